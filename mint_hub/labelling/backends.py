"""Every backend there is, by stage and name; made from plain settings.

>>> default_backend("detect")
'mediapipe'
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from importlib import import_module
from types import UnionType
from typing import Any, Final, Literal, Union, get_args, get_origin, get_type_hints

from mint_hub.labelling.stage import Stage

STAGES: Final = (
    "normalise",
    "detect",
    "filter",
    "intrinsics",
    "undistort",
    "depth",
    "camera",
    "hands",
    "stitch",
    "scale",
    "clean",
    "describe",
    "accept",
)
"""Places in the cascade, in order."""

OPTIONAL: Final = frozenset({"depth"})
"""Places that stay empty unless a backend is chosen."""


@dataclass(frozen=True)
class Backend:
    """One backend.

    Attributes:
        stage: its place.
        name: its name there.
        path: where its class is, "module:Class", the module below `mint_hub.labelling.stages`.
        what: what it is, in a line.
        default: whether it is the one used unless another is chosen.

    """

    stage: str
    name: str
    path: str
    what: str
    default: bool = False

    def load(self) -> type[Any]:
        """Import the class."""
        module, _, name = self.path.partition(":")
        return getattr(import_module(f"mint_hub.labelling.stages.{module}"), name)

    def settings_type(self) -> type[Any]:
        """Return the dataclass of its settings."""
        hint = get_type_hints(self.load().__init__)["settings"]
        kinds: list[type[Any]] = [k for k in (hint, *get_args(hint)) if is_dataclass(k)]  # pyright: ignore
        assert len(kinds) == 1, (self.path, hint)
        return kinds[0]


BACKENDS: Final = (
    Backend(
        *("normalise", "default", "normalise:Normalise"),
        "constant 30 frames/s, upright, in clips of 10 to 15 s",
        default=True,
    ),
    Backend(
        *("detect", "mediapipe", "mediapipe_hands:MediaPipeHands"),
        "MediaPipe Hands: boxes, 2-D and 3-D landmarks, on a CPU",
        default=True,
    ),
    Backend(*("detect", "yolo", "yolo_hands:YoloHands"), "boxes by a YOLO model of yours"),
    Backend(
        *("filter", "hands", "hand_filter:HandFilter"),
        "keeps stretches where hands are seen, two at most",
        default=True,
    ),
    Backend(
        *("intrinsics", "sfm", "sfm_camera:SfmIntrinsics"),
        "one focal a video, from structure from motion",
        default=True,
    ),
    Backend(*("intrinsics", "given", "given_intrinsics:GivenIntrinsics"), "the camera you know"),
    Backend(
        *("intrinsics", "geocalib", "geocalib:GeoCalibIntrinsics"),
        "GeoCalib: focal and gravity from single pictures",
    ),
    Backend(*("intrinsics", "mint", "mint:MintIntrinsics"), "a MINT checkpoint's field of view"),
    Backend(
        *("undistort", "default", "undistort:Undistort"),
        "takes a lens that is known and material out of the video",
        default=True,
    ),
    Backend(*("depth", "moge2", "moge2:MogeDepth"), "MoGe-2: metric depth, for the scale"),
    Backend(
        *("camera", "sfm", "sfm_camera:SfmCamera"),
        "structure from motion with a covisibility gate",
        default=True,
    ),
    Backend(*("camera", "megasam", "megasam:MegaSamCamera"), "MegaSaM, its scale handed back"),
    Backend(*("camera", "droid_slam", "droid_slam:DroidCamera"), "DROID-SLAM, monocular"),
    Backend(*("camera", "mint", "mint:MintCamera"), "a MINT checkpoint's camera and hands"),
    Backend(
        *("hands", "ik", "fitted_hands:FittedHands"),
        "tracks with side voting, and a hand model fitted to the landmarks",
        default=True,
    ),
    Backend(*("hands", "hawor", "hawor:HaworHands"), "HaWoR: MANO hands in the camera frame"),
    Backend(*("hands", "mint", "mint:MintHands"), "a MINT checkpoint's hands"),
    Backend(
        *("stitch", "default", "stitch:Stitch"),
        "joins clips over the frames they share",
        default=True,
    ),
    Backend(
        *("scale", "evidence", "metric_scale:MetricScale"),
        "metres from a factor, a length, depth or the hands",
        default=True,
    ),
    Backend(
        *("clean", "default", "clean:Clean"),
        "spikes and outliers out, short gaps filled and marked, smoothed",
        default=True,
    ),
    Backend(
        *("describe", "annotations", "describe:Describe"),
        "action text of the source's annotations or a table",
        default=True,
    ),
    Backend(
        *("describe", "vlm", "describe:DescribeWithModel"),
        "action text by a vision-language model of yours",
    ),
    Backend(
        *("accept", "default", "accept:Accept"),
        "accepts or rejects an episode, with the reason",
        default=True,
    ),
)


def backend_of(stage: str, name: str) -> Backend:
    """Find a backend.

    Raises:
        ValueError: no such stage, or no such backend of it; lists what there is.

    """
    if stage not in STAGES:
        raise ValueError(f"stage: expected one of {', '.join(STAGES)}, got {stage!r}")
    there = {backend.name: backend for backend in BACKENDS if backend.stage == stage}
    if name not in there:
        raise ValueError(f"backend of {stage}: expected one of {', '.join(there)}, got {name!r}")
    return there[name]


def default_backend(stage: str) -> str | None:
    """Name the backend of a stage that is used unless another is chosen; None for no backend.

    Raises:
        ValueError: no such stage.

    """
    if stage not in STAGES:
        raise ValueError(f"stage: expected one of {', '.join(STAGES)}, got {stage!r}")
    return next((b.name for b in BACKENDS if b.stage == stage and b.default), None)


def make(stage: str, name: str | None, settings: Mapping[str, Any] | None = None) -> Stage:
    """Make a stage of plain settings.

    Args:
        stage: its place.
        name: the backend; the default one, or the only one there is, when None.
        settings: by name; lists become tuples, mappings become settings within settings.

    Raises:
        ValueError: no such backend, a setting it does not have, a value of another kind, or one
            that it refuses.

    """
    backend = backend_of(stage, name or default_backend(stage) or _only_one(stage))
    kind = backend.settings_type()
    return backend.load()(_settings(kind, settings or {}, f"{stage}={backend.name}"))


def _only_one(stage: str) -> str:
    names = [backend.name for backend in BACKENDS if backend.stage == stage]
    if len(names) != 1:
        raise ValueError(f"backend of {stage}: expected one of {', '.join(names)}, got none")
    return names[0]


def _settings(kind: type[Any], given: Mapping[str, Any], where: str) -> Any:
    hints = get_type_hints(kind)
    known = [field.name for field in fields(kind)]
    values: dict[str, Any] = {}
    for name, value in given.items():
        if name not in known:
            raise ValueError(f"{where}: expected settings among {', '.join(known)}, got {name!r}")
        inner = [k for k in (hints[name], *get_args(hints[name])) if is_dataclass(k)]
        if inner and isinstance(value, Mapping):
            value = _settings(inner[0], value, f"{where}.{name}")  # pyright: ignore
        values[name] = tuple(value) if isinstance(value, list) else value  # pyright: ignore
        if not _fits(values[name], hints[name]):
            hint = hints[name]
            expected = hint.__name__ if isinstance(hint, type) else str(hint)
            raise ValueError(f"{where}, {name}: expected {expected}, got {value!r}")
    return kind(**values)


def _fits(value: Any, hint: Any) -> bool:
    """Whether a plain value is what a type hint of settings says."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return any(_fits(value, one) for one in inner)
    if origin is Literal:
        return value in inner
    if origin is tuple and isinstance(value, tuple):
        parts: tuple[Any, ...] = value  # pyright: ignore[reportUnknownVariableType]
        if inner[-1] is Ellipsis:
            return all(_fits(part, inner[0]) for part in parts)
        return len(parts) == len(inner) and all(map(_fits, parts, inner))
    if hint in (int, float) and isinstance(value, bool):
        return False
    if hint is float:
        return isinstance(value, int | float)
    return hint is Any or isinstance(value, origin or hint)
