"""Frames in, predictions of whole windows out: each frame encoded once, windows in batches.

With accelerators, work is handed to one thread a device, so that decoding and resizing (in the
caller's thread) go on while the network runs, and several devices share the windows of a video. On
a single CPU everything runs in the caller's thread: a second one would only compete for the cores.
Nothing grows with the length of the video: a few windows of patch tokens are held at a time.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import cycle
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from mint_hub.geometry import camera_state
from mint_hub.model.modeling_mint import MintModel
from mint_hub.windows import Window, WindowPlanner

ENCODE_BATCH: Final = 8
"""Frames that the patch encoder sees at once; it fills a device without holding much memory."""


@dataclass(frozen=True)
class WindowPrediction:
    """What the network says of one window of L frames.

    Attributes:
        window: the frames it covers.
        T_camera_from_world: (L, 4, 4) float64, metres; the world is the window's own.
        fov_vh_rad: (L, 2) float64.
        hand_state: (L, 2, 109) float32, camera frame.
        presence_logits: (L, 2) float32.

    """

    window: Window
    T_camera_from_world: NDArray[np.float64]
    fov_vh_rad: NDArray[np.float64]
    hand_state: NDArray[np.float32]
    presence_logits: NDArray[np.float32]


class _Inline(Executor):
    """Runs what is submitted at once, in the caller's thread."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> "Future[Any]":
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


class _Device:
    """One copy of the model and the thread that feeds it."""

    def __init__(self, model: MintModel, alone: bool) -> None:
        self.model = model
        on_cpu = model.device.type == "cpu"
        self.thread = _Inline() if alone and on_cpu else ThreadPoolExecutor(1, "mint-device")

    @torch.inference_mode()
    def encode(self, pixels: torch.Tensor) -> torch.Tensor:
        """(F, 3, H, W) -> (F, N, C), left on the device."""
        return self.model.encode_frames(pixels.to(self.model.device))

    @torch.inference_mode()
    def predict(
        self,
        windows: Sequence[Window],
        tokens: Sequence[Sequence["_Token"]],
        grid: tuple[int, int],
        known_fov_vh: NDArray[np.float64] | None,
    ) -> list[WindowPrediction]:
        """Run a batch of windows of one length, each a list of tokens by frame."""
        device = self.model.device
        stacked = torch.stack(
            [torch.stack([token.result().to(device) for token in row]) for row in tokens]
        )  # (B, T, N, C)
        known = None
        if known_fov_vh is not None:
            known = torch.tensor(known_fov_vh, dtype=torch.float32, device=device)
            known = known.expand(len(windows), 2)
        output = self.model(patch_tokens=stacked, grid_hw=grid, known_fov_vh=known)
        fields = (output.pose_encoding, output.hand_state, output.presence_logits)
        pose, hands, logits = (field.float().cpu().numpy() for field in fields)
        return [
            _prediction(window, *parts)
            for window, *parts in zip(windows, pose, hands, logits, strict=True)
        ]


@dataclass(frozen=True)
class _Token:
    """Patch tokens of one frame, being made: row ``row`` of what ``future`` will hold."""

    future: "Future[torch.Tensor]"
    row: int

    def result(self) -> torch.Tensor:
        return self.future.result()[self.row]


class WindowNetwork:
    """Runs `MintModel` over the windows of a video.

    Args:
        models: one copy of the model a device, all with the same weights.
        length: frames in a window.
        overlap: frames that consecutive windows share.
        batch_size: windows that go through the aggregator at once.
        known_fov_vh: (2,) radians of a lens that is known; the cameras are refined under it.

    Raises:
        ValueError: no model, or sizes out of range.

    """

    def __init__(
        self,
        models: Sequence[MintModel],
        length: int,
        overlap: int,
        batch_size: int,
        known_fov_vh: NDArray[np.float64] | None = None,
    ) -> None:
        if not models:
            raise ValueError("models: expected at least one, got none")
        if batch_size < 1:
            raise ValueError(f"batch_size: expected at least 1 window, got {batch_size}")
        self.models = models
        self.length = length
        self.overlap = overlap
        self.batch_size = batch_size
        self.known_fov_vh = known_fov_vh
        WindowPlanner(self.length, overlap)  # complains about sizes at once

    def predict(self, frames: Iterable[torch.Tensor]) -> Iterator[WindowPrediction]:
        """Predictions of the windows of a stream of frames, in order, as they become ready.

        Args:
            frames: (3, H, W) float in [0, 1] each, all of one size.

        Raises:
            ValueError: no frames, or a prediction that is not finite, naming what and where.

        """
        patch = self.models[0].config.patch_size
        with ExitStack() as stack:
            devices = [_Device(model, alone=len(self.models) == 1) for model in self.models]
            for device in devices:
                stack.callback(device.thread.shutdown, wait=True, cancel_futures=True)
            turn = cycle(devices)
            planner = WindowPlanner(self.length, self.overlap)
            tokens: dict[int, _Token] = {}
            ready: list[Window] = []
            running: deque[Future[list[WindowPrediction]]] = deque()
            encoding: deque[Future[torch.Tensor]] = deque()
            grid = (0, 0)

            def launch(batch: list[Window]) -> None:
                device = next(turn)
                rows = [[tokens[i] for i in range(w.start, w.stop)] for w in batch]
                running.append(
                    device.thread.submit(device.predict, batch, rows, grid, self.known_fov_vh)
                )

            for pixels in _batches(frames, ENCODE_BATCH):
                grid = (pixels.shape[-2] // patch, pixels.shape[-1] // patch)
                device = next(turn)
                encoded = device.thread.submit(device.encode, pixels)
                encoding.append(encoded)
                first = planner.num_frames
                tokens |= {first + row: _Token(encoded, row) for row in range(len(pixels))}
                ready += planner.push(len(pixels))
                while len(ready) >= self.batch_size:
                    launch(ready[: self.batch_size])
                    del ready[: self.batch_size]
                keep = min([planner.needed_from, *(w.start for w in ready)])
                for index in [i for i in tokens if i < keep]:
                    del tokens[index]
                while len(encoding) > 2 * len(devices):  # decode no further ahead than this
                    encoding.popleft().result()
                while len(running) > len(devices) or (running and running[0].done()):
                    yield from running.popleft().result()
            ready += planner.finish()
            for at in range(0, len(ready), self.batch_size):
                launch(ready[at : at + self.batch_size])
            for future in running:
                yield from future.result()


def _batches(frames: Iterable[torch.Tensor], size: int) -> Iterator[torch.Tensor]:
    """Stack up to ``size`` frames at a time."""
    batch: list[torch.Tensor] = []
    for frame in frames:
        batch.append(frame)
        if len(batch) == size:
            yield torch.stack(batch)
            batch = []
    if batch:
        yield torch.stack(batch)


def _prediction(
    window: Window,
    pose: NDArray[np.float32],
    hands: NDArray[np.float32],
    logits: NDArray[np.float32],
) -> WindowPrediction:
    for name, values in (("camera", pose), ("hand", hands), ("presence", logits)):
        finite = np.isfinite(values.reshape(len(values), -1)).all(-1)
        if not finite.all():
            frame = window.start + int(np.argmin(finite))
            raise ValueError(
                f"the network's {name} output is not finite at frame {frame}: its weights or its "
                "precision (try dtype float32) do not work for this video"
            )
    state = camera_state.unpack(pose.astype(np.float64))
    return WindowPrediction(
        window, np.asarray(state.T_camera_from_world()), np.asarray(state.fov_vh_rad), hands, logits
    )
