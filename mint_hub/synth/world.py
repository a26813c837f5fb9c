"""A synthetic world: what there is, where it is at each frame, and who looks at it.

The generator makes a `World`, the renderer draws it; neither knows the other. Letters in shapes: T
frames, 2 hands (left, right), V vertices, F faces. The world's z points up, metres; cameras are
those of :mod:`mint_hub.conventions`. Colours are linear reflectances or intensities, 0 to 1, RGB.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry.lenses import Lens
from mint_hub.loaders.fields import TextSegment

__all__ = [
    "TEXTURE_KINDS",
    "Body",
    "Hands",
    "Light",
    "Mesh",
    "TextSegment",
    "Texture",
    "TextureKind",
    "World",
]

Floats = NDArray[np.floating[Any]]
Colour = tuple[float, float, float]
TextureKind = Literal[
    "wood", "checker", "stripes", "noise", "speckle", "plaster", "tiles", "fabric", "label"
]
TEXTURE_KINDS: Final[tuple[TextureKind, ...]] = get_args(TextureKind)


@dataclass(frozen=True)
class Texture:
    """A procedural image of two colours; one repeat covers uv from 0 to 1.

    Attributes:
        kind: one of TEXTURE_KINDS.
        colour_a: the main colour, linear RGB.
        colour_b: the other one.
        frequency: features (boards, squares, stripes, blobs) across one repeat.
        seed: of what is random in it.
        roughness: 0 mirror-like highlights, 1 none.

    """

    kind: TextureKind
    colour_a: Colour
    colour_b: Colour
    frequency: float = 4.0
    seed: int = 0
    roughness: float = 0.8


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles, counter-clockwise seen from outside.

    Attributes:
        name: of the kind of thing, for people ("cup").
        vertices: (V, 3) metres, the body's frame.
        faces: (F, 3).
        normals: (V, 3) unit; None: smooth ones from the faces.
        uv: (V, 2), in repeats of the texture.
        texture: its surface.

    """

    name: str
    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]
    normals: NDArray[np.float32] | None
    uv: NDArray[np.float32]
    texture: Texture


@dataclass(frozen=True, eq=False)
class Body:
    """A mesh in the world.

    Attributes:
        mesh: its shape and surface. Bodies may share one mesh: it is uploaded once.
        T_world_from_body: (T, 4, 4) rigid, or (4, 4) when it never moves.
        movable: an object (segmentation 3) or furniture and room (4); None: an object exactly when
            its pose is given per frame.

    """

    mesh: Mesh
    T_world_from_body: NDArray[np.float64]
    movable: bool | None = None

    def is_object(self) -> bool:
        """Whether the segmentation calls it a movable object."""
        return self.T_world_from_body.ndim == 3 if self.movable is None else self.movable

    def pose(self, k: int) -> NDArray[np.float64]:
        """T_world_from_body (4, 4) at frame ``k``."""
        poses = self.T_world_from_body
        return poses[k] if poses.ndim == 3 else poses


@dataclass(frozen=True)
class Light:
    """A distant light, and the light that comes from everywhere.

    Attributes:
        direction: (3,) in which the light travels (down: negative z); any length.
        colour: its intensity on a surface that faces it.
        ambient: added everywhere, more from above than from below.
        shadow: whether things throw shadows in it. At most the first two that do are drawn.

    """

    direction: tuple[float, float, float]
    colour: Colour
    ambient: Colour = (0.0, 0.0, 0.0)
    shadow: bool = True


@dataclass(frozen=True, eq=False)
class Hands:
    """Both hands of the person who looks.

    Attributes:
        hand_state: (T, 2, 109) float32 as Episode has it, camera frame; ``hand_state.absent`` where
            a hand does not exist.
        exists: (T, 2) bool, whether the arm is in the world at all (not: in the image).
        skin_colour: (2, 3) linear RGB.
        forearm_direction: (T, 2, 3) world, from the wrist towards the elbow; any length.
        sleeve: its cloth; None: a bare forearm.
        forearm_length_m: from the wrist to the elbow, where the drawn arm turns to the shoulder.

    """

    hand_state: NDArray[np.float32]
    exists: NDArray[np.bool_]
    skin_colour: Floats
    forearm_direction: Floats
    sleeve: Texture | None = None
    forearm_length_m: float = 0.28


@dataclass(frozen=True, eq=False)
class World:
    """One clip before it is drawn.

    Attributes:
        key: of the episode to come.
        bodies: everything but the hands.
        lights: at least one.
        hands: of the person who looks.
        T_camera_from_world: (T, 4, 4).
        fov_vh_rad: (2,) vertical, horizontal, of the pinhole that is drawn; a list of these per
            frame is not supported: a lens does not change within a clip.
        image_size_hw: (height, width).
        fps: frames a second.
        lens: what the pictures are resampled to by `corruption`; None: the pinhole.
        exposure: (T,) factor on all light; None: 1 throughout.
        text: what happens.
        seed: it was made from.
        preset: it was made for.
        meta: anything JSON-able to be kept with the episode.

    """

    key: str
    bodies: tuple[Body, ...]
    lights: tuple[Light, ...]
    hands: Hands
    T_camera_from_world: NDArray[np.float64]
    fov_vh_rad: tuple[float, float]
    image_size_hw: tuple[int, int]
    fps: float = 30.0
    lens: Lens | None = None
    exposure: NDArray[np.float32] | None = None
    text: tuple[TextSegment, ...] = ()
    seed: int = 0
    preset: str = "train"
    meta: dict[str, Any] = field(default_factory=dict[str, Any])

    @property
    def num_frames(self) -> int:
        """T."""
        return len(self.T_camera_from_world)

    def cut(self, first: int, count: int) -> World:
        """Frames first <= k < first + count, as a world of the same key.

        Raises:
            ValueError: it has not all of these frames.

        """
        if first < 0 or count < 1 or first + count > self.num_frames:
            raise ValueError(
                f"{self.key}: expected frames within 0 to {self.num_frames}, got {first} to "
                f"{first + count}"
            )
        of = slice(first, first + count)
        bodies = [
            replace(body, T_world_from_body=body.T_world_from_body[of])
            if body.T_world_from_body.ndim == 3
            else body
            for body in self.bodies
        ]
        hands = replace(
            self.hands,
            hand_state=self.hands.hand_state[of],
            exists=self.hands.exists[of],
            forearm_direction=self.hands.forearm_direction[of],
        )
        said = [
            replace(text, start=max(text.start - first, 0), end=min(text.end - first, count))
            for text in self.text
            if text.start < first + count and text.end > first
        ]
        return replace(
            self,
            bodies=tuple(bodies),
            hands=hands,
            T_camera_from_world=self.T_camera_from_world[of],
            exposure=None if self.exposure is None else self.exposure[of],
            text=tuple(said),
            meta={**self.meta, "first_frame": first},
        )
