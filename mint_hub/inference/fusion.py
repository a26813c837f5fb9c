"""From the results of single windows to one track: cameras chained, hands and scalars fused.

Windows arrive left to right. Where a new window shares frames with what is fused so far, the two
are blended with the linear ramp of :func:`mint_hub.windows.ramp` over the frames they do share, so
that a frame of three windows (the last one is shifted) is blended twice. Fusers are incremental: a
frame is handed out as soon as no later window can touch it, and at most a window of frames is held.
``chain_cameras``, ``fuse_hands`` and ``fuse_linear`` run a fuser over a list. numpy only, float64
inside.

Legend: T frames of the video, T_w of a window, m shared by two.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry import hand_state as hands
from mint_hub.geometry import rigid, rotations
from mint_hub.windows import Window, ramp

Values = NDArray[Any]
Blend = Callable[[Values, Values, Values], Values]
"""(earlier (m, ...), later (m, ...), share of the later (m,)) -> (m, ...), float64."""


# --- blends: what lies between two estimates of the same frames ----------------------------------


def blend_linear(earlier: Values, later: Values, alpha: Values) -> Values:
    """Blend numbers (m, ...) on a line: ``(1 - alpha) earlier + alpha later``."""
    share = alpha.reshape((-1,) + (1,) * (earlier.ndim - 1))
    return (1.0 - share) * earlier + share * later


def blend_hands(earlier: Values, later: Values, alpha: Values) -> Values:
    """Blend hand states (m, ..., 109): rotations on SO(3), translation and shape on a line.

    The mean of two rotations with weights ``1 - alpha`` and ``alpha`` is the point at ``alpha`` of
    the shortest arc between them, exactly. The result's 6D rows are orthonormal.

    Raises:
        ValueError: degenerate or non-finite 6D rows.

    """
    a, b = hands.unpack(earlier), hands.unpack(later)
    share = alpha.reshape((-1,) + (1,) * (earlier.ndim - 2))
    state = hands.HandState.from_matrices(
        blend_linear(np.asarray(a.translation), np.asarray(b.translation), alpha),
        rotations.slerp(a.orientation(), b.orientation(), share),
        rotations.slerp(a.joint_rotations(), b.joint_rotations(), share[..., None]),
        blend_linear(np.asarray(a.shape_params), np.asarray(b.shape_params), alpha),
    )
    return np.asarray(state.pack())


def blend_cameras(earlier: Values, later: Values, alpha: Values) -> Values:
    """Blend T_camera_from_world (m, 4, 4): rotation by slerp, the camera's centre on a line."""
    T_world_from_camera = rigid.interpolate_rigid(
        rigid.inverse(earlier), rigid.inverse(later), alpha
    )
    return rigid.inverse(T_world_from_camera)


# --- the fusers -----------------------------------------------------------------------------------


class OverlapFuser:
    """Fuse per-frame values (T_w, ...) of windows into a track (T, ...), left to right.

    ``push`` and ``finish`` return consecutive pieces of the track, in the first window's dtype but
    at least float32. Frames of a single window pass through unchanged.
    """

    def __init__(self, blend: Blend = blend_linear) -> None:
        self._blend = blend
        self._last: Window | None = None
        self._held: Values = np.empty(0)  # fused frames start .. stop of the last window
        self._emitted = 0  # of the held frames
        self._dtype: Any = None
        self._finished = False

    def overlap(self, window: Window) -> Values:
        """Look up the fused values (m, ...) of the frames that ``window``, the next one, shares.

        Raises:
            ValueError: the window does not follow the last one, or the track was finished.

        """
        if self._finished:
            raise ValueError(f"{window}: the track was finished; make a new fuser")
        if self._last is None:
            if window.start != 0:
                raise ValueError(f"window: expected the first to start at frame 0, got {window}")
            return self._held[:0]
        last = self._last
        if not (last.start < window.start <= last.stop < window.stop):
            raise ValueError(
                f"window: expected one that starts and stops after {last} and leaves no gap, "
                f"got {window}"
            )
        return self._held[window.start - last.start :]

    def push(self, window: Window, values: Values) -> Values:
        """Fuse one more window; the frames (k, ...) that became final.

        Any later window starts after this one does, so frames up to ``window.start`` are final.

        Raises:
            ValueError: the window does not follow the last one, or ``values`` do not fit.

        """
        values = np.asarray(values)
        shared = self.overlap(window)
        expected = (window.num_frames, *(self._held if self._last else values).shape[1:])
        if values.shape != expected:
            raise ValueError(f"values of {window}: expected shape {expected}, got {values.shape}")
        if self._last is None:
            self._dtype = np.result_type(values.dtype, np.float32)
        values = values.astype(np.float64)
        m = len(shared)
        if m > 0:
            values[:m] = self._blend(shared, values[:m], np.array(ramp(m)))
        fused = (
            np.concatenate([self._held[: len(self._held) - m], values]) if self._last else values
        )
        num_final = len(fused) - window.num_frames + 1
        final = fused[self._emitted : num_final]
        self._held, self._last, self._emitted = fused[num_final - 1 :], window, 1
        return final.astype(self._dtype)

    def finish(self) -> Values:
        """End the track; the remaining frames (k, ...).

        Raises:
            ValueError: no window was pushed.

        """
        if self._last is None:
            raise ValueError("windows: expected at least one, got none")
        rest = self._held[self._emitted :].astype(self._dtype)
        self._emitted, self._finished = len(self._held), True
        return rest


class HandFuser(OverlapFuser):
    """Fuse hand states (T_w, ..., 109), as ``blend_hands`` does."""

    def __init__(self) -> None:
        super().__init__(blend_hands)


@dataclass(frozen=True)
class Seam:
    """How well a window agrees with its predecessors over the frames ``start <= i < stop``.

    Attributes:
        start: first shared frame.
        stop: end of the shared frames.
        rotation_deg: root mean square angle between the two aligned orientations, degrees.
        translation_m: root mean square distance between the two aligned camera centres, metres.

    """

    start: int
    stop: int
    rotation_deg: float
    translation_m: float


class CameraFuser(OverlapFuser):
    """Chain windows of T_camera_from_world (T_w, 4, 4), each in its own world, into one world.

    The world of the result is that of the first window. With ``frames="all"`` a window is aligned
    by all shared frames, with ``"first"`` by the first alone, as the public release does.

    ``seams`` grows by one with every window after the first.
    """

    def __init__(self, frames: Literal["all", "first"] = "all") -> None:
        if frames not in ("all", "first"):
            raise ValueError(f"frames: expected 'all' or 'first', got {frames!r}")
        super().__init__(blend_cameras)
        self._frames: Final = frames
        self.seams: list[Seam] = []

    def push(self, window: Window, values: Values) -> Values:
        """Chain one more window; the poses (k, 4, 4) that became final, T_camera_from_world.

        Args:
            window: its frames.
            values: (T_w, 4, 4) T_camera_from_window, metres; "window" is the window's own world.

        Returns:
            float64, metres.

        Raises:
            ValueError: the window does not follow, shares no frame with what came before, or the
                poses are not finite rigid motions of this shape.

        """
        poses = np.asarray(values, dtype=np.float64)
        if poses.shape != (window.num_frames, 4, 4):
            raise ValueError(
                f"poses of {window}: expected shape {(window.num_frames, 4, 4)}, got {poses.shape}"
            )
        R = rigid.rotation_of(poses)
        if not (np.isfinite(poses).all() and np.allclose(R @ R.mT, np.eye(3), atol=1e-3)):
            raise ValueError(f"poses of {window}: expected finite rigid motions")
        before = self.overlap(window)
        if window.start > 0:
            if len(before) == 0:
                raise ValueError(f"poses of {window}: no frame is shared, nothing to align with")
            count = len(before) if self._frames == "all" else 1
            T_world_from_window = align(before[:count], poses[:count])
            poses = poses @ rigid.inverse(T_world_from_window)
            self.seams.append(_seam(window.start, before, poses[: len(before)]))
        return super().push(window, poses)


def align(T_camera_from_a: Values, T_camera_from_b: Values) -> Values:
    """T_a_from_b (4, 4) from the same cameras (m, 4, 4) seen in both worlds.

    Each camera gives one estimate, ``T_a_from_camera T_camera_from_b``; the result is their robust
    mean on SE(3). It is taken about the cameras themselves: origins are first moved to the median
    camera centre in either world. There the translation of an estimate is the displacement of one
    camera centre, and rotation noise does not reach it; about a distant world origin it would, by
    angle times distance. Outliers under half of m do not matter.
    """
    T_a_from_camera, T_b_from_camera = (
        rigid.inverse(T) for T in (T_camera_from_a, T_camera_from_b)
    )
    T_a_from_a0, T_b_from_b0 = (
        rigid.rigid(np.eye(3), np.median(rigid.translation_of(T), axis=0))
        for T in (T_a_from_camera, T_b_from_camera)
    )
    T_a0_from_b0 = rigid.inverse(T_a_from_a0) @ T_a_from_camera @ T_camera_from_b @ T_b_from_b0
    mean = rigid.robust_mean_rigid(T_a0_from_b0, axis=0).mean
    return T_a_from_a0 @ mean @ rigid.inverse(T_b_from_b0)


def _seam(start: int, before: Values, after: Values) -> Seam:
    between = before @ rigid.inverse(after)
    angle = rotations.geodesic_angle(rigid.rotation_of(between), np.eye(3))
    distance = np.linalg.norm(rigid.translation_of(between), axis=-1)
    return Seam(
        start,
        start + len(before),
        float(np.degrees(np.sqrt(np.mean(angle**2)))),
        float(np.sqrt(np.mean(distance**2))),
    )


# --- whole tracks --------------------------------------------------------------------------------


@dataclass(frozen=True)
class ChainedCameras:
    """A chained camera track.

    Attributes:
        T_camera_from_world: (T, 4, 4) float64, metres; the world is the first window's.
        seams: one a window after the first, left to right.

    """

    T_camera_from_world: NDArray[np.float64]
    seams: tuple[Seam, ...]


def chain_cameras(
    window_poses: Sequence[Values],
    windows: Sequence[Window],
    frames: Literal["all", "first"] = "all",
) -> ChainedCameras:
    """Chain T_camera_from_world (T_w, 4, 4) of each window; see :class:`CameraFuser`.

    Raises:
        ValueError: as ``CameraFuser.push``, or the lists differ in length or are empty.

    """
    fuser = CameraFuser(frames)
    track = _run(fuser, window_poses, windows)
    return ChainedCameras(track, tuple(fuser.seams))


def fuse_hands(window_states: Sequence[Values], windows: Sequence[Window]) -> Values:
    """Fuse hand states (T_w, 2, 109) of each window into (T, 2, 109); see ``blend_hands``.

    Raises:
        ValueError: as ``OverlapFuser.push``, or the lists differ in length or are empty.

    """
    return _run(HandFuser(), window_states, windows)


def fuse_linear(window_values: Sequence[Values], windows: Sequence[Window]) -> Values:
    """Fuse numbers (T_w, ...) of each window, fields of view or logits, into (T, ...).

    Raises:
        ValueError: as ``OverlapFuser.push``, or the lists differ in length or are empty.

    """
    return _run(OverlapFuser(), window_values, windows)


def _run(fuser: OverlapFuser, window_values: Sequence[Values], windows: Sequence[Window]) -> Values:
    if len(window_values) != len(windows):
        raise ValueError(
            f"windows: expected one for each of {len(window_values)} results, got {len(windows)}"
        )
    pieces = [fuser.push(w, v) for w, v in zip(windows, window_values, strict=True)]
    return np.concatenate([*pieces, fuser.finish()])
