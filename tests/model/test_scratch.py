"""How a network begins that has nothing to begin from: see `MintConfig.initializer`."""

import math

import pytest
import torch
from huggingface_hub.errors import StrictDataclassError

from mint_hub.geometry import camera_state, hand_state
from mint_hub.model.heads_mint import INITIAL_FOV_VH_DEG, INITIAL_WRIST_M
from mint_hub.model.modeling_mint import MintModel, sine_positions
from tests.small_model import small_config, small_model

SIZES = {"initializer": "scratch", "hidden_size": 64, "encoder_layers": 2, "position_grid": 4}


@pytest.fixture(scope="module")
def model():
    torch.manual_seed(0)
    return MintModel(small_config(**SIZES, camera_output_scale=0.05)).eval()


def test_its_heads_start_at_their_mean_answer(model):
    with torch.no_grad():
        output = model(torch.rand(2, 3, 3, 28, 42))
    hands = hand_state.unpack(output.hand_state)
    offset = hands.translation - torch.tensor(INITIAL_WRIST_M)
    assert offset.abs().max() < 0.02
    eye = torch.eye(3)
    assert (hands.orientation(check=False) - eye).abs().max() < 0.02
    camera = camera_state.unpack(output.pose_encoding)
    assert camera.translation.abs().max() < 0.005
    assert (camera.quat_xyzw - torch.tensor([0.0, 0, 0, 1])).abs().max() < 0.005
    expected = torch.tensor([math.radians(d) for d in INITIAL_FOV_VH_DEG])
    assert (camera.fov_vh_rad - expected).abs().max() < 0.02
    assert output.presence_logits.abs().max() < 0.05


def test_features_tell_pictures_and_places_apart(model):
    """Of all that tokens hold, a good part is the picture's, and a good part the place's."""

    def spread(network):
        frames = torch.rand(8, 3, 1, 1).expand(-1, -1, 28, 42)  # one colour each
        with torch.no_grad():
            tokens, _ = network.encoder(frames, "eager")
        return float(tokens.std(0).mean()), float(tokens.std(1).mean())

    torch.manual_seed(0)
    release = MintModel(small_config(**SIZES | {"initializer": "release"})).eval()
    pictures, places = spread(model)
    assert pictures > 0.2
    assert places > 0.1
    assert spread(release)[1] < 0.5 * places


def test_layers_keep_the_size_of_what_goes_through(model):
    stds = {
        n: float(p.detach().std()) * p[0].numel() ** 0.5
        for n, p in model.named_parameters()
        if _of(n)
    }
    assert len(stds) > 10
    for name, gain in stds.items():
        assert gain == pytest.approx(1.0, rel=0.15), name


def _of(name: str) -> bool:
    return name.startswith(("encoder.layers", "aggregator")) and name.endswith(
        ("qkv.weight", "out.weight", "fc1.weight", "fc2.weight")
    )


def test_positions_are_waves_of_both_sides():
    table = sine_positions(5, 32).reshape(5, 5, 32)
    assert table.abs().max() <= 0.5
    assert torch.equal(table[:, 2, :16], table[0, 2, :16].expand(5, -1))  # of x alone
    assert torch.equal(table[3, :, 16:], table[3, 0, 16:].expand(5, -1))  # of y alone
    distances = torch.cdist(table.flatten(0, 1), table.flatten(0, 1))
    assert distances[~torch.eye(25, dtype=torch.bool)].min() > 0.1


def test_the_camera_heads_scale_multiplies_what_it_says():
    one, half = small_model(), small_model(camera_output_scale=0.5)
    half.load_state_dict(one.state_dict())
    tokens = torch.rand(1, 4, 64)
    with torch.no_grad():
        full, scaled = (m.camera_head(tokens, "eager")[0] for m in (one, half))
    torch.testing.assert_close(scaled, 0.5 * full)
    with pytest.raises(StrictDataclassError, match="camera_output_scale: expected more than 0"):
        small_config(camera_output_scale=0.0)
