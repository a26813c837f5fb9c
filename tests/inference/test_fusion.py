"""Laws of chaining and fusion: what was cut apart comes back, and more frames align better."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mint_hub.geometry import hand_state as hands
from mint_hub.geometry import rigid, rotations
from mint_hub.inference.fusion import (
    CameraFuser,
    HandFuser,
    OverlapFuser,
    align,
    chain_cameras,
    fuse_hands,
    fuse_linear,
)
from mint_hub.windows import Window, WindowPlanner, ramp, windows

LAWS = settings(deadline=None, max_examples=25, derandomize=True)
CUTS = st.integers(2, 32).flatmap(
    lambda length: st.tuples(st.integers(1, 150), st.just(length), st.integers(1, length - 1))
)
ROTATION_NOISE = np.radians(0.5)
TRANSLATION_NOISE = 0.005


def camera_path(num_frames: int, rng: np.random.Generator) -> np.ndarray:
    """T_camera_from_world (T, 4, 4) of someone who walks and looks around, 30 frames a second."""
    t = np.arange(num_frames)[:, None] / 30.0

    def wander(size: float) -> np.ndarray:
        phases = rng.uniform(0, 2 * np.pi, (3, 3))
        waves = [np.sin(1.4 * (k + 1) * t + phases[k]) / (k + 1) for k in range(3)]
        return size * np.sum(waves, axis=0)

    centre = wander(0.2) + t * np.array([0.3, 0.0, 0.2])
    return rigid.inverse(rigid.rigid(rotations.rotvec_to_matrix(wander(0.4)), centre))


def random_rigid(rng: np.random.Generator, reach_m: float) -> np.ndarray:
    rotation = rotations.rotvec_to_matrix(rng.uniform(-1.5, 1.5, 3))
    return rigid.rigid(rotation, rng.uniform(-reach_m, reach_m, 3))


def camera_noise(count: int, rng: np.random.Generator) -> np.ndarray:
    """T_noisy_from_camera (count, 4, 4): half a degree and 5 mm a component, in the camera."""
    turn = rng.normal(0, ROTATION_NOISE, (count, 3))
    return rigid.rigid(
        rotations.rotvec_to_matrix(turn), rng.normal(0, TRANSLATION_NOISE, (count, 3))
    )


def cut_cameras(
    track: np.ndarray, cover: list[Window], rng: np.random.Generator, noisy: bool = False
) -> list[np.ndarray]:
    """Each window's poses in a random world of its own; the first keeps the track's."""
    parts = [track[w.frames] @ (random_rigid(rng, 3.0) if w.start else np.eye(4)) for w in cover]
    return [camera_noise(len(p), rng) @ p for p in parts] if noisy else parts


def centres(T_camera_from_world: np.ndarray) -> np.ndarray:
    return rigid.translation_of(rigid.inverse(T_camera_from_world))


def trajectory_error(got: np.ndarray, truth: np.ndarray) -> float:
    """ATE: root mean square distance of camera centres, metres, after the best rigid alignment."""
    source, target = centres(got), centres(truth)
    moved = rigid.umeyama(source, target, with_scale=False).apply(source)
    return float(np.sqrt(np.mean(np.sum((moved - target) ** 2, axis=-1))))


@LAWS
@given(CUTS, st.integers(0, 2**32 - 1), st.sampled_from(["all", "first"]))
def test_a_rigid_track_comes_back(cut: tuple[int, int, int], seed: int, frames: Any):
    rng, cover = np.random.default_rng(seed), windows(*cut)
    track = camera_path(cut[0], rng)
    chained = chain_cameras(cut_cameras(track, cover, rng), cover, frames)
    np.testing.assert_allclose(chained.T_camera_from_world, track, rtol=0, atol=1e-6)
    assert len(chained.seams) == len(cover) - 1
    for seam, a, b in zip(chained.seams, cover, cover[1:], strict=False):
        assert (seam.start, seam.stop) == (b.start, a.stop)
        assert seam.rotation_deg < 1e-6
        assert seam.translation_m < 1e-6


def test_all_shared_frames_chain_better_than_one():
    """Independent noise over 13 seams: lower error in 20 of 20 seeds, half of it on average."""
    cover, errors = windows(320), []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        track = camera_path(320, rng)
        parts = cut_cameras(track, cover, rng, noisy=True)
        both = [chain_cameras(parts, cover, frames) for frames in ("all", "first")]
        errors.append([trajectory_error(c.T_camera_from_world, track) for c in both])
    by_all, by_first = np.array(errors).T
    assert (by_all < by_first).all()
    assert by_all.mean() < 0.55 * by_first.mean()


def test_seams_report_the_noise():
    """Two windows disagree by sqrt(2) of three components' noise, less what the fit absorbs."""
    cover = windows(2000)
    rng = np.random.default_rng(0)
    track = camera_path(2000, rng)
    seams = chain_cameras(cut_cameras(track, cover, rng, noisy=True), cover).seams
    fitted = np.sqrt(6 * 7 / 8)
    turn = np.sqrt(np.mean([s.rotation_deg**2 for s in seams]))
    assert turn == pytest.approx(fitted * np.degrees(ROTATION_NOISE), rel=0.1)
    distance = np.sqrt(np.mean([s.translation_m**2 for s in seams]))
    assert distance == pytest.approx(fitted * TRANSLATION_NOISE, rel=0.1)


def test_alignment_is_indifferent_to_the_worlds_and_to_outliers():
    """Rotation noise must not reach the translation, however far away the origins are."""
    rng = np.random.default_rng(3)
    track = camera_path(8, rng)
    other = camera_noise(8, rng) @ track
    near = align(track, other)
    A, B = random_rigid(rng, 1000.0), random_rigid(rng, 1000.0)
    far = align(track @ rigid.inverse(A), other @ rigid.inverse(B))
    np.testing.assert_allclose(rigid.inverse(A) @ far @ B, near, rtol=0, atol=1e-6)
    spoiled = track.copy()
    spoiled[[1, 4]] = random_rigid(rng, 5.0) @ spoiled[[1, 4]]
    np.testing.assert_allclose(align(spoiled, track), np.eye(4), rtol=0, atol=1e-6)


def random_hands(count: int, rng: np.random.Generator) -> np.ndarray:
    """Smooth states (T, 2, 109) float64."""
    t = np.arange(count)[:, None, None] / 30.0

    def wander(size: int) -> np.ndarray:
        return 0.5 * np.sin(rng.uniform(1, 3, (2, size)) * t + rng.uniform(0, 6, (2, size)))

    joints = rotations.rotvec_to_matrix(wander(45).reshape(count, 2, 15, 3))
    orientation = rotations.rotvec_to_matrix(3 * wander(3))
    return np.asarray(
        hands.HandState.from_matrices(wander(3), orientation, joints, wander(10)).pack()
    )


@LAWS
@given(CUTS, st.integers(0, 2**32 - 1))
def test_what_was_cut_apart_comes_back(cut: tuple[int, int, int], seed: int):
    rng, cover = np.random.default_rng(seed), windows(*cut)
    states = random_hands(cut[0], rng)
    got = fuse_hands([states[w.frames] for w in cover], cover)
    np.testing.assert_allclose(got, states, rtol=0, atol=1e-9)
    logits = rng.normal(size=(cut[0], 2)).astype(np.float32)
    got = fuse_linear([logits[w.frames] for w in cover], cover)
    assert got.dtype == np.float32
    np.testing.assert_allclose(got, logits, rtol=0, atol=1e-6)


def test_ramps_over_three_windows_by_hand():
    cover = [Window(0, 4), Window(3, 7), Window(4, 8)]  # stride 3, the last one shifted
    got = fuse_linear([np.full(4, v) for v in (0.0, 1.0, 2.0)], cover)
    # frame 3: halfway; frames 4..6 are shared by the second and the third.
    np.testing.assert_allclose(got, [0, 0, 0, 0.5, 1.25, 1.5, 1.75, 2.0])
    cover = [Window(0, 4), Window(2, 6), Window(3, 7)]
    got = fuse_linear([np.full(4, v) for v in (0.0, 3.0, 9.0)], cover)
    # frame 3 has seen three: 2 of the first two, then a quarter of the way to 9.
    np.testing.assert_allclose(got, [0, 0, 1, 2 + 7 / 4, 3 + 6 / 2, 3 + 6 * 3 / 4, 9])


def test_rotations_are_averaged_on_the_sphere():
    """A wrist 170 degrees apart turns at constant speed; the mean of 6D rows would not."""
    m = 8
    a = np.asarray(hands.absent((32, 2))).astype(float)
    b = a.copy()
    turn = rotations.rotvec_to_matrix(np.array([0.0, 0.0, np.radians(170)]))
    b[..., hands.ORIENTATION] = rotations.matrix_to_rot6d_rows(turn)
    fused = hands.unpack(fuse_hands([a, b], [Window(0, 32), Window(24, 56)]))
    angle = rotations.geodesic_angle(np.eye(3), fused.orientation())
    want = np.radians(170) * np.array([*np.zeros(24), *ramp(m), *np.ones(24)])
    np.testing.assert_allclose(angle, np.stack([want, want], -1), rtol=0, atol=1e-9)


def test_fused_states_are_valid_and_single_frames_untouched():
    rng, cover = np.random.default_rng(1), windows(100)
    parts = [(random_hands(32, rng) * 1.3).astype(np.float32) for _ in cover]  # rows too long
    got = fuse_hands(parts, cover)
    assert got.dtype == np.float32
    np.testing.assert_array_equal(got[:24], parts[0][:24])
    np.testing.assert_array_equal(got[32:48], parts[1][8:24])
    rows = np.asarray(hands.unpack(got[24:32]).joint_rot6d_rows).reshape(-1, 2, 3)
    want = np.broadcast_to(np.eye(2), (len(rows), 2, 2))
    np.testing.assert_allclose(rows @ rows.mT, want, atol=1e-6)


@pytest.mark.parametrize("make", [CameraFuser, HandFuser, OverlapFuser])
@pytest.mark.parametrize("num_frames", [1, 20, 32, 57, 200])
def test_streaming_equals_the_whole_and_holds_little(
    make: Callable[[], OverlapFuser], num_frames: int
):
    rng, cover = np.random.default_rng(2), windows(num_frames)
    if make is CameraFuser:
        parts = cut_cameras(camera_path(num_frames, rng), cover, rng, noisy=True)
        whole = chain_cameras(parts, cover).T_camera_from_world
    elif make is HandFuser:
        parts = [random_hands(w.num_frames, rng) for w in cover]
        whole = fuse_hands(parts, cover)
    else:
        parts = [rng.normal(size=(w.num_frames, 2)) for w in cover]
        whole = fuse_linear(parts, cover)
    fuser, planner, done = make(), WindowPlanner(), 0
    queue = iter(parts)
    for event in [*range(num_frames), None]:
        ready = planner.finish() if event is None else planner.push()
        for window in ready:
            final = fuser.push(window, next(queue))
            np.testing.assert_array_equal(final, whole[done : done + len(final)])
            done += len(final)
            assert window.stop - done < 32
    rest = fuser.finish()
    np.testing.assert_array_equal(rest, whole[done:])
    assert done + len(rest) == num_frames


def test_errors_teach():
    poses = np.broadcast_to(np.eye(4), (32, 4, 4))
    cover = windows(56)
    with pytest.raises(ValueError, match="one for each of 1 results, got 2"):
        chain_cameras([poses], cover)
    with pytest.raises(ValueError, match="at least one, got none"):
        fuse_linear([], [])
    with pytest.raises(ValueError, match=r"expected shape \(32, 4, 4\), got \(31, 4, 4\)"):
        chain_cameras([poses, poses[1:]], cover)
    with pytest.raises(ValueError, match="rigid"):
        chain_cameras([poses, 2 * poses], cover)
    with pytest.raises(ValueError, match="no frame is shared"):
        chain_cameras([poses, poses], windows(64, 32, 0))
    with pytest.raises(ValueError, match="leaves no gap"):
        fuse_linear([poses, poses], [Window(0, 32), Window(33, 65)])
    with pytest.raises(ValueError, match="start at frame 0"):
        fuse_linear([poses], [Window(1, 33)])
    with pytest.raises(ValueError, match=r"expected shape \(32, 3\), got \(32, 2\)"):
        fuse_linear([np.zeros((32, 3)), np.zeros((32, 2))], cover)
    with pytest.raises(ValueError, match="'all' or 'first'"):
        CameraFuser("some")  # type: ignore[arg-type]
    fuser = OverlapFuser()
    fuser.push(cover[0], poses)
    fuser.finish()
    with pytest.raises(ValueError, match="finished"):
        fuser.push(cover[1], poses)
