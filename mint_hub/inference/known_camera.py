"""What is known of the camera beforehand: its lens, and where it was. Each use is explicit.

A known lens does up to three things: frames are resampled to a pinhole before the network sees
them; the network's hands, which it placed under its own estimate of the focal length, are moved to
where the true focal length puts them; and where pictures refine the camera's path they do it under
the true one. Known poses replace the predicted camera.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry import hand_state as hands
from mint_hub.geometry import rigid
from mint_hub.geometry.camera import K_to_fov_vh
from mint_hub.geometry.lenses import Lens, PinholeLens, lens_from
from mint_hub.geometry.rectification import Rectification, rectification

Float = NDArray[np.float64]
RIGID_TOLERANCE = 1e-3
MAX_POSE_STEP_S = 1.0


@dataclass(frozen=True, eq=False)
class KnownCamera:
    """A lens given by the user, ready to be applied to the frames of one video.

    Attributes:
        lens: the lens, at the size of the frames.
        rectification: the resampling to a pinhole; None where the frames are one already.
        fov_vh_rad: (2,) true field of view of the frames the network sees.

    """

    lens: Lens
    rectification: Rectification | None
    fov_vh_rad: Float

    @classmethod
    def from_user(cls, spec: Any, image_size_hw: tuple[int, int]) -> Self:
        """Read `camera=`: K (3, 3), a mapping, or a `Lens` (see `lens_from`).

        Raises:
            ValueError: malformed, naming the field.

        """
        lens = lens_from(spec, image_size_hw)
        height, width = image_size_hw
        # A calibration may count from pixel corners or centres: half a pixel either way is centred.
        off = np.abs([lens.cx - (width - 1) / 2, lens.cy - (height - 1) / 2])
        centred = bool((off < 1.0).all())
        warp = None if isinstance(lens, PinholeLens) and centred else rectification(lens)
        K = np.array([[lens.fx, 0, width / 2], [0, lens.fy, height / 2], [0, 0, 1.0]])
        return cls(lens, warp, np.asarray(K_to_fov_vh(K, image_size_hw)))

    def apply(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The frame as the pinhole would have seen it, (H, W, 3)."""
        return image if self.rectification is None else self.rectification.apply(image)


def correct_translation(
    hand_state: NDArray[Any], fov_predicted: Float, fov_true: Float
) -> NDArray[Any]:
    """Hands (T, 2, 109) moved from under the predicted focal length to under the true one.

    The network sees angles, not pixels: what it calls a depth rests on the field of view it
    believes in. Keeping the wrist's place in the image and the hand's apparent size, with
    r = f_true / f_predicted along each axis, z' = z sqrt(r_x r_y), x' = x (z' / z) / r_x, y alike.

    Args:
        hand_state: (T, 2, 109) camera frame, metres.
        fov_predicted: (T, 2) radians (vertical, horizontal), the network's.
        fov_true: (2,) or (T, 2) radians, the user's.

    Returns:
        (T, 2, 109): only translations differ.

    """
    fov_true = np.broadcast_to(fov_true, fov_predicted.shape)
    ratio = np.tan(fov_predicted / 2) / np.tan(fov_true / 2)
    corrected = hands.keep_in_picture(hand_state, fov_predicted, fov_true)
    corrected[..., hands.TRANSLATION] *= np.sqrt(ratio.prod(-1))[:, None, None]
    return corrected


def poses_at(spec: Any, timestamps_s: Float) -> Float:
    """Read `camera_poses=` as T_camera_from_world (T, 4, 4) at the episode's times.

    Args:
        spec: (T, 4, 4), one pose a frame; or a mapping with "timestamps_s" (M,) on the video's
            clock and "T_camera_from_world" (M, 4, 4), interpolated on SE(3).
        timestamps_s: (T,) the episode's.

    Raises:
        ValueError: another shape, poses that are not rigid, or times that do not cover the video.

    """
    if not isinstance(spec, Mapping):
        poses = _rigid_poses(spec)
        if len(poses) != len(timestamps_s):
            raise ValueError(
                f"camera_poses: expected {len(timestamps_s)} poses, one a frame of the resampled "
                f"video, got {len(poses)}; or give {{'timestamps_s', 'T_camera_from_world'}}"
            )
        return poses
    given: Mapping[str, Any] = spec  # pyright: ignore[reportUnknownVariableType]
    if missing := {"timestamps_s", "T_camera_from_world"} - set(given):
        raise ValueError(f"camera_poses: expected the key {min(missing)!r}, got {sorted(given)}")
    times = np.asarray(given["timestamps_s"], np.float64)
    poses = _rigid_poses(given["T_camera_from_world"])
    if times.shape != (len(poses),) or len(times) < 2 or not (np.diff(times) > 0).all():
        raise ValueError(
            f"camera_poses: expected increasing timestamps_s ({len(poses)},), at least 2, "
            f"got shape {times.shape}"
        )
    slack = float(np.median(np.diff(times)))
    if slack > MAX_POSE_STEP_S:
        raise ValueError(
            f"camera_poses: expected timestamps_s in seconds, at most {MAX_POSE_STEP_S:g} s apart, "
            f"got steps of {slack:g}"
        )
    if times[0] > timestamps_s[0] + slack or times[-1] < timestamps_s[-1] - slack:
        raise ValueError(
            f"camera_poses: expected times that cover the video, {timestamps_s[0]:.3f} to "
            f"{timestamps_s[-1]:.3f} s, got {times[0]:.3f} to {times[-1]:.3f} s"
        )
    T_world_from_camera = rigid.inverse(poses)  # it is the camera's place that moves straight
    between = rigid.interpolate_path(times, T_world_from_camera, timestamps_s)
    return np.asarray(rigid.inverse(between))


def check_poses(spec: Any) -> None:
    """Refuse malformed `camera_poses=` before a video is run; times are checked later.

    Raises:
        ValueError: as `poses_at`.

    """
    if not isinstance(spec, Mapping):
        _rigid_poses(spec)
    elif "T_camera_from_world" in spec:
        _rigid_poses(spec["T_camera_from_world"])


def _rigid_poses(values: Any) -> Float:
    try:
        poses = np.asarray(values, np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"camera_poses: expected numbers (T, 4, 4), got {type(values).__name__}"
        ) from error
    if poses.ndim != 3 or poses.shape[1:] != (4, 4) or not len(poses):
        raise ValueError(f"camera_poses: expected (T, 4, 4), got {poses.shape}")
    if not np.isfinite(poses).all():
        raise ValueError("camera_poses: expected finite numbers, got NaN or infinity")
    R = poses[:, :3, :3]
    off = np.abs(R @ R.swapaxes(1, 2) - np.eye(3)).max((1, 2)) + np.abs(np.linalg.det(R) - 1)
    bottom = np.abs(poses[:, 3] - [0, 0, 0, 1]).max(1)
    worst = int(np.argmax(off + bottom))
    if off[worst] > RIGID_TOLERANCE or bottom[worst] > RIGID_TOLERANCE:
        raise ValueError(
            f"camera_poses[{worst}]: expected a rigid transform (rotation, bottom row 0 0 0 1), "
            f"got {poses[worst].round(4).tolist()}"
        )
    return poses
