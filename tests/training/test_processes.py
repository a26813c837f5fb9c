"""The command itself: killed and run again, and shared by two processes."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from mint_hub.cli import main
from mint_hub.model.modeling_mint import MintModel
from tests.training.corpus import WINDOW, config, training_episode, write_packed

ROOT = Path(__file__).parents[2]
DISTRIBUTED = ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node")


@pytest.fixture(scope="module")
def corpus(tmp_path_factory):
    folder = tmp_path_factory.mktemp("processes")
    config().save_pretrained(folder / "sizes")
    write_packed(folder, [training_episode("v0")], split="validation")
    return write_packed(folder, [training_episode(f"e{i}") for i in range(3)])


def words(corpus: Path, out: Path, *more: str) -> list[str]:
    """The command: four steps of two windows, checkpoints every step."""
    call = ["train", "--data", str(corpus), "--init", "random", "-o", str(out), "--cpu", "--quiet"]
    call += ["--config", str(corpus / "sizes"), "--steps", "4", "--batch", "2"]
    call += ["--window", str(WINDOW), "--log-every", "1", "--warmup", "0"]
    return [*call, *more]


def start(call: list[str], processes: int = 1) -> subprocess.Popen[str]:
    launcher = (*DISTRIBUTED, str(processes)) if processes > 1 else ()
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    return subprocess.Popen(
        [sys.executable, *launcher, "-m", "mint_hub.cli", *call],
        env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": path},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def losses(out: Path) -> dict[int, float]:
    lines = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
    return {line["step"]: line["loss"] for line in lines if "loss" in line}


@pytest.fixture(scope="module")
def alone(corpus, tmp_path_factory):
    """A run in this process that nothing disturbs."""
    out = tmp_path_factory.mktemp("alone") / "run"
    assert main(words(corpus, out, "--recipe", "stage1+fp32", "--save-every", "2")) == 0
    return out


def test_the_command_trains_and_says_so(corpus, tmp_path, capsys):
    call = words(corpus, tmp_path / "run", "--recipe", "stage1", "--lr-factor", "2")
    assert main(call) == 0
    said = capsys.readouterr().out
    assert "4 steps, loss " in said
    assert str(tmp_path / "run" / "model") in said
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert record["learning_rates"]["hand_head"] == pytest.approx(1e-3)
    assert main(call) == 0
    assert "went on from step 4" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--recipe", "stage9"], "recipe: expected stage1"),
        (["--recipe", "stage1", "--mixture", "made"], "expected SOURCE=WEIGHT, got 'made'"),
        (["--recipe", "stage1", "--mixture", "no=1"], "expected sources of ['made'], got 'no'"),
        (["--recipe", "stage1", "--lr-factor", "0"], "--lr-factor: expected more than 0"),
        (["--recipe", "stage1", "--config", "huge"], "expected tiny, full or a folder"),
        (["--recipe", "stage1", "--data", "nowhere"], "nowhere: expected a corpus folder"),
    ],
)
def test_calls_that_are_wrong(corpus, tmp_path, capsys, more, message):
    out = tmp_path / "run"
    assert main(words(corpus, out, *more)) == 2
    assert message in capsys.readouterr().err
    assert not list(out.glob("checkpoint-*"))


def test_killed_and_run_again_the_losses_are_bit_equal(corpus, alone, tmp_path):
    out = tmp_path / "run"
    call = words(corpus, out, "--recipe", "stage1+fp32", "--save-every", "2")
    process = start(call)
    deadline = time.monotonic() + 300
    while not (out / "checkpoint-2").is_dir():
        assert process.poll() is None, process.communicate()[0]
        assert time.monotonic() < deadline
        time.sleep(0.005)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    assert not (out / "model").exists()
    assert main(call) == 0
    assert losses(out) == losses(alone)
    assert MintModel.from_pretrained(out / "model").config.hidden_size == 32


@pytest.mark.parametrize("sharded", [False, True], ids=["copied", "sharded"])
def test_two_processes_train_like_one(corpus, alone, tmp_path, sharded):
    out = tmp_path / "run"
    call = words(corpus, out, "--recipe", "stage1+fp32", "--save-every", "2")
    call += ["--evaluate-every", "4", "--evaluate-windows", "3"]
    process = start([*call, *(["--fsdp"] if sharded else [])], processes=2)
    said, _ = process.communicate(timeout=540)
    assert process.returncode == 0, said
    together, one = losses(out), losses(alone)
    assert list(together) == [1, 2, 3, 4]
    for step, value in together.items():
        assert value == pytest.approx(one[step], rel=1e-5)
    assert {path.name for path in (out / "checkpoint-4").glob("rng_state*")} == {
        "rng_state_0.pth",
        "rng_state_1.pth",
    }
    assert "eval_RPE-T" in (out / "log.jsonl").read_text()
    before, after = (
        MintModel.from_pretrained(path / "model").state_dict() for path in (alone, out)
    )
    for name, value in before.items():
        torch.testing.assert_close(after[name], value, rtol=1e-3, atol=1e-5)
