"""Freeze the benches: ``python -m mint_hub.synth.freeze`` writes the list that training refuses."""

from __future__ import annotations

import argparse
from pathlib import Path

from mint_hub.assets import asset_path
from mint_hub.geometry import hand_state
from mint_hub.synth.presets import BENCH_FILE, GENERATOR, PRESETS, fingerprint_of
from mint_hub.synth.scene import make_world


def frozen_list() -> str:
    """Return the file's text: a line for each clip of both benches, its fingerprint and name."""
    lines = [f"# clips of the synthetic benches, generator {GENERATOR}: fingerprint, clip"]
    for preset in PRESETS.values():
        for number in range(preset.clips or 0):
            world = make_world(number, preset.name, 1)
            there = world.hands.hand_state[0, world.hands.exists[0]][0]
            shape = hand_state.unpack(there).shape_params
            lines.append(f"{fingerprint_of(world.fov_vh_rad[1], shape)} {preset.name}/{number}")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Write the list among the assets, or to ``--out``."""
    parser = argparse.ArgumentParser(description="Freeze the synthetic benches.")
    parser.add_argument("--out", type=Path, default=asset_path(BENCH_FILE))
    out: Path = parser.parse_args().out
    out.write_text(frozen_list())


if __name__ == "__main__":
    main()
