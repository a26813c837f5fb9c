"""`mint-hub pack` where labels refer to undistorted pictures, or a video is not quite the one."""

import json
import shutil

import numpy as np
import pytest

from mint_hub.cli import main
from mint_hub.loaders.packing import MP4, Packer
from mint_hub.loaders.reader import CorpusReader
from mint_hub.loaders.shards import write_corpus
from tests import video_files as make
from tests.episodes import make_episode

SIZE = (48, 64)
LENS = {"model": "opencv", "f": 50, "distortion": [0.2, 0, 0, 0]}


@pytest.fixture
def labels(tmp_path):
    """Two episodes whose labels refer to undistorted pictures; their videos beside them."""
    (tmp_path / "videos").mkdir()
    made = []
    for i in range(2):
        make.video(tmp_path / "videos" / f"v{i}.mp4", 20)
        meta = {"uid": f"v{i}", "undistorted": True}
        made.append(make_episode(20, seed=i, key=f"e{i}", image_size_hw=SIZE, meta=meta))
    write_corpus(made, tmp_path / "labels", "made", "train", seed=None)
    return tmp_path


def call_of(folder, *more):
    out = ["-o", str(folder / "packed"), "--videos", str(folder / "videos"), "--quiet"]
    return ["pack", str(folder / "labels"), "--config", "made", *out, *more]


def clips(folder):
    reader = CorpusReader(folder / "packed", "made-video", "train")
    return {reader.key(i): bytes(reader.member(i, MP4)) for i in range(len(reader))}


def made_with(folder, **options):
    packer = Packer(folder / "videos", **options)
    return {e.key: packer(e)[MP4] for e in CorpusReader(folder / "labels", "made", "train")}


def test_the_refusal_names_the_options_and_pins_nothing(labels, capsys):
    assert main(call_of(labels, "--size", "24x32")) == 2
    error = capsys.readouterr().err
    assert "v0.mp4: lens: expected a lens, as these labels refer to undistorted" in error
    assert "--lens" in error
    assert "--ignore-lens" in error
    assert "lens=" not in error
    assert main(call_of(labels, "--ignore-lens")) == 0
    assert clips(labels) == made_with(labels, options={"lens": None})
    assert main(call_of(labels, "--ignore-lens")) == 0
    assert "finished before" in capsys.readouterr().out
    assert main(call_of(labels, "--lens", json.dumps(LENS))) == 2
    assert "expected lens " in capsys.readouterr().err


def test_one_lens_for_all(labels):
    assert main(call_of(labels, "--lens", json.dumps(LENS), "--num-procs", "2")) == 0
    assert clips(labels) == made_with(labels, options={"lens": LENS})
    assert clips(labels) != made_with(labels, options={"lens": None})


def test_a_lens_for_each_video_from_a_file(labels, capsys):
    lenses = {"v0": LENS, "v1": {**LENS, "f": 60}}
    (labels / "lenses.json").write_text(json.dumps(lenses))
    assert main(call_of(labels, "--lens", str(labels / "lenses.json"))) == 0
    both = [made_with(labels, options={"lens": lenses[uid]}) for uid in ("v0", "v1")]
    assert clips(labels) == {"e0": both[0]["e0"], "e1": both[1]["e1"]}
    assert both[0]["e1"] != both[1]["e1"]
    shutil.rmtree(labels / "packed")
    K = np.diag([50, 50, 1]).tolist()
    assert main(call_of(labels, "--lens", json.dumps({"v0": K}))) == 2
    assert "v1.mp4: lens: expected a lens" in capsys.readouterr().err


def test_other_checks_name_their_option(labels, capsys):
    make.video(labels / "videos/v1.mp4", 20, size_hw=(48, 48))
    assert main(call_of(labels, "--ignore-lens")) == 2
    error = capsys.readouterr().err
    assert "v1.mp4: size: expected the aspect ratio" in error
    assert "if it is the right video nevertheless, --ignore size" in error
    assert main(call_of(labels, "--ignore-lens", "--ignore", "size")) == 0


@pytest.mark.parametrize(
    ("lens", "message"),
    [
        ("{", "--lens: expected JSON, got '{'"),
        ("{}", "--lens: expected a lens, or {UID: lens, ...}, got {}"),
        ("nowhere.json", "nowhere.json"),
        ('{"model": "opencv", "distortion": [1], "f": 5}', "distortion"),
    ],
)
def test_wrong_lenses(labels, capsys, lens, message):
    assert main(call_of(labels, "--lens", lens)) == 2
    assert message in capsys.readouterr().err
    assert main(call_of(labels, "--lens", json.dumps(LENS), "--ignore-lens")) == 2
    assert "expected one of them, got both" in capsys.readouterr().err
