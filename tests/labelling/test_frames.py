"""Frames of a clip are those of its stretch of the file, by streaming and by picking."""

from pathlib import Path

import numpy as np
import pytest

from mint_hub.labelling.frames import clip_frames, clip_pictures
from mint_hub.labelling.records import Clip
from mint_hub.labelling.stage import StageError
from mint_hub.loaders.video import VideoError
from tests import video_files as make


@pytest.fixture(scope="module")
def file(tmp_path_factory) -> Path:
    return make.video(tmp_path_factory.mktemp("frames") / "a.mp4", 30, options={"bf": "2"})


def clip(file: Path, first: int = 0, count: int = 30, size=(48, 64)) -> Clip:
    return Clip("a-0", file, first, size, 30.0, np.arange(count) / 30 + 100.0)


@pytest.mark.parametrize(("first", "count"), [(0, 30), (7, 5), (29, 1), (11, 19)])
def test_a_clip_is_its_stretch_of_the_file(file, first, count):
    shown = [make.frame_number(image) for image in clip_frames(clip(file, first, count))]
    assert shown == list(range(first, first + count))


def test_part_of_a_clip(file):
    images = list(clip_frames(clip(file, 5, 20), 3, 6))
    assert [make.frame_number(image) for image in images] == [8, 9, 10]
    assert images[0].shape == (48, 64, 3)
    assert images[0].dtype == np.uint8


def test_picked_frames(file):
    images = clip_pictures(clip(file, 5, 20), [0, 2, 2, 19])
    assert [make.frame_number(image) for image in images] == [5, 7, 7, 24]


def test_files_that_do_not_fit(file, tmp_path):
    with pytest.raises(StageError, match=r"expected 40 frames .* got 30"):
        list(clip_frames(clip(file, 0, 40)))
    with pytest.raises(StageError, match=r"frame 39 of clip a-0"):
        clip_pictures(clip(file, 0, 40), [0, 39])
    for use in (lambda c: list(clip_frames(c)), lambda c: clip_pictures(c, [0])):
        with pytest.raises(StageError, match=r"\(64, 48\)"):
            use(clip(file, size=(64, 48)))
        with pytest.raises(VideoError, match="missing"):
            use(clip(tmp_path / "missing.mp4"))


def test_frames_that_a_clip_does_not_have(file):
    for start, stop in ((-1, 3), (3, 3), (0, 31)):
        with pytest.raises(ValueError, match="expected 0 <= start < stop <= 30"):
            clip_frames(clip(file), start, stop)
    for frames in ([], [3, 2], [30]):
        with pytest.raises(ValueError, match="expected"):
            clip_pictures(clip(file), frames)
