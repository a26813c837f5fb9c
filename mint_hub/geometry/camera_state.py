"""The camera state: nine numbers a frame, [translation 3, quaternion xyzw 4, field of view 2].

The pose is world-to-camera in OpenCV axes, p_camera = R p_world + t, metres; the field of view is
(vertical, horizontal), radians. The quaternion may have any length and either sign: the network's
is not normalised.
"""

from dataclasses import dataclass
from typing import Any, Final

from mint_hub.geometry.arrays import Array, as_dtype, namespace, require_shape
from mint_hub.geometry.rigid import rigid, rotation_of, translation_of
from mint_hub.geometry.rotations import matrix_to_quat_xyzw, quat_xyzw_to_matrix

CAMERA_STATE_SIZE: Final = 9
TRANSLATION: Final = slice(0, 3)
QUAT_XYZW: Final = slice(3, 7)
FOV_VH: Final = slice(7, 9)


@dataclass(frozen=True)
class CameraState:
    """The named parts of a camera state, numpy or torch alike.

    Attributes:
        translation: (..., 3) metres, world-to-camera.
        quat_xyzw: (..., 4) world-to-camera, as stored.
        fov_vh_rad: (..., 2) radians.

    """

    translation: Any
    quat_xyzw: Any
    fov_vh_rad: Any

    def pack(self) -> Any:
        """Return the state (..., 9), the inverse of ``unpack``."""
        xp = namespace(self.translation, self.quat_xyzw, self.fov_vh_rad)
        return xp.concatenate([self.translation, self.quat_xyzw, self.fov_vh_rad], axis=-1)

    def T_camera_from_world(self, check: bool = True) -> Any:  # noqa: N802
        """World-to-camera transforms (..., 4, 4), the quaternion normalised.

        Raises:
            ValueError: with ``check``, a zero or non-finite quaternion.

        """
        return rigid(quat_xyzw_to_matrix(self.quat_xyzw, check=check), self.translation)


def unpack(camera_state: Array) -> CameraState:
    """Name the parts of camera states (..., 9); the parts are views.

    Raises:
        ValueError: the last axis is not 9.

    """
    require_shape("camera_state", camera_state, (CAMERA_STATE_SIZE,))
    return CameraState(
        translation=camera_state[..., TRANSLATION],
        quat_xyzw=camera_state[..., QUAT_XYZW],
        fov_vh_rad=camera_state[..., FOV_VH],
    )


def from_matrices(T_camera_from_world: Array, fov_vh_rad: Array) -> CameraState:
    """Build the state of transforms (..., 4, 4) and fields of view (..., 2), with w >= 0.

    Raises:
        ValueError: wrong shapes.

    """
    require_shape("T_camera_from_world", T_camera_from_world, (4, 4))
    require_shape("fov_vh_rad", fov_vh_rad, (2,))
    quat = matrix_to_quat_xyzw(rotation_of(T_camera_from_world))
    fov = as_dtype(fov_vh_rad, T_camera_from_world.dtype)
    return CameraState(translation_of(T_camera_from_world), quat, fov)
