"""From worlds to episodes: pictures, exact labels, and shards like those of any other source.

A hand counts as present when any of its 21 joints, more than 1 cm before the camera, projects into
the image. ``presence_score``, which a presence head should learn from, is then the share of what
lies of it inside the picture that nothing hides (``Renderer.visible_fraction``), and 0 for a hand
that is not present: one whose skin reaches into the picture, but none of its joints. Labels are
written ``lossless``: they are exact.

A clip filmed through a lens has bent pictures (depth and segments with them), and presence is what
these show. Its camera is, by the convention of ``Episode``, a pinhole: that of
``rectification(Lens.from_dict(episode.meta["synth"]["lens"]))``, whose ``apply`` turns the pictures
into those of the labels.
"""

from __future__ import annotations

import io
import multiprocessing
import os
import zipfile
from collections.abc import Collection, Generator, Iterator
from dataclasses import asdict, dataclass, field, replace
from os import PathLike
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import MODEL_FPS
from mint_hub.geometry.hand_model import HandModel
from mint_hub.geometry.hand_state import absent
from mint_hub.loaders.parallel import in_order
from mint_hub.loaders.schema import Episode
from mint_hub.loaders.shards import CorpusReport, write_corpus
from mint_hub.synth.corruption import Corruption, corrupt, encode
from mint_hub.synth.figure import LEFT_HAND, RIGHT_HAND
from mint_hub.synth.gl import make_context
from mint_hub.synth.lensing import (
    Bend,
    draw_lens,
    in_picture,
    pinhole_of,
    require_share,
    seen_through,
)
from mint_hub.synth.presets import GENERATOR, REVISION, key_of, preset_named, rng_of, seed_of
from mint_hub.synth.render import SAMPLES, Rendered, Renderer
from mint_hub.synth.scene import make_world
from mint_hub.synth.world import World

__all__ = [
    "DEPTH_STEP_M",
    "Clip",
    "draw_corruption",
    "labels_of",
    "make_clip",
    "make_episode",
    "presence_of",
    "synthesise",
]

SHARD_BYTES: Final = 8 << 20
"""A handful of clips: what an interrupted run makes again is less than a shard."""

MP4: Final = "mp4"
DEPTH: Final = "depth.npz"
SEGMENTATION: Final = "segmentation.npz"

DEPTH_STEP_M: Final = 2.0**-12
"""Depth is stored as uint16 multiples of this, a quarter of a millimetre; 0 where there is none."""

_CAMERA_STREAM: Final = 7


@dataclass(frozen=True, eq=False)
class Clip:
    """An episode with its pictures.

    Attributes:
        episode: the labels.
        members: ``mp4``, and where asked ``depth.npz`` ("depth" (T, H, W) uint16) and
            ``segmentation.npz`` ("segmentation" (T, H, W) uint8, see ``render.Rendered``).

    """

    episode: Episode
    members: dict[str, bytes]


def presence_of(world: World) -> NDArray[np.bool_]:
    """Whether any joint of a hand that exists, with z > 0.01 m, is inside the picture: (T, 2)."""
    joints = np.asarray(HandModel.template().keypoints(world.hands.hand_state.astype(float)))
    return in_picture(world, joints).any(-1) & world.hands.exists


def draw_corruption(world: World) -> Corruption:
    """The camera that takes a world's pictures: how bad it is, drawn from the world's seed."""
    rng = rng_of(world.preset, world.seed, _CAMERA_STREAM)
    return Corruption(
        shutter=round(float(rng.uniform(0, 0.45) * (rng.random() < 0.7)), 3),
        exposure_drift=round(float(rng.uniform(0, 0.12)), 3),
        white_drift=round(float(rng.uniform(0, 0.06)), 3),
        vignette=round(float(rng.uniform(0, 0.3)), 3),
        blur_px=round(float(rng.uniform(0, 0.7)), 3),
        shot_noise=round(float(rng.uniform(0, 0.02)), 4),
        read_noise=round(float(rng.uniform(0, 0.006)), 4),
        crf=int(rng.integers(18, 27)),
        exposure=round(float(rng.uniform(-1.4, 0.3)), 3),
        contrast=round(float(rng.uniform(1.0, 2.0)), 3),
    )


def make_episode(
    world: World,
    renderer: Renderer,
    *,
    depth: bool = False,
    segmentation: bool = False,
    corruption: Corruption | None = None,
) -> Clip:
    """Draw a world, through its lens if it has one (see ``lensing.seen_through``).

    Args:
        world: what to draw.
        renderer: open, of the world's image size.
        depth: also keep depth.
        segmentation: also keep segments.
        corruption: of the pictures; drawn from the world's seed without it.

    Raises:
        ValueError: a renderer of another image size, or one that was closed.

    """
    settings = draw_corruption(world) if corruption is None else corruption
    passes = {"rgb", "segmentation"}
    passes |= {"flow"} if settings.shutter > 0 else set()
    passes |= {"depth"} if depth else set()
    kept = _Kept(renderer, world, depth, segmentation)
    drawn = renderer.frames(world, passes)  # pyright: ignore[reportArgumentType]
    filmed = corrupt(drawn, settings, world.seed, world.lens, world.fov_vh_rad)
    members = {MP4: encode(kept.watch(filmed), settings, world.fps)}
    if depth:
        members[DEPTH] = _npz("depth", np.stack(kept.depths))
    if segmentation:
        members[SEGMENTATION] = _npz("segmentation", np.stack(kept.segments))
    return Clip(labels_of(world, np.stack(kept.visible), settings), members)


@dataclass(eq=False)
class _Kept:
    """What is measured of the frames while they go by to the encoder."""

    renderer: Renderer
    world: World
    depth: bool
    segmentation: bool
    visible: list[NDArray[np.float32]] = field(default_factory=list[NDArray[np.float32]])
    depths: list[NDArray[np.uint16]] = field(default_factory=list[NDArray[np.uint16]])
    segments: list[NDArray[np.uint8]] = field(default_factory=list[NDArray[np.uint8]])

    def __post_init__(self) -> None:
        self._bend = Bend(self.world)

    def watch(self, frames: Iterator[Rendered]) -> Iterator[Rendered]:
        for frame in frames:
            assert frame.segmentation is not None
            self.visible.append(self._visible(frame.index, frame.segmentation))
            if self.depth:
                assert frame.depth is not None
                steps = np.clip(np.round(frame.depth / DEPTH_STEP_M), 0, 65535)
                self.depths.append(steps.astype(np.uint16))
            if self.segmentation:
                self.segments.append(frame.segmentation)
            yield frame

    def _visible(self, k: int, segments: NDArray[np.uint8]) -> NDArray[np.float32]:
        """As ``Renderer.visible_fraction``, from segments that are drawn already."""
        masks = self.renderer.hand_masks(self.world, k, dressed=True)
        alone = self._bend.masks(masks).sum((1, 2))
        seen = np.bincount(segments.ravel(), minlength=6)[[LEFT_HAND, RIGHT_HAND]]
        return (seen / np.maximum(alone, 1)).astype(np.float32)


def labels_of(world: World, visible: NDArray[np.float32] | None, settings: Corruption) -> Episode:
    """Make the labels of a world.

    Args:
        world: whose clip it is.
        visible: (T, 2) share of each hand that nothing hides; None: no ``presence_score``.
        settings: the camera's, for the record.

    """
    presence = presence_of(world)
    state = np.where(presence[..., None], world.hands.hand_state, absent(presence.shape))
    score = None
    if visible is not None:
        score = np.where(presence, np.clip(visible, 0.0, 1.0), 0).astype(np.float32)
    fov_vh_rad, size_hw = pinhole_of(world)
    lens = {} if world.lens is None else {"lens": world.lens.to_dict()}
    return Episode(
        key=world.key,
        timestamps_s=np.arange(world.num_frames) / world.fps,
        T_camera_from_world=world.T_camera_from_world,
        fov_vh_rad=np.tile(fov_vh_rad.astype(np.float32), (world.num_frames, 1)),
        hand_state=state.astype(np.float32),
        presence=presence,
        presence_score=score,
        image_size_hw=size_hw,
        text=world.text,
        meta={
            "source": f"mint-hub synth {world.preset}",
            "uid": world.key,
            "domain": "tabletop",
            "shape_space": "mint",
            "hand_model": HandModel.template().name,
            "scale_status": "exact (synthetic)",
            "fps": MODEL_FPS,
            "conventions": "world: z up, metres; presence_score: visible share of the hand",
            "synth": {
                "preset": world.preset,
                "seed": world.seed,
                "camera": asdict(settings),
                **lens,
                **world.meta,
            },
        },
    )


def _npz(name: str, array: NDArray[Any]) -> bytes:
    """A compressed npz whose bytes depend on nothing but the array."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=4) as file:
        plain = io.BytesIO()
        np.lib.format.write_array(plain, array, allow_pickle=False)
        entry = zipfile.ZipInfo(f"{name}.npy")
        file.writestr(entry, plain.getvalue(), zipfile.ZIP_DEFLATED, 4)
    return buffer.getvalue()


# --------------------------------------------------------------------------------- shards


def make_clip(
    seed: int,
    preset: str = "train",
    num_frames: int | None = None,
    *,
    scale: float = 1.0,
    samples: int = SAMPLES,
    lens: float = 0.0,
    depth: bool = False,
    segmentation: bool = False,
    corruption: Corruption | None = None,
) -> Clip:
    """Make a world and draw it, with a renderer of its own; see ``scene.make_world``.

    With ``scale`` the same clip has smaller or larger pictures: its size times that. ``samples`` a
    pixel are drawn: 0 is faster by a third, with jagged edges. With ``lens`` that share of all
    seeds is filmed through a lens (``lensing.draw_lens``); all else stays.

    Raises:
        ImportError: moderngl is not installed.
        RuntimeError: EGL is missing. Both say what to install.
        ValueError: as ``make_world`` does; a scale out of 0.1 to 4; samples but 0, 2 and 4; a lens
            share out of 0 to 1, or above 0 for a bench.

    """
    require_share(lens, preset)
    _check_samples(samples)
    world = _scaled(make_world(seed, preset, num_frames), scale)
    drawn = draw_lens(world, lens)
    world = world if drawn is None else seen_through(world, drawn)
    with Renderer(world.image_size_hw, samples=samples) as renderer:
        return make_episode(
            world, renderer, depth=depth, segmentation=segmentation, corruption=corruption
        )


def _check_samples(samples: int) -> int:
    if samples not in (0, 2, 4):
        raise ValueError(f"samples: expected 0, 2 or 4 a pixel, got {samples}")
    return samples


def _check_scale(scale: float) -> float:
    if not 0.1 <= scale <= 4:
        raise ValueError(f"scale: expected 0.1 to 4, got {scale}")
    return scale


def _scaled(world: World, scale: float) -> World:
    """Change the size of the pictures, to even numbers of pixels; the field of view stays."""
    if _check_scale(scale) == 1:
        return world
    height, width = (2 * max(round(side * scale / 2), 1) for side in world.image_size_hw)
    return replace(world, image_size_hw=(height, width))


def synthesise(
    folder: str | PathLike[str],
    preset: str = "train",
    episodes: int | None = None,
    seed: int = 0,
    *,
    config: str | None = None,
    split: str | None = None,
    num_frames: int | None = None,
    scale: float = 1.0,
    samples: int = SAMPLES,
    lens: float = 0.0,
    depth: bool = False,
    segmentation: bool = False,
    num_procs: int = 1,
    progress: bool = False,
) -> CorpusReport:
    """Write a split of synthetic clips, ``folder/config/split``; called again, it goes on.

    Going on, it keeps the shards that were finished, and makes no clip of these again.

    Args:
        folder: of the corpus.
        preset: "train", "bench" or "bench-ood".
        episodes: how many; by default all of a bench, and it must be said for train.
        seed: of the run; a bench's clips are the same for every seed.
        config: name of the config; ``synth-<preset>`` without it.
        split: "train" for train, "validation" for the benches without it.
        num_frames: of every clip; drawn per clip without it.
        scale: factor on the size of the pictures, height and width.
        samples: a pixel: 0, 2 or 4; see `make_clip`.
        lens: share of clips whose pictures are bent by a lens; 0 for benches.
        depth: also store depth.
        segmentation: also store segments.
        num_procs: processes that make clips.
        progress: show a bar.

    Raises:
        ImportError, RuntimeError: as ``make_clip`` does.
        CorpusError: as ``write_corpus`` does; an unfinished split was begun with other arguments.
        ValueError: an unknown preset, a number of episodes that it does not have, a bad scale
            or share of lenses.

    """
    kind = preset_named(preset)
    count = kind.clips if episodes is None else episodes
    if count is None or count < 1:
        raise ValueError(f"episodes: expected at least 1 for {preset}, got {episodes}")
    seeds = [seed_of(preset, seed, n) for n in range(count)]
    if num_frames is not None and num_frames < 1:
        raise ValueError(f"num_frames: expected at least 1, got {num_frames}")
    maker = _Maker(
        preset,
        num_frames,
        _check_scale(scale),
        _check_samples(samples),
        require_share(lens, preset),
        depth,
        segmentation,
    )
    make_context().release()  # say what is missing before a world or a folder is made
    clips = _Clips(maker, seeds, num_procs)
    try:
        return write_corpus(
            clips,
            folder,
            config or f"synth-{preset}",
            split or ("train" if kind.clips is None else "validation"),
            format="lossless",
            extra=True,
            shard_bytes=SHARD_BYTES,
            seed=None,
            progress=progress,
            extra_members=clips.members_of,
            made_with={
                **asdict(maker),
                **({"seed": seed} if kind.clips is None else {}),
                "generator": GENERATOR,
                "revision": REVISION,
            },
        )
    finally:
        clips.close()


@dataclass(frozen=True)
class _Maker:
    """Makes the clip of a seed; travels to other processes."""

    preset: str
    num_frames: int | None
    scale: float
    samples: int
    lens: float
    depth: bool
    segmentation: bool

    def __call__(self, seed: int) -> Clip:
        if multiprocessing.parent_process() is not None:
            # One of several: Mesa draws on this process's own core, without threads beside it.
            os.environ.setdefault("LP_NUM_THREADS", "0")
        return make_clip(seed, **asdict(self))


class _Clips:
    """Clips by number, in a row from the first that is asked for; other processes make them ahead.

    Their keys are known before they are made.
    """

    def __init__(self, maker: _Maker, seeds: Collection[int], num_procs: int) -> None:
        self._maker, self._seeds, self._num_procs = maker, list(seeds), num_procs
        self._stream: Generator[Clip] | None = None
        self._next = -1
        self._members: dict[str, dict[str, bytes]] = {}

    def __len__(self) -> int:
        return len(self._seeds)

    def __getitem__(self, i: int, /) -> Episode:
        if self._stream is None or i != self._next:
            self.close()
            self._stream = in_order(self._maker, self._seeds[i:], self._num_procs, 1, start="spawn")
        clip = next(self._stream)
        assert clip.episode.key == self.key(i)
        self._next = i + 1
        self._members = {clip.episode.key: clip.members}
        return clip.episode

    def key(self, i: int, /) -> str:
        return key_of(self._maker.preset, self._seeds[i])

    def members_of(self, episode: Episode) -> dict[str, bytes]:
        return self._members[episode.key]

    def close(self) -> None:
        if self._stream is not None:
            self._stream.close()
            self._stream = None
