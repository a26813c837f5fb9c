"""Which frames of which hand are alike: bins of what makes hands hard."""

from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.evaluation.clips import Clip
from mint_hub.geometry.camera import K_to_fov_vh

DEPTH_EDGES_M: Final = (0.0, 0.3, 0.45, 0.6, np.inf)
SPEED_EDGES_M_S: Final = (0.0, 0.1, 0.3, 0.8, np.inf)
HIDDEN_EDGES: Final = (0.0, 0.1, 0.3, 0.6, np.inf)
FOV_EDGES_DEG: Final = (0.0, 60.0, 75.0, 90.0, 110.0, np.inf)


def strata_of(clip: Clip) -> dict[str, NDArray[np.bool_]]:
    """Masks (T, 2) of the frames of each hand that fall into each bin, by "name: bin".

    Wrist depth along the viewing axis, share of the hand that is hidden (where known), speed of the
    wrist in the world; and of the whole clip its source and horizontal field of view. A hand that
    the truth does not have is in no bin of depth, hidden share or speed. Empty bins are left out.
    """
    truth = clip.truth
    everywhere = np.ones(truth.presence.shape, bool)
    fov_deg = np.degrees(K_to_fov_vh(clip.K, clip.image_size_hw)[..., 1])
    found = {f"source: {clip.source}": everywhere}
    fov = np.broadcast_to(fov_deg[..., None], truth.presence.shape)
    wrist = truth.wrist_camera()[..., 2, 3]
    found |= _binned("field of view", fov, FOV_EDGES_DEG, "degrees", 0)
    found |= _binned("wrist depth", wrist, DEPTH_EDGES_M, "m", 2)
    if clip.visible is not None:
        hidden = np.where(truth.presence, 1.0 - clip.visible, np.nan)
        found |= _binned("hidden share", hidden, HIDDEN_EDGES, "", 1)
    found |= _binned("wrist speed", wrist_speed(clip), SPEED_EDGES_M_S, "m/s", 1)
    return found


def wrist_speed(clip: Clip) -> NDArray[np.float64]:
    """Speed of the true wrists in the world, (T, 2) m/s; NaN where the hand is absent.

    From the frame before; of the first frame of a run to the frame after; alone, 0.
    """
    truth = clip.truth
    place = truth.wrist_world()[..., :3, 3]
    if truth.num_frames == 1:
        return np.where(truth.presence, 0.0, np.nan)
    step = np.linalg.norm(np.diff(place, axis=0), axis=-1) / np.diff(truth.timestamps_s)[:, None]
    nothing = np.full((1, 2), np.nan)
    before, after = np.concatenate([nothing, step]), np.concatenate([step, nothing])
    speed = np.where(np.isfinite(before), before, after)
    return np.where(truth.presence, np.where(np.isfinite(speed), speed, 0.0), np.nan)


def _binned(
    name: str, values: NDArray[np.floating], edges: tuple[float, ...], unit: str, digits: int
) -> dict[str, NDArray[np.bool_]]:
    found: dict[str, NDArray[np.bool_]] = {}
    for low, high in pairwise(edges):
        inside = (values >= low) & (values < high)
        if inside.any():
            bounds = [f"{low:.{digits}f}"] + [f"to {high:.{digits}f}"] * (not np.isinf(high))
            words = [*bounds, unit, "and more" if np.isinf(high) else ""]
            found[f"{name}: {' '.join(filter(None, words))}"] = inside
    return found
