"""The second look at hands: where it looks, what it cuts out, and that mirrored is mirrored."""

import pytest
import torch
from huggingface_hub.errors import StrictDataclassError

from mint_hub.geometry.hand_model import HandModel
from mint_hub.model.crop_mint import MintHandCrops, mirror_signs
from mint_hub.model.losses_mint import ATTENTION_TERM, LossSettings
from mint_hub.model.modeling_mint import MintModel
from tests.small_model import small_config, small_model

CROPS = {"patch_size": 8, "image_size": (48, 64), "hand_crop_size": 16}


def test_squares_are_cut_out_about_their_centres_and_the_left_one_mirrored():
    picture = torch.rand(1, 3, 48, 64, generator=torch.Generator().manual_seed(0))
    cut = MintHandCrops(8, 16).cut(picture, torch.tensor([[[-0.5, 0.0], [0.25, 0.5]]]))
    # Middles: x = 16, y = 24 and x = 40, y = 36 pixels.
    torch.testing.assert_close(cut[0, 0], picture[0, :, 16:32, 8:24].flip(-1), atol=1e-5, rtol=0)
    torch.testing.assert_close(cut[0, 1], picture[0, :, 28:44, 32:48], atol=1e-5, rtol=0)


def test_a_square_beyond_the_border_repeats_it():
    picture = torch.arange(64.0).expand(1, 3, 48, 64)
    cut = MintHandCrops(8, 16).cut(picture, torch.tensor([[[-1.0, 0.0], [1.0, 0.0]]]))
    assert (cut[0, 0, :, :, 8:] == 0).all()
    assert (cut[0, 1, :, :, 8:] == 63).all()


def test_the_centre_is_that_of_the_patch_it_is_sure_of():
    where = torch.full((1, 2, 48), 1e-4)
    where[0, 0, 0] = where[0, 1, 2 * 8 + 5] = 1.0
    expected = torch.tensor([[[1 / 8 - 1, 1 / 6 - 1], [11 / 8 - 1, 5 / 6 - 1]]])
    torch.testing.assert_close(MintHandCrops.centre(where, (6, 8)), expected, atol=1e-5, rtol=0)


def test_signs_turn_a_right_hand_into_the_mirrored_left_one():
    """Joints of the left hand are those of the right one, mirrored across x."""
    model, generator = HandModel.template(), torch.Generator().manual_seed(1)
    state = torch.randn(5, 109, generator=generator)
    both = state[:, None] * mirror_signs()
    left, right = model.keypoints(both).unbind(1)
    torch.testing.assert_close(left * torch.tensor([-1.0, 1, 1]), right, atol=1e-5, rtol=1e-5)


def test_windows_from_cached_tokens_are_windows_from_pixels():
    model, frames = small_model(**CROPS, motion_radius=2), torch.rand(1, 4, 3, 48, 64)
    with torch.no_grad():
        tokens = torch.cat([model.encode_frames(frames[:, k : k + 1]) for k in range(4)], 1)
        assert tokens.shape == (1, 4, 48 + 2, model.config.token_size)
        whole, cached = model(pixel_values=frames), model(patch_tokens=tokens)
    torch.testing.assert_close(cached.hand_state, whole.hand_state, atol=1e-5, rtol=0)
    with pytest.raises(ValueError, match=r"patch_tokens: expected \(B, T, 50, "):
        model(patch_tokens=tokens[:, :, :48])


def test_what_is_in_a_crop_reaches_its_hand():
    model, frames = small_model(**CROPS), torch.rand(1, 1, 3, 48, 64)
    with torch.no_grad():
        before = model(frames).hand_state
        for parameter in model.encoder.hand_crops.join.parameters():
            parameter.add_(1.0)
        after = model(frames).hand_state
    assert (after - before).abs().amax((0, 1, 3)).min() > 0


def test_the_attention_term_alone_teaches_where_to_look():
    model = small_model(**CROPS).train()
    pose, state = torch.zeros(1, 2, 9), torch.zeros(1, 2, 2, 109)
    pose[..., 6], pose[..., 7:] = 1.0, 1.2
    state[..., 2], state[..., 3:99] = 0.4, torch.tensor([1.0, 0, 0, 0, 1, 0]).repeat(16)
    labels = {
        "pose_encoding": pose,
        "hand_state": state,
        "presence": torch.ones(1, 2, 2, dtype=torch.bool),
    }
    place = model.encoder.hand_crops.locate.weight

    def gradient(term: str) -> float:
        model.loss_settings = LossSettings({term: 1.0})
        model.zero_grad()
        model(torch.rand(1, 2, 3, 48, 64), labels=labels).loss.backward()
        return 0.0 if place.grad is None else float(place.grad.abs().sum())

    assert gradient("hand/transl_l1") == 0
    assert gradient(ATTENTION_TERM) > 0


def test_it_loads_as_it_was_saved_and_refuses_other_sizes(tmp_path):
    model, frames = small_model(**CROPS), torch.rand(1, 2, 3, 48, 64)
    model.save_pretrained(tmp_path)
    loaded = MintModel.from_pretrained(tmp_path).eval()
    with torch.no_grad():
        torch.testing.assert_close(
            loaded(frames).hand_state, model(frames).hand_state, rtol=0, atol=0
        )
    with pytest.raises(StrictDataclassError, match="hand_crop_size: expected a multiple of 16"):
        small_config(hand_crop_size=20)
