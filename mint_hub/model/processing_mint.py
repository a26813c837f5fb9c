"""Video to the network's input: transformers processors without torchvision or Pillow.

Shape letters: B videos, T frames, C channels, H x W a picture's size, h x w the network's.

A picture is resized with torch's antialiased bilinear filter (`torch.nn.functional.interpolate`
with ``antialias=True, align_corners=False``; Pillow and torchvision filter alike). 8-bit pictures
are filtered in 8-bit arithmetic on a CPU and rounded elsewhere, so that what the network is fed is
one of 256 levels on every device: within one level of filtering in floating point, and 10 to 20
times faster. Pictures given in floating point are filtered in floating point. OpenCV's INTER_AREA
is as fast but several levels away, so it is not used.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
import torch
import torch.nn.functional as F
from huggingface_hub.dataclasses import validate_typed_dict
from transformers.feature_extraction_utils import BatchFeature
from transformers.image_utils import SizeDict
from transformers.processing_utils import ProcessorMixin, Unpack, VideosKwargs
from transformers.video_processing_utils import BaseVideoProcessor
from transformers.video_utils import VideoMetadata

from .frames_mint import (
    as_tensor,
    channels_first,
    check_unit_range,
    is_array,
    is_decoded,
    is_encoded,
    is_pillow,
    to_rgb,
)
from .saving_mint import SavesCode

_FILTERS = {0: "nearest-exact", 2: "bilinear", 3: "bicubic"}  # Pillow's numbers
_TIE = 1e-6


@dataclass
class MintVideoMetadata(VideoMetadata):
    """Where the frames of a decoded file come from.

    Attributes:
        timestamps_s: times of the frames, on the grid they were resampled to, seconds.
        source_timestamps_s: presentation times of the stored frames they show, seconds.
        warnings: what was forgiven while decoding.

    """

    timestamps_s: list[float] = field(default_factory=list)
    source_timestamps_s: list[float] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    @property
    def timestamps(self) -> list[float]:
        """Presentation times of the frames shown, seconds (exact at variable frame rates too)."""
        return self.source_timestamps_s


class MintVideoProcessor(SavesCode, BaseVideoProcessor):
    """Decodes, resamples in time, resizes and rescales videos.

    A video is a path, a URL, bytes, a binary file object, the dict of an undecoded dataset column,
    an array or tensor (T, H, W, C) or (T, C, H, W), or a list of frames (arrays, tensors or Pillow
    images). Integers hold 0..255 and are multiplied by ``rescale_factor``; floating point numbers
    hold [0, 1] and are not. A list of videos, nested or not, is a batch.

    Files are resampled by presentation time to ``fps`` (``fps=None`` or ``do_sample_frames=False``:
    every stored frame); decoded frames are taken as they are, unless ``do_sample_frames=True``.
    Normalisation happens inside the network, so there is none here by default.

    Returns (from a call):
        ``pixel_values`` (B, T, 3, h, w) float32 in [0, 1], a list of (T, 3, h, w) without
        ``return_tensors``; with ``return_metadata=True`` also ``video_metadata``, one a video.

    Raises:
        VideoError: (ValueError) a file that cannot be read, named.
        ValueError: frames of a wrong shape or range; videos of different lengths asked for as one
            tensor.

    """

    model_input_names = ["pixel_values"]  # noqa: RUF012 (transformers' own protocol)
    valid_kwargs = VideosKwargs
    size = {"height": 378, "width": 518}  # noqa: RUF012
    default_to_square = True
    resample = 2
    do_resize = True
    do_rescale = True
    rescale_factor = 1 / 255
    do_normalize = False
    do_convert_rgb = True
    fps = 30.0

    def __init__(self, **kwargs: Any) -> None:
        if __name__.startswith("mint_hub."):  # as in MintConfig: no reference to copied code
            kwargs.pop("auto_map", None)
        super().__init__(**kwargs)

    def preprocess(self, videos: Any, **kwargs: Unpack[VideosKwargs]) -> BatchFeature:
        """See the class."""
        options = self._options(kwargs)
        batch = list(_each_video(videos))
        if not batch:
            raise ValueError("videos: expected at least one video, got an empty list")
        known = _each_metadata(options["video_metadata"], len(batch))
        done = [self._one(*pair, options) for pair in zip(batch, known, strict=True)]
        pixels: Any = [pixel for pixel, _ in done]
        if options["return_tensors"] is not None:
            pixels = _stack(pixels)
            if str(getattr(options["return_tensors"], "value", options["return_tensors"])) == "np":
                pixels = pixels.cpu().numpy()
        features = BatchFeature({"pixel_values": pixels})
        if options["return_metadata"]:
            features["video_metadata"] = [metadata for _, metadata in done]
        return features

    def preprocess_frames(self, frames: np.ndarray) -> torch.Tensor:
        """Process frames as a call would, for callers that decode by themselves.

        Args:
            frames: (n, H, W, 3) uint8 RGB.

        Returns:
            (n, 3, h, w) float32 in [0, 1].

        """
        if frames.ndim != 4 or frames.shape[-1] != 3 or frames.dtype != np.uint8:
            raise ValueError(
                f"frames: expected (n, H, W, 3) uint8, got {frames.shape} {frames.dtype}"
            )
        return self._pixels(as_tensor(frames).permute(0, 3, 1, 2), self._options({}))

    def _options(self, kwargs: Mapping[str, Any]) -> dict[str, Any]:
        """Check the arguments of a call and fill in the rest from the attributes."""
        valid = self.valid_kwargs.__annotations__
        if unknown := sorted(set(kwargs) - set(valid)):
            raise TypeError(f"{type(self).__name__}: unknown arguments {unknown}")
        validate_typed_dict(self.valid_kwargs, dict(kwargs))
        options = {name: kwargs.get(name, getattr(self, name, None)) for name in valid}
        if kwargs.get("num_frames") is not None and "fps" not in kwargs:
            options["fps"] = None
        options = self._standardize_kwargs(**options)
        self._validate_preprocess_kwargs(**options)
        for name in ("do_center_crop", "do_pad"):
            if options[name]:
                raise ValueError(f"{name}: not supported, the field of view is the whole picture's")
        return options

    def _one(
        self, video: Any, metadata: VideoMetadata | None, options: dict[str, Any]
    ) -> tuple[torch.Tensor, VideoMetadata]:
        if is_encoded(video):
            return self._decoded(video, options)
        frames = channels_first(video, options["input_data_format"])
        if metadata is None:
            total, _, height, width = frames.shape
            metadata = VideoMetadata(
                total, height=height, width=width, frames_indices=list(range(total))
            )
        if options["do_sample_frames"]:
            indices = self.sample_frames(metadata, options["num_frames"], options["fps"])
            metadata.frames_indices = indices.tolist()
            frames = frames[torch.from_numpy(indices)]
        return self._pixels(frames, options), metadata

    def _decoded(
        self, source: Any, options: dict[str, Any]
    ) -> tuple[torch.Tensor, MintVideoMetadata]:
        sampled = options["do_sample_frames"] is not False
        stream = _open(source, options["fps"] if sampled else None)
        info, pixels, times = stream.info, [], []
        shown = None
        for frame in stream:
            if frame.image is shown:  # a frame repeated by resampling is prepared once
                pixels.append(pixels[-1])
            else:
                shown = frame.image
                pixels.append(self._pixels(as_tensor(shown)[None].permute(0, 3, 1, 2), options))
            times.append((frame.source_index, frame.timestamp_s, frame.source_timestamp_s))
        video = torch.cat(pixels)
        metadata = MintVideoMetadata(
            total_num_frames=times[-1][0] + 1,
            fps=info.fps,
            height=info.image_size_hw[0],
            width=info.image_size_hw[1],
            duration=info.duration_s,
            video_backend="pyav",
            warnings=stream.warnings,
        )
        if sampled and options["num_frames"] is not None:
            indices = self.sample_frames(
                VideoMetadata(len(times), info.fps), options["num_frames"], None
            ).tolist()
            video, times = video[indices], [times[i] for i in indices]
        columns = [list(column) for column in zip(*times, strict=True)]
        metadata.frames_indices, metadata.timestamps_s, metadata.source_timestamps_s = columns
        return video, metadata

    def sample_frames(
        self,
        metadata: VideoMetadata,
        num_frames: int | None = None,
        fps: float | None = None,
        **_: Any,
    ) -> np.ndarray:
        """Choose frames of a decoded video: ``num_frames`` evenly, or those nearest to k / ``fps``.

        Args:
            metadata: ``total_num_frames`` and, for ``fps``, the video's own ``fps``.
            num_frames: how many.
            fps: frames a second wanted.

        Returns:
            Indices into the video, non-decreasing; all of them when neither is given.

        Raises:
            ValueError: both are given, more frames than there are, or an unknown frame rate.

        """
        total = metadata.total_num_frames
        if num_frames is not None and fps is not None:
            raise ValueError("num_frames and fps exclude each other: give one")
        if num_frames is not None:
            if num_frames > total:
                raise ValueError(
                    f"num_frames: expected at most the video's {total}, got {num_frames}"
                )
            return np.arange(num_frames) * total // num_frames
        if fps is None:
            return np.arange(total)
        if not metadata.fps:
            raise ValueError(f"fps={fps:g}: unknown frame rate; give video_metadata with its 'fps'")
        slack = min(1, fps / metadata.fps) / 2 + _TIE  # as for files
        count = max(1, math.ceil(total / metadata.fps * fps - slack))
        nearest = np.ceil(np.arange(count) / fps * metadata.fps - 0.5 - _TIE).astype(int)
        return np.clip(nearest, 0, total - 1)

    def fetch_videos(self, video_url_or_urls: Any, sample_indices_fn: Any = None) -> Any:
        """Decode files at their own timing: (T, H, W, 3) uint8 and metadata, or lists of both."""
        if isinstance(video_url_or_urls, list):
            pairs = [self.fetch_videos(url, sample_indices_fn) for url in video_url_or_urls]
            return list(zip(*pairs, strict=True))
        stream = _open(video_url_or_urls, None)
        frames = list(stream)
        metadata = MintVideoMetadata(
            total_num_frames=len(frames),
            fps=stream.info.fps,
            duration=stream.info.duration_s,
            video_backend="pyav",
        )
        indices = range(len(frames)) if sample_indices_fn is None else sample_indices_fn(metadata)
        frames = [frames[i] for i in indices]
        metadata.frames_indices = [frame.source_index for frame in frames]
        metadata.timestamps_s = [frame.timestamp_s for frame in frames]
        metadata.source_timestamps_s = [frame.source_timestamp_s for frame in frames]
        return np.stack([frame.image for frame in frames]), metadata

    def _pixels(self, frames: torch.Tensor, options: dict[str, Any]) -> torch.Tensor:
        """(n, C, H, W) frames -> (n, 3, h, w) float32."""
        frames = frames if options["device"] is None else frames.to(options["device"])
        if options["do_convert_rgb"]:
            frames = self.convert_to_rgb(frames)
        if options["do_rescale"] and frames.is_floating_point():
            check_unit_range(frames)
        do_rescale = options["do_rescale"] and not frames.is_floating_point()
        if options["do_resize"]:
            frames = self.resize(frames, options["size"], options["resample"])
        return self.rescale_and_normalize(
            frames,
            do_rescale,
            options["rescale_factor"],
            options["do_normalize"],
            options["image_mean"],
            options["image_std"],
        )

    def convert_to_rgb(self, video: torch.Tensor, **_: Any) -> torch.Tensor:
        """(n, C, H, W) -> (n, 3, H, W): grey is repeated, transparency is laid over white."""
        return to_rgb(video)

    def resize(
        self, image: torch.Tensor, size: SizeDict, resample: Any = None, **_: Any
    ) -> torch.Tensor:
        """(n, C, H, W) -> (n, C, h, w), same dtype; see the head of this file."""
        if not (size.height and size.width):
            raise ValueError(f"size: expected height and width, got {dict(size)}")
        mode = _FILTERS.get(2 if resample is None else int(resample))
        if mode is None:
            raise ValueError(f"resample: expected one of {_FILTERS}, got {resample}")
        target = (size.height, size.width)
        if tuple(image.shape[-2:]) == target:
            return image
        options: dict[str, Any] = {"size": target, "mode": mode}
        if mode != "nearest-exact":
            options |= {"antialias": True, "align_corners": False}
        if image.is_floating_point() or image.device.type == "cpu":
            return F.interpolate(image, **options)
        resized = F.interpolate(image.float(), **options)
        return resized.clamp_(0, 255).round_().to(image.dtype)

    def rescale_and_normalize(
        self,
        images: torch.Tensor,
        do_rescale: bool,
        rescale_factor: float,
        do_normalize: bool,
        image_mean: Any = None,
        image_std: Any = None,
    ) -> torch.Tensor:
        """(n, C, h, w) -> float32: times ``rescale_factor``, then minus mean over deviation."""
        given, images = images, images.to(torch.float32, memory_format=torch.contiguous_format)
        if do_rescale:
            images = images * rescale_factor if images is given else images.mul_(rescale_factor)
        if do_normalize:
            mean = torch.as_tensor(image_mean, dtype=torch.float32, device=images.device)
            std = torch.as_tensor(image_std, dtype=torch.float32, device=images.device)
            images = (images - mean.view(-1, 1, 1)) / std.view(-1, 1, 1)
        return images


class MintProcessor(SavesCode, ProcessorMixin):
    """What `transformers` loads beside a MINT model: a `MintVideoProcessor`, no tokenizer.

    Args:
        video_processor: a `MintVideoProcessor`; its defaults without one.

    """

    def __init__(self, video_processor: BaseVideoProcessor | None = None) -> None:
        super().__init__(MintVideoProcessor() if video_processor is None else video_processor)

    @classmethod
    def for_config(cls, config: Any) -> Self:
        """Make the processor of a `MintConfig`: frames come out at its ``image_size``."""
        height, width = config.image_size
        return cls(MintVideoProcessor(size={"height": height, "width": width}))

    def __call__(self, videos: Any = None, **kwargs: Any) -> BatchFeature:
        """Process videos; arguments and result are those of `MintVideoProcessor`."""
        if videos is None:
            raise ValueError("videos: expected a video or a list of videos, got None")
        return self.video_processor(videos, **self._merge_kwargs(**kwargs)["videos_kwargs"])

    def check_argument_for_proper_class(self, argument_name: str, argument: Any) -> type:
        """Refuse other things by name (transformers would compare with a placeholder class)."""
        if not isinstance(argument, BaseVideoProcessor):
            raise TypeError(
                f"{argument_name}: expected a video processor, got {type(argument).__name__}"
            )
        return BaseVideoProcessor


def _open(source: Any, fps: float | None) -> Any:
    try:
        from mint_hub.loaders.video import iter_frames
    except ImportError as error:  # the file was downloaded as remote code, without the package
        raise ImportError("to decode video files: pip install mint-hub; or give frames") from error
    return iter_frames(source, fps)


def _each_video(videos: Any) -> Iterator[Any]:
    """Flatten whatever nesting into videos."""
    if is_encoded(videos):
        yield videos
    elif is_array(videos):
        if videos.ndim not in (3, 4, 5):
            raise ValueError(
                f"videos: expected 4 dimensions a video, got shape {tuple(videos.shape)}"
            )
        yield from videos if videos.ndim == 5 else [videos if videos.ndim == 4 else videos[None]]
    elif is_pillow(videos):
        yield [videos]
    elif isinstance(videos, list | tuple):
        if is_decoded(videos):
            yield videos
        else:
            for video in videos:
                yield from _each_video(video)
    else:
        raise ValueError(f"videos: expected files, arrays or frames, got {type(videos).__name__}")


def _each_metadata(given: Any, count: int) -> list[VideoMetadata | None]:
    if given is None:
        return [None] * count
    if isinstance(given, VideoMetadata) or not isinstance(given, list | tuple):
        given = [given]
    flat = [one for item in given for one in (item if isinstance(item, list | tuple) else [item])]
    if len(flat) != count:
        raise ValueError(f"video_metadata: expected one a video ({count}), got {len(flat)}")
    return [one if isinstance(one, VideoMetadata) else VideoMetadata(**one) for one in flat]


def _stack(pixels: list[torch.Tensor]) -> torch.Tensor:
    shapes = {tuple(video.shape) for video in pixels}
    if len(shapes) > 1:
        lengths = [len(video) for video in pixels]
        sizes = "" if len(set(lengths)) > 1 else f" and shapes {sorted(shapes)}"
        raise ValueError(
            f"videos: cannot make one tensor of videos of {lengths} frames{sizes}; "
            "give them one at a time, or return_tensors=None for a list"
        )
    return pixels[0][None] if len(pixels) == 1 else torch.stack(pixels)
