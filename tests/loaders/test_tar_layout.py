import doctest
import io
import tarfile

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mint_hub.loaders import tar_layout
from mint_hub.loaders.tar_layout import (
    BLOCK,
    END,
    CorpusError,
    key_at,
    map_file,
    members_at,
    pack_sample,
    samples_in,
)

MEMBERS = {"json": b"{}", "traj.npy": bytes(range(256)) * 5, "mp4": b""}
SHARD = b"".join(pack_sample(key, MEMBERS) for key in ("a-1", "b_2", "c")) + END

keys = st.from_regex(r"[a-z0-9_-]{1,20}", fullmatch=True)
samples = st.lists(st.tuples(keys, st.binary(max_size=1500)), max_size=5, unique_by=lambda s: s[0])


def test_doctests():
    assert doctest.testmod(tar_layout).failed == 0


@settings(deadline=None, max_examples=30)
@given(samples)
def test_any_tar_reader_finds_what_was_packed(made):
    shard = b"".join(pack_sample(key, {"json": b"x", "mp4": data}) for key, data in made) + END
    with tarfile.open(fileobj=io.BytesIO(shard)) as tar:
        found = {m.name: (tar.extractfile(m) or io.BytesIO()).read() for m in tar}
        assert all((m.mtime, m.uid, m.gid, m.mode) == (0, 0, 0, 0o644) for m in tar)
    assert found == {f"{k}.{n}": d for k, data in made for n, d in (("json", b"x"), ("mp4", data))}
    for span, (key, data) in zip(samples_in(shard), made, strict=True):
        assert span.key == key
        assert [shard[m.offset : m.offset + m.size] for m in span.members] == [b"x", data]


def test_samples_tile_the_shard():
    spans = list(samples_in(SHARD))
    assert [s.offset for s in spans] == [sum(t.size for t in spans[:i]) for i in range(3)]
    assert spans[-1].offset + spans[-1].size + len(END) == len(SHARD)
    for span in spans:
        assert members_at(SHARD, span.offset, span.size) == span.members
        assert key_at(SHARD, span.offset) == span.key


def test_every_cut_is_an_error_after_the_samples_before_it():
    """Also cuts between members and between samples, which other readers take for the end."""
    spans = list(samples_in(SHARD))
    for size in range(0, len(SHARD), 64):
        whole = []
        with pytest.raises(CorpusError, match=r"cut\.tar: expected"):
            take(whole, SHARD[:size])
        assert whole == spans[: len(whole)]
        assert all(s.offset + s.size <= size for s in whole)


def take(into: list, shard: bytes) -> None:
    for sample in samples_in(shard, "cut.tar"):
        into.append(sample)


def test_what_follows_the_end_is_an_error():
    with pytest.raises(CorpusError, match="nothing more"):
        list(samples_in(SHARD + bytes(BLOCK)))
    with pytest.raises(CorpusError, match="nothing more"):
        list(samples_in(SHARD + SHARD))


def test_a_damaged_header_is_an_error():
    for at in range(0, BLOCK, 7):
        damaged = bytearray(SHARD)
        damaged[at] ^= 0x10
        with pytest.raises(CorpusError, match="header at byte 0"):
            list(samples_in(bytes(damaged)))


@pytest.mark.parametrize("key", ["", "a.b", "A", "a/b", "é", "a b"])
def test_keys_that_would_merge_or_move_samples_are_refused(key):
    with pytest.raises(CorpusError, match="expected only a-z"):
        pack_sample(key, MEMBERS)


def test_names_too_long_for_a_plain_header_are_refused():
    assert len(pack_sample("k" * 95, {"json": b""})) == BLOCK
    with pytest.raises(CorpusError, match="at most 100 characters, got 101"):
        pack_sample("k" * 96, {"json": b""})


def test_mapping_no_file_and_an_empty_one(tmp_path):
    with pytest.raises(CorpusError, match=r"none\.tar: expected this file, got none"):
        map_file(tmp_path / "none.tar")
    (tmp_path / "empty.tar").touch()
    assert map_file(tmp_path / "empty.tar") == b""


def test_a_span_that_is_no_sample_is_an_error():
    first = next(samples_in(SHARD))
    for size in (first.size - 2 * BLOCK, first.size + BLOCK, 2 * first.size, len(SHARD)):
        with pytest.raises(CorpusError, match="expected one sample"):
            members_at(SHARD, 0, size, "x.tar")
    with pytest.raises(CorpusError, match="end of the shard"):
        key_at(SHARD, len(SHARD) - len(END))
