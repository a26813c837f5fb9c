"""The corpus verbs of the command line: convert, verify, pack, from labels to pixels."""

import shutil

import numpy as np
import pytest

from mint_hub.assets import asset_path
from mint_hub.cli import main
from mint_hub.loaders.lerobot import to_lerobot
from mint_hub.loaders.packing import pixel_window
from mint_hub.loaders.reader import CorpusReader
from tests.episodes import make_episode


@pytest.fixture
def root(tmp_path):
    """A LeRobot root of six episodes of six videos."""
    episodes = [
        make_episode(20 + i, seed=i, key=f"e-{i}", meta={"uid": f"video-{i}", "source": "made"})
        for i in range(6)
    ]
    to_lerobot(episodes, tmp_path / "root", extra=True)
    return tmp_path / "root"


def test_lerobot_to_verified_shards(root, tmp_path, capsys):
    corpus = tmp_path / "corpus"
    call = ["convert", "lerobot", str(root), "-o", str(corpus), "--config", "made", "--lossless"]
    assert main([*call, "--split", "train"]) == 0
    assert (corpus / "README.md").is_file()
    assert main(["verify", str(corpus), "--full"]) == 0
    assert len(CorpusReader(corpus, "made", "train")) == 6
    assert main([*call, "--split", "train"]) == 2
    assert "expected no such split yet" in capsys.readouterr().err


def test_splits_are_told_apart_by_video(root, tmp_path, capsys):
    corpus = tmp_path / "corpus"
    call = ["convert", "lerobot", str(root), "-o", str(corpus), "--config", "made", "--lossless"]
    assert main(call) == 0
    found = [p.name for p in (corpus / "made").iterdir() if p.is_dir()]
    count = sum(len(CorpusReader(corpus, "made", split)) for split in found)
    assert count == 6


def test_damage_is_named(root, tmp_path, capsys):
    corpus = tmp_path / "corpus"
    call = ["convert", "lerobot", str(root), "-o", str(corpus), "--config", "made", "--lossless"]
    assert main([*call, "--split", "train"]) == 0
    shard = next(corpus.rglob("*.tar"))
    data = bytearray(shard.read_bytes())
    data[len(data) // 2] ^= 1
    shard.write_bytes(data)
    assert main(["verify", str(corpus), "--full"]) == 1
    assert shard.name in capsys.readouterr().out


def test_pack_puts_pixels_beside_labels(tmp_path, capsys):
    corpus, videos = tmp_path / "packed", tmp_path / "videos"
    videos.mkdir()
    shutil.copy(asset_path("sample.mp4"), videos / "sample.mp4")
    labels = str(asset_path("sample_corpus"))
    call = ["pack", labels, "--config", "sample", "-o", str(corpus), "--size", "72x96"]
    assert main([*call, "--videos", str(videos / "sample.mp4")]) == 0
    reader = CorpusReader(corpus, "sample-video", "train")
    episode, images = pixel_window(reader, 0, 10, 4)[:2]
    assert np.asarray(images).shape == (4, 72, 96, 3)
    assert episode.num_frames == 4
    assert main(["verify", str(corpus), "--full"]) == 0


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (["verify", "no/such/corpus"], "no/such/corpus"),
        (["convert", "lerobot", "no/such/root", "-o", "x", "--config", "c"], "no/such/root"),
        (["convert", "vitra", "no.npy", "-o", "x", "--config", "c"], "no.npy"),
    ],
)
def test_wrong_calls(call, message, capsys):
    assert main(call) == 2
    error = capsys.readouterr().err
    assert message in error
    assert "Traceback" not in error
