"""The camera of the synthetic clips: a `World` drawn with OpenGL, and its exact labels.

The picture is drawn with several samples a pixel, textures, up to two lights with soft shadows and
a sky that is darker under things. Depth, segments and flow are drawn a second time with one sample
at each pixel's middle, without blending, so that every value belongs to one surface.
"""

from __future__ import annotations

from collections.abc import Collection, Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final, Literal, Self

import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry.camera import require_image_size
from mint_hub.geometry.hand_model import HandModel
from mint_hub.synth.figure import LEFT_HAND, RIGHT_HAND
from mint_hub.synth.gl import Programs, Targets, make_context, put
from mint_hub.synth.stage import Drawn, Stage
from mint_hub.synth.world import World

Pass = Literal["rgb", "depth", "segmentation", "flow"]
PASSES: Final[tuple[Pass, ...]] = ("rgb", "depth", "segmentation", "flow")

SAMPLES: Final = 4
"""Samples a pixel, for smooth edges."""

NEAR_M: Final = 0.01
FAR_M: Final = 60.0
SOFTNESS_M: Final = (0.008, 0.025, 0.06)
"""Radius of a shadow's edge, metres: of the first light, the second, and the sky."""

NOTHING: Final = (0.05, 0.05, 0.055)
"""What is seen where the world ends, linear RGB."""


@dataclass(frozen=True, eq=False)
class Rendered:
    """One frame.

    Attributes:
        index: of the frame in its world.
        rgb: (H, W, 3) uint8 sRGB.
        depth: (H, W) float32, z of the surface at each pixel's middle, metres; 0 where the world
            has none.
        segmentation: (H, W) uint8: 0 nothing, 1 left hand, 2 right hand, 3 objects, 4 furniture and
            room, 5 forearms and sleeves.
        flow: (H, W, 2) float32, how far (u, v) the surface at each pixel has moved since the frame
            before, pixels; 0 in frame 0.

    """

    index: int
    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32] | None = None
    segmentation: NDArray[np.uint8] | None = None
    flow: NDArray[np.float32] | None = None


class Renderer:
    """Draws worlds at one image size; a context manager that frees the graphics memory.

    Args:
        image_size_hw: (height, width), pixels.
        samples: samples a pixel: 0, 2, 4 or what the card allows.
        shadow_size: texels across a shadow map.
        hand_model: the hands; the template's without it.

    Raises:
        ImportError: moderngl is not installed.
        RuntimeError: EGL is missing. Both say what to install.
        ValueError: a malformed size.

    """

    def __init__(
        self,
        image_size_hw: tuple[int, int],
        *,
        samples: int = SAMPLES,
        shadow_size: int = 512,
        hand_model: HandModel | None = None,
    ) -> None:
        self.image_size_hw = require_image_size(image_size_hw)
        self.hand_model = hand_model or HandModel.template()
        self._ctx = make_context()
        self._programs = Programs(self._ctx)
        self._targets = Targets(self._ctx, self.image_size_hw, samples, shadow_size)
        self._stage: Stage | None = None
        self._closed = False
        self._ctx.front_face = "cw"  # rows count downwards

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Free what was made on the card; may be called twice."""
        if not self._closed:
            self._closed = True
            self._stage = None
            self._ctx.release()

    @property
    def device(self) -> str:
        """Name of what draws: "llvmpipe ..." without a graphics card."""
        return str(self._ctx.info["GL_RENDERER"])

    # -------------------------------------------------------------- frames

    def frames(
        self,
        world: World,
        passes: Collection[Pass] = ("rgb",),
        start: int = 0,
        stop: int | None = None,
    ) -> Iterator[Rendered]:
        """Draw frames start <= k < stop; the picture always, labels when asked.

        Raises:
            ValueError: an unknown pass, frames that are not there, another image size.

        """
        stop = world.num_frames if stop is None else stop
        unknown = [p for p in passes if p not in PASSES]
        if unknown:
            raise ValueError(f"passes: expected among {', '.join(PASSES)}, got {unknown}")
        if not 0 <= start < stop <= world.num_frames:
            raise ValueError(f"frames: expected within 0 to {world.num_frames}, got {start}:{stop}")
        return self._frames(world, frozenset(passes), range(start, stop))

    def _frames(self, world: World, passes: frozenset[str], which: range) -> Iterator[Rendered]:
        for k in which:
            with self._ready(world, k, which.stop) as stage:
                rgb = self._picture(stage)
                labels: dict[str, Any] = {}
                if passes - {"rgb"}:
                    self._label(stage, stage.drawn())
                    for i, name in enumerate(("depth", "segmentation", "flow")):
                        if name in passes:
                            labels[name] = self._targets.read_label(i)
            yield Rendered(k, rgb, **labels)

    def hand_masks(self, world: World, k: int, dressed: bool = False) -> NDArray[np.bool_]:
        """Where each hand is in frame ``k`` when nothing else is drawn, (2, H, W).

        With ``dressed``, its own forearm and sleeve are drawn too and may cover it.
        """
        masks = np.zeros((2, *self.image_size_hw), np.bool_)
        with self._ready(world, k, k + 1) as stage:
            for hand, label in enumerate((LEFT_HAND, RIGHT_HAND)):
                own = [d for d in stage.drawn() if d.hand == hand and (dressed or d.label == label)]
                if own:
                    self._label(stage, own)
                    masks[hand] = self._targets.read_label(1) == label
        return masks

    def visible_fraction(self, world: World, k: int) -> NDArray[np.float32]:
        """Share of each hand (2,) in frame ``k`` that nothing hides, of what is inside the image.

        Pixels of the hand in the segmentation over its pixels when only the hand with its own
        sleeve is drawn; 0 where it has none. What lies outside the image counts in neither.
        """
        alone = self.hand_masks(world, k, dressed=True).sum((1, 2))
        if not alone.any():
            return np.zeros(2, np.float32)
        with self._ready(world, k, k + 1) as stage:
            self._label(stage, stage.drawn())
            seen = np.bincount(self._targets.read_label(1).ravel(), minlength=6)
        visible = seen[[LEFT_HAND, RIGHT_HAND]]
        return (visible / np.maximum(alone, 1)).astype(np.float32)

    # -------------------------------------------------------------- passes

    @contextmanager
    def _ready(self, world: World, k: int, stop: int) -> Generator[Stage]:
        """Make this context the current one, with a world in it at frame ``k``.

        The world is uploaded unless it is the one already there.
        """
        if self._closed:
            raise ValueError("renderer: expected an open one, got one that was closed")
        if tuple(world.image_size_hw) != self.image_size_hw:
            raise ValueError(
                f"world, image_size_hw: expected the renderer's {self.image_size_hw}, "
                f"got {tuple(world.image_size_hw)}"
            )
        with self._ctx:
            if self._stage is None or self._stage.world is not world:
                if self._stage is not None:
                    self._stage.release()
                self._stage = Stage(self._ctx, self._programs, world, self.hand_model)
            self._stage.move_to(k, stop)
            yield self._stage

    def _picture(self, stage: Stage) -> NDArray[np.uint8]:
        import moderngl

        ctx, programs, targets = self._ctx, self._programs, self._targets
        ctx.enable_only(moderngl.DEPTH_TEST | moderngl.CULL_FACE)
        ctx.front_face = "ccw"
        for i, view in enumerate(stage.shadow_views):
            if view is not None:
                targets.shadows[i].target.clear(depth=1.0)
                targets.shadows[i].target.use()
                for drawn in stage.drawn():
                    stage.draw_shadow(drawn, view)
                targets.shadows[i].blur(SOFTNESS_M[i] / view.span_m)
        ctx.front_face = "cw"
        exposure = stage.exposure()
        values = stage.light_values() | {
            "lens": self._lens(stage),
            "exposure": exposure,
            "surface": 0,
        }
        values |= {f"shadow_{i}": 4 + i for i in range(3)}
        for program in (programs.body, programs.skin):
            put(program, values)
        for i, shadow in enumerate(targets.shadows):
            shadow.moments.use(4 + i)
        targets.colour.use()
        targets.colour.clear(*(min(exposure * c, 1.0) ** (1 / 2.2) for c in NOTHING), depth=1.0)
        for drawn in stage.drawn():
            stage.draw_colour(drawn)
        return targets.read_colour(ctx)

    def _label(self, stage: Stage, things: list[Drawn]) -> None:
        import moderngl

        height, width = self.image_size_hw
        self._ctx.enable_only(moderngl.DEPTH_TEST | moderngl.CULL_FACE)
        values = {"lens": self._lens(stage), "half_size": (width / 2, height / 2)}
        put(self._programs.label, values)
        self._targets.labels.use()
        self._targets.labels.clear(0.0, 0.0, 0.0, 0.0, depth=1.0)
        for drawn in things:
            stage.draw_label(drawn)

    def _lens(self, stage: Stage) -> tuple[float, float, float, float]:
        vertical, horizontal = (float(np.tan(a / 2)) for a in stage.world.fov_vh_rad)
        near, far = NEAR_M, FAR_M
        depth = (far + near) / (far - near), -2 * far * near / (far - near)
        return horizontal, vertical, *depth
