"""Stages that need no video to be looked at: what runner, manifest and account do is their test.

`Invent` can be told to misbehave on single clips: ``faults`` maps a clip key to "raise", "reject",
"die" (kill its own process, always) or "die once".
"""

import os
import signal
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mint_hub.geometry import hand_state
from mint_hub.labelling.records import (
    CameraPath,
    Clip,
    Hands,
    Intrinsics,
    StageReport,
    Video,
)
from mint_hub.labelling.stage import Outcome, Resources, StageError, reported


class Cut:
    """Cuts a video into pieces of one second."""

    stage, backend, version = "normalise", "fake", "1"
    needs, gives = (), ()
    resources = Resources(cpus=1)

    @dataclass(frozen=True)
    class Settings:
        piece_s: float = 1.0

    def __init__(self, settings: Settings | None = None) -> None:
        self.settings = settings or self.Settings()

    def run_video(self, video: Video) -> Video:
        frames = round(video.duration_s * 30)
        length = round(self.settings.piece_s * 30)
        clips = tuple(
            Clip(
                key=f"{video.key}-{i:02d}",
                video=video.path,
                first_frame=start,
                image_size_hw=video.image_size_hw,
                fps=30.0,
                source_timestamps_s=video.start_s
                + np.arange(start, min(start + length, frames)) / 30,
            )
            for i, start in enumerate(range(0, frames, length))
        )
        return Video(**{**video.__dict__, "clips": clips})

    def close(self) -> None:
        pass


class Invent:
    """Gives a clip everything, or misbehaves; every call leaves a line in ``log``."""

    stage, backend, version = "camera", "fake", "1"
    needs: tuple[str, ...] = ()
    gives = ("intrinsics", "camera", "hands")
    resources = Resources(cpus=1)

    @dataclass(frozen=True)
    class Settings:
        log: str
        sleep_s: float = 0.0
        faults: dict[str, str] = field(default_factory=dict)

    def __init__(self, settings: Settings) -> None:
        self.settings = settings

    def run_clip(self, clip: Clip, video: Video) -> Outcome:
        fault = self.settings.faults.get(clip.key)
        time.sleep(self.settings.sleep_s)
        if fault == "raise":
            raise ZeroDivisionError("no parallax")
        if fault == "stage error":
            raise StageError("this clip is beyond me")
        if fault == "reject":
            return Outcome((), (clip.lost(self.stage, "too dark"),))
        died = Path(f"{self.settings.log}.died")
        if fault == "die" or (fault == "die once" and not died.exists()):
            died.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        with open(self.settings.log, "a") as log:
            log.write(f"{clip.key}\n")
        frames = clip.num_frames
        T = np.tile(np.eye(4), (frames, 1, 1))
        T[:, 0, 3] = clip.source_timestamps_s
        hands = Hands(
            hand_state=np.asarray(hand_state.absent((frames, 2)), np.float32),
            presence=np.ones((frames, 2), bool),
            score=np.full((frames, 2), 0.5, np.float32),
            filled=np.zeros((frames, 2), bool),
            shape_space="mint",
            hand_model="template",
            source="fake",
            residual_px=np.ones((frames, 2), np.float32),
        )
        camera = CameraPath(T, np.ones(frames, bool), np.full(frames, 200, np.float32), 0.5, "fake")
        report = StageReport(self.stage, self.backend, self.version)
        changes = {"camera": camera, "hands": hands, "intrinsics": Intrinsics((1.0, 1.2), "x", 1)}
        return Outcome((reported(clip, report, **changes),))

    def close(self) -> None:
        pass
