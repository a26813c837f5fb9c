"""Decoding: frames a second of ours against stock OpenCV and a plain PyAV loop; then preparation.

    python benchmarks/decoding.py [CLIP ...]

All readers deliver every frame as an (H, W, 3) array of 8 bits, and take turns in one run. Without
clips two are made: moving noise, 1920 x 1080 and 512 x 512, H.264. Preparation is
`MintVideoProcessor.preprocess_frames`, a frame at a time as the runner calls it, against the same
filter in floating point.
"""

import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import av
import cv2
import numpy as np
import torch
import torch.nn.functional as F
from _report import seconds, write_report

from mint_hub.loaders.video import iter_frames, probe
from mint_hub.model.processing_mint import MintVideoProcessor

ROUNDS, MADE_FRAMES, SEED = 5, 120, 0
SIZES_HW = ((1080, 1920), (512, 512))
PREPARED_HW = (378, 518)


def ours(path: str, **options: Any) -> int:
    return sum(1 for _ in iter_frames(path, **options))


def opencv(path: str) -> int:
    reader, count = cv2.VideoCapture(path), 0
    while reader.read()[0]:
        count += 1
    reader.release()
    return count


def plain_pyav(path: str) -> int:
    with av.open(path) as container:
        return sum(len(f.to_ndarray(format="rgb24")) > 0 for f in container.decode(video=0))


READERS: dict[str, Callable[[str], int]] = {
    "ours": ours,
    "ours_native_timing": lambda path: ours(path, fps=None),
    "ours_one_thread": lambda path: ours(path, num_threads=1),
    "opencv": opencv,
    "plain_pyav": plain_pyav,
}


def read_all(path: str) -> dict[str, Any]:
    """Let the readers take turns; median frames a second of each."""
    taken: dict[str, list[float]] = {name: [] for name in READERS}
    counts = {name: reader(path) for name, reader in READERS.items()}
    for _ in range(ROUNDS):
        for name, reader in READERS.items():
            start = perf_counter()
            reader(path)
            taken[name].append(perf_counter() - start)
    info = probe(path)
    return {
        "size_hw": list(info.image_size_hw),
        "codec": info.codec,
        "frames": counts,
        "frames_a_second": {k: round(counts[k] / median(v), 1) for k, v in taken.items()},
    }


def prepare(size_hw: tuple[int, int]) -> dict[str, float]:
    frame = np.random.default_rng(SEED).integers(0, 256, (1, *size_hw, 3), dtype=np.uint8)
    processor = MintVideoProcessor(size=PREPARED_HW)

    def floating() -> torch.Tensor:
        pixels = torch.from_numpy(frame).permute(0, 3, 1, 2).float() / 255
        return F.interpolate(pixels, size=PREPARED_HW, mode="bilinear", antialias=True)

    apart = (processor.preprocess_frames(frame) - floating()).abs().max().item() * 255
    return {
        "ours_ms_a_frame": round(1e3 * seconds(lambda: processor.preprocess_frames(frame), 30), 3),
        "floating_point_ms_a_frame": round(1e3 * seconds(floating, 30), 3),
        "largest_difference_in_levels_of_255": round(apart, 3),
    }


def make_clip(path: Path, size_hw: tuple[int, int]) -> str:
    rng = np.random.default_rng(SEED)
    noise = rng.integers(0, 256, (size_hw[0] // 8, size_hw[1] // 8, 3), dtype=np.uint8)
    scene = cv2.resize(noise, size_hw[::-1], interpolation=cv2.INTER_CUBIC)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.height, stream.width = size_hw
        stream.pix_fmt = "yuv420p"
        for i in range(MADE_FRAMES):
            image = np.roll(scene, (2 * i, 3 * i), (0, 1))
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())
    return str(path)


def main() -> None:
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        clips = sys.argv[1:] or [
            make_clip(Path(folder) / f"made-{h}x{w}.mp4", (h, w)) for h, w in SIZES_HW
        ]
        read = {Path(clip).name: read_all(clip) for clip in clips}
    prepared = {f"{h}x{w}": prepare((h, w)) for h, w in SIZES_HW}
    path = write_report(
        "decoding",
        {"decoding": read, f"preparation to {PREPARED_HW}": prepared},
        settings={"rounds": ROUNDS, "seed": SEED, "torch_threads": 1},
        machine={"av": av.__version__, "opencv": cv2.__version__},
    )
    print(path, path.read_text(), sep="\n")


if __name__ == "__main__":
    main()
