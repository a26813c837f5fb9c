"""The hand model: laws of skinning, and what the licence-free hand must be."""

import copy
import pickle
import warnings
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from mint_hub.conventions import JOINT_PARENTS, KEYPOINT_FROM_JOINT, SIDES
from mint_hub.geometry.hand_asset import (
    HandAsset,
    closed_mesh,
    load_hand_asset,
    mirrored_asset,
    save_hand_asset,
)
from mint_hub.geometry.hand_model import HandModel, chain
from mint_hub.geometry.hand_state import HandState, absent, unpack
from mint_hub.geometry.rotations import rotvec_to_matrix
from mint_hub.synth import hand_anatomy
from mint_hub.synth.hand_surface import is_closed
from mint_hub.synth.make_hand import NUM_VERTICES, make_hand

MODEL = HandModel.template()
MIRROR = np.array([-1.0, 1.0, 1.0])


def random_states(seed: int, *shape: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return HandState.from_matrices(
        rng.normal(size=(*shape, 3)),
        rotvec_to_matrix(rng.normal(size=(*shape, 3))),
        rotvec_to_matrix(rng.normal(0, 0.5, (*shape, 15, 3))),
        rng.normal(size=(*shape, 10)),
    ).pack()


def moved(states: np.ndarray, R: np.ndarray, t: np.ndarray) -> np.ndarray:
    state = unpack(states)
    return HandState.from_matrices(
        state.translation @ R.T + t,
        R @ state.orientation(),
        state.joint_rotations(),
        state.shape_params,
    ).pack()


# ---- skinning ---------------------------------------------------------------------------------


@settings(deadline=None, max_examples=15)
@given(seed=st.integers(0, 2**31))
def test_moving_the_wrist_moves_everything_rigidly(seed):
    rng = np.random.default_rng(seed)
    R, t = rotvec_to_matrix(rng.normal(size=3)), rng.normal(size=3)
    states = random_states(seed, 3, 2)
    assert_allclose(
        MODEL.keypoints(moved(states, R, t)), MODEL.keypoints(states) @ R.T + t, atol=1e-12
    )
    for side in SIDES:
        after = MODEL.vertices(moved(states[:, 0], R, t), side)
        assert_allclose(after, MODEL.vertices(states[:, 0], side) @ R.T + t, atol=1e-12)


def test_translation_is_the_wrist_joint_whatever_pose_and_shape():
    states = random_states(0, 8, 2)
    assert_allclose(MODEL.keypoints(states)[..., 0, :], states[..., :3], atol=1e-12)


@pytest.mark.parametrize("pose_directions", [False, True])
def test_left_is_the_mirror_image_of_right(pose_directions):
    """With the wrist mirrored by hand, the same joint numbers give mirrored joints and mesh."""
    model = MODEL
    if pose_directions:
        rng = np.random.default_rng(5)
        right = HandAsset(
            **{
                name: getattr(MODEL.right, name)
                for name in ("template", "shape_directions", "joint_regressor", "skin_weights")
            },
            pose_directions=rng.normal(0, 0.003, (len(MODEL.right.template), 3, 135)),
            faces=MODEL.right.faces,
            tip_vertices=MODEL.right.tip_vertices,
        )
        model = HandModel("test", "mint", mirrored_asset(right), right)
    right_states = random_states(1, 4)
    state = unpack(right_states)
    M = np.diag(MIRROR)
    left_states = HandState.from_matrices(
        state.translation * MIRROR,
        M @ state.orientation() @ M,
        state.joint_rotations(),
        state.shape_params,
    ).pack()
    both = np.stack([left_states, right_states], axis=1)
    keypoints = model.keypoints(both)
    assert_allclose(keypoints[:, 0], keypoints[:, 1] * MIRROR, atol=1e-12)
    assert_allclose(
        model.vertices(left_states, "left"),
        model.vertices(right_states, "right") * MIRROR,
        atol=1e-12,
    )
    assert_array_equal(model.faces("left"), model.faces("right")[:, [0, 2, 1]])


def test_keypoints_are_joints_and_tip_vertices_in_openpose_order():
    states = random_states(2, 3, 2)
    keypoints = MODEL.keypoints(states)
    assert keypoints.shape == (3, 2, 21, 3)
    for i, side in enumerate(SIDES):
        joints = MODEL.joints(states[:, i], side)
        tips = MODEL.vertices(states[:, i], side)[:, MODEL.right.tip_vertices]
        expected = np.concatenate([joints, tips], axis=1)[:, list(KEYPOINT_FROM_JOINT)]
        assert_allclose(keypoints[:, i], expected, atol=1e-12)


def test_bending_one_joint_moves_only_what_hangs_from_it():
    rotvecs = np.zeros((15, 3))
    rotvecs[1] = [0, 0, 1.0]  # the middle joint of the index finger
    bent = HandState.from_matrices(
        np.zeros(3), np.eye(3), rotvec_to_matrix(rotvecs), np.zeros(10)
    ).pack()
    flat = MODEL.joints(absent((), like=bent), "right")
    moved_by = np.linalg.norm(MODEL.joints(bent, "right") - flat, axis=-1)
    assert_array_equal(moved_by > 1e-9, np.arange(16) == 3)
    tip = MODEL.keypoints(np.stack([bent, bent]))[1, 8] - flat[2]
    assert tip[1] < -0.02, "flexion about +z bends a right finger to the palm, -y"


def test_chain_composes_rotations_down_the_tree():
    rng = np.random.default_rng(4)
    root, own = rotvec_to_matrix(rng.normal(size=3)), rotvec_to_matrix(rng.normal(size=(15, 3)))
    rest = rng.normal(size=(16, 3))
    rotations, positions = chain(root, own, rest)
    expected_rotations, expected_positions = [root], [np.zeros(3)]
    for j in range(1, 16):
        parent = JOINT_PARENTS[j]
        expected_rotations.append(expected_rotations[parent] @ own[j - 1])
        bone = expected_rotations[parent] @ (rest[j] - rest[parent])
        expected_positions.append(expected_positions[parent] + bone)
    assert_allclose(rotations, expected_rotations, atol=1e-12)
    assert_allclose(positions, expected_positions, atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_torch_equals_numpy_and_keeps_the_dtype(dtype):
    states = random_states(6, 2, 3, 2)
    tensors = torch.from_numpy(states).to(dtype)
    tolerance = 1e-5 if dtype == torch.float32 else 1e-12
    keypoints = MODEL.keypoints(tensors)
    assert keypoints.dtype == dtype
    assert_allclose(keypoints.numpy(), MODEL.keypoints(states), atol=tolerance)
    vertices = MODEL.vertices(tensors[:, :, 0], "left")
    assert_allclose(vertices.numpy(), MODEL.vertices(states[:, :, 0], "left"), atol=tolerance)
    assert MODEL.keypoints(states.astype(np.float32)).dtype == np.float32


def test_gradients_are_right():
    states = torch.from_numpy(random_states(7, 1, 2)).requires_grad_()
    assert torch.autograd.gradcheck(partial(MODEL.keypoints, check=False), (states,))
    projection = torch.randn(len(MODEL.right.template), 3, dtype=torch.float64)

    def along(x: torch.Tensor) -> torch.Tensor:
        return (MODEL.vertices(x, "left", check=False) * projection).sum()

    assert torch.autograd.gradcheck(along, (states[0, 0].detach().requires_grad_(),))


def test_constants_first_made_in_inference_mode_can_train_later():
    model = HandModel("fresh", "mint", copy.deepcopy(MODEL.left), copy.deepcopy(MODEL.right))
    states = torch.from_numpy(random_states(8, 2))
    with torch.inference_mode():
        model.keypoints(states)
    states.requires_grad_()
    model.keypoints(states).sum().backward()
    assert states.grad is not None
    assert states.grad.abs().sum() > 0


def test_models_pickle_without_their_caches():
    states = random_states(9, 2)
    MODEL.keypoints(states)
    again = pickle.loads(pickle.dumps(MODEL))
    assert not again.right._on
    assert_array_equal(again.keypoints(states), MODEL.keypoints(states))


def test_foreign_shapes_use_the_mean_shape_and_say_so_once():
    model = HandModel("fresh", "mint", MODEL.left, MODEL.right)
    states = random_states(10, 5, 2)
    mean = states.copy()
    mean[..., 99:] = 0
    with pytest.warns(UserWarning, match=r"'mano'.*mean shape"):
        keypoints = model.keypoints(states, shape_space="mano")
    assert_allclose(keypoints, model.keypoints(mean), atol=1e-12)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.keypoints(states, shape_space="mano")
        own = model.keypoints(states, shape_space="mint")
    assert np.abs(own - keypoints).max() > 1e-4


def test_errors_name_what_is_wrong():
    with pytest.raises(ValueError, match=r"2, 109.*\(4, 109\)"):
        MODEL.keypoints(np.zeros((4, 109)))
    with pytest.raises(ValueError, match=r"left.*up"):
        MODEL.vertices(absent(), "up")
    with pytest.raises(ValueError, match="rot6d"):
        MODEL.vertices(np.zeros(109), "left")
    with pytest.raises(ValueError, match="one open loop"):
        closed_mesh(np.array([[0, 1, 2], [3, 4, 5]]))


# ---- the template -----------------------------------------------------------------------------


def edges_of(faces: np.ndarray) -> list[tuple[int, int]]:
    return [(int(a), int(b)) for f in faces for a, b in zip(f, np.roll(f, -1), strict=True)]


@pytest.mark.parametrize("side", SIDES)
def test_the_surface_is_closed_a_sphere_and_outward(side):
    vertices, faces = MODEL.vertices(absent(), side).astype(np.float64), MODEL.faces(side)
    edges = edges_of(faces)
    assert len(set(edges)) == len(edges), "an edge runs the same way in two faces"
    assert {(b, a) for a, b in edges} == set(edges), "an edge lies in one face only"
    assert len(np.unique(faces)) == len(vertices)
    assert len(vertices) - len(edges) // 2 + len(faces) == 2, "Euler characteristic of a sphere"
    assert 0.25 < volume_litres(vertices, faces) < 0.45, "negative when the faces point inward"


def test_axes_are_manos():
    """Right hand: fingers about -x, thumb towards +z; the left hand mirrored across x."""
    keypoints = MODEL.keypoints(absent((2,)))
    for hand, sign in zip(keypoints, (1, -1), strict=True):
        directions = hand[[8, 12, 16, 20]] - hand[[5, 9, 13, 17]]
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        straight = directions @ hand_anatomy.straight_axes("left" if sign == 1 else "right")
        assert (sign * straight[:, 0] > 0.94).all()
        assert (sign * directions[:3, 0] > 0.94).all(), "MANO's little finger: 33 degrees"
        assert hand[4, 2] > 0.05
        assert hand[4, 1] < -0.01, "the thumb lies towards the palm, -y"
        assert (np.diff(hand[[5, 9, 13, 17], 2]) < -0.01).all()


def bone_lengths_mm(keypoints: np.ndarray) -> dict[str, np.ndarray]:
    order = ("thumb", "index", "middle", "ring", "pinky")
    return {
        name: np.linalg.norm(np.diff(keypoints[1 + 4 * i : 5 + 4 * i], axis=0), axis=1) * 1e3
        for i, name in enumerate(order)
    }


def test_bones_are_those_of_an_average_adult():
    """Means of Buryanov and Kotiuk 2010, table I; each within half its standard deviation."""
    lengths = bone_lengths_mm(MODEL.keypoints(absent((2,)))[1])
    for name, bones in hand_anatomy.BONES_MM.items():
        off = np.abs(lengths[name] - bones) / hand_anatomy.BONE_SD_MM[name]
        assert (off < 0.5).all(), (name, lengths[name], bones)


@pytest.mark.parametrize(("size", "low", "high"), [(-2, 155, 172), (0, 178, 190), (2, 200, 215)])
def test_hand_length_and_breadth_are_adult(size, low, high):
    """Wrist to the middle finger's tip, about 180 mm women, 194 men, sd 10 (Greiner 1991)."""
    states = absent((2,))
    states[:, 99] = size
    hand = MODEL.keypoints(states)[1]
    assert low < np.linalg.norm(hand[12] - hand[0]) * 1e3 < high
    turn = hand_anatomy.REST_TURN
    hand, vertices = hand @ turn, MODEL.vertices(states[1], "right") @ turn
    thumb = MODEL.right.skin_weights[:, 13:].sum(axis=1) > 0.5
    at_knuckles = (np.abs(vertices[:, 0] - hand[9, 0]) < 0.008) & ~thumb
    breadth = np.ptp(vertices[at_knuckles][:, 2]) * 1e3
    assert 66 < breadth < 100


def test_every_shape_number_matters_and_stays_human():
    mean = MODEL.vertices(absent(like=np.zeros(1)), "right")
    for k in range(10):
        state = absent(like=np.zeros(1))
        state[99 + k] = 1.0
        largest = np.linalg.norm(MODEL.vertices(state, "right") - mean, axis=1).max()
        assert 0.0005 < largest < 0.015, k
    directions = MODEL.right.shape_directions.reshape(-1, 10)
    directions = directions / np.linalg.norm(directions, axis=0)
    assert np.linalg.svd(directions, compute_uv=False)[-1] > 0.1, "two numbers say the same"


def test_skin_weights_are_shares():
    weights = MODEL.right.skin_weights
    assert_allclose(weights.sum(axis=1), 1.0, atol=1e-12)
    assert (weights >= 0).all()
    assert ((weights > 0).sum(axis=1) <= 4).all()
    assert (weights.max(axis=0) > 0.9).all(), "a joint that owns no part of the hand"


def test_skin_weights_are_smooth_along_the_surface():
    edges = np.array(edges_of(MODEL.right.faces))
    jump = np.abs(np.diff(MODEL.right.skin_weights[edges], axis=1)).max()
    assert jump < 0.5


def test_regressor_gives_the_joints_the_hand_was_built_on_for_every_shape():
    hand = hand_anatomy.fingers()
    built = np.concatenate([np.zeros((1, 3)), *(hand[n].joints[:3] for n in hand_anatomy.FINGERS)])
    built = built @ hand_anatomy.REST_TURN.T
    assert_allclose(MODEL.rest_joints(np.zeros(10), "right"), built / 1e3, atol=2e-6)
    state = np.zeros(10)
    state[0] = 1.0  # size: every length grows by 6 %
    assert_allclose(MODEL.rest_joints(state, "right"), 1.06 * built / 1e3, atol=2e-5)
    assert_allclose(MODEL.right.joint_regressor.sum(axis=1), 1.0, atol=1e-9)


def test_the_shipped_file_is_what_the_generator_makes_of_its_mesh():
    """All but the meshing, which takes seconds: skin, shapes, joints, tips."""
    shipped = MODEL.right
    straight = shipped.template @ hand_anatomy.REST_TURN * 1e3
    made = make_hand((straight, shipped.faces))
    assert len(shipped.template) == NUM_VERTICES
    assert_allclose(made.skin_weights, shipped.skin_weights, atol=1e-4)
    assert_allclose(made.shape_directions, shipped.shape_directions, atol=2e-5)
    assert_array_equal(made.tip_vertices, shipped.tip_vertices)
    distance = hand_anatomy.hand_distance(straight, hand_anatomy.fingers())
    assert np.abs(distance).max() < 0.1, "a vertex off the modelled surface, millimetres"


def volume_litres(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return float((a * np.cross(b, c)).sum() / 6 * 1e3)


@pytest.mark.slow
def test_meshing_again_gives_the_shipped_surface():
    """Not number by number: another processor may merge two equal edges in another order."""
    made, shipped = make_hand(), MODEL.right
    assert made.template.shape == shipped.template.shape
    assert is_closed(made.faces)
    assert volume_litres(made.template, made.faces) == pytest.approx(
        volume_litres(shipped.template, shipped.faces), rel=2e-3
    )
    assert_allclose(
        made.template[made.tip_vertices], shipped.template[shipped.tip_vertices], atol=1e-6
    )


def test_saving_and_loading_gives_the_same_hand():
    data = save_hand_asset(MODEL.right, {"name": "test"})
    assert len(data) < 400_000
    again = load_hand_asset(data)
    assert_allclose(again.template, MODEL.right.template, atol=1e-9)
    assert_allclose(again.joint_regressor, MODEL.right.joint_regressor, atol=1e-12)
    assert_array_equal(again.faces, MODEL.right.faces)
