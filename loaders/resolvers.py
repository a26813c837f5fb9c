"""Where the video of an episode lies on the user's disk.

No video travels with the corpus: an episode names its source and a uid, and users have the files
from where those are published. A resolver is any function from a `VideoReference` to a file.
"""

import glob
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from mint_hub.loaders.fields import checked_size
from mint_hub.loaders.lerobot_origin import file_in_root
from mint_hub.loaders.participants import participant_of
from mint_hub.loaders.schema import Episode
from mint_hub.loaders.video_source import VideoError, VideoNotFoundError, VideoSource

GET_EGO4D: Final = (
    "sign its licence at https://ego4d-data.org and run "
    "`ego4d --output_directory ROOT --datasets full_scale --video_uids {uid}`"
)
GET_EPIC: Final = (
    "take it from https://epic-kitchens.github.io (epic-kitchens-download-scripts: "
    "`python epic_downloader.py --videos --participants {participant} --output-path ROOT`)"
)
GET_EGODEX: Final = (
    "take the archives part1 to part5, test and extra from EgoDex's page, "
    "https://github.com/apple/ml-egodex, and unpack them into ROOT"
)
GET_ROOT: Final = (
    "take the videos of the LeRobot root that the labels are from: they name no other video than "
    "that root's own file {uid!r}; ROOT is the folder of that root"
)
GET_OTHER: Final = "get it from whoever published {source!r}, or give another resolver"

EGODEX_PARTS: Final = ("", "part1", "part2", "part3", "part4", "part5", "test", "extra")


@dataclass(frozen=True, eq=False)
class VideoReference:
    """What an episode knows of its video.

    Attributes:
        key: of the episode, for errors.
        source: data set, such as "ego4d", "epic" or "egodex"; "" where unknown.
        uid: name of the video within it; "" where unknown.
        participant: who wears the camera; "" where unknown.
        timestamps_s: (T,) seconds, when each frame of the episode is shown, on the clock of the
            labels.
        image_size_hw: size that the labels refer to.
        native_fps: frames a second of the video; None where unknown.
        duration_s: seconds the whole video lasts (``video_duration_s``); None where unknown.
        video_start_s: when its first frame is shown, on the clock of the labels (Ego4D's
            ``video_start_sec``); None where the labels use the container's clock.
        lens: what `lens_from` takes, where labels refer to rectified pictures; None where not.
        undistorted: whether labels refer to undistorted pictures.
        turn_clockwise_deg: 0, 90, 180 or 270: how the picture, rectified if it has to be, is turned
            to be that of the labels (``image_turn_clockwise_deg``, of HOT3D's Aria cameras).

    """

    key: str
    source: str
    uid: str
    participant: str
    timestamps_s: NDArray[np.float64]
    image_size_hw: tuple[int, int]
    native_fps: float | None = None
    duration_s: float | None = None
    video_start_s: float | None = None
    lens: Any = None
    undistorted: bool = False
    turn_clockwise_deg: int = 0

    @classmethod
    def of(cls, episode: "Episode | Mapping[str, Any]") -> "VideoReference":
        """Read an episode, or the ``json`` member of one as `members.decode_meta` returns it.

        Raises:
            ValueError: the mapping lacks an entry that is needed here.

        """
        if isinstance(episode, Episode):
            times, size = episode.timestamps_s, episode.image_size_hw
            key, meta = episode.key, episode.meta
        else:
            needed = ("key", "start_s", "fps", "num_frames", "image_size_hw")
            if missing := [name for name in needed if name not in episode]:
                raise ValueError(f"{missing[0]}: expected this entry of the json member, got none")
            times = episode["start_s"] + np.arange(episode["num_frames"]) / episode["fps"]
            size, key = checked_size(episode["image_size_hw"]), episode["key"]
            meta = {**episode, **episode.get("meta", {})}
        return cls(
            key=key,
            source=meta.get("source") or "",
            uid=meta.get("uid") or "",
            participant=meta.get("participant") or "",
            timestamps_s=times,
            image_size_hw=size,
            native_fps=_number(meta, "native_fps", key),
            duration_s=_number(meta, "video_duration_s", key),
            video_start_s=_number(meta, "video_start_sec", key),
            lens=meta.get("lens"),
            undistorted=bool(meta.get("undistorted")),
            turn_clockwise_deg=_turn(meta, key),
        )


Resolver = Callable[[VideoReference], VideoSource | None]
"""From a reference to its video; None, or a path where nothing is, is refused by name."""

Videos = Resolver | Mapping[str, Any] | str | PathLike[str]
"""What users may give: a resolver, one for each source, a folder, or the one file itself."""


@dataclass(frozen=True)
class Ego4DVideos:
    """Videos as Ego4D's tool downloads them: ``ROOT[/v1 | /v2]/full_scale/<uid>.mp4``."""

    root: str | PathLike[str]

    def __call__(self, video: VideoReference) -> Path:
        """Return the file, or raise VideoNotFoundError that tells where it was looked for."""
        name = f"{_safe_uid(video)}.mp4"
        folders = ("full_scale", "v2/full_scale", "v1/full_scale", "")
        return _only(video, [Path(self.root, folder, name) for folder in folders], GET_EGO4D)


@dataclass(frozen=True)
class EpicVideos:
    """Videos of EPIC-KITCHENS: ``ROOT[/EPIC-KITCHENS]/Pxx/videos/<id>.MP4``."""

    root: str | PathLike[str]

    def __call__(self, video: VideoReference) -> Path:
        """Return the file, or raise VideoNotFoundError that tells where it was looked for."""
        uid = _safe_uid(video)
        person = participant_of("epic", uid) or uid.partition("_")[0]
        folders = (f"{person}/videos", f"EPIC-KITCHENS/{person}/videos", person, "")
        names = [f"{uid}{suffix}" for suffix in (".MP4", ".mp4")]
        places = [Path(self.root, folder, name) for folder in folders for name in names]
        return _only(video, places, GET_EPIC, participant=person)


@dataclass(frozen=True)
class EgoDexVideos:
    """Videos of EgoDex, whose uid is ``task/N``: ``ROOT[/part1 ...]/task/N.mp4``.

    Tasks may be numbered alike in several parts: then the uid has to name the part as well.
    """

    root: str | PathLike[str]

    def __call__(self, video: VideoReference) -> Path:
        """Return the file, or raise a VideoError: not found, or found in more than one part."""
        name = f"{_safe_uid(video)}.mp4"
        return _only(video, [Path(self.root, part, name) for part in EGODEX_PARTS], GET_EGODEX)


@dataclass(frozen=True)
class FolderVideos:
    """Videos in a folder, named by a pattern.

    It may say ``{uid}``, ``{key}``, ``{source}`` and ``{participant}`` of the episode, and
    hold wildcards as in `glob` ("**/{uid}.*"); it has to fit exactly one file.

    Raises:
        ValueError: the pattern names something else.

    """

    root: str | PathLike[str]
    pattern: str = "{uid}.mp4"

    def __post_init__(self) -> None:
        try:
            self.pattern.format(**dict.fromkeys(("uid", "key", "source", "participant"), ""))
        except (KeyError, IndexError, ValueError) as error:
            expected = "{uid}, {key}, {source} or {participant}"
            raise ValueError(f"pattern: expected only {expected}, got {self.pattern!r}") from error

    def __call__(self, video: VideoReference) -> Path:
        """Return the file, or raise a VideoError: not found, or more than one fits."""
        uid = _safe_uid(video) if "{uid" in self.pattern else video.uid
        values = {
            "uid": uid,
            "key": video.key,
            "source": _plain(video, "source", video.source),
            "participant": _plain(video, "participant", video.participant),
        }
        place = Path(self.root, self.pattern.format(**values))
        if not glob.has_magic(self.pattern):
            return _only(video, [place], GET_OTHER)
        escaped = {name: glob.escape(value) for name, value in values.items()}
        found = glob.glob(self.pattern.format(**escaped), root_dir=self.root, recursive=True)
        places = [Path(self.root, name) for name in sorted(found)]
        return _only(video, places or [place], GET_OTHER)


KNOWN_SOURCES: Final[Mapping[str, Callable[[str | PathLike[str]], Resolver]]] = {
    "ego4d": Ego4DVideos,
    "epic": EpicVideos,
    "egodex": EgoDexVideos,
}
"""How the files of each source of the corpus lie below the user's folder."""


def resolve(video: VideoReference, videos: Videos) -> VideoSource:
    """Find the video of an episode.

    Args:
        video: what is looked for.
        videos: a resolver; a mapping from source to a resolver or folder; a folder, laid out as
            ``video.source`` is published (KNOWN_SOURCES), or else holding ``<uid>.mp4``; or the
            path or URL of the one file.

    Raises:
        VideoNotFoundError: it is not there; says where it was looked for and where to get it.
        VideoError: a mapping without this source, a uid that is no file name, several files.

    """
    if isinstance(videos, Mapping):
        if video.source not in videos:
            known = ", ".join(sorted(map(str, videos))) or "none"
            raise VideoError(
                f"{_named(video)}: expected a folder or resolver for this source, got only {known}"
            )
        return resolve(video, cast("Videos", videos[video.source]))
    if isinstance(videos, str | PathLike):
        path = Path(videos)
        if not path.is_dir():
            return videos
        return KNOWN_SOURCES.get(video.source, FolderVideos)(path)(video)
    found = videos(video)
    if found is None:
        name = getattr(videos, "__name__", type(videos).__name__)
        raise VideoNotFoundError(f"{_named(video)}: the resolver {name} knows no such video")
    return found


def _only(
    video: VideoReference, places: Sequence[Path], hint: str, participant: str | None = None
) -> Path:
    """Return the one place where there is a file; several names of one file are one."""
    found = {path.resolve(): path for path in reversed(places) if path.is_file()}
    if len(found) == 1:
        return next(iter(found.values()))
    if found:
        names = ", ".join(sorted(map(str, found.values())))
        raise VideoError(f"{_named(video)}: expected one file, got {names}; make the uid say which")
    tried = "\n  ".join(map(str, places))
    person = participant or video.participant
    hint = hint if file_in_root(video.uid) is None else GET_ROOT
    how = hint.format(uid=video.uid, source=video.source, participant=person)
    raise VideoNotFoundError(
        f"{_named(video)}: there is no such video; looked for\n  {tried}\nTo get it, {how}"
    )


def _safe_uid(video: VideoReference) -> str:
    """Return which file the uid is, without its suffix.

    Labels come from elsewhere and must not reach outside the user's folder.
    """
    uid = file_in_root(video.uid) or video.uid
    if any(part in ("", ".", "..") or set(part) & set("\\:\0") for part in uid.split("/")):
        raise VideoError(f"{_named(video)}: expected a uid that names a file, got {video.uid!r}")
    return uid


def _plain(video: VideoReference, name: str, value: str) -> str:
    if value in (".", "..") or set(value) & set("/\\:\0"):
        raise VideoError(f"{_named(video)}: expected a {name} that names a folder, got {value!r}")
    return value


def _number(meta: Mapping[str, Any], name: str, key: str) -> float | None:
    value = meta.get(name)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise ValueError(f"meta[{name!r}]: expected a number, got {value!r} (episode {key})")
    return float(value)


def _turn(meta: Mapping[str, Any], key: str) -> int:
    turn = _number(meta, "image_turn_clockwise_deg", key) or 0
    if turn not in (0, 90, 180, 270):
        raise ValueError(
            f"meta['image_turn_clockwise_deg']: expected 0, 90, 180 or 270, got {turn:g} "
            f"(episode {key})"
        )
    return int(turn)


def _named(video: VideoReference) -> str:
    return f"video {video.uid!r} of {video.source or 'unknown source'!r} (episode {video.key})"
