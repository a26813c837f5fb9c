"""The verbs that measure, as a user calls them: labels, a checkpoint, two of either."""

import json
import shutil
import sys

import numpy as np
import pytest

from mint_hub.cli import main
from mint_hub.evaluation.clips import Source
from mint_hub.evaluation.predictor import OpenCheckpoint, Predictor
from mint_hub.evaluation.results import ClipResult, efficiency_of
from mint_hub.loaders.clips import encode_clip
from mint_hub.loaders.packing import MP4
from mint_hub.loaders.shards import write_corpus
from mint_hub.model.processing_mint import MintProcessor
from tests.evaluation_data import moved, noisy, save_all, true_episode
from tests.small_model import small_model

FRAMES = 20


def coloured_clip(episode):
    rng = np.random.default_rng(len(episode.key))
    pictures = rng.integers(0, 255, (episode.num_frames, 48, 64, 3), np.uint8)
    return {MP4: encode_clip(list(pictures), fps=episode.fps)}


@pytest.fixture(scope="module")
def truth():
    return [true_episode(i, FRAMES) for i in range(3)]


@pytest.fixture(scope="module")
def corpus(truth, tmp_path_factory):
    folder = tmp_path_factory.mktemp("cli") / "corpus"
    options = {"format": "lossless", "extra": True, "extra_members": coloured_clip}
    write_corpus(truth, folder, "c", "validation", **options)
    return str(folder)


@pytest.fixture(scope="module")
def labels(truth, tmp_path_factory):
    made = [noisy(e, 0.01) for e in truth]
    return str(save_all(made, tmp_path_factory.mktemp("labels")))


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    folder = tmp_path_factory.mktemp("model") / "small"
    model = small_model()
    model.save_pretrained(folder)
    MintProcessor.for_config(model.config).save_pretrained(folder)
    return str(folder)


def test_labels_are_scored_and_written(corpus, labels, tmp_path, capsys):
    call = ["evaluate", labels, "--on", "shards", corpus, "-o", str(tmp_path), "--quiet"]
    assert main([*call, "--name", "mine"]) == 0
    out = capsys.readouterr().out
    heads = next(line for line in out.splitlines() if line.startswith("Hands in the camera frame"))
    assert heads.split("  ")[1] == "mine"
    assert "always present" in heads
    assert out.count("\nRPE-T mean (mm)") == 1
    assert "| mine |" in (tmp_path / "tables.md").read_text()
    values = json.loads((tmp_path / "results.json").read_text())
    assert values["benchmark"]["clips"] == 3
    assert values["prediction"] == {"name": "mine", "kind": "labels", "episodes": 3}
    assert (tmp_path / "report.html").stat().st_size > 10_000


def test_a_checkpoint_is_run_once_and_then_read(corpus, checkpoint, tmp_path, capsys, monkeypatch):
    cache = tmp_path / "cache"
    call = ["evaluate", checkpoint, "--on", "shards", corpus, "--quiet", "--cache", str(cache)]
    call += ["--device", "cpu", "--window", "8", "--overlap", "2"]
    assert main([*call, "-o", str(tmp_path / "a")]) == 0
    kept = sorted(cache.rglob("*.npz"))
    assert len(kept) == 3
    first = json.loads((tmp_path / "a/results.json").read_text())
    assert first["prediction"]["settings"]["window"] == 8
    assert first["efficiency"]["frames"] == 2 * FRAMES
    assert [clip["warm_up"] for clip in first["clips"]] == [True, False, False]
    assert len(first["prediction"]["weights"]) == 16
    from mint_hub.inference.runner import MintRunner

    def never(*args, **kwargs):
        raise AssertionError("the cache was not used")

    with monkeypatch.context() as patch:
        patch.setattr(MintRunner, "run", never)
        assert main([*call, "-o", str(tmp_path / "b")]) == 0
    second = json.loads((tmp_path / "b/results.json").read_text())
    assert second["rows"] == first["rows"]
    assert second["efficiency"] is None
    call[call.index("8")] = "10"
    assert main([*call, "-o", str(tmp_path / "c")]) == 0
    assert len(list(cache.rglob("*.npz"))) == 6
    capsys.readouterr()


def test_weights_have_a_hash_that_follows_them(checkpoint, tmp_path):
    other = small_model(seed=1)
    other.save_pretrained(tmp_path)
    one, again, two = (
        OpenCheckpoint(Predictor.of(f, device="cpu")).weights_hash
        for f in (checkpoint, checkpoint, str(tmp_path))
    )
    assert one == again != two


def test_the_hash_is_of_the_model_not_of_the_library(checkpoint, tmp_path, monkeypatch):
    def hash_of(folder):
        return OpenCheckpoint(Predictor.of(str(folder), device="cpu")).weights_hash

    one = hash_of(checkpoint)
    with monkeypatch.context() as patch:
        patch.setattr("transformers.configuration_utils.__version__", "99.0.0")
        assert hash_of(checkpoint) == one
    folder = shutil.copytree(checkpoint, tmp_path / "copy")
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps({**config, "shape_space": "mano"}))
    assert hash_of(folder) != one


def test_a_checkpoint_with_episodes_beside_it_is_a_checkpoint(checkpoint, truth, tmp_path):
    folder = shutil.copytree(checkpoint, tmp_path / "trained")
    save_all(truth[:1], folder / "validation")
    assert Predictor.of(str(folder)).kind == "checkpoint"
    (folder / "config.json").unlink()
    assert Predictor.of(str(folder)).kind == "labels"


def test_two_files_of_one_episode_are_refused(truth, tmp_path):
    for run in ("one", "two"):
        save_all(truth, tmp_path / "runs" / run)
    with pytest.raises(ValueError, match=r"clip-0: \S+one/clip-0\.npz and \S+two/clip-0\.npz"):
        Predictor.of(str(tmp_path / "runs")).open()


def test_every_process_warms_up():
    """The first clip that each process predicts is no steady state."""
    results = [
        ClipResult(f"c{i}", 10, "s", "", {}, seconds=s, peak_bytes=1, warm_up=s > 5)
        for i, s in enumerate((9.0, 8.0, 1.0, 2.0))
    ]
    read = ClipResult("read", 10, "s", "", {})
    found = efficiency_of([*results, read], {"device": "cpu"})
    assert (found["frames"], found["seconds"]) == (20, 3.0)
    assert efficiency_of([*results[:2], read], {}) is None


def test_a_checkpoint_needs_pictures(checkpoint, labels, tmp_path):
    from mint_hub.evaluation.evaluate import evaluate

    with pytest.raises(ValueError, match=r"clip-0: no pictures to run \S+small on: labels"):
        evaluate(Source("labels", labels), Predictor.of(checkpoint, device="cpu"))


def test_compare_takes_results_labels_and_label_sets(corpus, labels, truth, tmp_path, capsys):
    far = str(save_all([moved(noisy(e, 0.01), 0.1) for e in truth], tmp_path / "far"))
    call = ["compare", labels, far, "--on", "shards", corpus, "--quiet"]
    assert main([*call, "-o", str(tmp_path / "out")]) == 0
    out = capsys.readouterr().out
    assert "# far against" in out
    assert "| CT-p (m) |" in out
    assert json.loads((tmp_path / "out/comparison.json").read_text())["clips"] == 3
    for name, folder in (("a", labels), ("b", far)):
        call = ["evaluate", folder, "--on", "shards", corpus, "--quiet", "-o", str(tmp_path / name)]
        assert main(call) == 0
    capsys.readouterr()
    assert main(["compare", str(tmp_path / "a"), str(tmp_path / "b" / "results.json")]) == 0
    assert "3 clips" in capsys.readouterr().out
    assert main(["compare", labels, far]) == 0
    assert "agreement, not accuracy" in capsys.readouterr().out


def test_the_trivial_rows_alone(corpus, tmp_path, capsys):
    call = ["evaluate", "trivial", "--on", "shards", corpus, "-o", str(tmp_path), "--quiet"]
    assert main([*call, "--limit", "2", "--clip-frames", "10"]) == 0
    values = json.loads((tmp_path / "results.json").read_text())
    assert values["prediction"] is None
    assert values["benchmark"]["clips"] == 4
    capsys.readouterr()


def test_bench_without_its_renderer_says_what_to_install(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "moderngl", None)
    call = ["evaluate", "trivial", "--on", "bench", "--cache", str(tmp_path), "--quiet"]
    assert main([*call, "-o", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert "mint-hub[synth]" in error
    assert "Traceback" not in error


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (["evaluate", "trivial", "--on", "bench", "here"], "--on bench: expected no folder"),
        (["evaluate", "trivial", "--on", "hot3d"], "--on hot3d: expected one folder"),
        (["evaluate", "trivial", "--on", "else"], "--on: expected one of ['bench'"),
        (["evaluate", "trivial", "--on", "hot3d", "no/where"], "found no folder; get sequences"),
        (["evaluate", "./no/model", "--on", "hot3d", "x"], "./no/model: expected a folder"),
        (["evaluate", "x", "--on", "shards", "no/where"], "no/where: expected a corpus folder"),
        (["compare", "a.json", "b.json"], "a.json: expected results"),
        (
            ["compare", "no", "b.json"],
            "no: expected results.json, or a folder with it, found neither",
        ),
    ],
)
def test_wrong_calls(call, message, capsys):
    assert main(call) == 2
    error = capsys.readouterr().err
    assert message in error
    assert "Traceback" not in error


def test_smoothing_labels_is_refused(corpus, labels, capsys):
    assert main(["evaluate", labels, "--on", "shards", corpus, "--smooth"]) == 2
    assert "--smooth: expected with a checkpoint" in capsys.readouterr().err
