"""The door to the metrics: what predictions are scored by, on arrays, without files.

    clip = hand_statistics(predicted, truth, K, image_size_hw, canonical_joints())
    corpus = sum(clips, HandStatistics())
    corpus.metrics()["MPJPE-p"]

Hands in the camera frame: ``hand_metrics``. Camera paths: ``trajectory_metrics``. Hands in the
world: ``world_hand_metrics``. Statistics add, so that processes share a corpus; each kind's
``*_MEASURES`` says the unit and the ideal value of its numbers, ``measure_of`` finds one by name.
"""

from typing import Final

from mint_hub.geometry.additive_metrics import NOTHING, Measure, interval, none_for_nan, number
from mint_hub.geometry.hand_metrics import (
    HAND_MEASURES,
    Hands,
    HandStatistics,
    canonical_joints,
    hand_statistics,
    present_hands,
)
from mint_hub.geometry.trajectory_metrics import (
    TRAJECTORY_MEASURES,
    AlignedErrors,
    TrajectoryErrors,
    TrajectoryStatistics,
    align_paths,
    associate,
    ranked_sequences,
    trajectory_errors,
)
from mint_hub.geometry.world_hand_metrics import (
    WORLD_MEASURES,
    WorldHands,
    WorldStatistics,
    world_hand_statistics,
)

__all__ = [
    "FIELD_OF_VIEW",
    "HAND_MEASURES",
    "NOTHING",
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
    "interval",
    "measure_of",
    "none_for_nan",
    "number",
    "present_hands",
    "ranked_sequences",
    "trajectory_errors",
    "world_hand_statistics",
]

FIELD_OF_VIEW: Final = Measure("Field of view error", "deg", 0.0)
"""Mean over frames of the horizontal field of view's error, without sign."""

_BY_NAME: Final = {
    m.name: m for m in (*HAND_MEASURES, *TRAJECTORY_MEASURES, *WORLD_MEASURES, FIELD_OF_VIEW)
}


def measure_of(column: str) -> Measure:
    """Return what a table's column holds, under the column's name; one not ours has no unit.

    A column is a measure, or its mean or median over sequences, or its value by reading.

    >>> measure_of("RPE-T mean").title, measure_of("EPE-p, known").unit
    ('RPE-T mean (mm)', 'px')
    """
    name = column.removesuffix(" mean").removesuffix(" median")
    found = _BY_NAME.get(name) or _BY_NAME.get(name.partition(",")[0])
    return Measure(column, found.unit, found.ideal) if found else Measure(column, "", None)
