"""Memory over a long video: resident size after 1 minute and after 10, in one run.

``python benchmarks/memory.py [CLIP] [--minutes 10] [--model FOLDER]``. The clip (by default the
embedded one) is looped to the length by copying its packets. Results grow with the video; growth
beyond them is what is reported. Writes ``benchmarks/results/memory-<date>.json``.
"""

import argparse
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import numpy as np
import psutil
import torch
from _report import write_report

from mint_hub.assets import sample_clip
from mint_hub.inference.runner import MintRunner
from mint_hub.loaders.schema import Episode
from mint_hub.model.configuration_mint import MintConfig
from mint_hub.model.modeling_mint import MintModel
from mint_hub.model.processing_mint import MintProcessor

FRAMES_A_MINUTE = 1800


def loop(clip: Path, minutes: float, target: Path) -> Path:
    """Repeat a clip's packets until the target is long enough."""
    shift, end = 0, 0
    with av.open(str(target), "w") as out:
        stream: Any = None
        while stream is None or end * stream.time_base < minutes * 60:
            with av.open(str(clip)) as source:
                video = source.streams.video[0]
                stream = stream or out.add_stream_from_template(video)
                for packet in source.demux(video):
                    if packet.dts is None:
                        continue
                    packet.pts, packet.dts = packet.pts + shift, packet.dts + shift
                    end = max(end, packet.pts + packet.duration)
                    packet.stream = stream
                    out.mux(packet)
            shift = end
    return target


class Watched(MintRunner):
    """A runner that notes its resident size every second of video."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.resident_mib: list[float] = []

    def _pixels(self, *args: Any) -> Iterator[torch.Tensor]:
        for k, pixels in enumerate(super()._pixels(*args)):
            if k % 30 == 0:
                self.resident_mib.append(psutil.Process().memory_info().rss / 2**20)
            yield pixels


def result_mib(episode: Episode) -> float:
    """What a result weighs: its arrays, and the times that its meta holds as Python numbers."""
    arrays = [v for v in episode.to_dict().values() if isinstance(v, np.ndarray)]
    numbers = 2 * 32 * episode.num_frames  # two lists of floats, 24 + 8 bytes each
    return (sum(a.nbytes for a in arrays) + numbers) / 2**20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("clip", nargs="?", type=Path, default=sample_clip())
    parser.add_argument("--minutes", type=float, default=10)
    parser.add_argument("--model")
    args = parser.parse_args()
    torch.manual_seed(0)
    model = (
        MintModel.from_pretrained(args.model) if args.model else MintModel(MintConfig.tiny())
    ).eval()
    runner = Watched(model, MintProcessor.for_config(model.config))
    with tempfile.TemporaryDirectory() as folder:
        video = loop(args.clip, args.minutes, Path(folder) / "long.mp4")
        episode = runner.run(video)
    after_all = psutil.Process().memory_info().rss / 2**20
    seconds = runner.resident_mib
    early, late = np.mean(seconds[55:65]), np.mean(seconds[-10:])
    share = 1 - 60 / len(seconds)
    growth = late - early
    results = {
        "frames": episode.num_frames,
        "resident_mib_at_1_min": round(float(early), 1),
        "resident_mib_at_the_end_of_the_stream": round(float(late), 1),
        "resident_mib_with_the_episode": round(after_all, 1),
        "result_mib": round(result_mib(episode), 1),
        "growth_mib": round(float(growth), 1),
        "growth_beyond_results_mib": round(float(growth - share * result_mib(episode)), 1),
        "resident_mib_each_minute": [round(x, 1) for x in seconds[59::60]],
    }
    print(results)
    settings = {
        "clip": args.clip.name,
        "minutes": args.minutes,
        "image_size": model.config.image_size,
    }
    print(write_report("memory", results, settings))


if __name__ == "__main__":
    main()
