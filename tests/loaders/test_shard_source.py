"""Samples are the same bytes however many are made at once, by whatever process."""

import tarfile

import numpy as np
import pytest

from mint_hub.loaders import members
from mint_hub.loaders.npy_member import arrays_of, npy_bytes
from mint_hub.loaders.shard_source import encoded_samples
from mint_hub.loaders.tar_layout import pack_sample
from mint_hub.loaders.unfinished import ShardSpec
from tests.episodes import make_episode

EPISODES = [make_episode(5 + 9 * i, seed=i, key=f"e-{i}", gaps=i % 2 == 0) for i in range(7)]


class Slices:
    """Episodes, a few a slice."""

    def __init__(self, size):
        self.size = size

    def __iter__(self):
        return iter(range(0, len(EPISODES), self.size))

    def read_slice(self, part, /):
        return EPISODES[part : part + self.size]


@pytest.mark.parametrize(("format", "extra"), [("compact", False), ("lossless", True)])
def test_episodes_encoded_together_are_those_encoded_alone(format, extra):
    together = list(members.encode_all(EPISODES, format, extra))
    assert together == [members.encode(episode, format, extra) for episode in EPISODES]


def test_an_episode_at_fault_is_named_and_those_before_it_are_encoded():
    from dataclasses import replace

    late = EPISODES[2].timestamps_s.copy()
    late[-1] += 1.0
    encoded = members.encode_all([*EPISODES[:2], replace(EPISODES[2], timestamps_s=late)])
    assert [next(encoded), next(encoded)] == [members.encode(e) for e in EPISODES[:2]]
    with pytest.raises(ValueError, match=r"timestamps_s: expected .* \(episode e-2\)"):
        next(encoded)


@pytest.mark.parametrize("size", [1, 3, 100])
@pytest.mark.parametrize("num_procs", [1, 2])
@pytest.mark.parametrize("seed", [None, 3])
def test_slices_are_the_stream_of_their_episodes(size, num_procs, seed):
    spec = ShardSpec("c", "train", seed=seed, shuffle_buffer=3)
    stream = list(encoded_samples(iter(EPISODES), spec))
    assert sorted(s.key for s in stream) == sorted(e.key for e in EPISODES)
    assert list(encoded_samples(Slices(size), spec, num_procs=num_procs)) == stream
    rest = encoded_samples(Slices(size), spec, num_procs=num_procs, written=[stream[0].key])
    assert list(rest) == stream[1:]


@pytest.mark.parametrize("size", [0, 1, 511, 512, 10**6])
def test_headers_are_those_of_tarfile(size):
    sample = pack_sample("a_b-9", {"json": bytes(size)})
    info = tarfile.TarInfo("a_b-9.json")
    info.size = size
    assert sample[:512] == info.tobuf(tarfile.USTAR_FORMAT)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", ["traj.npy", "rot6d.npy"])
def test_numbers_that_are_not_finite_are_seen(name, value):
    spec = members.member(name)
    array = np.random.default_rng(0).normal(0, 1e4, (7, spec.width)).astype(spec.dtype)
    arrays_of({name: npy_bytes(array, spec)})
    array[4, -1] = value
    with pytest.raises(ValueError, match=rf"{name}: expected finite numbers, got .* at frame 4"):
        arrays_of({name: npy_bytes(array, spec)})
