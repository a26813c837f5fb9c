"""Stage "accept": a clip becomes an episode, or is let go for a reason and with its numbers."""

from collections import Counter
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry import hand_state as hands
from mint_hub.geometry import rigid
from mint_hub.geometry.camera import fov_vh_to_K, project
from mint_hub.geometry.hand_model import HandModel
from mint_hub.geometry.rotations import geodesic_angle
from mint_hub.labelling.records import Clip, Lost, Video
from mint_hub.labelling.stage import Resources, report_of, reported, require

SHORT: Final = "too short"
FEW_HANDS: Final = "too few frames with a hand"
AT_BORDER: Final = "hands only at the border"
UNSOLVED: Final = "camera mostly unsolved"
CAMERA_JUMP: Final = "trajectory jump of the camera"
HAND_JUMP: Final = "trajectory jump of a hand"
HAND_DEPTH: Final = "scale implausible: distance of the hands"
CAMERA_SPEED: Final = "scale implausible: speed of the camera"

_SMALL = 1e-9

Float64 = NDArray[np.float64]


class Accept:
    """Refuses clips that cannot be trusted; of several reasons the first one in this order counts.

    Too short; too few frames with a hand; hands only at the border of the picture; camera mostly
    unsolved; camera or hand jumps from one frame to the next; implausible scale.
    """

    stage, backend, version = "accept", "default", "1"
    needs, gives = ("intrinsics", "camera", "hands"), ()
    resources = Resources(cpus=1)

    @dataclass(frozen=True)
    class Settings:
        """Limits; lengths in metres of the scaled world.

        Attributes:
            min_s: shortest clip, seconds.
            min_hand_share: share of frames that show a hand, at least.
            border: margin of the picture, as a share of its shorter side, within which the middle
                of a hand is at the border.
            min_inside_share: share of hands that are not at the border, at least.
            max_unsolved_share: share of frames whose camera was interpolated, at most.
            camera_jump_m, camera_jump_deg, hand_jump_m: step a frame, at most; hands in the world.
            wrist_depth_m: least and greatest median depth of the wrists.
            camera_speed_m_s: speed of the camera that it exceeds a twentieth of the time, at most.

        """

        min_s: float = 2.0
        min_hand_share: float = 0.3
        border: float = 0.03
        min_inside_share: float = 0.1
        max_unsolved_share: float = 0.5
        camera_jump_m: float = 0.3
        camera_jump_deg: float = 30.0
        hand_jump_m: float = 0.3
        wrist_depth_m: tuple[float, float] = (0.1, 1.5)
        camera_speed_m_s: float = 5.0

    def __init__(self, settings: Settings | None = None) -> None:
        self.settings = settings or self.Settings()

    def run_video(self, video: Video) -> Video:
        """Judge every clip; what was measured is in the reports, of refused clips in the video's.

        Raises:
            StageError: a clip lacks what the stages before should have given.

        """
        kept: list[Clip] = []
        lost: list[Lost] = []
        reasons: Counter[str] = Counter()
        refused: dict[str, Any] = {}
        for clip in video.clips:
            require(self, clip)
            numbers = measured(clip, self.settings.border)
            if reason := self.flaw(numbers):
                lost.append(clip.lost(self.stage, reason))
                reasons[reason] += 1
                refused[clip.key] = {"reason": reason, **numbers}
            else:
                kept.append(reported(clip, report_of(self, **numbers)))
        report = report_of(self, accepted=len(kept), reasons=dict(reasons), refused=refused)
        return replace(
            video,
            clips=tuple(kept),
            lost=(*video.lost, *lost),
            reports=(*video.reports, report),
        )

    def close(self) -> None:
        """Nothing to end."""

    def flaw(self, numbers: dict[str, Any]) -> str:
        """Return why a clip with these numbers is refused; empty when it is accepted."""
        s = self.settings
        near, far = s.wrist_depth_m
        checks = (
            (SHORT, numbers["seconds"] < s.min_s - _SMALL),
            (FEW_HANDS, numbers["hand_share"] < s.min_hand_share or numbers["hand_share"] == 0),
            (AT_BORDER, (numbers["inside_share"] or 0.0) < s.min_inside_share),
            (UNSOLVED, numbers["unsolved_share"] > s.max_unsolved_share),
            (CAMERA_JUMP, numbers["camera_step_m"] > s.camera_jump_m),
            (CAMERA_JUMP, numbers["camera_step_deg"] > s.camera_jump_deg),
            (HAND_JUMP, numbers["hand_step_m"] > s.hand_jump_m),
            (HAND_DEPTH, not near <= (numbers["wrist_depth_m"] or 0.0) <= far),
            (CAMERA_SPEED, numbers["camera_speed_m_s"] > s.camera_speed_m_s),
        )
        return next((reason for reason, wrong in checks if wrong), "")


def measured(clip: Clip, border: float) -> dict[str, Any]:
    """Numbers that `Accept` judges by; None where there is no hand to measure.

    Steps are the greatest from a frame to the next one, of hands only where both show the hand.
    """
    assert clip.camera is not None
    assert clip.hands is not None
    present = clip.hands.presence
    T_world_from_camera = rigid.inverse(clip.camera.T_camera_from_world)
    centre = rigid.translation_of(T_world_from_camera)
    turn_deg = np.degrees(
        geodesic_angle(T_world_from_camera[:-1, :3, :3], T_world_from_camera[1:, :3, :3])
    )
    step_m = np.linalg.norm(np.diff(centre, axis=0), axis=-1)
    wrist = np.asarray(hands.unpack(clip.hands.hand_state).translation, np.float64)
    world = rigid.transform_points(T_world_from_camera, wrist)
    hand_step = np.linalg.norm(np.diff(world, axis=0), axis=-1)[present[1:] & present[:-1]]
    inside = inside_share(clip, border)
    speed = float(np.quantile(step_m, 0.95)) * clip.fps if len(step_m) else 0.0
    return {
        "seconds": round(clip.num_frames / clip.fps, 4),
        "hand_share": round(float(present.any(1).mean()), 4),
        "inside_share": inside if inside is None else round(inside, 4),
        "unsolved_share": round(float((~clip.camera.solved).mean()), 4),
        "camera_step_m": round(float(step_m.max(initial=0.0)), 5),
        "camera_step_deg": round(float(turn_deg.max(initial=0.0)), 4),
        "camera_speed_m_s": round(speed, 4),
        "hand_step_m": round(float(hand_step.max(initial=0.0)), 5),
        "wrist_depth_m": round(float(np.median(wrist[present, 2])), 4) if present.any() else None,
    }


def inside_share(clip: Clip, border: float) -> float | None:
    """Share of hands whose middle, the mean of 21 keypoints, is not at the border; None if no hand.

    The default hand without its shape stands for every hand: this is about where, not how large.
    """
    assert clip.hands is not None
    assert clip.intrinsics is not None
    if not clip.hands.presence.any():
        return None
    state = hands.unpack(np.asarray(clip.hands.hand_state, np.float64))
    plain = replace(state, shape_params=np.zeros_like(state.shape_params))
    points = np.asarray(HandModel.template().keypoints(plain.pack()), np.float64)
    middle = points[clip.hands.presence].mean(-2)
    K = fov_vh_to_K(np.array(clip.intrinsics.fov_vh_rad, np.float64), clip.image_size_hw)
    uv, _ = project(middle, K)
    height, width = clip.image_size_hw
    margin = border * min(height, width)
    with np.errstate(invalid="ignore"):
        inside = ((uv >= margin) & (uv <= np.array([width, height]) - margin)).all(-1)
    return float(inside.mean())
