"""Kept pictures: what is read is what decoding gives, and the file is whole or not there."""

import numpy as np
import pytest
import torch

from mint_hub.loaders.video_source import VideoError
from mint_hub.model.processing_mint import MintProcessor
from mint_hub.training.augment import ColourAugmentation
from mint_hub.training.clips import find_splits
from mint_hub.training.data import PositionDataset, WindowSettings, open_windows
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
