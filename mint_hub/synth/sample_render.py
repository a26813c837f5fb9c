"""The picture of the sample clip: table, wall and floor by rays, the rest by triangles, then light.

Room frame: x right, y away from the person, z up, metres; the table top is z = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np

from mint_hub.geometry.camera import fov_vh_to_K, project
from mint_hub.geometry.rigid import inverse, transform_points
from mint_hub.synth import sample_scene as scene
from mint_hub.synth.raster import fill, vertex_normals
from mint_hub.synth.sample_scene import Mesh

OVERSAMPLING: Final = 2
SUN: Final = np.array([-0.42, -0.30, 0.86]) / np.linalg.norm([-0.42, -0.30, 0.86])
SHADOW_SCALE: Final = 0.4
"""Pixels of the shadow map to a pixel of the table's texture."""


def render(
    things: Sequence[Mesh],
    T_camera_from_room: np.ndarray,
    fov_vh_rad: np.ndarray,
    image_size_hw: tuple[int, int],
    textures: Sequence[np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """Draw meshes, in the room, over the planes.

    Returns:
        Image (H, W, 3) float64 RGB around 0..255, and the labels (2 H, 2 W) uint8 of the finer
        image it is the mean of.

    """
    height, width = (OVERSAMPLING * n for n in image_size_hw)
    K = fov_vh_to_K(fov_vh_rad, (height, width))
    depth = np.full((height, width), np.inf)  # -1 / z
    buffer = np.zeros((height, width, 7))  # 1, normal, uv, label; all over z
    _planes(T_camera_from_room, K, depth, buffer)
    for mesh in things:
        camera = transform_points(T_camera_from_room, mesh.vertices)
        uv, z = project(camera, K)
        corners = np.concatenate([uv - 0.5, -1 / z[:, None]], -1)
        normals = vertex_normals(mesh.vertices, mesh.faces)
        ones = np.ones((len(z), 1))
        attributes = np.concatenate([ones, normals, mesh.uv, mesh.label * ones], -1) / z[:, None]
        a, b, c = (camera[mesh.faces[:, i]] for i in range(3))
        facing = (np.cross(b - a, c - a) * a).sum(-1) < 0
        for face in mesh.faces[facing]:
            fill(corners[face], attributes[face], depth, buffer)
    image, labels = _shaded(buffer, things, textures)
    blocks = (image_size_hw[0], OVERSAMPLING, image_size_hw[1], OVERSAMPLING, 3)
    return image.reshape(blocks).mean((1, 3)), labels


def _planes(T: np.ndarray, K: np.ndarray, depth: np.ndarray, buffer: np.ndarray) -> None:
    rows, columns = np.mgrid[: depth.shape[0], : depth.shape[1]] + 0.5
    rays = np.stack([(columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1]], -1)
    rays = rays @ T[:2, :3] + T[2, :3]  # room directions of depth 1
    eye = inverse(T)[:3, 3]
    for label, corner, right, down, size, scale in scene.PLANES:
        normal = np.cross(down, right)
        z = ((np.array(corner) - eye) @ normal) / (rays @ normal)
        points = eye + z[..., None] * rays - np.array(corner)
        x, y = points @ np.array(right), points @ np.array(down)
        hit = (z > 0) & (x >= 0) & (x < size[0]) & (y >= 0) & (y < size[1]) & (-1 / z < depth)
        depth[hit] = -1 / z[hit]
        over = np.broadcast_to([1.0, *normal, 0.0, 0.0, label], (int(hit.sum()), 7)).copy()
        over[:, 4], over[:, 5] = x[hit] * scale, y[hit] * scale
        buffer[hit] = over / z[hit, None]


def _shaded(
    buffer: np.ndarray, things: Sequence[Mesh], textures: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    over = buffer / np.maximum(buffer[..., :1], 1e-9)
    z = 1 / np.maximum(buffer[..., 0], 0.1)
    normals = over[..., 1:4] / np.maximum(np.linalg.norm(over[..., 1:4], axis=-1), 1e-9)[..., None]
    u, v = (over[..., i].astype(np.float32) for i in (4, 5))
    labels = over[..., 6].round().astype(np.uint8)
    image = np.zeros((*labels.shape, 3))
    for label, texture in enumerate(textures):
        mask = labels == label
        sampled = cv2.remap(texture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
        image[mask] = sampled[mask]
    sun = normals @ SUN
    wrap = np.where(labels == scene.SKIN, 0.25, 0.05)  # light goes round soft things
    light = 0.50 + 0.10 * normals[..., 2] + 0.62 * np.clip((sun + wrap) / (1 + wrap), 0, 1)
    sampled = cv2.remap(shadows(things), u * SHADOW_SCALE, v * SHADOW_SCALE, cv2.INTER_LINEAR)
    light *= np.where(labels == scene.TABLE, sampled, 1.0)
    near = cv2.GaussianBlur(z, (0, 0), 7)  # darker where something nearer is close by
    light *= 1 - 0.30 * np.clip((z - near) / 0.035, 0, 1) * (z < 0.9)
    gloss = 60 * np.clip(sun, 0, 1) ** 24 * (labels == scene.MUG)
    ends = [np.linspace(-1, 1, n) ** 2 for n in labels.shape]
    vignette = 1.04 - 0.13 * (ends[0][:, None] + ends[1])
    return (image * light[..., None] + gloss[..., None]) * vignette[..., None], labels


def shadows(things: Sequence[Mesh]) -> np.ndarray:
    """Light that reaches the table, 0 .. 1, float32, over its texture: blurred silhouettes.

    One is cast along the sun, one straight down by what is within 6 cm of the table.
    """
    _, corner, _, _, size, scale = scene.PLANES[0]
    pixels = scale * SHADOW_SCALE
    shape = (round(size[1] * pixels), round(size[0] * pixels))
    out = np.ones(shape, np.float32)
    slant = SUN[:2] / SUN[2]
    for shift, reach, darkness, blur in ((slant, 9.0, 0.42, 3.5), (0 * slant, 0.06, 0.30, 9.0)):
        silhouette = np.zeros(shape, np.uint8)
        for mesh in things:
            flat = mesh.vertices[:, :2] - shift * mesh.vertices[:, 2:]
            at = (flat - corner[:2]) * [pixels, -pixels] * 16
            low = mesh.vertices[mesh.faces][..., 2].min(1) < reach
            for triangle in at.round().astype(np.int32)[mesh.faces[low]]:
                cv2.fillConvexPoly(silhouette, triangle, 1, cv2.LINE_8, 4)
        out *= 1 - darkness * cv2.GaussianBlur(silhouette.astype(np.float32), (0, 0), blur)
    return out
