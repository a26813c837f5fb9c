"""Make the licence-free hand: ``python -m mint_hub.synth.make_hand``.

A right hand is modelled as rounded rods and muscle masses around the skeleton of an average adult,
meshed, skinned, and given ten directions in which adults' hands differ. Nothing is scanned, learned
or copied from another hand model; the measurements are published means:

- bone lengths and the flesh beyond the finger tips: Buryanov and Kotiuk 2010, "Proportions of hand
  segments", Int. J. Morphol. 28(3), table I (radiographs of 66 adults);
- hand length, breadths and girths of fingers and wrist, heights of the webs between fingers:
  Greiner 1991, "Hand anthropometry of U.S. Army personnel", Natick TR-92/011, the mean between
  the sexes taken as 0.945 of the men's;
- the spread of hand length and breadth: the same survey (about 6 % with both sexes together).

The hand is modelled straight, with the fingers along -x, the palm facing -y, the thumb towards +z
and the wrist at the origin, in millimetres. The file is in metres, and everything in it is turned
as MANO's resting hand lies in those axes (`hand_anatomy.REST_TURN`), so that rotations mean the
same.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from mint_hub.assets import asset_path
from mint_hub.geometry.hand_asset import HandAsset, save_hand_asset
from mint_hub.synth.hand_anatomy import (
    CARPAL_MM,
    FINGERS,
    REST_TURN,
    Finger,
    fingers,
    hand_distance,
)
from mint_hub.synth.hand_surface import (
    collapse_edges,
    is_closed,
    project,
    relax,
    round_cone,
    surface_net,
)

CELL_MM: Final = 2.3
NUM_VERTICES: Final = 2400


def surface(hand: dict[str, Finger]) -> tuple[np.ndarray, np.ndarray]:
    """Mesh the straight hand: vertices (V, 3) millimetres and outward faces (F, 3)."""
    distance = partial(hand_distance, hand=hand)
    low, high = np.array([-195.0, -55.0, -75.0]), np.array([45.0, 35.0, 105.0])
    vertices, faces = surface_net(distance, low + 0.37, high, CELL_MM)
    vertices = relax(distance, vertices, faces, 6)
    vertices, faces = collapse_edges(vertices, faces, NUM_VERTICES)
    assert is_closed(faces), "the grid left an edge in more than two faces: try another CELL_MM"
    tips: list[int] = []  # a vertex exactly at each tip, so that the last bone is exact
    for finger in hand.values():
        tips.append(int(np.linalg.norm(vertices - finger.joints[3], axis=1).argmin()))
        vertices[tips[-1]] = finger.joints[3]
    return project(distance, relax(distance, vertices, faces, 40, tips)), faces


def skin_weights(vertices: np.ndarray, faces: np.ndarray, hand: dict[str, Finger]) -> np.ndarray:
    """Share of each of the 16 joints in each vertex, (V, 16), at most four a vertex.

    A vertex belongs to the fingers by its distance to their rods, and along a finger hands over
    from one joint to the next around the joint; then everything is smoothed over the mesh.
    """
    nearness = np.stack([_rod_distance(vertices, hand, name) for name in FINGERS], -1)
    reach = np.array([4.5 if name == "thumb" else 2.5 for name in FINGERS])
    belonging = np.exp(-(nearness - nearness.min(1, keepdims=True)) / reach)
    belonging /= belonging.sum(1, keepdims=True)
    weights = np.zeros((len(vertices), 16))
    for f, name in enumerate(FINGERS):
        joints = hand[name].joints
        widths = (15.0, 8.0, 7.0) if name == "thumb" else (10.0, 6.5, 5.5)
        shift = 7.0 if name == "thumb" else 0.0
        shares = [np.ones(len(vertices))]
        for i, width in enumerate(widths):
            axis = joints[i + 1] - joints[i]
            along = (vertices - joints[i]) @ axis / np.linalg.norm(axis) - (shift if i == 0 else 0)
            ramp = np.clip(along / (2 * width) + 0.5, 0.0, 1.0)
            shares.append(np.minimum(shares[-1], ramp * ramp * (3 - 2 * ramp)))
        shares.append(np.zeros(len(vertices)))
        own = belonging[:, f]
        weights[:, 0] += own * (shares[0] - shares[1])
        for i in range(1, 4):
            weights[:, 3 * f + i] += own * (shares[i] - shares[i + 1])
    return _four_joints(_smoothed(weights, faces, rounds=4))


def _rod_distance(vertices: np.ndarray, hand: dict[str, Finger], name: str) -> np.ndarray:
    stops = np.concatenate([[CARPAL_MM[name]], hand[name].joints])
    rods = [round_cone(vertices, a, b, (0.0, 0.0)) for a, b in itertools.pairwise(stops)]
    return np.min(rods, axis=0) - hand[name].radii[0]


def _smoothed(values: np.ndarray, faces: np.ndarray, rounds: int) -> np.ndarray:
    ends = np.concatenate([faces[:, [i, j]] for i in range(3) for j in range(3) if i != j])
    degree = np.bincount(ends[:, 0], minlength=len(values))[:, None]
    for _ in range(rounds):
        total = np.zeros_like(values)
        np.add.at(total, ends[:, 0], values[ends[:, 1]])
        values = 0.5 * values + 0.5 * total / degree
    return values


def _four_joints(weights: np.ndarray) -> np.ndarray:
    fourth = -np.sort(-weights, axis=1)[:, 3:4]
    kept = np.where((weights >= fourth) & (weights > 1e-4), weights, 0.0)
    return kept / kept.sum(1, keepdims=True)


SHAPE_MEANING: Final = (
    "size of the whole hand",
    "breadth of the palm",
    "depth from back to palm",
    "length of the four fingers",
    "girth of the fingers",
    "length of the thumb",
    "girth of the thumb",
    "index finger against ring finger",
    "length of the little finger",
    "taper of the fingers",
)
"""What a unit of each shape number changes: one standard deviation among adults."""


@dataclass(frozen=True)
class Growth:
    """How the pieces of a hand grow for a unit of one shape number; all are relative changes.

    Attributes:
        palm: along the straight x, y and z, of the palm, the wrist and where the fingers start.
        length: of a finger's three bones.
        girth: of a finger around its three bones.
        depth: of the fingers, along y alone.

    """

    palm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    length: Mapping[str, Sequence[float]] = field(default_factory=dict[str, Sequence[float]])
    girth: Mapping[str, Sequence[float]] = field(default_factory=dict[str, Sequence[float]])
    depth: float = 0.0


def growths() -> tuple[Growth, ...]:
    """One ``Growth`` for each entry of ``SHAPE_MEANING``."""
    four = ("index", "middle", "ring", "pinky")
    every: dict[str, Sequence[float]] = dict.fromkeys(map(str, FINGERS), (0.06,) * 3)
    return (
        Growth(palm=(0.06, 0.06, 0.06), length=every, girth=every),
        Growth(palm=(0.0, 0.0, 0.05), girth=dict.fromkeys(four, (0.02,) * 3)),
        Growth(palm=(0.0, 0.07, 0.0), depth=0.05),
        Growth(length=dict.fromkeys(four, (0.045,) * 3)),
        Growth(girth=dict.fromkeys(four, (0.07,) * 3)),
        Growth(length={"thumb": (0.05,) * 3}),
        Growth(girth={"thumb": (0.08, 0.07, 0.07)}),
        Growth(length={"index": (0.03,) * 3, "ring": (-0.03,) * 3}),
        Growth(length={"pinky": (0.05, 0.05, 0.05)}),
        Growth(girth=dict.fromkeys(FINGERS, (0.035, -0.02, -0.08))),
    )


def shape_directions(
    vertices: np.ndarray, weights: np.ndarray, hand: dict[str, Finger]
) -> tuple[np.ndarray, np.ndarray]:
    """Displacements of vertices (V, 3, 10) and joints (16, 3, 10) for a unit of each shape number.

    Each joint moves with the bones before it and stretches its own piece of the hand; the skin
    weights blend the pieces, so that seams stay smooth and a shape is exactly linear.
    """
    joints = joint_positions(hand)
    moves, motions = [], []
    for growth in growths():
        joint_moves, maps = np.zeros((16, 3)), np.zeros((16, 3, 3))
        maps[0] = np.diag(growth.palm)
        for f, name in enumerate(FINGERS):
            ends = hand[name].joints
            joint_moves[3 * f + 1] = maps[0] @ ends[0]
            for i in range(3):
                bone = ends[i + 1] - ends[i]
                axis = np.outer(bone, bone) / (bone @ bone)
                length = growth.length.get(name, (0.0,) * 3)[i]
                girth = growth.girth.get(name, (0.0,) * 3)[i]
                back = np.outer(hand[name].dorsal, hand[name].dorsal)
                j = 3 * f + 1 + i
                maps[j] = length * axis + girth * (np.eye(3) - axis) + growth.depth * back
                if i < 2:
                    joint_moves[j + 1] = joint_moves[j] + length * bone
        offsets = vertices[:, None] - joints[None]
        each = joint_moves[None] + np.einsum("jab,vjb->vja", maps, offsets)
        moves.append(joint_moves)
        motions.append(np.einsum("vj,vja->va", weights, each))
    return np.stack(motions, -1), np.stack(moves, -1)


def joint_positions(hand: dict[str, Finger]) -> np.ndarray:
    """Return the 16 joints (16, 3), MANO's order, millimetres."""
    return np.concatenate([np.zeros((1, 3)), *(hand[name].joints[:3] for name in FINGERS)])


def joint_regressor(
    vertices: np.ndarray, directions: np.ndarray, joints: np.ndarray, joint_directions: np.ndarray
) -> np.ndarray:
    """(16, V) such that it gives the joints of every shape: the smallest weights that do.

    Each joint uses the 64 vertices nearest to it; weights sum to one.
    """
    regressor = np.zeros((len(joints), len(vertices)))
    for j, joint in enumerate(joints):
        near = np.argsort(np.linalg.norm(vertices - joint, axis=1), kind="stable")[:64]
        known = np.concatenate(
            [
                np.ones((1, 64)),
                (vertices[near] - joint).T,
                (directions[near] - joint_directions[j]).reshape(64, -1).T,
            ]
        )
        wanted = np.zeros(len(known))
        wanted[0] = 1.0
        start = np.full(64, 1 / 64)
        step = np.linalg.lstsq(known, wanted - known @ start, rcond=1e-9)[0]
        regressor[j, near] = start + step
    return regressor


def make_hand(mesh: tuple[np.ndarray, np.ndarray] | None = None) -> HandAsset:
    """Make the whole right hand, metres; the same every time.

    Args:
        mesh: straight vertices (V, 3) millimetres and faces (F, 3) to dress; modelled and meshed
            without it.

    """
    hand = fingers()
    vertices, faces = surface(hand) if mesh is None else mesh
    weights = skin_weights(vertices, faces, hand)
    directions, joint_directions = shape_directions(vertices, weights, hand)
    template = (vertices @ REST_TURN.T / 1000).astype(np.float32).astype(np.float64)
    directions = _turned(directions / 1000).astype(np.float16).astype(np.float64)
    joints = joint_positions(hand) @ REST_TURN.T
    regressor = joint_regressor(
        template, directions, joints / 1000, _turned(joint_directions / 1000)
    )
    order = ("thumb", "index", "middle", "ring", "pinky")
    tips = [np.linalg.norm(vertices - hand[name].joints[3], axis=1).argmin() for name in order]
    return HandAsset(template, directions, None, regressor, weights, faces, np.array(tips))


def _turned(directions: np.ndarray) -> np.ndarray:
    """Turn displacements (N, 3, 10) as the hand rests."""
    return np.einsum("ab,nbk->nak", REST_TURN, directions)


def main() -> None:
    """Write the hand beside this script, or to ``--out``."""
    parser = argparse.ArgumentParser(description="Make the licence-free hand template.")
    default = asset_path("hand_template.safetensors")
    parser.add_argument("--out", type=Path, default=default)
    metadata = {
        "name": "mint-hand-template-1",
        "license": "Apache-2.0",
        "shape_space": "mint",
        "made_by": "python -m mint_hub.synth.make_hand",
        "units": "metres; MANO's rest: fingers about -x, palm about -y, thumb about +z; right hand",
        "shape_meaning": "; ".join(SHAPE_MEANING),
    }
    parser.parse_args().out.write_bytes(save_hand_asset(make_hand(), metadata))


if __name__ == "__main__":
    main()
