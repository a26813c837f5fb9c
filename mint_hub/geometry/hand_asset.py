"""What one hand is made of: mesh, shape and pose directions, joints, skin weights.

The template hand is stored as safetensors, small because only what is not zero is kept: four joints
a vertex, and a few dozen vertices a joint.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from safetensors.numpy import load, save

from mint_hub.conventions import LEFT_MIRROR
from mint_hub.geometry.arrays import Array


@dataclass(frozen=True, eq=False)
class HandAsset:
    """Arrays of one hand, right or left, metres, in its rest pose (flat).

    Attributes:
        template: (V, 3) mean shape.
        shape_directions: (V, 3, 10) displacement for a unit of each shape number.
        pose_directions: (V, 3, 135) displacement for each element of the 15 joint rotations minus
            the identity, row by row; None when the hand has no pose correction.
        joint_regressor: (16, V) joints from vertices.
        skin_weights: (V, 16), rows sum to one.
        faces: (F, 3) closed, outward.
        tip_vertices: (5,) thumb, index, middle, ring, pinky.

    """

    template: np.ndarray
    shape_directions: np.ndarray
    pose_directions: np.ndarray | None
    joint_regressor: np.ndarray
    skin_weights: np.ndarray
    faces: np.ndarray
    tip_vertices: np.ndarray
    _on: dict[Any, dict[str, Any]] = field(default_factory=dict[Any, dict[str, Any]], repr=False)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_on": {}}

    def on(self, like: Array) -> dict[str, Any]:
        """Give the arrays skinning needs in the kind, dtype and device of ``like``; made once each.

        ``{joint,vertices,tips}_template`` (P, 3), ``_shape`` (10, 3 P), ``_pose`` (135, 3 P) or
        None, ``_weights`` (P, 16).
        """
        key = (str(type(like)), like.dtype, like.device)
        if key not in self._on:
            constants = self._constants()
            if isinstance(like, np.ndarray):
                made = {
                    k: None if v is None else v.astype(like.dtype) for k, v in constants.items()
                }
            else:
                made = _as_tensors(constants, like)
            self._on[key] = made
        return self._on[key]

    def _constants(self) -> dict[str, np.ndarray | None]:
        joint_shape = np.einsum("jv,vck->kjc", self.joint_regressor, self.shape_directions)
        constants: dict[str, np.ndarray | None] = {
            "joint_template": self.joint_regressor @ self.template,
            "joint_shape": joint_shape.reshape(len(joint_shape), -1),
        }
        for which, rows in (("vertices", slice(None)), ("tips", self.tip_vertices)):
            constants[f"{which}_template"] = self.template[rows]
            constants[f"{which}_shape"] = _flat_directions(self.shape_directions[rows])
            pose = self.pose_directions
            constants[f"{which}_pose"] = None if pose is None else _flat_directions(pose[rows])
            constants[f"{which}_weights"] = self.skin_weights[rows]
        return constants


def mirrored_asset(asset: HandAsset) -> HandAsset:
    """Make the other hand: mirrored across x, faces turned so that they still point outward."""
    flip = np.array([-1.0, 1.0, 1.0])
    pose = asset.pose_directions
    return HandAsset(
        template=asset.template * flip,
        shape_directions=asset.shape_directions * flip[:, None],
        pose_directions=None if pose is None else _mirrored_pose_directions(pose * flip[:, None]),
        joint_regressor=asset.joint_regressor,
        skin_weights=asset.skin_weights,
        faces=asset.faces[:, [0, 2, 1]],
        tip_vertices=asset.tip_vertices,
    )


def closed_mesh(faces: np.ndarray) -> np.ndarray:
    """``faces`` (F, 3) with the one open loop closed; MANO's wrist takes 14 triangles.

    Closed meshes come back as they are.

    Raises:
        ValueError: the open edges do not form one simple loop.

    """
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    known = {(int(a), int(b)) for a, b in edges}
    following = {b: a for a, b in sorted(known) if (b, a) not in known}
    open_edges = sum((b, a) not in known for a, b in known)
    if not open_edges:
        return faces
    start = min(following)
    loop = [start]
    while (at := following[loop[-1]]) != start and len(loop) <= open_edges and at in following:
        loop.append(at)
    if len(loop) != open_edges:
        raise ValueError(f"faces: expected one open loop at the wrist, got {open_edges} open edges")
    low, high = 0, len(loop) - 1  # zigzag from both ends, which keeps the triangles short
    closing: list[tuple[int, int, int]] = []
    while high - low > 1:
        closing.append((loop[low], loop[low + 1], loop[high]))
        low += 1
        if high - low > 1:
            closing.append((loop[low], loop[high - 1], loop[high]))
            high -= 1
    return np.concatenate([faces, np.array(closing, dtype=faces.dtype)])


def save_hand_asset(asset: HandAsset, metadata: dict[str, str]) -> bytes:
    """Write a hand as safetensors bytes, without pose directions, for ``load_hand_asset``."""
    assert asset.pose_directions is None
    joints = np.argsort(-asset.skin_weights, axis=1, kind="stable")[:, :4]
    used = int((asset.joint_regressor != 0).sum(axis=1).max())
    vertices = np.argsort(-np.abs(asset.joint_regressor), axis=1, kind="stable")[:, :used]
    tensors = {
        "template": asset.template.astype(np.float32),
        "shape_directions": asset.shape_directions.astype(np.float16),
        "regressor_vertices": vertices.astype(np.uint16),
        "regressor_values": np.take_along_axis(asset.joint_regressor, vertices, 1),
        "skin_joints": joints.astype(np.uint8),
        "skin_values": np.take_along_axis(asset.skin_weights, joints, 1).astype(np.float32),
        "faces": asset.faces.astype(np.uint16),
        "tip_vertices": asset.tip_vertices.astype(np.uint16),
    }
    tensors = {k: np.ascontiguousarray(v) for k, v in tensors.items()}
    return _with_sorted_header(save(tensors, metadata))


def load_hand_asset(data: bytes) -> HandAsset:
    """Read the hand of ``save_hand_asset``, in float64."""
    stored = load(data)
    template = stored["template"].astype(np.float64)
    regressor = np.zeros((len(stored["regressor_values"]), len(template)))
    rows = np.arange(len(regressor))[:, None]
    regressor[rows, stored["regressor_vertices"].astype(np.int64)] = stored["regressor_values"]
    weights = np.zeros((len(template), len(regressor)))
    values = stored["skin_values"].astype(np.float64)
    columns = stored["skin_joints"].astype(np.int64)
    weights[np.arange(len(weights))[:, None], columns] = values / values.sum(1, keepdims=True)
    return HandAsset(
        template=template,
        shape_directions=stored["shape_directions"].astype(np.float64),
        pose_directions=None,
        joint_regressor=regressor,
        skin_weights=weights,
        faces=stored["faces"].astype(np.int64),
        tip_vertices=stored["tip_vertices"].astype(np.int64),
    )


def _with_sorted_header(data: bytes) -> bytes:
    """Sort the header of a safetensors file, which is written in no fixed order."""
    start = 8 + int.from_bytes(data[:8], "little")
    header = json.dumps(json.loads(data[8:start]), sort_keys=True, separators=(",", ":")).encode()
    header += b" " * (-len(header) % 8)
    return len(header).to_bytes(8, "little") + header + data[start:]


def _flat_directions(directions: np.ndarray) -> np.ndarray:
    """(P, 3, K) -> (K, 3 P), so that a batch is one matrix product."""
    return np.ascontiguousarray(directions.reshape(-1, directions.shape[-1]).T)


def _mirrored_pose_directions(directions: np.ndarray) -> np.ndarray:
    """Pose directions (V, 3, 135) for mirrored rotations: R[i, j] changes sign as in D R D."""
    signs = np.outer(LEFT_MIRROR, LEFT_MIRROR).reshape(-1)
    return directions * np.tile(signs, directions.shape[-1] // 9)


def _as_tensors(constants: dict[str, np.ndarray | None], like: Any) -> dict[str, Any]:
    """Tensors that training may use later, even when first made under inference mode."""
    import torch

    with torch.inference_mode(False):
        return {
            k: None if v is None else torch.tensor(v, dtype=like.dtype, device=like.device)
            for k, v in constants.items()
        }
