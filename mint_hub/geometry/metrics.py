"""The door to the metrics: what predictions are scored by, on arrays, without files.

    clip = hand_statistics(predicted, truth, K, image_size_hw, canonical_joints())
    corpus = sum(clips, HandStatistics())
    corpus.metrics()["MPJPE-p"]

Hands in the camera frame: ``hand_metrics``. Camera paths: ``trajectory_metrics``. Hands in the
world: ``world_hand_metrics``. Statistics add, so that processes share a corpus; each kind's
``*_MEASURES`` says the unit and the ideal value of its numbers.
"""

from mint_hub.geometry.additive_metrics import Measure
from mint_hub.geometry.hand_metrics import (
    HAND_MEASURES,
    Hands,
    HandStatistics,
    canonical_joints,
    hand_statistics,
)
from mint_hub.geometry.trajectory_metrics import (
    TRAJECTORY_MEASURES,
    AlignedErrors,
    TrajectoryErrors,
    TrajectoryStatistics,
    align_paths,
    associate,
    trajectory_errors,
)
from mint_hub.geometry.world_hand_metrics import (
    WORLD_MEASURES,
    WorldHands,
    WorldStatistics,
    world_hand_statistics,
)

__all__ = [
    "HAND_MEASURES",
    "TRAJECTORY_MEASURES",
    "WORLD_MEASURES",
    "AlignedErrors",
    "HandStatistics",
    "Hands",
    "Measure",
    "TrajectoryErrors",
    "TrajectoryStatistics",
    "WorldHands",
    "WorldStatistics",
    "align_paths",
    "associate",
    "canonical_joints",
    "hand_statistics",
    "trajectory_errors",
    "world_hand_statistics",
]
