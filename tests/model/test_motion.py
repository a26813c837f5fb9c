"""The cue of motion: shifts are found where they are, and frames are still encoded alone."""

import pytest
import torch
from huggingface_hub.errors import StrictDataclassError

from mint_hub.geometry.rotations import quat_xyzw_to_matrix
from mint_hub.inference.network import WindowNetwork
from mint_hub.model.alignment_mint import Alignment
from mint_hub.model.heads_mint import chained
from mint_hub.model.motion_mint import SHIFT_UNIT, MintMotionCue, describe
from tests.small_model import assert_loads_as_saved, small_config, small_model

CUE = {"patch_size": 8, "image_size": (48, 64), "motion_radius": 3}


def texture(seed: int = 0) -> torch.Tensor:
    """A smooth random picture, (1, 3, 80, 96)."""
    noise = torch.rand(1, 3, 80, 96, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.avg_pool2d(noise, 5, 1, 2)


def compare(cue: MintMotionCue, frames: torch.Tensor) -> torch.Tensor:
    """Costs (F, N, shifts) of frames of 6 x 8 patches."""
    now, before = now_and_before(cue, frames)
    return cue.costs(half(now), half(before))


def now_and_before(cue: MintMotionCue, frames: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Frames as the cue sees them; the first is its own predecessor."""
    now = cue.pictures(describe(frames, 8)[None], (6, 8))[0]
    return now, torch.cat([now[:1], now[:-1]])


def half(pictures: torch.Tensor) -> torch.Tensor:
    return torch.nn.functional.avg_pool2d(pictures, 2)


def shifted(down: int, right: int) -> torch.Tensor:
    """Two frames, the second's content moved by pixels, (2, 3, 48, 64)."""
    picture = texture()
    return torch.cat(
        [picture[..., 16 - dy : 64 - dy, 16 - dx : 80 - dx] for dy, dx in ((0, 0), (down, right))]
    )


@pytest.mark.parametrize(("down", "right"), [(0, 0), (2, 0), (0, -2), (1, 3), (-3, 2)])
def test_a_shifted_picture_is_found_at_its_shift(down, right):
    """Moved by so many pixels at half size, a patch was that far back in the frame before."""
    costs = compare(MintMotionCue(4, 8, 3), shifted(2 * down, 2 * right))
    found = costs[1].unflatten(0, (6, 8))[1:-1, 1:-1].argmin(-1)
    assert (found // 7 - 3 == -down).float().mean() > 0.9
    assert (found % 7 - 3 == -right).float().mean() > 0.9


@pytest.mark.parametrize(("down", "right"), [(0, 0), (3, 0), (-1, 4)])
def test_the_camera_and_patches_are_told_the_shift(down, right):
    """Half pixels at half size are pixels: a field without slope or bend, and the same patches."""
    cue = MintMotionCue(4, 8, 3)
    frames = shifted(down, right)
    now, before = now_and_before(cue, frames)
    fields = Alignment(now, before), Alignment(half(now), half(before))
    moved, patches = cue.shifts(*fields, compare(cue, frames), (6, 8))
    back = torch.tensor([-down, -right]) / SHIFT_UNIT
    torch.testing.assert_close(moved[0, :12], torch.zeros(12), atol=1e-4, rtol=0)
    torch.testing.assert_close(moved[1, :2], back, atol=0.02, rtol=0)
    torch.testing.assert_close(moved[1, 2:12], torch.zeros(10), atol=0.03, rtol=0)
    assert moved[1, 13] > 0.6  # of the pixels
    middle = patches[1].unflatten(0, (6, 8))[1:-1, 1:-1, :2]
    torch.testing.assert_close(middle, back.expand_as(middle), atol=0.03, rtol=0)


def test_costs_are_blind_to_light():
    cue, frames = MintMotionCue(4, 8, 2), torch.cat([texture(1), texture(2)])[..., :48, :64]
    frames = (6 * (frames - 0.5) + 0.5).clamp(0, 1)  # as much contrast as real pictures have
    costs = compare(cue, frames)
    assert costs.shape == (2, 48, 25)
    darker = compare(cue, 0.6 * frames + 0.2)
    torch.testing.assert_close(darker, costs, atol=0.01, rtol=0.1)
    assert costs[1].mean() > 0.5


def test_the_first_frame_does_not_move():
    costs = compare(MintMotionCue(4, 8, 2), texture()[..., :48, :64])
    assert (costs.argmin(-1) == 12).all()  # the middle of 5 x 5
    assert (costs[..., 12] == 0).all()


def test_windows_from_cached_tokens_are_windows_from_pixels():
    model = small_model(**CUE)
    frames = torch.rand(9, 3, 48, 64)
    with torch.no_grad():
        tokens = torch.cat([model.encode_frames(frame[None]) for frame in frames])
        assert tokens.shape == (9, 48, model.config.token_size)
        whole = model(pixel_values=frames[None])
        cached = model(patch_tokens=tokens[None])
        plain = model(pixel_values=frames[:1].expand(9, -1, -1, -1)[None])
    torch.testing.assert_close(cached.pose_encoding, whole.pose_encoding, atol=1e-5, rtol=0)
    assert not torch.allclose(plain.pose_encoding, whole.pose_encoding, atol=1e-5)
    predictions = list(WindowNetwork([model], 6, 3, 1).predict(iter(frames)))
    assert [p.window.start for p in predictions] == [0, 3]


def test_it_loads_as_it_was_saved_and_refuses_other_patches(tmp_path):
    model = small_model(**CUE)
    assert_loads_as_saved(model, torch.rand(1, 3, 3, 48, 64), tmp_path)
    with pytest.raises(StrictDataclassError, match="expected a multiple of 4 with a motion_radius"):
        small_config(patch_size=14, motion_radius=2)


def test_motions_chain_into_poses():
    """T_k = D_k ... D_1, the first frame's motion left out; gradients reach every other motion."""
    motions = torch.randn(2, 7, 7, generator=torch.Generator().manual_seed(3), dtype=torch.double)
    motions.requires_grad_()
    poses = chained(motions)
    step, pose = (camera_state_matrices(x) for x in (motions.detach(), poses.detach()))
    expected = torch.eye(4, dtype=torch.double).expand(2, 4, 4)
    for k in range(7):
        expected = step[:, k] @ expected if k else expected
        torch.testing.assert_close(pose[:, k], expected)
    poses.square().sum().backward()
    reached = motions.grad.abs().amax((0, 2)) > 0
    assert reached.tolist() == [False] + 6 * [True]


def camera_state_matrices(state: torch.Tensor) -> torch.Tensor:
    """Translation and quaternion (..., 7) -> (..., 4, 4)."""
    R = quat_xyzw_to_matrix(state[..., 3:])
    top = torch.cat([R, state[..., :3, None]], -1)
    last = torch.tensor([0, 0, 0, 1.0]).to(top).expand(*top.shape[:-2], 1, 4)
    return torch.cat([top, last], -2)


def test_a_chained_window_begins_at_the_identity():
    model = small_model(**CUE, camera_relative_to="previous")
    with torch.no_grad():
        pose = model(torch.rand(2, 5, 3, 48, 64)).pose_encoding
    start = torch.tensor([0, 0, 0, 0, 0, 0, 1.0]).expand(2, 7)
    torch.testing.assert_close(pose[:, 0, :7], start, rtol=0, atol=0)
    assert (pose[:, 1:, :3].abs().sum(-1) > 0).all()
