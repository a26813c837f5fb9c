"""Sequences cut to a length: one recording stays one, and is read once."""

from dataclasses import replace

import numpy as np
import pytest

from mint_hub.evaluation.bench_shards import LabelsBenchmark
from mint_hub.evaluation.benchmarks import open_benchmark
from mint_hub.evaluation.clips import BenchmarkError, Frames, Source
from mint_hub.evaluation.compare import compare
from mint_hub.evaluation.evaluate import evaluate
from mint_hub.evaluation.predictor import Predictor
from mint_hub.evaluation.results import Results
from mint_hub.evaluation.tables import all_tables
from mint_hub.loaders.clips import encode_clip
from mint_hub.loaders.packing import MP4
from mint_hub.loaders.shards import write_corpus
from tests.evaluation_data import moved, noisy, save_all, true_episode


def evaluated(truth, labels, folder, clip_frames):
    source = Source("labels", str(save_all(truth, folder / "truth")), clip_frames=clip_frames)
    return evaluate(source, Predictor.of(str(save_all(labels, folder / "labels"))))


def test_windows_of_one_recording_prove_nothing(tmp_path):
    truth = [true_episode(0, 300)]
    a, b = (
        evaluated(truth, [moved(noisy(truth[0], 0.002), m)], tmp_path / str(m), 25)
        for m in (0.01, 0.03)
    )
    assert len(a.clips) == 12
    assert {clip.recording for clip in a.clips} == {"clip-0"}
    value, low, high = a.summary["prediction"]["hands"]["published"]["CT-p"]
    assert np.isfinite(value)
    assert np.isnan([low, high]).all()
    found = compare(a, b)
    assert (found.clips, found.recordings) == (12, 1)
    assert not any(d.better for d in found.differences)
    assert all(np.isnan([d.p, d.low, d.high]).all() for d in found.differences)
    assert "12 clips (windows of 1 recording)" in found.markdown()
    again = Results.load(a.save(tmp_path / "a.json"))
    assert again.clips[3].part_of == "clip-0"


def test_recordings_give_the_test_one_value_each(tmp_path):
    truth = [true_episode(i, 50) for i in range(7)]
    a, b = (
        evaluated(
            truth,
            [moved(noisy(e, 0.001, i), m) for i, e in enumerate(truth)],
            tmp_path / str(m),
            25,
        )
        for m in (0.01, 0.03)
    )
    wrist = next(d for d in compare(a, b).differences if d.name == "CT-p")
    assert (wrist.clips, wrist.recordings) == (14, 7)
    assert wrist.p == pytest.approx(2 / 2**7)
    assert 0 < wrist.low <= wrist.b - wrist.a <= wrist.high


def test_labels_of_another_length_are_refused(tmp_path):
    truth, long = true_episode(0, 60), true_episode(0, 70)
    with pytest.raises(BenchmarkError, match=r"clip-0: expected labels of 60 frames.*got 70"):
        evaluated([truth], [long], tmp_path, 30)


def test_a_clip_is_read_once_for_all_its_windows(tmp_path, monkeypatch):
    source = Source(
        "labels", str(save_all([true_episode(i, 90) for i in range(2)], tmp_path)), clip_frames=9
    )
    reads, plain = [], LabelsBenchmark.clip

    def counted(self, i):
        reads.append(i)
        return plain(self, i)

    monkeypatch.setattr(LabelsBenchmark, "clip", counted)
    benchmark = open_benchmark(source)
    assert len(benchmark) == 20
    assert benchmark.num_frames(3) == 9
    assert reads == []
    keys = [clip.key for clip in benchmark]
    assert reads == [0, 1]
    assert keys[11] == "clip-1-000009"


class Counted(Frames):
    """Ninety pictures, whose grey is their number."""

    def __init__(self):
        self.decoded = 0

    def images(self, start=0):
        for k in range(start, 90):
            self.decoded += 1
            yield np.full((2, 2, 3), k, np.uint8)

    def stamp(self):
        return ""


def test_a_window_decodes_its_own_pictures_alone(tmp_path):
    source = Source("labels", str(save_all([true_episode(0, 90)], tmp_path)))
    frames = Counted()
    whole = replace(open_benchmark(source).clip(0), frames=frames)
    greys = [
        int(image[0, 0, 0])
        for start in range(0, 90, 9)
        for image in whole.window(start, 9).frames.images()
    ]
    assert greys == list(range(90))
    assert frames.decoded == 90
    assert [int(i[0, 0, 0]) for i in whole.window(18, 9).frames.images(7)] == [25, 26]


def test_packed_pictures_start_anywhere_and_lengths_come_from_the_index(tmp_path):
    pictures = [np.full((32, 32, 3), 5 * k, np.uint8) for k in range(40)]
    write_corpus(
        [true_episode(0, 40)],
        tmp_path / "corpus",
        "c",
        "validation",
        format="lossless",
        extra=True,
        extra_members=lambda e: {MP4: encode_clip(pictures, fps=e.fps)},
    )
    benchmark = open_benchmark(Source("shards", str(tmp_path / "corpus"), clip_frames=15))
    assert [benchmark.num_frames(i) for i in range(3)] == [15, 15, 10]
    assert (benchmark.source.config, benchmark.source.split) == ("c", "validation")
    greys = [image[0, 0, 0] for image in benchmark.clip(2).frames.images(3)]
    np.testing.assert_allclose(greys, 5 * np.arange(33, 40), atol=3)


def test_camera_tables_say_that_sequences_were_cut(tmp_path):
    truth = [true_episode(i, 40) for i in range(2)]
    cut, whole = (
        evaluated(truth, [noisy(e, 0.01) for e in truth], tmp_path / str(n), n) for n in (20, None)
    )
    for results, told in ((cut, True), (whole, False)):
        notes = [t.note for t in all_tables(results) if t.title.startswith("Camera path")]
        assert len(notes) == 3
        assert all(("window of 20 frames is a path of its own" in n) == told for n in notes)
