"""`mint-hub demo` and the embedded network: it loads as any checkpoint, and says what it is."""

import json

import numpy as np
import pytest
import torch
from safetensors import safe_open
from transformers import pipeline

from mint_hub.assets import asset_path, checkpoint_named, default_model, sample_clip
from mint_hub.cli import main
from mint_hub.cli_demo import METRICS
from mint_hub.geometry.rigid import inverse
from mint_hub.loaders.schema import Episode
from mint_hub.model.modeling_mint import MintModel


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo")
    assert main(["demo", "-o", str(folder), "--quiet"]) == 0
    return folder / sample_clip().stem


def test_everything_it_names_is_there_and_opens(out, capsys):
    assert main(["demo", "-o", str(out.parent), "--quiet"]) == 0  # finished before: at once
    shown = capsys.readouterr().out
    for name in ("episode.npz", "episode.mp4", "episode.png", "episode.html", METRICS):
        assert (out / name).stat().st_size > 0
        assert str(out / name) in shown
    assert "mint-tiny" in shown
    assert "mean hand" in shown
    episode, truth = Episode.load(out / "episode.npz"), Episode.load(asset_path("sample.npz"))
    assert episode.num_frames == truth.num_frames


def test_its_metrics_are_those_of_the_episode_it_wrote(out):
    """Turns from frame to frame, computed here by hand."""
    numbers = json.loads((out / METRICS).read_text())
    episode, truth = Episode.load(out / "episode.npz"), Episode.load(asset_path("sample.npz"))

    def turns(e):
        poses = e.T_world_from_camera
        return (inverse(poses[:-1]) @ poses[1:])[:, :3, :3]

    wrong = np.swapaxes(turns(truth), -1, -2) @ turns(episode)
    angle = np.arccos(np.clip((np.trace(wrong, axis1=1, axis2=2) - 1) / 2, -1, 1))
    expected = np.degrees(np.sqrt(np.mean(angle**2)))
    assert numbers["prediction"]["RPE-R"] == pytest.approx(expected, rel=1e-3)
    off = np.degrees(np.abs(episode.fov_vh_rad - truth.fov_vh_rad)[:, 1]).mean()  # horizontal
    assert numbers["prediction"]["fov"] == pytest.approx(off, rel=1e-4)


def test_it_is_better_than_answers_that_need_no_network(out):
    numbers = json.loads((out / METRICS).read_text())
    for name in ("MPJPE-p", "GO-p", "EPE-p"):
        assert numbers["prediction"][name] < numbers["mean hand"][name], name
    assert numbers["prediction"]["RPE-R"] < numbers["zero camera motion"]["RPE-R"]


def test_the_pipeline_takes_it_by_default(out):
    pipe = pipeline("egocentric-hands")
    episode = pipe(str(sample_clip()))
    assert episode.allclose(Episode.load(out / "episode.npz")) or np.allclose(
        episode.hand_state, Episode.load(out / "episode.npz").hand_state, atol=1e-5
    )
    stored = MintModel.from_pretrained(default_model()).state_dict()
    for name, value in pipe.model.state_dict().items():
        assert torch.equal(value.float(), stored[name].float()), name


def test_its_name_means_it_unless_a_folder_has_that_name(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert checkpoint_named("mint-tiny") == str(default_model())
    assert checkpoint_named("ORG/mint-tiny") == "ORG/mint-tiny"
    assert main(["info", "--model", "mint-tiny"]) == 0
    assert "128 x 160" in capsys.readouterr().out
    (tmp_path / "mint-tiny").mkdir()
    assert checkpoint_named("mint-tiny") == "mint-tiny"
    assert main(["demo", "--model", "./missing", "-o", "out"]) == 2
    assert "./missing: expected a folder with a checkpoint" in capsys.readouterr().err


def test_its_folder_is_small_whole_and_says_what_it_is():
    folder = default_model()
    weights = folder / "model.safetensors"
    assert weights.stat().st_size <= 40e6
    with safe_open(weights, "pt") as file:
        kinds = {file.get_tensor(name).dtype for name in file.keys()}  # noqa: SIM118
    assert kinds <= {torch.bfloat16, torch.float16}
    card = (folder / "README.md").read_text(encoding="utf-8").split("---")[2].strip()
    first = card.splitlines()[0]
    assert "synthetic" in first
    assert "not for labelling" in first
    for name in ("config.json", "processor_config.json", "log.jsonl", "run.json"):
        assert (folder / name).is_file(), name
    for run in json.loads((folder / "run.json").read_text())["runs"]:
        assert run["command"].startswith("mint-hub train --recipe stage")
        assert isinstance(run["seed"], int)
        assert len(run["data"]) == 16


def test_a_file_is_no_folder_for_results(tmp_path, capsys):
    (tmp_path / "file").write_text("x")
    assert main(["demo", "-o", str(tmp_path / "file")]) == 2
    assert "expected a folder, got a file" in capsys.readouterr().err
