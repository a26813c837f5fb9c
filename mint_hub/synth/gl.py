"""OpenGL without a screen: the context, the shaders made into programs, the pictures drawn into.

moderngl is imported when a context is made, not before: it belongs to the extra ``synth``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from mint_hub.synth import shaders

if TYPE_CHECKING:
    import moderngl

MISSING_PYTHON: Final = 'drawing synthetic clips needs moderngl: pip install "mint-hub[synth]"'
MISSING_EGL: Final = (
    "drawing synthetic clips needs OpenGL 3.3 through EGL, and none answered; on Debian or Ubuntu: "
    "apt-get install libegl1 libgl1-mesa-dri"
)


def make_context() -> moderngl.Context:
    """Open OpenGL off screen, on the graphics card or in Mesa's software.

    Raises:
        ImportError: moderngl is not installed.
        RuntimeError: no EGL, or none that draws. Both say what to install.

    """
    try:
        import moderngl
    except ImportError as error:
        raise ImportError(MISSING_PYTHON) from error
    try:
        settings: Any = {"backend": "egl"}
        return moderngl.create_standalone_context(require=330, **settings)
    except Exception as error:  # the loader raises whatever dlopen and EGL gave it
        raise RuntimeError(f"{MISSING_EGL} ({error})") from error


class Programs:
    """The compiled shaders."""

    def __init__(self, ctx: moderngl.Context) -> None:
        self.body = ctx.program(shaders.BODY_VERTEX, shaders.BODY_FRAGMENT)
        self.skin = ctx.program(shaders.SKIN_VERTEX, shaders.SKIN_FRAGMENT)
        self.shadow = ctx.program(shaders.SHADOW_VERTEX, shaders.SHADOW_FRAGMENT)
        self.label = ctx.program(shaders.LABEL_VERTEX, shaders.LABEL_FRAGMENT)


def put(program: moderngl.Program, values: Mapping[str, Any]) -> None:
    """Set uniforms; those that the compiler found unused are passed over.

    An array of two dimensions or more is a matrix, or a list of matrices; one of one dimension and
    tuples are vectors.
    """
    for name, value in values.items():
        if name not in program:
            continue
        uniform: Any = program[name]
        if isinstance(value, np.ndarray):
            matrix = value.ndim > 1 and value.shape[-2:] == (4, 4)
            ordered = np.swapaxes(value, -1, -2) if matrix else value
            uniform.write(np.ascontiguousarray(ordered, np.float32).tobytes())
        else:
            uniform.value = value


class ShadowMap:
    """How far light gets, seen along it; blurred as the first two moments of depth."""

    def __init__(self, ctx: moderngl.Context, side: int) -> None:
        self.side = side
        self._depth: Any = ctx.depth_texture((side, side))
        self.target = ctx.framebuffer([], self._depth)
        self.moments: Any = ctx.texture((side, side), 2, dtype="f4")
        self.moments.repeat_x = self.moments.repeat_y = False
        self.moments.write(np.ones((side, side, 2), np.float32).tobytes())

    def blur(self, radius: float) -> None:
        """Make ``moments`` of what was drawn, blurred by ``radius`` (a share of the width)."""
        depth = np.frombuffer(self._depth.read(), np.float32).reshape(self.side, self.side)
        box = (2 * max(1, round(radius * self.side / 2)) + 1,) * 2
        twice = [cv2.blur(cv2.blur(x, box), box) for x in (depth, depth * depth)]
        self.moments.write(cv2.merge(twice))


class Targets:
    """The pictures that one image size is drawn into."""

    def __init__(
        self,
        ctx: moderngl.Context,
        image_size_hw: tuple[int, int],
        samples: int,
        shadow_size: int,
    ) -> None:
        height, width = image_size_hw
        size = (width, height)
        self.image_size_hw = image_size_hw
        self.colour = ctx.framebuffer(
            [ctx.renderbuffer(size, 4, samples=samples)],
            ctx.depth_renderbuffer(size, samples=samples),
        )
        self.resolved = ctx.framebuffer([ctx.renderbuffer(size, 4)]) if samples else self.colour
        labels = [(1, "f4"), (1, "f1"), (2, "f4")]
        self.labels = ctx.framebuffer(
            [ctx.texture(size, count, dtype=kind) for count, kind in labels],
            ctx.depth_renderbuffer(size),
        )
        self.shadows: list[ShadowMap] = [
            ShadowMap(ctx, side) for side in (shadow_size, shadow_size, max(shadow_size // 2, 2))
        ]

    def read_colour(self, ctx: moderngl.Context) -> NDArray[np.uint8]:
        """Average the samples of what was drawn: (H, W, 3)."""
        if self.resolved is not self.colour:
            ctx.copy_framebuffer(self.resolved, self.colour)
        image = np.empty((*self.image_size_hw, 3), np.uint8)
        self.resolved.read_into(image, components=3, alignment=1)
        return image

    def read_label(self, attachment: int) -> NDArray[Any]:
        """Read depth (0, float32), segments (1, uint8) or flow (2, float32 with two channels)."""
        channels, kind, dtype = ((1, "f4", "f4"), (1, "f1", "u1"), (2, "f4", "f4"))[attachment]
        shape = self.image_size_hw if channels == 1 else (*self.image_size_hw, channels)
        image = np.empty(shape, dtype)
        self.labels.read_into(
            image, components=channels, attachment=attachment, alignment=1, dtype=kind
        )
        return image
