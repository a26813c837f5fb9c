import shutil

import pytest

from mint_hub.loaders.integrity import CorpusError, verify
from mint_hub.loaders.shards import write_corpus
from tests import corpus_faults as faults


@pytest.fixture(scope="module")
def pristine(tmp_path_factory):
    root = tmp_path_factory.mktemp("corpus") / "c"
    faults.write(root)
    return root


@pytest.fixture
def root(pristine, tmp_path):
    return shutil.copytree(pristine, tmp_path / "c")


@pytest.fixture
def split(root):
    return root / "sample/train"


def problems(root, level="full"):
    report = verify(root, level)
    return {problem.path: problem.status for problem in report.problems}


@pytest.mark.parametrize("level", ["size", "full"])
@pytest.mark.parametrize("below", ["", "sample", "sample/train"])
def test_what_was_written_is_whole(root, level, below):
    report = verify(root / below, level)
    assert report.ok, str(report)
    assert (report.num_lost, report.lost) == (0, ())
    assert sum(file.samples for file in report.files) == len(faults.EPISODES)
    report.raise_for_problems()


@pytest.mark.parametrize("level", ["size", "full"])
@pytest.mark.parametrize(
    "fault", [faults.cut_at_member_boundaries, faults.missing_files, faults.swapped_shards]
)
def test_every_case_is_named_with_what_is_lost(root, fault, level):
    row = fault(root, level)
    assert row.cases >= 3
    assert row.detected == row.cases, row
    assert verify(root, "full").ok


def test_every_flipped_bit_is_named_with_what_is_lost(root):
    row = faults.flipped_bits(root)
    assert (row.cases, row.silent) == (200, 0), row
    assert verify(root, "full").ok


def test_a_reader_that_checks_samples_reads_no_flipped_bit(root):
    row = faults.flipped_bits_read(root, "sample")
    assert (row.cases, row.silent) == (200, 0), row
    assert verify(root, "full").ok


def test_a_report_says_it_in_words(root, split):
    path = split / "sample-train-00001.tar"
    keys = [sample.key for sample in faults.spans_of(path)]
    path.unlink()
    report = verify(root)
    name = "sample/train/sample-train-00001.tar"
    lost = f"lost {len(keys)} of {len(keys)} episodes: {', '.join(keys)}"
    assert f"1 problems, {len(keys)} episodes lost" in str(report)
    assert f"{name}: missing, is not there: expected 20992 bytes; {lost}" in str(report)
    with pytest.raises(CorpusError, match=r"sample-train-00001\.tar: missing"):
        report.raise_for_problems()


def test_bytes_after_the_end_lose_nothing_and_are_named(root, split):
    path = split / "sample-train-00000.tar"
    path.write_bytes(path.read_bytes() + bytes(10))
    for level in ("size", "full"):
        report = verify(root, level)
        (problem,) = report.problems
        assert (problem.status, problem.num_lost) == ("longer", 0)


def test_the_levels_differ_in_flipped_bits_only(root, split):
    path = split / "sample-train-00000.tar"
    data = bytearray(path.read_bytes())
    data[faults.spans_of(path)[0].members[1].offset + 200] ^= 1
    path.write_bytes(data)
    assert verify(root, "size").ok
    assert problems(root) == {"sample/train/sample-train-00000.tar": "checksum"}


def test_equal_sizes_do_not_hide_a_swap(split):
    sizes = {path.stat().st_size for path in split.glob("*.tar")}
    assert len(sizes) == 1  # so that faults.swapped_shards shows more than a look at sizes


def test_files_that_do_not_belong_are_named(root, split):
    (split / "sample-train-00003.tar").write_bytes(b"more")
    (split / "notes.txt").touch()
    for level in ("size", "full"):
        assert problems(root, level) == {
            "sample/train/sample-train-00003.tar": "extra",
            "sample/train/notes.txt": "extra",
        }


def test_episodes_are_counted_where_nothing_can_name_them(root, split):
    (split / "episodes.parquet").unlink()
    path = split / "sample-train-00002.tar"
    samples = len(faults.spans_of(path))
    path.write_bytes(path.read_bytes()[:700])
    report = verify(root)
    assert (report.num_lost, report.lost) == (samples, ())
    assert {p.status for p in report.problems} == {"missing", "truncated"}


def test_a_split_that_is_gone_or_elsewhere_is_named(root, split):
    moved = split.rename(split.with_name("validation"))
    found = problems(root)
    assert found["sample/validation/shards.json"] == "swapped"
    assert found["sample/train"] == "missing"
    shutil.rmtree(moved)
    for folder in (root, root / "sample"):
        assert list(problems(folder, "size").values()) == ["missing"]


def test_statistics_of_other_shards_are_named(root, split, tmp_path):
    other = tmp_path / "other"
    write_corpus(faults.EPISODES[:3], other, "sample", "train")
    shutil.copy(other / "sample/stats.json", root / "sample/stats.json")
    assert problems(root, "size") == {"sample/stats.json": "swapped"}


def test_an_unfinished_split_is_named(root):
    def stops():
        yield faults.EPISODES[0]
        raise RuntimeError("the source broke")

    with pytest.raises(RuntimeError, match="the source broke"):
        write_corpus(stops(), root, "sample", "validation")
    assert problems(root) == {"sample/.validation.partial": "unfinished"}


def test_a_folder_without_any_split_is_refused(tmp_path):
    with pytest.raises(CorpusError, match="expected a corpus, a config or a split, got none"):
        verify(tmp_path)
    with pytest.raises(CorpusError, match="expected 'size' or 'full', got 'deep'"):
        verify(tmp_path, "deep")  # pyright: ignore[reportArgumentType]
