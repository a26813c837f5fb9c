"""A checkpoint that is evaluated: run on the clip's pictures, kept, told the lens if asked to."""

from dataclasses import asdict, replace

import numpy as np
import pytest

from mint_hub.cli import main
from mint_hub.evaluation import predictor as predictor_module
from mint_hub.evaluation.benchmarks import open_benchmark
from mint_hub.evaluation.clips import BenchmarkError, Source
from mint_hub.evaluation.evaluate import evaluate
from mint_hub.evaluation.predictor import OpenCheckpoint, Predictor
from mint_hub.evaluation.results import efficiency_of
from mint_hub.evaluation.tables import efficiency_line
from mint_hub.inference.runner import MintRunner
from tests.small_model import small_model
from tests.training.corpus import still, training_episode, write_packed


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    episodes = [still(training_episode(f"e{i}")) for i in range(2)]
    return Source("shards", str(write_packed(tmp_path_factory.mktemp("corpus"), episodes)))


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    folder = tmp_path_factory.mktemp("checkpoint")
    small_model(window=4).save_pretrained(folder)
    return str(folder)


def opened(checkpoint, **options) -> OpenCheckpoint:
    made = Predictor.of(checkpoint, **options).open()
    assert isinstance(made, OpenCheckpoint)
    return made


def numbers_of(value) -> list[float]:
    """All numbers of nested dictionaries and sequences, in order."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list | tuple | np.ndarray):
        return [number for part in value for number in numbers_of(part)]
    return [float(value)] if isinstance(value, int | float) else []


def test_a_prediction_is_kept_until_weights_options_or_code_change(
    source, checkpoint, tmp_path, monkeypatch
):
    clip = open_benchmark(source).clip(0)
    first = opened(checkpoint, cache_dir=str(tmp_path)).predict(clip)
    again = opened(checkpoint, cache_dir=str(tmp_path)).predict(clip)
    assert first.seconds is not None
    assert again.seconds is None
    assert again.episode.allclose(first.episode)
    told = opened(checkpoint, cache_dir=str(tmp_path), known_camera=True)
    assert told.predict(clip).seconds is not None
    assert told.facts["known_camera"]
    monkeypatch.setattr(predictor_module, "_code_hash", lambda: "other")
    assert opened(checkpoint, cache_dir=str(tmp_path)).predict(clip).seconds is not None


def test_the_true_lens_is_told_in_pixels_of_the_pictures(source, checkpoint, monkeypatch):
    """Of a clip whose pictures are smaller than its labels say; a lens that zooms is refused."""
    given = []
    run = MintRunner.run

    def noted(self, images, settings, camera=None, **options):
        given.append(camera)
        return run(self, images, settings, camera=camera, **options)

    monkeypatch.setattr(MintRunner, "run", noted)
    clip = open_benchmark(source).clip(0)
    episode = opened(checkpoint, known_camera=True).predict(clip).episode
    np.testing.assert_allclose(episode.fov_vh_rad, clip.truth.fov_vh_rad, rtol=1e-5)
    height, width = next(iter(clip.frames.images())).shape[:2]
    K = (
        clip.truth.K[0]
        * (np.array([width, height, 1]) / [*clip.truth.image_size_hw[::-1], 1])[:, None]
    )
    np.testing.assert_allclose(given[0], K, rtol=1e-5)
    assert opened(checkpoint).predict(clip).episode.fov_vh_rad[0, 1] != clip.truth.fov_vh_rad[0, 1]
    assert given[1] is None
    zooming = clip.truth.fov_vh_rad + np.linspace(0, 0.1, clip.truth.num_frames)[:, None]
    zooming = replace(clip, truth=replace(clip.truth, fov_vh_rad=zooming.astype(np.float32)))
    with pytest.raises(BenchmarkError, match=r"e0: expected one horizontal field of view.*got"):
        opened(checkpoint, known_camera=True).predict(zooming)


def test_processes_give_the_same_and_labels_are_told_nothing(source, checkpoint, tmp_path, capsys):
    one, two = (evaluate(source, Predictor.of(checkpoint), jobs=jobs) for jobs in (1, 2))
    assert one.prediction is not None
    for count, said in (
        (1, "frames/s), over 9 frames"),
        (2, "in each of 2 processes side by side"),
    ):
        told = efficiency_of(one.clips, one.prediction, count)
        assert told is not None
        assert said in efficiency_line(told)
    for a, b in zip(one.clips, two.clips, strict=True):
        a, b = (numbers_of(asdict(clip.scores["prediction"])) for clip in (a, b))
        assert len(a) > 20
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6)
    labels = opened(checkpoint).predict(open_benchmark(source).clip(0)).episode
    labels.save(tmp_path / f"{labels.key}.npz")
    arguments = ["evaluate", str(tmp_path), "--on", "shards", source.root, "--known-camera"]
    assert main(arguments) == 2
    assert "--known-camera: expected with a checkpoint, got labels" in capsys.readouterr().err
