"""The embedded network on real clips, beside a detector that knows nothing of it.

    python benchmarks/real_clips.py VIDEO [VIDEO ...] [--fov-h-deg 98.2] [--model CHECKPOINT]

There is no truth for these clips but their field of view (HOT3D's rectified ones: 98.2 degrees).
MediaPipe Hands, as the labelling cascade runs it, says where hands are in each frame. Of the
network are told: how often it says as many hands as the detector, how often a detected hand has a
predicted one and the reverse, how far their wrists are apart (as a share of the picture's diagonal,
beside that of a wrist that stands still at the detector's own mean place), and the predicted field
of view. The detector misses hands and sees false ones: agreement is no accuracy.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from _report import write_report
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from transformers import pipeline

import mint_hub  # noqa: F401 (registers the pipeline)
from mint_hub.geometry.camera import project
from mint_hub.labelling.records import Detections
from mint_hub.labelling.stages.mediapipe_hands import MediaPipeHands, joined, without_doubles
from mint_hub.loaders.schema import Episode
from mint_hub.loaders.video import iter_frames

NEAR = 0.15
"""A predicted hand is the detected one when their wrists are within this share of the diagonal."""


def detected(frames: list[NDArray[np.uint8]]) -> Detections:
    """Hands of all frames, each found once."""
    stage = MediaPipeHands()
    try:
        parts = [stage.detect(frames[at : at + 64], at) for at in range(0, len(frames), 64)]
    finally:
        stage.close()
    settings = stage.settings
    return without_doubles(joined(parts), settings.double_distance, settings.double_overlap)


def wrists_px(episode: Episode) -> NDArray[np.floating[Any]]:
    """Predicted wrists (T, 2, 2) in pixels; NaN of absent hands."""
    with np.errstate(divide="ignore", invalid="ignore"):
        uv, _ = project(episode.wrist_camera()[..., :3, 3].astype(float), episode.K)
    return np.where(episode.presence[..., None], np.asarray(uv), np.nan)


def agreement(episode: Episode, found: Detections) -> dict[str, Any]:
    """How a prediction and a detector agree; see the module."""
    diagonal = float(np.hypot(*episode.image_size_hw))
    wrists, still = wrists_px(episode), found.landmarks_uv[:, 0].mean(0)
    counts = np.minimum(np.bincount(found.frame, minlength=episode.num_frames), 2)
    offsets: list[float] = []
    plain: list[float] = []
    sides: list[bool] = []
    for frame in range(episode.num_frames):
        here = np.flatnonzero(found.frame == frame)
        there = np.flatnonzero(episode.presence[frame])
        seen = found.landmarks_uv[here, 0]
        apart = np.linalg.norm(seen[:, None] - wrists[frame, there][None], axis=-1) / diagonal
        apart = np.nan_to_num(apart, nan=10.0)  # behind the camera
        rows, columns = linear_sum_assignment(apart)
        offsets += apart[rows, columns].tolist()
        plain += (np.linalg.norm(seen[rows] - still, axis=-1) / diagonal).tolist()
        near = apart[rows, columns] < NEAR
        right = found.right_score[here[rows[near]]] > 0.5
        sides += (right == (there[columns[near]] == 1)).tolist()
    said, known = episode.presence.sum(), len(found.frame)
    near = int(np.sum(np.array(offsets) < NEAR))
    return {
        "frames": episode.num_frames,
        "hands_detected": int(known),
        "hands_predicted": int(said),
        "frames_with_as_many_hands": round(float((counts == episode.presence.sum(1)).mean()), 3),
        "share_of_detected_with_a_prediction_near": round(near / max(known, 1), 3),
        "share_of_predicted_with_a_detection_near": round(near / max(int(said), 1), 3),
        "share_of_near_ones_of_the_same_side": round(float(np.mean(sides)), 3) if sides else None,
        "wrist_distance_share_of_diagonal_median": round(float(np.median(offsets)), 4),
        "the_same_of_a_wrist_that_stands_still": round(float(np.median(plain)), 4),
        "fov_h_deg_median": round(float(np.degrees(np.median(episode.fov_vh_rad[:, 1]))), 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("videos", nargs="+", type=Path)
    parser.add_argument("--fov-h-deg", type=float, default=98.2)
    parser.add_argument("--model")
    args = parser.parse_args()
    pipe = pipeline("egocentric-hands", **({"model": args.model} if args.model else {}))
    results: dict[str, Any] = {}
    for path in args.videos:
        episode = pipe(str(path), fps=None)
        frames = [frame.image for frame in iter_frames(path, fps=None)]
        results[path.name] = agreement(episode, detected(frames))
        print(path.name, results[path.name])
    settings = {"true_fov_h_deg": args.fov_h_deg, "near_share_of_diagonal": NEAR}
    print(write_report("real_clips", results, settings))


if __name__ == "__main__":
    main()
