"""Two aligned clips become one: what they both say of the frames they share is blended."""

from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry import hand_state
from mint_hub.inference.fusion import blend_cameras, blend_hands
from mint_hub.labelling.records import CameraPath, Clip, Detections, Hands
from mint_hub.labelling.stages.stitch_poses import Alignment, shares
from mint_hub.windows import ramp

Float64 = NDArray[np.float64]

_UNSOLVED: Final = 1e-3
"""What an interpolated camera weighs beside a measured one."""

_HAND_ARRAYS: Final = ("hand_state", "presence", "score", "filled", "residual_px")


def joined(earlier: Clip, later: Clip, offset: int, found: Alignment, apart_m: float) -> Clip:
    """One clip of two, of which the later begins at frame ``offset`` of the earlier.

    Intrinsics, scale, key and file are the earlier's, as is the detections' share of the first half
    of the frames in common.
    """
    shared = earlier.num_frames - offset
    changes: dict[str, Any] = {}
    if earlier.hands is not None and later.hands is not None:
        changes["hands"] = _joined_hands(earlier.hands, later.hands, offset, apart_m)
    if earlier.detections is not None and later.detections is not None:
        switch = offset + shared // 2
        changes["detections"] = _joined_detections(
            earlier.detections, later.detections, offset, switch
        )
    assert earlier.camera is not None
    assert later.camera is not None
    moved = replace(later.camera, T_camera_from_world=found.moved(later.camera.T_camera_from_world))
    reports = [report for report in later.reports if report not in earlier.reports]
    return replace(
        earlier,
        source_timestamps_s=np.concatenate(
            [earlier.source_timestamps_s, later.source_timestamps_s[shared:]]
        ),
        camera=_joined_cameras(earlier.camera, moved, offset),
        text=(
            *earlier.text,
            *(replace(t, start=t.start + offset, end=t.end + offset) for t in later.text),
        ),
        reports=(*earlier.reports, *reports),
        **changes,
    )


def _joined_cameras(earlier: CameraPath, later: CameraPath, offset: int) -> CameraPath:
    shared = len(earlier.solved) - offset
    weights = [
        np.where(c, 1.0, _UNSOLVED) for c in (earlier.solved[offset:], later.solved[:shared])
    ]
    blended = blend_cameras(
        earlier.T_camera_from_world[offset:],
        later.T_camera_from_world[:shared],
        shares(np.array(ramp(shared)), *weights),
    )

    def put(middle: Any, name: str) -> Any:
        return np.concatenate(
            [getattr(earlier, name)[:offset], middle, getattr(later, name)[shared:]]
        )

    frames = len(earlier.solved), len(later.solved)
    return replace(
        earlier,
        T_camera_from_world=put(blended, "T_camera_from_world"),
        solved=put(earlier.solved[offset:] | later.solved[:shared], "solved"),
        covisible=put(
            np.maximum(earlier.covisible[offset:], later.covisible[:shared]), "covisible"
        ),
        residual_px=float(
            np.average([earlier.residual_px, later.residual_px], weights=np.array(frames))
        ),
    )


def _joined_hands(earlier: Hands, later: Hands, offset: int, apart_m: float) -> Hands:
    """Hands of both: a hand that one of them has is taken, one that both have is blended."""
    shared = len(earlier.presence) - offset
    old = {name: getattr(earlier, name)[offset:] for name in _HAND_ARRAYS}
    new = {name: getattr(later, name)[:shared] for name in _HAND_ARRAYS}
    share = _hand_shares(old, new, apart_m)
    middle = {
        name: np.where(share > 0.5, new[name], old[name])
        for name in ("presence", "filled", "residual_px")
    }
    middle["score"] = ((1 - share) * old["score"] + share * new["score"]).astype(np.float32)
    middle["hand_state"] = np.where((share > 0.5)[..., None], new["hand_state"], old["hand_state"])
    for side in range(2):
        (mixed,) = np.nonzero((share[:, side] > 0) & (share[:, side] < 1))
        if len(mixed):
            middle["hand_state"][mixed, side] = blend_hands(
                old["hand_state"][mixed, side].astype(np.float64),
                new["hand_state"][mixed, side].astype(np.float64),
                share[mixed, side],
            )
    return replace(
        earlier,
        **{
            name: np.concatenate(
                [getattr(earlier, name)[:offset], middle[name], getattr(later, name)[shared:]]
            )
            for name in _HAND_ARRAYS
        },
    )


def _hand_shares(old: dict[str, Any], new: dict[str, Any], apart_m: float) -> Float64:
    """Share (m, 2) of the later one of two fits of each hand; 0 or 1 where only one counts."""
    slope = np.array(ramp(len(old["presence"])))[:, None]
    weights = [np.where(h["filled"], 0.0, h["score"]).astype(np.float64) for h in (old, new)]
    share = shares(np.broadcast_to(slope, weights[0].shape), *weights)
    wrists = [
        np.asarray(hand_state.unpack(h["hand_state"]).translation, np.float64) for h in (old, new)
    ]
    far = np.linalg.norm(wrists[0] - wrists[1], axis=-1) > apart_m
    share = np.where(far, np.round(share), share)
    both = old["presence"] & new["presence"]
    return np.where(both, share, np.where(new["presence"], 1.0, 0.0))


def _joined_detections(
    earlier: Detections, later: Detections, offset: int, switch: int
) -> Detections:
    frame = later.frame + np.int32(offset)
    first, second = earlier.frame < switch, frame >= switch
    arrays: dict[str, Any] = {
        name: np.concatenate([getattr(earlier, name)[first], value[second]])
        for name, value in {**vars(later), "frame": frame}.items()
    }
    return Detections(**arrays)
