"""The labelling cascade: frames a second by stage and end to end, in one process and on Ray.

    python benchmarks/labelling.py CLIPS... [--seconds 5] [--workers 1 2] [--nodes 64 --vcpus 96]

The first seconds of each clip are labelled from the raw file to verified shards with the default
backends, their environments made before the clock starts: once in this process, then with each
number of Ray workers of one core. The CPU time of the first is what an estimate for a corpus is
reckoned from; its arithmetic is in the results, line by line.
"""

import argparse
import resource
import tempfile
from collections.abc import Iterable
from pathlib import Path
from time import perf_counter
from typing import Any

import av
from _report import write_report

from mint_hub.inference.batch import find_videos
from mint_hub.labelling.build import build_cascade
from mint_hub.labelling.label import FOLDER, label_videos
from mint_hub.labelling.ray_runner import OnRay
from mint_hub.labelling.runner import Executor, InProcess
from mint_hub.labelling.stages import mediapipe_hands, sfm_calls

FPS = 30
CORPUS_H = 1729.0
ONE_CORE = {stage: {"threads": 1} for stage in ("intrinsics", "camera")}


def cpu_s() -> float:
    """CPU seconds of this process and of those it has waited for."""
    kinds = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    return sum(u.ru_utime + u.ru_stime for u in map(resource.getrusage, kinds))


def beginning(source: str, target: Path, seconds: float) -> None:
    """Copy the first seconds of a video, packet by packet."""
    with av.open(source) as video, av.open(str(target), "w") as short:
        stream = video.streams.video[0]
        copy = short.add_stream_from_template(stream)
        assert stream.time_base is not None
        for packet in video.demux(stream):
            if packet.dts is None or packet.dts * stream.time_base >= seconds:
                break
            packet.stream = copy
            short.mux(packet)


def run(videos: dict[str, str], workers: int | None, settings: dict[str, Any]) -> dict[str, Any]:
    """Label everything; None is this process, else that many Ray workers of one core each."""
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch)
        cascade = build_cascade(out / FOLDER / "work", settings=settings)
        executor: Executor = OnRay(cascade, num_cpus=workers) if workers else InProcess(cascade)
        cpu, start = cpu_s(), perf_counter()
        report = label_videos(videos, out, cascade, executor=executor)
        wall, cpu = perf_counter() - start, cpu_s() - cpu
    frames = report.hours_in * 3600 * FPS
    stages = sorted(report.stage_seconds.items(), key=lambda item: -item[1])
    result = {
        "frames": round(frames),
        "frames_kept": report.num_frames,
        "wall_s": round(wall, 2),
        "frames_s": round(frames / wall, 3),
        "stage_s": {stage: round(s, 2) for stage, s in stages},
        "stage_frames_s": {s: round(report.num_frames / t, 2) for s, t in stages if t > 0.005},
        "stage_share": {s: round(t / wall, 4) for s, t in stages},
        "lost_s": {reason: round(3600 * h, 3) for reason, h in report.hours_lost.items()},
    }
    if workers is None:
        result |= {"cpu_s": round(cpu, 2), "cpu_s_a_frame": round(cpu / frames, 5)}
    return result


def estimate(
    cpu_s_a_frame: float, efficiency: float, hours: float, nodes: int, vcpus: int
) -> dict[str, Any]:
    """Return how long a cluster takes for a corpus, with the arithmetic."""
    frames = hours * 3600 * FPS
    core_hours = frames * cpu_s_a_frame / 3600
    wall_h = core_hours / (nodes * vcpus * efficiency)
    return {
        "cluster": f"{nodes} nodes x {vcpus} vCPU = {nodes * vcpus} workers of one thread",
        "core_hours": round(core_hours),
        "wall_h": round(wall_h, 2),
        "hours_an_hour": round(hours / wall_h, 1),
        "arithmetic": [
            f"{hours:g} h x 3600 s x {FPS} frames/s = {frames:.4g} frames",
            f"x {cpu_s_a_frame:g} CPU s a frame / 3600 = {core_hours:,.0f} core hours",
            f"/ ({nodes} x {vcpus} vCPU x {efficiency:.3f} parallel efficiency) = {wall_h:.2f} h",
        ],
        "assumes": [
            "a vCPU is as fast as a core of the machine above",
            "what is lost costs as much as what is kept; longer clips cost a frame the same",
            "the parallel efficiency of the two Ray workers measured holds for all; shared storage "
            "and scheduling keep up (not measured)",
            "3 GiB a worker, as the camera stage asks for",
        ],
    }


def efficiency_of(runs: dict[int, dict[str, Any]]) -> float:
    """Return the speed-up of the most workers over the fewest, over the ideal one; at most 1."""
    few, many = min(runs), max(runs)
    ideal = many / few
    return min(runs[few]["wall_s"] / runs[many]["wall_s"] / ideal, 1.0)


def first_seconds(clips: Iterable[str], folder: Path, seconds: float) -> dict[str, str]:
    videos: dict[str, str] = {}
    for key, path in find_videos(clips).items():
        beginning(path, folder / f"{key}.mp4", seconds)
        videos[key] = str(folder / f"{key}.mp4")
    return videos


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("clips", nargs="+", help="raw videos, or folders of them")
    parser.add_argument("--seconds", type=float, default=5.0, help="of each clip")
    parser.add_argument("--workers", type=int, nargs="*", default=[1, 2], help="Ray workers to try")
    parser.add_argument("--hours", type=float, default=CORPUS_H, help="of the corpus to estimate")
    parser.add_argument("--nodes", type=int, default=64)
    parser.add_argument("--vcpus", type=int, default=96, help="of a node")
    options = parser.parse_args()
    for environment in (mediapipe_hands.ENVIRONMENT, sfm_calls.ENVIRONMENT):
        environment.python()
    with tempfile.TemporaryDirectory() as scratch:
        videos = first_seconds(options.clips, Path(scratch), options.seconds)
        here = run(videos, None, {})
        on_ray = {workers: run(videos, workers, ONE_CORE) for workers in options.workers}
    results: dict[str, Any] = {"one_process": here}
    results |= {f"ray_workers_{workers}": result for workers, result in on_ray.items()}
    if len(on_ray) > 1:
        efficiency = efficiency_of(on_ray)
        results["parallel_efficiency"] = round(efficiency, 3)
        results["estimate"] = estimate(
            here["cpu_s_a_frame"], efficiency, options.hours, options.nodes, options.vcpus
        )
    settings = {"clips": len(videos), "seconds_of_each": options.seconds, "backends": "default"}
    print(write_report("labelling", results, settings))


if __name__ == "__main__":
    main()
