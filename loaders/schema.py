"""Episode: the one record of the project.

The corpus reader reads it, the pipeline returns it, metrics compare two of them, viewers draw it.
Letters in shapes: T frames, 2 hands (left, right). Frames, units and sides are those of
``mint_hub.conventions``. What can be derived is derived, never stored.

>>> import numpy as np
>>> from mint_hub.geometry import hand_state
>>> episode = Episode(
...     key="example",
...     timestamps_s=np.arange(3) / 30,
...     T_camera_from_world=np.tile(np.eye(4), (3, 1, 1)),
...     fov_vh_rad=np.full((3, 2), np.pi / 2),
...     hand_state=hand_state.absent((3, 2)),
...     presence=np.zeros((3, 2), bool),
...     image_size_hw=(480, 640),
... )
>>> episode
Episode('example', 3 frames, 0.10 s at 30 fps, left 0 %, right 0 %, path 0.00 m)
>>> episode.K[0].round(2).tolist()
[[320.0, 0.0, 320.0], [0.0, 240.0, 240.0], [0.0, 0.0, 1.0]]
"""

import copy
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import MODEL_FPS
from mint_hub.geometry import hand_state as hands
from mint_hub.geometry import rigid
from mint_hub.geometry.camera import fov_vh_to_K
from mint_hub.geometry.rotations import matrix_to_rot6d_rows
from mint_hub.loaders import fields as checks
from mint_hub.loaders.episode_file import read_episode, write_episode
from mint_hub.loaders.fields import ARRAY_FIELDS, ArrayField, EpisodeError, TextSegment

if TYPE_CHECKING:
    from mint_hub.geometry.hand_model import HandModel

__all__ = [
    "ARRAY_FIELDS",
    "SCHEMA_VERSION",
    "ArrayField",
    "Episode",
    "EpisodeError",
    "TextSegment",
]

SCHEMA_VERSION: Final = 1
"""Goes up when a reader of the previous version would misread what is written now."""


def checked_version(value: object) -> int:
    """Return a schema version that this code reads.

    Raises:
        EpisodeError: no whole number, below 1, or newer than SCHEMA_VERSION.

    """
    version = checks.integer(value, "schema_version")
    if version > SCHEMA_VERSION:
        raise EpisodeError(
            f"schema_version: expected at most {SCHEMA_VERSION}, got {version}: "
            "written by a newer mint-hub, so upgrade this one"
        )
    if version < 1:
        raise EpisodeError(f"schema_version: expected at least 1, got {version}")
    return version


@dataclass(frozen=True, eq=False, repr=False)
class Episode:
    """A stretch of egocentric video with its camera and both hands.

    Arrays are converted to the declared dtype where no meaning is lost (ARRAY_FIELDS), checked,
    copied unless already read-only, and made read-only. Rotations of absent hands must be valid
    too: ``hand_state.absent`` is the canonical filling. ``meta`` becomes plain JSON values.

    Where hands were annotated in a way that cannot be read, both are absent throughout and
    ``meta["quality"]["hands"]`` says why ("unavailable: needs MANO"); without that entry, absent
    means that no hand was there or none was found.

    Raises:
        EpisodeError: a ValueError that names the field, what was expected, what came, and the key.

    """

    key: str
    timestamps_s: NDArray[np.float64]
    T_camera_from_world: NDArray[np.float64]
    fov_vh_rad: NDArray[np.float32]
    hand_state: NDArray[np.float32]
    presence: NDArray[np.bool_]
    presence_score: NDArray[np.float32] | None = None
    filled: NDArray[np.bool_] | None = field(default=None, kw_only=True)
    image_size_hw: tuple[int, int] = field(kw_only=True)
    text: tuple[TextSegment, ...] = ()
    meta: dict[str, Any] = field(default_factory=dict[str, Any])

    def __post_init__(self) -> None:
        key = checks.checked_key(self.key)
        try:
            checked = self._checked()
        except EpisodeError as error:
            raise EpisodeError(f"{error} (episode {key})") from None
        for name, value in checked.items():
            object.__setattr__(self, name, value)

    # ---------------------------------------------------------------- time

    @property
    def num_frames(self) -> int:
        """T."""
        return len(self.timestamps_s)

    @property
    def fps(self) -> float:
        """Frames a second: ``meta["fps"]``, else the mean rate of the timestamps.

        One frame without ``meta["fps"]`` has the model's rate, MODEL_FPS.
        """
        if "fps" in self.meta:
            return float(self.meta["fps"])
        if self.num_frames == 1:
            return MODEL_FPS
        span = float(self.timestamps_s[-1] - self.timestamps_s[0])
        return round((self.num_frames - 1) / span, 6)

    @property
    def duration_s(self) -> float:
        """Seconds from the first frame to the end of the last one."""
        return float(self.timestamps_s[-1] - self.timestamps_s[0]) + 1.0 / self.fps

    # -------------------------------------------------------------- camera

    @cached_property
    def T_world_from_camera(self) -> NDArray[np.float64]:  # noqa: N802
        """(T, 4, 4), metres: the pose of the camera in the world."""
        return checks.read_only(rigid.inverse(self.T_camera_from_world))

    @cached_property
    def K(self) -> NDArray[np.float64]:  # noqa: N802
        """(T, 3, 3) pinhole intrinsics in pixels of an image of ``image_size_hw``."""
        return checks.read_only(fov_vh_to_K(self.fov_vh_rad.astype(np.float64), self.image_size_hw))

    @property
    def path_length_m(self) -> float:
        """Metres the camera travels."""
        steps = np.diff(self.T_world_from_camera[:, :3, 3], axis=0)
        return float(np.linalg.norm(steps, axis=-1).sum())

    def camera_speed_m_s(self) -> NDArray[np.float64]:
        """Speed of the camera from each frame to the next, (T - 1,); of one frame: (1,) zero."""
        if self.num_frames == 1:
            return np.zeros(1)
        steps = np.diff(self.T_world_from_camera[:, :3, 3], axis=0)
        return np.linalg.norm(steps, axis=-1) / np.diff(self.timestamps_s)

    # --------------------------------------------------------------- hands

    def wrist_camera(self) -> NDArray[np.float64]:
        """T_camera_from_wrist, (T, 2, 4, 4), metres; NaN where the hand is absent."""
        return np.where(self.presence[..., None, None], self._wrist(), np.nan)

    def wrist_world(self) -> NDArray[np.float64]:
        """T_world_from_wrist, (T, 2, 4, 4), metres; NaN where the hand is absent."""
        return self.T_world_from_camera[:, None] @ self.wrist_camera()

    def hand_state_world(self) -> NDArray[np.float32]:
        """(T, 2, 109) hand states whose wrists are in the world instead of the camera.

        p_w = Rᵀ (p_c - t) and Q_w = Rᵀ Q_c with T_camera_from_world = [R | t]; joint rotations and
        shapes are the same in both. An absent hand is ``hand_state.absent``.
        """
        state = hands.unpack(self.hand_state)
        world = self.T_world_from_camera[:, None] @ self._wrist()
        moved = replace(
            state,
            translation=world[..., :3, 3],
            orientation_rot6d_rows=matrix_to_rot6d_rows(world[..., :3, :3]),
        ).pack()
        absent = hands.absent(self.presence.shape)
        return np.where(self.presence[..., None], moved, absent).astype(np.float32)

    def joints_camera(self, hand_model: "HandModel | None" = None) -> NDArray[np.float32]:
        """21 keypoints a hand in the camera frame, (T, 2, 21, 3), metres; NaN where absent.

        Args:
            hand_model: default: MANO where ``meta["shape_space"]`` is "mano" and MANO's files are
                found, else the licence-free template.

        """
        model = hand_model or self.default_hand_model()
        joints = model.keypoints(self.hand_state, shape_space=self.meta.get("shape_space"))
        return np.where(self.presence[..., None, None], joints, np.float32(np.nan))

    def joints_world(self, hand_model: "HandModel | None" = None) -> NDArray[np.float64]:
        """21 keypoints a hand in the world, (T, 2, 21, 3), metres; NaN where absent."""
        joints = self.joints_camera(hand_model).astype(np.float64)
        T = self.T_world_from_camera[:, None, None]
        return (T[..., :3, :3] @ joints[..., None])[..., 0] + T[..., :3, 3]

    def default_hand_model(self) -> "HandModel":
        """Return the hand that ``joints_camera`` uses when none is given."""
        from mint_hub.geometry.hand_model import HandModel

        if self.meta.get("shape_space") == "mano":
            return HandModel.default()
        return HandModel.template()

    # ------------------------------------------------- parts and comparison

    def window(self, start: int, length: int) -> Self:
        """Return frames start .. start + length - 1, with timestamps, world and key unchanged.

        Text is cut to the window and renumbered to it; ``meta["window_start"]`` counts from the
        first frame of the whole episode, so that a window of a window is one window.

        Raises:
            EpisodeError: the frames are not all there, or length < 1.

        """
        stop = start + length
        checks.require_window(start, length, self.num_frames, self.key)
        text = (
            replace(s, start=max(s.start, start) - start, end=min(s.end, stop) - start)
            for s in self.text
            if s.start < stop and s.end > start
        )
        meta = copy.deepcopy(self.meta)
        for name in checks.PER_FRAME_META:
            if meta.get(name) is not None:
                meta[name] = meta[name][start:stop]
        if first := meta.get("window_start", 0) + start:
            meta["window_start"] = first
        arrays = {name: array[start:stop] for name, array in self._arrays()}
        return replace(self, **arrays, text=tuple(text), meta=meta)

    def allclose(self, other: "Episode", atol: float = 1e-6) -> bool:
        """Whether both say the same: arrays within ``atol``, everything else exactly."""
        mine, theirs = dict(self._arrays()), dict(other._arrays())
        return (
            (self.key, self.image_size_hw, self.text, self.meta)
            == (other.key, other.image_size_hw, other.text, other.meta)
            and mine.keys() == theirs.keys()
            and self.num_frames == other.num_frames
            and all(np.allclose(mine[n], theirs[n], rtol=0, atol=atol) for n in mine)
        )

    # ----------------------------------------------------- dicts and files

    def to_dict(self) -> dict[str, Any]:
        """Return every stored field by name: arrays stay numpy, the rest is JSON-able."""
        return {
            "schema_version": SCHEMA_VERSION,
            "key": self.key,
            "image_size_hw": list(self.image_size_hw),
            "text": [segment.to_dict() for segment in self.text],
            "meta": copy.deepcopy(self.meta),
            **dict(self._arrays()),
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Build an episode from ``to_dict``'s result; nested lists are as good as arrays.

        Raises:
            EpisodeError: a field is missing, unknown or wrong, or the schema is a newer one.

        """
        given = dict(values)
        checked_version(given.pop("schema_version", SCHEMA_VERSION))
        known = {f.name for f in fields(cls)}
        optional = {"text", "meta", *(f.name for f in ARRAY_FIELDS if f.optional)}
        if missing := sorted(known - optional - given.keys()):
            raise EpisodeError(f"{missing[0]}: expected this field, got none")
        if unknown := sorted(given.keys() - known):
            raise EpisodeError(f"{unknown[0]}: expected a field of an episode, got an unknown name")
        text = given.get("text") or ()
        if not isinstance(text, list | tuple):
            raise EpisodeError(f"text: expected a list of segments, got {text!r}")
        given["text"] = tuple(map(TextSegment.from_dict, text))  # pyright: ignore
        given["meta"] = given.get("meta") or {}
        return cls(**given)

    def save(self, path: str | PathLike[str]) -> Path:
        """Write one ``.npz`` file (plain arrays and JSON, no pickle) and return its path.

        The same episode gives the same bytes. The file appears whole or not at all.

        Raises:
            EpisodeError: the path does not end in .npz.

        """
        return write_episode(self.to_dict(), Path(path))

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Self:
        """Read what ``save`` wrote. Nothing is unpickled.

        Raises:
            FileNotFoundError: there is no such file.
            EpisodeError: names the file, the field, what was expected and what came.

        """
        try:
            return cls.from_dict(read_episode(Path(path)))
        except EpisodeError as error:
            raise EpisodeError(f"{path}: {error}") from None

    def __repr__(self) -> str:
        left, right = (100 * self.presence.mean(axis=0)).round().astype(int)
        return (
            f"Episode({self.key!r}, {self.num_frames} frames, {self.duration_s:.2f} s at "
            f"{self.fps:.4g} fps, left {left} %, right {right} %, path {self.path_length_m:.2f} m)"
        )

    # ------------------------------------------------------------- private

    def _wrist(self) -> NDArray[np.float64]:
        state = hands.unpack(self.hand_state.astype(np.float64))
        return np.asarray(rigid.rigid(state.orientation(), state.translation))

    def _arrays(self) -> Iterator[tuple[str, NDArray[Any]]]:
        pairs = ((f.name, getattr(self, f.name)) for f in ARRAY_FIELDS)
        return ((name, array) for name, array in pairs if array is not None)

    def _checked(self) -> dict[str, Any]:
        arrays: dict[str, NDArray[Any]] = {}
        for spec in ARRAY_FIELDS:
            if (value := getattr(self, spec.name)) is not None or not spec.optional:
                num_frames = len(arrays["timestamps_s"]) if arrays else None
                arrays[spec.name] = checks.checked_array(spec, value, num_frames)
        num_frames = len(arrays["timestamps_s"])
        checks.check_values(arrays)
        if not isinstance(self.text, tuple | list):  # pyright: ignore[reportUnnecessaryIsInstance]
            raise EpisodeError(f"text: expected a tuple of TextSegments, got {self.text!r}")
        text = tuple(self.text)
        for segment in text:
            if not isinstance(segment, TextSegment):  # pyright: ignore[reportUnnecessaryIsInstance]
                raise EpisodeError(f"text: expected TextSegments, got {segment!r}")
            if segment.end > num_frames:
                place = f"text segment {segment.id!r} end"
                raise EpisodeError(f"{place}: expected at most T = {num_frames}, got {segment.end}")
        meta = checks.checked_meta(self.meta, num_frames)
        size = checks.checked_size(self.image_size_hw)
        return {**arrays, "image_size_hw": size, "text": text, "meta": meta}
