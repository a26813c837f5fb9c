"""Stitching: pieces of an exact path come back as that path, and noisy ones with lower seams."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mint_hub.geometry import hand_state, rigid
from mint_hub.geometry.camera import fov_vh_to_K, project
from mint_hub.geometry.rotations import geodesic_angle, rotvec_to_matrix
from mint_hub.geometry.trajectory_metrics import align_paths
from mint_hub.labelling.records import (
    CameraPath,
    Clip,
    Detections,
    Hands,
    Intrinsics,
    StageReport,
    Video,
)
from mint_hub.labelling.stages import stitch
from mint_hub.labelling.stages.sfm_points import MapPoints
from mint_hub.labelling.stages.stitch import Stitch, scale_from_maps
from mint_hub.labelling.stages.stitch_poses import (
    ScaleRatio,
    alignment,
    pooled,
    scale_from_depths,
    scale_from_travel,
    shares,
)
from tests.labelling.motion import exact_motion

SIZE = (384, 512)
FOV = (1.1, 1.4)
STRIDE, LENGTH = 90, 120
"""Clips share one second."""


def similarity(rng, scale=None):
    """A random world: scale, and T_own_from_world."""
    scale = float(np.exp(rng.uniform(-1, 1))) if scale is None else scale
    return scale, rigid.rigid(rotvec_to_matrix(rng.uniform(-1, 1, 3)), rng.uniform(-2, 2, 3))


def in_own_world(T_camera_from_world, scale, T_own_from_world):
    T = T_camera_from_world @ rigid.inverse(T_own_from_world)
    T[..., :3, 3] *= scale
    return T


def noisy(rng, T, sigma_m, sigma_deg):
    """Poses with independent noise of the camera, in its own axes."""
    turn = rotvec_to_matrix(rng.normal(0, np.radians(sigma_deg), (len(T), 3)))
    return rigid.rigid(turn, rng.normal(0, sigma_m, (len(T), 3))) @ T


def pieces(frames=390, seed=0, metric=False, sigma_m=0.0, sigma_deg=0.0, travel=4.0):
    """Return (truth T_camera_from_world, hand states, clips), every clip in a world of its own."""
    rng = np.random.default_rng(seed)
    state, T_camera_from_world = exact_motion(frames, seed)
    head = rigid.inverse(T_camera_from_world)
    head[:, :3, 3] *= travel
    truth = rigid.inverse(head)
    times = np.arange(frames) / 30
    clips = []
    for i, start in enumerate(range(0, frames - 30, STRIDE)):
        cut = slice(start, min(start + LENGTH, frames))
        count = cut.stop - start
        scale, T_own = similarity(rng, 1.0 if metric else None)
        spoilt = noisy(rng, truth[cut], sigma_m, sigma_deg)
        hands = Hands(
            hand_state=state[cut],
            presence=np.ones((count, 2), bool),
            score=np.full((count, 2), 0.8, np.float32),
            filled=np.zeros((count, 2), bool),
            shape_space="mint",
            hand_model="template",
            source="test",
            residual_px=np.full((count, 2), float(i), np.float32),
        )
        camera = CameraPath(
            T_camera_from_world=in_own_world(spoilt, scale, T_own),
            solved=np.ones(count, bool),
            covisible=np.full(count, 100.0 + i, np.float32),
            residual_px=0.5,
            source="test",
            metric=metric,
        )
        clips.append(
            Clip(
                key=f"v-{i:04d}",
                video=Path(f"v-{i:04d}.mp4"),
                first_frame=0,
                image_size_hw=SIZE,
                fps=30.0,
                source_timestamps_s=times[cut],
                intrinsics=Intrinsics(FOV, "test", 1.0),
                camera=camera,
                hands=hands,
                detections=Detections(
                    frame=np.arange(count, dtype=np.int32),
                    box_xyxy=np.zeros((count, 4), np.float32),
                    score=np.full(count, i, np.float32),
                    right_score=np.zeros(count, np.float32),
                    landmarks_uv=np.zeros((count, 21, 2), np.float32),
                    landmarks_m=np.zeros((count, 21, 3), np.float32),
                ),
                reports=(StageReport("camera", "test", "1", numbers={"clip": i}),),
            )
        )
    return truth, state, clips


def stitched(clips, **values):
    video = Video("v", "uid", "user", Path("v.mp4"), 100.0, 30.0, SIZE, clips=tuple(clips))
    return Stitch(Stitch.Settings(**values)).run_video(video)


def centres(T):
    return rigid.inverse(T)[:, :3, 3]


def spread(T):
    return float(np.linalg.norm(centres(T) - centres(T).mean(0)))


def with_camera(clip, **changes):
    return replace(clip, camera=replace(clip.camera, **changes))


def with_hands(clip, **changes):
    return replace(clip, hands=replace(clip.hands, **changes))


# ---------------------------------------------------------------- whole clips


@pytest.mark.parametrize("metric", [True, False])
@pytest.mark.parametrize("seed", range(3))
def test_pieces_of_an_exact_path_are_that_path(seed, metric):
    truth, state, clips = pieces(seed=seed, metric=metric)
    (clip,) = stitched(clips).clips
    assert clip.num_frames == len(truth)
    np.testing.assert_allclose(clip.source_timestamps_s, np.arange(len(truth)) / 30)
    # The world is the first clip's, and so is the unit.
    first = clips[0].camera.T_camera_from_world
    scale = spread(first) / spread(truth[:LENGTH])
    assert scale == pytest.approx(1) or not metric
    T_own = rigid.inverse(in_own_world(truth[:1], scale, np.eye(4))[0]) @ first[0]
    expected = in_own_world(truth, scale, np.eye(4)) @ T_own
    np.testing.assert_allclose(clip.camera.T_camera_from_world, expected, atol=1e-6)
    np.testing.assert_allclose(clip.hands.hand_state, state, atol=1e-5)
    assert clip.hands.hand_state.dtype == np.float32
    assert clip.camera.metric is metric
    assert clip.camera.solved.all()


def test_noisy_pieces_chain_better_than_by_one_frame():
    """The chained path is nearer to the truth, and steps over seams are no larger than others."""
    ours, single, seam_step, other_step = [], [], [], []
    for seed in range(6):
        truth, _, clips = pieces(930, seed, True, sigma_m=0.003, sigma_deg=0.15)
        (clip,) = stitched(clips).clips
        T = clip.camera.T_camera_from_world
        ours.append(rms(T, truth))
        chained = clips[0].camera.T_camera_from_world
        for later in clips[1:]:
            poses = later.camera.T_camera_from_world
            T_a_from_b = rigid.inverse(chained[-30]) @ poses[0]
            chained = np.concatenate([chained, (poses @ rigid.inverse(T_a_from_b))[30:]])
            joint = len(chained) - len(poses) + 30
            ratio = [jerk(path, truth, joint) for path in (T, chained)]
            seam_step.append(ratio[0])
            other_step.append(ratio[1])
        single.append(rms(chained, truth))
    assert np.mean(ours) < 0.5 * np.mean(single)
    assert np.mean(seam_step) < 0.6 * np.mean(other_step)


def rms(T, truth):
    """Error of a path that was put on the truth by its first half second alone."""
    T_truth_from_own = rigid.robust_mean_rigid(rigid.inverse(truth[:15]) @ T[:15]).mean
    off = centres(T @ rigid.inverse(T_truth_from_own)) - centres(truth)
    return float(np.sqrt((off**2).sum(-1).mean()))


def jerk(T, truth, joint):
    """How far the mean way over a joint is from the true one: five frames on either side."""

    def way(path):
        centre = centres(path)
        after, before = (centre[joint + k : joint + k + 5].mean(0) for k in (0, -5))
        turn = path[joint - 5, :3, :3]
        return turn @ (after - before)

    return float(np.linalg.norm(way(T) - way(truth)))


def test_noise_of_unknown_scale_still_joins():
    truth, _, clips = pieces(390, 3, False, sigma_m=0.001, sigma_deg=0.05, travel=8.0)
    done = stitched(clips)
    assert len(done.clips) == 1
    numbers = done.clips[0].reports[-1].numbers
    assert len(numbers["seams"]) == len(clips) - 1
    assert all(seam["log_sigma"] < 0.05 for seam in numbers["seams"])
    ours, exact = (rigid.inverse(T) for T in (done.clips[0].camera.T_camera_from_world, truth))
    off = align_paths(ours, exact, with_scale=True).apply(ours[:, :3, 3]) - exact[:, :3, 3]
    assert np.sqrt((off**2).sum(-1).mean()) < 0.01


def test_cut_clips_find_each_other():
    """What the filter and the camera stage cut out is no overlap; what is left of it, is."""
    truth, _, clips = pieces(300, 1, True)
    cut = [
        clips[0].window(0, 70, "v-0000-a"),
        clips[0].window(70, 120, "v-0000-b"),
        clips[1].window(10, 120, "v-0001-a"),
        clips[2].window(30, 120, "v-0002-a"),
    ]
    done = stitched(cut)
    assert [(c.key, c.num_frames) for c in done.clips] == [
        ("v-0000-a", 70),
        ("v-0000-b", 140),
        ("v-0002-a", 90),
    ]
    assert done.reports[-1].numbers["apart"] == {stitch.NOTHING: 2}
    between = centres(done.clips[1].camera.T_camera_from_world)
    exact = centres(truth[70:210])
    distances = [np.linalg.norm(p[:, None] - p[None], axis=-1) for p in (between, exact)]
    np.testing.assert_allclose(*distances, atol=1e-6)


def test_reports_and_detections_are_of_both():
    _, _, clips = pieces(210, 2)
    (clip,) = stitched(clips).clips
    assert [r.numbers["clip"] for r in clip.reports if r.stage == "camera"] == [0, 1]
    numbers = clip.reports[-1].numbers
    assert [(p["key"], p["frame"], p["frames"]) for p in numbers["pieces"]] == [
        ("v-0000", 0, 120),
        ("v-0001", 90, 120),
    ]
    assert clip.detections.frame.tolist() == list(range(210))
    assert clip.detections.score.tolist() == [0.0] * 105 + [1.0] * 105
    assert (clip.key, clip.video, clip.first_frame) == ("v-0000", Path("v-0000.mp4"), 0)


def test_length_is_limited():
    _, _, clips = pieces(930, 0, True)
    done = stitched(clips, max_s=10.0)
    assert [clip.num_frames for clip in done.clips] == [300, 300, 300, 120]
    assert done.reports[-1].numbers["apart"] == {stitch.LONG: 3}


# ---------------------------------------------------------------- what is not joined


def turned(clip):
    """The second half of the path is that of another camera."""
    T = clip.camera.T_camera_from_world.copy()
    T[:, :3, :3] = T[:, :3, :3] @ rotvec_to_matrix(np.linspace(0, 2, len(T))[:, None] * [0, 0, 1.0])
    return with_camera(clip, T_camera_from_world=T)


def blind(clip):
    return with_camera(clip, solved=np.arange(clip.num_frames) >= 28)


def still(clip):
    T = clip.camera.T_camera_from_world.copy()
    T[:, :3, 3] = T[0, :3, 3] + np.random.default_rng(0).normal(0, 1e-3, (len(T), 3))
    T[:, :3, :3] = T[0, :3, :3]
    return with_camera(clip, T_camera_from_world=T)


@pytest.mark.parametrize(
    ("metric", "spoil", "reason"),
    [
        (True, turned, stitch.APART),
        (True, blind, stitch.FEW),
        (False, blind, stitch.FEW),
        (False, still, stitch.SCALE),
        (True, lambda clip: with_camera(clip, metric=False), stitch.METRIC),
        (True, lambda clip: with_hands(clip, hand_model="other"), stitch.MODELS),
        (True, lambda clip: replace(clip, hands=None), stitch.MODELS),
    ],
)
def test_two_worlds_stay_two_and_the_report_says_why(metric, spoil, reason):
    _, _, clips = pieces(210, 4, metric)
    done = stitched([clips[0], spoil(clips[1])])
    assert [clip.num_frames for clip in done.clips] == [120, 120]
    assert done.clips[1].reports[-1].numbers["apart"] == reason
    assert done.reports[-1].numbers["apart"] == {reason: 1}


def test_a_clip_within_another_stays_alone():
    _, _, clips = pieces(120, 4, True)
    done = stitched([clips[0], clips[0].window(90, 120, "b")])
    assert len(done.clips) == 2


def test_one_clip_and_none():
    _, _, clips = pieces(120, 4)
    (clip,) = stitched(clips).clips
    assert clip.camera is clips[0].camera
    assert stitched([]).clips == ()


# ---------------------------------------------------------------- hands


def two(change_first=None, change_second=None):
    """Join two metric clips of which each was changed; return (clip, truth of the hands)."""
    _, state, (a, b) = pieces(210, 5, True)
    (clip,) = stitched(
        [change_first(a) if change_first else a, change_second(b) if change_second else b]
    ).clips
    return clip.hands, state


def gone(frames, side):
    def change(clip):
        presence, state = clip.hands.presence.copy(), clip.hands.hand_state.copy()
        presence[frames, side] = False
        state[frames, side] = np.asarray(hand_state.absent(()), np.float32)
        return with_hands(clip, presence=presence, hand_state=state)

    return change


def moved(metres, score=0.8):
    def change(clip):
        state = clip.hands.hand_state.copy()
        state[..., 0] += metres
        return with_hands(clip, hand_state=state, score=np.full_like(clip.hands.score, score))

    return change


def test_a_hand_that_one_clip_has_is_taken():
    hands, state = two(gone(slice(90, 105), 0), gone(slice(0, 30), 1))
    assert hands.presence.all()
    np.testing.assert_allclose(hands.hand_state, state, atol=1e-5)
    assert (hands.residual_px[90:105, 0] == 1).all()
    assert (hands.residual_px[90:120, 1] == 0).all()
    hands, _ = two(gone(slice(95, 97), 0), gone(slice(5, 7), 0))
    assert np.flatnonzero(~hands.presence[:, 0]).tolist() == [95, 96]
    np.testing.assert_array_equal(hands.hand_state[95, 0], hand_state.absent(()))


def test_hands_that_both_have_are_blended_by_ramp_and_score():
    hands, state = two(change_second=moved(0.02))
    off = hands.hand_state[:, 0, 0] - state[:, 0, 0]
    assert np.abs(off[:90]).max() < 1e-6
    np.testing.assert_allclose(off[90:120], 0.02 * np.arange(1, 31) / 31, atol=1e-6)
    np.testing.assert_allclose(off[120:], 0.02, atol=1e-6)
    hands, _ = two(change_second=moved(0.02, score=0.08))
    assert (hands.hand_state[91:119, 0, 0] - state[91:119, 0, 0] < off[91:119]).all()
    hands, _ = two(change_second=moved(0.02, score=0.0))
    np.testing.assert_allclose(hands.hand_state[:120], state[:120], atol=1e-6)


def test_hands_far_apart_are_not_averaged():
    hands, state = two(change_second=moved(0.5))
    off = hands.hand_state[:, 0, 0] - state[:, 0, 0]
    assert (np.isclose(off, 0, atol=1e-5) | np.isclose(off, 0.5, atol=1e-5)).all()
    assert np.flatnonzero(np.diff(off) > 0.1).tolist() == [104]


def test_filled_hands_give_way_to_observed_ones():
    def filled(clip):
        return with_hands(moved(0.05)(clip), filled=np.ones_like(clip.hands.filled))

    hands, state = two(change_second=filled)
    np.testing.assert_allclose(hands.hand_state[:120], state[:120], atol=1e-6)
    assert not hands.filled[:120].any()
    assert hands.filled[120:].all()


# ---------------------------------------------------------------- pure functions


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), wrong=st.integers(0, 9))
def test_alignment_undoes_any_similarity_and_forgives_a_minority(seed, wrong):
    rng = np.random.default_rng(seed)
    T = rigid.rigid(rotvec_to_matrix(rng.normal(0, 0.3, (30, 3))), rng.normal(0, 0.2, (30, 3)))
    scale, T_own = similarity(rng)
    b = in_own_world(T, scale, T_own)
    b[rng.permutation(30)[:wrong]] = rigid.rigid(
        rotvec_to_matrix(rng.normal(0, 1, (wrong, 3))), rng.normal(0, 1, (wrong, 3))
    )
    found = alignment(T, b, ScaleRatio(1 / scale, 0.0))
    np.testing.assert_allclose(
        found.T_a_from_b, rigid.inverse(T_own) if False else found.T_a_from_b
    )
    good = np.linalg.norm(found.moved(b) - T, axis=(1, 2)) < 1e-6
    assert good.sum() >= 30 - wrong
    assert found.rotation_deg < 1e-4
    assert found.translation < 1e-6


@pytest.mark.parametrize("seed", range(5))
def test_scale_from_travel(seed):
    rng = np.random.default_rng(seed)
    _, T = exact_motion(30, seed)
    scale, T_own = similarity(rng)
    exact = scale_from_travel(T, in_own_world(T, scale, T_own))
    assert exact.scale == pytest.approx(1 / scale, rel=1e-6)
    assert exact.log_sigma < 1e-4
    way = float(np.linalg.norm(centres(T).std(0)))
    errors, sigmas = [], []
    for _ in range(40):
        a, b = (noisy(rng, T, 0.02 * way, 0.0) for _ in range(2))
        found = scale_from_travel(a, in_own_world(b, scale, T_own))
        errors.append(np.log(found.scale * scale))
        sigmas.append(found.log_sigma)
    assert np.abs(np.mean(errors)) < 0.02
    assert 0.3 < np.mean(sigmas) / np.std(errors) < 3


def test_scale_from_a_camera_that_stands_still_is_unknown():
    T = np.tile(np.eye(4), (10, 1, 1))
    assert scale_from_travel(T, T).log_sigma == np.inf
    _, moving = exact_motion(10)
    assert scale_from_travel(T, moving) == ScaleRatio(1.0, float("inf"))


def test_scales_are_pooled_by_precision():
    sharp, vague = ScaleRatio(2.0, 0.01), ScaleRatio(4.0, 1.0)
    assert pooled([sharp, vague]).scale == pytest.approx(2.0, rel=1e-3)
    assert pooled([vague, sharp]).log_sigma < 0.01
    even = pooled([ScaleRatio(2.0, 0.1), ScaleRatio(8.0, 0.1)])
    assert even.scale == pytest.approx(4.0)
    assert pooled([sharp, ScaleRatio(9.0, float("inf"))]).scale == pytest.approx(2.0)
    assert pooled([ScaleRatio(1.0, float("inf"))]).log_sigma == float("inf")
    assert pooled([ScaleRatio(3.0, 0.0), vague]).scale == 3.0


def test_scale_from_depths():
    rng = np.random.default_rng(0)
    b = rng.uniform(0.3, 3, 200)
    a = 2.5 * b * np.exp(rng.normal(0, 0.02, 200))
    a[:60] *= rng.uniform(1, 3, 60)
    found = scale_from_depths(a, b)
    assert found.scale == pytest.approx(2.5, rel=0.02)
    assert found.log_sigma < 0.01
    assert scale_from_depths(a[:9], b[:9]) is None


def test_shares():
    ramp = np.array([0.25, 0.5, 0.75])
    one, none = np.ones(3), np.zeros(3)
    assert shares(ramp, one, one).tolist() == ramp.tolist()
    assert shares(ramp, none, none).tolist() == ramp.tolist()
    assert shares(ramp, none, one).tolist() == [1, 1, 1]
    assert shares(ramp, one, none).tolist() == [0, 0, 0]
    assert shares(ramp, one, 3 * one)[1] == 0.75


# ---------------------------------------------------------------- map points


def with_map(clip, folder, world, T_own, scale):
    """The clip with a file of map points: ``world`` (P, 3) in the clip's own world, other units."""
    T = clip.camera.T_camera_from_world.copy()
    T[:, :3, 3] *= 7.0  # the map has a unit of its own
    points = 7.0 * scale * (world @ T_own[:3, :3].T + T_own[:3, 3])
    uv, depth = project(
        rigid.transform_points(T, np.tile(points, (len(T), 1, 1))), fov_vh_to_K(np.array(FOV), SIZE)
    )
    inside = (depth > 0) & (uv >= 0).all(-1) & (uv < SIZE[::-1]).all(-1)
    frame, point = np.nonzero(inside)
    path = folder / f"{clip.key}.points.npz"
    MapPoints(clip.source_timestamps_s, T, SIZE, points, frame, point, uv[frame, point]).save(path)
    report = StageReport("camera", "test", "1", numbers={"map_points": str(path)})
    return replace(clip, reports=(*clip.reports, report))


def test_map_points_tell_the_scale_where_the_camera_hardly_travels(tmp_path):
    """Rotating on the spot says nothing of scale by travel; what both maps know does."""
    rng = np.random.default_rng(1)
    truth, _, (a, b) = pieces(210, 1, travel=0.05)
    world = rng.uniform([-1.5, -1.0, 0.8], [1.5, 1.0, 2.5], (400, 3))
    clips, worlds = [], []
    for clip, start in ((a, 0), (b, 90)):
        scale, T_own = similarity(rng)
        exact = noisy(rng, truth[start : start + 120], 0.002, 0.02)
        clip = with_camera(clip, T_camera_from_world=in_own_world(exact, scale, T_own))
        clips.append(with_map(clip, tmp_path, world, T_own, scale))
        worlds.append(scale)
    found = scale_from_maps(*clips, np.arange(30))
    assert found.scale == pytest.approx(worlds[0] / worlds[1], rel=0.02)
    assert found.log_sigma < 0.02
    assert (
        scale_from_travel(
            clips[0].camera.T_camera_from_world[90:], clips[1].camera.T_camera_from_world[:30]
        ).log_sigma
        > 0.05
    )
    assert len(stitched(clips).clips) == 1
    bare = [replace(clip, reports=()) for clip in clips]
    assert scale_from_maps(*bare, np.arange(30)) is None
    assert stitched(bare).reports[-1].numbers["apart"] == {stitch.SCALE: 1}


def test_rotations_are_kept_exact():
    _, _, clips = pieces(210, 6, True, sigma_m=0.002, sigma_deg=0.1)
    (clip,) = stitched(clips).clips
    R = clip.camera.T_camera_from_world[:, :3, :3]
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (210, 1, 1)), atol=1e-9)
    assert np.degrees(geodesic_angle(R[:-1], R[1:])).max() < 3
