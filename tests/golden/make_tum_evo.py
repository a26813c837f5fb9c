"""Write tum_fr2_desk_evo.json: what the ``evo`` package (1.38.1) says of TUM's fr2_desk pair.

    python tests/golden/make_tum_evo.py FOLDER

FOLDER holds ``fr2_desk_groundtruth.txt`` and ``fr2_desk_ORB.txt``, as evo's test data has them;
``pip install evo`` in an environment of its own. Only the numbers travel with the repository.
"""

import copy
import json
import sys
from importlib import metadata
from pathlib import Path

from evo.core import metrics, sync
from evo.tools import file_interface


def rmse(metric, pair):
    metric.process_data(pair)
    return float(metric.get_statistic(metrics.StatisticsType.rmse))


def numbers(truth, aligned):
    pair = (truth, aligned)
    relation, frames = metrics.PoseRelation, metrics.Unit.frames
    found = {"ate_m": rmse(metrics.APE(relation.translation_part), pair)}
    for delta in (1, 30):
        for name, part in (("m", relation.translation_part), ("deg", relation.rotation_angle_deg)):
            metric = metrics.RPE(part, delta=delta, delta_unit=frames, all_pairs=True)
            found[f"rpe_{delta}_{name}"] = rmse(metric, pair)
    return found


def main(folder: Path) -> None:
    truth = file_interface.read_tum_trajectory_file(folder / "fr2_desk_groundtruth.txt")
    predicted = file_interface.read_tum_trajectory_file(folder / "fr2_desk_ORB.txt")
    truth, predicted = sync.associate_trajectories(truth, predicted, max_diff=0.01)
    result = {
        "evo": metadata.version("evo"),
        "pairs": truth.num_poses,
        "true_path_m": float(truth.path_length),
        "predicted_path_m": float(predicted.path_length),
    }
    for name, with_scale in (("se3", False), ("sim3", True)):
        aligned = copy.deepcopy(predicted)
        _, _, scale = aligned.align(truth, correct_scale=with_scale)
        result[name] = {"scale": float(scale), **numbers(truth, aligned)}
    path = Path(__file__).with_name("tum_fr2_desk_evo.json")
    path.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
