"""A corpus as samples for robot learning: pictures, text, state, actions and their mask.

    dataset = ActionDataset(reader, normaliser=normaliser, pixels=PackedPixels((224, 224)))
    loader = DataLoader(dataset, batch_size=64, shuffle=True, num_workers=2)
    loader = ElasticLoader(dataset.stream(64, seed=0, rank=rank, world_size=world_size))

A sample is a chunk (``actions``): a frame of an episode, and the steps that follow it. The second
loader reads in elastic order and resumes exactly (``stream``). Batches are computed together, from
the rows of the shards; no Episode is made. Letters: B samples, L steps, N pictures.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch.utils.data import Dataset

from mint_hub.conventions import SIDES
from mint_hub.geometry import camera_state
from mint_hub.geometry.hand_state import NUM_SHAPE_PARAMS
from mint_hub.loaders.action_normaliser import ActionNormaliser
from mint_hub.loaders.actions import (
    CHUNK_LENGTH,
    DEFINITIONS,
    ActionChunks,
    Fingers,
    Relative,
    pad_action,
    pad_state,
    window_actions,
)
from mint_hub.loaders.fields import EpisodeError, TextSegment
from mint_hub.loaders.members import META, TRAJ, decode_meta, hand_states, member, presence_of
from mint_hub.loaders.pixels import AttachedPixels, PackedPixels, Pixels, pictures
from mint_hub.loaders.reader import CorpusReader
from mint_hub.loaders.stream import ElasticStream
from mint_hub.loaders.tar_layout import CorpusError

__all__ = ["ActionDataset", "ActionStream", "AttachedPixels", "PackedPixels", "Pixels"]

if TYPE_CHECKING:
    Base = Dataset[dict[str, Any]]
else:
    Base = Dataset

_SHAPE: Final = (len(SIDES), NUM_SHAPE_PARAMS)
_KEPT_EPISODES: Final = 8192
"""Of so many episodes text and shapes stay in memory, some kilobytes each."""


class ActionDataset(Base):
    """One sample for every ``stride``-th frame of every episode of a reader.

    A sample is a dict, of which tensors are

        state         (122,) float32, zero for an absent hand; ``padded``: (212,)
        state_mask    (2,) bool, which hands are there at the frame
        action        (L, 102) float32, zero where the mask is false; ``padded``: (L, 192)
        mask          (L, 2) bool, which steps count, by hand; none after an episode's last frame
        episode       () int64, which episode of the reader
        frame         () int64, the chunk's first frame in it
        pixels        (N, 3, H, W) uint8 RGB, if ``pixels`` are given
        action_number_mask (L, 192) bool, state_number_mask (212,) bool: if ``padded``, the masks as
                      a number each

    and ``text`` is what the segments at that frame say of each hand, {"left": str, "right": str}: a
    segment of both hands, or of which nobody said the hand, is said of each; "; " is between two,
    and "" where there is none. Frame, unit and order of all numbers are those of ``actions``.

    Args:
        reader: what to read.
        length: L, steps of a chunk.
        stride: frames from one sample of an episode to the next.
        relative: see ``action_chunks``; default: the normaliser's, else VITRA's "step".
        fingers: see ``action_chunks``; default: the normaliser's, else VITRA's "absolute".
        normaliser: of states and actions, before they are padded.
        padded: to VITRA's 192 and 212 numbers: see ``pad_action`` and ``pad_state``.
        with_shape: of a padded state: see ``pad_state``.
        pixels: where pictures are from: PackedPixels, AttachedPixels, or a function like them.
        image_offsets: (N,) which frames are shown, counted from the chunk's first. A frame outside
            the episode is its first or last.

    Raises:
        ValueError: an argument of another kind, or a normaliser of another definition.

    """

    def __init__(
        self,
        reader: CorpusReader,
        *,
        length: int = CHUNK_LENGTH,
        stride: int = 1,
        relative: Relative | None = None,
        fingers: Fingers | None = None,
        normaliser: ActionNormaliser | None = None,
        padded: bool = False,
        with_shape: bool = False,
        pixels: Pixels | None = None,
        image_offsets: Sequence[int] = (0,),
    ) -> None:
        for name, value in (("length", length), ("stride", stride)):
            if type(value) is not int or value < 1:
                raise ValueError(f"{name}: expected a whole number of at least 1, got {value!r}")
        if with_shape and not padded:
            raise ValueError("with_shape: expected only with padded=True, as states have shapes")
        self.reader, self.length, self.stride = reader, length, stride
        self.relative: Relative
        self.fingers: Fingers
        self.relative, self.fingers = _definition(relative, fingers, normaliser)
        self.normaliser, self.padded, self.with_shape = normaliser, padded, with_shape
        self.pixels, self.image_offsets = pixels, _offsets(image_offsets)
        counts = -(-reader.num_frames // stride)
        self._ends = np.cumsum(counts, dtype=np.int64)
        self._known: dict[int, _Said] = {}

    def __len__(self) -> int:
        return int(self._ends[-1]) if len(self._ends) else 0

    def positions(self, samples: ArrayLike) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the episodes (B,) of samples (B,), and the first frames of their chunks (B,).

        Raises:
            IndexError: there is no such sample.
            ValueError: numbers that are not whole.

        """
        index = np.atleast_1d(np.asarray(samples))
        if index.size and index.dtype.kind not in "iu":
            raise ValueError(f"samples: expected whole numbers, got {index.dtype}")
        index = index.astype(np.int64)
        if index.size and not -len(self) <= index.min() <= index.max() < len(self):
            got = f"{index.min()} .. {index.max()}" if len(index) > 1 else str(index[0])
            raise IndexError(f"sample: expected 0 .. {len(self) - 1}, got {got}")
        index = index % max(len(self), 1)
        episode = np.searchsorted(self._ends, index, side="right")
        first = np.concatenate([[0], self._ends])[episode]
        return episode, (index - first) * self.stride

    def __getitem__(self, i: int) -> dict[str, Any]:
        """Return one sample.

        Raises:
            IndexError: there is no such sample.
            CorpusError: its episode cannot be read; names shard and episode.
            VideoError: its pictures cannot be read.

        """
        made = self._samples(*self.positions(i))
        return _pick(made, 0)

    def __getitems__(self, indices: list[int]) -> list[dict[str, Any]]:
        """Return several samples, computed together; a DataLoader asks for batches this way.

        With a reader that skips, samples of episodes that cannot be read are left out.

        Raises:
            CorpusError: none of them can be read. Else as of one sample.

        """
        made = self.batch(indices)
        count = len(made["episode"])
        if indices and not count:
            raise CorpusError(f"samples: expected one of {indices[:4]} that can be read, got none")
        return [_pick(made, k) for k in range(count)]

    def batch(self, samples: ArrayLike) -> dict[str, Any]:
        """Return samples side by side: every tensor with a leading (B,), texts as lists of B.

        With a reader that skips, a batch is shorter by those that cannot be read.

        Raises:
            IndexError: there is no such sample.
            CorpusError: an episode cannot be read; names shard and episode.
            VideoError: pictures cannot be read.
            ValueError: pictures of different sizes.

        """
        episode, frame = self.positions(samples)
        usable = self.reader.usable(episode)
        return self._samples(episode[usable], frame[usable])

    def stream(
        self,
        batch: int,
        *,
        seed: int | None = 0,
        rank: int = 0,
        world_size: int = 1,
        drop_last: bool = False,
    ) -> "ActionStream":
        """Return the samples as batches in elastic order, for ``stream.ElasticLoader``.

        Arguments and errors are those of ``stream.ElasticStream``.
        """
        options: dict[str, Any] = {"seed": seed, "rank": rank, "world_size": world_size}
        return ActionStream(self, batch, drop_last=drop_last, **options)

    def chunks(self, samples: ArrayLike) -> ActionChunks:
        """Return the chunks of samples (B,) as arrays, normalised but not padded."""
        return self._chunks(*self.positions(samples))

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_known": {}}

    # ------------------------------------------------------------- private

    def _samples(self, episode: NDArray[np.int64], frame: NDArray[np.int64]) -> dict[str, Any]:
        chunks = self._chunks(episode, frame)
        arrays: dict[str, Any] = {"state": chunks.state, "action": chunks.action}
        if self.padded:
            action, action_mask = pad_action(chunks.action, chunks.mask)
            state, state_mask = pad_state(
                chunks.state, chunks.state_mask, with_shape=self.with_shape
            )
            arrays = {"state": state, "action": action}
            arrays |= {"action_number_mask": action_mask, "state_number_mask": state_mask}
        arrays |= {"state_mask": chunks.state_mask, "mask": chunks.mask}
        arrays |= {"episode": episode, "frame": frame}
        if self.pixels is not None:
            arrays["pixels"] = pictures(
                self.reader, self.pixels, episode, frame, self.image_offsets
            )
        places = list(zip(episode.tolist(), frame.tolist(), strict=True))
        text = {side: [self._said(i).text_of(side, k) for i, k in places] for side in SIDES}
        return {**{name: torch.from_numpy(array) for name, array in arrays.items()}, "text": text}

    def _chunks(self, episode: NDArray[np.int64], frame: NDArray[np.int64]) -> ActionChunks:
        """Chunks of the rows from each frame on, of which those past the end do not count."""
        wanted = frame[:, None] + np.arange(self.length + 1)
        last = self.reader.num_frames[episode] - 1
        rows = self._rows(episode, wanted.clip(max=last[:, None]))
        flat = {name: array.reshape(-1, array.shape[-1]) for name, array in rows.items()}
        shapes = [self._said(i).shape for i in episode.tolist()]
        shape = np.repeat(np.array(shapes).reshape(-1, *_SHAPE), wanted.shape[1], axis=0)
        try:
            there = presence_of(flat[TRAJ])
            state = hand_states(flat, shape, there)
        except EpisodeError:
            for i in np.unique(episode).tolist():
                self.reader[i]  # raises for the one that it is, and names it
            raise
        camera = camera_state.unpack(
            flat[TRAJ][:, : member(TRAJ).slices["fov_vh"].stop].astype(np.float64)
        )
        chunks = window_actions(
            camera.T_camera_from_world().reshape(*wanted.shape, 4, 4),
            state.reshape(*wanted.shape, *state.shape[1:]),
            there.reshape(*wanted.shape, 2) & (wanted <= last[:, None])[..., None],
            relative=self.relative,
            fingers=self.fingers,
        )
        return chunks if self.normaliser is None else self.normaliser.normalise(chunks)

    def _rows(
        self, episode: NDArray[np.int64], wanted: NDArray[np.int64]
    ) -> dict[str, NDArray[Any]]:
        """Return the frames ``wanted`` (B, L + 1) of each episode, (B, L + 1, C) by member."""
        span = np.minimum(self.reader.num_frames[episode], wanted.shape[1])
        first = np.minimum(wanted[:, 0], self.reader.num_frames[episode] - span)
        rows: dict[str, NDArray[Any]] = {}
        lengths = np.unique(span).tolist()  # one, but for episodes shorter than a chunk
        for length in lengths or [wanted.shape[1]]:
            mine = np.flatnonzero(span == length)
            windows = self.reader.windows(episode[mine], first[mine], length)
            within = wanted[mine] - first[mine, None]
            for name, array in windows.arrays.items():
                if name not in rows:
                    rows[name] = np.empty((*wanted.shape, array.shape[-1]), array.dtype)
                rows[name][mine] = np.take_along_axis(array, within[..., None], axis=1)
        return rows

    def _said(self, i: int) -> "_Said":
        if (said := self._known.get(i)) is None:
            values = decode_meta(self.reader.member(i, META))
            text = tuple(map(TextSegment.from_dict, values["text"]))
            if len(self._known) >= _KEPT_EPISODES:
                self._known.clear()
            said = self._known[i] = _Said(np.asarray(values["shape"], np.float32), text)
        return said


class ActionStream(ElasticStream):
    """Batches of a dataset's samples, each once an epoch: ``ActionDataset.batch``."""

    def __init__(self, dataset: ActionDataset, batch: int, **options: Any) -> None:
        super().__init__(len(dataset), batch, **options)
        self.dataset = dataset

    def batch_of(self, samples: NDArray[np.int64], epoch: int) -> dict[str, Any]:
        """Return ``ActionDataset.batch``, which is the same in every epoch."""
        return self.dataset.batch(samples)


class _Said(NamedTuple):
    """What the json member of an episode says for all of its chunks."""

    shape: NDArray[np.float32]  # (2, 10)
    text: tuple[TextSegment, ...]

    def text_of(self, side: str, frame: int) -> str:
        """What is said of a hand at a frame."""
        return "; ".join(
            s.text for s in self.text if s.start <= frame < s.end and s.side in (side, "both", None)
        )


def _pick(made: dict[str, Any], k: int) -> dict[str, Any]:
    text = {side: texts[k] for side, texts in made["text"].items()}
    return {**{n: values[k] for n, values in made.items() if n != "text"}, "text": text}


def _definition(
    relative: Relative | None, fingers: Fingers | None, normaliser: ActionNormaliser | None
) -> tuple[Relative, Fingers]:
    """Return the definition that is asked for, which a normaliser shares."""
    default = DEFINITIONS[0] if normaliser is None else (normaliser.relative, normaliser.fingers)
    chosen = relative or default[0], fingers or default[1]
    if chosen not in DEFINITIONS:
        raise ValueError(
            f"relative, fingers: expected one of {list(DEFINITIONS)}, got {(relative, fingers)}"
        )
    if normaliser is not None and chosen != default:
        raise ValueError(
            f"normaliser: expected one of the definition {chosen}, got one of {default}"
        )
    return chosen


def _offsets(offsets: Sequence[int]) -> NDArray[np.int64]:
    array = np.asarray(offsets)
    if array.ndim != 1 or not array.size or array.dtype.kind not in "iu":
        raise ValueError(f"image_offsets: expected whole numbers (N,), N >= 1, got {offsets!r}")
    return array.astype(np.int64)
