"""A small world by hand: a room's floor and wall, a table, some things, two hands."""

import numpy as np
import pytest
from numpy.typing import NDArray

from mint_hub.geometry import hand_state as hands
from mint_hub.geometry.hand_state import HandState
from mint_hub.geometry.rigid import rigid
from mint_hub.geometry.rotations import rotvec_to_matrix
from mint_hub.synth import meshes
from mint_hub.synth.draw_hand import POSES
from mint_hub.synth.render import Renderer
from mint_hub.synth.world import Body, Hands, Light, Texture, World

SIZE_HW = (120, 160)
FOV_VH_RAD = (float(2 * np.arctan(0.75 * np.tan(0.6))), 1.2)
WOOD = Texture("wood", (0.36, 0.21, 0.11), (0.17, 0.08, 0.035), 6, 2)
CLOTH = Texture("fabric", (0.08, 0.12, 0.3), (0.3, 0.3, 0.4), 6, 5)
SUN = Light((-0.7, -0.3, -1.0), (1.0, 0.95, 0.85), (0.36, 0.38, 0.42))

Floats = NDArray[np.float64]


def renderer_or_skip(image_size_hw: tuple[int, int]) -> Renderer:
    """Open a renderer, or skip the test with the reason why there is none."""
    try:
        return Renderer(image_size_hw)
    except (ImportError, RuntimeError) as error:
        pytest.skip(str(error))


def looking(eye: Floats, target: Floats) -> Floats:
    """T_camera_from_world (4, 4) of an upright camera at ``eye``."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    return rigid(R, -R @ eye)


def standing(x: float, y: float, z: float, turn: float = 0.0) -> Floats:
    """T_world_from_body (4, 4), turned about z."""
    return rigid(rotvec_to_matrix(np.array([0.0, 0.0, turn])), np.array([x, y, z]))


def empty_hands(num_frames: int) -> Hands:
    """Nobody."""
    return Hands(
        hands.absent((num_frames, 2)),
        np.zeros((num_frames, 2), bool),
        np.full((2, 3), 0.4),
        np.tile([0.0, -1.0, 0.0], (num_frames, 2, 1)),
    )


def two_hands(
    T_camera_from_world: Floats,
    pose: str = "relaxed",
    turns: Floats | None = None,
    sleeve: Texture | None = CLOTH,
) -> Hands:
    """Both hands over the table, palms down; ``turns`` (T, 2, 3) turns each about its wrist."""
    count = len(T_camera_from_world)
    state = np.zeros((count, 2, hands.HAND_STATE_SIZE), np.float32)
    for k in range(count):
        for h, side in enumerate((-1.0, 1.0)):
            x = -side * np.array([0.0, 1.0, 0.0])  # the hand's x axis; a left hand is mirrored
            up = np.array([0.0, 0.0, 1.0])
            R = np.stack([x, up, np.cross(x, up)], -1)
            if turns is not None:
                R = R @ rotvec_to_matrix(turns[k, h])
            wrist = np.array([0.16 * side, 0.47 + 0.003 * k, 0.85])
            T = T_camera_from_world[k] @ rigid(R, wrist)
            made = HandState.from_matrices(T[:3, 3], T[:3, :3], POSES[pose](), np.zeros(10))
            state[k, h] = made.pack()
    forearm = np.tile([[[-0.3, -1.0, 0.1], [0.3, -1.0, 0.1]]], (count, 1, 1))
    skin = np.array([(0.52, 0.30, 0.21), (0.52, 0.30, 0.21)])
    return Hands(state, np.ones((count, 2), bool), skin, forearm, sleeve)


def moving_camera(count: int) -> Floats:
    """(T, 4, 4): a head over the table that drifts and turns."""
    k = np.arange(count)[:, None]
    eyes = np.array([0.0, 0.08, 1.3]) + k * [0.006, 0.003, 0.002]
    targets = np.array([0.0, 0.62, 0.75]) + k * [0.004, 0.002, 0.0]
    return np.stack([looking(e, t) for e, t in zip(eyes, targets, strict=True)])


def small_world(count: int = 3, **changes: object) -> World:
    """Make the world; ``changes`` replace its fields."""
    wall = rigid(np.array([[-1.0, 0, 0], [0, 0, -1], [0, -1, 0]]), np.array([0, 1.6, 1.3]))
    things = [
        (meshes.cup(0.04, 0.095, Texture("stripes", (0.7, 0.7, 0.6), (0.5, 0.1, 0.1), 5)), 0.0),
        (meshes.bowl(0.08, 0.06, Texture("speckle", (0.7, 0.7, 0.6), (0.2, 0.3, 0.5), 8)), -0.25),
        (meshes.book((0.15, 0.2, 0.03), Texture("label", (0.5, 0.1, 0.1), (0.8, 0.8, 0.7))), 0.3),
    ]
    tiles = Texture("tiles", (0.32, 0.25, 0.2), (0.12, 0.1, 0.09), 3, 4)
    plaster = Texture("noise", (0.6, 0.55, 0.5), (0.3, 0.3, 0.35), 12, 3)
    bodies = [
        Body(meshes.plane((6.0, 6.0), tiles), np.eye(4)),
        Body(meshes.plane((6.0, 2.6), plaster), wall),
        Body(meshes.table((1.4, 0.9, 0.75), WOOD), standing(0.0, 0.7, 0.0)),
    ]
    for i, (mesh, x) in enumerate(things):
        poses = np.stack([standing(x, 0.85 + 0.1 * i, 0.75 + 0.002 * k) for k in range(count)])
        bodies.append(Body(mesh, poses))
    camera = moving_camera(count)
    fields: dict[str, object] = {
        "key": "small",
        "bodies": tuple(bodies),
        "lights": (SUN,),
        "hands": two_hands(camera),
        "T_camera_from_world": camera,
        "fov_vh_rad": FOV_VH_RAD,
        "image_size_hw": SIZE_HW,
    }
    return World(**(fields | changes))  # type: ignore[arg-type]
