"""VITRA's episode annotations as episodes: one ``.npy`` file, read without unpickling.

What VITRA stores, as found in its files and documentation: world-to-camera extrinsics with OpenCV's
axes; K of the original (undistorted) video, whose size is twice its principal point; for each hand
MANO's shape, wrist orientation, 15 joint rotations (of MANO_RIGHT for both hands, which is how
``geometry.hand_state`` stores a left hand too), 21 joints in OpenPose's order, and a mask of kept
frames. ``transl_camspace`` is MANO's transl, which lies about 0.10 m from the wrist;
``transl_worldspace`` is the wrist itself. The wrist is therefore taken from the joints.
"""

from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import MODEL_FPS, SIDES, Side
from mint_hub.geometry import hand_state as hands
from mint_hub.geometry import rigid
from mint_hub.geometry.camera import K_to_fov_vh
from mint_hub.geometry.plain_pickle import load_plain_npy
from mint_hub.geometry.rotations import nearest_rotation
from mint_hub.loaders.fields import slug
from mint_hub.loaders.participants import participant_of
from mint_hub.loaders.schema import Episode, TextSegment

Float = NDArray[np.float64]

ROTATION_TOLERANCE: Final = 1e-3
"""Largest entry of R Rᵀ - I in an annotation; below it, rotations are rounded to exact ones."""

WRIST_TOLERANCE_M: Final = 0.005
"""Largest distance between the wrist of the joints and ``transl_worldspace``, where both are."""

OPTIONAL_FACTS: Final = ("anno_type", "avg_speed", "total_rotvec_degree", "total_transl_dist")


def from_vitra(
    path: str | PathLike[str],
    *,
    key: str | None = None,
    source: str | None = None,
    fps: float = MODEL_FPS,
    start_s: float | None = None,
    image_size_hw: tuple[int, int] | None = None,
) -> Episode:
    """Read one annotation of VITRA's as an episode.

    Args:
        path: the ``.npy`` file, named ``{dataset}_{video}_ep_{number}.npy``.
        key: of the episode; the file's name, made of allowed characters, when None.
        source: the data set's name; the first part of the file's name when None.
        fps: of the video that ``video_decode_frame`` counts.
        start_s: video time of the first frame; its frame number / fps when None.
        image_size_hw: of the original video; from K's principal point when None.

    Returns:
        An episode in the video's own time, with MANO's shape numbers. A frame that is not kept has
        no hand. ``meta["text_rephrase"]`` and ``meta["vitra"]`` keep what has no field of its own.
        For `attach`: ``native_fps`` is ``fps``; ``video_start_sec`` is when frame 0 is shown, 0
        unless ``start_s`` says otherwise; ``undistorted`` is true, as VITRA's K is of pictures
        whose distortion was removed. Frame numbers are (timestamps_s - video_start_sec) * fps.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: not an annotation, naming file, field, what was expected and what came; or a
            pickle that asks for more than plain data (nothing of it is run).

    """
    path = Path(path)
    try:
        content = load_plain_npy(path)
        if not isinstance(content, dict):
            raise ValueError(f"expected a dict of fields, got {type(content).__name__}")
        fields = cast("dict[str, Any]", content)
        return _episode(fields, path, key, source, fps, start_s, image_size_hw)
    except ValueError as error:
        # What is wrong within a pickle is told without the file, all else with it.
        told = str(error).removeprefix(f"{path}: ")
        raise type(error)(f"{path}: {told}") from None


def _episode(
    fields: Mapping[str, Any],
    path: Path,
    key: str | None,
    source: str | None,
    fps: float,
    start_s: float | None,
    image_size_hw: tuple[int, int] | None,
) -> Episode:
    T_camera_from_world = _array(fields, "extrinsics", (None, 4, 4))
    num_frames = len(T_camera_from_world)
    T_camera_from_world[:, :3, :3] = _rotations("extrinsics", T_camera_from_world[:, :3, :3])
    K = _array(fields, "intrinsics", (3, 3))
    size = image_size_hw or (round(2 * K[1, 2]), round(2 * K[0, 2]))
    frames = _array(fields, "video_decode_frame", (num_frames,))
    start = frames[0] / fps if start_s is None else start_s
    read = [_hand(fields, side, T_camera_from_world) for side in SIDES]
    text, empty = _text(fields, num_frames)
    warnings = [
        f"text of the {side} hand without frames left out: {words}" for side, words in empty
    ]
    name, uid = path.stem, str(_field(fields, "video_name"))
    source = source or name.split("_")[0].lower()
    participant = participant_of(source, uid)
    return Episode(
        key=key or slug(name),
        timestamps_s=start + (frames - frames[0]) / fps,
        T_camera_from_world=T_camera_from_world,
        fov_vh_rad=np.tile(K_to_fov_vh(K, size), (num_frames, 1)).astype(np.float32),
        hand_state=np.stack([state for state, _ in read], axis=1),
        presence=np.stack([kept for _, kept in read], axis=1),
        image_size_hw=size,
        text=text,
        meta={
            "source": source,
            "uid": uid,
            **({} if participant is None else {"participant": participant}),
            "fps": fps,
            "native_fps": float(fps),
            "video_start_sec": float(start - frames[0] / fps),
            "undistorted": True,
            "shape_space": "mano",
            "scale_status": "pseudo-label of VITRA, not metric ground truth",
            "provenance": {"annotation": "vitra", "file": path.name},
            "warnings": warnings,
            "text_rephrase": _plain(fields.get("text_rephrase", {})),
            "vitra": {n: _plain(fields[n]) for n in OPTIONAL_FACTS if n in fields},
        },
    )


def _hand(
    fields: Mapping[str, Any], side: Side, T_camera_from_world: Float
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Hand states (T, 109) in the camera frame, absent where not kept, and the kept frames (T,)."""
    num_frames = len(T_camera_from_world)
    state = np.asarray(hands.absent((num_frames,)), np.float64)
    given = fields.get(side)
    if given is None:
        return state, np.zeros(num_frames, bool)
    if not isinstance(given, Mapping):
        raise ValueError(f"{side}: expected a dict of fields, got {type(given).__name__}")
    hand = {f"{side}.{name}": value for name, value in cast("dict[str, Any]", given).items()}
    kept = _array(hand, f"{side}.kept_frames", (num_frames,)) != 0
    if not kept.any():
        return state, kept
    R_camera_from_world = T_camera_from_world[:, :3, :3]
    if f"{side}.global_orient_camspace" in hand:
        orientation = _array(hand, f"{side}.global_orient_camspace", (num_frames, 3, 3))
    else:
        world = _array(hand, f"{side}.global_orient_worldspace", (num_frames, 3, 3))
        orientation = R_camera_from_world @ world
    shape = _array(hand, f"{side}.beta", (hands.NUM_SHAPE_PARAMS,))
    joints = _array(hand, f"{side}.hand_pose", (num_frames, hands.NUM_JOINT_ROTATIONS, 3, 3))
    packed = hands.HandState.from_matrices(
        _wrist(hand, side, T_camera_from_world, kept)[kept],
        _rotations(f"{side}.global_orient", orientation[kept]),
        _rotations(f"{side}.hand_pose", joints[kept]),
        np.broadcast_to(shape, (int(kept.sum()), len(shape))),
    )
    state[kept] = packed.pack()
    return state, kept


def _wrist(
    hand: Mapping[str, Any], side: Side, T_camera_from_world: Float, kept: NDArray[np.bool_]
) -> Float:
    """Wrist joints (T, 3) in the camera: from the joints, else from the wrist in the world."""
    num_frames = len(T_camera_from_world)
    from_world = None
    if f"{side}.transl_worldspace" in hand:
        world = _array(hand, f"{side}.transl_worldspace", (num_frames, 3))
        from_world = rigid.transform_points(T_camera_from_world, world)
    if f"{side}.joints_camspace" in hand:
        wrist = _array(hand, f"{side}.joints_camspace", (num_frames, 21, 3))[:, 0]
    elif f"{side}.joints_worldspace" in hand:
        joints = _array(hand, f"{side}.joints_worldspace", (num_frames, 21, 3))
        wrist = rigid.transform_points(T_camera_from_world, joints[:, 0])
    elif from_world is not None:
        return from_world
    else:
        raise ValueError(
            f"{side}: expected joints_camspace, joints_worldspace or transl_worldspace, got none: "
            "transl_camspace alone is MANO's transl, which is not the wrist"
        )
    if from_world is not None:
        miss = np.linalg.norm(from_world - wrist, axis=-1)[kept]
        if miss.max() > WRIST_TOLERANCE_M:
            raise ValueError(
                f"{side}.transl_worldspace: expected the wrist of the joints to within "
                f"{WRIST_TOLERANCE_M} m, got {miss.max():.3f} m"
            )
    return wrist


def _text(
    fields: Mapping[str, Any], num_frames: int
) -> tuple[tuple[TextSegment, ...], list[tuple[Side, str]]]:
    """Text segments cut to the episode, and those without frames."""
    given = fields.get("text", {})
    if not isinstance(given, Mapping):
        raise ValueError(f"text: expected a dict of left and right, got {type(given).__name__}")
    texts = cast("Mapping[str, Any]", given)
    segments: list[TextSegment] = []
    empty: list[tuple[Side, str]] = []
    for side in SIDES:
        for i, entry in enumerate(texts.get(side, ())):
            try:
                words, (start, end) = entry
                start, end = max(0, int(start)), min(num_frames, int(end))
            except (TypeError, ValueError):
                raise ValueError(
                    f"text.{side}[{i}]: expected (words, (start, end)), got {entry!r}"
                ) from None
            if start < end:
                segments.append(TextSegment(f"{side}-{i}", str(words), side, start, end))
            else:
                empty.append((side, str(words)))
    return tuple(segments), empty


def _array(fields: Mapping[str, Any], name: str, shape: tuple[int | None, ...]) -> Float:
    """Return a field as a fresh finite float64 array of the shape (None: any length but 0)."""
    value = _field(fields, name)
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: expected numbers, got {type(value).__name__}") from None
    fits = len(array.shape) == len(shape) and all(
        (got > 0 if size is None else got == size)
        for size, got in zip(shape, array.shape, strict=True)
    )
    if not fits:
        text = ", ".join("T" if size is None else str(size) for size in shape)
        text += "," if len(shape) == 1 else ""
        raise ValueError(f"{name}: expected shape ({text}), got {array.shape}")
    if not np.isfinite(array).all():
        bad = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise ValueError(f"{name}: expected finite numbers, got {array[bad]} at {bad}")
    return array


def _field(fields: Mapping[str, Any], name: str) -> Any:
    if name not in fields:
        raise ValueError(f"{name}: expected this field, got {', '.join(sorted(map(str, fields)))}")
    return fields[name]


def _rotations(name: str, R: Float) -> Float:
    """Return the nearest exact rotations, refusing what is none."""
    error = np.abs(R @ R.swapaxes(-1, -2) - np.eye(3)).max(axis=(-1, -2))
    bad = (error > ROTATION_TOLERANCE) | (np.linalg.det(R) < 0)
    if bad.any():
        where = tuple(int(i) for i in np.argwhere(bad)[0])
        raise ValueError(f"{name}: expected rotations, got {R[where].round(3).tolist()} at {where}")
    return nearest_rotation(R)


def _plain(value: Any) -> Any:
    """JSON values of plain pickled ones."""
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in cast("Mapping[Any, Any]", value).items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in cast("list[Any]", value)]
    return value if isinstance(value, str | int | float | bool | None) else str(value)
