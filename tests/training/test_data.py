"""Windows of a corpus: what they hold, which there are, and what is refused."""

import pickle
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from mint_hub.geometry import camera_state
from mint_hub.loaders.clips import encode_clip
from mint_hub.loaders.video_source import VideoError
from mint_hub.model.processing_mint import MintProcessor
from mint_hub.synth import presets
from mint_hub.synth.teacher_noise import TeacherNoise
from mint_hub.training import clips
from mint_hub.training.augment import ColourAugmentation
from mint_hub.training.clips import DataError, evaluation_clip, find_splits
from mint_hub.training.data import (
    PositionDataset,
    WindowSettings,
    collate,
    labels_of,
    open_windows,
)
from mint_hub.training.normalisation import reanchored
from tests.training.corpus import WINDOW, config, pictures, training_episode, write_packed

SETTINGS = WindowSettings(length=WINDOW, stride=WINDOW)


def processor() -> MintProcessor:
    return MintProcessor.for_config(config())


@pytest.fixture(scope="module")
def corpus(tmp_path_factory):
    """Two sources: two long episodes of two people, and three short ones of one."""
    folder = tmp_path_factory.mktemp("data") / "corpus"
    metas = [{"participant": f"P{i}"} for i in range(2)] + [{"source": "other"}] * 3
    episodes = [
        training_episode(f"e{i}", 13 if i < 2 else 6, meta=meta) for i, meta in enumerate(metas)
    ]
    return write_packed(folder, episodes)


def windows_of(corpus, settings=SETTINGS, **options):
    return open_windows(find_splits([corpus], **options), settings, processor())


def test_windows_never_cross_episodes(corpus):
    windows = windows_of(corpus)
    assert windows.sources == ("made", "other")
    assert windows.sizes == (6, 3)
    starts = {tuple(place[1:]) for place in windows.places.tolist()}
    reader = windows.splits[0].reader
    expected = {
        (i, s) for i in range(5) for s in ((0, 4, 8) if reader.num_frames[i] == 13 else (0,))
    }
    assert starts == expected


def test_an_example_is_its_pictures_and_labels(corpus):
    windows = windows_of(corpus)
    for number in (1, 7):
        split, i, start = windows.places[number].tolist()
        episode = windows.splits[split].reader[i]
        example = windows.example(number)
        assert example["pixel_values"].shape == (WINDOW, 3, 28, 42)
        drawn = pictures(episode)[start : start + WINDOW]
        seen = windows.pictures(number)
        assert np.abs(seen.astype(int) - drawn).mean() < 12  # the video is lossy
        labels = example["labels"]
        part = episode.window(start, WINDOW)
        camera = camera_state.unpack(labels["pose_encoding"].double())
        poses = camera.T_camera_from_world().numpy()
        np.testing.assert_allclose(poses, reanchored(part.T_camera_from_world), atol=1e-6)
        np.testing.assert_allclose(poses[0], np.eye(4), atol=1e-12)
        np.testing.assert_array_equal(labels["hand_state"], part.hand_state)
        np.testing.assert_array_equal(labels["presence"], part.presence)
        assert labels["velocity_std"].tolist() == pytest.approx(windows.scales.velocity.tolist())


def test_presence_learns_visible_shares_of_synthetic_clips_alone():
    episode = training_episode("e0")
    plain = labels_of(episode, "visible")["presence_target"]
    assert torch.equal(plain, torch.tensor(episode.presence, dtype=torch.float32))
    synthetic = replace(episode, meta={**episode.meta, "synth": {"preset": "train"}})
    target = labels_of(synthetic, "visible")["presence_target"].numpy()
    np.testing.assert_array_equal(target, episode.presence_score)
    target = labels_of(synthetic, "presence")["presence_target"].numpy()
    np.testing.assert_array_equal(target, episode.presence)


def test_records_without_hands_say_so():
    episode = training_episode("e0")
    blind = replace(episode, meta={**episode.meta, "quality": {"hands": "unavailable: needs MANO"}})
    assert not labels_of(blind, "presence")["hands_known"]
    assert labels_of(episode, "presence")["hands_known"]


def test_strata_are_capped_and_sources_weighted(corpus):
    capped = windows_of(corpus, replace(SETTINGS, cap_per_stratum=2))
    assert capped.sizes == (4, 2)  # two people of two windows each, and one stratum
    weighted = windows_of(corpus, replace(SETTINGS, mixture={"other": 1.0}))
    assert {weighted.order().window(p) for p in range(20)} == {6, 7, 8}
    with pytest.raises(ValueError, match="expected sources of"):
        windows_of(corpus, replace(SETTINGS, mixture={"ego4d": 1.0})).order()


def test_the_same_position_gives_the_same_example(corpus):
    windows = windows_of(corpus)
    one = PositionDataset(windows, 30, ColourAugmentation())
    other = pickle.loads(
        pickle.dumps(PositionDataset(windows_of(corpus), 30, ColourAugmentation()))
    )
    for position in (3, 17):
        first, second = one[position], other[position]
        assert torch.equal(first["pixel_values"], second["pixel_values"])
        assert torch.equal(first["labels"]["pose_encoding"], second["labels"]["pose_encoding"])
    plain = PositionDataset(windows, 30)
    assert torch.equal(
        plain[0]["pixel_values"], windows.example(plain._order.window(0))["pixel_values"]
    )
    assert not torch.equal(one[0]["pixel_values"], plain[0]["pixel_values"])
    with pytest.raises(IndexError, match="0 to 29"):
        one[30]


def test_augmentation_changes_colours_within_bounds():
    pixels = torch.rand(3, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    augment = ColourAugmentation()
    once, again, other = (augment(pixels, np.random.default_rng(s)) for s in (1, 1, 2))
    assert torch.equal(once, again)
    assert not torch.equal(once, other)
    assert once.min() >= 0
    assert once.max() <= 1
    quiet = ColourAugmentation(0, 0, 0, 0, 0, 0, 0)
    torch.testing.assert_close(quiet(pixels, np.random.default_rng(1)), pixels)


def test_batches_stack_examples(corpus):
    windows = windows_of(corpus)
    batch = collate([windows.example(0), windows.example(1)])
    assert batch["pixel_values"].shape == (2, WINDOW, 3, 28, 42)
    assert batch["labels"]["hand_state"].shape == (2, WINDOW, 2, 109)
    assert batch["labels"]["translation_std"].shape == (2, 3)


def test_noise_on_labels_is_the_same_every_time(corpus):
    exact, noisy = windows_of(corpus), windows_of(corpus, noise=TeacherNoise(), seed=3)
    again = windows_of(corpus, noise=TeacherNoise(), seed=3)
    assert not noisy.labels(0).allclose(exact.labels(0))
    assert noisy.labels(0).allclose(again.labels(0))
    assert noisy.content != exact.content
    assert not np.allclose(noisy.scales.translation, exact.scales.translation)
    assert np.array_equal(noisy.pictures(0), exact.pictures(0))


def test_a_survey_is_made_once(corpus, tmp_path, monkeypatch):
    splits = find_splits([corpus])
    first = splits[0].survey(WINDOW, WINDOW, tmp_path)
    monkeypatch.setattr(clips, "evaluation_clip", lambda _: pytest.fail("looked again"))
    again = find_splits([corpus])[0].survey(WINDOW, WINDOW, tmp_path)
    assert again.rows == first.rows
    np.testing.assert_array_equal(again.sums.values, first.sums.values)
    (file,) = tmp_path.iterdir()
    file.write_text("{}")
    with pytest.raises(DataError, match="delete it"):
        splits[0].survey(WINDOW, WINDOW, tmp_path)


# --- refused --------------------------------------------------------------------------------------


def test_evaluation_clips_are_known(monkeypatch):
    episode = training_episode("e0")
    assert evaluation_clip(episode) is None
    assert len(presets.bench_fingerprints()) > 0
    clip = training_episode("b", gaps=False)  # says nothing of a bench, but its numbers do
    frozen = {presets.fingerprint(clip): "bench/0"}
    monkeypatch.setattr(presets, "bench_fingerprints", lambda: frozen)
    assert evaluation_clip(clip) == "a synthetic bench"
    assert evaluation_clip(episode) is None
    for meta, name in (
        ({"source": "hot3d"}, "HOT3D"),
        ({"source": "ARCTIC"}, "ARCTIC"),
        ({"uid": "arctic/s05/box_use"}, "ARCTIC"),
    ):
        assert evaluation_clip(replace(episode, meta={**episode.meta, **meta})) == name
    synth = {**episode.meta, "synth": {"preset": "bench-ood"}}
    assert evaluation_clip(replace(episode, meta=synth)) == "a synthetic bench"


def test_evaluation_clips_are_refused_unless_forced(tmp_path):
    episodes = [training_episode("e0"), training_episode("h", meta={"source": "hot3d"})]
    folder = write_packed(tmp_path, episodes)
    with pytest.raises(DataError, match=r"1 of 2 .*first h \(HOT3D\).*--allow-evaluation-clips"):
        windows_of(folder)
    forced = windows_of(folder, replace(SETTINGS, allow_evaluation_clips=True))
    assert "hot3d" in forced.sources


def test_no_data(tmp_path):
    with pytest.raises(DataError, match="expected a corpus folder, got none"):
        find_splits([])
    with pytest.raises(DataError, match="found no folder"):
        find_splits([tmp_path / "nowhere"])
    with pytest.raises(DataError, match="expected a corpus with a train split"):
        find_splits([tmp_path])


def test_episodes_of_one_frame(tmp_path):
    folder = write_packed(tmp_path, [training_episode("one", 1)])
    with pytest.raises(DataError, match=r"at least 4 frames.*found 1 episodes, all shorter"):
        windows_of(folder)
    folder = write_packed(tmp_path / "more", [training_episode("one", 1), training_episode("two")])
    assert windows_of(folder).warnings == ("1 of 2 episodes are shorter than a window",)


def test_labels_that_hold_nan(tmp_path):
    """A shard that came to hold NaN is refused when it is surveyed, naming the episode."""
    episode = training_episode("e0")
    folder = write_packed(tmp_path, [episode])
    (shard,) = folder.rglob("*.tar")
    data = shard.read_bytes()
    number = episode.hand_state[2, 1, 0].tobytes()
    assert number in data
    shard.write_bytes(data.replace(number, np.float32(np.nan).tobytes()))
    with pytest.raises(ValueError, match=r"NaN|finite.*e0|e0.*finite"):
        windows_of(folder)


def test_missing_and_damaged_videos(tmp_path):
    unpacked = write_packed(tmp_path / "labels", [training_episode("e0")], packed=False)
    with pytest.raises(DataError, match=r"found labels alone; pack them.*--videos"):
        windows_of(unpacked)
    with pytest.raises(VideoError, match=r"1 of 1 videos are missing; .*e0"):
        windows_of(unpacked, replace(SETTINGS, videos=str(tmp_path)))
    folder = write_packed(tmp_path / "packed", [training_episode("e0")])
    (shard,) = folder.rglob("*.tar")
    data = bytearray(shard.read_bytes())
    at = data.index(b"ftyp")
    data[at - 4 : at + 1200] = bytes(1204)
    shard.write_bytes(data)
    windows = windows_of(folder)
    with pytest.raises(VideoError):
        windows.example(0)


def test_videos_beside_the_labels(tmp_path):
    """A corpus of labels alone trains with the user's own videos."""
    episode = training_episode("e0", image_size_hw=(56, 84))
    unpacked = write_packed(tmp_path / "labels", [episode], packed=False)
    video = tmp_path / "videos" / "e0.mp4"
    video.parent.mkdir()
    video.write_bytes(encode_clip(pictures(episode), fps=30.0, crf=18))
    windows = windows_of(unpacked, replace(SETTINGS, videos=str(video.parent)))
    seen = windows.pictures(1)
    assert np.abs(seen.astype(int) - pictures(episode)[WINDOW : 2 * WINDOW]).mean() < 12
    assert windows.example(1)["pixel_values"].shape == (WINDOW, 3, 28, 42)


def test_settings_out_of_range():
    with pytest.raises(ValueError, match="cap_per_stratum: expected at least 1"):
        WindowSettings(cap_per_stratum=0)


def test_moving_a_corpus_changes_nothing(corpus, tmp_path):
    moved = shutil.copytree(corpus, tmp_path / "moved")
    assert windows_of(moved).content == windows_of(corpus).content
