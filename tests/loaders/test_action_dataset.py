"""Laws of the samples for robot learning: those of ``action_chunks``, in any order, any workers."""

import itertools
import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader, Dataset

from mint_hub.assets import sample_clip
from mint_hub.loaders.action_dataset import ActionDataset, AttachedPixels, PackedPixels
from mint_hub.loaders.action_normaliser import ActionNormaliser
from mint_hub.loaders.actions import DEFINITIONS, action_chunks, pad_action, pad_state
from mint_hub.loaders.attach import VideoAttachment
from mint_hub.loaders.order import ElasticSampler
from mint_hub.loaders.packing import Packer, pack_corpus, pixel_window
from mint_hub.loaders.reader import CorpusReader
from mint_hub.loaders.schema import Episode, TextSegment
from mint_hub.loaders.shards import write_corpus
from mint_hub.loaders.stream import ElasticLoader
from mint_hub.loaders.tar_layout import CorpusError
from tests.episodes import make_episode

LENGTHS = (40, 5, 1, 23, 17, 16, 30)
"""Frames: some shorter than a chunk, one a single frame."""


@pytest.fixture(scope="module", params=["compact", "lossless"])
def reader(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp(request.param)
    made = [make_episode(n, seed=i, key=f"e-{i}") for i, n in enumerate(LENGTHS)]
    write_corpus(made, folder, "c", "train", shard_bytes=60_000, format=request.param)
    return CorpusReader(folder, "c", "train")


def by_hand(reader, definition=DEFINITIONS[0], length=16):
    """All chunks of every episode, one after the other."""
    words = {"relative": definition[0], "fingers": definition[1]}
    made = [action_chunks(episode, length=length, **words) for episode in reader]
    names = ("action", "mask", "state", "state_mask")
    return {name: np.concatenate([getattr(c, name) for c in made]) for name in names}


def places(batches):
    """(episode, frame) of every sample, in order."""
    return [
        p for b in batches for p in zip(b["episode"].tolist(), b["frame"].tolist(), strict=True)
    ]


@pytest.mark.parametrize("definition", DEFINITIONS)
def test_samples_are_the_chunks_of_the_episodes(reader, definition):
    dataset = ActionDataset(reader, relative=definition[0], fingers=definition[1])
    assert isinstance(dataset, Dataset)
    assert len(dataset) == sum(LENGTHS)
    want = by_hand(reader, definition)
    whole = dataset.batch(np.arange(len(dataset)))
    single = [dataset[k] for k in range(len(dataset))]
    for name, array in want.items():
        assert torch.equal(whole[name], torch.from_numpy(array))
        assert torch.equal(torch.stack([s[name] for s in single]), whole[name])
    assert dataset[0]["action"].shape == (16, 102)
    assert dataset[0]["state"].shape == (122,)
    assert dataset[0]["mask"].shape == (16, 2)
    assert places([whole]) == [(i, k) for i, n in enumerate(reader.num_frames) for k in range(n)]


def test_no_step_counts_after_the_last_frame(reader):
    dataset = ActionDataset(reader)
    ends = np.cumsum(reader.num_frames)
    for i, end in enumerate(ends.tolist()):
        last = dataset[end - 1]
        assert last["episode"] == i
        assert not last["mask"].any()
        assert not last["action"].any()
        assert last["state_mask"].tolist() == reader[i].presence[-1].tolist()
    for k in np.flatnonzero(np.repeat(reader.num_frames, reader.num_frames) > 20).tolist():
        sample = dataset[k]
        left = int(reader.num_frames[sample["episode"]]) - 1 - int(sample["frame"])
        assert not sample["mask"][max(left, 0) :].any()


def test_stride_and_length(reader):
    dataset = ActionDataset(reader, length=4, stride=3)
    want = [(i, k) for i, n in enumerate(reader.num_frames) for k in range(0, n, 3)]
    assert len(dataset) == len(want)
    assert places([dataset.batch(range(len(want)))]) == want
    whole, first = by_hand(reader, length=4), np.cumsum([0, *reader.num_frames])
    for k, (i, frame) in enumerate(want):
        assert np.array_equal(dataset[k]["action"], whole["action"][first[i] + frame])


def test_padded_samples_are_vitras(reader):
    want = by_hand(reader)
    for with_shape in (False, True):
        dataset = ActionDataset(reader, padded=True, with_shape=with_shape)
        got = dataset.batch(np.arange(len(dataset)))
        action, action_mask = pad_action(want["action"], want["mask"])
        state, state_mask = pad_state(want["state"], want["state_mask"], with_shape=with_shape)
        assert got["action"].shape[1:] == (16, 192)
        assert got["state"].shape[1:] == (212,)
        assert np.array_equal(got["action"], action)
        assert np.array_equal(got["state"], state)
        assert np.array_equal(got["action_number_mask"], action_mask)
        assert np.array_equal(got["state_number_mask"], state_mask)
        assert np.array_equal(got["mask"], want["mask"])


def test_a_normaliser_gives_its_definition_and_is_undone(reader, tmp_path):
    rng = np.random.default_rng(0)
    normaliser = ActionNormaliser(
        rng.normal(size=102),
        rng.uniform(0.5, 2, 102),
        rng.normal(size=122),
        rng.uniform(0.5, 2, 122),
        *DEFINITIONS[1],
    )
    plain = ActionDataset(reader, relative="anchor")
    dataset = ActionDataset(reader, normaliser=normaliser)
    assert (dataset.relative, dataset.fingers) == DEFINITIONS[1]
    some = np.arange(0, len(dataset), 3)
    got, want = dataset.chunks(some), normaliser.normalise(plain.chunks(some))
    assert np.array_equal(got.action, want.action)
    assert np.array_equal(dataset.batch(some)["state"], want.state)
    assert not got.action.reshape(*got.mask.shape, 51)[~got.mask].any()
    back = normaliser.denormalise(got)
    np.testing.assert_allclose(back.action, plain.chunks(some).action, atol=1e-5)
    with pytest.raises(ValueError, match=r"normaliser: expected one of the definition \('step'"):
        ActionDataset(reader, normaliser=normaliser, relative="step")


def test_text_is_of_the_frame_and_the_hand(tmp_path):
    text = (
        TextSegment("a", "hold", "left", 0, 6),
        TextSegment("b", "open", "right", 4, 8),
        TextSegment("c", "make tea", None, 2, 5),
        TextSegment("d", "clap", "both", 8, 9),
    )
    write_corpus([replace(make_episode(12), text=text)], tmp_path, "c", "train")
    dataset = ActionDataset(CorpusReader(tmp_path, "c", "train"))
    said = [dataset[k]["text"] for k in range(12)]
    left, right = ([s[side] for s in said] for side in ("left", "right"))
    assert left == ["hold"] * 2 + ["hold; make tea"] * 3 + ["hold", "", "", "clap", "", "", ""]
    assert right == [
        *[""] * 2,
        *["make tea"] * 2,
        "open; make tea",
        *["open"] * 3,
        "clap",
        *[""] * 3,
    ]
    assert dataset.batch([0, 8])["text"] == {"left": ["hold", "clap"], "right": ["", "clap"]}


@pytest.mark.parametrize("workers", [0, 2])
def test_a_data_loader_gives_every_sample_once(reader, workers):
    dataset = ActionDataset(reader)
    loader = DataLoader(dataset, batch_size=9, num_workers=workers, shuffle=True)
    batches = list(loader)
    want = dataset.batch(np.arange(len(dataset)))
    assert sorted(places(batches)) == sorted(places([want]))
    numbers = {p: k for k, p in enumerate(places([want]))}
    for batch in batches:
        rows = [numbers[p] for p in places([batch])]
        assert all(torch.equal(batch[n], want[n][rows]) for n in ("action", "mask", "state"))
        assert batch["text"]["left"] == [want["text"]["left"][k] for k in rows]


def test_a_sampler_resumes(reader):
    dataset = ActionDataset(reader)
    whole = list(ElasticSampler(len(dataset), seed=4))
    sampler = ElasticSampler(len(dataset), seed=4)
    loader = DataLoader(dataset, batch_size=8, sampler=sampler, num_workers=2)
    first = places(itertools.islice(loader, 5))
    state = ElasticSampler(len(dataset), seed=4).state_dict(steps=5 * 8)
    rest = ElasticSampler(len(dataset), seed=4)
    rest.load_state_dict(state)
    after = places(DataLoader(dataset, batch_size=5, sampler=rest))
    assert first + after == list(zip(*(x.tolist() for x in dataset.positions(whole)), strict=True))


@pytest.mark.parametrize("workers", [0, 2])
def test_an_elastic_loader_resumes_with_other_ranks(reader, workers):
    dataset = ActionDataset(reader)
    before, states = [], []
    for rank in range(2):
        stream = dataset.stream(6, seed=1, rank=rank, world_size=2)
        loader = ElasticLoader(stream, num_workers=workers)
        before += places(itertools.islice(loader, 4))
        states.append(loader.state_dict())
    assert states[0] == states[1]
    after = []
    for rank in range(3):
        loader = ElasticLoader(dataset.stream(5, seed=1, rank=rank, world_size=3))
        loader.load_state_dict(states[0])
        after += places(loader)
    assert sorted(before + after) == places([dataset.batch(np.arange(len(dataset)))])
    assert before[:24] != sorted(before[:24])


def test_it_travels_to_a_process_that_shares_nothing(reader):
    dataset = ActionDataset(reader, pixels=PackedPixels((8, 8)))
    there = pickle.loads(pickle.dumps(dataset))
    assert there.pixels == dataset.pixels
    assert np.array_equal(there.chunks([3, 50]).action, dataset.chunks([3, 50]).action)


# -------------------------------------------------------------------- pictures


@pytest.fixture(scope="module")
def packed(tmp_path_factory):
    """The sample clip's own episode, and a part of it, packed."""
    folder = tmp_path_factory.mktemp("packed")
    truth = Episode.load(sample_clip().with_name("sample.npz"))
    made = [truth, replace(truth.window(20, 30), key="part")]
    pack_corpus(made, Packer(sample_clip(), size_hw=(72, 96)), folder, "video", "train")
    return CorpusReader(folder, "video", "train")


def test_packed_pictures_are_those_of_the_frames(packed):
    offsets = (-4, -2, 0, 3)
    dataset = ActionDataset(packed, pixels=PackedPixels(), image_offsets=offsets)
    for k in (0, 1, 40, len(dataset) - 1):
        sample = dataset[k]
        i, frame = int(sample["episode"]), int(sample["frame"])
        shown = np.clip(frame + np.array(offsets), 0, packed.num_frames[i] - 1)
        want = np.stack([pixel_window(packed, i, int(j), 1).images[0] for j in shown])
        assert sample["pixels"].dtype == torch.uint8
        assert sample["pixels"].shape == (4, 3, 72, 96)
        assert np.array_equal(sample["pixels"], want.transpose(0, 3, 1, 2))
    small = ActionDataset(packed, pixels=PackedPixels((24, 32)))
    loader = DataLoader(small, batch_size=4, num_workers=2, sampler=[0, 30, 60, 90])
    assert next(iter(loader))["pixels"].shape == (4, 1, 3, 24, 32)


def test_attached_pictures_are_those_of_the_video(packed):
    pixels = AttachedPixels(sample_clip(), (36, 48))
    dataset = ActionDataset(packed, pixels=pixels, image_offsets=range(-1, 2))
    sample = dataset[25]
    i, frame = int(sample["episode"]), int(sample["frame"])
    want = VideoAttachment(packed[i], sample_clip()).frames(frame - 1, 3, (36, 48))
    assert np.array_equal(sample["pixels"], want.transpose(0, 3, 1, 2))


def test_pictures_that_do_not_fit_or_are_not_there_are_refused(packed, reader):
    with pytest.raises(CorpusError, match="expected member mp4"):
        ActionDataset(reader, pixels=PackedPixels())[0]

    def of_two_sizes(reader, i, start, length):
        return np.zeros((length, 8 + 2 * i, 8, 3), np.uint8)

    dataset = ActionDataset(packed, pixels=of_two_sizes)
    with pytest.raises(
        ValueError, match=r"one size in a batch, got .*\(8, 8\), \(10, 8\).*size_hw"
    ):
        dataset.batch([0, len(dataset) - 1])


# ------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"length": 0}, "length: expected a whole number of at least 1, got 0"),
        ({"length": 2.0}, r"length: expected a whole number of at least 1, got 2\.0"),
        ({"stride": 0}, "stride: expected a whole number of at least 1, got 0"),
        ({"relative": "first"}, r"relative, fingers: expected one of .* got \('first', None\)"),
        ({"with_shape": True}, "with_shape: expected only with padded"),
        ({"image_offsets": (0.5,)}, "image_offsets: expected whole numbers"),
        ({"image_offsets": ()}, "image_offsets: expected whole numbers"),
    ],
)
def test_bad_arguments(reader, options, message):
    with pytest.raises(ValueError, match=message):
        ActionDataset(reader, **options)


def test_bad_samples(reader):
    dataset = ActionDataset(reader)
    with pytest.raises(IndexError, match=f"expected 0 .. {len(dataset) - 1}, got {len(dataset)}"):
        dataset[len(dataset)]
    with pytest.raises(ValueError, match="samples: expected whole numbers, got float64"):
        dataset.batch([0.5])
    assert torch.equal(dataset[-1]["state"], dataset[len(dataset) - 1]["state"])


def test_damage_is_raised_or_left_out(tmp_path):
    made = [make_episode(20, seed=i, key=f"e-{i}") for i in range(4)]
    write_corpus(made, tmp_path, "c", "train", shard_bytes=1)
    shard = sorted((tmp_path / "c/train").glob("*.tar"))[1]
    data = bytearray(shard.read_bytes())
    data[data.index(b"\x93NUMPY") + 1] ^= 1
    shard.write_bytes(data)
    lost = CorpusReader(tmp_path, "c", "train").key(1)
    with pytest.raises(CorpusError, match=f"{shard.name}, episode {lost}"):
        ActionDataset(CorpusReader(tmp_path, "c", "train")).batch(range(80))
    dataset = ActionDataset(CorpusReader(tmp_path, "c", "train", on_error="skip"))
    assert set(dataset.batch(range(80))["episode"].tolist()) == {0, 2, 3}
    assert len(dataset.__getitems__([0, 25, 79])) == 2
    assert len(dataset.batch([25])["episode"]) == 0
    with pytest.raises(CorpusError, match="expected one of"):
        dataset.__getitems__([25])
