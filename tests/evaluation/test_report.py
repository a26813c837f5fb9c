"""What people read: tables, the page, pictures; published numbers stay apart."""

import re
from dataclasses import replace

import numpy as np
import pytest

from mint_hub.evaluation.bench_shards import clip_of
from mint_hub.evaluation.benchmarks import open_benchmark
from mint_hub.evaluation.clips import Source
from mint_hub.evaluation.evaluate import evaluate
from mint_hub.evaluation.figures import (
    Bar,
    bar_chart,
    pair_figure,
    path_figure,
    strata_figure,
    worst_frame,
)
from mint_hub.evaluation.predictor import Predictor
from mint_hub.evaluation.published import published_tables
from mint_hub.evaluation.report import worst_clips, write_report
from mint_hub.evaluation.scoring import ClipScorer
from mint_hub.evaluation.tables import all_tables, main_tables, published
from mint_hub.evaluation.trivial import TRIVIAL
from mint_hub.geometry.hand_state import absent
from mint_hub.geometry.metrics import HAND_MEASURES
from mint_hub.loaders.clips import encode_clip
from mint_hub.loaders.packing import MP4
from mint_hub.loaders.shards import write_corpus
from tests.evaluation_data import moved, noisy, save_all, true_episode


def grey_clip(episode):
    height, width = (side // 8 * 2 for side in episode.image_size_hw)
    pictures = [np.full((height, width, 3), 90, np.uint8)] * episode.num_frames
    return {MP4: encode_clip(pictures, fps=episode.fps)}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A packed corpus as truth, labels of it that are off, and the results."""
    folder = tmp_path_factory.mktemp("report")
    truth = [true_episode(i, 30) for i in range(4)]
    write_corpus(
        truth,
        folder / "corpus",
        "c",
        "validation",
        format="lossless",
        extra=True,
        extra_members=grey_clip,
    )
    labels = [moved(noisy(e, 0.004), 0.02 * (i + 1)) for i, e in enumerate(truth)]
    source = Source("shards", str(folder / "corpus"))
    predictor = Predictor.of(str(save_all(labels, folder / "labels")), "off <b>")
    return source, predictor, evaluate(source, predictor)


def test_every_table_has_the_trivial_rows(made):
    _, _, results = made
    tables = {t.title: t for t in all_tables(results)}
    hands = tables["Hands in the camera frame"]
    assert hands.columns[:3] == ("FAcc", "Recall", "F1")
    ours = tables["Hands in the camera frame: beyond the paper's protocol"]
    assert hands.columns + ours.columns == tuple(m.title for m in HAND_MEASURES)
    found = {name for table in tables.values() for name, _ in table.rows}
    assert set(TRIVIAL) <= found
    for title, table in tables.items():
        if title != "By stratum":
            assert table.kinds.count("ours") == 1
            assert table.kinds.count("trivial") >= 2


def test_every_bin_of_a_stratum_has_the_trivial_rows(made):
    results = made[2]
    table = next(t for t in all_tables(results) if t.title == "By stratum")
    assert table.kinds[:4] == ("ours", "trivial", "trivial", "trivial")
    bins = [name.rpartition(" · ")[0] for name, _ in table.rows]
    whos = [name.rpartition(" · ")[2] for name, _ in table.rows]
    assert whos == ["off <b>", "mean hand", "always present", "last frame copied"] * (
        len(bins) // 4
    )
    assert all(bins[i] == bins[i // 4 * 4] for i in range(len(bins)))
    name, cells = table.rows[2]
    own = results.summary["always present"]["strata"][bins[2]]
    assert cells[-1].value == own["CT-p"]
    assert f"| {name} |" in table.markdown()


def test_what_is_known_of_the_camera_is_told_along_and_across_the_ray(made):
    """A wrong focal length moves a hand along the ray; what is left across it is the network's."""
    table = next(t for t in all_tables(made[2]) if t.title.startswith("Hands by what is known"))
    for name in ("CT-p", "CT-along-p", "CT-lateral-p"):
        for reading in ("published", "known"):
            assert f"{name}, {reading} (m)" in table.columns


def test_columns_without_a_number_are_left_out(made):
    """Clips of a second have no drift over 10 s: no column of dashes."""
    table = next(t for t in all_tables(made[2]) if t.title.endswith("scale and drift"))
    assert "ATE mean (mm)" in table.columns
    assert not [c for c in table.columns if c.startswith("ATE 1")]
    assert all(len(cells) == len(table.columns) for _, cells in table.rows)


def test_bins_of_a_stratum_that_has_one_only_are_not_listed(made):
    names = [name for name, _ in next(t for t in all_tables(made[2]) if "stratum" in t.title).rows]
    kinds = [name.partition(":")[0] for name in names]
    assert "wrist depth" in kinds
    assert "source" not in kinds
    assert min(map(kinds.count, kinds)) > 1


def test_terminal_has_a_line_a_number(made):
    table = main_tables(made[2])[0]
    lines = table.text().splitlines()
    assert len(lines) == 1 + len(table.columns)
    assert lines[0].startswith("Hands in the camera frame  off <b>")
    assert lines[4].split("  ")[0] == "MPJPE-p (mm)"
    name, cells = table.rows[1]
    at = lines[0].index(name)
    assert lines[4][at:].startswith(f"{cells[3].text} {cells[3].interval}")


def test_page_opens_offline_and_says_what_is_whose(made, tmp_path):
    source, predictor, results = made
    hot3d = replace(results, benchmark={**results.benchmark, "published": "hot3d"})
    path = write_report(hot3d, tmp_path, source, predictor, worst=2)
    page = path.read_text()
    assert "off &lt;b&gt;" in page
    assert "<b>&lt;" not in page.replace("off &lt;b&gt;", "")
    assert not re.findall(r'(?:src|href)="(?!data:)', page)
    assert page.count('class="worst"') == 2
    assert page.index("Hands in the camera frame") < page.index("Published numbers, not run here")
    box = page[page.index('<div class="theirs">') :]
    assert "WiLoR" in box
    assert "WiLoR" not in page[: page.index('<div class="theirs">')]
    assert "direction disputed" in box
    text = (tmp_path / "tables.md").read_text()
    assert text.index("## Published numbers (not run here)") < text.index("WiLoR")
    assert len(list((tmp_path / "figures").glob("*.png"))) >= 4
    assert (tmp_path / "results.json").is_file()


def test_page_without_a_prediction_shows_the_trivial_rows(made, tmp_path):
    source, _, _ = made
    results = evaluate(source)
    page = write_report(results, tmp_path, source, worst=1).read_text()
    assert results.rows == TRIVIAL
    assert "no prediction on" in page
    assert page.count('class="worst"') == 1


def test_worst_clips_come_first(made):
    _, _, results = made
    keys = [clip.key for clip in worst_clips(results, 10)]
    assert len(keys) == 4
    assert keys[0] == "clip-3"
    assert len(worst_clips(results, 2)) == 2


def test_truth_and_prediction_are_drawn_side_by_side(made):
    source, predictor, results = made
    key = worst_clips(results, 1)[0].key
    clip = next(c for c in open_benchmark(source) if c.key == key)
    predicted = predictor.open().predict(clip).episode
    frame = worst_frame(clip, predicted)
    image = pair_figure(clip, predicted, frame, None)
    half = (image.shape[1] - 6) // 2
    left, right = image[:, :half], image[:, half + 6 :]
    assert left.shape == right.shape
    assert (left != right).any()
    same = pair_figure(clip, clip.truth, frame, None)
    assert (same[:, :half] == same[:, half + 6 :]).all()
    paths = path_figure(clip, predicted)
    assert paths.shape == (360, 360, 3)
    assert len(np.unique(paths.reshape(-1, 3), axis=0)) > 3


def test_the_worst_frame_is_by_what_is_scored(made):
    """A valid hand off screen is no miss, as motion capture has it, nor made up where predicted."""
    truth = true_episode(0, 30)
    state = truth.hand_state.copy()
    state[:15, :, 0] = np.where(truth.presence[:15], 9.0, state[:15, :, 0])
    truth = replace(truth, hand_state=state)
    clip = clip_of(truth, None, None)
    seen = ClipScorer(clip).seen()
    assert not seen[:15].any()
    (wrong,) = np.flatnonzero(seen.all(axis=1))[-1:]
    bad = np.where(seen[..., None], state, absent(seen.shape))
    bad[wrong, :, 2] += 0.02
    assert worst_frame(clip, replace(truth, hand_state=bad, presence=seen)) == wrong
    bad = state.copy()
    bad[wrong, :, 2] += 0.02
    assert worst_frame(clip, replace(truth, hand_state=bad)) == wrong
    missed = replace(truth, hand_state=absent(seen.shape), presence=np.zeros_like(seen))
    assert seen[worst_frame(clip, missed)].all()


def test_bars_are_as_high_as_their_values():
    groups = [("a", [Bar("x", 1.0)]), ("b", [Bar("x", 2.0)]), ("c", [Bar("x", float("nan"))])]
    color = (10, 200, 30)
    image = bar_chart("t", "mm", groups, [], {"x": color})
    inside = (np.abs(image.astype(int) - color).max(axis=-1) < 8).sum(axis=0)
    heights = np.sort(np.unique(inside[inside > 5]))
    assert heights[-1] == pytest.approx(2 * heights[0], abs=4)


def test_a_stratum_without_bins_has_no_picture(made):
    assert strata_figure(made[2], "hidden share", "EPE-p", "px") is None
    assert strata_figure(made[2], "wrist depth", "EPE-p", "px") is not None


def test_published_numbers_have_a_source_and_our_columns():
    tables = published_tables()
    assert len(tables) == 9
    for key, table in tables.items():
        assert table.source
        if key.endswith("camera"):
            assert "Arc-length ratio (direction disputed)" in table.columns
            assert "true / predicted" in table.note
    hands = {m.name for m in HAND_MEASURES}
    assert set(tables["hot3d hands"].columns) <= hands
    mint = dict(tables["hot3d hands"].rows)["MINT"]
    assert mint[:4] == (0.945, 0.983, 0.953, 29.926)
    assert dict(tables["arctic camera"].rows)["MINT"] == (3.392, 3.372, 0.256, 0.251, 1.412)
    assert set(published_tables("arctic")) == {"arctic hands", "arctic camera"}


def test_no_published_table_where_the_benchmark_is_not_theirs(made):
    assert published(made[2]) == []
