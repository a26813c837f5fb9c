"""Answers that need no model; a number is only good beside theirs.

- ``mean hand``: the training set's mean hands at their mean places, each there as often as in
  training, by lot.
- ``always present``: the same hands, both there in every frame.
- ``zero camera motion``: the camera stays where it was in the first frame; hands as above.
- ``last frame copied``: the truth, one frame late. No answer without a model could be this good;
  it shows how little a slow clip asks.
"""

import hashlib
import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final, get_args

import numpy as np
from numpy.typing import NDArray

from mint_hub.assets import read_asset
from mint_hub.conventions import ShapeSpace
from mint_hub.geometry import hand_state as hands
from mint_hub.geometry.rotations import mean_rotation
from mint_hub.loaders.atomic import replacing
from mint_hub.loaders.schema import Episode

MEAN_HAND_FILE: Final = "mean_hand.json"
TRIVIAL: Final = ("mean hand", "always present", "zero camera motion", "last frame copied")


@dataclass(frozen=True)
class MeanHand:
    """What a training set says before any picture is seen.

    Attributes:
        trained_on: which set, in words.
        frames: how many of them.
        hand_state: (2, 109) mean hand of each side; rotations are means on SO(3).
        presence_rate: (2,) share of frames with the hand.
        fov_vh_rad: (2,) mean field of view.
        shape_space: of the shape numbers.

    """

    trained_on: str
    frames: int
    hand_state: list[list[float]]
    presence_rate: list[float]
    fov_vh_rad: list[float]
    shape_space: str

    @classmethod
    def of(cls, episodes: Iterable[Episode], trained_on: str, step: int = 10) -> "MeanHand":
        """Average every ``step``-th frame.

        Raises:
            ValueError: no frame with a left hand, or none with a right one.

        """
        kept = list(episodes)
        states = np.concatenate([e.hand_state[::step].astype(float) for e in kept])
        there = np.concatenate([e.presence[::step] for e in kept])
        fov = np.concatenate([e.fov_vh_rad[::step].astype(float) for e in kept])
        if not there.any(axis=0).all():
            raise ValueError(f"{trained_on}: expected frames with each hand, got none with one")
        mean: list[list[float]] = []
        for hand in range(2):
            own = hands.unpack(states[there[:, hand], hand])
            packed = hands.HandState.from_matrices(
                np.asarray(own.translation).mean(axis=0),
                np.asarray(mean_rotation(own.orientation())),
                np.asarray(mean_rotation(own.joint_rotations())),
                np.asarray(own.shape_params).mean(axis=0),
            ).pack()
            mean.append(np.asarray(packed, float).round(6).tolist())
        return cls(
            trained_on,
            len(states),
            mean,
            there.mean(axis=0).round(4).tolist(),
            fov.mean(axis=0).round(6).tolist(),
            str(kept[0].meta.get("shape_space", "mint")),
        )

    @classmethod
    def load(cls, path: Path | None = None) -> "MeanHand":
        """Read what ``save`` wrote; without a path, what comes with mint-hub.

        Raises:
            ValueError: no such file, or not a mean hand.

        """
        try:
            data = read_asset(MEAN_HAND_FILE) if path is None else path.read_bytes()
            return cls(**json.loads(data)).checked()
        except FileNotFoundError:
            raise ValueError(f"{path}: expected a mean hand, found no file") from None
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"{path or MEAN_HAND_FILE}: expected a mean hand, got {error}"
            ) from None

    def save(self, path: Path) -> Path:
        """Write it as JSON."""
        with replacing(path) as temporary:
            temporary.write_text(json.dumps(asdict(self), indent=1) + "\n", encoding="utf-8")
        return path

    def state(self) -> NDArray[np.float32]:
        """(2, 109) hand states."""
        return np.asarray(self.hand_state, np.float32)

    def checked(self) -> "MeanHand":
        """Return itself.

        Raises:
            ValueError: a field has another shape or kind than it should, numbers that are not
                finite or out of range, or a rotation that is none; names the field.

        """
        limits = {
            "hand_state": ((2, hands.HAND_STATE_SIZE), -np.inf, np.inf),
            "presence_rate": ((2,), 0.0, 1.0),
            "fov_vh_rad": ((2,), 1e-3, np.pi - 1e-3),
        }
        for name, (shape, low, high) in limits.items():
            try:
                values = np.asarray(getattr(self, name), np.float64)
            except (TypeError, ValueError):
                raise ValueError(f"{name}: expected numbers {shape}, got others") from None
            if values.shape != shape:
                raise ValueError(f"{name}: expected {shape}, got {values.shape}")
            if not (np.isfinite(values) & (values >= low) & (values <= high)).all():
                raise ValueError(
                    f"{name}: expected finite numbers from {low:g} to {high:g}, got "
                    f"{values.min():g} to {values.max():g}"
                )
        if self.shape_space not in get_args(ShapeSpace):
            raise ValueError(
                f"shape_space: expected one of {get_args(ShapeSpace)}, got {self.shape_space!r}"
            )
        own = hands.unpack(self.state())
        for decode in (own.orientation, own.joint_rotations):
            decode()  # a degenerate rotation raises
        return self


def trivial_predictions(
    truth: Episode, mean: MeanHand, seen: NDArray[np.bool_] | None = None
) -> dict[str, Episode]:
    """Return the answers of TRIVIAL for a clip, as episodes.

    Args:
        truth: the clip's.
        mean: hands of the training set.
        seen: (T, 2) which true hands can be seen, for the last frame copied; the truth's presence
            without it. They differ where the truth knows hands off screen, as motion capture does.

    """
    count = truth.num_frames
    seed = int.from_bytes(hashlib.sha256(truth.key.encode()).digest()[:8], "little")
    by_lot = np.random.default_rng(seed).random((count, 2)) < mean.presence_rate
    still = np.tile(np.eye(4), (count, 1, 1))
    always = _constant(truth, mean, np.ones((count, 2), bool), still)
    return {
        "mean hand": _constant(truth, mean, by_lot, still),
        "always present": always,
        "zero camera motion": always,
        "last frame copied": _late(truth, truth.presence if seen is None else seen),
    }


def _constant(
    truth: Episode,
    mean: MeanHand,
    presence: NDArray[np.bool_],
    T_camera_from_world: NDArray[np.float64],
) -> Episode:
    count = truth.num_frames
    state = np.where(presence[..., None], mean.state(), hands.absent((count, 2)))
    return replace(
        truth,
        T_camera_from_world=T_camera_from_world,
        fov_vh_rad=np.tile(np.asarray(mean.fov_vh_rad, np.float32), (count, 1)),
        hand_state=state.astype(np.float32),
        presence=presence,
        presence_score=None,
        filled=None,
        text=(),
        meta=_meta(truth, mean.shape_space),
    )


def _late(truth: Episode, seen: NDArray[np.bool_]) -> Episode:
    """The truth of the frame before; the first frame has its own."""
    before = np.maximum(np.arange(truth.num_frames) - 1, 0)
    there = seen[before]
    state = np.where(there[..., None], truth.hand_state[before], hands.absent(there.shape))
    return replace(
        truth,
        T_camera_from_world=truth.T_camera_from_world[before],
        fov_vh_rad=truth.fov_vh_rad[before],
        hand_state=state.astype(np.float32),
        presence=there,
        presence_score=None,
        filled=None,
        text=(),
        meta=_meta(truth, str(truth.meta.get("shape_space", "mint")), truth.meta.get("hand_model")),
    )


def _meta(truth: Episode, shape_space: str, hand_model: Any = None) -> dict[str, Any]:
    made = {"source": "trivial", "fps": truth.fps, "shape_space": shape_space}
    return made if hand_model is None else {**made, "hand_model": hand_model}
