"""Windows of pixels a second: from packed clips, and from the long-GOP video they were cut from.

    python benchmarks/packed_video.py [VIDEO]

Random windows of 16 frames at 224 x 224, one process. A packed window is found in the bytes of its
episode's clip, as a shard holds them. The original is read three ways: with its decoder kept open
(`VideoAttachment`), opened for every window, and through OpenCV. Time inside the decoder and in
turning pictures into RGB of the size wanted is reported apart from the rest (opening, seeking,
copying). Without VIDEO one is made: moving noise, 1280 x 720, 40 s, a key frame every 250.
"""

import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import av
import cv2
import numpy as np
from _report import write_report

from mint_hub.geometry import hand_state
from mint_hub.loaders.attach import VideoAttachment
from mint_hub.loaders.packing import GOP, MP4, Packer, decode_window
from mint_hub.loaders.schema import Episode
from mint_hub.loaders.video_decoder import Decoder, Picture
from mint_hub.loaders.video_reader import DecoderCache, VideoReader

SEED, ROUNDS, WINDOWS, LENGTH, SIZE = 0, 3, 30, 16, (224, 224)
EPISODE_FRAMES, FPS, MADE_S, MADE_HW, MADE_GOP = 197, 30, 40, (720, 1280), 250


def make_video(path: Path) -> Path:
    rng = np.random.default_rng(SEED)
    noise = rng.integers(0, 256, (MADE_HW[0] // 8, MADE_HW[1] // 8, 3), dtype=np.uint8)
    scene = cv2.resize(noise, MADE_HW[::-1], interpolation=cv2.INTER_CUBIC)
    options = {"preset": "veryfast", "x264-params": f"keyint={MADE_GOP}:scenecut=0"}
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=FPS, options=options)
        (stream.height, stream.width), stream.pix_fmt = MADE_HW, "yuv420p"
        for i in range(MADE_S * FPS):
            image = np.roll(scene, (2 * i, 3 * i), (0, 1))
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())
    return path


def episodes_of(path: Path) -> list[Episode]:
    """Cut a video into episodes of the corpus's mean length, with nobody in them."""
    with VideoReader(path) as reader:
        info = reader.info
    assert info.duration_s is not None
    T, made = EPISODE_FRAMES, []
    for k in range(int(info.duration_s * FPS) // T):
        blank = Episode(
            key=f"made-{k}",
            timestamps_s=info.start_time_s + (k * T + np.arange(T)) / FPS,
            T_camera_from_world=np.tile(np.eye(4), (T, 1, 1)),
            fov_vh_rad=np.ones((T, 2)),
            hand_state=hand_state.absent((T, 2)),
            presence=np.zeros((T, 2), bool),
            image_size_hw=info.image_size_hw,
        )
        made.append(replace(blank, meta={"uid": path.stem}))
    return made


def through_opencv(path: Path, start_s: float) -> np.ndarray:
    reader = cv2.VideoCapture(str(path))
    reader.set(cv2.CAP_PROP_POS_MSEC, 1000 * start_s)
    images = [
        cv2.cvtColor(cv2.resize(reader.read()[1], SIZE[::-1], interpolation=cv2.INTER_AREA), 4)
        for _ in range(LENGTH)
    ]
    reader.release()
    return np.stack(images)


class Clock:
    """Seconds spent inside the decoder, and in turning its frames into RGB."""

    def __init__(self) -> None:
        self.decoding_s = self.picturing_s = 0.0
        stored, rgb, clock = Decoder.stored, Picture.rgb, self

        def timed_stored(decoder: Decoder) -> Any:
            frames = stored(decoder)
            while True:
                start = perf_counter()
                frame = next(frames, None)
                clock.decoding_s += perf_counter() - start
                if frame is None:
                    return
                yield frame

        def timed_rgb(picture: Picture, *arguments: Any) -> Any:
            start = perf_counter()
            image = rgb(picture, *arguments)
            clock.picturing_s += perf_counter() - start
            return image

        Decoder.stored, Picture.rgb = timed_stored, timed_rgb
        self._before = stored, rgb

    def stop(self) -> None:
        """Measure no longer."""
        Decoder.stored, Picture.rgb = self._before


def timed(read: Callable[[int, int], np.ndarray], asked: list[tuple[int, int]]) -> dict[str, float]:
    """Read all windows and sum their pixels inside the timing."""
    clock = Clock()
    start = perf_counter()
    for episode, frame in asked:
        images = read(episode, frame)
        assert images.shape == (LENGTH, *SIZE, 3)
        images.sum(dtype=np.int64)
    total = perf_counter() - start
    clock.stop()
    numbers = {"windows_a_second": len(asked) / total, "ms_a_window": 1e3 * total / len(asked)}
    if clock.decoding_s == 0:  # OpenCV does not tell
        return numbers
    return {
        **numbers,
        "decoding_ms_a_window": 1e3 * clock.decoding_s / len(asked),
        "to_rgb_ms_a_window": 1e3 * clock.picturing_s / len(asked),
    }


def run(path: Path) -> dict[str, Any]:
    episodes = episodes_of(path)
    begin = perf_counter()
    clips = [Packer(path, size_hw=SIZE)(episode)[MP4] for episode in episodes]
    packing_s = perf_counter() - begin
    open_decoders = DecoderCache()
    kept = [VideoAttachment(episode, path, decoders=open_decoders) for episode in episodes]

    def opened_each_time(k: int, frame: int) -> np.ndarray:
        decoders = DecoderCache()
        images = VideoAttachment(episodes[k], path, decoders=decoders).frames(frame, LENGTH, SIZE)
        decoders.close()
        return images

    readers: dict[str, Callable[[int, int], np.ndarray]] = {
        "packed": lambda k, frame: decode_window(clips[k], frame, LENGTH),
        "original_kept_open": lambda k, frame: kept[k].frames(frame, LENGTH, SIZE),
        "original_opened_each_time": opened_each_time,
        "original_through_opencv": lambda k, frame: through_opencv(
            path, float(episodes[k].timestamps_s[frame])
        ),
    }
    rng = np.random.default_rng(SEED)
    draws = rng.integers(0, (len(episodes), EPISODE_FRAMES - LENGTH + 1), (WINDOWS, 2))
    asked = [(int(k), int(frame)) for k, frame in draws]
    rounds = [{name: timed(read, asked) for name, read in readers.items()} for _ in range(ROUNDS)]
    numbers = {
        name: {key: round(median(r[name][key] for r in rounds), 2) for key in rounds[0][name]}
        for name in readers
    }
    packed = numbers["packed"]["windows_a_second"]
    frames = len(episodes) * EPISODE_FRAMES
    return {
        **numbers,
        "packed_over": {
            name: round(packed / numbers[name]["windows_a_second"], 2) for name in list(readers)[1:]
        },
        "packed_bytes_a_frame": round(sum(map(len, clips)) / frames),
        "packing_frames_a_second": round(frames / packing_s),
    }


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        given = sys.argv[1:]
        path = Path(given[0]) if given else make_video(Path(folder) / "made-720p.mp4")
        with VideoReader(path) as reader:
            info = reader.info
        results = run(path)
    settings = {
        "video": {"codec": info.codec, "size_hw": info.image_size_hw, "seconds": info.duration_s},
        "made_gop": None if given else MADE_GOP,
        "packed_gop": GOP,
        "window": [LENGTH, *SIZE],
        "windows": WINDOWS,
        "rounds": ROUNDS,
        "seed": SEED,
    }
    machine = {"av": av.__version__, "opencv": cv2.__version__}
    report = write_report("packed_video", results, settings=settings, machine=machine)
    print(report, report.read_text(), sep="\n")


if __name__ == "__main__":
    main()
