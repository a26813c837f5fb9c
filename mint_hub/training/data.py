"""Windows with pictures and labels, as the network takes them.

    windows = open_windows(find_splits(["corpus"]), WindowSettings(), processor)
    example = windows.example(0)          # {"pixel_values": (T, 3, h, w), "labels": {...}}
    stream = PositionDataset(windows, positions=1000)

Windows never cross episodes. Poses are relative to a window's first frame, and camera losses are
divided by the spread of such poses over the whole training set.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import Dataset

from mint_hub.evaluation.clips import knows_hands
from mint_hub.geometry import camera_state
from mint_hub.loaders.attach import VideoAttachment
from mint_hub.loaders.derived import VIDEO_MEMBER
from mint_hub.loaders.order import Order
from mint_hub.loaders.packing import all_missing, missing_videos, packed_images
from mint_hub.loaders.resolvers import Videos
from mint_hub.loaders.schema import Episode
from mint_hub.synth.undo_lens import undo_lens
from mint_hub.training.augment import Augmentation
from mint_hub.training.clips import ClipRow, DataError, Split, Survey
from mint_hub.training.normalisation import CameraScales, CameraSums, reanchored, window_starts
from mint_hub.training.order import MixtureOrder, group_weights
from mint_hub.training.pixels import PixelCache, filter_of, resized
from mint_hub.training.recipes import Presence
from mint_hub.training.views import OVERSIZE, Tempo, View, ViewAugmentation
from mint_hub.windows import WINDOW_LENGTH

if TYPE_CHECKING:
    from mint_hub.model.processing_mint import MintProcessor

    Base = Dataset[dict[str, Any]]
else:
    Base = Dataset

__all__ = [
    "PositionDataset",
    "TrainingWindows",
    "WindowSettings",
    "collate",
    "labels_of",
    "open_windows",
]

_CAP_SEED: Final = 7
_AUGMENT: Final = 0xC0102
_VIEW: Final = 0x71E3


@dataclass(frozen=True)
class WindowSettings:
    """Which windows there are, and what they hold.

    Attributes:
        length: frames of a window.
        stride: frames from one window to the next.
        presence: what the presence head learns, see `recipes.Recipe`.
        cap_per_stratum: most windows of a (source, domain, participant); None: all of them.
        mixture: weights of sources by name; None: each window alike.
        seed: of the order and of augmentation.
        videos: where videos of episodes without packed ones are, see `loaders.resolvers.resolve`.
        allow_evaluation_clips: train on clips that are kept for evaluation, too.

    """

    length: int = WINDOW_LENGTH
    stride: int = WINDOW_LENGTH
    presence: Presence = "presence"
    cap_per_stratum: int | None = None
    mixture: Mapping[str, float] | None = None
    seed: int = 42
    videos: Videos | None = None
    allow_evaluation_clips: bool = False

    def __post_init__(self) -> None:
        for name in ("length", "stride", "cap_per_stratum"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"{name}: expected at least 1, got {value}")


def labels_of(
    episode: Episode, presence: Presence, scales: CameraScales | None = None
) -> dict[str, torch.Tensor]:
    """Labels of one window, without a batch axis: see `model.losses_mint.LossCase`.

    Args:
        episode: T frames; its first frame becomes the world.
        presence: "visible": the presence head learns the visible share of each hand, where the
            episode carries it (``presence_score`` of synthetic clips).
        scales: standard deviations that camera losses are divided by; None: one metre.

    """
    poses = reanchored(episode.T_camera_from_world)
    camera = camera_state.from_matrices(poses, episode.fov_vh_rad)
    labels = {
        "pose_encoding": torch.from_numpy(np.asarray(camera.pack(), np.float32)),
        "hand_state": torch.from_numpy(episode.hand_state.copy()),
        "presence": torch.from_numpy(episode.presence.copy()),
        "presence_target": torch.from_numpy(_presence_target(episode, presence)),
        "hands_known": torch.tensor(knows_hands(episode)),
    }
    for name in ("translation", "velocity", "acceleration"):
        std = np.ones(3) if scales is None else getattr(scales, name)
        labels[f"{name}_std"] = torch.from_numpy(np.asarray(std, np.float32))
    return labels


def _presence_target(episode: Episode, presence: Presence) -> NDArray[np.float32]:
    score = episode.presence_score
    if presence == "visible" and score is not None and isinstance(episode.meta.get("synth"), dict):
        return np.clip(score, 0, 1).astype(np.float32)
    return episode.presence.astype(np.float32)


@dataclass(frozen=True, eq=False)
class TrainingWindows:
    """The windows of a training set by number, in groups by source.

    Attributes:
        splits: where they lie.
        places: (N, 3) int64: number of the split, of its episode, and the first frame; sorted by
            source.
        sources: names of the sources, as ``sizes`` counts them.
        sizes: windows of each source.
        scales: of camera losses.
        settings: see there.
        processor: makes the network's input of pictures.
        shape_spaces: what shape numbers mean, of all episodes with hands.
        warnings: what was left out, in words.
        caches: pictures that were decoded and resized before, by number of the split.

    """

    splits: tuple[Split, ...]
    places: NDArray[np.int64]
    sources: tuple[str, ...]
    sizes: tuple[int, ...]
    scales: CameraScales
    settings: WindowSettings
    processor: MintProcessor = field(repr=False)
    shape_spaces: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    caches: Mapping[int, PixelCache] = field(default_factory=dict[int, PixelCache])

    def __len__(self) -> int:
        return len(self.places)

    @property
    def content(self) -> str:
        """Hash of the data and of how windows are made of it, 16 hex digits."""
        digest = hashlib.sha256(self.places.tobytes())
        for split in self.splits:
            digest.update(split.content.encode())
        return digest.hexdigest()[:16]

    def order(self) -> MixtureOrder:
        """Return in which order the windows are read."""
        weights = group_weights(self.sources, self.settings.mixture)
        return MixtureOrder(self.sizes, weights, self.settings.seed)

    def labels(self, number: int, span: int | None = None) -> Episode:
        """Return the frames' record of a window, without pictures.

        With ``span`` of that many frames: a stretch that holds the window, all in one episode.
        """
        split, i, start, length = self._stretch(number, span)
        return self.splits[split].episode(i).window(start, length)

    def pictures(self, number: int, span: int | None = None) -> NDArray[np.uint8]:
        """Decode the pictures of a window, (T, H, W, 3) uint8 RGB, in the geometry of its labels.

        Raises:
            VideoError: a clip that is damaged, missing, or of another length than its episode.
            ValueError: pictures of another size than their lens's.

        """
        at, i, start, length = self._stretch(number, span)
        split = self.splits[at]
        if not split.packed:
            assert self.settings.videos is not None
            video = VideoAttachment(split.reader[i], self.settings.videos)
            return video.window(start, length).images
        return undo_lens(packed_images(split.reader, i, start, length), split.episode(i))

    def resized(
        self, number: int, size_hw: tuple[int, int], span: int | None = None
    ) -> NDArray[np.uint8]:
        """Return the pictures of a window at a size, (T, h, w, 3), kept ones where there are any.

        Raises:
            VideoError: as `pictures`.

        """
        at, i, start, length = self._stretch(number, span)
        cache = self.caches.get(at)
        if cache is not None and cache.size_hw == size_hw:
            return cache.read(i, start, length)
        return resized(self.pictures(number, span), self.processor, size_hw)

    def _stretch(self, number: int, span: int | None) -> tuple[int, int, int, int]:
        """Number of the split and of its episode, first frame, frames."""
        at, i, start = (int(n) for n in self.places[number])
        length = self.settings.length if span is None else span
        last = int(self.splits[at].reader.num_frames[i]) - length
        return at, i, min(start, last), length

    def example(
        self,
        number: int,
        augment: Augmentation | None = None,
        views: ViewAugmentation | None = None,
        position: int = 0,
    ) -> dict[str, Any]:
        """Return ``pixel_values`` (T, 3, h, w) in [0, 1], and ``labels`` by name.

        Augmentation follows from the settings' seed and ``position`` alone.
        """
        if views is None:
            episode, images = self.labels(number), self.resized(number, self.image_size_hw)
        else:
            rng = np.random.default_rng([self.settings.seed, _VIEW, position])
            episode, images = self._seen(number, views(rng), views.tempo(rng))
        pixels = self.processor.video_processor.preprocess_frames(images)
        if augment is not None:
            pixels = augment(
                pixels, np.random.default_rng([self.settings.seed, _AUGMENT, position])
            )
        labels = labels_of(episode, self.settings.presence, self.scales)
        return {"pixel_values": pixels, "labels": labels}

    def _seen(self, number: int, view: View, tempo: Tempo) -> tuple[Episode, NDArray[np.uint8]]:
        """A window by another camera and tempo; at its own step where the episode is too short."""
        at, i, *_ = self._stretch(number, None)
        span = tempo.span(self.settings.length)
        if span > self.splits[at].reader.num_frames[i]:
            tempo, span = replace(tempo, step=1), self.settings.length
        episode = tempo.episode(self.labels(number, span))
        images = tempo.frames(self.resized(number, self.read_size_hw(True), span))
        images = view.images(images, episode.fov_vh_rad, self.image_size_hw)
        return view.episode(episode), images

    @property
    def image_size_hw(self) -> tuple[int, int]:
        """Size of the network's pictures."""
        size: Any = self.processor.video_processor.size
        return int(size["height"]), int(size["width"])

    def read_size_hw(self, views: bool) -> tuple[int, int]:
        """Size at which pictures are read: larger than the network's where views crop them."""
        height, width = self.image_size_hw
        return (round(height * OVERSIZE), round(width * OVERSIZE)) if views else (height, width)

    def cached(self, folder: Path, views: bool, progress: bool = False) -> TrainingWindows:
        """Decode and resize all pictures of packed splits into ``folder``, unless they are there.

        Raises:
            VideoError: a clip that is damaged, missing, or of another length than its episode.
            OSError: no room.

        """
        from tqdm.auto import tqdm

        caches: dict[int, PixelCache] = {}
        for at, split in enumerate(self.splits):
            if not split.packed:
                continue
            size_hw = self.read_size_hw(views)
            made = filter_of(split.reader, self.processor)
            cache = PixelCache(folder, split.folder, size_hw, made)
            caches[at] = cache
            if not cache.made():
                with tqdm(total=len(split.reader), disable=not progress, desc=split.name) as bar:
                    for done in cache.make(split.reader, self.processor):
                        bar.update(done - bar.n)
        return replace(self, caches=caches)


class PositionDataset(Base):
    """A run's windows in the order they are read: item p is what stands at position ``first + p``.

    Read in sequence by any number of processes and workers, it gives every run the same data at the
    same position.
    """

    def __init__(
        self,
        windows: TrainingWindows,
        positions: int,
        augment: Augmentation | None = None,
        views: ViewAugmentation | None = None,
    ) -> None:
        self.windows, self.positions, self.augment = windows, positions, augment
        self.views = views
        self._order = windows.order()

    def __len__(self) -> int:
        return self.positions

    def __getitem__(self, position: int) -> dict[str, Any]:
        if not 0 <= position < self.positions:
            raise IndexError(f"position: expected 0 to {self.positions - 1}, got {position}")
        number = self._order.window(position)
        return self.windows.example(number, self.augment, self.views, position)


def collate(examples: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Stack examples: ``pixel_values`` (B, T, 3, h, w), and ``labels`` by name, each (B, ...)."""
    names = examples[0]["labels"]
    return {
        "pixel_values": torch.stack([e["pixel_values"] for e in examples]),
        "labels": {n: torch.stack([e["labels"][n] for e in examples]) for n in names},
    }


def open_windows(
    splits: Sequence[Split],
    settings: WindowSettings,
    processor: MintProcessor,
    cache_dir: Path | None = None,
    scales: CameraScales | None = None,
) -> TrainingWindows:
    """Survey splits, refuse what may not be trained on, and list the windows.

    Args:
        splits: see `clips.find_splits`.
        settings: which windows.
        processor: of the model.
        cache_dir: where surveys are kept; None: nowhere.
        scales: of camera losses; None: those of these windows (validation takes the training's).

    Raises:
        DataError: evaluation clips; no windows; a split without pictures. Names what to do.
        CorpusError, EpisodeError: an episode that cannot be read, or that holds NaN.
        VideoNotFoundError: videos beside the labels that are not there; how many, and the first.

    """
    surveys = [s.survey(settings.length, settings.stride, cache_dir) for s in splits]
    for split, survey in zip(splits, surveys, strict=True):
        if not settings.allow_evaluation_clips:
            _refuse_evaluation_clips(split, survey)
        if split.packed:
            continue
        if settings.videos is None:
            raise DataError(
                f"{split.folder}: expected pictures ({VIDEO_MEMBER} members), found labels alone; "
                "pack them with `mint-hub pack`, or say where the videos are (--videos)"
            )
        if missing := missing_videos(split.reader, settings.videos):
            raise all_missing(missing, len(split.reader))
    rows = [(at, i, row) for at, survey in enumerate(surveys) for i, row in enumerate(survey.rows)]
    places, sources, short = _places(rows, settings)
    if not len(places):
        names = ", ".join(str(s.folder) for s in splits)
        raise DataError(
            f"{names}: expected an episode of at least {settings.length} frames, the window, "
            f"found {len(rows)} episodes, all shorter"
        )
    warnings = [f"{short} of {len(rows)} episodes are shorter than a window"] if short else []
    total = sum((s.sums for s in surveys), CameraSums.none())
    return TrainingWindows(
        splits=tuple(splits),
        places=places,
        sources=tuple(sources),
        sizes=tuple(sources.values()),
        scales=scales or total.scales(),
        settings=settings,
        processor=processor,
        shape_spaces=tuple(sorted({row.shape_space for *_, row in rows if row.hands_known})),
        warnings=tuple(warnings),
    )


def _refuse_evaluation_clips(split: Split, survey: Survey) -> None:
    kept = [row for row in survey.rows if row.kept_for]
    if kept:
        raise DataError(
            f"{split.folder}: {len(kept)} of {len(survey.rows)} episodes are kept for evaluation, "
            f"first {kept[0].key} ({kept[0].kept_for}): a network trained on them cannot be scored "
            "on them. Leave them out, or force it with --allow-evaluation-clips"
        )


def _places(
    rows: Sequence[tuple[int, int, ClipRow]], settings: WindowSettings
) -> tuple[NDArray[np.int64], dict[str, int], int]:
    """Windows (N, 3) by source and stratum under the cap, how many a source has, short episodes."""
    strata: dict[tuple[str, str, str], list[tuple[int, int, int]]] = {}
    short = 0
    for split, i, row in rows:
        starts = window_starts(row.num_frames, settings.length, settings.stride)
        short += not len(starts)
        if len(starts):
            mine = strata.setdefault(row.stratum, [])
            mine += [(split, i, start) for start in starts]
    found: list[tuple[int, int, int]] = []
    sources: dict[str, int] = {}
    for stratum, windows in sorted(strata.items()):
        cap = settings.cap_per_stratum
        if cap is not None and len(windows) > cap:
            chosen = Order(len(windows), _CAP_SEED).permute(0, np.arange(cap))
            windows = [windows[k] for k in sorted(chosen.tolist())]
        found += windows
        sources[stratum[0]] = sources.get(stratum[0], 0) + len(windows)
    return np.array(found, np.int64).reshape(-1, 3), sources, short
