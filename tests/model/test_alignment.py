"""Fields of shifts: a picture moved by a known field is found by it, whatever else moves."""

import pytest
import torch

from mint_hub.model.alignment_mint import Alignment, fit_field, peaks, terms_at
from mint_hub.model.layers_mint import patch_centres

SIZE = (64, 80)


def picture(seed: int = 0) -> torch.Tensor:
    """A smooth random picture, (1, 1, 64, 80), about as bright and dark as `describe` gives."""
    noise = torch.randn(1, 1, 70, 86, generator=torch.Generator().manual_seed(seed))
    for _ in range(3):
        noise = torch.nn.functional.avg_pool2d(noise, 3, 1)
    return noise / noise.std()


def moved(before: torch.Tensor, field: torch.Tensor) -> torch.Tensor:
    """The next frame: at each place, what was at that place + shift."""
    x, y = patch_centres(SIZE, before.device)
    shifts = terms_at(x, y) @ field
    unit = torch.tensor([2 / SIZE[1], 2 / SIZE[0]])
    grid = (torch.stack([x, y], -1) + shifts.flip(-1) * unit).unflatten(1, SIZE)
    return torch.nn.functional.grid_sample(
        before, grid, mode="bicubic", padding_mode="border", align_corners=False
    )


def a_field(seed: int, size: float) -> torch.Tensor:
    return size * torch.randn(1, 6, 2, generator=torch.Generator().manual_seed(seed))


def off_px(found: torch.Tensor, truth: torch.Tensor) -> float:
    """Mean distance of two fields over the picture."""
    terms = terms_at(*patch_centres(SIZE, found.device))
    return float((terms @ (found - truth)).norm(dim=-1).mean())


@pytest.mark.parametrize("seed", range(4))
def test_a_known_field_is_found(seed):
    before, truth = picture(seed), a_field(seed, 0.5)
    found = Alignment(moved(before, truth), before).refine(torch.zeros(1, 6, 2), 8)
    assert off_px(torch.zeros(1, 6, 2), truth) > 0.3
    assert off_px(found, truth) < 0.06


def test_what_moves_on_its_own_counts_for_little():
    """A fifth of the picture is another picture: the field is that of the rest."""
    before, truth = picture(1), a_field(1, 0.5)
    now = moved(before, truth)
    now[..., 20:48, 30:66] = picture(9)[..., 20:48, 30:66]
    found = Alignment(now, before).refine(torch.zeros(1, 6, 2), 8)
    assert off_px(found, truth) < 0.12


def test_patches_tell_what_the_field_leaves():
    """One patch is half a pixel further down than the field says; its neighbours are not."""
    before, truth = picture(2), a_field(2, 0.3)
    extra = truth.clone()
    extra[:, 0, 0] += 0.5
    now = moved(before, truth)
    now[..., 16:32, 32:48] = moved(before, extra)[..., 16:32, 32:48]
    beyond, seen, difference, explained = Alignment(now, before).local(truth, 16)
    beyond = beyond.unflatten(1, (4, 5))[0]
    assert beyond[1, 2, 0] == pytest.approx(0.5, abs=0.2)
    assert beyond[1, 2, 1].abs() < 0.1
    others = torch.cat([beyond[2:].flatten(0, 1), beyond[0]])
    assert others.norm(dim=-1).max() < 0.1
    assert (seen > 0.5).all()
    assert float(difference) < 0.1
    assert float(explained) > 0.8


@pytest.mark.parametrize("level", [0.0, 1.0])
def test_a_blank_picture_moves_nothing(level):
    flat = torch.full((2, 1, *SIZE), level)
    alignment, field = Alignment(flat, flat), a_field(3, 1.0).expand(2, -1, -1)
    found = alignment.refine(field, 4)
    torch.testing.assert_close(found, field, atol=1e-3, rtol=0)
    assert all(fact.isfinite().all() for fact in alignment.local(found, 16))


def test_peaks_lie_between_whole_shifts():
    """Costs that are a bowl about (0.3, -1.2) are least there; at the border nothing is known."""
    steps = torch.arange(-3.0, 4)
    down, right = torch.meshgrid(steps, steps, indexing="ij")
    bowl = (down - 0.3).square() + (right + 1.2).square()
    slope = down + right
    shifts, weights = peaks(torch.stack([bowl.flatten(), slope.flatten()])[None], 3)
    torch.testing.assert_close(shifts[0, 0], torch.tensor([0.3, -1.2]))
    assert weights[0, 0] > 0
    assert weights[0, 1] == 0


def test_a_fit_passes_over_patches_that_disagree():
    places = patch_centres((6, 8), torch.device("cpu"))
    truth = a_field(4, 1.0)
    shifts = terms_at(*places) @ truth
    shifts[:, ::7] += torch.tensor([6.0, -5.0])
    found = fit_field(shifts, torch.ones(1, 48), places)
    assert (terms_at(*places) @ (found - truth)).norm(dim=-1).mean() < 0.3
    nothing = fit_field(shifts, torch.zeros(1, 48), places)
    torch.testing.assert_close(nothing, torch.zeros(1, 6, 2))
