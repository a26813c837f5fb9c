"""The presets, and which clips a trainer must refuse.

``train`` is unbounded, and ``train-lively`` is ``train`` where heads move as much as in the benches
(in ``train``, many hold still). ``bench`` is forty clips of the same generator from reserved seeds.
``bench-ood`` is forty clips whose things, surfaces, activities, fields of view, image sizes, camera
heights and sides, and hand shapes train cannot produce: those tables and ranges are disjoint. A
preset's seeds are a stream of their own: no seed of ``train`` gives a clip of a bench.

A clip is known by its `fingerprint`, a hash of numbers that are drawn on an exact float32 grid and
survive shards, windows and other labels of the same clip: horizontal field of view and hand shape.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from mint_hub.assets import read_asset
from mint_hub.geometry import hand_state as hands
from mint_hub.loaders.schema import Episode
from mint_hub.synth import things
from mint_hub.synth.activities import TRAIN
from mint_hub.synth.activities_ood import OOD
from mint_hub.synth.world import TextureKind

__all__ = [
    "BENCH_CLIPS",
    "GENERATOR",
    "PRESETS",
    "RESERVED_SEEDS",
    "REVISION",
    "Preset",
    "bench_fingerprints",
    "bench_rows",
    "fingerprint",
    "fingerprint_of",
    "is_bench",
    "key_of",
    "on_grid",
    "preset_named",
    "rng_of",
    "seed_of",
]

GENERATOR: Final = 1
REVISION: Final = 2
"""The first goes up when the same seed gives another clip, the second when the same clip is moved,
labelled or drawn otherwise; benches are frozen for each, and drawn ones are kept apart."""

BENCH_CLIPS: Final = 40
BENCH_FILE: Final = "synth_benches.txt"

RESERVED_SEEDS: Final = 1 << 48
"""Worlds of train from this seed on are set apart: no run of `mint-hub synth` draws them, whatever
its seed (`seed_of` stays below). The clips that travel with the package are of these."""

Range = tuple[float, float]


@dataclass(frozen=True)
class Preset:
    """What a clip is drawn from; ranges are uniform unless said otherwise.

    Attributes:
        name: of the preset.
        stream: number of its stream of seeds.
        clips: how many there are; None: unbounded.
        kinds: things that may be on the table.
        activities: what may be done with them.
        surfaces: textures of table, floor and walls.
        paints: textures of things.
        fov_h_deg: ranges of the horizontal field of view, one of which is taken.
        fov_v_most_deg: vertical field of view that is not exceeded: beyond it one would look at
            one's own body, which is not drawn.
        sizes_hw: image sizes, one of which is taken.
        eye_up, eye_back, eye_aside: metres of the camera above the table, behind the table's near
            edge, and to either side.
        hand_size: ranges of the first shape number, one of which is taken.
        other_shape: ranges of the absolute value of the others.
        sway: range of a factor on the movements of the head.
        least_step: smallest median camera motion, metres and degrees a frame.
        num_frames: range of the clip's length.

    """

    name: str = "train"
    stream: int = 1
    clips: int | None = None
    kinds: tuple[str, ...] = tuple(things.KINDS_TRAIN)
    activities: tuple[str, ...] = tuple(TRAIN)
    surfaces: tuple[TextureKind, ...] = ("wood", "plaster", "noise", "stripes", "fabric")
    paints: tuple[TextureKind, ...] = ("noise", "stripes", "fabric", "label", "plaster", "wood")
    fov_h_deg: tuple[Range, ...] = ((50.0, 110.0),)
    fov_v_most_deg: float = 84.0
    sizes_hw: tuple[tuple[int, int], ...] = ((384, 512), (360, 640), (368, 480), (432, 432))
    eye_up: Range = (0.40, 0.60)
    eye_back: Range = (-0.02, 0.16)
    eye_aside: Range = (0.0, 0.06)
    hand_size: tuple[Range, ...] = ((-1.9, 1.9),)
    other_shape: Range = (0.0, 1.5)
    sway: Range = (0.15, 1.3)
    least_step: tuple[float, float] = (0.0, 0.0)
    num_frames: tuple[int, int] = (150, 240)


_TRAIN: Final = Preset()
_BENCH: Final = replace(
    _TRAIN, name="bench", stream=2, clips=BENCH_CLIPS, sway=(0.8, 1.4), least_step=(0.006, 0.6)
)
_LIVELY: Final = replace(_BENCH, name="train-lively", stream=4, clips=None)
_OOD: Final = replace(
    _BENCH,
    name="bench-ood",
    stream=3,
    kinds=tuple(things.KINDS_OOD),
    activities=tuple(OOD),
    surfaces=("tiles", "checker", "speckle"),
    paints=("checker", "speckle", "tiles"),
    fov_h_deg=((40.0, 48.0), (112.0, 122.0)),
    fov_v_most_deg=92.0,
    sizes_hw=((352, 528), (400, 500), (320, 640)),
    eye_up=(0.62, 0.72),
    eye_back=(-0.02, 0.10),
    eye_aside=(0.10, 0.20),
    hand_size=((-2.8, -2.1), (2.1, 2.8)),
    other_shape=(1.6, 2.3),
)
PRESETS: Final[dict[str, Preset]] = {p.name: p for p in (_TRAIN, _LIVELY, _BENCH, _OOD)}


def preset_named(name: str) -> Preset:
    """Look a preset up.

    Raises:
        ValueError: there is none of this name.

    """
    if name not in PRESETS:
        raise ValueError(f"preset: expected one of {sorted(PRESETS)}, got {name!r}")
    return PRESETS[name]


def seed_of(preset: str, seed: int, number: int) -> int:
    """Seed of clip ``number`` of a run with ``seed``; a bench's clips are the same in every run.

    Raises:
        ValueError: an unknown preset, a negative number or seed, a clip that a bench does not have.

    """
    kind = preset_named(preset)
    for name, value in (("number", number), ("seed", seed)):
        if value < 0:
            raise ValueError(f"{name}: expected 0 or more, got {value}")
    if kind.clips is not None:
        if number >= kind.clips:
            raise ValueError(f"number: {preset} has {kind.clips} clips, got {number}")
        return number
    drawn = int.from_bytes(hashlib.sha256(f"{seed}:{number}".encode()).digest()[:6], "big")
    assert drawn < RESERVED_SEEDS
    return drawn


def key_of(preset: str, seed: int) -> str:
    """Key of the episode of a seed."""
    return f"synth-{preset}-{seed:x}"


def rng_of(preset: str, seed: int, *more: int) -> np.random.Generator:
    """Make a stream of random numbers of a clip; ``more`` names one of its streams.

    The seed always takes two words: short entropy is padded with zeros, so that without them the
    stream 0 of a small seed would be the clip's own.
    """
    words = seed & 0xFFFFFFFF, seed >> 32
    return np.random.default_rng([GENERATOR, preset_named(preset).stream, *words, *more])


def on_grid(value: Any, steps: int) -> Any:
    """Round to multiples of 1 / ``steps`` (a power of two), which float32 holds exactly."""
    return np.round(np.asarray(value, float) * steps) / steps


FOV_STEPS: Final = 1 << 20
SHAPE_STEPS: Final = 1 << 14


def fingerprint_of(fov_h_rad: float, shape_params: Any) -> str:
    """Sixteen hex digits of a horizontal field of view and ten shape numbers (none: empty)."""
    fov = round(float(fov_h_rad) * FOV_STEPS)
    shape = [int(n) for n in np.round(np.asarray(shape_params, float) * SHAPE_STEPS)]
    return hashlib.sha256(f"{fov}:{shape}".encode()).hexdigest()[:16]


def fingerprint(episode: Episode) -> str:
    """Know a synthetic clip again: whole or a window, its hands noisy or not.

    From the horizontal field of view of the first frame and the shape of a hand that is there (both
    hands of a person have one shape). A window without any hand gives the fingerprint of no clip:
    such windows are known by ``meta["synth"]`` alone.
    """
    seen = np.argwhere(episode.presence)
    shape: Any = []
    if len(seen):
        frame, hand = seen[0]
        shape = hands.unpack(episode.hand_state[frame, hand]).shape_params
    return fingerprint_of(float(episode.fov_vh_rad[0, 1]), shape)


def bench_rows() -> list[list[str]]:
    """Words of each line of the frozen list, see `frozen`: the fingerprint, the clip, and more."""
    lines = read_asset(BENCH_FILE).decode().splitlines()
    return [line.split() for line in lines if line and not line.startswith("#")]


@cache
def bench_fingerprints() -> Mapping[str, str]:
    """Frozen fingerprints of both benches, each with its clip: ``{"0123...": "bench/7"}``."""
    return MappingProxyType({row[0]: row[1] for row in bench_rows()})


def is_bench(episode: Episode) -> bool:
    """Whether an episode is a clip of a bench, or a part of one: what training must not see.

    Labels that somebody else made of its pictures are known by the clip's name.
    """
    names = (episode.key, str(episode.meta.get("uid") or ""))
    if any(name.startswith("synth-bench-") for name in names):
        return True
    synth = episode.meta.get("synth")
    preset = synth.get("preset") if isinstance(synth, dict) else None
    return preset in ("bench", "bench-ood") or fingerprint(episode) in bench_fingerprints()
