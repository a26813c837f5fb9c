"""Worlds: the same from the same seed, things carried rigidly, benches as they must be."""

from functools import cache
from itertools import combinations

import numpy as np
import pytest

from mint_hub.conventions import SIDES
from mint_hub.geometry import hand_state
from mint_hub.geometry.rigid import inverse, rigid
from mint_hub.geometry.rotations import geodesic_angle
from mint_hub.synth.actors import Item, depths
from mint_hub.synth.camera_motion import median_steps
from mint_hub.synth.collisions import collisions
from mint_hub.synth.hand_pose import HandProxy
from mint_hub.synth.motion import PoseTrack
from mint_hub.synth.person import Person
from mint_hub.synth.presets import PRESETS, seed_of
from mint_hub.synth.room import standing
from mint_hub.synth.scene import make_world
from mint_hub.synth.tabletop import Tabletop
from mint_hub.synth.things import make_thing
from mint_hub.synth.world import Texture, World

CASES = [("train", 0), ("train", 1), ("train", 4), ("bench", 3), ("bench-ood", 5)]


@cache
def world_of(preset: str, seed: int) -> World:
    return make_world(seed, preset, 150)


def wrists_world(world: World) -> np.ndarray:
    """T_world_from_wrist (T, 2, 4, 4)."""
    state = hand_state.unpack(world.hands.hand_state.astype(float))
    wrist = np.asarray(rigid(state.orientation(), state.translation))
    return inverse(world.T_camera_from_world)[:, None] @ wrist


@pytest.fixture(params=CASES, ids=lambda case: f"{case[0]}-{case[1]}")
def world(request) -> World:
    return world_of(*request.param)


def test_same_seed_same_world():
    one, two, other = (make_world(seed, "train", 40) for seed in (7, 7, 8))
    assert np.array_equal(one.hands.hand_state, two.hands.hand_state)
    assert np.array_equal(one.T_camera_from_world, two.T_camera_from_world)
    assert one.text == two.text
    assert one.meta == two.meta
    assert len(one.bodies) == len(two.bodies)
    for a, b in zip(one.bodies, two.bodies, strict=True):
        assert np.array_equal(a.T_world_from_body, b.T_world_from_body)
        assert a.mesh.texture == b.mesh.texture
        assert np.array_equal(a.mesh.vertices, b.mesh.vertices)
    assert not np.array_equal(one.hands.hand_state, other.hands.hand_state)


def test_camera_and_person_do_not_depend_on_what_happens():
    """So that a clip of any length, planned in any number of attempts, has one fingerprint."""
    short, long = make_world(2, "bench", 1), make_world(2, "bench", 60)
    assert short.fov_vh_rad == long.fov_vh_rad
    assert short.image_size_hw == long.image_size_hw
    one, two = (hand_state.unpack(w.hands.hand_state[0]).shape_params for w in (short, long))
    assert np.array_equal(one, two)


def test_what_moves_is_held(world):
    """A thing that moves keeps its pose in a hand, but for the short fall into a bowl."""
    wrists = wrists_world(world)[:, world.hands.exists[0]]
    moving = held = 0
    for body in world.bodies:
        T = body.T_world_from_body
        if T.ndim == 2:
            continue
        step = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)
        for k in np.flatnonzero(step > 0.002):
            in_hand = inverse(wrists[k : k + 2]) @ T[k : k + 2, None]
            slip = np.linalg.norm(in_hand[1, :, :3, 3] - in_hand[0, :, :3, 3], axis=-1)
            turned = geodesic_angle(in_hand[1, :, :3, :3], in_hand[0, :, :3, :3])
            moving += 1
            held += bool(((slip < 1e-4) & (turned < 1e-3)).any())
    if world.preset == "train":
        assert moving > 20
    assert held >= 0.93 * moving


def test_hands_move_smoothly(world):
    T = wrists_world(world)[:, world.hands.exists[0]]
    assert np.linalg.norm(np.diff(T[..., :3, 3], axis=0), axis=-1).max() < 0.09
    assert np.rad2deg(geodesic_angle(T[1:, ..., :3, :3], T[:-1, ..., :3, :3])).max() < 25
    state = hand_state.unpack(world.hands.hand_state.astype(float))
    joints = np.asarray(state.joint_rotations())
    assert np.rad2deg(geodesic_angle(joints[1:], joints[:-1])).max() < 30


def test_arms_come_from_the_viewer(world):
    """Behind a wrist that is seen, the arm goes on towards the camera's side of the table."""
    R = world.T_camera_from_world[:, :3, :3]
    ahead = R[:, 2] * [1, 1, 0]
    ahead /= np.linalg.norm(ahead, axis=-1, keepdims=True)
    z = world.hands.hand_state[..., 2]
    there = world.hands.exists & (z > 0.25)
    back = (world.hands.forearm_direction * ahead[:, None]).sum(-1)
    assert (back[there] < 0.5).mean() > 0.95
    assert np.allclose(np.linalg.norm(world.hands.forearm_direction, axis=-1), 1)


def test_hardly_anything_collides(world):
    assert world.meta["collision_share"] < 0.08


def test_texts_name_the_hand_that_acts(world):
    assert world.text
    for segment in world.text:
        assert segment.text.startswith((f"{segment.side} hand", "both hands")) or (
            segment.side == "both"
        )
        assert segment.end <= world.num_frames


def test_worlds_keep_their_presets_ranges(world):
    preset = PRESETS[world.preset]
    vertical, horizontal = np.rad2deg(world.fov_vh_rad)
    assert any(low <= horizontal <= high for low, high in preset.fov_h_deg)
    assert world.image_size_hw in preset.sizes_hw
    height, width = world.image_size_hw
    square = np.tan(np.deg2rad(vertical / 2)) / height / np.tan(np.deg2rad(horizontal / 2)) * width
    assert square == pytest.approx(1)
    shape = hand_state.unpack(world.hands.hand_state).shape_params[:, world.hands.exists[0]]
    assert np.ptp(shape, axis=(0, 1)).max() == 0
    assert any(low <= shape[0, 0, 0] <= high for low, high in preset.hand_size)


@pytest.mark.parametrize("preset", ["bench", "bench-ood"])
def test_benches_move_enough(preset):
    for number in (0, 19, 39):
        world = make_world(number, preset)
        metres, degrees = median_steps(world.T_camera_from_world)
        assert metres >= 0.005
        assert degrees >= 0.5
        assert world.num_frames >= 150


def test_sizes_do_not_tell_each_other():
    made = [make_world(seed_of("train", 0, n), "train", 1) for n in range(15)]
    made += [make_world(n, "bench", 1) for n in range(15)]
    names = ("table_height_m", "eye_above_table_m", "hand_size")
    sizes = {name: [w.meta[name] for w in made] for name in names}
    sizes["things"] = [
        float(np.mean([np.ptp(b.mesh.vertices, axis=0).max() for b in w.bodies if b.is_object()]))
        for w in made
    ]
    for a, b in combinations(sizes, 2):
        assert abs(np.corrcoef(sizes[a], sizes[b])[0, 1]) < 0.45, (a, b)


def test_heads_do_not_whirl():
    for number in range(4):
        world = make_world(seed_of("train", 3, number), "train", 150)
        R = world.T_camera_from_world[:, :3, :3]
        assert np.rad2deg(geodesic_angle(R[1:], R[:-1])).max() * world.fps < 220


def test_bad_arguments_are_named():
    with pytest.raises(ValueError, match="preset: expected one of"):
        make_world(0, "val")
    with pytest.raises(ValueError, match="seed: expected 0 to 39 for bench, got 40"):
        make_world(40, "bench")
    with pytest.raises(ValueError, match="seed: expected 0 or more for train, got -1"):
        make_world(-1, "train")
    with pytest.raises(ValueError, match="num_frames"):
        make_world(0, "train", 0)


# ------------------------------------------------------------------------ collisions


def still_table(at: tuple[float, float, float]) -> Tabletop:
    """Two resting hands, and a carton somewhere."""
    person = Person(HandProxy.of(np.zeros(10)), np.array([0, -0.05, 0.5]), 0.28, 0.1, 1.0, "right")
    texture = Texture("noise", (0.5, 0.4, 0.3), (0.3, 0.3, 0.2))
    thing = make_thing("carton", np.random.default_rng(0), texture)
    rng = np.random.default_rng(1)
    table = Tabletop.begin(person, rng, [], dict.fromkeys(SIDES, "rest"), 0.0)
    table.items.append(Item(thing, PoseTrack(standing(*at))))
    return table


def test_a_thing_in_a_hand_is_a_collision():
    times = np.linspace(0, 1, 4)
    free = still_table((0.0, 0.6, 0.0))
    assert collisions(free, times, (True, True), 0).share == 0
    wrist = free.arms["right"].T[:3, 3]
    through = still_table((float(wrist[0]), float(wrist[1]), 0.0))
    assert collisions(through, times, (True, True), 0).share == 1
    assert collisions(through, times, (True, False), 0).share == 0


def test_depths_count_balls_by_their_radius():
    table = still_table((0.0, 0.0, 0.0))
    (item,) = table.items
    above = np.array([[[0.0, 0.0, item.thing.height + 0.02]]])
    assert depths(item.thing, item.T[None], above)[0] == 0
    assert depths(item.thing, item.T[None], above, 0.03)[0] == pytest.approx(0.01)
