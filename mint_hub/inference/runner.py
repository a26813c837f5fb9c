"""From one video to one episode: decode, predict windows, chain, fuse, correct, smooth.

`MintRunner` is the plain verb behind the pipeline and the command line. The steps, in order:

1. frames at the model's rate, rectified where the lens is known (`video_input`, `known_camera`);
2. predictions of overlapping windows, each frame encoded once (`network`);
3. window cameras chained into one world, hands and logits track over the overlaps (`fusion`);
4. the first camera made the world; true focal length and device poses put in, where given;
5. presence decided, hands smoothed if asked for, and everything written down in the episode.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm.auto import tqdm

from mint_hub._version import __version__
from mint_hub.conventions import MODEL_FPS
from mint_hub.geometry import hand_state as hands
from mint_hub.geometry import rigid
from mint_hub.geometry.hand_model import HandModel
from mint_hub.geometry.smoothing import SmoothingSettings, smooth_hands
from mint_hub.inference.known_camera import (
    KnownCamera,
    check_poses,
    correct_translation,
    poses_at,
)
from mint_hub.inference.network import WindowNetwork
from mint_hub.inference.track import Track, TrackBuilder
from mint_hub.inference.video_input import Video, VideoInput, key_from_name
from mint_hub.loaders.schema import Episode
from mint_hub.loaders.video import OnError
from mint_hub.model.modeling_mint import MintModel
from mint_hub.model.processing_mint import MintProcessor
from mint_hub.windows import WINDOW_OVERLAP

Float = NDArray[np.float64]

TASK = "egocentric-hands"
"""The name that transformers knows this by."""


@dataclass(frozen=True)
class RunSettings:
    """How a video is run.

    Attributes:
        fps: frames a second the video is resampled to, or None for its own timing. The network was
            trained at 30.
        overlap: frames that consecutive windows share; a quarter of a window, at most 8, when None.
        window: frames in a window; the model's own when None.
        batch_size: windows that go through the network at once.
        presence_threshold: a hand is present where its logit is at least this.
        smooth: smooth the hands ("+ UKF" in the paper's tables), with settings or the defaults.
        chain_over: align windows over "all" frames they share, or the "first" one, as the public
            release does.
        fixed_lens: the lens does not zoom: the field of view is one for the whole video, the median
            of what was predicted frame by frame; hands keep their place in the picture.
        on_error: what damage in the middle of a video does: "raise", or "stop" and keep what came.

    """

    fps: float | None = MODEL_FPS
    overlap: int | None = None
    window: int | None = None
    batch_size: int = 1
    presence_threshold: float = 0.0
    smooth: bool | SmoothingSettings = False
    chain_over: Literal["all", "first"] = "all"
    fixed_lens: bool = True
    on_error: OnError = "raise"

    def __post_init__(self) -> None:
        if self.fps is not None and not (_is_number(self.fps) and 0 < self.fps < math.inf):
            raise ValueError(f"fps: expected a positive number or None, got {self.fps!r}")
        for name, least in (("overlap", 1), ("window", 2), ("batch_size", 1)):
            value = getattr(self, name)
            if value is None and name != "batch_size":
                continue
            if not isinstance(value, int) or isinstance(value, bool) or value < least:
                raise ValueError(f"{name}: expected a whole number from {least}, got {value!r}")
        if not _is_number(self.presence_threshold) or math.isnan(self.presence_threshold):
            raise ValueError(
                f"presence_threshold: expected a number, got {self.presence_threshold!r}"
            )
        if not isinstance(self.smooth, bool | SmoothingSettings):  # pyright: ignore[reportUnnecessaryIsInstance]
            raise ValueError(f"smooth: expected True, False or settings, got {self.smooth!r}")
        if not isinstance(self.fixed_lens, bool):  # pyright: ignore[reportUnnecessaryIsInstance]
            raise ValueError(f"fixed_lens: expected True or False, got {self.fixed_lens!r}")
        for name, values in (("chain_over", ("all", "first")), ("on_error", ("raise", "stop"))):
            if getattr(self, name) not in values:
                raise ValueError(f"{name}: expected one of {values}, got {getattr(self, name)!r}")

    def cut(self, model_window: int) -> tuple[int, int]:
        """Window and overlap in frames, for a model of this window.

        Raises:
            ValueError: an overlap that is no shorter than the window.

        """
        window = model_window if self.window is None else self.window
        overlap = self.overlap
        if overlap is None:
            overlap = max(1, min(WINDOW_OVERLAP, window // 4))
        if overlap >= window:
            raise ValueError(
                f"overlap: expected fewer frames than the window's {window}, got {overlap}"
            )
        return window, overlap

    def resolved(self, model_window: int) -> "RunSettings":
        """The same with window and overlap as numbers; errors as of `cut`."""
        window, overlap = self.cut(model_window)
        return replace(self, window=window, overlap=overlap)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


@dataclass
class _Times:
    """When the frames are shown and where they came from; filled while the video streams."""

    timestamps_s: list[float] = field(default_factory=list[float])
    source_timestamps_s: list[float] = field(default_factory=list[float])


class MintRunner:
    """Runs a MINT model over videos.

    Args:
        model: the model, in evaluation mode, on its device; or one copy a device.
        processor: resizes frames to the model's size.
        hand_model: turns states into joints; by default the licence-free template, or MANO where
            the model speaks MANO's shapes and MANO's files are found.

    """

    def __init__(
        self,
        model: MintModel | Sequence[MintModel],
        processor: MintProcessor,
        hand_model: HandModel | None = None,
    ) -> None:
        self.models = list(model) if isinstance(model, Sequence) else [model]
        self.processor = processor
        config = self.models[0].config
        self.hand_model = hand_model or (
            HandModel.default() if config.shape_space == "mano" else HandModel.template()
        )
        size = processor.video_processor.size
        expected, got = tuple(config.image_size), (size["height"], size["width"])
        if expected != got:
            raise ValueError(
                f"processor size: expected the model's image_size {expected}, got {got}"
            )

    def run(
        self,
        video: Video,
        settings: RunSettings | None = None,
        *,
        camera: Any = None,
        camera_poses: Any = None,
        key: str | None = None,
        warnings: Sequence[str] = (),
        progress: bool = False,
    ) -> Episode:
        """Predict one video.

        Args:
            video: a path, URL, bytes or binary file; or frames in memory (T, H, W, 3).
            settings: see `RunSettings`.
            camera: known intrinsics: K (3, 3), a mapping or a lens (see `lens_from`). Frames are
                rectified, hands placed under the true focal length, and where pictures refine
                the camera's path they do it under that.
            camera_poses: known T_camera_from_world, which replace the predicted ones (see
                `poses_at`).
            key: the episode's key; from the file's name by default.
            warnings: remarks to carry in ``meta["warnings"]``.
            progress: show a bar of frames on standard error.

        Returns:
            The episode: camera, hands and presence a frame. The world is the first camera, unless
            ``camera_poses`` bring a world of their own.

        Raises:
            VideoError: the video cannot be read; the message names it.
            ValueError: settings or known cameras that do not fit, or a network that diverges.

        """
        settings = (settings or RunSettings()).resolved(self.models[0].config.window)
        if camera_poses is not None:
            check_poses(camera_poses)
        window, overlap = settings.cut(self.models[0].config.window)
        with VideoInput.open(video, settings.fps, settings.on_error) as source:
            known = None
            if camera is not None:
                known = KnownCamera.from_user(camera, source.image_size_hw)
            lens = None if known is None else known.fov_vh_rad
            network = WindowNetwork(self.models, window, overlap, settings.batch_size, lens)
            times = _Times()
            builder = TrackBuilder(settings.chain_over)
            with frame_bar(source.num_frames, key_from_name(source.name), progress) as bar:
                for prediction in network.predict(self._pixels(source, known, times, bar)):
                    builder.push(prediction)
            track = builder.finish()
            return self._episode(source, times, track, settings, known, camera_poses, key, warnings)

    def _pixels(
        self, source: VideoInput, known: KnownCamera | None, times: _Times, bar: "tqdm[Any]"
    ) -> Iterator[torch.Tensor]:
        """Frames as the network takes them, (3, H, W) in [0, 1]; notes their times on the way."""
        shown: NDArray[np.uint8] | None = None
        pixels = torch.empty(0)
        for frame in source.frames:
            times.timestamps_s.append(frame.timestamp_s)
            times.source_timestamps_s.append(frame.source_timestamp_s)
            if frame.image is not shown:  # frames repeated by resampling are prepared once
                image = frame.image if known is None else known.apply(frame.image)
                pixels = self.processor.video_processor.preprocess_frames(image[None])[0]
                shown = frame.image
            yield pixels
            bar.update()

    def _episode(
        self,
        source: VideoInput,
        times: _Times,
        track: Track,
        settings: RunSettings,
        known: KnownCamera | None,
        camera_poses: Any,
        key: str | None,
        warnings: Sequence[str],
    ) -> Episode:
        timestamps = np.asarray(times.timestamps_s)
        corrections: list[str] = []
        T_first_from_world = track.T_camera_from_world[0]
        T_camera_from_world = track.T_camera_from_world @ rigid.inverse(T_first_from_world)
        state, fov = track.hand_state, track.fov_vh_rad
        if settings.fixed_lens:
            median = np.broadcast_to(np.median(fov, axis=0), fov.shape)
            state, fov = hands.keep_in_picture(state, fov, median), median
        if known is not None:
            state = correct_translation(state, fov, known.fov_vh_rad)
            fov = np.broadcast_to(known.fov_vh_rad, fov.shape)
            corrections.append("hands placed under the given focal length")
            if self.models[0].config.camera_refinement == "pictures":
                corrections.append("camera path refined under the given focal length")
            if known.rectification is not None:
                corrections.insert(0, "frames rectified by the given lens")
        if camera_poses is not None:
            T_camera_from_world = poses_at(camera_poses, timestamps)
            corrections.append("predicted camera replaced by the given poses")
        logits = track.presence_logits
        presence = logits >= settings.presence_threshold
        if settings.smooth:
            smoothing = settings.smooth if isinstance(settings.smooth, SmoothingSettings) else None
            state = smooth_hands(state, presence, smoothing)
        state = np.where(presence[..., None], state, hands.absent(presence.shape))
        return Episode(
            key=key or key_from_name(source.name),
            timestamps_s=timestamps,
            T_camera_from_world=T_camera_from_world,
            fov_vh_rad=fov.astype(np.float32),
            hand_state=state.astype(np.float32),
            presence=presence,
            presence_score=(1 / (1 + np.exp(-logits))).astype(np.float32),
            image_size_hw=source.image_size_hw,
            meta=self._meta(source, times, track, settings, known, corrections, warnings),
        )

    @staticmethod
    def _scale_status(corrections: list[str]) -> str:
        """Whose metres these are: the network's unless the camera's poses were given."""
        given = any("given poses" in correction for correction in corrections)
        return "camera given, hands predicted" if given else "predicted"

    def _meta(
        self,
        source: VideoInput,
        times: _Times,
        track: Track,
        settings: RunSettings,
        known: KnownCamera | None,
        corrections: list[str],
        warnings: Sequence[str],
    ) -> dict[str, Any]:
        model = self.models[0]
        config = model.config
        smooth = settings.smooth
        if smooth is True:
            smooth = SmoothingSettings()
        meta: dict[str, Any] = {
            "source": source.name,
            "fps": source.fps,
            "source_timestamps_s": times.source_timestamps_s,
            "conventions": "camera: world-to-camera, OpenCV axes, metres; hands: camera frame",
            "scale_status": self._scale_status(corrections),
            "shape_space": config.shape_space,
            "hand_model": self.hand_model.name,
            "warnings": [*warnings, *source.warnings],
            "provenance": {
                "task": TASK,
                "mint_hub": __version__,
                "model": str(config._name_or_path) or "in memory",  # pyright: ignore
                "revision": getattr(config, "_commit_hash", None),
                "dtype": str(model.dtype).removeprefix("torch."),
                "devices": [str(m.device) for m in self.models],
                "settings": asdict(replace(settings, smooth=smooth)),
                "corrections": corrections,
                "seams": track.seam_report(),
            },
        }
        if known is not None and known.rectification is not None:
            meta["lens"] = known.lens.to_dict()
        return meta


def frame_bar(total: int | None, name: str, show: bool) -> "tqdm[Any]":
    """Make a progress bar of frames on standard error, hidden where that is no terminal."""
    hidden = None if show else True
    return tqdm(total=total, unit="frame", desc=name, leave=False, disable=hidden)
