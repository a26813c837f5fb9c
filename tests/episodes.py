"""Synthetic but plausible episodes, made without any video or network, for tests of every part."""

import numpy as np
from scipy.spatial.transform import Rotation

from mint_hub.geometry import hand_state
from mint_hub.loaders.schema import Episode, TextSegment

REACH_M = 0.45


def make_episode(
    num_frames: int = 90,
    seed: int = 0,
    *,
    fps: float = 30.0,
    image_size_hw: tuple[int, int] = (480, 640),
    gaps: bool = True,
    key: str = "synthetic-0",
    meta: dict | None = None,
) -> Episode:
    """A head that walks and looks around above two hands that work in front of it.

    With ``gaps``, the left hand is away in the third quarter and the right one in a short blink
    before the end; absent frames hold the canonical absent state.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(num_frames) / fps
    presence = np.ones((num_frames, 2), bool)
    if gaps and num_frames >= 8:
        presence[num_frames // 2 : 3 * num_frames // 4, 0] = False
        presence[-num_frames // 8 : -num_frames // 16, 1] = False
    state = np.where(presence[..., None], _hands(rng, t), hand_state.absent((num_frames, 2)))
    noise = np.abs(_smooth(rng, t, 2, 0.06))
    wobble = _smooth(rng, t, 1, 0.002)
    return Episode(
        key=key,
        timestamps_s=t,
        T_camera_from_world=_head(rng, t),
        fov_vh_rad=np.array([1.05, 1.31]) + wobble,
        hand_state=state,
        presence=presence,
        presence_score=np.where(presence, 0.98 - noise, 0.05 + noise).clip(0, 1),
        image_size_hw=image_size_hw,
        text=(
            TextSegment("a", "open the jar", "both", 0, max(1, num_frames // 2)),
            TextSegment("b", "put down the lid", "right", num_frames // 3, num_frames),
        ),
        meta={
            "source": "synthetic",
            "uid": f"seed-{seed}",
            "fps": fps,
            "scale_status": "synthetic, metric",
            "shape_space": "mint",
            "source_timestamps_s": t.tolist(),
            "provenance": {"generator": "tests.episodes", "seed": seed},
            "warnings": [],
            **(meta or {}),
        },
    )


def _smooth(rng: np.random.Generator, t: np.ndarray, size: int, amplitude: float) -> np.ndarray:
    """Sum of four sines a channel, (T, size), of roughly the given amplitude."""
    rate = rng.uniform(0.1, 0.9, (4, size))
    phase = rng.uniform(0, 2 * np.pi, (4, size))
    waves = np.sin(2 * np.pi * rate * t[:, None, None] + phase) / (1 + 2 * rate)
    return amplitude * waves.sum(axis=1)


def _head(rng: np.random.Generator, t: np.ndarray) -> np.ndarray:
    """T_camera_from_world (T, 4, 4): a slow walk with a turn; the first pose is the world."""
    position = _smooth(rng, t, 3, 0.08) + np.stack([0.15 * t, 0 * t, 0.1 * t], axis=-1)
    turn = Rotation.from_rotvec(_smooth(rng, t, 3, 0.15) + [0.0, 0.05, 0.0] * t[:, None])
    T_world_from_camera = np.tile(np.eye(4), (len(t), 1, 1))
    T_world_from_camera[:, :3, :3] = turn.as_matrix()
    T_world_from_camera[:, :3, 3] = position
    T_world_from_first = T_world_from_camera[0].copy()
    return np.linalg.inv(T_world_from_camera) @ T_world_from_first


def _hands(rng: np.random.Generator, t: np.ndarray) -> np.ndarray:
    """Hand states (T, 2, 109): palms down in front of the camera, fingers forward, flexing."""
    num_frames = len(t)
    translation = np.stack([[-0.14, 0.16, REACH_M], [0.14, 0.16, REACH_M]]) + np.stack(
        [_smooth(rng, t, 3, 0.06) for _ in range(2)], axis=1
    )
    # Columns are where x, y, z go. Right: fingers along -x, palm facing -y; left: its mirror image.
    palm_down = (
        Rotation.from_matrix([[0, 0, 1], [0, -1, 0], [1, 0, 0]]),
        Rotation.from_matrix([[0, 0, -1], [0, -1, 0], [-1, 0, 0]]),
    )
    orientation = np.stack(
        [
            (Rotation.from_rotvec(_smooth(rng, t, 3, 0.3)) * palm_down[hand]).as_matrix()
            for hand in range(2)
        ],
        axis=1,
    )
    flexion = np.zeros((num_frames, 2, 15, 3))
    curl = 0.45 + _smooth(rng, t, 10, 0.25).reshape(num_frames, 2, 5)
    flexion[..., 2] = np.repeat(curl, 3, axis=-1)
    flexion += rng.normal(0, 0.03, (2, 15, 3))
    joints = Rotation.from_rotvec(flexion.reshape(-1, 3)).as_matrix()
    shape = np.broadcast_to(rng.normal(0, 0.3, 10), (num_frames, 2, 10))
    return (
        hand_state.HandState.from_matrices(
            translation=translation,
            orientation=orientation,
            joint_rotations=joints.reshape(num_frames, 2, 15, 3, 3),
            shape_params=shape,
        )
        .pack()
        .astype(np.float32)
    )
