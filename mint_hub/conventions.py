"""Frames, units, sides and joint order, said once.

Frames
    Camera axes are OpenCV's: x right, y down, z forward, metres. ``T_b_from_a`` maps coordinates in
    frame ``a`` to frame ``b``, so that names chain: ``T_c_from_a = T_c_from_b @ T_b_from_a``.
    The world of a prediction is the camera of its first frame.
Images
    Pixel coordinates are (u, v), u right, v down; an image of width W spans 0 <= u < W. Only a
    calibrated lens and its resampling count integers as pixel centres, as calibrations do: their
    middle (W - 1) / 2 is the W / 2 of everything else. A field of
    view belongs to a pinhole whose principal point is the image centre (W / 2, H / 2). Sizes are
    (height, width) and say so in their names (``_hw``); fields of view are (vertical, horizontal),
    radians (``_vh_rad``).
Rotations
    ``rot6d_rows`` is the first two rows of R, flattened. Quaternions are ``xyzw``. Rotation vectors
    are axis times angle, radians.
Hands
    Left first, then right, on the axis called "hand". A hand is 16 joints in MANO's order, or 21
    keypoints in OpenPose's order.
"""

from typing import Final, Literal

Side = Literal["left", "right"]
ShapeSpace = Literal["mano", "mint"]

SIDES: Final[tuple[Side, Side]] = ("left", "right")
LEFT: Final = 0
RIGHT: Final = 1

MODEL_FPS: Final = 30.0
"""Frames a second at which the network was trained, and of every episode of the corpus."""

JOINT_NAMES: Final = (
    "wrist",
    *(
        f"{finger}{i}"
        for finger in ("index", "middle", "pinky", "ring", "thumb")
        for i in (1, 2, 3)
    ),
)
"""The 16 joints of the hand state, in MANO's order: the wrist, then three a finger, root to tip."""

JOINT_PARENTS: Final = (-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14)
"""Parent of each of the 16 joints; the wrist has none (-1)."""

FINGERTIP_NAMES: Final = ("thumb_tip", "index_tip", "middle_tip", "ring_tip", "pinky_tip")
"""The five tips that follow the 16 joints, as numbers 16..20, before reordering to keypoints."""

MANO_FINGERTIP_VERTICES: Final = (744, 320, 443, 554, 671)
"""Vertices of MANO's mesh that stand for FINGERTIP_NAMES."""

KEYPOINT_FROM_JOINT: Final = (
    *(0, 13, 14, 15, 16, 1, 2, 3, 17, 4, 5, 6),
    *(18, 10, 11, 12, 19, 7, 8, 9, 20),
)
"""For each of the 21 keypoints, its number among (16 joints, 5 tips)."""

KEYPOINT_NAMES: Final = tuple((*JOINT_NAMES, *FINGERTIP_NAMES)[j] for j in KEYPOINT_FROM_JOINT)
"""The 21 keypoints in OpenPose's order: wrist, then thumb to pinky, each from root to tip."""

KEYPOINT_BONES: Final = tuple(
    (0 if i % 4 == 1 else i - 1, i) for i in range(1, len(KEYPOINT_FROM_JOINT))
)
"""The 20 bones of the drawn skeleton, as (parent, child) keypoint numbers."""

LEFT_MIRROR: Final = (1.0, -1.0, -1.0)
"""Diagonal of D: a left hand's joint rotations are stored as D R D, like a right hand's."""
