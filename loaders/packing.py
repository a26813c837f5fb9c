"""Video that users may store, packed beside the labels, so that a pixel window needs no long seek.

A clip (`clips`) is one ``mp4`` member of a sample. Its frame k shows frame k of the episode, in the
labels' geometry: a lens is undone before.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from os import PathLike
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

from mint_hub.loaders.attach import VideoAttachment
from mint_hub.loaders.clips import (
    CRF,
    GOP,
    PRESET,
    Images,
    PackedClip,
    Size,
    clip_size,
    decode_window,
    encode_clip,
)
from mint_hub.loaders.derived import VIDEO_MEMBER
from mint_hub.loaders.resolvers import VideoReference, Videos, resolve
from mint_hub.loaders.schema import Episode
from mint_hub.loaders.video_source import VideoError, VideoNotFoundError, VideoSource

if TYPE_CHECKING:
    from mint_hub.loaders.reader import CorpusReader
    from mint_hub.loaders.shards import CorpusReport, Indexed

__all__ = [
    "MP4",
    "PackReport",
    "PackedClip",
    "Packer",
    "PixelWindow",
    "decode_window",
    "encode_clip",
    "pack",
    "pack_corpus",
    "packed_images",
    "pixel_window",
    "read_window",
]

MP4: Final = VIDEO_MEMBER
"""Name of the member that holds a clip."""

_CHUNK: Final = 64

OnMissing = Literal["raise", "skip"]


class PixelWindow(NamedTuple):
    """Labels and pixels of the same frames.

    Attributes:
        episode: the frames' labels; ``image_size_hw`` is the pictures', so that ``K`` fits them.
        images: (length, H, W, 3) uint8 RGB.

    """

    episode: Episode
    images: Images


def read_window(
    episode: Episode,
    mp4: VideoSource,
    start: int = 0,
    length: int | None = None,
    size_hw: tuple[int, int] | None = None,
) -> PixelWindow:
    """Return a window of a whole episode together with its pictures from the episode's clip.

    Raises:
        VideoError: a damaged clip, or one that has another number of frames than the episode.
        ValueError: the frames are not all there.

    """
    images = _images(mp4, episode.num_frames, episode.key, start, length, size_hw)
    height, width = images.shape[1:3]
    window = episode.window(start, len(images))
    return PixelWindow(replace(window, image_size_hw=(height, width)), images)


def pixel_window(
    reader: "CorpusReader",
    i: int,
    start: int = 0,
    length: int | None = None,
    size_hw: tuple[int, int] | None = None,
) -> PixelWindow:
    """Return labels and pictures of a window of episode ``i`` of a packed corpus.

    Raises:
        CorpusError: the episode cannot be read, or the config holds no video.
        VideoError: its clip is damaged.
        ValueError: the frames are not all there.

    """
    return read_window(reader[i], reader.member(i, MP4), start, length, size_hw)


def packed_images(
    reader: "CorpusReader",
    i: int,
    start: int = 0,
    length: int | None = None,
    size_hw: tuple[int, int] | None = None,
) -> Images:
    """Return the pictures of ``pixel_window`` alone, (length, H, W, 3) uint8 RGB; errors alike."""
    mp4, num_frames = reader.member(i, MP4), int(reader.num_frames[i])
    return _images(mp4, num_frames, reader.key(i), start, length, size_hw)


def _images(
    mp4: VideoSource,
    num_frames: int,
    key: str,
    start: int,
    length: int | None,
    size_hw: tuple[int, int] | None,
) -> Images:
    """Pictures of the clip of an episode; errors name it."""
    try:
        with PackedClip(mp4) as clip:
            if clip.num_frames != num_frames:
                raise VideoError(f"{MP4}: expected {num_frames} frames, got {clip.num_frames}")
            return clip.images(start, length, size_hw)
    except ValueError as error:
        raise type(error)(f"{error} (episode {key})") from None


# ----------------------------------------------------------------------- pack


@dataclass(frozen=True)
class Packer:
    """From an episode to its clip: what ``write_corpus`` takes as ``extra_members``.

    It can be sent to other processes when ``videos`` can (a lambda cannot).

    Attributes:
        videos: where the user's videos are: see `resolvers.resolve`.
        size_hw, gop, crf, preset: see `encode_clip`; the size is by default the episode's.
        options: what `VideoAttachment` takes beside.
        lenses: the ``lens`` of each video by its uid, where ``options`` have none for all; a video
            that is not named has that of its labels.

    """

    videos: Videos
    size_hw: Size = None
    gop: int = GOP
    crf: int = CRF
    preset: str = PRESET
    options: dict[str, Any] | None = None
    lenses: dict[str, Any] | None = None

    def __call__(self, episode: Episode) -> dict[str, bytes]:
        """Return ``{"mp4": bytes}``; errors as of `VideoAttachment`."""
        options, uid = dict(self.options or {}), episode.meta.get("uid")
        if self.lenses is not None and uid in self.lenses:
            options["lens"] = self.lenses[uid]
        video = VideoAttachment(episode, self.videos, **options)
        size = clip_size(self.size_hw, episode.image_size_hw)
        lengths = range(0, episode.num_frames, _CHUNK)
        chunks = (
            video.window(start, min(_CHUNK, episode.num_frames - start), size).images
            for start in lengths
        )
        images = (image for chunk in chunks for image in chunk)
        clip = encode_clip(
            images, fps=episode.fps, gop=self.gop, size_hw=size, crf=self.crf, preset=self.preset
        )
        return {MP4: clip}


def pack(
    episodes: Iterable[Episode], packer: Packer, on_missing: OnMissing = "raise"
) -> Iterator[tuple[Episode, dict[str, bytes]]]:
    """Yield each episode with its further members.

    Args:
        episodes: what to pack.
        packer: how, and from which videos.
        on_missing: of an episode whose video is not there: "raise", or "skip" it.

    Raises:
        VideoNotFoundError: a video is not there; other errors as of `VideoAttachment`.

    """
    for episode in episodes:
        try:
            members = packer(episode)
        except VideoNotFoundError:
            if on_missing == "skip":
                continue
            raise
        yield episode, members


class PackReport(NamedTuple):
    """What ``pack_corpus`` did: the writer's report, and the keys whose videos were not there."""

    corpus: "CorpusReport"
    missing: tuple[str, ...]


def pack_corpus(
    episodes: "Indexed",
    packer: Packer,
    folder: str | PathLike[str],
    config: str,
    split: str,
    *,
    on_missing: OnMissing = "raise",
    **options: Any,
) -> PackReport:
    """Write a split with pictures: labels and clips in the same shards (``mint-hub pack``).

    Args:
        episodes: what to pack, a `CorpusReader`, or anything with ``len`` and ``[i]``.
        packer: how, and from which videos.
        folder: the corpus to write to.
        config: its config; one of its own, as all samples of a config have the same members.
        split: its split.
        on_missing: of an episode whose video is not there: "raise" before anything is written, or
            "skip" it and tell.
        options: what ``write_corpus`` takes beside: format, num_procs, progress, ...

    Raises:
        VideoNotFoundError: a video is not there; names how many and the first.
        VideoError: a video is another one than the labels say, or damaged.
        CorpusError: as ``write_corpus`` does.

    """
    from mint_hub.loaders.shards import write_corpus

    missing = missing_videos(episodes, packer.videos)
    if missing and (on_missing == "raise" or len(missing) == len(episodes)):
        raise all_missing(missing, len(episodes))
    there = [i for i in range(len(episodes)) if i not in missing]
    chosen = _Chosen(episodes, there) if missing else episodes
    report = write_corpus(chosen, folder, config, split, extra_members=packer, **options)
    return PackReport(report, tuple(episodes[i].key for i in missing))


def missing_videos(episodes: "Indexed", videos: Videos) -> dict[int, VideoNotFoundError]:
    """Look for the video of every episode: what is said of those that are not there, by number."""
    missing: dict[int, VideoNotFoundError] = {}
    for i in range(len(episodes)):
        try:
            resolve(VideoReference.of(episodes[i]), videos)
        except VideoNotFoundError as error:
            missing[i] = error
    return missing


def all_missing(missing: Mapping[int, VideoNotFoundError], count: int) -> VideoNotFoundError:
    """One error for many: how many of ``count``, and the first."""
    first = next(iter(missing.values()))
    return VideoNotFoundError(f"{len(missing)} of {count} videos are missing; {first}")


@dataclass(frozen=True)
class _Chosen:
    """Some of the episodes, by number."""

    episodes: "Indexed"
    numbers: list[int]

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, i: int, /) -> Episode:
        return self.episodes[self.numbers[i]]
