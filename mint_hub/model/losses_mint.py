"""Every term that training minimises: pure functions over the outputs of a window and its truth.

    case = LossCase(prediction, labels, settings)
    loss, terms = total(case)

Shape letters: B windows, T frames, 2 hands (left, right), 21 keypoints. Poses are world-to-camera
and re-anchored: the world is the camera of the window's first frame. Everything is computed in
float32 (float64 stays, for checks of gradients). A masked mean is the sum over what counts over
max(count, 1): nothing that is masked changes a value or a gradient.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from ..geometry import camera_state, hand_state
from ..geometry.camera import fov_vh_to_K, project
from ..geometry.hand_model import HandModel
from ..geometry.rotations import quat_xyzw_to_matrix

LABELS = {
    "pose_encoding": (9,),
    "hand_state": (2, 109),
    "presence": (2,),
}
"""What labels must hold: name, and its shape after (B, T)."""

ATTENTION_TERM = "image/attention"
"""Where the heads of hands and presence look; the one term that needs more than their outputs."""

OPTIONAL_LABELS = (
    "presence_target",
    "hands_known",
    "translation_std",
    "velocity_std",
    "acceleration_std",
)


@dataclass(frozen=True)
class LossSettings:
    """Which terms count how much.

    Attributes:
        weights: of terms by name (`TERMS`), each with its group's factor multiplied in.
        observability: weight hand and world terms by the predicted probability of presence,
            detached (the paper's recipe), beside the truth's presence.
        per_window: a loss is the mean over windows of their own masked means, so that it does not
            depend on which windows share a batch, process or accumulation step. Without it, masked
            means run over the batch; for one window both are the same.

    Raises:
        ValueError: a term that does not exist, or a weight that is no number of at least 0.
    """

    weights: Mapping[str, float]
    observability: bool = False
    per_window: bool = False

    def __post_init__(self) -> None:
        unknown = sorted(set(self.weights) - set(TERMS))
        if unknown:
            raise ValueError(f"weights: expected terms of {sorted(TERMS)}, got {unknown[0]!r}")
        for name, weight in self.weights.items():
            if not (weight >= 0 and math.isfinite(weight)):
                raise ValueError(f"weights[{name!r}]: expected a number >= 0, got {weight}")

    def without(self, group: str) -> "LossSettings":
        """Leave a group of terms out, such as "image"."""
        kept = {n: w for n, w in self.weights.items() if n.split("/")[0] != group}
        return replace(self, weights=kept)


@dataclass(frozen=True, eq=False)
class LossCase:
    """A prediction, its truth, and what several terms share, made when first asked for.

    Attributes:
        prediction: ``pose_encoding`` (B, T, 9), ``hand_state`` (B, T, 2, 109) and
            ``presence_logits`` (B, T, 2), by name; for the attention term also
            ``patch_attention`` (B, T, 2, Q, N), how much of each of Q queries of a hand goes to
            each of N patches, row by row.
        labels: ``pose_encoding``, ``hand_state``, ``presence`` (B, T, 2) bool; where wanted
            ``presence_target`` (B, T, 2) in 0..1 (default: presence), ``hands_known`` (B,) bool
            (False: the record knows no hands, so that no hand and presence term sees it), and
            standard deviations (B, 3) of translations, their velocities and accelerations.
        settings: see `LossSettings`.
        image_size_hw: of the network's pictures, for image terms.
        grid_hw: its patches, for the attention term.
        shape_space: what the shape numbers mean, "mano" or "mint".
        hand_model: turns states into keypoints, for image terms; the default of the shape space.

    Raises:
        ValueError: labels that lack a name, have another shape, or hold NaN where they count.
    """

    prediction: Mapping[str, Tensor]
    labels: Mapping[str, Tensor]
    settings: LossSettings
    image_size_hw: tuple[int, int] = (378, 518)
    grid_hw: tuple[int, int] = (27, 37)
    shape_space: str = "mint"
    hand_model: HandModel | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        _check_labels(self.labels, tuple(self.prediction["pose_encoding"].shape[:2]))

    # --- camera: (B, T, ...) ---

    @cached_property
    def translation(self) -> "Pair":
        """(B, T, 3) metres, world-to-camera."""
        return self._pair("pose_encoding", lambda x: camera_state.unpack(x).translation)

    @cached_property
    def rotation(self) -> "Pair":
        """(B, T, 3, 3) world-to-camera."""
        return self._pair(
            "pose_encoding",
            lambda x: quat_xyzw_to_matrix(camera_state.unpack(x).quat_xyzw, check=False),
        )

    @cached_property
    def fov(self) -> "Pair":
        """(B, T, 2) radians (vertical, horizontal)."""
        return self._pair("pose_encoding", lambda x: camera_state.unpack(x).fov_vh_rad)

    @cached_property
    def camera_velocity(self) -> "Pair":
        """t_{k+1} - (R_{k+1} R_k^T) t_k, (B, T-1, 3)."""

        def velocity(t: Tensor, R: Tensor) -> Tensor:
            return t[:, 1:] - (turns(R) @ t[:, :-1, :, None])[..., 0]

        return Pair(*map(velocity, self.translation, self.rotation))

    def std(self, name: str) -> Tensor:
        """(B, 1, 3), one where the labels have none."""
        given = self.labels.get(name)
        like = self.translation.mine
        if given is None:
            return torch.ones_like(like[:, :1])
        return given.to(like)[:, None].expand_as(like[:, :1])

    # --- hands: (B, T, 2, ...) ---

    @cached_property
    def presence_logits(self) -> Tensor:
        """(B, T, 2), as predicted."""
        return _real(self.prediction["presence_logits"])

    @cached_property
    def known(self) -> Tensor:
        """(B, T, 2) 1 where the record knows the hands, else 0."""
        given, like = self.labels.get("hands_known"), self.presence_logits
        if given is None:
            return torch.ones_like(like)
        return given.to(like)[:, None, None].expand_as(like)

    @cached_property
    def present(self) -> Tensor:
        """(B, T, 2) 1 where the truth has a hand."""
        return self.labels["presence"].to(self.presence_logits) * self.known

    @cached_property
    def hand_weight(self) -> Tensor:
        """(B, T, 2) how much a hand's frame counts."""
        if self.settings.observability:
            return self.present * self.presence_logits.detach().sigmoid()
        return self.present

    @cached_property
    def hands(self) -> "Pair":
        """(B, T, 2, 109)."""
        # A hand that is not there holds anything, also NaN: it is replaced, not multiplied away.
        there = self.present[..., None] > 0
        truth = _real(self.labels["hand_state"])
        truth = torch.where(there, truth, hand_state.absent(like=truth))
        return Pair(_real(self.prediction["hand_state"]), truth)

    @cached_property
    def wrist(self) -> "Pair":
        """(B, T, 2, 3) metres, camera frame."""
        return self._hand(lambda state: state.translation)

    @cached_property
    def orientation(self) -> "Pair":
        """(B, T, 2, 3, 3) camera from hand."""
        return self._hand(lambda state: state.orientation(check=False))

    @cached_property
    def pose(self) -> "Pair":
        """(B, T, 2, 15, 3, 3) joint rotations, as stored."""
        return self._hand(lambda state: state.joint_rotations(check=False))

    @cached_property
    def shape(self) -> "Pair":
        """(B, T, 2, 10)."""
        return self._hand(lambda state: state.shape_params)

    @cached_property
    def orientation_rot6d(self) -> "Pair":
        """(B, T, 2, 6), as predicted."""
        return self._hand(lambda state: state.orientation_rot6d_rows)

    @cached_property
    def pose_rot6d(self) -> "Pair":
        """(B, T, 2, 90), as predicted."""
        return self._hand(lambda state: state.joint_rot6d_rows.flatten(-2))

    @cached_property
    def joints(self) -> "Pair":
        """(B, T, 2, 21, 3) metres, camera frame; of absent true hands anything finite."""
        model = self.hand_model or default_hand(self.shape_space)
        space: Any = self.shape_space
        return self.hands.over(lambda x: model.keypoints(x, shape_space=space, check=False))

    @cached_property
    def true_K(self) -> Tensor:  # noqa: N802
        """(B, T, 3, 3) pixels, of the true field of view."""
        fov = self.fov.true.clamp(math.radians(1.0), math.pi - 1e-3)
        return fov_vh_to_K(fov, self.image_size_hw, check=False)

    @cached_property
    def joints_on_screen(self) -> tuple[Tensor, Tensor]:
        """True joints in pixels (B, T, 2, 21, 2), and which are of a hand and on screen."""
        uv, z = project(self.joints.true, self.true_K)
        height, width = self.image_size_hw
        on_screen = (z > 0) & (uv >= 0).all(-1) & (uv[..., 0] < width) & (uv[..., 1] < height)
        return uv, on_screen & (self.present[..., None] > 0)

    @cached_property
    def world_wrist(self) -> "Pair":
        """p_w = R^T (p_c - t), each under its own camera, (B, T, 2, 3)."""

        def place(p: Tensor, R: Tensor, t: Tensor) -> Tensor:
            return (R.mT[:, :, None] @ (p - t[:, :, None])[..., None])[..., 0]

        return Pair(*map(place, self.wrist, self.rotation, self.translation))

    @cached_property
    def world_orientation(self) -> "Pair":
        """Q_w = R^T Q_c, each under its own camera, (B, T, 2, 3, 3)."""
        return Pair(
            *(R.mT[:, :, None] @ Q for Q, R in zip(self.orientation, self.rotation, strict=True))
        )

    def mean(self, values: Tensor, weight: Tensor | None = None) -> Tensor:
        """Masked mean of values (B, ...) under a weight that broadcasts; scalar."""
        if weight is None:
            weight = torch.ones_like(values)
        # what counts nothing may be anything, also NaN
        spread = weight.reshape(*weight.shape, *(1,) * (values.ndim - weight.ndim))
        spread = spread.expand_as(values)
        values = torch.where(spread > 0, values, 0.0) * spread
        axes = tuple(range(1, values.ndim)) if self.settings.per_window else None
        sums, counts = values.sum(axes), spread.sum(axes)
        return (sums / counts.clamp_min(1.0)).mean()

    def _pair(self, name: str, part: Callable[[Tensor], Any]) -> "Pair":
        return Pair(part(_real(self.prediction[name])), part(_real(self.labels[name])))

    def _hand(self, part: Callable[[hand_state.HandState], Any]) -> "Pair":
        return self.hands.over(lambda states: part(hand_state.unpack(states)))


class Pair(tuple[Tensor, Tensor]):
    """(prediction, truth) of one quantity."""

    def __new__(cls, mine: Tensor, true: Tensor) -> "Pair":  # noqa: D102
        return super().__new__(cls, (mine, true))

    @property
    def mine(self) -> Tensor:
        """The prediction's."""
        return self[0]

    @property
    def true(self) -> Tensor:
        """The truth's."""
        return self[1]

    def over(self, function: Callable[[Tensor], Tensor]) -> "Pair":
        """Apply to both."""
        return Pair(function(self[0]), function(self[1]))

    def l1(self) -> Tensor:
        """Difference without sign."""
        return (self[0] - self[1]).abs()

    def geo(self) -> Tensor:
        """Rotation distance, radians, (...) of (..., 3, 3)."""
        return rotation_distance(self[0], self[1])


def rotation_distance(A: Tensor, B: Tensor) -> Tensor:
    """atan2(sqrt(|R - R^T|_F^2 + 1e-8) / (2 sqrt 2), (tr R - 1) / 2) with R = A B^T: radians.

    Smooth everywhere; of equal rotations it is 3.5e-5 rather than 0.
    """
    R = A @ B.mT
    sine = ((R - R.mT).square().sum((-1, -2)) + 1e-8).sqrt() / (2 * math.sqrt(2))
    return torch.atan2(sine, (R.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2)


def steps(x: Tensor) -> Tensor:
    """x_{k+1} - x_k over frames, (B, T, ...) -> (B, T-1, ...)."""
    return x[:, 1:] - x[:, :-1]


def turns(R: Tensor) -> Tensor:
    """R_{k+1} R_k^T over frames, (B, T, ..., 3, 3) -> (B, T-1, ..., 3, 3)."""
    return R[:, 1:] @ R[:, :-1].mT


def both(mask: Tensor) -> Tensor:
    """Product of neighbouring masks, (B, T, ...) -> (B, T-1, ...)."""
    return mask[:, 1:] * mask[:, :-1]


def three(mask: Tensor) -> Tensor:
    """Product of three masks in a row, (B, T, ...) -> (B, T-2, ...)."""
    return mask[:, 2:] * mask[:, 1:-1] * mask[:, :-2]


# --- terms ----------------------------------------------------------------------------------------


def _camera_path(t: Tensor, R: Tensor) -> Tensor:
    """Camera centres from the first one, over their RMS displacement + 1e-6, (B, T, 3)."""
    centres = -(R.mT @ t[..., None])[..., 0]
    moved = centres - centres[:, :1]
    size = moved.square().sum(-1).mean(1).clamp_min(1e-24).sqrt() + 1e-6
    return moved / size[:, None, None]


def _scale_aligned(case: LossCase) -> Tensor:
    paths = Pair(*map(_camera_path, case.translation, case.rotation))
    return case.mean(paths.l1())


def _presence(case: LossCase) -> Tensor:
    target = case.labels.get("presence_target")
    target = (case.labels["presence"] if target is None else target).to(case.presence_logits)
    target = torch.where(case.known > 0, target, 0.0)
    value = torch.nn.functional.binary_cross_entropy_with_logits(
        case.presence_logits, target, reduction="none"
    )
    return case.mean(value, case.known)


def _charbonnier(case: LossCase) -> Tensor:
    bend = steps(steps(case.wrist.mine))
    return case.mean((bend.square() + 1e-6).sqrt() - 1e-3, three(case.hand_weight))


def _reprojection(case: LossCase) -> Tensor:
    """Mean error of the on-screen true joints, pixels of the network's image."""
    diagonal = math.hypot(*case.image_size_hw)
    uv, z = project(case.joints.mine, case.true_K)
    uv_true, counts = case.joints_on_screen
    valid = counts & (z > 0)
    offset = torch.where(valid[..., None], uv - uv_true, diagonal)
    error = torch.linalg.vector_norm(offset, dim=-1).clamp_max(diagonal)
    seen = (case.presence_logits.detach() >= 0)[..., None]
    error = torch.where(seen & valid, error, diagonal)
    return case.mean(error, counts.to(error))


def _attention(case: LossCase) -> Tensor:
    """-log of the attention that goes to patches with a joint of the hand, mean over queries."""
    given = case.prediction.get("patch_attention")
    if given is None:
        raise ValueError(f"{ATTENTION_TERM}: expected patch_attention in the prediction, got none")
    uv, counts = case.joints_on_screen
    rows, columns = case.grid_hw
    size = uv.new_tensor(case.image_size_hw).flip(0)  # (width, height)
    place = (uv / size * uv.new_tensor((columns, rows))).floor().long()
    index = torch.where(counts, place[..., 1] * columns + place[..., 0], rows * columns)
    holds = torch.zeros(*counts.shape[:-1], rows * columns + 1, device=uv.device, dtype=uv.dtype)
    holds = holds.scatter(-1, index, 1.0)[..., :-1]  # (B, T, 2, N)
    share = (_real(given) * holds[..., None, :]).sum(-1)  # (B, T, 2, Q)
    return case.mean(-(share + 1e-4).log(), counts.any(-1).to(share))


def _hand_mean(name: str, kind: str, order: int, truth: bool = True) -> "Term":
    """A term of hands: ``kind`` "l1" or "geo", of values (0), velocities (1), accelerations (2)."""
    change = turns if kind == "geo" else steps
    masks: tuple[Callable[[Tensor], Tensor], ...] = (lambda m: m, both, three)

    def term(case: LossCase) -> Tensor:
        pair: Pair = getattr(case, name)
        for _ in range(order):
            pair = pair.over(change)
        values = pair.geo() if kind == "geo" else pair.l1() if truth else pair.mine.abs()
        return case.mean(values, masks[order](case.hand_weight))

    return term


def _hand_terms() -> "dict[str, Term]":
    terms: dict[str, Term] = {}
    for order, suffix in ((0, ""), (1, "_vel"), (2, "_acc")):
        terms[f"hand/transl{suffix}_l1"] = _hand_mean("wrist", "l1", order)
        for name, part in (("orient", "orientation"), ("pose", "pose")):
            terms[f"hand/{name}{suffix}_geo"] = _hand_mean(part, "geo", order)
            terms[f"hand/{name}_6d{suffix}_l1"] = _hand_mean(f"{part}_rot6d", "l1", order)
    terms["hand/betas_l1"] = _hand_mean("shape", "l1", 0)
    terms["hand/betas_vel_l1"] = _hand_mean("shape", "l1", 1)
    terms["hand/betas_consistency_l1"] = _hand_mean("shape", "l1", 1, truth=False)
    terms["hand/transl_acc_smooth_charbonnier"] = _charbonnier
    for order, suffix in ((0, ""), (1, "_vel")):
        terms[f"world/transl{suffix}_l1"] = _hand_mean("world_wrist", "l1", order)
        terms[f"world/orient{suffix}_geo"] = _hand_mean("world_orientation", "geo", order)
    return terms


Term = Callable[[LossCase], Tensor]

TERMS: dict[str, Term] = {
    "camera/trans_l1": lambda c: c.mean(c.translation.l1() / c.std("translation_std")),
    "camera/trans_scale_aligned_l1": _scale_aligned,
    "camera/rot_geo": lambda c: c.mean(c.rotation.geo()),
    "camera/trans_vel_l1": lambda c: c.mean(c.camera_velocity.l1() / c.std("velocity_std")),
    "camera/rot_vel_geo": lambda c: c.mean(c.rotation.over(turns).geo()),
    "camera/trans_acc_l1": lambda c: c.mean(
        c.translation.over(steps).over(steps).l1() / c.std("acceleration_std")
    ),
    "fov/fov_l1": lambda c: c.mean(c.fov.l1()),
    "fov/fov_vel_l1": lambda c: c.mean(c.fov.over(steps).l1()),
    "presence/bce": _presence,
    **_hand_terms(),
    "image/reprojection": _reprojection,
    ATTENTION_TERM: _attention,
}
"""Every term by name, "group/term"; a term that needs more frames than there are is 0."""

RELEASE_STAGE_1 = {
    "camera/trans_l1": 0.025,
    "camera/trans_scale_aligned_l1": 0.25,
    "camera/rot_geo": 0.5,
    "camera/rot_vel_geo": 0.25,
    "fov/fov_l1": 2 * 1.0,
    "fov/fov_vel_l1": 2 * 0.05,
    "presence/bce": 2.0,
    "hand/transl_l1": 2.0,
    "hand/orient_geo": 1.0,
    "hand/pose_geo": 1.0,
    "hand/betas_l1": 0.3,
    "hand/betas_consistency_l1": 0.2,
    "hand/transl_vel_l1": 0.25,
    "hand/orient_vel_geo": 0.25,
    "hand/transl_acc_l1": 0.25,
    "hand/orient_acc_geo": 0.1,
    "image/reprojection": 0.01,
}
"""Weights of the first stage of the public release, group factors multiplied in."""

RELEASE_STAGE_2 = {
    "camera/trans_l1": 2 * 1.0,
    "camera/rot_geo": 2 * 1.0,
    "camera/trans_vel_l1": 2 * 0.5,
    "camera/rot_vel_geo": 2 * 0.5,
}
"""Weights of the second stage, which trains the camera head alone."""

WORLD = {
    "world/transl_l1": 1.0,
    "world/orient_geo": 0.5,
    "world/transl_vel_l1": 0.25,
    "world/orient_vel_geo": 0.25,
}
"""Weights of the paper's fourth objective; the paper gives none, these are ours."""


MOTION = {
    "camera/trans_l1": 0.25,
    "camera/trans_vel_l1": 0.25,
    "camera/rot_geo": 5.0,
    "camera/rot_vel_geo": 10.0,
}
"""Camera weights, in place of the release's, for a network that must first learn to see motion: a
camera turns by hundredths of a radian from frame to frame, so that its terms are a hundredth of the
hands' otherwise. Ours."""


GUIDE = {ATTENTION_TERM: 0.5}
"""Draws the attention of each hand's queries to the patches that hold its joints. A network that
begins from nothing found the hands within 14,000 frames so, and not within 37,000 without. Ours."""


def total(case: LossCase) -> tuple[Tensor, dict[str, Tensor]]:
    """The weighted sum of the case's terms, and each term with a weight above 0, unweighted.

    Returns:
        Scalar, and scalars by name.
    """
    with torch.autocast(case.prediction["pose_encoding"].device.type, enabled=False):
        weights = {name: weight for name, weight in case.settings.weights.items() if weight > 0}
        terms = {name: TERMS[name](case) for name in weights}
        zero = case.translation.mine.new_zeros(())
        loss = sum((weights[name] * value for name, value in terms.items()), zero)
    return loss, terms


def camera_loss(case: LossCase, pose_encoding: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
    """As `total`, of the camera's terms, for another path (B, T, 9) of the same windows."""
    weights = {n: weight for n, weight in case.settings.weights.items() if n.startswith("camera/")}
    prediction = {**case.prediction, "pose_encoding": pose_encoding}
    settings = replace(case.settings, weights=weights)
    return total(replace(case, prediction=prediction, settings=settings))


def default_hand(shape_space: str) -> HandModel:
    """The user's MANO hand for the "mano" space where there is one, else the template."""
    return HandModel.default() if shape_space == "mano" else HandModel.template()


def _real(x: Tensor) -> Tensor:
    return x if x.dtype == torch.float64 else x.float()


def _check_labels(labels: Mapping[str, Tensor], frames: tuple[int, ...]) -> None:
    unknown = sorted(set(labels) - set(LABELS) - set(OPTIONAL_LABELS))
    if unknown:
        expected = sorted({*LABELS, *OPTIONAL_LABELS})
        raise ValueError(f"labels: expected names of {expected}, got {unknown[0]!r}")
    for name, tail in LABELS.items():
        if name not in labels:
            raise ValueError(f"labels[{name!r}]: expected a tensor (B, T, ...), got none")
        if tuple(labels[name].shape) != (*frames, *tail):
            got = tuple(labels[name].shape)
            raise ValueError(f"labels[{name!r}]: expected shape {(*frames, *tail)}, got {got}")
    if torch.compiler.is_compiling():
        return
    there = labels["presence"].bool()
    if (known := labels.get("hands_known")) is not None:
        there = there & known.bool()[:, None, None]
    for name, values in (
        ("pose_encoding", labels["pose_encoding"]),
        ("hand_state", labels["hand_state"][there]),
    ):
        if not torch.isfinite(values).all():
            raise ValueError(f"labels[{name!r}]: expected finite numbers, got NaN or infinity")
