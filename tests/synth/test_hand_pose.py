"""A hand by its angles: the same rotations as the drawn poses, the same points as the model."""

import numpy as np
import pytest

from mint_hub.conventions import SIDES
from mint_hub.geometry.hand_model import HandModel
from mint_hub.geometry.hand_state import HandState
from mint_hub.synth.draw_hand import pose
from mint_hub.synth.hand_pose import (
    FINGERS,
    LIMITS_DEG,
    NUM_ANGLES,
    POSTURES,
    HandProxy,
    joint_rotations,
)

SHAPE = np.array([1.2, -0.5, 0.3, 0.8, -1.0, 0.4, 0.2, -0.7, 0.5, 0.1])


def test_no_angle_is_the_flat_hand():
    assert np.allclose(joint_rotations(np.zeros((4, NUM_ANGLES))), np.eye(3))


@pytest.mark.parametrize("name", POSTURES)
def test_postures_keep_the_limits(name):
    angles = POSTURES[name]
    assert (angles >= LIMITS_DEG[:, 0]).all()
    assert (angles <= LIMITS_DEG[:, 1]).all()


def test_angles_mean_what_the_drawn_poses_mean():
    rng = np.random.default_rng(0)
    for angles in rng.uniform(*LIMITS_DEG.T, (5, NUM_ANGLES)):
        fingers = angles[:16].reshape(4, 4)
        curl = {name: tuple(f[:3]) for name, f in zip(FINGERS, fingers, strict=True)}
        spread = {name: float(f[3]) for name, f in zip(FINGERS, fingers, strict=True)}
        drawn = pose(curl, spread, (angles[16:19], angles[19], angles[20]))
        assert np.allclose(joint_rotations(angles), drawn)


@pytest.mark.parametrize("side", SIDES)
def test_proxy_points_are_points_of_the_model(side):
    model, proxy = HandModel.template(), HandProxy.of(SHAPE)
    state = HandState.from_matrices(
        np.zeros(3), np.eye(3), joint_rotations(POSTURES["claw"]), SHAPE
    )
    vertices = model.vertices(state.pack(), side)
    points = proxy.points(POSTURES["claw"][None], side)[0]
    away = np.linalg.norm(vertices[:, None] - points, axis=-1).min(0)
    assert away.max() < 1e-9


def test_pads_face_inwards():
    """Bending a finger brings its pad nearer to the palm."""
    proxy = HandProxy.of(np.zeros(10))
    flat, bent = (proxy.points(POSTURES[n][None])[0] for n in ("flat", "pinch"))
    for pad in proxy.pads[:4]:
        to_palm = [np.linalg.norm(p[pad].mean(0) - p[proxy.palm].mean(0)) for p in (flat, bent)]
        assert to_palm[1] < to_palm[0]
