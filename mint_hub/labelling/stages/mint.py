"""MINT itself as a backend: any checkpoint, so that labels by model come out in the same records.

`MintCamera` gives camera and hands in one pass; `MintHands` keeps those where it finds them, and
runs the model where the camera came from elsewhere; `MintIntrinsics` freezes what the model thinks
of the field of view over the video. Known intrinsics correct the hands' depth, as in inference.
"""

import hashlib
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.assets import checkpoint_named
from mint_hub.geometry.camera import fov_vh_to_K
from mint_hub.inference.opening import open_model, runner_of
from mint_hub.inference.runner import MintRunner, RunSettings
from mint_hub.labelling.frames import clip_frames
from mint_hub.labelling.readiness import Lack, check
from mint_hub.labelling.records import CameraPath, Clip, Hands, Intrinsics, Video
from mint_hub.labelling.stage import (
    LOCAL,
    NotReadyError,
    Outcome,
    Resources,
    report_of,
    reported,
    require,
)
from mint_hub.loaders.schema import Episode

_SURE: Final = 0.05
"""Focal lengths of windows that differ by this much have confidence 1/2."""


@dataclass(frozen=True)
class MintSettings:
    """Settings of the three stages.

    Attributes:
        model: a folder with a checkpoint as `transformers` loads it, a repository ORG/NAME, or
            "mint-tiny".
        device: "cuda:0", "mps", "cpu".
        presence_threshold: a hand is present where its logit is at least this.
        batch_size: windows that go through the network at once.
        windows: how many `MintIntrinsics` looks at, spread over the video.
        content: of a folder, which files it holds, found by the stage: others, other results.

    """

    model: str = field(default="", metadata=LOCAL)
    device: str = "cpu"
    presence_threshold: float = 0.0
    batch_size: int = 1
    windows: int = 4
    content: str = ""


class MintStage:
    """What the three share: a loaded model."""

    backend: str = "mint"
    version: str = "1"
    resources: Resources = Resources(cpus=2.0, memory_gib=8.0)

    def __init__(self, settings: MintSettings | None = None) -> None:
        settings = settings or MintSettings()
        self.settings = replace(settings, content=_content(settings.model))
        self._runner: MintRunner | None = None
        if self.settings.device.startswith("cuda"):
            self.resources = Resources(cpus=1.0, gpus=1.0, memory_gib=8.0)

    def lacks(self) -> tuple[Lack, ...]:
        """Return what is missing for it to run; a repository's name is taken on trust."""
        if self.settings.model:
            return ()
        where = (
            "the public MINT weights or your own, as `mint-hub convert-checkpoint` or training "
            "writes them"
        )
        return (Lack("a MINT checkpoint (setting model: folder or ORG/NAME)", where),)

    def close(self) -> None:
        """Let go of the model."""
        self._runner = None

    def runner(self) -> MintRunner:
        """Return the loaded model.

        Raises:
            NotReadyError: no checkpoint is named, or none can be read at that name.
            ValueError: no such device.

        """
        if self._runner is None:
            check(self.lacks())
            try:
                model = open_model(self.settings.model)
            except (OSError, ValueError) as error:
                raise NotReadyError(f"MINT checkpoint {self.settings.model}: {error}") from error
            self._runner = runner_of(model, [self.settings.device])
        return self._runner

    def predict(self, images: NDArray[np.uint8], clip: Clip) -> Episode:
        """Run the model over frames of a clip, under its intrinsics where they are known."""
        run = RunSettings(
            fps=clip.fps,
            batch_size=self.settings.batch_size,
            presence_threshold=self.settings.presence_threshold,
        )
        return self.runner().run(images, run, camera=_pinhole(clip), key=clip.key)


class MintIntrinsics(MintStage):
    """Stage "intrinsics", backend "mint"."""

    stage: str = "intrinsics"
    needs: tuple[str, ...] = ()
    gives: tuple[str, ...] = ("intrinsics",)

    def run_video(self, video: Video) -> Video:
        """Give every clip the median field of view over windows spread over the video."""
        if not video.clips:
            return video
        fields: list[NDArray[np.float64]] = []
        for clip, start, stop in windows_of(video.clips, self._window(), self.settings.windows):
            images = np.stack(list(clip_frames(clip, start, stop)))
            episode = self.predict(images, replace(clip, intrinsics=None))
            fields.append(np.median(episode.fov_vh_rad.astype(np.float64), axis=0))
        intrinsics = to_intrinsics(np.stack(fields))
        report = report_of(self, fov_vh_deg=np.degrees(np.stack(fields)).tolist())
        clips = tuple(replace(clip, intrinsics=intrinsics) for clip in video.clips)
        return replace(video, clips=clips, reports=(*video.reports, report))

    def _window(self) -> int:
        return int(self.runner().models[0].config.window)


class MintCamera(MintStage):
    """Stage "camera", backend "mint": metric, and the hands of the same pass with it."""

    stage: str = "camera"
    needs: tuple[str, ...] = ("intrinsics",)
    gives: tuple[str, ...] = ("camera", "hands")

    def run_clip(self, clip: Clip, video: Video) -> Outcome:
        """Predict the clip."""
        require(self, clip)
        episode = self.predict(np.stack(list(clip_frames(clip))), clip)
        camera, hands = to_camera(episode), to_hands(episode)
        report = report_of(self, **_seams(episode), **_shares(hands))
        return Outcome((reported(clip, report, camera=camera, hands=hands),))


class MintHands(MintStage):
    """Stage "hands", backend "mint"."""

    stage: str = "hands"
    needs: tuple[str, ...] = ("intrinsics",)
    gives: tuple[str, ...] = ("hands",)

    def run_clip(self, clip: Clip, video: Video) -> Outcome:
        """Keep the hands that came with MINT's camera, else predict them."""
        require(self, clip)
        hands = clip.hands
        if hands is None or hands.source != self.backend:
            hands = to_hands(self.predict(np.stack(list(clip_frames(clip))), clip))
        return Outcome((reported(clip, report_of(self, **_shares(hands)), hands=hands),))


def to_intrinsics(fov_vh_rad: NDArray[np.float64]) -> Intrinsics:
    """Median of fields of view (N, 2); confidence 1 / (1 + (relative spread of focals / 5 %)^2)."""
    vertical, horizontal = (float(x) for x in np.median(fov_vh_rad, axis=0))
    focals = 1 / np.tan(fov_vh_rad[:, 0] / 2)
    spread = float(np.std(focals) / np.mean(focals))
    return Intrinsics((vertical, horizontal), "mint", 1 / (1 + (spread / _SURE) ** 2))


def to_camera(episode: Episode) -> CameraPath:
    """Camera path of an episode that the model made; covisibility and residual are NaN."""
    count = episode.num_frames
    return CameraPath(
        T_camera_from_world=episode.T_camera_from_world,
        solved=np.ones(count, bool),
        covisible=np.full(count, np.nan, np.float32),
        residual_px=float("nan"),
        source="mint",
        metric=True,
    )


def to_hands(episode: Episode) -> Hands:
    """Hands of an episode that the model made; their score is the presence's, 0 where absent."""
    presence = episode.presence
    score = presence.astype(np.float32)
    if episode.presence_score is not None:
        score = np.where(presence, episode.presence_score, np.float32(0)).astype(np.float32)
    return Hands(
        hand_state=episode.hand_state,
        presence=presence,
        score=score,
        filled=np.zeros(presence.shape, bool),
        shape_space=episode.meta["shape_space"],
        hand_model=episode.meta["hand_model"],
        source="mint",
        residual_px=np.full(presence.shape, np.nan, np.float32),
    )


def windows_of(clips: tuple[Clip, ...], window: int, count: int) -> list[tuple[Clip, int, int]]:
    """Up to ``count`` stretches of at most ``window`` frames, spread over the clips."""
    every = [
        (clip, start, min(start + window, clip.num_frames))
        for clip in clips
        for start in range(0, max(clip.num_frames - window, 0) + 1, window)
    ]
    count = min(count, len(every))
    return [every[int((i + 0.5) * len(every) / count)] for i in range(count)]


def _content(model: str) -> str:
    """Return a hash of a folder's configuration and of its weights' sizes and times."""
    folder = Path(checkpoint_named(model))
    if not model or not folder.is_dir():
        return model
    digest = hashlib.sha256()
    for path in sorted(folder.glob("*")):
        if path.suffix == ".json":
            digest.update(path.read_bytes())
        elif path.suffix == ".safetensors":
            stat = path.stat()
            digest.update(f"{path.name} {stat.st_size} {stat.st_mtime_ns}".encode())
    return digest.hexdigest()[:16]


def _pinhole(clip: Clip) -> NDArray[np.float64] | None:
    """K (3, 3) of a clip whose intrinsics are known."""
    if clip.intrinsics is None:
        return None
    return fov_vh_to_K(np.array(clip.intrinsics.fov_vh_rad, np.float64), clip.image_size_hw)


def _seams(episode: Episode) -> dict[str, Any]:
    return {"seams": episode.meta["provenance"]["seams"]}


def _shares(hands: Hands) -> dict[str, Any]:
    left, right = (float(share) for share in hands.presence.mean(0))
    return {"left": left, "right": right}
