"""Scores of a network during training: windows of clips that it does not learn from.

Numbers are those of `mint_hub.geometry.metrics`, on single windows, without fusion: a quick look at
the course of a run. Benchmarks of whole clips are `mint-hub evaluate`'s.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from math import isnan
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from mint_hub.geometry import camera_state
from mint_hub.geometry.metrics import (
    Hands,
    HandStatistics,
    TrajectoryStatistics,
    canonical_joints,
    hand_statistics,
    trajectory_errors,
)
from mint_hub.geometry.rigid import inverse
from mint_hub.loaders.schema import Episode
from mint_hub.training.data import TrainingWindows, collate

if TYPE_CHECKING:
    from mint_hub.model.modeling_mint import MintModel


@dataclass(frozen=True)
class WindowScores:
    """What was counted over some windows; parts are added."""

    hands: HandStatistics = field(default_factory=HandStatistics)
    camera: TrajectoryStatistics = field(default_factory=TrajectoryStatistics)
    losses: tuple[float, ...] = ()
    fov_errors_deg: tuple[float, ...] = ()

    def __add__(self, other: WindowScores) -> WindowScores:
        return WindowScores(
            self.hands + other.hands,
            self.camera + other.camera,
            self.losses + other.losses,
            self.fov_errors_deg + other.fov_errors_deg,
        )

    def metrics(self) -> dict[str, float]:
        """Return hand metrics, means over windows of camera metrics, loss and fov error, no NaN."""
        found = dict(self.hands.metrics())
        means = self.camera.metrics(with_degenerate=True)
        found |= {k.removesuffix(" mean"): v for k, v in means.items() if k.endswith(" mean")}
        if self.losses:
            found["loss"] = float(np.mean(self.losses))
            found["fov-error"] = float(np.mean(self.fov_errors_deg))
        return {name: float(value) for name, value in found.items() if not isnan(value)}


def spread_numbers(windows: TrainingWindows, limit: int | None) -> list[int]:
    """Numbers of at most ``limit`` windows, evenly spread; None: of all."""
    count = len(windows)
    if limit is None or limit >= count:
        return list(range(count))
    return np.linspace(0, count - 1, limit).round().astype(int).tolist()


def score_windows(
    model: MintModel, windows: TrainingWindows, numbers: Iterable[int], bf16: bool = False
) -> WindowScores:
    """Run the network over windows, one at a time, and score it; training state is as before."""
    was_training, total = model.training, WindowScores()
    device = next(model.parameters()).device
    model.eval()
    autocast = torch.autocast(device.type, torch.bfloat16) if bf16 else nullcontext()
    try:
        for number in numbers:
            batch = collate([windows.example(number)])
            labels = {k: v.to(device) for k, v in batch["labels"].items()}
            with torch.no_grad(), autocast:
                output = model(pixel_values=batch["pixel_values"].to(device), labels=labels)
            total = total + score_window(output, windows.labels(number))
    finally:
        model.train(was_training)
    return total


def score_window(output: Any, truth: Episode) -> WindowScores:
    """Score the network's output for one window, batch axis of 1, against its record."""
    pose = output.pose_encoding[0].double().cpu().numpy()
    state = output.hand_state[0].double().cpu().numpy()
    present = (output.presence_logits[0] >= 0).cpu().numpy()
    camera = camera_state.unpack(pose)
    path = np.asarray(inverse(camera.T_camera_from_world()))
    model = truth.default_hand_model()
    hands = hand_statistics(
        Hands.from_state(state, present, model),
        Hands.from_state(truth.hand_state.astype(float), truth.presence, model),
        truth.K,
        truth.image_size_hw,
        canonical_joints(model),
    )
    errors = trajectory_errors(path, truth.T_world_from_camera, truth.fps)
    fov = np.abs(camera.fov_vh_rad[:, 1] - truth.fov_vh_rad[:, 1]).mean()
    return WindowScores(
        hands,
        TrajectoryStatistics((errors,)),
        (float(output.loss),),
        (float(np.degrees(fov)),),
    )


def gathered(scores: WindowScores) -> WindowScores:
    """Add up the scores of all processes; every process gets the sum."""
    if not (torch.distributed.is_available() and torch.distributed.is_initialized()):
        return scores
    parts: list[Any] = [None] * torch.distributed.get_world_size()
    torch.distributed.all_gather_object(parts, scores)
    found: Sequence[WindowScores] = parts
    return sum(found, WindowScores())
