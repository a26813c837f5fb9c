"""MediaPipe Hands in a Python of its own; stands alone (see `worker_side`).

Uses the hand tracking graph and the two models that come inside mediapipe 0.10.21, so that nothing
is downloaded. Of one frame the graph gives hands (landmarks, world landmarks, handedness) and,
separately, the palms that its detector saw.
"""

# pyright: reportMissingImports=false

import os
from typing import Any

os.environ.setdefault("GLOG_minloglevel", "2")

import numpy as np
from mediapipe.python.solution_base import SolutionBase

GRAPH = "mediapipe/modules/hand_landmark/hand_landmark_tracking_cpu.binarypb"
MIRRORED_RIGHT = "Left"
"""What the graph calls a right hand: it takes its pictures for mirror images."""

graphs: dict[Any, Any] = {}


def detect(
    arrays: dict[str, Any],
    *,
    restart: bool,
    max_hands: int,
    detection_confidence: float,
    tracking_confidence: float,
    complexity: int,
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Track hands through the next frames of a video.

    Args:
        arrays: "images" (T, H, W, 3) uint8 RGB.
        restart: forget the frames before these.
        max_hands: hands followed at once.
        detection_confidence: least score of a palm, 0 to 1.
        tracking_confidence: least presence of a hand that is followed, 0 to 1.
        complexity: 0 or 1, the lighter or the better landmark model.

    Returns:
        Of N hands: "frame" (N,) int32 counted within these images, "landmarks" (N, 21, 3) float32
        (x and y as fractions of width and height), "landmarks_m" (N, 21, 3) float32 metres,
        "right_score" (N,) float32; of M palms "palm_frame" (M,) int32, "palm_score" (M,) float32
        and "palm_box" (M, 4) float32 (x y x y, fractions).

    """
    graph = ready_graph(max_hands, detection_confidence, tracking_confidence, complexity, restart)
    hands: list[Any] = []
    palms: list[Any] = []
    for index, image in enumerate(arrays["images"]):
        result = graph.process({"image": np.ascontiguousarray(image)})
        found = result.multi_hand_landmarks or []
        world = result.multi_hand_world_landmarks or []
        sides = result.multi_handedness or []
        for each in zip(found, world, sides, strict=True):
            hands.append((index, points(each[0]), points(each[1]), right_score(each[2])))
        for palm in result.palm_detections or []:
            palms.append((index, palm.score[0], box(palm)))
    return {
        "frame": np.array([h[0] for h in hands], np.int32),
        "landmarks": np.array([h[1] for h in hands], np.float32).reshape(-1, 21, 3),
        "landmarks_m": np.array([h[2] for h in hands], np.float32).reshape(-1, 21, 3),
        "right_score": np.array([h[3] for h in hands], np.float32),
        "palm_frame": np.array([p[0] for p in palms], np.int32),
        "palm_score": np.array([p[1] for p in palms], np.float32),
        "palm_box": np.array([p[2] for p in palms], np.float32).reshape(-1, 4),
    }, {}


def ready_graph(
    max_hands: int,
    detection_confidence: float,
    tracking_confidence: float,
    complexity: int,
    restart: bool,
) -> Any:
    """Return the graph with these settings; loaded once, emptied where a new video begins."""
    key = max_hands, detection_confidence, tracking_confidence, complexity
    if key not in graphs:
        threshold = "palmdetectioncpu__TensorsToDetectionsCalculator.min_score_thresh"
        graphs[key] = SolutionBase(
            binary_graph_path=GRAPH,
            side_inputs={
                "model_complexity": complexity,
                "num_hands": max_hands,
                "use_prev_landmarks": True,
            },
            calculator_params={
                threshold: detection_confidence,
                "handlandmarkcpu__ThresholdingCalculator.threshold": tracking_confidence,
            },
            outputs=[
                "multi_hand_landmarks",
                "multi_hand_world_landmarks",
                "multi_handedness",
                "palm_detections",
            ],
        )
    elif restart:
        graphs[key].reset()
    return graphs[key]


def points(landmarks: Any) -> list[tuple[float, float, float]]:
    """Turn a landmark list into (21, 3)."""
    return [(point.x, point.y, point.z) for point in landmarks.landmark]


def right_score(side: Any) -> float:
    """Tell how sure the graph is of a right hand."""
    best = side.classification[0]
    return best.score if best.label == MIRRORED_RIGHT else 1.0 - best.score


def box(detection: Any) -> tuple[float, float, float, float]:
    """Turn a detection's box into x y x y."""
    it = detection.location_data.relative_bounding_box
    return it.xmin, it.ymin, it.xmin + it.width, it.ymin + it.height


if __name__ == "__main__":
    from worker_side import serve

    serve({"detect": detect})
