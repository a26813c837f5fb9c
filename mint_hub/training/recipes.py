"""What is trained, on what, by how much: frozen typed configurations, found by name.

A name is a base and options: ``stage1``, ``stage2``, ``paper-stage1``, ``paper-stage2``, then
``+OPTION`` of OPTIONS. The ablations of the paper are such names:

- data mixture: ``stage1`` (all sources) or ``stage1+one-source``;
- initialisation: ``stage1+pretrained`` or ``stage1+random``;
- world loss: ``paper-stage1`` or ``paper-stage1+no-world``, ``stage1+world``;
- second stage: score the checkpoint of a stage 1 run, or that of the stage 2 run that begins there.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Final, Literal

from mint_hub.model.losses_mint import (
    GUIDE,
    MOTION,
    RELEASE_STAGE_1,
    RELEASE_STAGE_2,
    WORLD,
    LossSettings,
)
from mint_hub.windows import WINDOW_LENGTH

__all__ = [
    "OPTIONS",
    "PARTS",
    "Optimisation",
    "Recipe",
    "paper_stage1",
    "paper_stage2",
    "recipe_named",
    "release_stage1",
    "release_stage2",
]

Part = Literal["encoder", "aggregator", "camera_head", "fov_head", "hand_head", "presence_head"]
PARTS: Final[tuple[Part, ...]] = (
    "encoder",
    "aggregator",
    "camera_head",
    "fov_head",
    "hand_head",
    "presence_head",
)
"""Parts of `MintModel`, each with a learning rate of its own, or frozen."""

Init = Literal["random", "pretrained"]
Presence = Literal["presence", "visible"]
Sources = Literal["all", "one"]


@dataclass(frozen=True)
class Optimisation:
    """How a step is made; the defaults are those of both stages.

    Attributes:
        betas: of AdamW.
        weight_decay: of AdamW, on every parameter.
        clip_value: gradients are clipped to this, element by element, before the step.
        warmup_steps: of the linear rise; then a cosine to 0 at the last step.
        bf16: run the network under bfloat16 autocast (the camera head and losses stay in float32).
        seed: of initialisation, order and augmentation.

    """

    betas: tuple[float, float] = (0.9, 0.95)
    weight_decay: float = 0.05
    clip_value: float = 1.0
    warmup_steps: int = 2000
    bf16: bool = True
    seed: int = 42

    def __post_init__(self) -> None:
        for name in ("weight_decay", "warmup_steps", "seed"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name}: expected at least 0, got {getattr(self, name)}")
        if not self.clip_value > 0:
            raise ValueError(f"clip_value: expected more than 0, got {self.clip_value}")
        if not all(0 <= beta < 1 for beta in self.betas):
            raise ValueError(f"betas: expected two numbers in [0, 1), got {self.betas}")


@dataclass(frozen=True)
class Recipe:
    """One stage of training.

    Attributes:
        name: as `recipe_named` takes it.
        stage: 1 or 2.
        loss: terms and weights.
        learning_rates: by part, at the top of the schedule; a part without one is frozen.
        batch: windows a step, over all processes and accumulated ones together.
        optimisation: see there.
        window: frames of a window.
        stride: frames from one window to the next; windows never cross episodes, tails are dropped.
        presence: what the presence head learns: the labels' presence, or, where an episode carries
            it, the visible share of a hand.
        init: what the run must begin with: "random", "pretrained", or None for either.
        sources: "one" refuses data of several sources.
        augment: change the colours of windows at random.
        views: mirror, crop, turn, hasten and reverse windows at random, labels alike.
        refine: from here on, the camera head's path is made exact by pictures.

    Raises:
        ValueError: a number out of range, an unknown part, or nothing to train.

    """

    name: str
    stage: Literal[1, 2]
    loss: LossSettings
    learning_rates: Mapping[Part, float]
    batch: int
    optimisation: Optimisation = field(default_factory=Optimisation)
    window: int = WINDOW_LENGTH
    stride: int = WINDOW_LENGTH
    presence: Presence = "presence"
    init: Init | None = None
    sources: Sources = "all"
    augment: bool = False
    views: bool = False
    refine: bool = False

    def __post_init__(self) -> None:
        for name in ("batch", "window", "stride"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: expected at least 1, got {getattr(self, name)}")
        if unknown := sorted(set(self.learning_rates) - set(PARTS)):
            raise ValueError(f"learning_rates: expected parts of {PARTS}, got {unknown[0]!r}")
        if not any(rate > 0 for rate in self.learning_rates.values()):
            raise ValueError(f"learning_rates: expected a part to train, got {self.learning_rates}")

    @property
    def trained(self) -> tuple[Part, ...]:
        """Parts that are not frozen."""
        return tuple(part for part in PARTS if self.learning_rates.get(part, 0) > 0)

    def scaled(self, factor: float) -> Recipe:
        """Multiply all learning rates."""
        rates = {part: rate * factor for part, rate in self.learning_rates.items()}
        return replace(self, learning_rates=MappingProxyType(rates))


_RATES_1: Final[Mapping[Part, float]] = MappingProxyType(
    {
        "encoder": 5e-5,
        "aggregator": 5e-5,
        "camera_head": 1e-4,
        "fov_head": 1e-4,
        "hand_head": 5e-4,
        "presence_head": 5e-4,
    }
)
_RATES_EVEN: Final[Mapping[Part, float]] = MappingProxyType(dict.fromkeys(PARTS, 5e-4))
_RATES_2: Final[Mapping[Part, float]] = MappingProxyType({"camera_head": 5e-5})


def release_stage1() -> Recipe:
    """Stage 1 as the public release trains it: everything, on all terms but the world's."""
    loss = LossSettings(MappingProxyType(RELEASE_STAGE_1), per_window=True)
    return Recipe("stage1", 1, loss, _RATES_1, batch=1)


def release_stage2() -> Recipe:
    """Stage 2: the camera head alone, on exact camera paths."""
    loss = LossSettings(MappingProxyType(RELEASE_STAGE_2), per_window=True)
    return Recipe("stage2", 2, loss, _RATES_2, batch=4)


def paper_stage1() -> Recipe:
    """Stage 1 as the paper tells it: with the world loss, hands weighted by observability."""
    base = release_stage1()
    weights = MappingProxyType({**base.loss.weights, **WORLD})
    loss = replace(base.loss, weights=weights, observability=True)
    return replace(base, name="paper-stage1", loss=loss)


def paper_stage2() -> Recipe:
    """Stage 2 of the paper, which is the release's."""
    return replace(release_stage2(), name="paper-stage2")


_BASES: Final[Mapping[str, Callable[[], Recipe]]] = MappingProxyType(
    {
        "stage1": release_stage1,
        "stage2": release_stage2,
        "paper-stage1": paper_stage1,
        "paper-stage2": paper_stage2,
    }
)


def _without(group: str) -> Callable[[Recipe], Recipe]:
    return lambda given: replace(given, loss=given.loss.without(group))


def _with(weights: Mapping[str, float]) -> Callable[[Recipe], Recipe]:
    def weighted(given: Recipe) -> Recipe:
        made = MappingProxyType({**given.loss.weights, **weights})
        return replace(given, loss=replace(given.loss, weights=made))

    return weighted


OPTIONS: Final[Mapping[str, Callable[[Recipe], Recipe]]] = MappingProxyType(
    {
        "world": _with(WORLD),
        "motion": _with(MOTION),
        "guide": _with(GUIDE),
        "no-world": _without("world"),
        "no-image": _without("image"),
        "random": lambda given: replace(given, init="random"),
        "pretrained": lambda given: replace(given, init="pretrained"),
        "one-source": lambda given: replace(given, sources="one"),
        "visible": lambda given: replace(given, presence="visible"),
        "augment": lambda given: replace(given, augment=True),
        "views": lambda given: replace(given, views=True),
        "refine": lambda given: replace(given, refine=True),
        "even": lambda given: replace(given, learning_rates=_RATES_EVEN),
        "scratch": lambda given: replace(given, init="random", learning_rates=_RATES_EVEN),
        "fp32": lambda given: replace(given, optimisation=replace(given.optimisation, bf16=False)),
    }
)
"""What may follow a base, each after a ``+``: world and no-world (the paper's fourth objective),
motion (camera terms weigh as much as the hands': see `losses_mint.MOTION`), guide (attention is
drawn to the hands: see `losses_mint.GUIDE`), no-image, random and pretrained (what to begin with),
one-source, visible (presence learns the visible share of a hand), augment (colours), views (windows
mirrored, cropped, turned, faster, backwards), refine (the camera head's path is made exact by
pictures: see `MintConfig.camera_refinement`), even (one learning rate for all parts, 5e-4), scratch
(random and even: nothing is known yet that a lower rate would keep), fp32 (no autocast)."""


def recipe_named(name: str) -> Recipe:
    """Look a recipe up: a base, and options after ``+``.

    >>> recipe_named("paper-stage1+no-world+random").init
    'random'

    Raises:
        ValueError: no such base or option; lists those that exist.

    """
    base, *options = name.split("+")
    if base not in _BASES:
        raise ValueError(f"recipe: expected {', '.join(_BASES)} (and +options), got {name!r}")
    made = _BASES[base]()
    for option in options:
        if option not in OPTIONS:
            raise ValueError(f"recipe {name!r}: expected options {sorted(OPTIONS)}, got {option!r}")
        made = OPTIONS[option](made)
    if made.stage == 2 and any(n.startswith("world/") for n in made.loss.weights):
        raise ValueError(
            f"recipe {name!r}: the hands are frozen in stage 2: expected no world loss"
        )
    if made.stage == 1 and made.refine:
        raise ValueError(
            f"recipe {name!r}: pictures refine what a camera head has learned: expected +refine "
            "after stage2 alone"
        )
    return replace(made, name=name)
