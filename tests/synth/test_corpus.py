"""Synthetic shards: read like any other, and made on from where they stopped."""

import re
import sys

import pytest

from mint_hub.cli import main
from mint_hub.geometry.lenses import Lens
from mint_hub.loaders.integrity import verify
from mint_hub.loaders.packing import pixel_window
from mint_hub.loaders.reader import CorpusReader
from mint_hub.loaders.shards import CorpusError
from mint_hub.synth import corpus
from mint_hub.synth.corpus import synthesise
from mint_hub.synth.episodes import Clip
from mint_hub.synth.presets import is_bench, seed_of
from tests.corpus_faults import tree
from tests.episodes import make_episode as make_labels


@pytest.fixture(scope="module")
def written(renderer, tmp_path_factory):
    folder = tmp_path_factory.mktemp("synth")
    synthesise(folder, "train", 2, seed=1, num_frames=3)
    return folder


def test_shards_read_like_any_other(written):
    assert verify(written, "full").ok
    reader = CorpusReader(written, "synth-train", "train")
    assert len(reader) == 2
    window = pixel_window(reader, 1)
    assert window.images.shape[0] == window.episode.num_frames == 3
    assert reader[1].presence_score is not None
    assert reader[1].meta["scale_status"] == "exact (synthetic)"


class Maker:
    """Stands for ``make_clip``: labels alone, one clip a shard; interrupted at seed ``stop``."""

    def __init__(self, stop: int | None = None) -> None:
        self.stop, self.seeds = stop, list[int]()

    def __call__(self, seed: int, preset: str, *_: object, **__: object) -> Clip:
        self.seeds.append(seed)
        if seed == self.stop:
            raise KeyboardInterrupt
        return Clip(make_labels(3, key=f"synth-{preset}-{seed:x}"), {"mp4": b"%d" % seed})


@pytest.fixture
def begun(renderer, tmp_path, monkeypatch):
    """Make runs of four clips, of train and of the bench, that stop at the fourth."""
    monkeypatch.setattr(corpus, "SHARD_BYTES", 1)
    for preset in ("train", "bench"):
        monkeypatch.setattr(corpus, "make_clip", Maker(stop=seed_of(preset, 1, 3)))
        with pytest.raises(KeyboardInterrupt):
            synthesise(tmp_path, preset, 4, seed=1, num_frames=3)
    monkeypatch.setattr(corpus, "make_clip", Maker())
    return tmp_path


@pytest.mark.parametrize(("preset", "seed"), [("train", 1), ("bench", 2)])
def test_an_interrupted_run_goes_on_with_the_clips_that_are_missing(
    begun, tmp_path_factory, preset, seed
):
    """A bench's clips are the same for every seed, and 1 is the scale 1.0."""
    report = synthesise(begun, preset, 4, seed=seed, num_frames=3, scale=1)
    assert (report.kept_shards, report.num_shards) == (2, 4)  # the third was still open
    assert corpus.make_clip.seeds == [seed_of(preset, 1, n) for n in (2, 3)]
    whole = tmp_path_factory.mktemp("whole")
    synthesise(whole, preset, 4, seed=1, num_frames=3)
    split = report.folder.relative_to(begun)
    assert tree(begun / split) == tree(whole / split)


def test_keys_are_those_of_the_clips(written):
    reader = CorpusReader(written, "synth-train", "train")
    keys = [f"synth-train-{seed_of('train', 1, n):x}" for n in range(2)]
    assert [episode.key for episode in reader] == keys


@pytest.mark.parametrize(
    ("preset", "other", "message"),
    [
        ("train", {"num_frames": 4}, "num_frames 3 as it was begun, got 4"),
        ("train", {"num_frames": None}, "num_frames 3 as it was begun, got None"),
        ("train", {"scale": 0.5}, "scale 1.0 as it was begun, got 0.5"),
        ("train", {"samples": 0}, "samples 4 as it was begun, got 0"),
        ("train", {"lens": 0.5}, "lens 0.0 as it was begun, got 0.5"),
        ("train", {"depth": True}, "depth False as it was begun, got True"),
        ("train", {"segmentation": True}, "segmentation False as it was begun, got True"),
        ("train", {"seed": 2}, "seed 1 as it was begun, got 2"),
        ("bench", {"scale": 0.5}, "scale 1.0 as it was begun, got 0.5"),
    ],
)
def test_other_arguments_do_not_go_on(begun, preset, other, message):
    before = tree(begun)
    with pytest.raises(CorpusError, match=f"{re.escape(message)}: resume with the same arguments"):
        synthesise(begun, preset, 4, **{"seed": 1, "num_frames": 3, **other})
    assert tree(begun) == before


def test_another_generator_does_not_go_on(begun, monkeypatch):
    monkeypatch.setattr(corpus, "REVISION", corpus.REVISION + 1)
    with pytest.raises(CorpusError, match="expected revision"):
        synthesise(begun, "train", 4, seed=1, num_frames=3)


def test_processes_do_not_matter(written, tmp_path):
    synthesise(tmp_path, "train", 2, seed=1, num_frames=3, num_procs=2)
    one, two = (next((f / "synth-train" / "train").glob("*.tar")) for f in (written, tmp_path))
    assert one.read_bytes() == two.read_bytes()


def test_pieces_go_on_where_they_stopped(renderer, tmp_path, monkeypatch):
    """The second world's second piece was not written: it is, and the first is not made again."""
    whole = tmp_path / "whole"
    asked = {"seed": 1, "num_frames": 1, "pieces": 2, "scale": 0.1, "samples": 0}
    monkeypatch.setattr(corpus, "SHARD_BYTES", 1)
    synthesise(whole, "train", 3, **asked)
    keys = [f"synth-train-{seed_of('train', 1, n):x}-{k}" for n in range(3) for k in range(2)]
    assert [e.key for e in CorpusReader(whole, "synth-train", "train")] == keys
    made = list[int]()
    genuine = corpus.make_pieces

    def stops(seed, *args, **kwargs):
        made.append(seed)
        if len(made) == 3:
            raise KeyboardInterrupt
        return genuine(seed, *args, **kwargs)

    monkeypatch.setattr(corpus, "make_pieces", stops)
    begun = tmp_path / "begun"
    with pytest.raises(KeyboardInterrupt):
        synthesise(begun, "train", 3, **asked)
    synthesise(begun, "train", 3, **asked)
    seeds = [seed_of("train", 1, n) for n in range(3)]
    assert made == [*seeds, *seeds[1:]]  # the fourth shard was still open: its world is made again
    assert tree(begun) == tree(whole)


@pytest.mark.parametrize(
    ("preset", "num_frames", "pieces", "message"),
    [
        ("bench", 8, 2, "pieces: expected whole clips of bench, got 2"),
        ("train", None, 2, "got num_frames None, pieces 2"),
        ("train", 60, 3, r"within 1 to 150, the shortest clip of train; got num_frames 60"),
        ("train", 8, -1, "got num_frames 8, pieces -1"),
    ],
)
def test_pieces_that_cannot_be(tmp_path, preset, num_frames, pieces, message):
    with pytest.raises(ValueError, match=message):
        synthesise(tmp_path / "new", preset, 1, num_frames=num_frames, pieces=pieces)
    assert not (tmp_path / "new").exists()


def test_the_command_line_makes_a_bench_clip(renderer, tmp_path, capsys):
    call = ["synth", "--preset", "bench", "--episodes", "1", "--frames", "2", "--quiet"]
    assert main([*call, "-o", str(tmp_path)]) == 0
    assert (tmp_path / "README.md").is_file()
    (episode,) = CorpusReader(tmp_path, "synth-bench", "validation")
    assert is_bench(episode)
    assert main([*call, "-o", str(tmp_path)]) == 2
    assert "expected no such split yet" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "--episodes: expected how many"),
        (["--episodes", "0"], "episodes: expected at least 1"),
        (["--episodes", "-3", "--preset", "bench"], "episodes: expected at least 1"),
        (["--episodes", "1", "--jobs", "0"], "--jobs: expected at least 1"),
        (["--episodes", "1", "--frames", "0"], "num_frames: expected at least 1, got 0"),
        (["--episodes", "1", "--seed", "-2"], "seed: expected 0 or more, got -2"),
        (["--episodes", "1", "--scale", "0"], "scale: expected 0.1 to 4, got 0.0"),
        (["--episodes", "1", "--scale", "nan"], "scale: expected 0.1 to 4, got nan"),
        (["--episodes", "1", "--samples", "3"], "samples: expected 0, 2 or 4 a pixel, got 3"),
        (["--episodes", "1", "--lens", "1.1"], "lens: expected a share of clips from 0 to 1"),
        (["--lens", "0.5", "--preset", "bench"], "lens: expected 0 for bench"),
        (["--episodes", "41", "--preset", "bench"], "bench has 40 clips"),
    ],
)
def test_bad_arguments_are_named(arguments, message, tmp_path, capsys):
    assert main(["synth", *arguments, "-o", str(tmp_path), "--quiet"]) == 2
    said = capsys.readouterr().err.strip()
    assert message in said
    assert "\n" not in said
    assert not list(tmp_path.iterdir())


def test_a_file_where_the_corpus_should_be_is_named(tmp_path, capsys):
    (tmp_path / "taken").write_text("mine")
    call = ["synth", "--episodes", "1", "-o", str(tmp_path / "taken"), "--quiet"]
    assert main(call) == 2
    said = capsys.readouterr().err.strip()
    assert "expected a folder, got a file" in said
    assert "\n" not in said
    assert (tmp_path / "taken").read_text() == "mine"


def test_an_unknown_preset_is_named(tmp_path, capsys):
    with pytest.raises(SystemExit) as left:
        main(["synth", "--preset", "kitchen", "--episodes", "1", "-o", str(tmp_path)])
    assert left.value.code == 2
    assert "invalid choice: 'kitchen'" in capsys.readouterr().err
    with pytest.raises(ValueError, match=r"preset: expected one of .*'train'.*, got 'kitchen'"):
        synthesise(tmp_path, "kitchen", 1)


class WithoutEgl:
    """A moderngl that finds no driver."""

    @staticmethod
    def create_standalone_context(**_):
        raise OSError("libEGL.so: cannot open shared object file")


@pytest.mark.parametrize(
    ("module", "message"),
    [(None, 'pip install "mint-hub[synth]"'), (WithoutEgl, "libegl1 libgl1-mesa-dri")],
)
def test_what_is_missing_is_one_line(module, message, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "moderngl", module)
    call = ["synth", "--episodes", "1", "--frames", "1", "-o", str(tmp_path), "--quiet"]
    assert main(call) == 2
    said = capsys.readouterr().err.strip()
    assert message in said
    assert "\n" not in said
    assert not list(tmp_path.iterdir())


def test_the_command_line_bends_pictures(renderer, tmp_path):
    call = ["synth", "--episodes", "1", "--frames", "1", "--scale", "0.2", "--lens", "1"]
    assert main([*call, "--seed", "4", "-o", str(tmp_path), "--quiet"]) == 0
    (episode,) = CorpusReader(tmp_path, "synth-train", "train")
    lens = Lens.from_dict(episode.meta["synth"]["lens"])
    assert lens.image_size_hw == episode.image_size_hw
    assert any(lens.distortion)
