"""From worlds to episodes: pictures and exact labels.

A hand counts as present when any of its 21 joints, more than 1 cm before the camera, projects into
the image. ``presence_score``, which a presence head should learn from, is then the share of what
lies of it inside the picture that nothing hides (``Renderer.visible_fraction``), and 0 for a hand
that is not present: one whose skin reaches into the picture, but none of its joints.

A clip filmed through a lens has bent pictures (depth and segments with them), and presence is what
these show. Its camera is, by the convention of ``Episode``, a pinhole: that of
``rectification(Lens.from_dict(episode.meta["synth"]["lens"]))``, whose ``apply`` turns the pictures
into those of the labels.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import MODEL_FPS
from mint_hub.geometry.hand_model import HandModel
from mint_hub.geometry.hand_state import absent
from mint_hub.loaders.schema import Episode
from mint_hub.synth.corruption import Corruption, corrupt, encode
from mint_hub.synth.figure import LEFT_HAND, RIGHT_HAND
from mint_hub.synth.lensing import (
    Bend,
    draw_lens,
    in_picture,
    pinhole_of,
    require_share,
    seen_through,
)
from mint_hub.synth.presets import preset_named, rng_of
from mint_hub.synth.render import SAMPLES, Rendered, Renderer
from mint_hub.synth.scene import make_world
from mint_hub.synth.world import World

__all__ = [
    "DEPTH_STEP_M",
    "Clip",
    "check_pieces",
    "check_samples",
    "check_scale",
    "draw_corruption",
    "labels_of",
    "make_clip",
    "make_episode",
    "make_pieces",
    "piece_key",
    "presence_of",
]

MP4: Final = "mp4"
DEPTH: Final = "depth.npz"
SEGMENTATION: Final = "segmentation.npz"

DEPTH_STEP_M: Final = 2.0**-12
"""Depth is stored as uint16 multiples of this, a quarter of a millimetre; 0 where there is none."""

_CAMERA_STREAM: Final = 7
_PIECE_STREAM: Final = 11


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


# ---------------------------------------------------------------------------------- clips


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
    check_samples(samples)
    world = _filmed(seed, preset, num_frames, scale, lens)
    with Renderer(world.image_size_hw, samples=samples) as renderer:
        return make_episode(
            world, renderer, depth=depth, segmentation=segmentation, corruption=corruption
        )


def make_pieces(
    seed: int,
    preset: str = "train",
    num_frames: int = 16,
    pieces: int = 3,
    *,
    scale: float = 1.0,
    samples: int = SAMPLES,
    lens: float = 0.0,
    depth: bool = False,
    segmentation: bool = False,
) -> list[Clip]:
    """Make a world of full length, but draw pieces of it alone: one in each part of it, in order.

    For the frames that are drawn, training then sees more rooms and people than in whole clips, and
    later moments than in short ones, which begin where hands still rest. Keys are the world's
    with the number of the piece, ``meta["synth"]["first_frame"]`` is where it began.

    Raises:
        ImportError, RuntimeError: as `make_clip` does.
        ValueError: as `make_clip` does; a bench, or more frames than its clips may have.

    """
    require_share(lens, preset)
    check_samples(samples)
    check_pieces(pieces, num_frames, preset)
    world = _filmed(seed, preset, None, scale, lens)
    rng = rng_of(preset, seed, _PIECE_STREAM)
    part = world.num_frames / pieces
    spare = part - num_frames
    firsts = [int(n * part + rng.uniform() * spare) for n in range(pieces)]
    clips: list[Clip] = []
    with Renderer(world.image_size_hw, samples=samples) as renderer:
        for number, first in enumerate(firsts):
            piece = replace(world.cut(first, num_frames), key=piece_key(world.key, number))
            clips.append(make_episode(piece, renderer, depth=depth, segmentation=segmentation))
    return clips


def piece_key(key: str, number: int) -> str:
    """Key of a piece of the clip of a key."""
    return f"{key}-{number}"


def _filmed(seed: int, preset: str, num_frames: int | None, scale: float, lens: float) -> World:
    """The world of a seed, with pictures of another size, through its lens if it has one."""
    world = _scaled(make_world(seed, preset, num_frames), scale)
    drawn = draw_lens(world, lens)
    return world if drawn is None else seen_through(world, drawn)


def check_pieces(pieces: int, num_frames: int | None, preset: str) -> None:
    """Refuse pieces of a bench, or more frames than the shortest clip has; ValueError."""
    kind = preset_named(preset)
    least = kind.num_frames[0]
    if kind.clips is not None:
        raise ValueError(f"pieces: expected whole clips of {preset}, got {pieces}")
    if num_frames is None or not 1 <= num_frames * pieces <= least:
        raise ValueError(
            f"pieces: expected num_frames * pieces within 1 to {least}, the shortest clip of "
            f"{preset}; got num_frames {num_frames}, pieces {pieces}"
        )


def check_samples(samples: int) -> int:
    """Refuse any number but 0, 2 and 4; ValueError."""
    if samples not in (0, 2, 4):
        raise ValueError(f"samples: expected 0, 2 or 4 a pixel, got {samples}")
    return samples


def check_scale(scale: float) -> float:
    """Refuse sizes out of 0.1 to 4; ValueError."""
    if not 0.1 <= scale <= 4:
        raise ValueError(f"scale: expected 0.1 to 4, got {scale}")
    return scale


def _scaled(world: World, scale: float) -> World:
    """Change the size of the pictures, to even numbers of pixels; the field of view stays."""
    if check_scale(scale) == 1:
        return world
    height, width = (2 * max(round(side * scale / 2), 1) for side in world.image_size_hw)
    return replace(world, image_size_hw=(height, width))
