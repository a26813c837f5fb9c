"""What the cascade made of real clips: a row a clip, and the Ego4D clip against its annotation.

    mint-hub label CLIPS -o CORPUS
    python benchmarks/labelling_clips.py CORPUS [--ego4d ANNOTATION.npy]

Camera and hands are compared where the annotation has them: the path after one similarity fit over
the camera centres, orientations after one constant turn, hands in the camera frame.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from _report import write_report

from mint_hub.geometry.rigid import umeyama
from mint_hub.geometry.rotations import geodesic_angle, mean_rotation
from mint_hub.loaders.schema import Episode
from mint_hub.loaders.vitra import from_vitra


def row_of(episode: Episode, account: dict[str, Any]) -> dict[str, Any]:
    """Return the numbers of one episode."""
    quality, scale = episode.meta["quality"], episode.meta["provenance"]["scale"] or {}
    width = episode.image_size_hw[1]
    return {
        "seconds_kept": round(episode.duration_s, 2),
        "seconds_lost": {k: round(v, 2) for k, v in account["lost_s"].items()},
        "hands_observed_left_right": quality["hands_observed"],
        "hands_filled_left_right": quality["hands_filled"],
        "hands_residual_px": quality["hands_residual_px"],
        "focal_share_of_width": round(float(episode.K[0, 0, 0]) / width, 5),
        "camera_solved": quality["camera_solved"],
        "points_shared_min": quality["covisible_min"],
        "camera_residual_px": quality["camera_residual_px"],
        "scale_source": scale.get("source"),
        "metres_per_unit": scale.get("metres_per_unit"),
        "scale_log_sigma": scale.get("log_sigma"),
        "stage_s": account["stage_s"],
    }


def against(episode: Episode, truth: Episode) -> dict[str, Any]:
    """Compare with an annotation of the same frames."""
    frames = min(episode.num_frames, truth.num_frames)
    mine, true = episode.T_world_from_camera[:frames], truth.T_world_from_camera[:frames]
    fit = umeyama(mine[:, :3, 3], true[:, :3, 3], with_scale=True)
    away = np.linalg.norm(fit.apply(mine[:, :3, 3]) - true[:, :3, 3], axis=-1)
    turn = true[:, :3, :3] @ np.swapaxes(mine[:, :3, :3], -1, -2)
    off = np.degrees(
        geodesic_angle(np.asarray(mean_rotation(turn)) @ mine[:, :3, :3], true[:, :3, :3])
    )
    both = episode.presence[:frames, 1] & truth.presence[:frames, 1]
    wrist, true_wrist = episode.wrist_camera()[:frames, 1], truth.wrist_camera()[:frames, 1]
    turned = np.degrees(geodesic_angle(wrist[both, :3, :3], true_wrist[both, :3, :3]))
    step = np.linalg.norm(wrist[both, :3, 3] - true_wrist[both, :3, 3], axis=-1)
    return {
        "frames": frames,
        "camera_ate_cm_sim3": round(100 * float(np.sqrt((away**2).mean())), 4),
        "camera_path_cm": round(100 * truth.window(0, frames).path_length_m, 2),
        "camera_rotation_deg_mean": round(float(off.mean()), 4),
        "camera_rotation_deg_max": round(float(off.max()), 4),
        "scale_fitted": round(float(fit.scale), 4),
        "right_hand_frames_both": int(both.sum()),
        "wrist_error_mm_mean": round(1000 * float(step.mean()), 1),
        "wrist_turn_deg_mean": round(float(turned.mean()), 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("corpus", type=Path)
    parser.add_argument("--ego4d", type=Path, help="annotation of the Ego4D clip")
    args = parser.parse_args()
    clips: dict[str, Any] = {}
    results: dict[str, Any] = {"clips": clips}
    for place in sorted(args.corpus.glob("labelling/videos/*/account.json")):
        account = json.loads(place.read_text())
        if not account["episodes"]:
            clips[place.parent.name] = {"rejected": account["reason"], "lost_s": account["lost_s"]}
        for key in account["episodes"]:
            episode = Episode.load(place.parent / "episodes" / f"{key}.npz")
            clips[key] = row_of(episode, account)
            if args.ego4d and account["uid"] in args.ego4d.name:
                results["ego4d"] = against(episode, from_vitra(args.ego4d))
    print(json.dumps(results, indent=1))
    print(write_report("labelling_clips", results))


if __name__ == "__main__":
    main()
