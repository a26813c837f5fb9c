"""Camera-frame hands, coverage-aware: a missed hand pays a penalty in every pose number.

Sources: the MINT paper's protocol (its Table 1) for the first nine numbers of ``HAND_MEASURES``;
the others are ours, because that protocol never counts a false alarm on an off-screen hand.

Words. A true hand is *present* when it is valid and one of its 21 joints is on screen: z > 0.01 m
and 0 <= u < W, 0 <= v < H. Per hand and frame: TP present and predicted, FN present and not
predicted, FP predicted where the truth is not valid. A valid hand off screen is none of these.
Pose numbers average over TP and FN; false alarms cost nothing there.

Legend: T frames, 2 hands (left first), 21 keypoints in OpenPose's order, camera axes, metres.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from mint_hub.geometry.additive_metrics import (
    Additive,
    Bools,
    Floats,
    Measure,
    checked_flags,
    checked_floats,
    finite_where,
    ratio,
)
from mint_hub.geometry.camera import MIN_DEPTH_M, on_screen, project, require_image_size
from mint_hub.geometry.hand_model import HandModel, ShapeSpace
from mint_hub.geometry.hand_state import absent, unpack
from mint_hub.geometry.rigid import umeyama
from mint_hub.geometry.rotations import geodesic_angle

HAND_MEASURES = (
    Measure("FAcc", "", 1.0),
    Measure("Recall", "", 1.0),
    Measure("F1", "", 1.0),
    Measure("MPJPE-p", "mm", 0.0),
    Measure("PA-MPJPE-p", "mm", 0.0),
    Measure("EPE-p", "px", 0.0),
    Measure("GO-p", "deg", 0.0),
    Measure("CT-p", "m", 0.0),
    Measure("Jitter", "mm/frame^2", None),
    Measure("Presence-BA", "", 1.0),
    Measure("CT-along-p", "m", 0.0),
    Measure("CT-lateral-p", "m", 0.0),
    Measure("Jitter-excess", "mm/frame^2", 0.0),
)


@dataclass(frozen=True)
class Hands:
    """Two hands over a clip, in the camera frame; what is not ``present`` may hold anything.

    Attributes:
        joints: (T, 2, 21, 3) metres.
        orientation: (T, 2, 3, 3), camera from wrist.
        translation: (T, 2, 3) metres, the hand state's own.
        present: (T, 2) bool: predicted (logit >= 0), or for the truth, valid.

    """

    joints: Any
    orientation: Any
    translation: Any
    present: Any

    @classmethod
    def from_state(
        cls,
        hand_state: Any,
        present: Any,
        model: HandModel | None = None,
        shape_space: ShapeSpace | None = None,
    ) -> "Hands":
        """Hands of states (T, 2, 109); those not present may hold anything.

        Shape numbers of another ``shape_space`` than the model's are replaced by its mean shape.

        Raises:
            ValueError: wrong shapes, or a degenerate rotation in a hand that is present.

        """
        flags = checked_flags("present", present, np.shape(hand_state)[:-1])
        given = np.asarray(hand_state, dtype=np.float64)
        state = np.where(flags[..., None], given, absent((), like=given))
        hand = unpack(state)
        joints = (model or HandModel.default()).keypoints(state, shape_space)
        return cls(joints, hand.orientation(), hand.translation, flags)


def canonical_joints(model: HandModel | None = None) -> Floats:
    """Joints (2, 21, 3) that stand in for a missed hand: zero pose, mean shape, no turn."""
    state = absent((2,), like=np.zeros(0))
    return np.asarray((model or HandModel.default()).keypoints(state), dtype=np.float64)


@dataclass(frozen=True)
class HandStatistics(Additive):
    """Sums and counts over hands and frames; ``metrics`` divides.

    ``negatives`` are hand-frames whose true hand is not present: not valid, or off screen.
    """

    facc_correct: int = 0
    facc_frames: int = 0
    tp: int = 0
    fn: int = 0
    fp: int = 0
    negatives: int = 0
    negatives_predicted: int = 0
    off_screen: int = 0
    off_screen_predicted: int = 0
    mpjpe_sum_mm: float = 0.0
    pa_mpjpe_sum_mm: float = 0.0
    epe_sum_px: float = 0.0
    epe_joint_count: int = 0
    go_sum_deg: float = 0.0
    ct_sum_m: float = 0.0
    ct_along_sum_m: float = 0.0
    ct_lateral_sum_m: float = 0.0
    jitter_sum_mm: float = 0.0
    true_jitter_sum_mm: float = 0.0
    jitter_count: int = 0

    @property
    def pose_count(self) -> int:
        """How many hands the pose numbers average over."""
        return self.tp + self.fn

    def metrics(self) -> dict[str, float]:
        """Return the values of ``HAND_MEASURES`` by name, in their units.

        A number nothing was counted for is NaN. Without a present hand that is all of them but F1,
        which is then 0 if there was a false alarm; Jitter needs three TP frames in a row, and
        Presence-BA both kinds: the mean of Recall and the share of ``negatives`` left alone.
        """
        hands = self.pose_count
        kept = ratio(self.negatives - self.negatives_predicted, self.negatives)
        recall = ratio(self.tp, hands)
        jitter = ratio(self.jitter_sum_mm, self.jitter_count)
        return {
            "FAcc": ratio(self.facc_correct, self.facc_frames),
            "Recall": recall,
            "F1": ratio(2 * self.tp, 2 * self.tp + self.fp + self.fn),
            "MPJPE-p": ratio(self.mpjpe_sum_mm, hands),
            "PA-MPJPE-p": ratio(self.pa_mpjpe_sum_mm, hands),
            "EPE-p": ratio(self.epe_sum_px, self.epe_joint_count),
            "GO-p": ratio(self.go_sum_deg, hands),
            "CT-p": ratio(self.ct_sum_m, hands),
            "Jitter": jitter,
            "Presence-BA": (recall + kept) / 2,
            "CT-along-p": ratio(self.ct_along_sum_m, hands),
            "CT-lateral-p": ratio(self.ct_lateral_sum_m, hands),
            "Jitter-excess": jitter - ratio(self.true_jitter_sum_mm, self.jitter_count),
        }


def hand_statistics(
    predicted: Hands,
    truth: Hands,
    K: Any,
    image_size_hw: tuple[int, int],
    canonical: Any,
    predicted_K: Any = None,
    only: Any = None,
) -> HandStatistics:
    """Score a clip's predicted hands against the truth.

    Pose errors of a TP hand, and what an FN pays instead:

    - MPJPE-p: mean over 21 joints, both sides minus their wrist; FN: with the canonical hand.
    - PA-MPJPE-p: the same after a Sim(3) fit (Umeyama 1991); FN: the canonical hand, not fitted.
      Predicted joints that all coincide count as the true joints' mean.
    - EPE-p: pixels, every on-screen true joint, at most the image diagonal; FN: the diagonal.
    - GO-p: geodesic angle of the wrist orientation; FN: from the identity.
    - CT-p: distance of translations; FN: the true translation's length.
    - CT-along-p, CT-lateral-p: that error along and across the ray to the true translation (the z
      axis where that is zero); FN: the true translation's length in both, for a miss must not be
      the best answer across the ray.
    - Jitter: norm of the second difference over time, mean over joints, at frames whose neighbours
      are TP too. Jitter-excess: less the truth's at the same frames; negative is smoother than it.

    Args:
        predicted: T frames; ``present`` is what the prediction says.
        truth: T frames; ``present`` is whether the truth is valid.
        K: (3, 3) or (T, 3, 3) pixels, the truth's.
        image_size_hw: (height, width) pixels.
        canonical: (2, 21, 3) metres, see ``canonical_joints``.
        predicted_K: as K; projects the predicted joints instead of K, for scores with predicted
            intrinsics.
        only: (T, 2) bool, hand-frames that count (a stratum); FAcc then looks at those alone. None
            counts all. The statistics of a partition add up to the whole's, but for FAcc.

    Returns:
        Statistics in which nothing is NaN; without a present hand their pose sums and counts are 0.

    Raises:
        ValueError: no frame, shapes that disagree, presence that is not boolean, numbers that are
            not finite in a predicted or a valid hand, K or the canonical hand.

    """
    frames = _num_frames(truth)
    guess, true = _checked("predicted", predicted, frames), _checked("truth", truth, frames)
    size_hw = require_image_size(image_size_hw)
    K_true = _intrinsics("K", K, frames)
    K_guess = K_true if predicted_K is None else _intrinsics("predicted_K", predicted_K, frames)
    stand_in = checked_floats("canonical", canonical, (2, 21, 3))
    if not np.isfinite(stand_in).all():
        raise ValueError("canonical: expected finite joints")
    counted = (
        np.ones((frames, 2), bool) if only is None else checked_flags("only", only, (frames, 2))
    )

    pixels, visible = _seen(true, K_true, size_hw)
    present = np.asarray(visible.any(axis=-1))
    frame, hand = np.nonzero(present & counted)
    missed = ~guess.present[frame, hand]
    guess_pixels, _ = project(_in_front(guess.joints), K_guess)
    pixel_error = np.linalg.norm(guess_pixels - pixels, axis=-1)[frame, hand]
    diagonal = float(np.hypot(*size_hw))
    capped = np.where(missed[:, None], diagonal, np.minimum(pixel_error, diagonal))
    seen = visible[frame, hand]
    return (
        _presence_counts(guess.present, true.present, present, counted)
        + _jitter_sums(guess, true, guess.present & present, counted)
        + HandStatistics(epe_sum_px=float(capped[seen].sum()), epe_joint_count=int(seen.sum()))
        + _shape_sums(guess.joints[frame, hand], true.joints[frame, hand], stand_in[hand], missed)
        + _wrist_sums(guess, true, frame, hand, missed)
    )


def present_hands(truth: Hands, K: Any, image_size_hw: tuple[int, int]) -> Bools:
    """Which true hands are present: valid, with a joint on screen; (T, 2).

    Args:
        truth: T frames; ``present`` is whether the truth is valid.
        K: (3, 3) or (T, 3, 3) pixels.
        image_size_hw: (height, width) pixels.

    Raises:
        ValueError: as ``hand_statistics`` does.

    """
    frames = _num_frames(truth)
    true, size_hw = _checked("truth", truth, frames), require_image_size(image_size_hw)
    return np.asarray(_seen(true, _intrinsics("K", K, frames), size_hw)[1].any(axis=-1))


def _seen(true: Hands, K: Floats, image_size_hw: tuple[int, int]) -> tuple[Floats, Bools]:
    """Pixels (T, 2, 21, 2) of joints, and which joints are on screen."""
    pixels, _ = project(_in_front(true.joints), K)
    visible = np.asarray(on_screen(pixels, true.joints[..., 2], image_size_hw))
    return pixels, np.asarray(visible & true.present[..., None])


def _num_frames(truth: Hands) -> int:
    shape = np.shape(truth.present)
    if len(shape) != 2 or shape[0] == 0:
        raise ValueError(f"truth.present: expected (T, 2) with at least one frame, got {shape}")
    return shape[0]


def _checked(name: str, hands: Hands, frames: int) -> Hands:
    """Make everything float64, with zeros where a hand is not present."""
    present = checked_flags(f"{name}.present", hands.present, (frames, 2))
    parts = {
        field: finite_where(
            f"{name}.{field}",
            checked_floats(f"{name}.{field}", getattr(hands, field), (frames, 2, *tail)),
            present,
        )
        for field, tail in (("joints", (21, 3)), ("orientation", (3, 3)), ("translation", (3,)))
    }
    return Hands(**parts, present=present)


def _intrinsics(name: str, K: Any, frames: int) -> Floats:
    values = np.asarray(K, dtype=np.float64)
    if values.shape not in ((3, 3), (frames, 3, 3)) or not np.isfinite(values).all():
        raise ValueError(
            f"{name}: expected finite (3, 3) or ({frames}, 3, 3) pixels, got shape {values.shape}"
        )
    return np.broadcast_to(values, (frames, 3, 3))


def _in_front(joints: Floats) -> Floats:
    """Joints with their depth floored."""
    return np.concatenate([joints[..., :2], np.maximum(joints[..., 2:], MIN_DEPTH_M)], axis=-1)


def _presence_counts(guess: Bools, valid: Bools, present: Bools, counted: Bools) -> HandStatistics:
    """Counts of what was seen, missed and made up; all masks (T, 2)."""
    miss, alarm = present & ~guess & counted, ~valid & guess & counted
    frames = (present & counted).any(axis=1)
    hidden = valid & ~present & counted
    negatives = ~present & counted
    return HandStatistics(
        facc_correct=int((frames & ~(miss | alarm).any(axis=1)).sum()),
        facc_frames=int(frames.sum()),
        tp=int((present & guess & counted).sum()),
        fn=int(miss.sum()),
        fp=int(alarm.sum()),
        negatives=int(negatives.sum()),
        negatives_predicted=int((negatives & guess).sum()),
        off_screen=int(hidden.sum()),
        off_screen_predicted=int((hidden & guess).sum()),
    )


def _shape_sums(guess: Floats, true: Floats, stand_in: Floats, missed: Bools) -> HandStatistics:
    """Wrist-relative joint errors of N hands (N, 21, 3)."""
    true = true - true[:, :1]
    guess = guess - guess[:, :1]
    penalty = _mean_distance_mm(stand_in - stand_in[:, :1], true)
    aligned = umeyama(guess, true, check=False).apply(guess)
    direct, fitted = _mean_distance_mm(guess, true), _mean_distance_mm(aligned, true)
    return HandStatistics(
        mpjpe_sum_mm=float(np.where(missed, penalty, direct).sum()),
        pa_mpjpe_sum_mm=float(np.where(missed, penalty, fitted).sum()),
    )


def _wrist_sums(guess: Hands, true: Hands, frame: Any, hand: Any, missed: Bools) -> HandStatistics:
    """Orientation and translation errors of the hands at (frame, hand), N of them."""
    at = (frame, hand)
    turned = np.where(missed[:, None, None], np.eye(3), guess.orientation[at])
    angle = np.degrees(geodesic_angle(true.orientation[at], turned))
    place = true.translation[at]
    penalty = np.linalg.norm(place, axis=-1)
    away = penalty[:, None] > 0
    ray = np.where(away, place, np.array([0.0, 0.0, 1.0])) / np.where(away, penalty[:, None], 1.0)
    error = guess.translation[at] - place
    along = (error * ray).sum(axis=-1)
    across = np.linalg.norm(error - along[:, None] * ray, axis=-1)
    return HandStatistics(
        go_sum_deg=float(angle.sum()),
        ct_sum_m=float(np.where(missed, penalty, np.linalg.norm(error, axis=-1)).sum()),
        ct_along_sum_m=float(np.where(missed, penalty, np.abs(along)).sum()),
        ct_lateral_sum_m=float(np.where(missed, penalty, across).sum()),
    )


def _jitter_sums(guess: Hands, true: Hands, matched: Bools, counted: Bools) -> HandStatistics:
    """Second differences where a hand is TP in three frames in a row."""
    middle = matched[:-2] & matched[1:-1] & matched[2:] & counted[1:-1]
    bend = [(h.joints[:-2] - 2 * h.joints[1:-1] + h.joints[2:])[middle] for h in (guess, true)]
    still = np.zeros_like(bend[0])
    return HandStatistics(
        jitter_sum_mm=float(_mean_distance_mm(bend[0], still).sum()),
        true_jitter_sum_mm=float(_mean_distance_mm(bend[1], still).sum()),
        jitter_count=int(middle.sum()),
    )


def _mean_distance_mm(a: Floats, b: Floats) -> Floats:
    """Mean over joints of the distances of (N, 21, 3), metres, in mm: (N,)."""
    return 1e3 * np.linalg.norm(a - b, axis=-1).mean(axis=-1)
