"""The corpus verbs of the command line: convert, verify, pack, from labels to pixels."""

import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import mint_hub
from mint_hub.assets import asset_path
from mint_hub.cli import main
from mint_hub.loaders.lerobot import to_lerobot
from mint_hub.loaders.packing import pixel_window
from mint_hub.loaders.reader import CorpusReader
from mint_hub.loaders.schema import Episode
from mint_hub.loaders.shards import split_of, write_corpus
from tests.corpus_faults import tree
from tests.episodes import make_episode
from tests.loaders.test_vitra import annotation


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
    for out in corpus.glob("made/.*"):
        assert out.name == ".train.origin.json"
        assert str(tmp_path) not in out.read_text().replace(str(root), "")


def test_withdrawn_videos_go_and_stay_away(root, tmp_path, capsys):
    corpus = tmp_path / "corpus"
    call = ["convert", "lerobot", str(root), "-o", str(corpus), "--config", "made", "--lossless"]
    assert main([*call, "--split", "train"]) == 0
    gone = CorpusReader(corpus, "made", "train")[0].meta["uid"]
    capsys.readouterr()
    away = ["withdraw", str(corpus), gone, "--reason", "asked for by its owner"]
    assert main(away) == 0
    assert capsys.readouterr().out == "1 episodes out of made/train\n"
    assert main(away) == 0
    assert "withdrawn before" in capsys.readouterr().out
    assert main([*call, "--split", "validation"]) == 0  # these sources, into another split
    for split in ("train", "validation"):
        left = [episode.meta["uid"] for episode in CorpusReader(corpus, "made", split)]
        assert len(left) == 5
        assert gone not in left
    assert "asked for by its owner" in (corpus / "README.md").read_text()


def test_one_bad_file_among_good_ones(tmp_path, capsys):
    """Raised by default, or left out, counted and named."""
    paths = [tmp_path / f"ego4d_{name}_ep_1.npy" for name in ("a", "b", "c")]
    for path in paths:
        fields = {**annotation(), "video_name": path.stem}
        np.save(path, np.array(fields, dtype=object), allow_pickle=True)
    paths[1].write_bytes(paths[1].read_bytes()[:500])
    corpus = tmp_path / "corpus"
    call = ["convert", "vitra", *map(str, paths), "-o", str(corpus), "--config", "made", "--quiet"]
    assert main(call) == 2
    assert f"{paths[1]}: " in capsys.readouterr().err
    assert not (corpus / "made/train/shards.json").exists()
    shutil.rmtree(corpus, ignore_errors=True)
    skipping = [*call, "--on-error", "skip"]
    assert main(skipping) == 1
    said = capsys.readouterr().out
    assert f"skipped 1 of 3 sources:\n{paths[1]}: " in said
    assert said.count(str(paths[1])) == 1
    found = [
        episode.meta["uid"]
        for split in ("train", "validation")
        if (corpus / "made" / split).exists()
        for episode in CorpusReader(corpus, "made", split)
    ]
    assert sorted(found) == [paths[0].stem, paths[2].stem]
    shutil.rmtree(corpus)
    for path in paths:
        path.write_bytes(b"")
    assert main(skipping) == 2
    assert "skipped 3 of 3 sources" in capsys.readouterr().out


def test_scores_that_are_left_out_are_told(root, tmp_path, caplog):
    call = ["convert", "lerobot", str(root), "--config", "made", "--split", "train", "--quiet"]
    assert main([*call, "-o", str(tmp_path / "with"), "--extra"]) == 0
    assert not caplog.records
    assert main([*call, "-o", str(tmp_path / "without")]) == 0
    (line,) = caplog.messages
    assert "made/train: presence scores of 6 episodes are not in the shards" in line
    assert "--extra" in line


# ------------------------------------------------------------------ going on


def call_of(root, corpus, *more):
    paths = [str(root), "-o", str(corpus), "--config", "made", "--lossless", "--quiet"]
    return ["convert", "lerobot", *paths, *more]


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    """A LeRobot root with videos of both splits."""
    folder = tmp_path_factory.mktemp("both")
    uids = [f"video-{i}" for i in range(200)]
    chosen = [u for u in uids if split_of(u) == "validation"][:3] + uids[:5]
    episodes = [
        make_episode(20 + i, seed=i, key=f"e-{i}", meta={"uid": uid, "source": "made"})
        for i, uid in enumerate(chosen)
    ]
    to_lerobot(episodes, folder / "root", extra=True)
    return folder / "root"


@pytest.fixture(scope="module")
def whole(both, tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    assert main(call_of(both, folder)) == 0
    assert {p.name for p in (folder / "made").iterdir()} >= {"train", "validation"}
    return tree(folder)


def test_the_same_command_again_skips_what_is_finished(both, whole, tmp_path, capsys):
    assert main(call_of(both, tmp_path)) == 0
    capsys.readouterr()
    assert main(call_of(both, tmp_path)) == 0
    told = capsys.readouterr().out.splitlines()
    assert [line.partition(": ")[0] for line in told] == ["made/train", "made/validation", "card"]
    assert all("finished before, from the same inputs" in line for line in told[:2])
    shutil.rmtree(tmp_path / "made/train")
    (tmp_path / "README.md").unlink()
    assert main(call_of(both, tmp_path)) == 0
    assert "made/validation: finished before" in capsys.readouterr().out
    assert tree(tmp_path) == whole


def test_a_corpus_within_its_own_source_is_no_change_of_it(both, tmp_path, capsys):
    shutil.copytree(both, tmp_path / "root")
    for _ in range(2):
        assert main(call_of(tmp_path / "root", tmp_path / "root/corpus")) == 0
    assert capsys.readouterr().out.count("finished before") == 2


def test_something_else_than_was_written_is_refused_naming_both(both, tmp_path, capsys):
    root, corpus = tmp_path / "root", tmp_path / "corpus"
    shutil.copytree(both, root)
    assert main(call_of(root, corpus)) == 0

    def refusal(call):
        capsys.readouterr()
        assert main(call) == 2
        return capsys.readouterr().err

    written = f"{corpus / 'made/train'}: expected "
    error = refusal(call_of(root, corpus, "--extra"))
    assert f"{written}extra False, from which it was written, got True" in error
    assert f"{written}split auto" in refusal(call_of(root, corpus, "--split", "train"))
    assert main(call_of(shutil.copytree(root, tmp_path / "moved"), corpus)) == 0  # equal files
    info = root / "meta/info.json"
    info.write_text(info.read_text() + " ")
    error = refusal(call_of(root, corpus))
    assert f"{written}inputs ['{root}'] as they were (stamp " in error
    assert f"got ['{root}'] as they are now (stamp " in error
    (corpus / "made/.train.origin.json").unlink()
    assert "expected no such split yet, or one that this command wrote" in refusal(
        call_of(root, corpus)
    )
    shutil.rmtree(corpus / "made")
    assert main(call_of(root, corpus)) == 0


def test_an_unfinished_split_of_other_inputs_is_refused(both, tmp_path, capsys):
    other = tmp_path / "root"
    shutil.copytree(both, other)
    corpus = tmp_path / "corpus"
    for number in range(100):
        die_at_rename(call_of(other, corpus), number)
        if list(corpus.glob("made/.train.partial/files/*.tar")):
            break
        shutil.rmtree(corpus, ignore_errors=True)
    info = other / "meta/info.json"
    info.write_text(info.read_text() + " ")
    assert main(call_of(other, corpus)) == 2
    error = capsys.readouterr().err
    assert f"{corpus / 'made/.train.partial'}: expected inputs ['{other}'] as they were" in error


def die_at_rename(call, number):
    """Run a call in a process that is killed before (even) or after (odd) its n-th rename."""

    def run():
        rename, calls = os.replace, iter(range(10**9))

        def replace(a, b):
            turn = next(calls)
            if turn == number // 2 and number % 2 == 0:
                os.kill(os.getpid(), signal.SIGKILL)
            rename(a, b)
            if turn == number // 2:
                os.kill(os.getpid(), signal.SIGKILL)

        os.replace = replace
        os._exit(main(call))

    child = multiprocessing.get_context("fork").Process(target=run)
    child.start()
    child.join()
    return child.exitcode


def test_killed_at_renames_the_same_command_ends_in_equal_bytes(both, whole, tmp_path):
    killed = 0
    for number in range(0, 1000, 5):  # every fifth, before and after by turns
        corpus = tmp_path / str(number)
        code = die_at_rename(call_of(both, corpus), number)
        if code == 0:
            break
        assert code == -signal.SIGKILL
        killed += 1
        assert main(call_of(both, corpus)) == 0
        assert tree(corpus) == whole
    assert killed > 5


def test_killed_at_random_moments_the_same_command_ends_in_equal_bytes(both, whole, tmp_path):
    """One folder, one command, killed from outside again and again."""
    code = "import sys; from mint_hub.cli import main; sys.exit(main(sys.argv[1:]))"
    call = [sys.executable, "-c", code, *call_of(both, tmp_path, "--num-procs", "2")]
    home = Path(mint_hub.__file__).parent.parent
    rng = np.random.default_rng(0)
    for _ in range(4):
        process = subprocess.Popen(call, cwd=home, stdout=subprocess.DEVNULL)
        seen = 0
        while process.poll() is None and seen < rng.integers(1, 8):
            time.sleep(rng.uniform(0, 0.02))
            seen += (tmp_path / "made").exists()
        process.kill()
        process.wait()
    subprocess.run(call, cwd=home, check=True, stdout=subprocess.DEVNULL)
    assert tree(tmp_path) == whole


# -------------------------------------------------------------------- splits


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
    labels = tmp_path / "labels"
    write_corpus([Episode.load(asset_path("sample.npz"))], labels, "sample", "train")
    call = ["pack", str(labels), "--config", "sample", "-o", str(corpus), "--size", "72x96"]
    assert main([*call, "--videos", str(videos / "sample.mp4")]) == 0
    reader = CorpusReader(corpus, "sample-video", "train")
    episode, images = pixel_window(reader, 0, 10, 4)[:2]
    assert np.asarray(images).shape == (4, 72, 96, 3)
    assert episode.num_frames == 4
    assert main(["verify", str(corpus), "--full"]) == 0
    capsys.readouterr()
    assert main([*call, "--videos", str(videos / "sample.mp4")]) == 0
    assert "sample-video/train: finished before" in capsys.readouterr().out
    other = [*call[:-1], "48x64", "--videos", str(videos / "sample.mp4")]
    assert main(other) == 2
    assert "expected size 72x96, from which it was written, got 48x64" in capsys.readouterr().err


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
