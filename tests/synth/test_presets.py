"""Presets: disjoint where they must be, and bench clips are known again in any form."""

import dataclasses

import numpy as np
import pytest

from mint_hub.geometry.hand_state import unpack
from mint_hub.synth.activities import TRAIN
from mint_hub.synth.activities_ood import OOD
from mint_hub.synth.camera_motion import median_steps
from mint_hub.synth.corruption import Corruption
from mint_hub.synth.episodes import labels_of
from mint_hub.synth.frozen import require_frozen
from mint_hub.synth.presets import (
    BENCH_CLIPS,
    PRESETS,
    bench_fingerprints,
    fingerprint,
    fingerprint_of,
    is_bench,
    rng_of,
    seed_of,
)
from mint_hub.synth.scene import make_world
from mint_hub.synth.teacher_noise import teacher_noise
from mint_hub.synth.things import KINDS_OOD, KINDS_TRAIN
from tests.episodes import make_episode


def test_ood_is_nothing_that_train_can_be():
    train, ood = PRESETS["train"], PRESETS["bench-ood"]
    assert not set(KINDS_TRAIN) & set(KINDS_OOD)
    assert not set(TRAIN) & set(OOD)
    for name in ("kinds", "activities", "surfaces", "paints", "sizes_hw"):
        assert not set(getattr(train, name)) & set(getattr(ood, name)), name
    for name in ("fov_h_deg", "hand_size"):
        for low, high in getattr(ood, name):
            assert all(high < a or low > b for a, b in getattr(train, name)), name
    for name in ("eye_up", "eye_aside", "other_shape"):
        assert getattr(ood, name)[0] > getattr(train, name)[1], name


def test_bench_differs_from_train_in_motion_alone():
    train, bench = PRESETS["train"], PRESETS["bench"]
    differ = {
        f.name
        for f in dataclasses.fields(train)
        if getattr(train, f.name) != getattr(bench, f.name)
    }
    assert differ == {"name", "stream", "clips", "sway", "least_step"}


def test_lively_clips_move_as_the_benches_do_and_are_others():
    lively, bench = PRESETS["train-lively"], PRESETS["bench"]
    assert dataclasses.replace(lively, name="", stream=0, clips=0) == dataclasses.replace(
        bench, name="", stream=0, clips=0
    )
    assert len({preset.stream for preset in PRESETS.values()}) == len(PRESETS)
    world = make_world(seed_of("train-lively", 0, 0), "train-lively")
    metres, degrees = median_steps(world.T_camera_from_world)
    assert metres >= 0.006
    assert degrees >= 0.6
    assert not is_bench(labels_of(world, None, Corruption()))


def test_seeds():
    many = [seed_of("train", seed, number) for seed in range(3) for number in range(200)]
    assert len(set(many)) == len(many)
    assert [seed_of("bench", seed, 7) for seed in (0, 5)] == [7, 7]
    with pytest.raises(ValueError, match="bench has 40 clips, got 40"):
        seed_of("bench", 0, BENCH_CLIPS)
    with pytest.raises(ValueError, match="seed: expected 0 or more, got -1"):
        seed_of("train", -1, 0)


def test_all_bench_clips_are_frozen():
    names = sorted(bench_fingerprints().values())
    assert names == sorted(f"{p}/{n}" for p in ("bench", "bench-ood") for n in range(BENCH_CLIPS))


def episode_like(world, **changes):
    """An episode with a world's field of view and hand shape."""
    made = make_episode(12, seed=1, key="e-1", **changes)
    state = made.hand_state.copy()
    there = world.hands.exists[0]
    shape = unpack(world.hands.hand_state[0, there][0]).shape_params
    state[..., -10:] = shape
    fov = np.tile(np.asarray(world.fov_vh_rad, np.float32), (12, 1))
    everywhere = np.ones((12, 2), bool)
    return dataclasses.replace(made, hand_state=state, fov_vh_rad=fov, presence=everywhere)


@pytest.mark.parametrize(("preset", "number"), [("bench", 0), ("bench-ood", 39)])
def test_bench_clips_are_refused_in_any_form(preset, number):
    episode = episode_like(make_world(number, preset, 2))
    assert bench_fingerprints()[fingerprint(episode)] == f"{preset}/{number}"
    assert is_bench(episode)
    assert is_bench(episode.window(3, 5))
    assert is_bench(teacher_noise(episode, 4).window(0, 6))


def test_other_labels_of_a_bench_clip_are_known_by_its_name():
    other = make_episode(4, seed=2, key="synth-bench-ood-1f")
    assert is_bench(other)
    assert is_bench(dataclasses.replace(other, key="a", meta={"uid": "synth-bench-3"}))
    assert not is_bench(dataclasses.replace(other, key="synth-train-3"))


@pytest.mark.parametrize(("preset", "number"), [("bench", 5), ("bench-ood", 22)])
def test_benches_are_what_was_frozen(preset, number):
    world = make_world(number, preset)
    episode = labels_of(world, None, Corruption())
    require_frozen(preset, number, episode)
    moved = world.T_camera_from_world.copy()
    moved[10, 0, 3] += 0.01
    with pytest.raises(ValueError, match=f"{preset}/{number}: expected the clip of generator"):
        require_frozen(preset, number, dataclasses.replace(episode, T_camera_from_world=moved))
    with pytest.raises(ValueError, match="expected the clip of generator"):
        require_frozen(preset, number, episode.window(0, world.num_frames - 1))


def test_streams_of_a_clip_are_apart():
    """Also those of small seeds, whose words numpy would pad with zeros."""
    for seed in (0, 3, 1 << 40):
        first = [rng_of("train", seed, *more).random() for more in ((), (0,), (1,), (7,))]
        assert len(set(first)) == 4
    assert rng_of("train", 3).random() != rng_of("bench", 3).random()


def test_a_bench_clip_is_known_by_its_meta_alone():
    plain = make_episode(4, seed=2, key="e-2")
    assert not is_bench(plain)
    noted = dataclasses.replace(plain, meta={"synth": {"preset": "bench", "seed": 3}})
    assert is_bench(noted)


def test_train_clips_are_not_refused():
    assert not is_bench(episode_like(make_world(0, "train", 2)))


def test_fingerprints_depend_on_both_numbers():
    shape = np.zeros(10)
    marks = {
        fingerprint_of(1.0, shape),
        fingerprint_of(1.0 + 2**-19, shape),
        fingerprint_of(1.0, shape + 2**-13),
        fingerprint_of(1.0, []),
    }
    assert len(marks) == 4
