"""`pipeline("egocentric-hands")` from an mp4 to the fused episode: frames a second, and its stages.

    python benchmarks/pipeline.py [VIDEO ...] [--rounds 5]

Each video (default: the embedded clip) is predicted by the embedded network, settings as they come.
The rate is that of whole calls, the median over rounds after one warm-up. Stages are timed in a
further round of their own, so that the timing of stages is not part of the rate; what is in none of
them (queues, the episode's checks) is "other". The stock way beside it: the same network over the
same windows, every window from pixels, frames read by OpenCV, nothing fused.
"""

import argparse
import resource
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any
from unittest.mock import patch

import cv2
import torch
from _report import write_report
from transformers import pipeline

import mint_hub
from mint_hub.assets import sample_clip
from mint_hub.inference.network import _Device
from mint_hub.inference.runner import MintRunner
from mint_hub.inference.track import TrackBuilder
from mint_hub.windows import windows


class Stages:
    """Seconds spent in functions, by stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    def timed(self, stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Wrap a function."""

        def call(*args: Any, **kwargs: Any) -> Any:
            start = perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                self.seconds[stage] = self.seconds.get(stage, 0.0) + perf_counter() - start

        return call

    def each(self, stage: str, items: Iterable[Any]) -> Iterator[Any]:
        """Wrap an iterator."""
        step = self.timed(stage, iter(items).__next__)
        while True:
            try:
                yield step()
            except StopIteration:
                return


def stages_of(pipe: Any, video: str) -> dict[str, float]:
    """Seconds of each stage of one call."""
    stages, runner = Stages(), pipe.runner
    processor = runner.processor.video_processor
    pixels = MintRunner._pixels

    def read(self: MintRunner, source: Any, *rest: Any) -> Iterator[torch.Tensor]:
        source.frames = stages.each("decode", source.frames)
        return pixels(self, source, *rest)

    with (
        patch.object(MintRunner, "_pixels", read),
        patch.object(
            processor, "preprocess_frames", stages.timed("resize", processor.preprocess_frames)
        ),
        patch.object(_Device, "encode", stages.timed("patch encoder", _Device.encode)),
        patch.object(_Device, "predict", stages.timed("aggregator and heads", _Device.predict)),
        patch.object(TrackBuilder, "push", stages.timed("fusion", TrackBuilder.push)),
        patch.object(TrackBuilder, "finish", stages.timed("fusion", TrackBuilder.finish)),
    ):
        start = perf_counter()
        pipe(video)
        whole = perf_counter() - start
    return {**stages.seconds, "other": whole - sum(stages.seconds.values())}


@torch.inference_mode()
def stock(pipe: Any, video: str) -> int:
    """Predict the plain way; returns the number of frames."""
    model, processor = pipe.model, pipe.runner.processor.video_processor
    height, width = model.config.image_size
    file, frames = cv2.VideoCapture(video), []
    while (read := file.read())[0]:
        image = cv2.resize(read[1], (width, height), interpolation=cv2.INTER_LINEAR)
        frames.append(torch.from_numpy(image[..., ::-1].copy()).permute(2, 0, 1) / 255)
    file.release()
    assert processor.size["height"] == height
    stacked = torch.stack(frames).to(model.dtype)
    length = model.config.window
    for window in windows(len(frames), length, pipe.runner_overlap):
        model(pixel_values=stacked[window.frames][None])
    return len(frames)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("videos", nargs="*", type=Path)
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()
    start = perf_counter()
    pipe = pipeline("egocentric-hands")
    opened = perf_counter() - start
    from mint_hub.inference.runner import RunSettings

    pipe.runner_overlap = RunSettings().cut(pipe.model.config.window)[1]
    results: dict[str, Any] = {}
    for path in args.videos or [sample_clip()]:
        video, ours, plain = str(path), [], []
        frames = pipe(video).num_frames
        stock(pipe, video)
        for _ in range(args.rounds):
            start = perf_counter()
            pipe(video)
            ours.append(perf_counter() - start)
            start = perf_counter()
            stock(pipe, video)
            plain.append(perf_counter() - start)
        stages = stages_of(pipe, video)
        results[path.name] = {
            "frames": frames,
            "frames_a_second": round(frames / median(ours), 1),
            "frames_a_second_slowest_round": round(frames / max(ours), 1),
            "stock_frames_a_second": round(frames / median(plain), 1),
            "ratio_to_stock": round(median(plain) / median(ours), 2),
            "stages_ms_a_frame": {n: round(1e3 * s / frames, 2) for n, s in stages.items()},
        }
        print(path.name, results[path.name])
    results["seconds_to_open_the_pipeline"] = round(opened, 2)
    results["peak_memory_mib"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    settings = {
        "network": "mint-tiny (embedded)",
        "dtype": str(pipe.model.dtype),
        "window": pipe.model.config.window,
        "overlap": pipe.runner_overlap,
        "windows_at_once": 1,
        "rounds": args.rounds,
        "mint_hub": mint_hub.__version__,
    }
    print(write_report("pipeline", results, settings))


if __name__ == "__main__":
    main()
