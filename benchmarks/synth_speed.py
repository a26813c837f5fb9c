"""Synthetic clips: milliseconds a frame by image size and pass, clips an hour, and sameness.

    python benchmarks/synth_speed.py [--sizes 216x216 384x512 378x518 720x1280] [--frames 60]
        [--worlds 3] [--clips 4] [--processes 1 2] [--clip-frames 150]

Passes are timed alone, each on frames that are there already, CPU time of all threads beside wall
time: drawing the picture; the second drawing that gives depth, segments and flow; the hands drawn
alone for the visible share; what the camera does to the picture (without and with motion blur);
H.264. ``episode`` is all of it as `make_episode` does it. A world is made once a clip, whatever its
length, and counted by itself, and so are meshes and textures, which the first frame makes (the
first frame of all compiles the shaders too). ``end_to_end`` writes shards with `synthesise`, world
and all, as `mint-hub synth` does. The last part makes one clip twice here and once in another
process.
"""

import argparse
import hashlib
import multiprocessing
import os
import resource
import tempfile
from collections.abc import Callable
from dataclasses import replace
from statistics import mean, median
from time import perf_counter, process_time
from typing import Any

import numpy as np
from _report import write_report

from mint_hub.loaders.clips import PackedClip
from mint_hub.synth.corpus import synthesise
from mint_hub.synth.corruption import Corruption, corrupt, encode
from mint_hub.synth.episodes import make_clip, make_episode
from mint_hub.synth.presets import seed_of
from mint_hub.synth.render import PASSES, Rendered, Renderer
from mint_hub.synth.scene import make_world
from mint_hub.synth.world import World

Times = dict[str, float]
SHARP = Corruption(
    exposure_drift=0.06,
    white_drift=0.03,
    vignette=0.15,
    blur_px=0.4,
    shot_noise=0.01,
    read_noise=0.003,
    crf=22,
)
BLURRED = replace(SHARP, shutter=0.25)
WARM_UP = 2


def timed(work: Callable[[], Any], frames: int) -> Times:
    """Milliseconds a frame."""
    cpu, wall = process_time(), perf_counter()
    work()
    cpu, wall = process_time() - cpu, perf_counter() - wall
    return {"cpu_ms": 1e3 * cpu / frames, "wall_ms": 1e3 * wall / frames}


def sized(world: World, size_hw: tuple[int, int]) -> World:
    """The same world with pictures of another shape: square pixels, horizontal view as it was."""
    half = np.tan(world.fov_vh_rad[1] / 2) * size_hw[0] / size_hw[1]
    fov = (2 * float(np.arctan(half)), world.fov_vh_rad[1])
    return replace(world, image_size_hw=size_hw, fov_vh_rad=fov)


def passes(world: World, frames: int) -> dict[str, Times]:
    """Every part of making a clip of this world."""
    stop = min(frames + WARM_UP, world.num_frames)
    count = stop - WARM_UP
    with Renderer(world.image_size_hw) as renderer:
        begun = process_time()
        list(renderer.frames(world, PASSES, stop=1))
        found = {"first_frame": {"cpu_s_a_clip": process_time() - begun}}
        list(renderer.frames(world, PASSES, stop=WARM_UP))

        def draw(which: Any = ("rgb",)) -> list[Rendered]:
            return list(renderer.frames(world, which, start=WARM_UP, stop=stop))

        def masks() -> None:
            for k in range(WARM_UP, stop):
                renderer.hand_masks(world, k, dressed=True)

        found["picture"] = timed(draw, count)
        both = timed(lambda: draw(PASSES), count)
        found["labels"] = {k: both[k] - found["picture"][k] for k in both}
        found["visible_share"] = timed(masks, count)
        drawn = draw(PASSES)
        bad: list[Rendered] = []
        found["camera_sharp"] = timed(lambda: bad.extend(corrupt(drawn, SHARP, 0)), count)
        found["camera_blurred"] = timed(lambda: list(corrupt(drawn, BLURRED, 0)), count)
        found["encoding"] = timed(lambda: encode(bad, SHARP), count)
        short = first_frames(world, count)
        list(renderer.frames(short, stop=1))
        found["episode"] = timed(lambda: make_episode(short, renderer), count)
    return found


def first_frames(world: World, count: int) -> World:
    """Cut a world short, so that `make_episode` draws no more than is timed."""
    h = world.hands
    hands = replace(
        h,
        hand_state=h.hand_state[:count],
        exists=h.exists[:count],
        forearm_direction=h.forearm_direction[:count],
    )
    bodies = tuple(
        replace(b, T_world_from_body=b.T_world_from_body[:count])
        if b.T_world_from_body.ndim == 3
        else b
        for b in world.bodies
    )
    return replace(
        world,
        hands=hands,
        bodies=bodies,
        T_camera_from_world=world.T_camera_from_world[:count],
        exposure=None if world.exposure is None else world.exposure[:count],
        text=(),
    )


def by_size(sizes: list[tuple[int, int]], worlds: list[World], frames: int) -> dict[str, Any]:
    """Mean over worlds; one line a size."""
    found: dict[str, Any] = {}
    for size in sizes:
        runs = [passes(sized(world, size), frames) for world in worlds]
        name = f"{size[0]}x{size[1]}"
        found[name] = {
            part: {k: round(mean(run[part][k] for run in runs), 2) for k in times}
            for part, times in runs[0].items()
        }
        parts = (
            f"{part} {'/'.join(f'{value:.1f}' for value in times.values())}"
            for part, times in found[name].items()
        )
        line = "  ".join(parts)
        print(f"{name} (cpu/wall ms): {line}", flush=True)
    return found


def worlds_made(count: int, seed: int) -> tuple[list[World], dict[str, float]]:
    """Make worlds of whole length; what one takes, CPU seconds."""
    taken: list[float] = []
    made: list[World] = []
    make_world(seed_of("train", seed, 0), "train", 30)  # what is made once
    for n in range(count):
        begun = process_time()
        made.append(make_world(seed_of("train", seed, n), "train"))
        taken.append(process_time() - begun)
    return made, {
        "cpu_s_median": round(median(taken), 3),
        "cpu_s_most": round(max(taken), 3),
        "worlds": count,
    }


def end_to_end(
    clips: int, processes: int, frames: int | None, scale: float, seed: int
) -> dict[str, Any]:
    """Write a corpus; clips an hour are those of the wall clock, start of processes included."""
    cpu, start = all_cpu_s(), perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        report = synthesise(
            folder, "train", clips, seed, num_frames=frames, scale=scale, num_procs=processes
        )
    wall, cpu = perf_counter() - start, all_cpu_s() - cpu
    result = {
        "clips": clips,
        "frames": report.num_frames,
        "wall_s": round(wall, 2),
        "cpu_s": round(cpu, 2),
        "cpu_ms_a_frame": round(1e3 * cpu / report.num_frames, 2),
        "clips_an_hour": round(3600 * clips / wall, 1),
        "frames_s": round(report.num_frames / wall, 2),
    }
    print(f"{processes} processes: {result}", flush=True)
    return result


def all_cpu_s() -> float:
    """CPU seconds of this process and of those it has waited for."""
    kinds = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    return sum(u.ru_utime + u.ru_stime for u in map(resource.getrusage, kinds))


def stamp(seed: int) -> dict[str, str]:
    """Make a small clip; hashes of the labels, the decoded pictures and the mp4's bytes."""
    clip = make_clip(seed, "train", 24, scale=0.5)
    labels = hashlib.sha256()
    for name, value in clip.episode.to_dict().items():
        labels.update(name.encode())
        labels.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
    with PackedClip(clip.members["mp4"]) as packed:
        pictures = hashlib.sha256(packed.images().tobytes())
    mp4 = hashlib.sha256(clip.members["mp4"])
    return {"labels": labels.hexdigest(), "pictures": pictures.hexdigest(), "mp4": mp4.hexdigest()}


def elsewhere(seed: int) -> dict[str, str]:
    """What another process makes, drawing without threads."""
    os.environ["LP_NUM_THREADS"] = "0"
    return stamp(seed)


def sameness() -> dict[str, Any]:
    """Whether one seed gives one clip."""
    first, second = stamp(5), stamp(5)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        third = pool.apply(elsewhere, (5,))
    other = stamp(6)
    return {
        "same_in_one_process": {k: first[k] == second[k] for k in first},
        "same_in_another_process": {k: first[k] == third[k] for k in first},
        "another_seed_differs": {k: first[k] != other[k] for k in first},
    }


def size_of(text: str) -> tuple[int, int]:
    """Read "384x512", height first."""
    height, width = (int(side) for side in text.split("x"))
    return height, width


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add("--sizes", nargs="+", default=["216x216", "384x512", "378x518", "720x1280"], help="HxW")
    add("--frames", type=int, default=60, help="timed of each world and pass")
    add("--worlds", type=int, default=3)
    add("--clips", type=int, default=4, help="written end to end by each number of processes")
    add("--processes", type=int, nargs="+", default=[1, 2])
    add("--clip-frames", type=int, default=150, help="frames of a clip that is written")
    add("--scale", type=float, default=1.0, help="of the clips that are written")
    add("--seed", type=int, default=0)
    args = parser.parse_args()
    worlds, world_s = worlds_made(args.worlds, args.seed)
    with Renderer((64, 64)) as renderer:
        device = renderer.device
    results: dict[str, Any] = {
        "world": world_s,
        "ms_a_frame": by_size([size_of(s) for s in args.sizes], worlds, args.frames),
        "end_to_end": {
            f"{n} processes": end_to_end(args.clips, n, args.clip_frames, args.scale, args.seed)
            for n in args.processes
        },
        "sameness": sameness(),
    }
    print(results["world"], results["sameness"])
    settings = vars(args) | {
        "samples_a_pixel": 4,
        "camera": "sharp: noise, drift, vignette, blur; blurred: and a shutter of a quarter frame",
    }
    machine = {"renderer": device, "lp_num_threads": os.environ.get("LP_NUM_THREADS")}
    print(write_report("synth_speed", results, settings, machine))


if __name__ == "__main__":
    main()
