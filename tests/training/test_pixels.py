"""Kept pictures: what is read is what decoding gives, and the file is whole or not there."""

import errno
import os
from dataclasses import replace

import numpy as np
import pytest
import torch

from mint_hub.geometry import hand_state
from mint_hub.geometry.camera import K_to_fov_vh, project
from mint_hub.geometry.lenses import OpenCVLens, rectification
from mint_hub.loaders.clips import encode_clip
from mint_hub.loaders.packing import packed_images
from mint_hub.loaders.schema import Episode
from mint_hub.loaders.shards import write_corpus
from mint_hub.loaders.video_source import VideoError
from mint_hub.model.processing_mint import MintProcessor
from mint_hub.synth.undo_lens import undo_lens
from mint_hub.training.augment import ColourAugmentation
from mint_hub.training.clips import find_splits
from mint_hub.training.data import PositionDataset, WindowSettings, open_windows
from mint_hub.training.pixels import PixelCache
from mint_hub.training.views import ViewAugmentation
from tests.training.corpus import WINDOW, config, training_episode, write_packed


@pytest.fixture
def windows(tmp_path):
    write_packed(tmp_path / "corpus", [training_episode(f"e{i}") for i in range(3)])
    settings = WindowSettings(length=WINDOW, stride=3)
    processor = MintProcessor.for_config(config())
    return open_windows(find_splits([tmp_path / "corpus"]), settings, processor)


@pytest.mark.parametrize("views", [None, ViewAugmentation()])
def test_kept_pictures_change_nothing(windows, tmp_path, views):
    kept = windows.cached(tmp_path / "kept", views is not None)
    colours = ColourAugmentation()
    for position in range(6):
        one = PositionDataset(windows, 6, colours, views)[position]
        other = PositionDataset(kept, 6, colours, views)[position]
        assert torch.equal(one["pixel_values"], other["pixel_values"])
        assert one["pixel_values"].shape[-2:] == (28, 42)
        assert torch.equal(one["labels"]["hand_state"], other["labels"]["hand_state"])


def test_the_file_serves_another_run_and_another_size_has_its_own(windows, tmp_path):
    folder = tmp_path / "kept"
    windows.cached(folder, views=False)
    (first,) = folder.iterdir()
    before = first.stat().st_mtime_ns
    windows.cached(folder, views=False)
    assert first.stat().st_mtime_ns == before
    windows.cached(folder, views=True)
    shapes = sorted(np.load(path, mmap_mode="r").shape[1:3] for path in folder.iterdir())
    assert shapes == [(28, 42), (42, 63)]


def test_nothing_is_left_of_a_file_that_could_not_be_made(windows, tmp_path, monkeypatch):
    def broken(*_):
        raise VideoError("mp4: damaged")

    monkeypatch.setattr("mint_hub.training.pixels.packed_images", broken)
    with pytest.raises(VideoError, match="damaged"):
        windows.cached(tmp_path / "kept", views=False)
    assert list((tmp_path / "kept").iterdir()) == []


def test_a_disk_without_room_for_the_file_is_told_before_it_is_filled(
    windows, tmp_path, monkeypatch
):
    """It is mapped: to write where there is no room would end the process without a word."""

    def full(descriptor, offset, size):
        assert os.fstat(descriptor).st_size == offset + size
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(OSError, match=r"No space left on device for \d+ bytes.*pixels-"):
        windows.cached(tmp_path / "kept", views=False)
    assert list((tmp_path / "kept").iterdir()) == []


SIZE_HW = (120, 160)
LENS = OpenCVLens(SIZE_HW, 90.0, 92.0, 82.0, 58.0, (-0.24, 0.04, 0.004, -0.003))


def bent_episode(key: str) -> Episode:
    """A right hand whose wrist is off the middle, labels those of the pinhole of rectifying."""
    episode = training_episode(key, image_size_hw=SIZE_HW, meta={"synth": {"lens": LENS.to_dict()}})
    count = episode.num_frames
    state = episode.hand_state.copy()
    state[:, 1, :3] = (0.32, 0.24, 0.5)
    fov = K_to_fov_vh(rectification(LENS).K, SIZE_HW).astype(np.float32)
    presence = np.tile([False, True], (count, 1))
    state = np.where(presence[..., None], state, hand_state.absent(presence.shape))
    made = replace(
        episode, hand_state=state, presence=presence, fov_vh_rad=np.tile(fov, (count, 1))
    )
    return replace(made, presence_score=None, filled=None)


def spots(episode: Episode) -> np.ndarray:
    """Pictures of a bright spot where the lens sees the wrist: (T, H, W, 3)."""
    wrist = episode.wrist_camera()[:, 1, :3, 3]
    v, u = np.mgrid[: SIZE_HW[0], : SIZE_HW[1]]
    x, y = np.moveaxis(LENS.project(wrist), -1, 0)[..., None, None]
    bright = 20 + 220 * np.exp(-((u - x) ** 2 + (v - y) ** 2) / 18)
    return np.repeat(bright[..., None], 3, -1).astype(np.uint8)


def seen_at(images: np.ndarray) -> np.ndarray:
    """Where the spot is, (T, 2), columns and rows from the middle of the first pixel."""
    bright = np.clip(images.mean(-1) - 60, 0, None)
    v, u = np.mgrid[: bright.shape[1], : bright.shape[2]]
    sums = [(bright * grid).sum((1, 2)) / bright.sum((1, 2)) for grid in (u, v)]
    return np.stack(sums, -1)


@pytest.fixture
def bent(tmp_path):
    episodes = [bent_episode("b0"), bent_episode("b1")]
    write_corpus(
        episodes,
        tmp_path / "corpus",
        "bent",
        "train",
        format="lossless",
        extra_members=lambda e: {"mp4": encode_clip(spots(e), fps=30.0, crf=12)},
    )
    processor = MintProcessor.for_config(config())
    settings = WindowSettings(length=WINDOW, stride=3)
    return open_windows(find_splits([tmp_path / "corpus"]), settings, processor)


def test_a_joint_lies_where_labels_project_in_rectified_pictures(bent, tmp_path):
    for number in range(len(bent)):
        window = bent.labels(number)
        uv, _ = project(window.wrist_camera()[:, 1, :3, 3], window.K)
        expected = uv - 0.5  # of which integers are pixels' middles
        assert np.abs(seen_at(bent.pictures(number)) - expected).max() < 0.5
        split, i, start = bent.places[number].tolist()
        stored = packed_images(bent.splits[split].reader, i, start, WINDOW)
        assert np.linalg.norm(seen_at(stored) - expected, axis=-1).min() > 5


def test_kept_pictures_are_rectified_and_in_a_file_of_their_own(bent, tmp_path):
    kept = bent.cached(tmp_path / "kept", views=False)
    for number in range(len(bent)):
        size_hw = bent.image_size_hw
        np.testing.assert_array_equal(kept.resized(number, size_hw), bent.resized(number, size_hw))
    (split,) = bent.splits
    resample = int(bent.processor.video_processor.resample)
    bare = PixelCache(tmp_path / "kept", split.folder, bent.image_size_hw, f"resample {resample}")
    assert not bare.made()  # what was kept before lenses were undone is not read


def test_pictures_of_another_size_than_their_lens_are_named():
    images = np.zeros((1, 60, 80, 3), np.uint8)
    with pytest.raises(ValueError, match=r"expected .*\(120, 160\) of the lens.*\(episode b0\)"):
        undo_lens(images, bent_episode("b0"))
