"""Make the sample clip and its truth: ``python -m mint_hub.synth.make_sample``.

Three seconds at a table, seen from the head: the right hand takes a mug and lifts it, the left one
rests and then points at a box. Everything is computed here, the same every time: no picture, scan
or recording is used. The truth is what is drawn: the meshes come from the hand states written.
Room frame: x right, y away from the person, z up, metres; the table top is z = 0.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Final

import av
import numpy as np

from mint_hub.assets import asset_path
from mint_hub.conventions import MODEL_FPS, SIDES, Side
from mint_hub.geometry.camera import fov_vh_to_K, project
from mint_hub.geometry.hand_model import HandModel
from mint_hub.geometry.hand_state import HandState, absent, unpack
from mint_hub.geometry.rigid import inverse, rigid, transform_points
from mint_hub.geometry.rotations import rotvec_to_matrix, slerp
from mint_hub.loaders.schema import Episode, TextSegment
from mint_hub.synth import sample_scene as scene
from mint_hub.synth.draw_hand import POSES, pose
from mint_hub.synth.hand_anatomy import straight_axes
from mint_hub.synth.sample_render import render
from mint_hub.synth.sample_scene import Mesh

SEED: Final = 7
NUM_FRAMES: Final = 90
SIZE_HW: Final = (288, 384)
FOV_VH_RAD: Final = 2 * np.arctan(np.tan(np.deg2rad(32.5)) * np.array([0.75, 1.0]))
SHAPE: Final = np.array([0.3, 0.2, 0.0, 0.4, -0.3, 0.2, 0.0, 0.0, 0.0, 0.2])

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Key:
    """Where a hand is at a time: wrist (x, y), and its lowest point above the table."""

    time: float
    wrist: tuple[float, float]
    height: float
    fingers: Vector
    palm: Vector
    pose: np.ndarray


REST: Final = pose(
    {"index": (10, 16, 8), "middle": (12, 20, 10), "ring": (13, 22, 10), "pinky": (14, 22, 10)},
    {"index": 2, "ring": -2, "pinky": -4},
    ((6, 0, 2), 6, 10),
)
OPEN: Final = pose(
    {"index": (-4, 8, 8), "middle": (0, 8, 8), "ring": (-2, 9, 6), "pinky": (-6, 8, 8)},
    {},
    ((36, 40, 6), 0, 0),
)
GRASP: Final = pose(  # touches the mug all round, by a search over angles
    {"index": (10, 29, 28), "middle": (20, 29, 28), "ring": (15, 29, 18), "pinky": (5, 20, 18)},
    {},
    ((55, 25, 6), 0, 5),
)
POINT: Final = POSES["point"]()
FORWARD, DOWN, ACROSS = (-0.18, 0.98, 0.0), (-0.55, -0.1, -0.83), (-0.98, -0.18, -0.1)
KEYS: Final[dict[Side, tuple[Key, ...]]] = {
    "right": (
        Key(-0.2, (0.27, -0.07), 0.030, FORWARD, DOWN, POSES["relaxed"]()),
        Key(0.85, (0.20, 0.06), 0.012, FORWARD, ACROSS, OPEN),
        Key(1.20, (0.20, 0.06), 0.012, FORWARD, ACROSS, GRASP),
        Key(2.15, (0.17, 0.03), 0.105, (-0.25, 0.95, 0.10), (-0.98, -0.20, 0.06), GRASP),
        Key(3.20, (0.15, 0.01), 0.120, (-0.30, 0.93, 0.16), (-0.97, -0.24, 0.10), GRASP),
    ),
    "left": (
        Key(-0.5, (-0.19, 0.035), 0.0, (0.28, 0.96, -0.06), (0.0, -0.10, -1.0), REST),
        Key(0.90, (-0.17, 0.045), 0.0, (0.30, 0.95, -0.06), (0.0, -0.10, -1.0), REST),
        Key(1.60, (-0.15, 0.05), 0.035, (0.10, 0.99, 0.0), (0.35, 0.0, -0.94), POINT),
        Key(2.30, (-0.145, 0.075), 0.030, (0.02, 0.99, -0.08), (0.35, 0.0, -0.94), POINT),
        Key(3.20, (-0.15, 0.06), 0.034, (0.10, 0.99, -0.02), (0.35, 0.0, -0.94), POINT),
    ),
}
GRASP_TIME: Final = 1.20
TEXT: Final = (
    TextSegment("sample-0", "right hand reaches for the mug", "right", 0, 36),
    TextSegment("sample-1", "right hand lifts the mug", "right", 36, 90),
    TextSegment("sample-2", "left hand points at the box", "left", 36, 90),
)

# ------------------------------------------------------------------ motion


def camera_from_room(time: float) -> np.ndarray:
    """T_camera_from_room (4, 4) of the head: a slow look to the mug, breathing and sway."""
    turn = 2 * np.pi * time
    glance = _ease((time - 0.2) / 1.6)
    eye = np.array([0.010 * np.sin(0.45 * turn), -0.265, 0.43 + 0.006 * np.sin(0.9 * turn + 1)])
    eye += glance * np.array([0.030, 0.035, -0.012])
    target = np.array([-0.015 + 0.05 * glance, 0.185, 0.0]) + 0.05 * glance * np.array([0, 0, 1.0])
    target += 0.006 * np.array([np.sin(0.8 * turn + 2), np.cos(0.6 * turn), np.sin(1.3 * turn)])
    ahead = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    level = np.stack([right, np.cross(ahead, right), ahead])
    roll = np.deg2rad(1.5 * np.sin(0.5 * turn + 0.6))
    rotation = rotvec_to_matrix(np.array([0.0, 0.0, roll])) @ level
    return rigid(rotation, -rotation @ eye)


def hand_in_room(side: Side, time: float, model: HandModel) -> HandState:
    """Pose one hand from its keys, eased from each to the next."""
    keys = KEYS[side]
    i = max(k for k, key in enumerate(keys[:-1]) if key.time <= time)
    a, b = keys[i], keys[i + 1]
    alpha = _ease((time - a.time) / (b.time - a.time))
    axes = [_hand_axes(side, key.fingers, key.palm) for key in (a, b)]
    mix = np.array([*a.wrist, a.height]) * (1 - alpha) + np.array([*b.wrist, b.height]) * alpha
    mix += 0.0015 * np.sin(2 * np.pi * np.array([0.9, 0.7, 0.0]) * time + len(side))
    joints = slerp(a.pose, b.pose, alpha)
    state = HandState.from_matrices(np.zeros(3), slerp(axes[0], axes[1], alpha), joints, SHAPE)
    lowest = np.asarray(model.vertices(state.pack(), side))[:, 2].min()
    place = np.array([mix[0], mix[1], mix[2] - lowest])
    return HandState(place, state.orientation_rot6d_rows, state.joint_rot6d_rows, SHAPE)


def _ease(share: float) -> float:
    s = float(np.clip(share, 0.0, 1.0))
    return s * s * s * (s * (6 * s - 15) + 10)


def _hand_axes(side: Side, fingers: Vector, palm: Vector) -> np.ndarray:
    """Rotation, room from hand, of a hand with these directions."""
    x = np.array(fingers) * (-1.0 if side == "right" else 1.0)
    x /= np.linalg.norm(x)
    y = -np.array(palm) + x * (x @ np.array(palm))
    y /= np.linalg.norm(y)
    return np.stack([x, y, np.cross(x, y)], -1) @ straight_axes(side).T


def _pose_of(state: HandState) -> np.ndarray:
    return rigid(np.asarray(state.orientation()), np.asarray(state.translation))


def truth(model: HandModel) -> Episode:
    """Everything that is drawn, as an episode; its world is the camera of the first frame."""
    times = np.arange(NUM_FRAMES) / MODEL_FPS
    cameras = np.stack([camera_from_room(float(t)) for t in times])
    states = np.asarray(absent((NUM_FRAMES, 2)))
    for k, time in enumerate(times):
        for h, side in enumerate(SIDES):
            room = hand_in_room(side, float(time), model)
            wrist = cameras[k] @ _pose_of(room)
            joints = np.asarray(room.joint_rotations())
            state = HandState.from_matrices(wrist[:3, 3], wrist[:3, :3], joints, SHAPE)
            states[k, h] = np.asarray(state.pack())
    uv, z = project(
        np.asarray(model.keypoints(states)), fov_vh_to_K(FOV_VH_RAD, SIZE_HW).astype(np.float32)
    )
    inside = (uv >= 0).all(-1) & (uv < np.array(SIZE_HW[::-1])).all(-1) & (z > 0.01)
    return Episode(
        key="sample",
        timestamps_s=times,
        T_camera_from_world=cameras @ inverse(cameras[0]),
        fov_vh_rad=np.tile(FOV_VH_RAD, (NUM_FRAMES, 1)),
        hand_state=states,
        presence=np.asarray(inside.any(-1)),
        image_size_hw=SIZE_HW,
        text=TEXT,
        meta={
            "source": "mint-hub sample",
            "shape_space": model.shape_space,
            "hand_model": model.name,
            "scale_status": "exact (synthetic)",
            "fps": MODEL_FPS,
            "provenance": {"made_by": "python -m mint_hub.synth.make_sample"},
        },
    )


# ----------------------------------------------------------------- drawing


def meshes(episode: Episode, frame: int, model: HandModel) -> list[Mesh]:
    """Everything but the planes, in the room, as the truth of a frame has it."""
    time = frame / MODEL_FPS
    T_room_from_camera = inverse(camera_from_room(time))
    out = [
        scene.placed(scene.box((0.13, 0.075, 0.085)), _standing(-0.12, 0.315, 0.35)),
        scene.placed(scene.ball(0.034), _standing(0.035, 0.30, 0.8)),
    ]
    carried = _pose_of(hand_in_room("right", max(time, GRASP_TIME), model))
    T_room_from_mug = carried @ inverse(_pose_of(hand_in_room("right", GRASP_TIME, model)))
    out += [scene.placed(m, T_room_from_mug @ _standing(0.1237, 0.160, 0.3)) for m in scene.mug()]
    for h, side in enumerate(SIDES):
        state = episode.hand_state[frame, h].astype(np.float64)
        flat = np.asarray(model.vertices(absent(), side)) @ straight_axes(side)
        skin_uv = np.stack([80 + 900 * np.abs(flat[:, 0]), 110 + 900 * flat[:, 2]], -1)
        vertices = transform_points(T_room_from_camera, np.asarray(model.vertices(state, side)))
        out.append(Mesh(scene.SKIN, vertices, model.faces(side), skin_uv))
        out.append(_sleeve(side, T_room_from_camera @ _pose_of(unpack(state))))
    return out


def _standing(x: float, y: float, yaw: float) -> np.ndarray:
    return rigid(rotvec_to_matrix(np.array([0.0, 0.0, yaw])), np.array([x, y, 0.0]))


def _sleeve(side: Side, T_room_from_wrist: np.ndarray) -> Mesh:
    """Make a sleeve from the wrist, along the hand, to an elbow below the image."""
    sign = 1.0 if side == "right" else -1.0
    axes = T_room_from_wrist[:3, :3] @ straight_axes(side)
    back = axes[:, 0] * sign
    start = T_room_from_wrist[:3, 3] + 0.020 * back
    elbow = np.array([sign * 0.30, -0.30, 0.055])
    s = np.array([0, 0, 0.04, 0.10, 0.11, *np.linspace(0.14, 1, 22)])[:, None]
    centers = (1 - s) ** 2 * start + 2 * s * (1 - s) * (start + 0.09 * back) + s * s * elbow
    along = 2 * (1 - s) * 0.09 * back + 2 * s * (elbow - start - 0.09 * back)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    u = np.cross(along, axes[:, 2] * sign)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(along, u)
    bulge = 0.0018 * np.sin(34 * s + 2 * sign) * np.clip(6 * s, 0, 1) + 0.004 * (s > 0.105)
    narrow, wide = 0.0235 + 0.016 * s + bulge, 0.032 + 0.009 * s + bulge
    narrow[0] = wide[0] = 0.015
    return scene.tube(scene.SLEEVE, centers, narrow * u, wide * v, 900.0)


def draw_frame(
    episode: Episode, frame: int, model: HandModel, textures: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Draw a frame of the truth: what ``render`` gives, with a little sensor noise."""
    image, labels = render(
        meshes(episode, frame, model),
        camera_from_room(frame / MODEL_FPS),
        episode.fov_vh_rad[frame].astype(np.float64),
        SIZE_HW,
        textures,
    )
    noise = np.random.default_rng((SEED, frame)).normal(0, 1.2, image.shape)
    return np.clip(image + noise, 0, 255).round().astype(np.uint8), labels


# ----------------------------------------------------------------- writing


def write_video(path: Path, frames: Sequence[np.ndarray]) -> None:
    """Write H.264, yuv420p, one thread: the same file every time with the same FFmpeg."""
    with av.open(str(path), "w") as container:
        rate = Fraction(MODEL_FPS).limit_denominator(1001)
        stream = container.add_stream("libx264", rate=rate)
        stream.height, stream.width = SIZE_HW
        stream.pix_fmt = "yuv420p"
        stream.options = {"crf": "20", "preset": "veryslow", "threads": "1"}
        for image in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode(None))


def main() -> None:
    """Write sample.mp4 and sample.npz beside this script, or into ``--out``."""
    parser = argparse.ArgumentParser(description="Make the sample clip and its truth.")
    parser.add_argument("--out", type=Path, default=asset_path("sample.mp4").parent)
    out: Path = parser.parse_args().out
    model = HandModel.template()
    episode, textures = truth(model), scene.textures(SEED)
    frames = [draw_frame(episode, k, model, textures)[0] for k in range(NUM_FRAMES)]
    write_video(out / "sample.mp4", frames)
    episode.save(out / "sample.npz")


if __name__ == "__main__":
    main()
