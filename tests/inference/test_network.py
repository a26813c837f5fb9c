"""Windows of a stream: each frame encoded once, one answer for all batch sizes and devices."""

import numpy as np
import pytest
import torch

from mint_hub.inference.network import WindowNetwork
from mint_hub.windows import Window, windows
from tests.small_model import small_model


@pytest.fixture(scope="module")
def model():
    return small_model()


@pytest.fixture(scope="module")
def frames():
    return torch.rand(61, 3, 28, 42, generator=torch.Generator().manual_seed(3))


def predict(models, frames, length=16, overlap=4, batch_size=1):
    return list(WindowNetwork(models, length, overlap, batch_size).predict(iter(frames)))


def test_equals_the_model_window_by_window(model, frames):
    predictions = predict([model], frames)
    assert [p.window for p in predictions] == windows(61, 16, 4)
    for p in predictions:
        with torch.no_grad():
            output = model(pixel_values=frames[p.window.frames][None])
        np.testing.assert_allclose(p.hand_state, output.hand_state[0], atol=1e-5)
        np.testing.assert_allclose(p.presence_logits, output.presence_logits[0], atol=1e-5)
        np.testing.assert_allclose(p.fov_vh_rad, output.pose_encoding[0, :, 7:], atol=1e-5)
        np.testing.assert_allclose(
            p.T_camera_from_world[:, :3, 3], output.pose_encoding[0, :, :3], atol=1e-5
        )


@pytest.mark.parametrize("batch_size", [2, 3, 100])
@pytest.mark.parametrize("copies", [1, 3])
def test_batches_and_devices_change_nothing(model, frames, batch_size, copies):
    plain = predict([model], frames)
    spread = predict([model] * copies, frames, batch_size=batch_size)
    assert [p.window for p in plain] == [p.window for p in spread]
    for a, b in zip(plain, spread, strict=True):
        np.testing.assert_allclose(a.hand_state, b.hand_state, atol=1e-5)


def test_every_frame_is_encoded_once(model, frames, monkeypatch):
    seen = []
    encode = model.encode_frames
    monkeypatch.setattr(model, "encode_frames", lambda x: seen.append(len(x)) or encode(x))
    predict([model], frames, overlap=8)
    assert sum(seen) == len(frames)


@pytest.mark.parametrize("count", [1, 5, 16])
def test_short_videos_are_one_window(model, frames, count):
    (prediction,) = predict([model], frames[:count])
    assert prediction.window == Window(0, count)


def test_tokens_do_not_pile_up(model):
    """At any time no more frames are alive than a few windows, however long the stream is."""
    import weakref

    alive: set[int] = set()
    most = 0

    def stream():
        nonlocal most
        for k in range(300):
            frame = torch.full((3, 28, 42), k / 300)
            alive.add(k)
            weakref.finalize(frame, alive.discard, k)
            most = max(most, len(alive))
            yield frame

    for _ in WindowNetwork([model], 16, 4, 1).predict(stream()):
        pass
    assert most <= 48


def test_divergence_is_told_with_its_frame(frames):
    model = small_model()
    broken = frames.clone()
    broken[20] = float("nan")
    with pytest.raises(ValueError, match="not finite at frame"):
        predict([model], broken)


def test_no_frames(model):
    with pytest.raises(ValueError, match="at least one frame"):
        predict([model], frames=[])


def test_bad_sizes_are_refused_at_once(model):
    with pytest.raises(ValueError, match="overlap"):
        WindowNetwork([model], 16, 16, 1)
    with pytest.raises(ValueError, match="batch_size"):
        WindowNetwork([model], 16, 4, 0)
    with pytest.raises(ValueError, match="models"):
        WindowNetwork([], 16, 4, 1)


def test_an_error_in_the_stream_is_raised(model):
    def stream():
        yield from torch.rand(20, 3, 28, 42)
        raise OSError("the disk is gone")

    with pytest.raises(OSError, match="the disk is gone"):
        predict([model], stream())
