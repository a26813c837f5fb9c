"""A small packed corpus to train on, and a network small enough for it."""

import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mint_hub.geometry.hand_model import HandModel
from mint_hub.loaders.clips import encode_clip
from mint_hub.loaders.schema import Episode
from mint_hub.loaders.shards import write_corpus
from mint_hub.model.configuration_mint import MintConfig
from tests.episodes import make_episode

SIZE_HW = (56, 84)
WINDOW = 4


def config() -> MintConfig:
    """One layer of everything at 28 x 42 pixels."""
    return MintConfig.tiny(
        image_size=(28, 42),
        patch_size=14,
        patch_stem="linear",
        position_grid=3,
        hidden_size=32,
        num_attention_heads=2,
        encoder_layers=1,
        aggregator_layers=1,
        camera_layers=1,
        camera_heads=4,
        camera_relative_to="first",
        camera_output_scale=1.0,
        initializer="release",
        motion_radius=0,
        hand_crop_size=0,
        camera_iterations=2,
        fov_hidden_size=16,
        fov_heads=2,
        fov_layers=1,
        hand_hidden_size=32,
        hand_heads=2,
        presence_hidden_size=16,
        presence_heads=2,
    )


def pictures(episode: Episode, size_hw: tuple[int, int] = SIZE_HW) -> np.ndarray:
    """Draw joints as coloured squares on a smooth background, (T, H, W, 3) uint8."""
    height, width = size_hw
    v, u = np.mgrid[:height, :width]
    images = np.empty((episode.num_frames, height, width, 3), np.uint8)
    joints = np.nan_to_num(episode.joints_camera(HandModel.template()), nan=-1.0)
    scale = np.array([width, height]) / np.array(episode.image_size_hw)[::-1]
    for k in range(episode.num_frames):
        yaw = episode.T_camera_from_world[k, 0, 2]
        images[k] = np.stack([60 + u, 90 + v, 0 * u + 128 + 100 * yaw], -1).clip(0, 255)
        for hand in range(2):
            for x, y, z in joints[k, hand]:
                if z > 0.01:
                    K = episode.K[k]
                    at = np.array([K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]]) * scale
                    at = np.round(at).astype(int)
                    if (at >= 0).all() and at[0] < width and at[1] < height:
                        colour = (230, 40, 40) if hand else (40, 40, 230)
                        images[k, at[1] : at[1] + 3, at[0] : at[0] + 3] = colour
    return images


def training_episode(key: str, num_frames: int = 9, **options) -> Episode:
    meta = {"uid": key, "source": "made", "domain": "daily"} | options.pop("meta", {})
    seed = zlib.crc32(key.encode())
    return make_episode(num_frames, seed=seed, key=key, meta=meta, **options)


def write_packed(
    folder: Path,
    episodes: Sequence[Episode],
    config_name: str = "made",
    split: str = "train",
    packed: bool = True,
) -> Path:
    """Write a corpus whose clips are drawn from its labels."""

    def members(episode: Episode) -> dict[str, bytes]:
        return {"mp4": encode_clip(pictures(episode), fps=30.0, crf=18)}

    write_corpus(
        list(episodes),
        folder,
        config_name,
        split,
        format="lossless",
        extra=True,
        extra_members=members if packed else None,
    )
    return folder


def still(episode: Episode) -> Episode:
    """The same with one field of view and no presence scores."""
    fov = np.broadcast_to(episode.fov_vh_rad[:1], episode.fov_vh_rad.shape)
    return replace(episode, fov_vh_rad=fov, presence_score=None)
