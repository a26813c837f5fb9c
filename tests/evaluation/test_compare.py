"""Comparisons are paired: what differs is found, what does not is not, and names are kept."""

import json
from dataclasses import replace

import numpy as np
import pytest

from mint_hub.evaluation.clips import Source
from mint_hub.evaluation.compare import compare
from mint_hub.evaluation.evaluate import evaluate
from mint_hub.evaluation.predictor import Predictor
from mint_hub.evaluation.results import Results, ResultsError
from tests.evaluation_data import moved, noisy, save_all, true_episode

COUNT = 12


@pytest.fixture(scope="module")
def sides(tmp_path_factory):
    """Results of labels 3 cm off, and of better ones, 1 cm off; both with some noise."""
    folder = tmp_path_factory.mktemp("compare")
    truth = [true_episode(i, 30) for i in range(COUNT)]
    source = Source("labels", str(save_all(truth, folder / "truth")))
    made: dict[str, Results] = {}
    for name, metres in (("far", 0.03), ("near", 0.01)):
        labels = [moved(noisy(e, 0.002, seed=i), metres) for i, e in enumerate(truth)]
        made[name] = evaluate(source, Predictor.of(str(save_all(labels, folder / name))))
    return made


def by_name(comparison):
    return {d.name: d for d in comparison.differences}


def test_the_better_side_is_found_with_interval_and_test(sides):
    found = by_name(compare(sides["far"], sides["near"]))
    wrist = found["CT-p"]
    assert wrist.better == "B"
    assert wrist.b - wrist.a == pytest.approx(-0.02, abs=1e-3)
    assert wrist.low <= wrist.b - wrist.a <= wrist.high < 0
    assert wrist.p == pytest.approx(2 / 2**COUNT)
    assert wrist.p_holm >= wrist.p
    assert found["MPJPE-p"].better == ""
    swapped = by_name(compare(sides["near"], sides["far"]))["CT-p"]
    assert (swapped.a, swapped.b, swapped.better) == (wrist.b, wrist.a, "A")


def test_a_side_against_itself_differs_in_nothing(sides):
    for difference in compare(sides["near"], sides["near"]).differences:
        assert difference.a == difference.b
        assert difference.better == ""
        assert np.isnan(difference.p)


def test_only_shared_clips_count_and_the_rest_is_told(sides):
    some = replace(sides["near"], clips=sides["near"].clips[2:])
    found = compare(sides["far"], some)
    assert (found.clips, found.only_a, found.only_b) == (COUNT - 2, 2, 0)
    assert "2 clips only of A" in found.markdown()


def test_few_clips_have_no_p_value(sides):
    few = [replace(r, clips=r.clips[:3]) for r in (sides["far"], sides["near"])]
    assert all(np.isnan(d.p) for d in compare(*few).differences)


def camera_with(results, name, values):
    """The results with other values of one camera number, clip by clip."""
    clips = []
    for clip, value in zip(results.clips, values, strict=True):
        score = clip.scores["prediction"]
        camera = replace(score.camera, **{name: float(value)})
        scores = {**clip.scores, "prediction": replace(score, camera=camera)}
        clips.append(replace(clip, scores=scores))
    return replace(results, clips=tuple(clips))


RATIO = "Arc-length ratio (predicted / true) mean"


def test_a_clear_difference_across_the_ideal_says_nothing_of_better(sides):
    """A path 10 % short and one 10 % long are told apart, and are equally good."""
    rng = np.random.default_rng(0)
    short, long = (
        camera_with(sides["near"], "arc_length_ratio", 1 + gap + rng.normal(0, 0.004, COUNT))
        for gap in (-0.1, 0.1)
    )
    found = by_name(compare(short, long))[RATIO]
    assert found.low > 0.19
    assert found.nearer_low < 0 < found.nearer_high
    assert found.better == ""
    closer = camera_with(sides["near"], "arc_length_ratio", np.linspace(1.02, 1.04, COUNT))
    assert by_name(compare(short, closer))[RATIO].better == "B"
    assert by_name(compare(closer, short))[RATIO].better == "A"
    assert by_name(compare(long, closer))[RATIO].better == "B"


def test_interval_and_test_have_to_agree_on_the_side(sides):
    """Ratios wild on both sides of 1 have an ideal mean; clip by clip they are worse than 1.1."""
    rng = np.random.default_rng(0)
    wild = np.tile([0.5, 1.5], COUNT // 2) + rng.normal(0, 1e-3, COUNT)
    a = camera_with(sides["near"], "arc_length_ratio", wild)
    b = camera_with(sides["near"], "arc_length_ratio", np.linspace(1.6, 1.602, COUNT))
    c = camera_with(sides["near"], "arc_length_ratio", np.linspace(1.45, 1.452, COUNT))
    assert by_name(compare(a, b))[RATIO].better == "A"
    against = by_name(compare(a, c))[RATIO]
    assert against.ahead == "B"
    assert abs(against.a - 1) < abs(against.b - 1)
    assert against.better == ""


def test_clips_without_a_path_count_on_neither_side_and_are_told(sides, tmp_path):
    """As in `evaluate`: a camera that got stuck is no error of so many millimetres."""
    truth = [true_episode(i, 30) for i in range(4)]
    source = Source("labels", str(save_all(truth, tmp_path / "truth")))
    still = [
        replace(e, T_camera_from_world=np.tile(e.T_camera_from_world[:1], (30, 1, 1)))
        for e in truth
    ]
    labels = {
        "some": [*still[:3], noisy(truth[3], 0.002)],
        "all": still,
        "own": [noisy(e, 0.01, i) for i, e in enumerate(truth)],
    }
    made = {
        name: evaluate(source, Predictor.of(str(save_all(episodes, tmp_path / name))))
        for name, episodes in labels.items()
    }
    found = compare(made["some"], made["own"])
    rpe = by_name(found)["RPE-T mean"]
    assert rpe.a == pytest.approx(made["some"].summary["prediction"]["camera"]["RPE-T mean"][0])
    last = made["own"].clips[3].scores["prediction"].camera
    assert rpe.b == pytest.approx(last.se3.rpe_translation_mm)
    assert (rpe.clips, found.still) == (1, 3)
    assert "3 clips whose camera does not move" in found.markdown()
    found = compare(made["all"], made["own"])  # nothing else to rank, as in evaluate
    rpe = by_name(found)["RPE-T mean"]
    assert rpe.a == pytest.approx(made["all"].summary["prediction"]["camera"]["RPE-T mean"][0])
    assert (rpe.clips, found.still) == (4, 0)
    assert "does not move" not in found.markdown()


def test_table_and_file(sides, tmp_path):
    found = compare(sides["far"], sides["near"])
    assert "| CT-p (m) | 0.030 | 0.010 |" in found.markdown()
    values = json.loads(found.save(tmp_path / "c.json").read_text())
    assert values["clips"] == COUNT
    assert {d["name"] for d in values["differences"]} >= {"CT-p", "ATE mean", "W-MPJPE"}


def test_what_cannot_be_compared_is_said(sides):
    other = replace(sides["near"], clips=())
    with pytest.raises(ResultsError, match="expected the row 'prediction'"):
        compare(sides["far"], other)
    renamed = tuple(replace(c, key=f"x-{c.key}") for c in sides["near"].clips)
    with pytest.raises(ResultsError, match="got none in common"):
        compare(sides["far"], replace(sides["near"], clips=renamed))
    cut = tuple(replace(c, frames=29) for c in sides["near"].clips)
    with pytest.raises(ResultsError, match="expected the same frames, got 30 in A and 29 in B"):
        compare(sides["far"], replace(sides["near"], clips=cut))
    (first, *rest) = sides["near"].clips
    other = (replace(first, stamp="0" * 16), *rest)
    with pytest.raises(ResultsError, match=r"clip-0: expected the same truth.*0{16} in B"):
        compare(sides["far"], replace(sides["near"], clips=other))


def test_few_clips_are_told(sides):
    few = [replace(r, clips=r.clips[:7]) for r in (sides["far"], sides["near"])]
    assert "no p can be below 0.05" in compare(*few).markdown()
    assert "no p can be below" not in compare(sides["far"], sides["near"]).markdown()
