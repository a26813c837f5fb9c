"""A world on the graphics card: what was uploaded once, and what moves with every frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry.hand_model import HandModel
from mint_hub.geometry.rigid import inverse
from mint_hub.synth.figure import Figure
from mint_hub.synth.gl import Programs, put
from mint_hub.synth.primitives import normals_of
from mint_hub.synth.shaders import NUM_LIGHTS
from mint_hub.synth.shadows import SKY, ShadowView, focus_of, in_shadow_maps, shadow_view
from mint_hub.synth.skin import SKIN_LAYOUT
from mint_hub.synth.textures import skin_image, texture_image
from mint_hub.synth.world import Body, Mesh, Texture, World

if TYPE_CHECKING:
    import moderngl

OBJECT, FURNITURE = 3, 4
CHUNK: Final = 32
"""Frames whose hands are computed at once."""


@dataclass(frozen=True, eq=False)
class Drawn:
    """One mesh on the card, with the ways to draw it.

    Attributes:
        label: its segment.
        hand: 0, 1, or None for what is not the person.
        source: the body, or the number of the figure's part.
        buffers: of the person: positions, normals, positions of the frame before.
        colour: vertex array that draws its surface.
        shadow: vertex array for shadow maps; None: it throws none.
        labels: vertex array that draws its segment.
        surface: its texture.
        roughness: of its surface; None: skin.

    """

    label: int
    hand: int | None
    source: Body | int
    buffers: tuple[Any, ...]
    colour: Any
    shadow: Any
    labels: Any
    surface: Any
    roughness: float | None


class Stage:
    """One world, uploaded; `move_to` a frame before drawing."""

    def __init__(
        self, ctx: moderngl.Context, programs: Programs, world: World, model: HandModel
    ) -> None:
        self.world = world
        self.k = 0
        self._ctx, self._programs = ctx, programs
        self._owned: list[Any] = []
        self._surfaces: dict[Texture | None, Any] = {}
        self.lights = sorted(world.lights, key=lambda light: not light.shadow)[:NUM_LIGHTS]
        self.focus = focus_of(world)
        self.shadow_views: list[ShadowView | None] = [None, None]
        for i, light in enumerate(self.lights[:2]):
            self.shadow_views[i] = shadow_view(world, light, self.focus) if light.shadow else None
        self.shadow_views.append(shadow_view(world, SKY, self.focus))
        self.figure = Figure(world, model)
        self._bodies = self._upload_bodies()
        self._person = [self._upload_part(i) for i in range(len(self.figure.parts))]
        self._chunk = range(0)
        self._points: list[NDArray[np.float32]] = []

    def release(self) -> None:
        """Free everything of this world."""
        for thing in reversed(self._owned):
            thing.release()
        self._owned.clear()

    # -------------------------------------------------------------- upload

    def _buffer(self, values: NDArray[Any]) -> Any:
        self._owned.append(self._ctx.buffer(np.ascontiguousarray(values).tobytes()))
        return self._owned[-1]

    def _array(self, program: Any, content: list[tuple[Any, ...]], index: Any) -> Any:
        self._owned.append(self._ctx.vertex_array(program, content, index_buffer=index))
        return self._owned[-1]

    def _surface(self, texture: Texture | None) -> Any:
        """Upload a texture, or the one of skin, once."""
        if texture not in self._surfaces:
            image = skin_image() if texture is None else texture_image(texture)
            height, width, channels = image.shape
            made: Any = self._ctx.texture((width, height), channels, image.tobytes())
            made.build_mipmaps()
            self._owned.append(made)
            self._surfaces[texture] = made
        return self._surfaces[texture]

    def _upload_bodies(self) -> list[Drawn]:
        arrays: dict[int, tuple[Any, Any, Any]] = {}
        drawn: list[Drawn] = []
        for body in self.world.bodies:
            if id(body.mesh) not in arrays:
                arrays[id(body.mesh)] = self._upload_mesh(body.mesh)
            colour, shadow, labels = arrays[id(body.mesh)]
            texture = body.mesh.texture
            drawn.append(
                Drawn(
                    label=OBJECT if body.is_object() else FURNITURE,
                    hand=None,
                    source=body,
                    buffers=(),
                    colour=colour,
                    shadow=shadow if in_shadow_maps(body) else None,
                    labels=labels,
                    surface=self._surface(texture),
                    roughness=texture.roughness,
                )
            )
        # Near things first: what they hide is not shaded.
        sizes = [float(np.ptp(body.mesh.vertices, axis=0).max()) for body in self.world.bodies]
        return [drawn[i] for i in np.argsort(sizes, kind="stable")]

    def _upload_mesh(self, mesh: Mesh) -> tuple[Any, Any, Any]:
        p = self._programs
        at = self._buffer(np.asarray(mesh.vertices, np.float32))
        index = self._buffer(np.asarray(mesh.faces, np.int32))
        rest = np.column_stack([normals_of(mesh), mesh.uv]).astype(np.float32)
        surface = (self._buffer(rest), "3f 2f", "in_normal", "in_uv")
        where = (at, "3f", "in_position")
        return (
            self._array(p.body, [where, surface], index),
            self._array(p.shadow, [where], index),
            self._array(p.label, [where, (at, "3f", "in_earlier")], index),
        )

    def _upload_part(self, number: int) -> Drawn:
        part, p = self.figure.parts[number], self._programs
        empty = np.zeros((len(part.static), 3), np.float32)
        at, normal, earlier = (self._buffer(empty) for _ in range(3))
        index, static = self._buffer(part.faces), self._buffer(part.static)
        where, facing = (at, "3f", "in_position"), (normal, "3f", "in_normal")
        skin = part.texture is None
        own = (static, *(SKIN_LAYOUT if skin else ("2f", "in_uv")))
        return Drawn(
            label=part.label,
            hand=part.hand,
            source=number,
            buffers=(at, normal, earlier),
            colour=self._array(p.skin if skin else p.body, [where, facing, own], index),
            shadow=self._array(p.shadow, [where], index),
            labels=self._array(p.label, [where, (earlier, "3f", "in_earlier")], index),
            surface=self._surface(part.texture),
            roughness=None if part.texture is None else part.texture.roughness,
        )

    # ---------------------------------------------------------------- move

    def move_to(self, k: int, stop: int) -> None:
        """Put the person in the pose of frame ``k``; frames up to ``stop`` may follow."""
        self.k = k
        before = max(k - 1, 0)
        if before not in self._chunk or k not in self._chunk:
            self._chunk = range(before, min(k + CHUNK, max(stop, k + 1)))
            self._points = self.figure.points(self._chunk)
        for drawn, points in zip(self._person, self._points, strict=True):
            assert drawn.hand is not None
            assert isinstance(drawn.source, int)
            if not self.world.hands.exists[k, drawn.hand]:
                continue
            now = points[k - self._chunk.start]
            was_there = self.world.hands.exists[before, drawn.hand]
            at, normal, earlier = drawn.buffers
            at.write(now.tobytes())
            normal.write(self.figure.normals(drawn.source, now).tobytes())
            earlier.write((points[before - self._chunk.start] if was_there else now).tobytes())

    def drawn(self) -> list[Drawn]:
        """List what there is in this frame, the person first."""
        exists = self.world.hands.exists[self.k]
        return [d for d in self._person if exists[d.hand]] + self._bodies

    # ---------------------------------------------------------------- draw

    def exposure(self) -> float:
        """Return the factor on all light in this frame."""
        exposure = self.world.exposure
        return 1.0 if exposure is None else float(exposure[self.k])

    def light_values(self) -> dict[str, Any]:
        """Uniforms of the shaders' light."""
        towards = np.zeros((NUM_LIGHTS, 3))
        colours = np.zeros((NUM_LIGHTS, 3))
        for i, light in enumerate(self.lights):
            towards[i] = -np.asarray(light.direction) / np.linalg.norm(light.direction)
            colours[i] = light.colour
        views = self.shadow_views
        nowhere = np.diag([0.0, 0.0, 0.0, 1.0])  # what falls outside a map is lit
        return {
            "eye": inverse(self.world.T_camera_from_world[self.k])[:3, 3],
            "focus": self.focus,
            "ambient": np.sum([light.ambient for light in self.world.lights], axis=0),
            "num_lights": len(self.lights),
            "to_light": towards.ravel(),
            "light_colour": colours.ravel(),
            "num_shadowed": sum(view is not None for view in views[:2]),
            "shadow_depth": np.array([1.0 if v is None else v.depth_m for v in views]),
            "shadow_from_world": np.stack(
                [nowhere if v is None else v.shadow_from_world for v in views]
            ),
        }

    def _matrices(self, drawn: Drawn, k: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """T_world_from_body and T_camera_from_body in frame ``k``."""
        T_camera_from_world = self.world.T_camera_from_world[k]
        if isinstance(drawn.source, Body):
            T_world_from_body = drawn.source.pose(k)
            return T_world_from_body, T_camera_from_world @ T_world_from_body
        return inverse(T_camera_from_world), np.eye(4)

    def draw_shadow(self, drawn: Drawn, view: ShadowView) -> None:
        """Draw into the shadow map in use, seen along that view."""
        if drawn.shadow is None:
            return
        T_world_from_body, _ = self._matrices(drawn, self.k)
        put(self._programs.shadow, {"shadow_from_body": view.shadow_from_world @ T_world_from_body})
        drawn.shadow.render()

    def draw_colour(self, drawn: Drawn) -> None:
        """Draw the surface in its light."""
        world, camera = self._matrices(drawn, self.k)
        values: dict[str, Any] = {"world_from_body": world, "camera_from_body": camera}
        if drawn.roughness is None:
            assert drawn.hand is not None
            values["skin"] = np.asarray(self.world.hands.skin_colour[drawn.hand])
        else:
            values["roughness"] = float(drawn.roughness)
        put(self._programs.skin if drawn.roughness is None else self._programs.body, values)
        drawn.surface.use(0)
        drawn.colour.render()

    def draw_label(self, drawn: Drawn) -> None:
        """Draw depth, segment and flow."""
        _, camera = self._matrices(drawn, self.k)
        _, earlier = self._matrices(drawn, max(self.k - 1, 0))
        values = {"camera_from_body": camera, "earlier_from_body": earlier}
        put(self._programs.label, values | {"label": float(drawn.label)})
        drawn.labels.render()
