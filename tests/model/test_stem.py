"""The convolutional stem: tokens where patches are, shifts with the picture, and loads as saved."""

import pytest
import torch
from huggingface_hub.errors import StrictDataclassError

from mint_hub.model.configuration_mint import MintConfig
from mint_hub.model.layers_mint import MintConvolutionalStem
from mint_hub.model.modeling_mint import MintModel
from tests.small_model import small_config, small_model

STEM = {"patch_size": 8, "patch_stem": "convolutional", "image_size": (24, 32)}


def test_a_token_for_every_patch_that_moves_with_the_picture():
    torch.manual_seed(0)
    stem = MintConvolutionalStem(16, 8)
    images = torch.rand(2, 3, 48, 64)
    tokens = stem(images)
    assert tokens.shape == (2, 16, 6, 8)
    moved = stem(torch.roll(images, (8, 16), (2, 3)))
    inside = (slice(None), slice(None), slice(2, -1), slice(3, -1))
    torch.testing.assert_close(
        moved[inside], torch.roll(tokens, (1, 2), (2, 3))[inside], rtol=0, atol=1e-5
    )


def test_it_halves_the_picture_as_often_as_the_patch_needs():
    sizes = [
        tuple(layer.weight.shape[:2])
        for layer in MintConvolutionalStem(192, 16)
        if isinstance(layer, torch.nn.Conv2d)
    ]
    assert sizes == [(24, 3), (48, 24), (96, 48), (192, 96)]


def test_a_network_with_it_loads_as_it_was_saved(tmp_path):
    model = small_model(**STEM)
    model.save_pretrained(tmp_path)
    loaded = MintModel.from_pretrained(tmp_path).eval()
    assert loaded.config.patch_stem == "convolutional"
    frames = torch.rand(1, 2, 3, 24, 32)
    with torch.no_grad():
        mine, theirs = model(frames), loaded(frames)
    for name in ("pose_encoding", "hand_state", "presence_logits"):
        torch.testing.assert_close(theirs[name], mine[name], rtol=0, atol=0)
    assert isinstance(loaded.get_input_embeddings(), MintConvolutionalStem)


@pytest.mark.parametrize("patch", [1, 14])
def test_patches_that_halving_does_not_reach_are_refused(patch):
    with pytest.raises(StrictDataclassError, match=f"expected a power of 2.*got {patch}"):
        small_config(**STEM | {"patch_size": patch, "image_size": (28, 28)})


def test_the_release_has_none():
    assert MintConfig().patch_stem == "linear"
