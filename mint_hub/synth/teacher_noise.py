"""Labels as a cascade makes them: a documented corruption of an episode's truth.

What real pseudo-labels get wrong (scale, slow drift of the path, hands that are missed, thrown far
off, or taken for the other one) is put into exact ones, so that a first training stage can learn
from labels of the usual quality and a second from exact cameras. In this order:

1. **Scale.** Camera centres move away from the first one by a factor that is constant in a clip
   and log-normal over clips, median 1.8. Hands stay as they are in the camera's frame.
2. **Path.** Every camera pose is turned and shifted in its own frame by white jitter, and by a
   drift that walks at random from the first frame, which has none.
3. **Hands.** Wrist position (smooth and white, more along the ray than across), orientation and
   fingers jitter; a bias of depth, constant in a clip, moves both hands along their rays.
4. **Outliers.** Now and then a hand is thrown off for a few frames, in position and orientation.
5. **Missing.** Bursts of frames lose a hand that was there: its score is 0. No hand is invented.
6. **Swaps.** Bursts of frames take each hand for the other: what was left is stored as right,
   turned half around so that palm and fingers point where they did; score and ``filled`` with it.

Field of view, shape, text and times are kept. The law: with all sizes 0 and the scale 1, the
episode comes back as it was.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import LEFT, RIGHT, SIDES
from mint_hub.geometry import hand_state as hands
from mint_hub.geometry.rigid import inverse, rigid
from mint_hub.geometry.rotations import matrix_to_rot6d_rows, rotvec_to_matrix
from mint_hub.loaders.schema import Episode
from mint_hub.synth.hand_anatomy import straight_axes

__all__ = ["TeacherNoise", "teacher_noise"]

Floats = NDArray[np.float64]
N = TypeVar("N", bound=np.generic)

_TURN_AROUND: Final = np.stack(
    [
        straight_axes(other) @ np.diag([-1.0, 1.0, -1.0]) @ straight_axes(side).T
        for side, other in zip(SIDES, SIDES[::-1], strict=True)
    ]
)
"""(2, 3, 3) for each hand: from the other's axes to its own with the same palm and fingers."""


@dataclass(frozen=True)
class TeacherNoise:
    """How wrong the teacher is; the default imitates the cascade, `none` is exact.

    Attributes:
        scale_median: of the factor on the camera's path.
        scale_sigma: standard deviation of its logarithm.
        jitter_m: of each camera position, before scaling by the clip's factor.
        jitter_deg: of each camera rotation.
        drift_m: after a second, of position, growing with the root of time.
        drift_deg: after a second, of rotation.
        wrist_m: of wrist positions across the ray; three times as much along it.
        depth_bias: standard deviation of the logarithm of a clip's factor on hand distances.
        orientation_deg: of wrist orientations.
        finger_deg: of each finger joint.
        outliers_per_s: bursts a second and hand in which it is thrown off.
        outlier_m: how far, about.
        missing_per_s: bursts a second and hand in which it is lost.
        missing_frames: mean length of those bursts.
        swaps_per_s: bursts a second in which sides are swapped.
        swap_frames: mean length of those bursts.

    Raises:
        ValueError: a number below 0, or a median that is not above 0.

    """

    scale_median: float = 1.8
    scale_sigma: float = 0.35
    jitter_m: float = 0.0015
    jitter_deg: float = 0.12
    drift_m: float = 0.006
    drift_deg: float = 0.35
    wrist_m: float = 0.004
    depth_bias: float = 0.06
    orientation_deg: float = 3.0
    finger_deg: float = 4.0
    outliers_per_s: float = 0.06
    outlier_m: float = 0.25
    missing_per_s: float = 0.12
    missing_frames: float = 8.0
    swaps_per_s: float = 0.03
    swap_frames: float = 6.0

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not (np.isfinite(value) and value >= 0):
                raise ValueError(f"teacher noise, {item.name}: expected 0 or more, got {value}")
        if self.scale_median == 0:
            raise ValueError("teacher noise, scale_median: expected more than 0, got 0")

    @classmethod
    def none(cls) -> TeacherNoise:
        """Return the settings that leave an episode as it is."""
        return cls(**{item.name: float(item.name == "scale_median") for item in fields(cls)})


def teacher_noise(episode: Episode, seed: int, settings: TeacherNoise | None = None) -> Episode:
    """Corrupt an episode's labels as the module describes.

    Args:
        episode: exact labels.
        seed: the same seed gives the same corruption of the same episode.
        settings: how much; `TeacherNoise()` without it.

    Returns:
        An episode with the same frames, whose ``meta`` says so: ``scale_status``, and
        ``teacher_noise`` with seed, settings, the scale that was drawn, and how many frames of
        either hand are outlying, missing or swapped.

    """
    size = settings or TeacherNoise()
    rng = np.random.default_rng([seed, 0x7EAC])
    scale = float(size.scale_median * np.exp(size.scale_sigma * rng.standard_normal()))
    camera = _camera(episode, size, scale, rng)
    state, outlying = _hands(episode, size, rng)
    presence, missing = _missing(episode, size, rng)
    score, filled = episode.presence_score, episode.filled
    if score is not None:
        score = np.where(missing, np.float32(0), score)
    if filled is not None:
        filled = filled & presence
    swapped = _bursts(rng, episode.num_frames, size.swaps_per_s / episode.fps, size.swap_frames)
    swapped &= presence.any(1)
    state = np.where(swapped[:, None, None], _taken_for_the_other(state), state)
    presence = _exchanged(presence, swapped)
    state = np.where(presence[..., None], state, hands.absent(presence.shape))
    status = "pseudo: path enlarged" if size != TeacherNoise.none() else None
    meta: dict[str, Any] = {
        **episode.meta,
        "teacher_noise": {
            "seed": seed,
            "scale": scale,
            "outlying": int((outlying & episode.presence).sum()),
            "missing": int(missing.sum()),
            "swapped": int(swapped.sum()),
            "settings": asdict(size),
        },
    }
    if status is not None:
        meta["scale_status"] = status
    return replace(
        episode,
        T_camera_from_world=camera,
        hand_state=state.astype(np.float32),
        presence=presence,
        presence_score=None if score is None else _exchanged(score, swapped),
        filled=None if filled is None else _exchanged(filled, swapped),
        meta=meta,
    )


def _camera(episode: Episode, size: TeacherNoise, scale: float, rng: np.random.Generator) -> Floats:
    """T_camera_from_world (T, 4, 4) with another scale, jitter and drift."""
    world_from_camera = np.array(episode.T_world_from_camera)
    first = world_from_camera[0, :3, 3]
    world_from_camera[:, :3, 3] = first + scale * (world_from_camera[:, :3, 3] - first)
    count = episode.num_frames
    walk = rng.standard_normal((count, 6)) / np.sqrt(episode.fps)
    walk[0] = 0
    drift = np.cumsum(walk, axis=0)
    white = rng.standard_normal((count, 6))
    white[0] = 0
    turn = np.deg2rad(size.jitter_deg * white[:, :3] + size.drift_deg * drift[:, :3])
    shift = scale * (size.jitter_m * white[:, 3:] + size.drift_m * drift[:, 3:])
    noisy = world_from_camera @ np.asarray(rigid(np.asarray(rotvec_to_matrix(turn)), shift))
    return np.asarray(inverse(noisy))


def _hands(
    episode: Episode, size: TeacherNoise, rng: np.random.Generator
) -> tuple[Floats, NDArray[np.bool_]]:
    """Hand states (T, 2, 109) with jitter and outliers, and which are outlying."""
    state = hands.unpack(episode.hand_state.astype(float))
    at = np.asarray(state.translation)
    count = episode.num_frames
    noise = _half_smooth(rng, (count, 2, 3))
    ray = at / np.maximum(np.linalg.norm(at, axis=-1, keepdims=True), 1e-9)
    along = (noise * ray).sum(-1, keepdims=True)
    bias = np.exp(size.depth_bias * rng.standard_normal())
    outlying = np.stack(
        [_bursts(rng, count, size.outliers_per_s / episode.fps, 2.5) for _ in range(2)], 1
    )
    thrown = size.outlier_m * rng.normal(0, 0.6, (count, 2, 3)) * outlying[..., None]
    moved = bias * at + size.wrist_m * (noise + 2 * along * ray) + thrown
    turn = np.deg2rad(size.orientation_deg) / np.sqrt(3) * _half_smooth(rng, (count, 2, 3))
    wild = rng.normal(0, 0.8, (count, 2, 3)) * outlying[..., None] * (size.outlier_m > 0)
    orientation = np.asarray(rotvec_to_matrix(turn + wild)) @ np.asarray(state.orientation())
    bend = np.deg2rad(size.finger_deg) / np.sqrt(3) * _half_smooth(rng, (count, 2, 15, 3))
    joints = np.asarray(rotvec_to_matrix(bend)) @ np.asarray(state.joint_rotations())
    made = hands.HandState(
        moved,
        matrix_to_rot6d_rows(orientation),
        matrix_to_rot6d_rows(joints),
        state.shape_params,
    )
    return np.asarray(made.pack()), outlying


def _missing(
    episode: Episode, size: TeacherNoise, rng: np.random.Generator
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Presence (T, 2) after losses, and what was lost."""
    lost = np.stack(
        [
            _bursts(rng, episode.num_frames, size.missing_per_s / episode.fps, size.missing_frames)
            for _ in range(2)
        ],
        1,
    )
    missing = lost & episode.presence
    return episode.presence & ~lost, missing


def _taken_for_the_other(state: Floats) -> Floats:
    """States (T, 2, 109) of each hand stored as the other, palm and fingers where they were."""
    other = hands.unpack(state[:, [RIGHT, LEFT]])
    turned = np.asarray(other.orientation()) @ _TURN_AROUND
    return np.asarray(replace(other, orientation_rot6d_rows=matrix_to_rot6d_rows(turned)).pack())


def _exchanged(array: NDArray[N], frames: NDArray[np.bool_]) -> NDArray[N]:
    """(T, 2) with the two hands exchanged in ``frames`` (T,)."""
    return np.where(frames[:, None], array[:, [RIGHT, LEFT]], array)


def _half_smooth(rng: np.random.Generator, shape: tuple[int, ...], frames: float = 10.0) -> Floats:
    """Noise of deviation 1 over the first axis: half of its variance white, half slow."""
    white, slow = rng.standard_normal(shape), rng.standard_normal(shape)
    keep = np.exp(-1 / frames)
    for k in range(1, shape[0]):
        slow[k] = keep * slow[k - 1] + np.sqrt(1 - keep * keep) * slow[k]
    return np.sqrt(0.5) * (white + slow)


def _bursts(
    rng: np.random.Generator, count: int, per_frame: float, mean_frames: float
) -> NDArray[np.bool_]:
    """Frames (T,) inside bursts that begin at random and last a geometric time."""
    out = np.zeros(count, bool)
    begins = rng.random(count) < per_frame
    lengths = rng.geometric(1 / max(mean_frames, 1.0), count)
    for k in np.flatnonzero(begins):
        out[k : k + lengths[k]] = True
    return out
