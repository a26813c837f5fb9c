"""Acceptance: a sound clip passes, and each flaw is refused for its own reason."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mint_hub.geometry import hand_state, rigid
from mint_hub.geometry.rotations import rotvec_to_matrix
from mint_hub.labelling.records import CameraPath, Clip, Hands, Intrinsics, Video
from mint_hub.labelling.stage import StageError, lost_seconds
from mint_hub.labelling.stages import accept
from mint_hub.labelling.stages.accept import Accept, measured
from tests.labelling.motion import exact_motion

FRAMES = 120


def sound(key="v-0000", start=0, frames=FRAMES):
    state, T_camera_from_world = exact_motion(frames, seed=1)
    hands = Hands(
        hand_state=state,
        presence=np.ones((frames, 2), bool),
        score=np.full((frames, 2), 0.9, np.float32),
        filled=np.zeros((frames, 2), bool),
        shape_space="mint",
        hand_model="template",
        source="test",
        residual_px=np.ones((frames, 2), np.float32),
    )
    ones = np.ones(frames)
    camera = CameraPath(
        T_camera_from_world, ones.astype(bool), ones.astype(np.float32), 0.5, "test", metric=True
    )
    times = (start + np.arange(frames)) / 30
    return Clip(
        key, Path("v.mp4"), 0, (384, 512), 30.0, times,
        intrinsics=Intrinsics((1.2, 1.5), "test", 1.0), camera=camera, hands=hands,
    )  # fmt: skip


def judged(*clips):
    seconds = max(clip.stop_s for clip in clips)
    video = Video("v", "uid", "user", Path("v.mp4"), seconds, 30.0, (384, 512), clips=clips)
    return Accept().run_video(video)


def with_hands(clip, **changes):
    return replace(clip, hands=replace(clip.hands, **changes))


def with_camera(clip, **changes):
    return replace(clip, camera=replace(clip.camera, **changes))


def moved(clip, scale=1.0, jump=0.0, turn_deg=0.0):
    """The camera's way stretched, and one step of it lengthened; the hands stay in the world."""
    head = rigid.inverse(clip.camera.T_camera_from_world)
    world = rigid.transform_points(
        head, hand_state.unpack(clip.hands.hand_state).translation.astype(float)
    )
    after = head.copy()
    after[:, :3, 3] *= scale
    after[60:, 0, 3] += jump
    after[60:, :3, :3] = after[60:, :3, :3] @ rotvec_to_matrix(np.radians([0, 0, turn_deg]))
    state = clip.hands.hand_state.copy()
    state[..., :3] = rigid.transform_points(rigid.inverse(after), world)
    return with_hands(with_camera(clip, T_camera_from_world=rigid.inverse(after)), hand_state=state)


def absent(clip, mask):
    state = clip.hands.hand_state.copy()
    state[mask] = np.asarray(hand_state.absent(()), np.float32)
    return with_hands(clip, hand_state=state, presence=~mask)


def shifted(clip, offset, frames=slice(None)):
    state = clip.hands.hand_state.copy()
    state[frames, :, :3] += np.asarray(offset, np.float32)
    return with_hands(clip, hand_state=state)


def hidden(frames):
    mask = np.zeros((FRAMES, 2), bool)
    mask[:frames] = True
    return mask


def test_a_sound_clip_is_accepted_with_its_numbers():
    (clip,) = judged(sound()).clips
    numbers = clip.reports[-1].numbers
    assert numbers["seconds"] == 4
    assert numbers["hand_share"] == 1
    assert numbers["inside_share"] > 0.9
    assert numbers["unsolved_share"] == 0
    assert 0.3 < numbers["wrist_depth_m"] < 0.8
    assert 0 < numbers["hand_step_m"] < 0.05


@pytest.mark.parametrize(
    ("clip", "reason"),
    [
        (sound(frames=59), accept.SHORT),
        (absent(sound(), hidden(FRAMES)), accept.FEW_HANDS),
        (absent(sound(), hidden(85)), accept.FEW_HANDS),
        (shifted(sound(), [3.0, 0, 0]), accept.AT_BORDER),
        (shifted(sound(), [0, 0, -2.0]), accept.AT_BORDER),  # behind the camera
        (with_camera(sound(), solved=np.arange(FRAMES) < 55), accept.UNSOLVED),
        (moved(sound(), jump=0.4), accept.CAMERA_JUMP),
        (moved(sound(), turn_deg=40), accept.CAMERA_JUMP),
        (shifted(sound(), [0.1, 0.1, 0.4], slice(60, None)), accept.HAND_JUMP),
        (shifted(sound(), [0, 0, 1.6]), accept.HAND_DEPTH),
        (moved(sound(), scale=50.0), accept.CAMERA_SPEED),
    ],
)  # fmt: skip
def test_each_flaw_has_its_reason(clip, reason):
    done = judged(clip)
    assert done.clips == ()
    assert [(lost.reason, lost.seconds) for lost in done.lost] == [
        (reason, pytest.approx(clip.stop_s - clip.start_s))
    ]
    report = done.reports[-1].numbers
    assert report["reasons"] == {reason: 1}
    assert report["refused"][clip.key]["seconds"] == pytest.approx(clip.num_frames / 30, abs=1e-3)


@pytest.mark.parametrize(
    "clip",
    [
        sound(frames=60),
        absent(sound(), hidden(80)),
        with_camera(sound(), solved=np.arange(FRAMES) < 65),
        moved(sound(), jump=0.25),
        moved(sound(), turn_deg=25),
        shifted(sound(), [0, 0, 0.8]),
    ],
)
def test_within_the_limits(clip):
    assert len(judged(clip).clips) == 1


def test_a_hand_that_comes_back_elsewhere_did_not_jump():
    mask = np.zeros((FRAMES, 2), bool)
    mask[58:60] = True
    clip = absent(shifted(sound(), [0.0, 0.0, 0.5], slice(60, None)), mask)
    assert judged(clip).lost == ()


def test_seconds_add_up():
    clips = sound("v-0000"), absent(sound("v-0001", 120), hidden(FRAMES)), sound("v-0002", 240, 50)
    done = judged(*clips)
    kept = [(clip.start_s, clip.stop_s) for clip in done.clips]
    seconds = lost_seconds((0.0, 290 / 30), kept, done.lost)
    assert seconds == {
        f"accept: {accept.FEW_HANDS}": pytest.approx(4.0),
        f"accept: {accept.SHORT}": pytest.approx(50 / 30),
    }


def test_what_is_measured():
    clip = moved(sound(), jump=0.25)
    steps = np.diff(rigid.inverse(clip.camera.T_camera_from_world)[:, :3, 3], axis=0)
    numbers = measured(clip, 0.03)
    assert numbers["camera_step_m"] == pytest.approx(np.linalg.norm(steps, axis=1).max(), abs=1e-5)
    one = sound(frames=1)
    assert measured(one, 0.03)["camera_speed_m_s"] == 0
    assert measured(absent(sound(), hidden(FRAMES)), 0.03)["wrist_depth_m"] is None


def test_what_is_missing_is_named():
    with pytest.raises(StageError, match="expected hands of clip v-0000"):
        judged(replace(sound(), hands=None))
