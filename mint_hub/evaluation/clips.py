"""What a benchmark is: clips with truth, the camera they are scored in, and pictures where any.

A `Clip` is read when asked for, so that a corpus never lies in memory; a `Source` says in a few
words which benchmark it is, so that every process opens its own.
"""

import hashlib
import json
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any, Final, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry.hand_model import HandModel
from mint_hub.loaders.clips import PackedClip
from mint_hub.loaders.schema import Episode
from mint_hub.synth.undo_lens import lens_of, undo_lens

Image = NDArray[np.uint8]
Name = Literal["bench", "bench-ood", "hot3d", "arctic", "shards", "labels"]
NAMES: Final[tuple[Name, ...]] = ("bench", "bench-ood", "hot3d", "arctic", "shards", "labels")


class BenchmarkError(ValueError):
    """A benchmark that cannot be used: the message names the file and where to get it."""


class MissingFilesError(BenchmarkError, FileNotFoundError):
    """A file of a benchmark is not there."""

    def __str__(self) -> str:
        return str(self.args[0])


@dataclass(frozen=True)
class Source:
    """Which benchmark, in words that travel to other processes.

    Attributes:
        name: one of NAMES.
        root: the user's folder; for the synthetic ones, where they are kept.
        config: config of a corpus folder; None where it has one only.
        split: split of a corpus folder, of HOT3D-Clips or of ARCTIC; None for the usual one.
        protocol: ARCTIC's, "p1" or "p2".
        stream: HOT3D's camera.
        mano_dir: folder with the user's MANO files.
        clip_frames: cut sequences into clips of so many frames, tails included.
        limit: only so many clips, evenly spread.

    """

    name: Name
    root: str = ""
    config: str | None = None
    split: str | None = None
    protocol: Literal["p1", "p2"] = "p2"
    stream: str | None = None
    mano_dir: str | None = None
    clip_frames: int | None = None
    limit: int | None = None

    def __post_init__(self) -> None:
        for name in ("clip_frames", "limit"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"{name}: expected at least 1, got {value}")


class Frames(ABC):
    """Pictures of a clip, one for each frame of its truth."""

    @abstractmethod
    def images(self, start: int = 0) -> Iterator[Image]:
        """Yield (H, W, 3) uint8 RGB, as the protocol's camera sees them, in order, from ``start``.

        Those before it are not decoded.
        """

    @abstractmethod
    def stamp(self) -> str:
        """Return words that change when the pictures do."""


@dataclass(frozen=True, eq=False)
class PackedFrames(Frames):
    """The pictures of an mp4 in a shard, as the camera of its episode's labels would take them."""

    mp4: bytes
    episode: Episode

    def images(self, start: int = 0) -> Iterator[Image]:
        """Yield the decoded frames; a synthetic clip's lens is undone."""
        with PackedClip(self.mp4) as clip:
            for at in range(start, clip.num_frames, 32):
                shown = clip.images(at, min(32, clip.num_frames - at))
                yield from undo_lens(shown, self.episode)

    def stamp(self) -> str:
        """Return the hash of the bytes, and of the lens where there is one."""
        lens = lens_of(self.episode)
        bent = b"" if lens is None else json.dumps(lens.to_dict(), sort_keys=True).encode()
        return hashlib.sha256(self.mp4 + bent).hexdigest()


@dataclass(frozen=True, eq=False)
class FrameWindow(Frames):
    """Some consecutive pictures of other ones."""

    whole: Frames
    start: int
    length: int

    def images(self, start: int = 0) -> Iterator[Image]:
        """Yield frames start .. length - 1 of the window."""
        yield from islice(self.whole.images(self.start + start), self.length - start)

    def stamp(self) -> str:
        """Return the whole's, and which part."""
        return f"{self.whole.stamp()} {self.start}+{self.length}"


@dataclass(frozen=True, eq=False)
class Clip:
    """One unit of a benchmark: what is scored together and drawn together by the bootstrap.

    Attributes:
        key: its name within the benchmark.
        truth: what is true, T frames.
        K: (3, 3) pixels, the camera of the protocol; (T, 3, 3) where it zooms.
        image_size_hw: of the protocol's image, in which a hand is on screen or not.
        frames: the pictures; None where the user has none.
        hand_model: turns the truth's states into joints.
        source: data set that it comes from.
        visible: (T, 2) share of each hand that can be seen, 0..1, NaN where unknown; or None.
        hands: whether the truth knows the hands.
        without_frames: why there are no pictures, and where to get them.
        part_of: key of the clip that this is a window of.
        whole_frames: how many frames that clip has; None where this is no window.

    """

    key: str
    truth: Episode
    K: NDArray[np.float64]
    image_size_hw: tuple[int, int]
    frames: Frames | None
    hand_model: HandModel
    source: str
    visible: NDArray[np.float32] | None = None
    hands: bool = True
    without_frames: str = ""
    part_of: str | None = None
    whole_frames: int | None = None

    @property
    def whole(self) -> tuple[str, int]:
        """Key of the clip that this is a window of, and its first frame there; its own and 0."""
        cut = self.part_of is not None
        return (self.part_of or self.key, int(self.key.rpartition("-")[2]) if cut else 0)

    def window(self, start: int, length: int) -> "Clip":
        """Return frames start .. start + length - 1 as a clip of their own."""
        part = slice(start, start + length)
        key = f"{self.key}-{start:06d}"
        return replace(
            self,
            key=key,
            part_of=self.key,
            whole_frames=self.truth.num_frames,
            truth=replace(self.truth.window(start, length), key=key),
            K=self.K if self.K.ndim == 2 else self.K[part],
            frames=None if self.frames is None else FrameWindow(self.frames, start, length),
            visible=None if self.visible is None else self.visible[part],
        )

    def truth_stamp(self) -> str:
        """Return 16 hex digits that change when the truth, its hand or its camera does.

        Pictures do not count: two scores are of the same truth wherever the pictures lie, or where
        one side had none. Numbers are rounded (poses and states to 1e-5, K to a thousandth of a
        pixel), for their last bits differ from machine to machine.
        """
        digest = hashlib.sha256(f"{self.key} {self.image_size_hw} {self.hands}".encode())
        arrays = {k: v for k, v in self.truth.to_dict().items() if isinstance(v, np.ndarray)}
        if self.visible is not None:
            arrays["visible"] = self.visible
        for name, values in arrays.items():
            digest.update(f" {name} ".encode() + _rounded(values, 5))
        digest.update(_rounded(self.K, 3) + _hand_stamp(self.hand_model).encode())
        return digest.hexdigest()[:16]

    def stamp(self) -> str:
        """Return 16 hex digits that change when truth or pictures do: what a prediction is of."""
        pictures = "" if self.frames is None else self.frames.stamp()
        return hashlib.sha256(f"{self.truth_stamp()} {pictures}".encode()).hexdigest()[:16]


def _rounded(values: NDArray[Any], digits: int) -> bytes:
    """The bytes of an array, numbers to so many digits, minus zero as zero."""
    if values.dtype.kind == "f":
        values = np.round(values.astype(np.float64), digits) + 0.0
    return f"{values.shape}".encode() + np.ascontiguousarray(values).tobytes()


@lru_cache(maxsize=4)
def _hand_stamp(model: HandModel) -> str:
    """Words that change when any array of a pair of hands does, or what their shapes mean."""
    digest = hashlib.sha256(model.shape_space.encode())
    for asset in (model.left, model.right):
        for array in fields(asset):
            values = getattr(asset, array.name)
            if isinstance(values, np.ndarray):
                digest.update(f" {array.name} ".encode() + _rounded(values, 8))
    return digest.hexdigest()


class Benchmark(ABC):
    """Clips by number; ``clip`` reads one.

    Attributes:
        source: what it was opened from.
        title: its name for people.
        published: key of the published numbers to print beside ours, or None.
        notes: what a reader of the numbers has to know.

    """

    source: Source
    title: str
    published: str | None = None
    notes: tuple[str, ...] = ()

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def clip(self, i: int) -> Clip:
        """Read clip ``i``.

        Raises:
            BenchmarkError: it cannot be read; names the file.

        """

    def num_frames(self, i: int) -> int:
        """Return the length of clip ``i``; reads no more than that where its files allow."""
        return self.clip(i).truth.num_frames

    def __iter__(self) -> Iterator[Clip]:
        return (self.clip(i) for i in range(len(self)))


@dataclass(eq=False)
class Chosen(Benchmark):
    """Parts of the clips of another benchmark: cut to a length, thinned out.

    The last whole clip is kept, for the next part is mostly of the same.
    """

    whole: Benchmark
    parts: Sequence[tuple[int, int, int]]
    source: Source = field(init=False)
    _last: tuple[int, Clip] | None = field(init=False, default=None, repr=False)

    def __post_init__(self) -> None:
        self.source, self.title = self.whole.source, self.whole.title
        self.published, self.notes = self.whole.published, self.whole.notes

    def __len__(self) -> int:
        return len(self.parts)

    def clip(self, i: int) -> Clip:
        """Read clip ``i``; errors as of the whole benchmark."""
        number, start, length = self.parts[i]
        if self._last is None or self._last[0] != number:
            self._last = (number, self.whole.clip(number))
        clip = self._last[1]
        return clip if length == 0 else clip.window(start, length)

    def num_frames(self, i: int) -> int:
        """Return the length of clip ``i``."""
        number, _, length = self.parts[i]
        return length or self.whole.num_frames(number)


def chosen(benchmark: Benchmark) -> Benchmark:
    """Cut and thin out as ``benchmark.source`` says."""
    source = benchmark.source
    numbers = list(range(len(benchmark)))
    if source.limit is not None and source.limit < len(numbers):
        spread = np.linspace(0, len(numbers) - 1, source.limit).round().astype(int)
        numbers = sorted(set(spread.tolist()))
    if source.clip_frames is None:
        return Chosen(benchmark, [(i, 0, 0) for i in numbers]) if source.limit else benchmark
    size, parts = source.clip_frames, list[tuple[int, int, int]]()
    for i in numbers:
        frames = benchmark.num_frames(i)
        parts += [(i, at, min(size, frames - at)) for at in range(0, frames, size)]
    return Chosen(benchmark, parts)


def truth_model(episode: Episode, mano_dir: str | Path | None) -> HandModel:
    """Return the hand of an episode's shape space: the user's MANO hand, or the template."""
    if episode.meta.get("shape_space") == "mano":
        return HandModel.default(mano_dir)
    return HandModel.template()


def knows_hands(episode: Episode) -> bool:
    """Whether the record has hands; an episode whose hands cannot be read says so in its meta."""
    quality = episode.meta.get("quality")
    words = quality.get("hands") if isinstance(quality, dict) else None
    return not str(words or "").startswith("unavailable")


def decoded_picture(data: bytes, name: str, advice: str) -> Image:
    """Decode a JPEG or PNG file to (H, W, 3) RGB.

    Raises:
        BenchmarkError: it is none; names it and gives the advice.

    """
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
    if image is None:
        raise BenchmarkError(
            f"{name}: expected a picture, got {len(data)} bytes that are none; {advice}"
        )
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB).astype(np.uint8)


def image_folder_stamp(paths: Sequence[Path]) -> str:
    """Return words that change when any of these files does."""
    digest = hashlib.sha256()
    for path in paths:
        facts = path.stat()
        digest.update(f"{path.name} {facts.st_size} {facts.st_mtime_ns}\n".encode())
    return digest.hexdigest()
