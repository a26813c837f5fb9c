"""Grasps: pads on the surface, nothing inside it, angles within their limits, on real meshes."""

import numpy as np
import pytest

from mint_hub.conventions import SIDES
from mint_hub.geometry.hand_model import HandModel
from mint_hub.geometry.hand_state import HandState
from mint_hub.synth.grasps import CONTACTS, Grasp, aligned, fit, hand_axes, opposed, posture_for
from mint_hub.synth.hand_anatomy import straight_axes
from mint_hub.synth.hand_pose import LIMITS_DEG, HandProxy, joint_rotations
from mint_hub.synth.person import Person, clamps, grasp_of
from mint_hub.synth.room import standing
from mint_hub.synth.solids import Block
from mint_hub.synth.things import KINDS_OOD, KINDS_TRAIN, make_thing
from mint_hub.synth.world import Texture

PROXY = HandProxy.of(np.array([0.4, 0.2, -0.3, 0.5, 0.1, 0.0, 0.2, 0.0, 0.1, 0.0]))
PERSON = Person(PROXY, np.array([0.0, -0.05, 0.5]), 0.28, 0.1, 1.0, "right")
TEXTURE = Texture("noise", (0.5, 0.4, 0.3), (0.3, 0.3, 0.2))
TAKEN = [k for k in (*KINDS_TRAIN, *KINDS_OOD) if k not in ("bowl", "plate", "parcel", "pan")]


def mesh_of(grasp: Grasp) -> np.ndarray:
    """All vertices of the hand, in the thing's frame."""
    T = grasp.T_thing_from_wrist
    joints = joint_rotations(grasp.angles_deg)
    state = HandState.from_matrices(T[:3, 3], T[:3, :3], joints, PROXY.shape_params)
    return np.asarray(HandModel.template().vertices(state.pack(), grasp.side))


def check(grasp: Grasp, solid) -> None:
    assert (grasp.angles_deg >= LIMITS_DEG[:, 0] - 1e-9).all()
    assert (grasp.angles_deg <= LIMITS_DEG[:, 1] + 1e-9).all()
    vertices = mesh_of(grasp)
    distance = solid.distance(vertices)
    assert distance.min() > -0.006  # flesh gives way
    assert vertices[:, 2].min() > -0.004
    dominant = HandModel.template().right.skin_weights.argmax(1)
    touched = {j // 3 for j in dominant[distance < 0.004] - 1 if j >= 0}
    assert len(touched) >= min(2, len(CONTACTS[grasp.style]))


@pytest.mark.parametrize("kind", TAKEN)
def test_most_things_can_be_taken(kind):
    good = 0
    for seed in range(4):
        rng = np.random.default_rng(seed)
        thing = make_thing(kind, rng, TEXTURE)
        side = SIDES[seed % 2]
        at = 0.12 if side == "right" else -0.12
        yaw = rng.normal(0, 0.3)
        grasp = grasp_of(PERSON, side, thing, standing(at, 0.3, 0.0, yaw))
        if grasp is not None:
            good += 1
            check(grasp, thing.solid)
    assert good >= 2, kind


def test_left_grasps_mirror_right_ones():
    block, made = Block((0.05, 0.05, 0.06)), []
    angles = posture_for(PROXY, "pinch", 0.05)
    for side in SIDES:
        sign = 1.0 if side == "right" else -1.0
        across, approach = np.array([0.3 * sign, 1.0, 0.0]), np.array([-0.4 * sign, 0.1, -1.0])
        T = aligned(
            opposed(PROXY, side, "pinch", angles), np.array([0, 0, 0.035]), across, approach
        )
        made.append(fit(PROXY, side, "pinch", block, T, angles))
    left, right = made
    assert np.allclose(left.angles_deg, right.angles_deg, atol=2.0)
    mirrored = right.T_thing_from_wrist[:3, 3] * [-1, 1, 1]
    assert np.allclose(left.T_thing_from_wrist[:3, 3], mirrored, atol=2e-3)


def test_both_hands_clamp_a_parcel():
    thing = make_thing("parcel", np.random.default_rng(2), TEXTURE)
    hold = clamps(PERSON, thing, standing(0.0, 0.3))
    assert hold is not None
    assert hold["left"].T_thing_from_wrist[0, 3] < 0 < hold["right"].T_thing_from_wrist[0, 3]
    for grasp in hold.values():
        check(grasp, thing.solid)


def test_a_hand_leaves_without_touching():
    """Opened and 6 cm back, no point is inside the thing."""
    thing = make_thing("can", np.random.default_rng(0), TEXTURE)
    grasp = grasp_of(PERSON, "right", thing, standing(0.12, 0.3))
    assert grasp is not None
    T = grasp.T_thing_from_wrist.copy()
    T[:3, 3] += 0.06 * grasp.retreat
    points = PROXY.placed(T[None], grasp.opened_deg[None], "right")[0]
    assert thing.solid.distance(points).min() > -0.004


@pytest.mark.parametrize("side", SIDES)
def test_hand_axes(side):
    turned = hand_axes(side, np.array([0.0, 2.0, 0.0]), np.array([0.0, 0.3, -1.0]))
    R = turned @ straight_axes(side)
    fingers = -R[:, 0] if side == "right" else R[:, 0]
    assert np.allclose(fingers, [0, 1, 0])
    assert np.allclose(-R[:, 1], [0, 0, -1])
    assert np.linalg.det(R) == pytest.approx(1)


def test_awkward_poses_cost_more():
    easy, turned_out = np.eye(4), np.eye(4)
    easy[:3, :3] = hand_axes("right", np.array([-0.4, 1.0, 0.0]), np.array([0.0, 0.0, -1.0]))
    turned_out[:3, :3] = hand_axes("right", np.array([1.0, -0.2, 0.0]), np.array([0.0, 0.0, 1.0]))
    easy[:3, 3] = turned_out[:3, 3] = 0.15, 0.3, 0.05
    assert PERSON.effort("right", easy) < 0.4 < 1.1 < PERSON.effort("right", turned_out)
