"""What a sample of a shard is made of: its members declared once, episode to bytes and back.

A sample is an episode. Its members are ``json`` and plain npy arrays with one row a frame; MEMBERS
says what every column is, and everything derived (features, cards, tables) follows it. In a
``compact`` shard rotations are float16 and the shape of a hand is said once, in ``json``; in a
``lossless`` one ``state.npy`` holds all numbers of both hands in float32. Letters: T frames.

What comes back: hand states, fields of view and presence bit for bit (compact rotations within
MAX_COMPACT_ERROR_DEG), poses and scores as float32, times within TIME_TOLERANCE_S, or 1e-6 s with
``extra.npy``. Not kept: scores without ``extra.npy``, and numbers of absent hands, which become
``hand_state.absent``.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import SIDES
from mint_hub.geometry import camera_state
from mint_hub.geometry import hand_state as hands
from mint_hub.geometry.rotations import matrix_to_rot6d_rows, rot6d_rows_to_matrix
from mint_hub.loaders.fields import EpisodeError, placed, row_products
from mint_hub.loaders.member_table import (
    ABSENT,
    EXTRA,
    FILLED,
    MEMBERS,
    META,
    OBSERVED,
    ROT6D,
    ROTATIONS,
    STATE,
    TRAJ,
    Column,
    Format,
    Member,
    member,
    member_names,
)
from mint_hub.loaders.meta_member import decode_meta, encode_meta
from mint_hub.loaders.npy_member import arrays_of, data_offset, npy_bytes
from mint_hub.loaders.schema import Episode, TextSegment

__all__ = [
    "ABSENT",
    "EXTRA",
    "FILLED",
    "MEMBERS",
    "META",
    "OBSERVED",
    "ROT6D",
    "STATE",
    "TRAJ",
    "Column",
    "Format",
    "Member",
    "arrays_of",
    "data_offset",
    "decode",
    "decode_meta",
    "encode",
    "encode_all",
    "hand_states",
    "member",
    "member_names",
    "presence_of",
]

MAX_COMPACT_ERROR_DEG: Final = 0.031
"""Largest angle between a rotation and its float16 rows: a search for the worst rotation ends at
0.0306 degrees, ten million random ones stay below 0.0293."""

TIME_TOLERANCE_S: Final = 1e-3
"""Without ``extra.npy``, frame k may differ by this much from start + k / fps."""

MAX_OFFSET_S: Final = 32.0
"""With ``extra.npy``, by this much: float32 holds smaller offsets to 1e-6 s."""

SHAPE_TOLERANCE: Final = 1e-5
"""Within a compact episode, the shape of a hand may vary by this much."""

_UNIT_TOLERANCE: Final = 1e-3


# ------------------------------------------------------------------- encoding


def encode(episode: Episode, format: Format = "compact", extra: bool = False) -> dict[str, bytes]:
    """Return the members of an episode by name, in the order of the tar.

    The same episode gives the same bytes. Rows depend on their own frame only, so the rows of a
    window are a window of the rows (but for ``extra.npy``, whose times count from the start).
    Presence scores are in ``extra.npy`` alone: without it, in either format, an episode comes back
    with none (``write_corpus`` counts such episodes and warns).

    Raises:
        EpisodeError: a compact episode whose shape varies, or times that are not start + k / fps
            although there is no ``extra.npy``, or ``meta`` entries of another type than declared.

    """
    return next(encode_all([episode], format, extra))


def encode_all(
    episodes: Sequence[Episode], format: Format = "compact", extra: bool = False
) -> Iterator[dict[str, bytes]]:
    """Yield what ``encode`` returns for each of some episodes, their frames computed together.

    Raises:
        EpisodeError: as ``encode``, when the episode at fault is reached.

    """
    names = member_names(format, extra)
    stops = np.cumsum([episode.num_frames for episode in episodes]).tolist()
    rows = _rows_of(episodes, format)
    for episode, stop in zip(episodes, stops, strict=True):
        own = {name: array[stop - episode.num_frames : stop] for name, array in rows.items()}
        try:
            yield _encode(episode, own, format, names)
        except EpisodeError as error:
            raise placed(error, "", episode.key) from None


def _rows_of(episodes: Sequence[Episode], format: Format) -> dict[str, NDArray[Any]]:
    """Rows of the arrays whose rows depend on their own frame only, of all episodes, by member.

    Under _SHAPES are the shapes (frames, 2, 10).
    """
    state = np.concatenate([episode.hand_state for episode in episodes])
    presence = np.concatenate([episode.presence for episode in episodes])
    T = np.concatenate([episode.T_camera_from_world for episode in episodes])
    fov = np.concatenate([episode.fov_vh_rad for episode in episodes])
    state[~presence] = hands.absent()
    code = presence.astype(np.float32)
    stop = 0
    for episode in episodes:
        stop += episode.num_frames
        if episode.filled is not None:
            code[stop - episode.num_frames : stop][episode.filled] = FILLED
    camera = camera_state.from_matrices(T, fov).pack()
    wrists = state[..., hands.TRANSLATION].reshape(len(state), -1)
    with np.errstate(over="ignore"):
        traj = np.concatenate([camera.astype(np.float32), wrists, code], axis=-1)
    numbers = _rot6d_of(state) if format == "compact" else state.reshape(len(state), -1)
    return {
        TRAJ: traj,
        ROT6D if format == "compact" else STATE: numbers,
        _SHAPES: state[..., hands.SHAPE],
    }


_SHAPES: Final = "shapes"


def _encode(
    episode: Episode, rows: dict[str, NDArray[Any]], format: Format, names: tuple[str, ...]
) -> dict[str, bytes]:
    extra = EXTRA in names
    shapes = rows[_SHAPES]
    shape = _shape_of(episode, shapes) if format == "compact" else np.zeros((2, 10), np.float32)
    _check_lengths(episode, rows[TRAJ])
    offsets = episode.timestamps_s - _regular_times(
        float(episode.timestamps_s[0]), episode.fps, episode.num_frames
    )
    _check_times(offsets, episode.fps, MAX_OFFSET_S if extra else TIME_TOLERANCE_S)
    arrays = dict(rows)
    if extra:
        score = episode.presence_score
        score = np.full(episode.presence.shape, np.nan) if score is None else score
        arrays[EXTRA] = np.concatenate([offsets[:, None], score], axis=-1)
    members = {META: encode_meta(episode, format, shape)}
    members.update((name, npy_bytes(arrays[name], member(name))) for name in names if name != META)
    return members


def _check_lengths(episode: Episode, traj: NDArray[np.float32]) -> None:
    if (far := np.flatnonzero(~np.isfinite(traj).all(axis=-1))).size:
        raise EpisodeError(
            f"T_camera_from_world: expected lengths that float32 can say, got "
            f"{episode.T_camera_from_world[far[0], :3, 3].tolist()} at frame {far[0]}"
        )


def _check_times(offsets: NDArray[np.float64], fps: float, tolerance: float) -> None:
    if (late := float(np.abs(offsets).max())) <= tolerance:
        return
    advice = "write it with extra.npy (extra=True)" if late < MAX_OFFSET_S else "state its fps"
    raise EpisodeError(
        f"timestamps_s: expected start + k / {fps:g} within {tolerance:g} s, "
        f"got {late:.4g} s off: {advice}"
    )


def _rot6d_of(state: NDArray[np.float32]) -> NDArray[np.float16]:
    """Rotations as rows (T, 192): made orthonormal where they are not, then rounded."""
    rows = state[..., ROTATIONS].reshape(-1, 6)
    aa, bb, ab = row_products(rows)
    off = np.maximum(np.maximum(np.abs(aa - 1), np.abs(bb - 1)), np.abs(ab))
    if (bad := off > _UNIT_TOLERANCE).any():
        rows[bad] = matrix_to_rot6d_rows(rot6d_rows_to_matrix(rows[bad].astype(np.float64)))
    return rows.reshape(len(state), -1).astype(np.float16)


def _shape_of(episode: Episode, shapes: NDArray[np.float32]) -> NDArray[np.float32]:
    """Shape of both hands, (2, 10): of ``shapes`` (T, 2, 10) where each is first present."""
    shape = np.zeros(shapes.shape[1:], np.float32)
    for hand, side in enumerate(SIDES):
        there = shapes[episode.presence[:, hand], hand]
        if not len(there):
            continue
        shape[hand] = there[0]
        spread = float(np.abs(there - there[0]).max())
        if spread > SHAPE_TOLERANCE:
            raise EpisodeError(
                f"hand_state: expected one {side} shape in a compact episode, got shapes that "
                f"differ by {spread:.4g}: use lossless (format='lossless')"
            )
    return shape


# ------------------------------------------------------------------- decoding


def decode(members: Mapping[str, Any], where: str = "") -> Episode:
    """Return the episode of a sample's members; members that are none of MEMBERS are passed over.

    ``meta["fps"]`` is always there afterwards, and ``filled`` is None where no hand is filled.

    Args:
        members: bytes by member name, as ``encode`` returns them.
        where: what errors call the shard, for instance "ego4d-train-00012.tar".

    Raises:
        EpisodeError: a member is missing or breaks the schema, or the schema is a newer one; names
            the member or field, what was expected, what came, ``where`` and the episode.

    """
    if META not in members:
        error = EpisodeError(f"{META}: expected this member, got {sorted(members) or 'none'}")
        raise placed(error, where)
    values = decode_meta(members[META], where)
    try:
        names = member_names(values["format"], EXTRA in members)
        if missing := [name for name in names if name not in members]:
            raise EpisodeError(f"{missing[0]}: expected this member, got {sorted(members)}")
        arrays = arrays_of({name: members[name] for name in names if name != META})
        return _decode(values, arrays)
    except EpisodeError as error:
        raise placed(error, where, values["key"]) from None


def _decode(values: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> Episode:
    num_frames = values["num_frames"]
    for name, array in arrays.items():
        if len(array) != num_frames:
            raise EpisodeError(f"{name}: expected {num_frames} frames, got {len(array)}")
    traj = member(TRAJ).slices
    camera = camera_state.unpack(arrays[TRAJ][:, : traj["fov_vh"].stop].astype(np.float64))
    _check_unit(camera.quat_xyzw)
    code = _presence_code(arrays[TRAJ])
    times = _regular_times(values["start_s"], values["fps"], num_frames)
    score = None
    if EXTRA in arrays:
        times = times + arrays[EXTRA][:, 0]
        score = None if np.isnan(arrays[EXTRA][:, 1:]).all() else arrays[EXTRA][:, 1:]
    return Episode(
        key=values["key"],
        timestamps_s=times,
        T_camera_from_world=camera.T_camera_from_world(),
        fov_vh_rad=camera.fov_vh_rad.astype(np.float32),
        hand_state=hand_states(arrays, values["shape"], code != ABSENT),
        presence=code != ABSENT,
        presence_score=score,
        filled=code == FILLED if (code == FILLED).any() else None,
        image_size_hw=cast("tuple[int, int]", tuple(values["image_size_hw"])),
        text=tuple(map(TextSegment.from_dict, values["text"])),
        meta=values["meta"],
    )


def presence_of(traj: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return which hands are there, (T, 2), by rows of ``traj.npy`` (T, 17).

    Raises:
        EpisodeError: a presence is none of ABSENT, OBSERVED and FILLED.

    """
    return _presence_code(traj) != ABSENT


def hand_states(
    arrays: Mapping[str, NDArray[Any]], shape: Any, presence: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Return hand states (T, 2, 109) by rows of the members of either format.

    Args:
        arrays: (T, C) by member name.
        shape: of a compact sample's hands, (2, 10) or anything that broadcasts to (T, 2, 10).
        presence: (T, 2).

    Raises:
        EpisodeError: lossless wrists that are not those of ``traj.npy``.

    """
    traj = member(TRAJ).slices
    wrist = arrays[TRAJ][:, traj["left_wrist"].start : traj["right_wrist"].stop].reshape(-1, 2, 3)
    if STATE in arrays:
        state = arrays[STATE].reshape(-1, 2, hands.HAND_STATE_SIZE)
        if (bad := np.flatnonzero((state[..., hands.TRANSLATION] != wrist).any((1, 2)))).size:
            raise EpisodeError(
                f"{STATE}: expected the wrists of {TRAJ}, got others at frame {bad[0]}"
            )
        return state
    state = np.empty((len(wrist), 2, hands.HAND_STATE_SIZE), np.float32)
    state[..., hands.TRANSLATION] = wrist
    state[..., ROTATIONS] = arrays[ROT6D].reshape(-1, 2, ROTATIONS.stop - ROTATIONS.start)
    state[..., hands.SHAPE] = np.where(
        presence[..., None], np.asarray(shape, np.float32), np.float32(0)
    )
    return state


def _presence_code(traj: NDArray[np.float32]) -> NDArray[np.float32]:
    slices = member(TRAJ).slices
    code = traj[:, slices["left_presence"].start : slices["right_presence"].stop]
    if (bad := np.argwhere(~np.isin(code, (ABSENT, OBSERVED, FILLED)))).size:
        frame, hand = (int(i) for i in bad[0])
        raise EpisodeError(
            f"{TRAJ} {SIDES[hand]}_presence: expected 0, 1 or 2, got {code[frame, hand]} "
            f"at frame {frame}"
        )
    return code


def _check_unit(quat: NDArray[np.float64]) -> None:
    length = np.linalg.norm(quat, axis=-1)
    if (bad := np.flatnonzero(~(np.abs(length - 1) <= _UNIT_TOLERANCE))).size:
        raise EpisodeError(
            f"{TRAJ} camera_quat_xyzw: expected unit quaternions, got length "
            f"{length[bad[0]]:.6g} at frame {bad[0]}"
        )


def _regular_times(start_s: float, fps: float, num_frames: int) -> NDArray[np.float64]:
    return start_s + np.arange(num_frames) / fps
