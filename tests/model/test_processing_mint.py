"""The processors: every kind of input gives the same pixels, and bad input says what is wrong."""

import io
import json
import subprocess
import sys

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from transformers.image_utils import ChannelDimension
from transformers.video_utils import VideoMetadata

from mint_hub.loaders.video import VideoError, VideoNotFoundError, iter_frames
from mint_hub.model.configuration_mint import MintConfig
from mint_hub.model.processing_mint import MintProcessor, MintVideoMetadata, MintVideoProcessor
from tests import video_files as make

SIZE = {"height": 28, "width": 42}


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    return make.video(tmp_path_factory.mktemp("processing") / "clip.mp4", 10)


@pytest.fixture(scope="module")
def frames(clip):
    """(10, 48, 64, 3) uint8."""
    return np.stack([frame.image for frame in iter_frames(clip)])


@pytest.fixture
def processor():
    return MintVideoProcessor(size=SIZE)


def pixels(processor, video, **options):
    return processor(video, return_tensors="pt", **options)["pixel_values"]


# ---------------------------------------------------------------- what comes out


def test_every_kind_of_input_gives_the_same_pixels(processor, clip, frames):
    reference = pixels(processor, clip)
    assert reference.shape == (1, 10, 3, 28, 42)
    assert reference.dtype == torch.float32
    assert reference.is_contiguous()
    assert 0 <= reference.min() < reference.max() <= 1
    channels_first = np.ascontiguousarray(frames.transpose(0, 3, 1, 2))
    unit = frames.astype(np.float32) / 255
    exact = {
        "str": str(clip),
        "bytes": clip.read_bytes(),
        "file": io.BytesIO(clip.read_bytes()),
        "undecoded column": {"path": str(clip), "bytes": None},
        "list of a path": [clip],
        "nested path": [[str(clip)]],
        "array": frames,
        "array, channels first": channels_first,
        "reversed twice": frames[::-1][::-1],
        "read only": np.broadcast_to(frames, frames.shape),
        "int64": frames.astype(np.int64),
        "tensor": torch.from_numpy(channels_first),
        "tensor, channels last": torch.from_numpy(frames),
        "batch of one": frames[None],
        "list of arrays": list(frames),
        "tuple of tensors": tuple(torch.from_numpy(channels_first)),
        "list of a list": [list(frames)],
    }
    for name, video in exact.items():
        torch.testing.assert_close(pixels(processor, video), reference, rtol=0, atol=0, msg=name)
    for name, video in {"float": unit, "double": torch.from_numpy(unit).double()}.items():
        given = pixels(processor, video)
        assert given.dtype == torch.float32, name
        torch.testing.assert_close(given, reference, rtol=0, atol=1.01 / 255, msg=name)


def test_pillow_frames(processor, frames):
    image = pytest.importorskip("PIL.Image")
    video = [image.fromarray(frame) for frame in frames]
    reference = pixels(processor, frames)
    torch.testing.assert_close(pixels(processor, video), reference, rtol=0, atol=0)
    torch.testing.assert_close(pixels(processor, video[0]), reference[:, :1], rtol=0, atol=0)
    grey = [frame.convert("L") for frame in video]
    assert pixels(processor, grey).shape == (1, 10, 3, 28, 42)


@pytest.mark.parametrize("size_hw", [(1080, 1920), (512, 512), (480, 640), (200, 300), (378, 518)])
def test_resize_is_the_antialiased_bilinear_filter_to_one_level(size_hw):
    rng = np.random.default_rng(0)
    video = rng.integers(0, 256, (2, *size_hw, 3), dtype=np.uint8)
    given = MintVideoProcessor().preprocess_frames(video)
    reference = F.interpolate(
        torch.from_numpy(video).permute(0, 3, 1, 2).float() / 255,
        size=(378, 518),
        mode="bilinear",
        antialias=True,
        align_corners=False,
    )
    assert given.shape == (2, 3, 378, 518)
    difference = (given - reference).abs() * 255
    assert difference.max() <= 1.01
    assert (given - reference).mean().abs() * 255 < 0.05


def test_preprocess_frames_is_the_same_path_as_a_call(processor, frames):
    one_by_one = torch.cat([processor.preprocess_frames(frame[None]) for frame in frames])
    torch.testing.assert_close(one_by_one, pixels(processor, frames)[0], rtol=0, atol=0)
    for wrong in (frames[0], frames.astype(np.float32), frames[..., :2]):
        with pytest.raises(ValueError, match=r"frames: expected \(n, H, W, 3\) uint8, got"):
            processor.preprocess_frames(wrong)


def test_return_tensors(processor, frames):
    tensor = pixels(processor, [frames, frames])
    assert tensor.shape == (2, 10, 3, 28, 42)
    array = processor([frames, frames], return_tensors="np")["pixel_values"]
    assert isinstance(array, np.ndarray)
    np.testing.assert_array_equal(array, tensor)
    listed = processor([frames, frames[:4]])["pixel_values"]
    assert [tuple(video.shape) for video in listed] == [(10, 3, 28, 42), (4, 3, 28, 42)]


def test_input_is_not_changed(processor, frames):
    video = torch.from_numpy(frames.astype(np.float32) / 255)
    before = video.clone()
    pixels(processor, video, do_resize=False, do_normalize=True, image_mean=0.5, image_std=0.5)
    pixels(processor, video.permute(0, 3, 1, 2).contiguous(), do_resize=False)
    torch.testing.assert_close(video, before, rtol=0, atol=0)


# ---------------------------------------------------------------- options


def test_options_of_a_call_override_attributes(processor, frames):
    raw = pixels(processor, frames, do_resize=False, do_rescale=False)
    assert raw.shape == (1, 10, 3, 48, 64)
    np.testing.assert_array_equal(raw[0].numpy(), frames.transpose(0, 3, 1, 2))
    assert pixels(processor, frames, size={"height": 14, "width": 14}).shape[-2:] == (14, 14)
    assert pixels(processor, frames, size=14).shape[-2:] == (14, 14)
    assert pixels(processor, frames, rescale_factor=-1.0).max() <= 0
    normalised = pixels(
        processor, frames, do_normalize=True, image_mean=[0.5, 0.4, 0.3], image_std=[0.2, 0.1, 0.5]
    )
    expected = (pixels(processor, frames) - torch.tensor([0.5, 0.4, 0.3])[:, None, None]) / (
        torch.tensor([0.2, 0.1, 0.5])[:, None, None]
    )
    torch.testing.assert_close(normalised, expected)
    for resample in (0, 3):
        assert pixels(processor, frames, resample=resample).shape == (1, 10, 3, 28, 42)
    assert processor.size == SIZE


def test_grey_and_transparent_frames_become_rgb(processor):
    grey = np.full((2, 48, 64, 1), 100, np.uint8)
    torch.testing.assert_close(
        pixels(processor, grey), torch.full((1, 2, 3, 28, 42), 100 / 255), rtol=0, atol=1e-6
    )
    glass = np.zeros((2, 48, 64, 4), np.uint8)  # black, see-through: the white behind it
    assert pixels(processor, glass).min() == 1
    glass[..., 3] = 255
    assert pixels(processor, glass).max() == 0


def test_ambiguous_layout_is_settled_by_kind_or_by_name(processor):
    video = np.random.default_rng(0).integers(0, 256, (2, 3, 40, 3), dtype=np.uint8)
    last = pixels(processor, video, input_data_format=ChannelDimension.LAST)
    first = pixels(processor, video, input_data_format="channels_first")
    assert not torch.equal(first, last)
    assert torch.equal(pixels(processor, video), last)
    assert torch.equal(pixels(processor, torch.from_numpy(video)), first)


def test_files_are_resampled_to_the_rate(processor, tmp_path):
    path = make.video(tmp_path / "sixty.mp4", 20, rate=60)
    assert pixels(processor, path).shape[1] == 10
    assert pixels(processor, path, fps=15).shape[1] == 5
    for options in ({"fps": None}, {"do_sample_frames": False}):
        assert pixels(processor, path, **options).shape[1] == 20
    assert pixels(processor, path, num_frames=4).shape[1] == 4
    slow = make.video(tmp_path / "slow.mp4", 5, rate=15)
    doubled = pixels(processor, slow)[0]
    assert len(doubled) == 10
    torch.testing.assert_close(doubled[0::2], doubled[1::2], rtol=0, atol=0)


def test_metadata_maps_outputs_to_the_source(processor, tmp_path):
    path = make.vfr(tmp_path / "phone.mkv", [0, 20, 90, 100, 400, 433])
    output = processor(path, return_tensors="pt", return_metadata=True)
    [metadata] = output["video_metadata"]
    assert isinstance(metadata, MintVideoMetadata)
    assert metadata.total_num_frames == 6
    assert metadata.frames_indices == [0, 1, 2, 3, 3, 3, 3, 3, 4, 4, 4, 4, 4, 5]
    np.testing.assert_allclose(metadata.timestamps_s, np.arange(14) / 30, atol=1e-9)
    stored = np.array([0, 0.02, 0.09, 0.1, 0.4, 0.433])
    np.testing.assert_allclose(metadata.timestamps, stored[metadata.frames_indices], atol=1e-6)
    assert (metadata.height, metadata.width, metadata.video_backend) == (48, 64, "pyav")
    assert metadata.warnings == []
    assert list(processor(path, return_tensors="pt")) == ["pixel_values"]


def test_sampling_decoded_frames(processor, frames):
    metadata = {"total_num_frames": 10, "fps": 60.0, "duration": 1 / 6}
    options = {"do_sample_frames": True, "video_metadata": metadata}
    whole = pixels(processor, frames)
    assert torch.equal(pixels(processor, frames, **options), whole[:, ::2])
    assert torch.equal(pixels(processor, frames, fps=20, **options), whole[:, [0, 3, 6, 9]])
    assert torch.equal(pixels(processor, frames, num_frames=5, **options), whole[:, ::2])
    assert torch.equal(pixels(processor, frames, video_metadata=metadata), whole)
    with pytest.raises(ValueError, match="fps=30: unknown frame rate"):
        processor(frames, do_sample_frames=True)
    with pytest.raises(ValueError, match="num_frames: expected at most the video's 10, got 11"):
        processor(frames, num_frames=11, **options)
    with pytest.raises(ValueError, match="exclude each other"):
        processor.sample_frames(VideoMetadata(10, 30.0), num_frames=3, fps=3)


# ---------------------------------------------------------------- saved and loaded


def test_size_comes_from_the_configuration(frames):
    config = MintConfig(image_size=(56, 84))
    assert MintVideoProcessor(size=config.image_size).size == {"height": 56, "width": 84}
    assert MintProcessor.for_config(config).video_processor.size == {"height": 56, "width": 84}
    assert MintVideoProcessor().size == {"height": 378, "width": 518}


def test_save_and_load(tmp_path, processor, frames):
    processor.save_pretrained(tmp_path / "video")
    loaded = MintVideoProcessor.from_pretrained(tmp_path / "video")
    assert loaded.to_dict() == processor.to_dict()
    assert json.loads(loaded.to_json_string())["size"] == SIZE
    assert torch.equal(pixels(loaded, frames), pixels(processor, frames))
    changed = MintVideoProcessor.from_pretrained(tmp_path / "video", fps=None, size=14)
    assert changed.size == {"height": 14, "width": 14}
    none = MintVideoProcessor(do_resize=None)
    assert MintVideoProcessor.from_dict(none.to_dict()).do_resize is None


def test_instances_do_not_share_their_size():
    one, two = MintVideoProcessor(), MintVideoProcessor()
    one.size["height"] = -1
    assert two.size == MintVideoProcessor().size == {"height": 378, "width": 518}


def test_processor_passes_on(processor, clip, frames):
    both = MintProcessor(processor)
    assert both.model_input_names == ["pixel_values"]
    assert list(both(videos=clip, return_tensors="pt")) == both.model_input_names
    assert torch.equal(pixels(both, frames), pixels(processor, frames))
    assert pixels(both, frames, videos_kwargs={"size": {"height": 14, "width": 14}}).shape[-1] == 14
    assert both(frames, return_metadata=True)["video_metadata"][0].total_num_frames == 10
    assert MintProcessor().video_processor.size == {"height": 378, "width": 518}
    with pytest.raises(ValueError, match="videos: expected a video or a list of videos, got None"):
        both()
    with pytest.raises(TypeError, match="video_processor: expected a video processor, got str"):
        MintProcessor("video")


ALONE = """
import sys
sys.modules["PIL"] = sys.modules["torchvision"] = None  # as if not installed
import numpy as np, torch
import mint_hub
from mint_hub import MintProcessor, MintVideoProcessor
from transformers import AutoProcessor
from transformers.models.auto.video_processing_auto import AutoVideoProcessor
from transformers.utils import is_torchvision_available, is_vision_available
assert not is_vision_available() and not is_torchvision_available()
clip, folder = sys.argv[1:]
made = MintProcessor(MintVideoProcessor(size=(28, 42)))
made.save_pretrained(folder)
frames = np.zeros((3, 48, 64, 3), np.uint8)
for video in (clip, frames, list(frames), torch.from_numpy(frames)):
    assert made(video, return_tensors="pt", fps=15)["pixel_values"].shape[2:] == (3, 28, 42)
both, video = AutoProcessor.from_pretrained(folder), AutoVideoProcessor.from_pretrained(folder)
assert type(both) is MintProcessor and type(video) is MintVideoProcessor
assert both.to_dict() == made.to_dict() and video.to_dict() == made.video_processor.to_dict()
"""


def test_alone_without_torchvision_and_pillow(clip, tmp_path):
    """From files and arrays to pixels, and through both auto classes, in a bare environment."""
    run = subprocess.run(
        [sys.executable, "-c", ALONE, str(clip), str(tmp_path)], capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr


# ---------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("video", "message"),
    [
        ([], "videos: expected at least one video, got an empty list"),
        (3, "videos: expected files, arrays or frames, got int"),
        (
            np.zeros((2, 8, 8, 5), np.uint8),
            r"expected \(T, H, W, 3\) or .*, got \(2, 8, 8, 5",
        ),
        (np.zeros((8, 8), np.uint8), r"videos: expected 4 dimensions a video, got shape \(8, 8\)"),
        (np.zeros((0, 8, 8, 3), np.uint8), "videos: expected at least one frame"),
        (np.full((2, 8, 8, 3), 200.0), r"floating point frames in \[0, 1\], got \[200, 200\]"),
        (np.full((2, 8, 8, 3), np.nan), r"floating point frames in \[0, 1\], got \[nan, nan\]"),
        (np.full((2, 8, 8, 3), 300), r"videos: expected 0\.\.255, got 300\.\.300 as torch.int64"),
        (np.zeros((2, 8, 8, 3), bool), "videos: expected 0..255"),
        ([np.zeros((8, 8, 3)), np.zeros((9, 8, 3))], r"frame 1: expected \(8, 8, 3\) as before"),
        ([np.zeros((8, 8, 3)), "x.png"], r"frame 1: expected \(H, W, C\) or \(C, H, W\), got str"),
    ],
)
def test_bad_frames(processor, video, message):
    with pytest.raises(ValueError, match=message):
        processor(video, return_tensors="pt")


def test_bad_files_are_named(processor, tmp_path):
    with pytest.raises(VideoNotFoundError, match=r"none\.mp4: no such file"):
        processor(tmp_path / "none.mp4")
    path = make.cut_with_index(tmp_path / "cut.mp4")
    with pytest.raises(VideoError, match=r"cut\.mp4: damaged at frame"):
        processor([path])


def test_unequal_lengths_do_not_become_one_tensor(processor, frames):
    message = r"cannot make one tensor of videos of \[10, 4\] frames; .* return_tensors=None"
    for kind in ("pt", "np"):
        with pytest.raises(ValueError, match=message):
            processor([frames, frames[:4]], return_tensors=kind)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"sise": 3}, TypeError, r"MintVideoProcessor: unknown arguments \['sise'\]"),
        ({"do_center_crop": True, "crop_size": 8}, ValueError, "do_center_crop: not supported"),
        ({"size": {"shortest_edge": 8}}, ValueError, "size: expected height and width, got"),
        ({"resample": 1}, ValueError, "resample: expected one of"),
        ({"do_normalize": True}, ValueError, "image_mean"),
        (
            {"video_metadata": [{"total_num_frames": 1}] * 2},
            ValueError,
            r"one a video \(1\), got 2",
        ),
    ],
)
def test_bad_options(processor, frames, options, error, message):
    with pytest.raises(error, match=message):
        processor(frames, **options)


# ---------------------------------------------------------------- real clips


@pytest.mark.real
def test_real_clips(real_dir):
    processor = MintVideoProcessor(size=SIZE)
    found = sorted(path for path in real_dir.glob("*/*.mp4"))
    assert len(found) == 6
    for path in found:
        output = pixels(processor, path)
        assert output.shape[2:] == (3, 28, 42)
        assert 0.05 < output.mean() < 0.95
        assert output.std() > 0.05
