import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mint_hub.loaders.manifest import (
    CorpusError,
    FileRecord,
    Manifest,
    ShardRecord,
    read_manifest,
    read_sealed,
    seal,
    split_folders,
    unseal,
    write_sealed,
)

MANIFEST = Manifest(
    config="ego4d",
    split="train",
    format="compact",
    members=("json", "traj.npy"),
    num_frames=900,
    shards=(ShardRecord("a.tar", 10, "0" * 64, 3), ShardRecord("b.tar", 20, "1" * 64, 4)),
    files=(FileRecord("index.npy", 5, "2" * 64),),
    spec={"seed": 0},
)
values = st.dictionaries(
    st.text(max_size=5).filter(lambda k: k != "checksum"),
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(max_size=9),
    max_size=5,
)  # fmt: skip


def test_a_manifest_comes_back(tmp_path):
    assert Manifest.from_dict(MANIFEST.to_dict()) == MANIFEST
    write_sealed(tmp_path / "shards.json", MANIFEST.to_dict())
    assert read_manifest(tmp_path) == MANIFEST
    assert (MANIFEST.num_episodes, MANIFEST.num_bytes) == (7, 30)


@settings(deadline=None, max_examples=50)
@given(values)
def test_what_was_sealed_comes_back(given_values):
    assert unseal(seal(given_values), "x") == given_values


def test_every_flipped_bit_of_a_sealed_file_is_seen():
    data = seal({"name": "x", "numbers": [1, 2.5], "flag": True})
    for bit in range(8 * len(data)):
        damaged = bytearray(data)
        damaged[bit // 8] ^= 1 << bit % 8
        with pytest.raises(CorpusError, match="got damaged ones"):
            unseal(bytes(damaged), "x.json")


def test_every_cut_of_a_sealed_file_is_seen():
    data = seal({"name": "x", "numbers": [1, 2.5], "flag": True})
    for size in range(len(data)):
        with pytest.raises(CorpusError, match="got damaged ones"):
            unseal(data[:size], "x.json")


def test_what_has_a_checksum_or_is_not_finite_cannot_be_sealed():
    with pytest.raises(ValueError, match="checksum"):
        seal({"checksum": 1})
    with pytest.raises(ValueError, match="JSON"):
        seal({"x": float("nan")})


def test_newer_manifests_are_refused_and_incomplete_ones_explained():
    with pytest.raises(CorpusError, match=r"at most 1, got 2: written by a newer mint-hub"):
        Manifest.from_dict({**MANIFEST.to_dict(), "manifest_version": 2})
    without = {k: v for k, v in MANIFEST.to_dict().items() if k != "shards"}
    with pytest.raises(CorpusError, match="expected the fields of a manifest, got 'shards'"):
        Manifest.from_dict(without)


def test_a_split_without_manifest_is_not_complete(tmp_path):
    with pytest.raises(CorpusError, match="a split without it is not complete"):
        read_manifest(tmp_path)
    with pytest.raises(CorpusError, match=r"stats\.json: expected this file, got none$"):
        read_sealed(tmp_path / "stats.json")


def test_splits_are_found_from_corpus_config_and_split(tmp_path):
    seen = ("a/train/shards.json", "a/validation/x.tar", "b/train/index.npy")
    unseen = ("a/.train.partial/x.tar", "a/.train.partial/files/x.tar", "b/notes/x.txt")
    for place in seen + unseen:
        (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / place).touch()
    a, b = tmp_path / "a", tmp_path / "b"
    assert split_folders(tmp_path) == [a / "train", a / "validation", b / "train"]
    assert split_folders(a) == [a / "train", a / "validation"]
    assert split_folders(a / "train") == [a / "train"]
