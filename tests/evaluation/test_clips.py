"""A clip's camera and its stamps: what makes two truths, or two predictions, the same."""

from dataclasses import replace

import numpy as np
import pytest

from mint_hub.evaluation.benchmarks import open_benchmark
from mint_hub.evaluation.clips import PackedFrames, Source
from mint_hub.evaluation.scoring import ClipScorer
from mint_hub.geometry.lenses import OpenCVLens
from mint_hub.loaders.clips import PackedClip, encode_clip
from mint_hub.synth.undo_lens import undo_lens
from tests.evaluation_data import noisy, save_all, true_episode


@pytest.fixture(scope="module")
def truth():
    return [true_episode(0)]


@pytest.fixture(scope="module")
def source(truth, tmp_path_factory):
    return Source("labels", str(save_all(truth, tmp_path_factory.mktemp("truth"))))


def clip_of(source):
    return open_benchmark(source).clip(0)


def test_truth_that_zooms_is_scored_with_a_camera_a_frame(truth, tmp_path):
    fov = np.array(truth[0].fov_vh_rad)
    fov[30:] += 0.1
    zooming = replace(truth[0], fov_vh_rad=fov)
    source = Source("labels", str(save_all([zooming], tmp_path / "zoom")))
    clip = clip_of(source)
    np.testing.assert_allclose(clip.K, zooming.K)
    score = ClipScorer(clip).score(zooming)
    for name in ("published", "predicted", "known"):
        assert score.hands[name].metrics()["EPE-p"] == pytest.approx(0, abs=1e-6)
    assert score.fov_error_deg == pytest.approx(0, abs=1e-4)
    views = [name for name in score.strata if name.startswith("field of view")]
    assert sum(score.strata[name].tp for name in views) == score.hands["published"].tp
    part = clip.window(20, 20)
    assert part.K.shape == (20, 3, 3)
    assert ClipScorer(part).score(zooming.window(20, 20)).hands["published"].tp > 0
    assert clip_of(Source("labels", str(save_all(truth[:1], tmp_path / "still")))).K.shape == (3, 3)


def test_truth_stamp_follows_truth_camera_and_hand_but_no_last_bit(source, truth):
    clip = clip_of(source)
    stamp = clip.truth_stamp()
    assert stamp == clip_of(source).truth_stamp()
    hand = clip.hand_model.right
    bent = replace(hand, shape_directions=hand.shape_directions * 1.1)
    others = [
        replace(clip, truth=noisy(truth[0], 0.001)),
        replace(clip, K=clip.K + 0.5),
        replace(clip, image_size_hw=(1, 1)),
        replace(clip, hands=False),
        replace(clip, visible=np.full(truth[0].presence.shape, 0.5, np.float32)),
        replace(clip, hand_model=replace(clip.hand_model, right=bent)),
    ]
    assert len({stamp, *(other.truth_stamp() for other in others)}) == 1 + len(others)
    T = truth[0].T_camera_from_world
    shaken = replace(truth[0], T_camera_from_world=T + 1e-13 * np.eye(4, k=3))
    assert not np.array_equal(shaken.T_camera_from_world, T)
    assert replace(clip, truth=shaken).truth_stamp() == stamp


def test_other_pictures_are_the_same_truth_but_another_prediction(source):
    clip = clip_of(source)
    one, two = (replace(clip, frames=PackedFrames(data, clip.truth)) for data in (b"one", b"two"))
    assert one.truth_stamp() == two.truth_stamp() == clip.truth_stamp()
    assert len({one.stamp(), two.stamp(), clip.stamp()}) == 3


def test_a_network_sees_a_lens_clip_as_its_labels_do(truth):
    size = (96, 128)
    lens = OpenCVLens(size, 90.0, 90.0, 63.5, 47.5, (-0.2, 0.05, 0.004, -0.003))
    rng = np.random.default_rng(0)
    mp4 = encode_clip(list(rng.integers(0, 255, (5, *size, 3), np.uint8)), crf=10)
    bent = replace(truth[0], meta={**truth[0].meta, "synth": {"lens": lens.to_dict()}})
    with PackedClip(mp4) as clip:
        stored = clip.images()
    seen = np.stack(list(PackedFrames(mp4, bent).images(1)))
    np.testing.assert_array_equal(seen, undo_lens(stored, bent)[1:])
    assert not np.array_equal(seen, stored[1:])
    plain = PackedFrames(mp4, truth[0])
    np.testing.assert_array_equal(np.stack(list(plain.images())), stored)
    assert plain.stamp() != PackedFrames(mp4, bent).stamp()
