"""Make ``assets/mean_hand.json``: the mean hands of the synthetic training set.

``python -m mint_hub.evaluation.make_mean_hand [CLIPS]``. Worlds are made, nothing is drawn. For
another training set: ``MeanHand.of(episodes, "its name").save(path)``, then
``mint-hub evaluate --mean-hand``.
"""

import argparse
from collections.abc import Iterator

import numpy as np

from mint_hub.assets import asset_path
from mint_hub.evaluation.trivial import MEAN_HAND_FILE, MeanHand
from mint_hub.geometry.hand_state import absent
from mint_hub.loaders.schema import Episode
from mint_hub.synth.episodes import presence_of
from mint_hub.synth.presets import GENERATOR, seed_of
from mint_hub.synth.scene import make_world


def labels(count: int) -> Iterator[Episode]:
    """Labels of the first clips of the training preset, without pictures."""
    for number in range(count):
        world = make_world(seed_of("train", 0, number), "train")
        presence = presence_of(world)
        yield Episode(
            key=world.key,
            timestamps_s=np.arange(world.num_frames) / world.fps,
            T_camera_from_world=world.T_camera_from_world,
            fov_vh_rad=np.tile(np.asarray(world.fov_vh_rad), (world.num_frames, 1)),
            hand_state=np.where(
                presence[..., None], world.hands.hand_state, absent(presence.shape)
            ).astype(np.float32),
            presence=presence,
            image_size_hw=world.image_size_hw,
            meta={"shape_space": "mint"},
        )


def main() -> None:
    """Write the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("clips", type=int, nargs="?", default=64, help="default: 64")
    count = parser.parse_args().clips
    name = f"{count} clips of mint-hub synth train, generator {GENERATOR}"
    MeanHand.of(labels(count), name).save(asset_path(MEAN_HAND_FILE))


if __name__ == "__main__":
    main()
