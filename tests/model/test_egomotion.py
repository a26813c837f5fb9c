"""The camera's path made exact by pictures: in scenes drawn exactly, whatever else moves."""

import pytest
import torch
from huggingface_hub.errors import StrictDataclassError

from mint_hub.geometry.hand_state import absent
from mint_hub.geometry.rotations import (
    geodesic_angle,
    matrix_to_quat_xyzw,
    quat_xyzw_to_matrix,
    rotvec_to_matrix,
)
from mint_hub.model.alignment_mint import with_slopes
from mint_hub.model.belief_mint import Belief
from mint_hub.model.egomotion_mint import STRONGEST, Bundle, refine_path
from mint_hub.model.heads_mint import BELIEF, MintPathRefinement
from mint_hub.model.layers_mint import patch_centres
from mint_hub.model.losses_mint import RELEASE_STAGE_2, LossSettings
from tests.small_model import assert_loads_as_saved, small_config, small_model

SIZE = (96, 128)
PATCH = 4
GRID = (SIZE[0] // PATCH, SIZE[1] // PATCH)
PATCHES = GRID[0] * GRID[1]
FOV_VH = torch.tensor([1.1, 1.3])
REFINED = {
    "patch_size": 8,
    "image_size": (48, 64),
    "motion_radius": 3,
    "camera_refinement": "pictures",
}
Poses = tuple[torch.Tensor, torch.Tensor]


def waves(place: torch.Tensor, seed: int) -> torch.Tensor:
    """A smooth grey pattern over space, (..., 3) metres -> (...)."""
    generator = torch.Generator().manual_seed(seed)
    pitch = torch.randn(24, 3, generator=generator) * 22
    phase = torch.rand(24, generator=generator) * 6.3
    return 0.3 * (place @ pitch.T + phase).sin().sum(-1)


def drawn(poses: Poses, seed: int = 0) -> torch.Tensor:
    """A table's top and a wall behind it, (1, T, 1, H, W), seen from T_camera_from_world."""
    R, t = poses
    x, y = patch_centres(SIZE, R.device)
    tan = (FOV_VH / 2).tan()
    ray = torch.stack([x * tan[1], y * tan[0], torch.ones_like(x)], -1) @ R  # (T, E, 3) in world
    eye = -(R.mT @ t[..., None])[..., 0][:, None]
    down = torch.where(ray[..., 1] > 1e-3, (0.25 - eye[..., 1]) / ray[..., 1], torch.inf)
    ahead = (0.9 - eye[..., 2]) / ray[..., 2]
    far = torch.minimum(down, ahead)[..., None]
    return waves(eye + far * ray, seed).unflatten(1, SIZE)[None, :, None]


def path(frames: int, turn: float = 0.015, move: float = 0.008) -> Poses:
    """A camera that turns and moves steadily from the world's origin."""
    steps = torch.arange(frames)[:, None]
    R = rotvec_to_matrix(steps * torch.tensor([0.5, 1.0, 0.3]) * turn)
    return R, steps * torch.tensor([0.8, -0.3, 0.5]) * move


def mistaken(poses: Poses, seed: int = 0) -> Poses:
    """Each motion off by half a degree and 3 mm, in the mean."""
    generator = torch.Generator().manual_seed(seed)
    turn, move = (torch.randn(len(poses[1]), 3, generator=generator) for _ in range(2))
    off = rotvec_to_matrix(0.005 * turn.cumsum(0))
    return off @ poses[0], poses[1] + 0.002 * move.cumsum(0)


def walked(
    pictures: torch.Tensor, believed: Poses, trust: torch.Tensor, sure: float, fov_vh=FOV_VH
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """What `refine_path` says of one window."""
    turn, move, near, near_spread, lens = (torch.tensor([value]) for value in BELIEF)
    R, t = (part[None] for part in believed)
    spreads = turn / sure, move / sure, near, near_spread, lens / sure
    return refine_path(pictures, Belief(R, t, *spreads, trust, fov_vh[None]), PATCH)


def refined(
    pictures: torch.Tensor, believed: Poses, trust: torch.Tensor | None = None, sure: float = 1.0
) -> Poses:
    """The path of a window; beliefs are surer by a factor."""
    trust = torch.full((1, PATCHES), 0.5) if trust is None else trust
    R, t, _ = walked(pictures, believed, trust, sure)
    return R[0], t[0]


def motions(poses: Poses) -> Poses:
    """Turns and motions from frame to frame."""
    R = poses[0][1:] @ poses[0][:-1].mT
    return R, poses[1][1:] - (R @ poses[1][:-1, :, None])[..., 0]


def off(poses: Poses, truth: Poses) -> tuple[float, float]:
    """Mean error of turns in degrees; of motions, lengths fitted, as a share of the truth's."""
    (R, a), (R_true, b) = motions(poses), motions(truth)
    length = (a * b).sum() / (a * a).sum()
    share = (length * a - b).norm(dim=-1).mean() / b.norm(dim=-1).mean()
    return float(geodesic_angle(R, R_true).rad2deg().mean()), float(share)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("frames", [5, 8])
def test_a_mistaken_path_is_mended(frames, seed):
    truth = path(frames)
    believed = mistaken(truth, seed)
    before, after = (
        off(poses, truth) for poses in (believed, refined(drawn(truth, seed), believed))
    )
    assert before[0] > 0.2
    assert after[0] < 0.2 * before[0]
    assert before[1] > 0.2
    assert after[1] < 0.4 * before[1]


@pytest.mark.parametrize("longer", [0.9, 1.12])
def test_a_mistaken_lens_is_mended_where_the_camera_turns(longer):
    truth = path(8, turn=0.02)
    wrong = 2 * ((FOV_VH / 2).tan() / longer).atan()
    trust = torch.full((1, PATCHES), 0.5)
    R, t, fov = walked(drawn(truth), mistaken(truth), trust, 1.0, wrong)
    assert (wrong - FOV_VH).abs().min() > 0.08
    assert (fov[0] - FOV_VH).abs().max() < 0.015
    assert off((R[0], t[0]), truth)[0] < 0.06
    sure = walked(drawn(truth), mistaken(truth), trust, 1e4, wrong)[2]
    torch.testing.assert_close(sure[0], wrong, atol=1e-3, rtol=0)


def test_a_lens_moves_by_its_share_of_what_pictures_and_belief_say():
    """Where both weigh, it ends between them, however many steps are walked."""
    truth = path(8, turn=0.02)
    wrong = 2 * ((FOV_VH / 2).tan() / 1.12).atan()
    R, t = (part[None] for part in mistaken(truth))
    trust, moved = torch.full((1, PATCHES), 0.5), []
    for spread in (1e-4, 3e-3, 8e-2):
        spreads = (torch.tensor([value]) for value in (*BELIEF[:-1], spread))
        _, _, fov = refine_path(drawn(truth), Belief(R, t, *spreads, trust, wrong[None]), PATCH)
        moved.append(float(((fov[0] / 2).tan() / (wrong / 2).tan()).log()[0]))
    assert abs(moved[0]) < 1e-3
    assert 0.01 < moved[1] < 0.05
    assert moved[2] > 0.1


def test_the_steepest_pixels_of_a_patch_are_looked_at():
    generator = torch.Generator().manual_seed(1)
    pictures = torch.randn(2, 3, 1, 32, 48, generator=generator)
    bundle = Bundle(pictures, FOV_VH.expand(2, 2), 8, 0.2)
    slopes = with_slopes(pictures[:, 1])[:, 1:] * torch.tensor([32.0, 48.0])[:, None, None] / 2
    steep = slopes.square().sum(1)  # (B, H, W)
    patches = steep.unflatten(2, (6, 8)).unflatten(1, (4, 8)).permute(0, 1, 3, 2, 4)
    expected = patches.reshape(2, 24, 64).topk(STRONGEST).values.sort(-1).values
    columns, rows = ((bundle.places[:, 0, :, i] + 1) * n / 2 for i, n in enumerate((48, 32)))
    at = rows.floor().long() * 48 + columns.floor().long()
    found = steep.flatten(1).gather(1, at).unflatten(1, (24, STRONGEST)).sort(-1).values
    torch.testing.assert_close(found, expected)


def test_the_first_pose_stays_and_the_world_with_it():
    """Another world gives the same path in that world."""
    truth = path(6)
    believed, pictures = mistaken(truth), drawn(truth)
    R, t = refined(pictures, believed)
    torch.testing.assert_close((R[0], t[0]), (believed[0][0], believed[1][0]), atol=1e-5, rtol=0)
    turn, move = rotvec_to_matrix(torch.tensor([0.3, -0.8, 0.5])), torch.tensor([0.2, 1.0, -0.4])
    elsewhere = refined(pictures, (believed[0] @ turn, believed[1] + believed[0] @ move))
    torch.testing.assert_close(elsewhere, (R @ turn, t + R @ move), atol=1e-4, rtol=0)


def test_a_sure_belief_is_kept():
    truth = path(6)
    believed = mistaken(truth)
    kept = refined(drawn(truth), believed, sure=1e4)
    torch.testing.assert_close(kept, believed, atol=1e-4, rtol=0)
    unseen = refined(drawn(truth), believed, trust=torch.full((1, PATCHES), 1e-9))
    torch.testing.assert_close(unseen[0], believed[0], atol=1e-4, rtol=0)


def test_what_is_not_trusted_counts_for_nothing():
    """Patches of the middle frame that look different; the others' pixels stay."""
    truth = path(5)
    believed, pictures = mistaken(truth), drawn(truth)
    other = pictures.clone()
    other[:, 2, :, 16:24, 24:32] += 0.1
    trust = torch.full((1, PATCHES), 0.5)
    trust.unflatten(1, GRID)[:, 4:6, 6:8] = 0
    same = refined(other, believed, trust)
    torch.testing.assert_close(same, refined(pictures, believed, trust), atol=1e-5, rtol=1e-4)
    assert not torch.allclose(refined(other, believed)[1], same[1], atol=1e-5)


def test_trust_learns_what_moves_on_its_own():
    """Gradients of the error ask for less trust in an arm, and following them helps."""
    truth = path(8)
    believed, pictures = mistaken(truth), drawn(truth)
    x, y = patch_centres(SIZE, pictures.device)
    for k in range(8):
        place = torch.stack([0.5 * x - 0.02 * k, 0.4 * y + 0.015 * k, 0 * x], -1)
        pictures[:, k, 0, 32:, 40:96] = waves(place, 9).unflatten(0, SIZE)[32:, 40:96]
    arm = torch.zeros(1, PATCHES, dtype=torch.bool)
    arm.unflatten(1, GRID)[:, 8:, 10:24] = True

    def error(trust: torch.Tensor) -> torch.Tensor:
        R, t = refined(pictures, believed, trust)
        return (R - truth[0]).square().sum() + (t - truth[1]).square().sum()

    logits = torch.zeros(1, PATCHES, requires_grad=True)
    optimiser = torch.optim.Adam([logits], 0.5)
    first = error(logits.sigmoid())
    first.backward()
    assert logits.grad is not None
    assert logits.grad[arm].mean() > 0
    for _ in range(16):
        optimiser.step()
        optimiser.zero_grad()
        last = error(logits.sigmoid())
        last.backward()
    assert last < 0.5 * first
    trust = logits.detach().sigmoid()
    assert trust[arm].mean() < trust[~arm].mean() - 0.1
    assert error(0.5 * ~arm) < 0.5 * first


@pytest.mark.parametrize("frames", [1, 2, 8])
@pytest.mark.parametrize("level", [0.0, 1.0])
def test_blank_pictures_leave_what_was_believed(frames, level):
    """But for how suddenly a head starts and stops."""
    believed = mistaken(path(frames))
    R, t = refined(torch.full((1, frames, 1, *SIZE), level), believed)
    torch.testing.assert_close(R, believed[0], atol=1e-5, rtol=0)
    torch.testing.assert_close(t, believed[1], atol=0.01, rtol=0)


def test_noise_gives_numbers():
    noise = torch.randn(1, 8, 1, *SIZE, generator=torch.Generator().manual_seed(1))
    assert all(part.isfinite().all() for part in refined(noise, path(8)))


def test_windows_do_not_touch_each_other():
    truth = path(4)
    believed = [mistaken(truth, seed) for seed in (0, 1)]
    windows = [drawn(truth, seed) for seed in (0, 1)]
    R, t = (torch.stack(parts) for parts in zip(*believed, strict=True))
    spreads = (torch.full((2,), value) for value in BELIEF)
    trust = torch.full((2, PATCHES), 0.5)
    fov = FOV_VH.expand(2, 2)
    both = refine_path(torch.cat(windows), Belief(R, t, *spreads, trust, fov), PATCH)
    for k in (0, 1):
        alone = walked(windows[k], believed[k], trust[:1], 1.0)
        for mine, other in zip(both, alone, strict=True):
            torch.testing.assert_close(mine[k], other[0], atol=1e-5, rtol=1e-3)


def test_a_network_refines_what_its_camera_head_says():
    model = small_model(**REFINED)
    frames = torch.rand(1, 5, 3, 48, 64, generator=torch.Generator().manual_seed(2))
    with torch.no_grad():
        output = model(frames)
        cached = model(patch_tokens=model.encode_frames(frames))
    *_, believed, last = output.camera_iterations
    assert len(output.camera_iterations) == model.config.camera_iterations + 1
    torch.testing.assert_close(last, output.pose_encoding[..., :7])
    torch.testing.assert_close(cached.pose_encoding, output.pose_encoding, atol=1e-4, rtol=0)
    first = (last[:, 0, :3], believed[:, 0, :3])
    torch.testing.assert_close(*first, atol=1e-5, rtol=0)
    assert not torch.allclose(last[:, 1:, :3], believed[:, 1:, :3], atol=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_a_path_is_refined_under_a_lens_that_is_known(seed):
    """Nearer the truth than under the lens that the network believes in, which is still told."""
    truth = path(6, turn=0.005)  # too little for pictures to tell the lens by
    refinement = MintPathRefinement(8, PATCH)
    for parameter in (*refinement.belief.parameters(), *refinement.trust.fc2.parameters()):
        torch.nn.init.zeros_(parameter)
    R, t = mistaken(truth, seed)
    pose = torch.cat([t, matrix_to_quat_xyzw(R)], -1)[None]
    wrong = (2 * ((FOV_VH / 2).tan() * 0.7).atan()).expand(1, 6, 2)
    given = pose, wrong, torch.zeros(1, 6, 1 + PATCHES, 8), drawn(truth, seed)
    with torch.no_grad():
        (free, lens), (known, told) = (refinement(*given, fov) for fov in (None, FOV_VH[None]))
    errors = [off((quat_xyzw_to_matrix(p[0, :, 3:]), p[0, :, :3]), truth) for p in (free, known)]
    assert torch.equal(lens, told)
    assert errors[1][0] < 0.7 * errors[0][0]
    assert errors[1][0] < 0.06


def test_a_known_lens_changes_the_camera_path_alone():
    model = small_model(**REFINED)
    frames = torch.rand(2, 4, 3, 48, 64, generator=torch.Generator().manual_seed(2))
    with torch.no_grad():
        before, after = model(frames), model(frames, known_fov_vh=FOV_VH.expand(2, 2))
        plain = small_model(**(REFINED | {"camera_refinement": "none"}))
        same = plain(frames), plain(frames, known_fov_vh=FOV_VH.expand(2, 2))
    assert not torch.equal(before.pose_encoding[..., :7], after.pose_encoding[..., :7])
    assert torch.equal(before.pose_encoding[..., 7:], after.pose_encoding[..., 7:])
    assert torch.equal(before.hand_state, after.hand_state)
    assert torch.equal(same[0].pose_encoding, same[1].pose_encoding)
    with pytest.raises(ValueError, match=r"known_fov_vh: expected \(2, 2\).* got \(2,\)"):
        model(frames, known_fov_vh=FOV_VH)
    with pytest.raises(ValueError, match=r"known_fov_vh: expected radians.* got \[\[63"):
        model(frames, known_fov_vh=FOV_VH.rad2deg().expand(2, 2))


def labels_of(truth: Poses) -> dict[str, torch.Tensor]:
    """Of one window: its path; hands are absent."""
    frames = len(truth[1])
    fov = FOV_VH.expand(frames, 2)
    pose = torch.cat([truth[1], matrix_to_quat_xyzw(truth[0]), fov], -1)
    absent_hands = absent((1, frames, 2)).astype("float32")
    return {
        "pose_encoding": pose[None],
        "hand_state": torch.from_numpy(absent_hands),
        "presence": torch.zeros(1, frames, 2, dtype=torch.bool),
    }


def test_the_path_that_is_refined_learns_by_its_own_errors():
    """The loss has both paths' camera terms, each under its name; hands' terms once."""
    model, truth = small_model(**REFINED), path(4)
    pictures = torch.rand(1, 4, 3, 48, 64, generator=torch.Generator().manual_seed(4))
    with torch.no_grad():
        output = model(pictures, labels=labels_of(truth))
    assert output.loss is not None
    weights = model.loss_settings.weights
    told = {name: float(value) for name, value in output.losses.items()}
    every = sum(weights[name.removeprefix("unrefined/")] * value for name, value in told.items())
    assert float(output.loss) == pytest.approx(every, rel=1e-5)
    model.camera_head.refinement = None
    with torch.no_grad():
        alone = model(pictures, labels=labels_of(truth)).losses
    own = sum(weights[n] * float(v) for n, v in alone.items() if n.startswith("camera/"))
    assert own > 0
    unrefined = sum(
        weights[name.removeprefix("unrefined/")] * value
        for name, value in told.items()
        if name.startswith("unrefined/")
    )
    assert unrefined == pytest.approx(own, rel=1e-5)


def test_a_path_does_not_learn_through_its_refinement():
    """Errors that pictures mend would teach it nothing; trust, beliefs and the lens do."""
    truth = path(4)
    refinement = MintPathRefinement(8, PATCH)
    pose = torch.cat([truth[1], matrix_to_quat_xyzw(truth[0])], -1)[None].requires_grad_()
    fov = FOV_VH.expand(1, 4, 2).clone().requires_grad_()
    tokens = torch.randn(1, 4, 1 + PATCHES, 8, requires_grad=True)
    refined, lens = refinement(pose, fov, tokens, drawn(truth))
    (refined.square().sum() + lens.sum()).backward()
    assert pose.grad is None
    for given in (fov, tokens):
        assert given.grad is not None
        assert given.grad.any()


def test_training_reaches_every_part_of_the_camera_head():
    model = small_model(**REFINED).train()
    truth = path(4)
    generator = torch.Generator().manual_seed(3)
    for parameter in model.camera_head.parameters():  # past the zeros it starts with
        parameter.data += 0.01 * torch.randn(parameter.shape, generator=generator)
    pictures = 0.1 * drawn(truth)[0, :, :, :48, :64].expand(-1, 3, -1, -1) + 0.5
    model.loss_settings = LossSettings(RELEASE_STAGE_2)
    output = model(pictures[None], labels=labels_of(truth))
    assert output.loss is not None
    output.loss.backward()
    silent = [
        name
        for name, parameter in model.camera_head.named_parameters()
        if parameter.grad is None or not parameter.grad.isfinite().all() or not parameter.grad.any()
    ]
    assert silent == []


def test_it_loads_as_it_was_saved_and_refuses_what_it_cannot_refine(tmp_path):
    model = small_model(**REFINED)
    assert_loads_as_saved(model, torch.rand(1, 3, 3, 48, 64), tmp_path)
    with pytest.raises(StrictDataclassError, match="motion_radius: expected at least 1"):
        small_config(**(REFINED | {"motion_radius": 0}))
