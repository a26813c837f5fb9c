"""The picture and its labels say what the geometry says."""

import sys
from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
import pytest

from mint_hub.conventions import KEYPOINT_NAMES, SIDES
from mint_hub.geometry.camera import fov_vh_to_K, project, unproject
from mint_hub.geometry.hand_model import HandModel
from mint_hub.geometry.rigid import inverse, transform_points
from mint_hub.synth import gl, meshes
from mint_hub.synth.draw_hand import POSES
from mint_hub.synth.raster import vertex_normals
from mint_hub.synth.render import Rendered, Renderer
from mint_hub.synth.world import Body, Light, Texture
from tests.small_world import (
    FOV_VH_RAD,
    SIZE_HW,
    empty_hands,
    moving_camera,
    small_world,
    standing,
    two_hands,
)

ALL = ("rgb", "depth", "segmentation", "flow")
K = fov_vh_to_K(np.array(FOV_VH_RAD), SIZE_HW)
PIXELS = np.stack(np.meshgrid(np.arange(SIZE_HW[1]), np.arange(SIZE_HW[0])), -1) + 0.5
TIPS = [i for i, name in enumerate(KEYPOINT_NAMES) if name.endswith("tip")]
LARGE_HW = (360, 480)
LARGE_K = fov_vh_to_K(np.array(FOV_VH_RAD), LARGE_HW)
WHITE = Texture("checker", (0.9, 0.9, 0.9), (0.9, 0.9, 0.9))


@pytest.fixture(scope="module")
def frames(renderer: Renderer) -> list[Rendered]:
    return list(renderer.frames(small_world(), ALL))


@pytest.mark.parametrize("pose", POSES)
def test_joints_inside_the_image_lie_on_the_hand_drawn_alone(renderer, pose):
    """Tips lie on the surface itself: at the outline the middle of their pixel may be outside."""
    camera = moving_camera(10)
    turns = np.random.default_rng(1).uniform(-0.7, 0.7, (10, 2, 3))
    world = small_world(10, hands=two_hands(camera, pose, turns))
    keypoints = HandModel.template().keypoints(world.hands.hand_state)
    exact, near = [], []
    for k in range(10):
        for hand, mask in enumerate(renderer.hand_masks(world, k)):
            uv, depth = project(keypoints[k, hand].astype(np.float64), K)
            inside = (depth > 0.01) & (uv >= 0).all(-1) & (uv < SIZE_HW[::-1]).all(-1)
            column, row = np.floor(uv[inside]).astype(int).T
            grown = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8))
            near += list(grown[row, column])
            exact += list(mask[row, column][~np.isin(np.flatnonzero(inside), TIPS)])
    assert len(exact) > 200
    assert np.mean(exact) == 1.0
    assert np.mean(near) >= 0.99


def test_depth_of_the_floor_is_that_of_a_plane(renderer):
    camera = moving_camera(1)
    floor = Body(meshes.plane((40.0, 40.0), WHITE), np.eye(4))
    world = small_world(1, bodies=(floor,), hands=empty_hands(1), T_camera_from_world=camera)
    (frame,) = renderer.frames(world, ("depth",))
    rays = unproject(PIXELS, np.ones(SIZE_HW), K) @ camera[0, :3, :3]
    eye = inverse(camera[0])[:3, 3]
    expected = -eye[2] / rays[..., 2]
    np.testing.assert_allclose(frame.depth, expected, rtol=2e-5)


def test_depth_of_a_box_is_where_rays_enter_it(renderer):
    camera, size = moving_camera(1), np.array([0.3, 0.2, 0.25])
    T = standing(0.05, 0.7, 0.75, 0.6)
    box = Body(meshes.box(tuple(size), WHITE), T)
    world = small_world(1, bodies=(box,), hands=empty_hands(1), T_camera_from_world=camera)
    (frame,) = renderer.frames(world, ("depth", "segmentation"))
    T_body_from_camera = inverse(camera[0] @ T)
    rays = unproject(PIXELS, np.ones(SIZE_HW), K) @ T_body_from_camera[:3, :3].T
    low, high = np.array([-0.5, -0.5, 0.0]) * size, np.array([0.5, 0.5, 1.0]) * size
    a, b = (low - T_body_from_camera[:3, 3]) / rays, (high - T_body_from_camera[:3, 3]) / rays
    enter, leave = np.minimum(a, b).max(-1), np.maximum(a, b).min(-1)
    clearly = np.abs(leave - enter) > 1e-3
    hit = (enter < leave) & clearly
    assert hit.sum() > 500
    np.testing.assert_array_equal((frame.segmentation > 0)[clearly], hit[clearly])
    np.testing.assert_allclose(frame.depth[hit], enter[hit], rtol=2e-5)
    assert (frame.depth[(enter >= leave) & clearly] == 0).all()


@pytest.fixture(scope="module")
def large() -> Iterator[Renderer]:
    """Draws three times as many pixels across: pixels of 1.7 mm on the hands."""
    with Renderer(LARGE_HW) as made:
        yield made


@pytest.mark.usefixtures("renderer")
def test_no_vertex_of_a_hand_lies_in_front_of_the_depth(large):
    camera = moving_camera(1)
    hands = two_hands(camera, sleeve=None)
    world = small_world(1, bodies=(), hands=hands, image_size_hw=LARGE_HW)
    (frame,) = large.frames(world, ("depth", "segmentation"))
    for hand, side in enumerate(SIDES):
        model = HandModel.template()
        vertices = np.asarray(model.vertices(hands.hand_state[0, hand], side), np.float64)
        facing = (vertex_normals(vertices, model.faces(side)) * vertices).sum(-1)
        vertices = vertices[facing < -0.6 * np.linalg.norm(vertices, axis=-1)]
        uv, depth = project(vertices, LARGE_K)
        column, row = np.floor(uv).astype(int).T
        inside = (column >= 0) & (row >= 0) & (column < LARGE_HW[1]) & (row < LARGE_HW[0])
        column, row = column[inside], row[inside]
        own = frame.segmentation[row, column] == hand + 1
        behind = depth[inside][own] - frame.depth[row, column][own]
        assert own.sum() > 200
        assert np.quantile(behind, 0.01) > -0.003  # surfaces slope within a pixel
        assert np.median(np.abs(behind)) < 0.0005
        assert (np.abs(behind) < 0.003).mean() > 0.8  # others are hidden by the hand itself


@pytest.mark.usefixtures("renderer")
def test_pose_and_depth_explain_how_the_background_moves(large):
    """Followed in the pictures by Lucas and Kanade's method, which knows nothing of geometry."""
    world = small_world(image_size_hw=LARGE_HW)
    first, _, last = large.frames(world, ("depth", "segmentation"))
    before, now = (cv2.cvtColor(f.rgb, cv2.COLOR_RGB2GRAY) for f in (first, last))
    still = ((last.segmentation == 4) * np.uint8(255)).astype(np.uint8)
    still = cv2.erode(still, np.ones((21, 21), np.uint8))
    corners = cv2.goodFeaturesToTrack(now, 300, 0.02, 5, mask=still)
    followed, found, _ = cv2.calcOpticalFlowPyrLK(now, before, corners, None, winSize=(15, 15))
    at = corners[found[:, 0] == 1, 0].astype(np.float64)
    column, row = at.round().astype(int).T
    depth = last.depth[row, column].astype(np.float64)
    T = world.T_camera_from_world
    points = transform_points(T[0] @ inverse(T[2]), unproject(at + 0.5, depth, LARGE_K))
    predicted = project(points, LARGE_K)[0] - 0.5
    error = np.linalg.norm(predicted - followed[found[:, 0] == 1, 0], axis=-1)
    assert len(at) > 100
    assert np.median(np.linalg.norm(predicted - at, axis=-1)) > 1.0
    assert np.median(error) < 0.3


def test_flow_is_what_pose_and_depth_say(frames):
    T = small_world().T_camera_from_world
    for k in (1, 2):
        still = frames[k].segmentation == 4
        uv = PIXELS[still]
        points = unproject(uv, frames[k].depth[still].astype(np.float64), K)
        earlier, _ = project(transform_points(T[k - 1] @ inverse(T[k]), points), K)
        np.testing.assert_allclose(frames[k].flow[still], uv - earlier, atol=2e-3)
    assert (frames[0].flow == 0).all()


def test_flow_of_a_hand_is_that_of_its_joints(frames):
    keypoints = HandModel.template().keypoints(small_world().hands.hand_state)
    uv, _ = project(keypoints.astype(np.float64), K)
    moved = np.median(uv[2] - uv[1], axis=1)
    for hand in range(2):
        flow = np.median(frames[2].flow[frames[2].segmentation == hand + 1], axis=0)
        np.testing.assert_allclose(flow, moved[hand], atol=0.3)


def test_an_image_spans_zero_to_its_width(renderer):
    """A small white square is centred where it projects, in the picture and in the segments."""
    rng = np.random.default_rng(3)
    light = Light((0.0, 0.0, -1.0), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), shadow=False)
    errors = []
    for _ in range(16):
        x, y = rng.uniform((-0.3, 0.5), (0.3, 0.9))
        square = Body(meshes.plane((0.06, 0.06), WHITE, None), standing(x, y, 0.75, 0.4))
        world = small_world(1, bodies=(square,), hands=empty_hands(1), lights=(light,))
        (frame,) = renderer.frames(world, ("segmentation",))
        vertices = square.mesh.vertices.astype(np.float64)
        middle = _centre_of_area(
            project(transform_points(moving_camera(1)[0] @ square.pose(0), vertices), K)[0]
        )
        brightness = frame.rgb[..., 0] - float(frame.rgb[0, 0, 0])
        for weight in (brightness, frame.segmentation > 0):
            seen = (PIXELS * np.asarray(weight, float)[..., None]).sum((0, 1)) / np.sum(weight)
            errors.append(seen - middle)
    picture, segments = np.array(errors[::2]), np.array(errors[1::2])
    assert np.abs(picture).max() < 0.1
    assert np.abs(segments).max() < 0.3
    assert np.abs(picture.mean(0)).max() < 0.03
    assert np.abs(segments.mean(0)).max() < 0.06


def _centre_of_area(outline):
    a, b = outline, np.roll(outline, -1, 0)
    cross = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return ((a + b) * cross[:, None]).sum(0) / (3 * cross.sum())


def test_samples_change_the_picture_and_never_the_labels(renderer, frames):
    with Renderer(SIZE_HW, samples=0) as single:
        other = list(single.frames(small_world(), ALL))
    for a, b in zip(frames, other, strict=True):
        np.testing.assert_array_equal(a.depth, b.depth)
        np.testing.assert_array_equal(a.segmentation, b.segmentation)
        np.testing.assert_array_equal(a.flow, b.flow)
        assert (a.rgb != b.rgb).any()


def test_edges_belong_to_one_surface(renderer):
    """Of two parallel sheets that face the camera every pixel has the depth of one."""
    eye = np.eye(4)
    sheets = []
    for z, width in ((1.0, 0.4), (2.0, 8.0)):
        T = np.diag([1.0, -1.0, -1.0, 1.0])  # the sheet's z towards the camera
        T[:3, 3] = 0.031, -0.02, z
        movable = z == 1.0
        sheets.append(Body(meshes.plane((width, width), WHITE), T, movable))
    world = small_world(
        1, bodies=tuple(sheets), hands=empty_hands(1), T_camera_from_world=eye[None]
    )
    (frame,) = renderer.frames(world, ("depth", "segmentation"))
    near = frame.segmentation == 3
    assert near.any()
    assert set(np.unique(frame.segmentation)) == {3, 4}
    np.testing.assert_allclose(frame.depth, np.where(near, 1.0, 2.0), rtol=1e-6)


def test_a_forearm_is_welded_to_its_hand(renderer):
    """However the wrist bends, hand, forearm and sleeve are one patch without holes in between."""
    rng = np.random.default_rng(5)
    camera = moving_camera(12)
    turns = rng.uniform(-1.0, 1.0, (12, 2, 3))
    for sleeve in (None, Texture("fabric", (0.1, 0.1, 0.1), (0.2, 0.2, 0.2), 4, 9)):
        world = small_world(12, bodies=(), hands=two_hands(camera, turns=turns, sleeve=sleeve))
        left = replace(world.hands, exists=np.tile([True, False], (12, 1)))
        for frame in renderer.frames(replace(world, hands=left), ("segmentation",)):
            patch = (frame.segmentation > 0).astype(np.uint8)
            count, _, stats, _ = cv2.connectedComponentsWithStats(patch, connectivity=8)
            large = (stats[1:, cv2.CC_STAT_AREA] > 3).sum()
            assert count > 1
            assert large == 1
            assert {1, 5} <= set(np.unique(frame.segmentation))


def test_visible_fraction_counts_what_the_segmentation_shows(renderer):
    world = small_world()
    lid = Body(meshes.box((0.1, 0.06, 0.02), WHITE), standing(0.13, 0.42, 0.96))
    covered = replace(world, bodies=(*world.bodies, lid))
    for k in range(3):
        alone = renderer.hand_masks(covered, k, dressed=True).sum((1, 2))
        frame = next(renderer.frames(covered, ("segmentation",), k, k + 1))
        seen = [(frame.segmentation == label).sum() for label in (1, 2)]
        np.testing.assert_allclose(renderer.visible_fraction(covered, k), seen / alone, rtol=1e-6)
        left, right = renderer.visible_fraction(covered, k)
        assert left == 1.0
        assert 0.05 < right < 0.8
    np.testing.assert_array_equal(renderer.visible_fraction(world, 0), [1.0, 1.0])


def test_a_hand_outside_the_image_or_the_world_has_no_visible_fraction(renderer):
    world = small_world(1)
    gone = replace(world.hands, exists=np.array([[True, False]]))
    assert renderer.visible_fraction(replace(world, hands=gone), 0)[1] == 0
    moved = world.hands.hand_state.copy()
    moved[..., 2] -= 5.0  # behind the camera
    behind = replace(world, hands=replace(world.hands, hand_state=moved))
    np.testing.assert_array_equal(renderer.visible_fraction(behind, 0), [0.0, 0.0])


def test_the_same_world_gives_the_same_frames_from_any_start(renderer, frames):
    again = list(renderer.frames(small_world(), ALL))
    middle = list(renderer.frames(small_world(), ALL, start=2))
    for a, b in [*zip(frames, again, strict=True), (frames[2], middle[0])]:
        assert a.index == b.index
        for name in ALL:
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_things_throw_shadows_and_exposure_brightens(renderer):
    light = Light((-0.5, 0.0, -1.0), (1.0, 1.0, 1.0), (0.2, 0.2, 0.2))
    world = small_world(1, hands=empty_hands(1), lights=(light,))
    (dark,) = renderer.frames(world, ("segmentation",))
    (lit,) = renderer.frames(replace(world, lights=(replace(light, shadow=False),)))
    table = dark.segmentation == 4
    change = dark.rgb.astype(int).sum(-1) - lit.rgb.astype(int).sum(-1)
    assert (change[table] < -60).mean() > 0.005
    assert (change[table] > 6).mean() < 0.005
    bright = replace(world, exposure=np.array([1.5], np.float32))
    (brighter,) = renderer.frames(bright)
    assert brighter.rgb.mean() > 1.1 * dark.rgb.mean()


def test_bad_arguments_are_named(renderer):
    world = small_world()
    with pytest.raises(ValueError, match=r"passes.*normals"):
        renderer.frames(world, ("normals",))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="within 0 to 3, got 2:9"):
        renderer.frames(world, start=2, stop=9)
    with pytest.raises(ValueError, match="image_size_hw"):
        next(renderer.frames(replace(world, image_size_hw=(64, 64))))
    with Renderer((32, 32)) as closed:
        pass
    with pytest.raises(ValueError, match="closed"):
        next(closed.frames(replace(world, image_size_hw=(32, 32))))


def test_what_is_missing_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "moderngl", None)
    with pytest.raises(ImportError, match=r'pip install "mint-hub\[synth\]"'):
        gl.make_context()

    class WithoutEgl:
        @staticmethod
        def create_standalone_context(**_: object) -> None:
            raise OSError("libEGL.so: cannot open shared object file")

    monkeypatch.setitem(sys.modules, "moderngl", WithoutEgl)
    with pytest.raises(RuntimeError, match="libegl1 libgl1-mesa-dri") as caught:
        gl.make_context()
    assert "\n" not in str(caught.value)
    assert isinstance(caught.value.__cause__, OSError)
