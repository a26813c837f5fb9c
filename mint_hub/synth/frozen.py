"""The benches as they were frozen: what their clips are known by, and whether drawn ones are they.

``assets/synth_benches.txt`` has a line a clip: its fingerprint, its name, how many frames it has
and how far its camera and its wrists go. A change of the generator that moves anything moves the
last two; what differs between machines by rounding does not.

    python -m mint_hub.synth.frozen      # writes the file, in a minute or two
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.assets import asset_path
from mint_hub.geometry import hand_state
from mint_hub.geometry.rigid import inverse, transform_points
from mint_hub.loaders.schema import Episode
from mint_hub.synth.presets import BENCH_FILE, GENERATOR, REVISION, bench_rows, fingerprint

__all__ = ["FrozenClip", "frozen_clip", "frozen_clips", "require_frozen"]

TOLERANCE_M: Final = 2e-3
"""By how much a path may differ: metres of several."""


@dataclass(frozen=True)
class FrozenClip:
    """What is kept of a clip.

    Attributes:
        fingerprint: see `presets.fingerprint`.
        num_frames: T.
        camera_m: length of the camera's path, metres.
        wrists_m: length of both wrists' paths in the world, from each frame to the next in which a
            hand is present, metres.

    """

    fingerprint: str
    num_frames: int
    camera_m: float
    wrists_m: float


def frozen_clip(episode: Episode) -> FrozenClip:
    """Make what is kept of a whole clip."""
    poses = np.asarray(inverse(episode.T_camera_from_world))
    wrists = np.asarray(hand_state.unpack(episode.hand_state).translation, np.float64)
    placed = np.asarray(transform_points(poses, wrists))
    both = episode.presence[1:] & episode.presence[:-1]
    steps = np.linalg.norm(np.diff(placed, axis=0), axis=-1)
    return FrozenClip(
        fingerprint(episode), episode.num_frames, _length(poses[:, :3, 3]), float(steps[both].sum())
    )


def _length(points: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(np.diff(points, axis=0), axis=-1).sum())


@cache
def frozen_clips() -> Mapping[str, FrozenClip]:
    """Return the clips of both benches by name: ``{"bench/0": FrozenClip(...)}``."""
    found = {
        name: FrozenClip(known, int(frames), float(camera), float(wrists))
        for known, name, frames, camera, wrists in bench_rows()
    }
    return MappingProxyType(found)


def require_frozen(bench: str, number: int, episode: Episode) -> None:
    """Check that an episode is a clip of a bench as it was frozen.

    Raises:
        ValueError: another clip, or one that moves otherwise; says both.

    """
    name = f"{bench}/{number}"
    frozen, found = frozen_clips()[name], frozen_clip(episode)
    same = frozen.fingerprint == found.fingerprint and frozen.num_frames == found.num_frames
    off = max(abs(frozen.camera_m - found.camera_m), abs(frozen.wrists_m - found.wrists_m))
    if not same or not off < TOLERANCE_M:
        raise ValueError(
            f"{name}: expected the clip of generator {GENERATOR}.{REVISION} ({frozen}), got {found}"
        )


def frozen_list(clips: Iterable[tuple[str, FrozenClip]]) -> str:
    """Return the file's text."""
    lines = [
        f"# clips of the synthetic benches, generator {GENERATOR}.{REVISION}: fingerprint, clip, "
        "frames, metres of the camera's path and of the wrists'"
    ]
    lines += [
        f"{c.fingerprint} {name} {c.num_frames} {c.camera_m:.4f} {c.wrists_m:.4f}"
        for name, c in clips
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Make the worlds of both benches and write the list among the assets, or to ``--out``."""
    from tqdm.auto import tqdm

    from mint_hub.synth.corruption import Corruption
    from mint_hub.synth.episodes import labels_of
    from mint_hub.synth.presets import PRESETS
    from mint_hub.synth.scene import make_world

    parser = argparse.ArgumentParser(description="Freeze the synthetic benches.")
    parser.add_argument("--out", type=Path, default=asset_path(BENCH_FILE))
    out: Path = parser.parse_args().out
    names = [(p.name, n) for p in PRESETS.values() for n in range(p.clips or 0)]
    clips = [
        (f"{preset}/{n}", frozen_clip(labels_of(make_world(n, preset), None, Corruption())))
        for preset, n in tqdm(names, unit="clip")
    ]
    out.write_text(frozen_list(clips))


if __name__ == "__main__":
    main()
