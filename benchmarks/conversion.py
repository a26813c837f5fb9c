"""Converting a LeRobot v3 root to a corpus: frames a second and CPU time a frame.

    python benchmarks/conversion.py [--frames 2000000] [--procs 2] [--runs 3] [--root KEEP]

A root of synthetic trajectories is written once and converted a few times by ``write_corpus`` from
``LeRobotSlices``, as `mint-hub convert lerobot` does: parquet in, shards, index, table and
statistics out, everything checked, in a warm page cache. The CPU time is that of all processes, so
that ``procs / cpu_us_a_frame`` is what as many free cores would do: the distance of the wall clock
from it is what else the machine was doing, and what the processes waited for each other.
"""

import argparse
import resource
import tempfile
from pathlib import Path
from time import perf_counter
from typing import Any

from _report import write_report
from loading import Trajectories

from mint_hub.loaders.lerobot import LeRobotSlices, to_lerobot
from mint_hub.loaders.shards import write_corpus


def cpu_s() -> float:
    """CPU seconds of this process and of those it has waited for."""
    kinds = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    return sum(u.ru_utime + u.ru_stime for u in map(resource.getrusage, kinds))


def convert(root: Path, num_procs: int) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as scratch:
        cpu, start = cpu_s(), perf_counter()
        made = write_corpus(
            LeRobotSlices([root]), Path(scratch) / "corpus", "all", "train", num_procs=num_procs
        )
        taken, cpu = perf_counter() - start, cpu_s() - cpu
    frames = made.num_frames
    return {
        "frames": frames,
        "frames_s": round(frames / taken),
        "wall_s": round(taken, 2),
        "cpu_s": round(cpu, 2),
        "wall_us_a_frame": round(1e6 * taken / frames, 2),
        "cpu_us_a_frame": round(1e6 * cpu / frames, 2),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--frames", type=int, default=2_000_000, help="frames of the root")
    parser.add_argument("--procs", type=int, default=2, help="processes that read and encode")
    parser.add_argument("--runs", type=int, default=3, help="conversions; the best is reported")
    parser.add_argument("--root", type=Path, help="keep the root here, or use the one there")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        root = options.root or Path(scratch) / "root"
        if not root.exists():
            made = Trajectories(options.frames)
            to_lerobot((made[i] for i in range(len(made))), root)
        runs = [convert(root, options.procs) for _ in range(options.runs)]
    best = max(runs, key=lambda run: run["frames_s"])
    for run in runs:
        print(run)
    results = {"best": best, "runs": runs}
    settings = {"frames": best["frames"], "procs": options.procs, "runs": options.runs}
    print(write_report("conversion", results, settings))


if __name__ == "__main__":
    main()
