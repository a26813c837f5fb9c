"""An evaluation end to end on saved labels: laws of its numbers, and one clear error each."""

import json
from dataclasses import replace

import numpy as np
import pytest

from mint_hub.evaluation.benchmarks import open_benchmark
from mint_hub.evaluation.clips import BenchmarkError, MissingFilesError, Source
from mint_hub.evaluation.evaluate import evaluate
from mint_hub.evaluation.predictor import Predictor
from mint_hub.evaluation.results import Results, ResultsError
from mint_hub.evaluation.scoring import ClipScorer
from mint_hub.evaluation.strata import strata_of
from mint_hub.evaluation.trivial import TRIVIAL
from mint_hub.geometry import rigid
from mint_hub.geometry.metrics import HAND_MEASURES, HandStatistics
from mint_hub.inference.known_camera import correct_translation
from mint_hub.loaders.shards import write_corpus
from mint_hub.synth.frozen import frozen_clip
from mint_hub.synth.presets import BENCH_CLIPS, GENERATOR, REVISION
from tests.evaluation_data import moved, noisy, save_all, true_episode, without_hands

COUNT = 4
WORDS = ("mean", "median")


@pytest.fixture(scope="module")
def truth():
    return [true_episode(i) for i in range(COUNT)]


@pytest.fixture(scope="module")
def folder(truth, tmp_path_factory):
    return save_all(truth, tmp_path_factory.mktemp("truth"))


@pytest.fixture(scope="module")
def source(folder):
    return Source("labels", str(folder))


@pytest.fixture(scope="module")
def spoilt(truth, tmp_path_factory):
    return save_all([noisy(e, 0.01) for e in truth], tmp_path_factory.mktemp("noisy"))


@pytest.fixture(scope="module")
def results(source, spoilt):
    return evaluate(source, Predictor.of(str(spoilt), "noisy"))


def clip_of(source, number=0):
    return open_benchmark(source).clip(number)


def test_truth_scores_ideally_and_trivial_rows_are_in_every_table(source, folder):
    perfect = evaluate(source, Predictor.of(str(folder), "truth"))
    assert perfect.rows == ("prediction", *TRIVIAL)
    own = perfect.summary["prediction"]
    for measure in HAND_MEASURES:
        if measure.ideal is not None:
            assert own["hands"]["published"][measure.name][0] == pytest.approx(
                measure.ideal, abs=1e-9
            )
    assert own["camera"]["ATE mean"][0] == pytest.approx(0, abs=1e-6)
    assert own["world"]["SE(3)"]["W-MPJPE"][0] == pytest.approx(0, abs=1e-6)
    assert own["fov_error_deg"][0] == pytest.approx(0, abs=1e-4)
    for row in ("mean hand", "always present", "last frame copied"):
        assert perfect.summary[row]["hands"]["published"]["MPJPE-p"][0] > 1
    assert perfect.summary["always present"]["hands"]["published"]["Recall"][0] == 1
    assert perfect.summary["always present"]["hands"]["published"]["Presence-BA"][0] == 0.5
    still = perfect.summary["zero camera motion"]["camera"]
    assert still["Arc-length ratio (predicted / true) mean"][0] == 0
    assert still["RPE-T mean"][0] > own["camera"]["RPE-T mean"][0]


def test_results_do_not_depend_on_the_number_of_processes(source, spoilt, results):
    again = evaluate(source, Predictor.of(str(spoilt), "noisy"), jobs=2)
    one, two = results.to_dict(), again.to_dict()
    assert one.pop("date") <= two.pop("date")
    assert one == two


def test_file_is_read_back_whole(results, tmp_path):
    path = results.save(tmp_path / "a.json")
    assert Results.load(path).to_dict() == results.to_dict()
    assert "NaN" not in path.read_text()
    assert str(tmp_path.parent) not in path.read_text()
    path.write_text(path.read_text().replace('"tp"', '"tq"', 1))
    with pytest.raises(ResultsError, match=r"a\.json: expected schema 1 whole, .*unknown \['tq'\]"):
        Results.load(path)
    path.write_text('{"kind": "mint-hub evaluation"}')
    with pytest.raises(ResultsError, match=r"a\.json: schema: expected 1, got None"):
        Results.load(path)
    bare = results.to_dict()
    bare["clips"][0]["scores"] = []
    path.write_text(json.dumps(bare))
    with pytest.raises(ResultsError, match=r"a\.json: expected schema 1 whole, .*by row, got \[\]"):
        Results.load(path)
    path.write_text('{"kind": "other"}')
    with pytest.raises(ResultsError, match="expected results of `mint-hub evaluate`"):
        Results.load(path)
    with pytest.raises(ResultsError, match="found no file"):
        Results.load(tmp_path / "none.json")


def test_intervals_hold_the_value_and_one_clip_has_none(results, source, spoilt):
    own = results.summary["prediction"]
    held = [*own["hands"]["published"].values(), *own["world"]["SE(3)"].values()]
    held += [own["camera"][f"{name} {word}"] for name in ("ATE", "RPE-T") for word in WORDS]
    for value, low, high in held:
        assert low <= value <= high
        assert np.isfinite([low, high]).all()
    alone = evaluate(replace(source, limit=1), Predictor.of(str(spoilt)))
    value, low, high = alone.summary["prediction"]["hands"]["published"]["EPE-p"]
    assert np.isfinite(value)
    assert np.isnan([low, high]).all()


def test_cutting_clips_changes_no_pose_number(results, source, spoilt):
    cut = evaluate(replace(source, clip_frames=25), Predictor.of(str(spoilt)))
    assert len(cut.clips) == 3 * COUNT
    assert cut.clips[0].key == "clip-0-000000"
    for name in ("FAcc", "F1", "MPJPE-p", "EPE-p", "GO-p", "CT-p"):
        whole = results.summary["prediction"]["hands"]["published"][name][0]
        assert cut.summary["prediction"]["hands"]["published"][name][0] == pytest.approx(whole)


# ---------------------------------------------------------------- camera readings, strata


def test_a_wrong_focal_length_is_forgiven_where_the_camera_is_known(source, truth):
    fov = truth[0].fov_vh_rad
    wide = (2 * np.arctan(1.3 * np.tan(fov / 2))).astype(np.float32)
    state = correct_translation(truth[0].hand_state.astype(float), fov, wide)
    state = np.where(truth[0].presence[..., None], state, truth[0].hand_state)
    guess = replace(truth[0], fov_vh_rad=wide, hand_state=state.astype(np.float32))
    score = ClipScorer(clip_of(source)).score(guess)
    numbers = {name: s.metrics() for name, s in score.hands.items()}
    assert numbers["known"]["CT-p"] == pytest.approx(0, abs=1e-6)
    assert numbers["known"]["EPE-p"] == pytest.approx(0, abs=1e-2)
    assert numbers["published"]["CT-p"] > 0.05
    assert numbers["predicted"]["EPE-p"] < numbers["published"]["EPE-p"]
    assert score.fov_error_deg == pytest.approx(float(np.degrees(wide - fov)[0, 1]), abs=1e-3)


def test_bins_of_a_stratum_add_up_to_the_whole(source, truth):
    clip = replace(clip_of(source), visible=np.full(truth[0].presence.shape, 0.8, np.float32))
    score = ClipScorer(clip).score(noisy(truth[0], 0.02))
    whole = score.hands["published"]
    kinds = {name.partition(": ")[0] for name in score.strata}
    assert kinds == {"source", "field of view", "wrist depth", "hidden share", "wrist speed"}
    for kind in kinds:
        parts = [s for name, s in score.strata.items() if name.startswith(f"{kind}:")]
        total = sum(parts, HandStatistics())
        assert (total.tp, total.fn) == (whole.tp, whole.fn)
        assert total.epe_sum_px == pytest.approx(whole.epe_sum_px)


def test_strata_know_depth_and_absence(source, truth):
    masks = strata_of(clip_of(source))
    depth = truth[0].hand_state[..., 2]
    inside = sum(m for n, m in masks.items() if n.startswith("wrist depth"))
    assert (inside == truth[0].presence).all()
    for name, mask in masks.items():
        if name.startswith("wrist depth: 0.30 to 0.45"):
            assert ((depth[mask] >= 0.3) & (depth[mask] < 0.45)).all()


def test_scaled_hands_err_by_the_shift(source, truth):
    score = ClipScorer(clip_of(source)).score(moved(truth[0], 0.07))
    numbers = score.hands["published"].metrics()
    assert numbers["CT-p"] == pytest.approx(0.07, abs=1e-6)
    assert numbers["MPJPE-p"] == pytest.approx(0, abs=1e-3)


def test_shapes_of_a_space_without_its_hand_are_the_mean_shape(source, truth):
    """MANO's numbers never deform the template: a prediction without MANO has its mean hand."""
    state = truth[0].hand_state.copy()
    state[..., -10:] = np.where(truth[0].presence[..., None], 3.0, state[..., -10:])
    theirs = replace(truth[0], hand_state=state, meta={**truth[0].meta, "shape_space": "mano"})
    plain = state.copy()
    plain[..., -10:] = 0
    with pytest.warns(UserWarning, match="mean shape is used"):
        got = ClipScorer(clip_of(source)).score(theirs).hands["published"]
    want = ClipScorer(clip_of(source)).score(replace(truth[0], hand_state=plain))
    assert got == want.hands["published"]
    ours = ClipScorer(clip_of(source)).score(replace(truth[0], hand_state=state))
    assert ours.hands["published"] != got


# ---------------------------------------------------------------------------- bad input


def test_mismatched_lengths_name_the_clip(source, truth):
    with pytest.raises(ValueError, match=r"clip-0: expected a prediction of 60 frames.*got 59"):
        ClipScorer(clip_of(source)).score(truth[0].window(0, 59))


def test_predictions_that_are_not_finite_are_refused_by_name(source, truth, tmp_path):
    folder = save_all(truth, tmp_path / "labels")
    values = dict(np.load(folder / "clip-1.npz"))
    values["hand_state"] = np.array(values["hand_state"])
    values["hand_state"][3, 0, 0] = np.nan
    np.savez(folder / "clip-1.npz", **values)
    with pytest.raises(ValueError, match=r"clip-1\.npz: .*hand_state"):
        evaluate(source, Predictor.of(str(folder)))


def test_no_hand_at_all_gives_no_number_and_says_so(truth, tmp_path):
    folder = save_all([without_hands(e) for e in truth[:2]], tmp_path / "empty")
    found = evaluate(Source("labels", str(folder)), Predictor.of(str(folder)))
    assert np.isnan(found.summary["prediction"]["hands"]["published"]["MPJPE-p"][0])
    assert any("no hand is on screen" in w for w in found.warnings)
    found.save(tmp_path / "r.json")


def test_a_camera_that_does_not_move_is_reported_and_not_ranked(truth, tmp_path):
    still = [
        replace(e, T_camera_from_world=np.tile(e.T_camera_from_world[:1], (60, 1, 1)))
        for e in truth[:1]
    ]
    folder = save_all([*still, truth[1]], tmp_path / "still")
    found = evaluate(Source("labels", str(folder)), Predictor.of(str(folder)))
    assert any("1 clip whose camera does not move" in w for w in found.warnings)
    camera = found.summary["prediction"]["camera"]
    assert (camera["sequences"], camera["degenerate"]) == (2, 1)


def test_a_prediction_that_does_not_move_is_told(source, truth, tmp_path):
    still = [
        replace(e, T_camera_from_world=np.tile(e.T_camera_from_world[:1], (60, 1, 1)))
        for e in truth[:3]
    ]
    folder = save_all([*still, truth[3]], tmp_path / "stuck")
    found = evaluate(source, Predictor.of(str(folder)))
    (warning,) = found.warnings
    assert warning.startswith("3 clips whose predicted camera does not move though the true one")
    assert found.summary["prediction"]["camera"]["RPE-T mean"][0] == pytest.approx(0, abs=1e-6)
    assert not evaluate(source).warnings  # zero camera motion is no prediction of anyone's


def test_zero_motion_is_averaged_over_the_clips_that_move(truth, tmp_path):
    """Its error on a camera that does not move is no merit: no other row is ranked there."""
    still = [
        replace(e, T_camera_from_world=np.tile(e.T_camera_from_world[:1], (60, 1, 1)))
        for e in truth[:3]
    ]
    clips = [*still, truth[3]]
    source = Source("labels", str(save_all(clips, tmp_path / "still")))
    labels = save_all([noisy(e, 0.002, i) for i, e in enumerate(clips)], tmp_path / "labels")
    found = evaluate(source, Predictor.of(str(labels)))
    alone = found.clips[3].scores["zero camera motion"].camera
    assert alone is not None
    row = found.summary["zero camera motion"]["camera"]
    assert row["RPE-T mean"][0] == pytest.approx(alone.se3.rpe_translation_mm)
    assert row["RPE-T median"][0] == pytest.approx(alone.se3.rpe_translation_mm)
    assert np.isnan(row["RPE-T mean"][1:]).all()  # of one clip


def test_worlds_do_not_matter(source, truth, results, tmp_path):
    """A prediction may live in any world: moving it as a whole changes no number."""
    move = rigid.se3_exp(np.array([0.4, -1.1, 2.0, 3.0, -2.0, 5.0]))
    labels = [noisy(e, 0.01) for e in truth]
    moved_labels = [
        replace(e, T_camera_from_world=e.T_camera_from_world @ np.asarray(rigid.inverse(move)))
        for e in labels
    ]
    found = evaluate(source, Predictor.of(str(save_all(moved_labels, tmp_path / "moved"))))
    one, two = (r.summary["prediction"] for r in (results, found))
    assert one["hands"] == two["hands"]
    pairs = [(one["camera"], two["camera"])]
    pairs += [(numbers, two["world"][name]) for name, numbers in one["world"].items()]
    for before, after in pairs:
        for name, value in before.items():
            np.testing.assert_allclose(after[name], value, rtol=1e-5, atol=1e-6, err_msg=name)


def test_labels_that_lack_a_clip_are_refused_or_skipped(source, truth, tmp_path):
    folder = save_all(truth[1:], tmp_path / "some")
    with pytest.raises(MissingFilesError, match=r"some: expected labels of clip-0, found none"):
        evaluate(source, Predictor.of(str(folder)))
    found = evaluate(source, Predictor.of(str(folder)), on_missing="skip")
    assert found.skipped == ("clip-0",)
    assert [c.key for c in found.clips] == ["clip-1", "clip-2", "clip-3"]
    assert any("1 clip without a prediction" in w for w in found.warnings)


def test_folders_without_anything_are_named(source, tmp_path):
    with pytest.raises(MissingFilesError, match="expected a checkpoint"):
        Predictor.of(str(tmp_path))
    with pytest.raises(MissingFilesError, match="found none"):
        Predictor.of(str(tmp_path / "nothing"))
    with pytest.raises(
        MissingFilesError, match="there is no folder nothing: it is taken for a hub"
    ):
        Predictor.of("nothing").open().predict(clip_of(source))
    with pytest.raises(MissingFilesError, match="found no folder"):
        open_benchmark(Source("labels", str(tmp_path / "nothing")))
    with pytest.raises(MissingFilesError, match="expected a corpus"):
        open_benchmark(Source("shards", str(tmp_path)))
    with pytest.raises(ValueError, match="jobs: expected at least 1"):
        evaluate(Source("labels", str(tmp_path)), jobs=0)
    with pytest.raises(ValueError, match="limit: expected at least 1, got 0"):
        Source("labels", str(tmp_path), limit=0)


def test_a_kept_bench_is_opened_and_another_is_refused(truth, tmp_path, monkeypatch):
    short = truth[0].window(0, 2)
    every = [replace(short, key=f"synth-bench-{k}") for k in range(BENCH_CLIPS)]
    folder = tmp_path / f"generator-{GENERATOR}.{REVISION}"
    write_corpus(every, folder, "synth-bench", "validation", format="lossless", extra=True)
    with pytest.raises(BenchmarkError, match="bench/0: expected the clip of generator"):
        open_benchmark(Source("bench", str(tmp_path)))
    known = {f"bench/{k}": frozen_clip(short) for k in range(BENCH_CLIPS)}
    monkeypatch.setattr("mint_hub.synth.frozen.frozen_clips", lambda: known)
    benchmark = open_benchmark(Source("bench", str(tmp_path)))
    assert len(benchmark) == BENCH_CLIPS
    assert f"generator {GENERATOR}.{REVISION}" in benchmark.title
    assert benchmark.source.root == str(tmp_path)
    write_corpus(every[:3], folder, "synth-bench-ood", "validation", format="lossless", extra=True)
    with pytest.raises(BenchmarkError, match="expected the 40 clips of bench-ood, got 3"):
        open_benchmark(Source("bench-ood", str(tmp_path)))


def test_labels_of_another_clip_never_stand_in(truth, tmp_path):
    """Only windows are served by the labels of their whole clip, whatever keys look like."""
    folder = save_all([replace(truth[0], key="clip")], tmp_path / "labels")
    source = Source("labels", str(save_all([truth[0], truth[1]], tmp_path / "truth")))
    with pytest.raises(MissingFilesError, match="expected labels of clip-0"):
        evaluate(source, Predictor.of(str(folder)))
    window = open_benchmark(source).clip(1).window(20, 10)
    assert window.whole == ("clip-1", 20)
    served = Predictor.of(source.root).open().predict(window).episode
    assert np.array_equal(served.hand_state, truth[1].hand_state[20:30])
