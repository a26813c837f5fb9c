"""LeRobot v3 roots become Episodes and come back, in both dialects; what is wrong is said."""

import json
import logging
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from itertools import chain
from pathlib import Path

import fsspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from mint_hub.geometry import hand_state
from mint_hub.loaders.derived import lerobot_features
from mint_hub.loaders.lerobot import (
    SCALE_STATUS,
    LeRobotError,
    from_lerobot,
    lerobot_episodes,
    lerobot_roots,
    to_lerobot,
)
from mint_hub.loaders.lerobot_columns import LABELS, columns_of
from mint_hub.loaders.lerobot_files import open_root
from tests.episodes import make_episode
from tests.lerobot_files import (
    IMAGE_SIZE_HW,
    RootPlan,
    edit_info,
    episode_rows,
    frame_table,
    replace_column,
    write_root,
)
from tests.loopback_hub import LoopbackHub

REPOSITORY = Path(__file__).parents[2]
DIALECTS = ("camera", "world")
FIRST = "data/chunk-000/file-000.parquet"


def read(folder, **options):
    return list(from_lerobot(folder, **options))


def listed(values, width):
    return pa.FixedSizeListArray.from_arrays(pa.array(np.asarray(values).reshape(-1)), width)


# ------------------------------------------------------------------------------------------ reading


@pytest.mark.parametrize("dialect", DIALECTS)
@pytest.mark.parametrize("placeholder", ["canonical", "zeros", "nan"])
def test_reads_the_motion_that_was_written(tmp_path, dialect, placeholder):
    truth = write_root(tmp_path, RootPlan(dialect=dialect, placeholder=placeholder))
    found = read(tmp_path)
    assert len(found) == len(truth)
    for got, want in zip(found, truth, strict=True):
        np.testing.assert_array_equal(got.presence, want.presence)
        np.testing.assert_allclose(got.T_camera_from_world, want.T_camera_from_world, atol=1e-6)
        np.testing.assert_allclose(got.fov_vh_rad, want.fov_vh_rad, atol=1e-7)
        np.testing.assert_allclose(got.hand_state, want.hand_state, atol=1e-6)
        assert got.image_size_hw == IMAGE_SIZE_HW
        absent = got.hand_state[~got.presence]
        np.testing.assert_array_equal(absent, hand_state.absent((len(absent),)))


def test_camera_dialect_keeps_hands_to_the_bit(tmp_path):
    truth = write_root(tmp_path)
    for got, want in zip(read(tmp_path), truth, strict=True):
        np.testing.assert_array_equal(got.hand_state, want.hand_state)
        np.testing.assert_array_equal(got.fov_vh_rad, want.fov_vh_rad)


def test_both_dialects_give_the_same_episodes(tmp_path):
    for dialect in DIALECTS:
        write_root(tmp_path / dialect, RootPlan(dialect=dialect))
    camera, world = (read(tmp_path / dialect) for dialect in DIALECTS)
    for a, b in zip(camera, world, strict=True):
        assert replace(a, key=b.key, meta=b.meta).allclose(b, atol=1e-6)
        assert a.fov_vh_rad[0, 0] < a.fov_vh_rad[0, 1]
        differing = {k for k in a.meta if a.meta[k] != b.meta[k]}
        assert differing == {"provenance", "uid"}  # which name the root


def test_says_where_an_episode_is_from(tmp_path):
    root = tmp_path / "ego4d" / "lerobot_v3"
    uids = ("AB-1", "AB-1", "c.d", "e", "f")
    write_root(root, RootPlan(source=None, first_episode=7, episode_columns={"video_uid": uids}))
    found = read(root)
    assert [e.key for e in found[:3]] == [
        "ego4d-ab-1-000007",
        "ego4d-ab-1-000008",
        "ego4d-c-d-000009",
    ]
    meta = found[2].meta
    assert (meta["source"], meta["uid"], meta["domain"]) == ("ego4d", "c.d", "daily")
    assert meta["scale_status"] == SCALE_STATUS == "scale-enlarged pseudo-label, not metric"
    assert meta["shape_space"] == "mano"
    origin = meta["provenance"]
    assert (origin["episode_index"], origin["row"]) == (9, 0)
    assert origin["file"] == "data/chunk-000/file-001.parquet"
    assert origin["video"]["from_timestamp"] == found[2].timestamps_s[0] == 4.0
    np.testing.assert_allclose(np.diff(found[2].timestamps_s), 1 / 30)


def test_a_root_is_known_by_what_it_holds(tmp_path):
    """Not by where it lies; nor by what a user adds, or has not fetched yet."""
    write_root(tmp_path / "a")
    shutil.copytree(tmp_path / "a", tmp_path / "elsewhere/b")
    write_root(tmp_path / "other", RootPlan(seed=5))  # same texts and lengths, another motion
    write_root(tmp_path / "longer", RootPlan((12, 9, 20, 8, 16)))
    names = [open_root(tmp_path / f).identity for f in ("a", "elsewhere/b", "other", "longer")]
    assert len(set(names)) == 3
    assert names[0] == names[1]
    (tmp_path / "a/videos").mkdir()
    (tmp_path / "a/videos/x.mp4").write_bytes(b"x")
    (tmp_path / "a/data/chunk-000/file-002.parquet").unlink()
    assert open_root(tmp_path / "a").identity == names[0]
    episode = next(from_lerobot(tmp_path / "a"))
    assert episode.meta["provenance"]["root"] == names[0]
    assert str(tmp_path) not in json.dumps(episode.meta)
    (tmp_path / "a" / FIRST).write_bytes(b"cut")
    with pytest.raises(LeRobotError, match=r"file-000.parquet: expected a parquet file, got"):
        next(from_lerobot(tmp_path / "a"))


def test_text_is_atomic_segments_or_else_tasks(tmp_path):
    write_root(tmp_path)
    first, second, third, *_ = read(tmp_path)
    assert [s.to_dict() for s in first.text] == [
        {"id": "0", "text": "open the jar", "side": None, "start": 0, "end": 4},
        {"id": "1", "text": "pour water", "side": None, "start": 6, "end": 12},
    ]
    assert first.meta["tasks"][0] == "make tea 0"
    assert [s.to_dict() for s in second.text] == [
        {"id": "0", "text": "make tea 0", "side": "left", "start": 0, "end": 9}
    ]
    assert {s.side for s in third.text} == {"right"}


def test_local_row_counts_from_the_smallest_index_of_the_file(tmp_path):
    write_root(tmp_path / "a", RootPlan())
    write_root(tmp_path / "b", RootPlan(first_episode=3, first_row=5000))
    for a, b in zip(read(tmp_path / "a"), read(tmp_path / "b"), strict=True):
        assert replace(b, key=a.key, meta=a.meta).allclose(a, atol=0)


@pytest.mark.parametrize("rows_per_group", [1, 7, None])
def test_row_groups_do_not_matter(tmp_path, rows_per_group):
    write_root(tmp_path / "a", RootPlan(rows_per_group=rows_per_group, per_file=5))
    write_root(tmp_path / "b", RootPlan(per_file=1))
    for a, b in zip(read(tmp_path / "a"), read(tmp_path / "b"), strict=True):
        assert replace(a, key=b.key, meta=b.meta).allclose(b, atol=0)


def test_chosen_episodes_only(tmp_path):
    write_root(tmp_path, RootPlan(first_episode=10))
    every = {e.key: e for e in read(tmp_path)}
    found = read(tmp_path, episodes=[13, 11])
    name = open_root(tmp_path).identity
    assert [e.key for e in found] == [f"ego4d-{name}-000011", f"ego4d-{name}-000013"]
    assert all(e.allclose(every[e.key], atol=0) for e in found)
    with pytest.raises(LeRobotError, match=r"expected \[2\], got 5 episodes without"):
        from_lerobot(tmp_path, episodes=[2, 11])


def test_parts_of_a_root_are_the_root(tmp_path):
    write_root(tmp_path, RootPlan(first_episode=10))
    numbers = lerobot_episodes(tmp_path)
    assert numbers == [10, 11, 12, 13, 14]
    parts = [read(tmp_path, episodes=part) for part in (numbers[:3], numbers[3:], [])]
    assert [e.key for e in chain(*parts)] == [e.key for e in read(tmp_path)]
    assert parts[2] == []


def test_plain_lists_are_as_good_as_fixed_ones(tmp_path):
    for name in "ab":
        write_root(tmp_path / name)
    path = tmp_path / "b" / FIRST
    table = pq.read_table(path)
    plain = pa.array(table["cam_trans"].to_pylist(), pa.list_(pa.float64()))
    replace_column(path, "cam_trans", plain)
    for a, b in zip(read(tmp_path / "a"), read(tmp_path / "b"), strict=True):
        assert replace(a, key=b.key, meta=b.meta).allclose(b, atol=0)


def test_reads_through_fsspec_and_no_further_than_asked(tmp_path):
    write_root(tmp_path / "ego4d")
    memory = fsspec.filesystem("memory")
    memory.put(str(tmp_path / "ego4d"), "/lerobot-test/ego4d", recursive=True)
    try:
        assert lerobot_roots("memory://lerobot-test") == ["memory://lerobot-test/ego4d"]
        memory.rm("/lerobot-test/ego4d/data/chunk-000/file-002.parquet")
        episodes = from_lerobot("memory://lerobot-test/ego4d")
        for want in read(tmp_path / "ego4d")[:4]:
            got = next(episodes)
            assert replace(got, meta=want.meta).allclose(want, atol=0)
        with pytest.raises(LeRobotError, match=r"file-002.parquet: expected this file, got none"):
            next(episodes)
    finally:
        memory.rm("/lerobot-test", recursive=True)


def test_reads_from_the_hub_without_a_copy(tmp_path):
    write_root(tmp_path / "labels" / "ego4d" / "lerobot_v3", RootPlan(source=None))
    code = """
from mint_hub.loaders.lerobot import from_lerobot, lerobot_roots
for root in lerobot_roots("hf://datasets/org/labels"):
    print(root, *(e.key for e in from_lerobot(root, episodes=[1, 3])))
"""
    with LoopbackHub() as hub:
        hub.add("org/labels", tmp_path / "labels", kind="datasets")
        environment = os.environ | hub.environment(tmp_path / "home")
        command = [sys.executable, "-c", code]
        done = subprocess.run(
            command, env=environment, cwd=REPOSITORY, capture_output=True, text=True, check=False
        )
    name = open_root(tmp_path / "labels/ego4d/lerobot_v3").identity
    assert done.stdout.split() == [
        "hf://datasets/org/labels/ego4d/lerobot_v3",
        f"ego4d-{name}-000001",
        f"ego4d-{name}-000003",
    ], done.stderr


def test_camera_labels_are_those_of_the_schema():
    columns = {c.name: c.feature() for c in LABELS["camera"]}
    assert columns == lerobot_features()


def test_finds_roots_below_a_folder(tmp_path):
    write_root(tmp_path / "ego4d" / "lerobot_v3", RootPlan(lengths=(3,)))
    write_root(tmp_path / "epic", RootPlan(lengths=(3,)))
    found = [Path(r).relative_to(tmp_path).as_posix() for r in lerobot_roots(tmp_path)]
    assert found == ["ego4d/lerobot_v3", "epic"]
    assert lerobot_roots(tmp_path / "epic") == [str(tmp_path / "epic")]


# ------------------------------------------------------------------------------------- round trips


@pytest.mark.parametrize("dialect", DIALECTS)
def test_columns_come_back(tmp_path, dialect):
    write_root(tmp_path / "in", RootPlan(dialect=dialect))
    report = to_lerobot(from_lerobot(tmp_path / "in"), tmp_path / "out", dialect)
    assert (report.num_episodes, report.num_frames) == (5, 64)
    before, after = frame_table(tmp_path / "in"), frame_table(tmp_path / "out")
    assert before.schema.remove_metadata() == after.schema.remove_metadata()
    for name in before.column_names:
        want, got = (np.array(t[name].to_pylist()) for t in (before, after))
        exact = want.dtype.kind != "f" or "_mano_" in name or name in ("cam_fov", "timestamp")
        atol = 0 if exact else 1e-3 if name == "intrinsics" else 2e-6
        np.testing.assert_allclose(got, want, rtol=0, atol=atol, err_msg=name)
    names = ("episode_index", "length", "tasks", "atomic_segments")
    names += ("dataset_from_index", "dataset_to_index")
    rows = [
        [{n: row[n] for n in names} for row in episode_rows(tmp_path / f)] for f in ("in", "out")
    ]
    assert rows[0] == rows[1]
    tasks = [pq.read_table(tmp_path / f / "meta/tasks.parquet") for f in ("in", "out")]
    assert tasks[0].to_pydict() == tasks[1].to_pydict()


@pytest.mark.parametrize("dialect", DIALECTS)
def test_sources_join_in_one_root(tmp_path, dialect):
    plans = {"ego4d": 0, "epickitchen": 100, "egodex": 200}
    for (source, seed), written in zip(plans.items(), ("camera", "world", "camera"), strict=True):
        plan = RootPlan((9, 5, 8), written, source, seed=seed, first_episode=seed, first_row=seed)
        write_root(tmp_path / source, plan)
    before = [read(tmp_path / source) for source in plans]
    report = to_lerobot(chain(*before), tmp_path / "joined", dialect, file_bytes=20_000)
    assert report.num_files > 2
    assert len(list((tmp_path / "joined").glob("data/*/*.parquet"))) == report.num_files
    after = read(tmp_path / "joined")
    assert [e.meta["source"] for e in after] == ["ego4d"] * 3 + ["epic"] * 3 + ["egodex"] * 3
    assert [e.meta["domain"] for e in after[::3]] == ["daily", "kitchen", "tabletop"]
    for want, got in zip(chain(*before), after, strict=True):
        assert got.allclose(want, atol=2e-6)


@pytest.mark.parametrize("dialect", DIALECTS)
def test_extra_columns_bring_back_everything(tmp_path, dialect):
    whole = make_episode(40, 3, key="a", meta={"tasks": ["tidy up"], "participant": "P01"})
    filled = np.zeros((40, 2), bool)
    filled[5:8, 1] = True
    late = whole.timestamps_s + 12.5 + 0.004 * np.sin(np.arange(40))
    whole = replace(whole, filled=filled, timestamps_s=late)
    plain = replace(make_episode(9, 4, key="b"), presence_score=None, text=())
    to_lerobot([whole, plain], tmp_path / "out", dialect, extra=True)
    for got, want in zip(read(tmp_path / "out"), (whole, plain), strict=True):
        assert got.allclose(want, atol=2e-6)


def test_shape_that_varies_is_kept_per_frame(tmp_path):
    episode = make_episode(12, gaps=False)
    state = np.array(episode.hand_state)
    state[..., hand_state.SHAPE] += np.arange(12)[:, None, None] / 7
    episode = replace(episode, hand_state=state, presence_score=None)
    for dialect in DIALECTS:
        to_lerobot([episode], tmp_path / dialect, dialect)
        got = read(tmp_path / dialect)[0]
        shape = hand_state.unpack(got.hand_state).shape_params
        np.testing.assert_allclose(shape, state[..., hand_state.SHAPE], atol=1e-6)


@pytest.mark.parametrize("extra", [False, True])
@pytest.mark.parametrize("dialect", DIALECTS)
def test_info_is_the_columns(tmp_path, dialect, extra):
    to_lerobot([make_episode(9), make_episode(7, key="b")], tmp_path / "out", dialect, extra=extra)
    info = json.loads((tmp_path / "out/meta/info.json").read_text())
    schema = frame_table(tmp_path / "out").schema
    assert list(info["features"]) == schema.names == [c.name for c in columns_of(dialect, extra)]
    for name, feature in info["features"].items():
        kind = schema.field(name).type
        width = kind.list_size if pa.types.is_fixed_size_list(kind) else 1
        number = kind.value_type if width > 1 else kind
        assert feature["shape"] == [width]
        assert pa.from_numpy_dtype(np.dtype(feature["dtype"])) == number
    totals = {name: info[f"total_{name}"] for name in ("episodes", "frames", "tasks", "videos")}
    assert totals == {"episodes": 2, "frames": 16, "tasks": 2, "videos": 0}
    assert info["splits"] == {"train": "0:2"}


def test_stats_leave_absent_hands_out(tmp_path):
    episode = make_episode(60)
    to_lerobot([episode], tmp_path / "out")
    stats = json.loads((tmp_path / "out/meta/stats.json").read_text())
    there = episode.presence[:, 0]
    assert 0 < there.sum() < 60
    want = episode.hand_state[there, 0, hand_state.TRANSLATION].astype(float)
    got = stats["left_mano_transl_cam"]
    assert got["count"] == [there.sum()]
    for name, value in {"mean": want.mean(0), "std": want.std(0), "max": want.max(0)}.items():
        np.testing.assert_allclose(got[name], value, atol=1e-6)
    assert stats["cam_trans"]["count"] == [60]


# -------------------------------------------------------------------------------------- what fails


def test_missing_and_foreign_files(tmp_path):
    with pytest.raises(LeRobotError, match=r"info.json: expected this file, got none"):
        from_lerobot(tmp_path / "nowhere")
    write_root(tmp_path)
    edit_info(tmp_path, codebase_version="v2.1")
    with pytest.raises(LeRobotError, match=r"codebase_version: expected v3.x, got 'v2.1'"):
        from_lerobot(tmp_path)
    edit_info(tmp_path, codebase_version="v3.0", fps=0)
    with pytest.raises(LeRobotError, match="fps: expected a positive number, got 0"):
        from_lerobot(tmp_path)
    edit_info(tmp_path, fps=30, data_path="../{chunk_index}/{file_index}")
    with pytest.raises(LeRobotError, match="data_path: expected a path"):
        read(tmp_path)
    edit_info(tmp_path, data_path="data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet")
    (tmp_path / FIRST).write_bytes(b"not parquet, but long enough to look")
    with pytest.raises(LeRobotError, match=r"file-000.parquet: expected a parquet file"):
        read(tmp_path)


@pytest.mark.parametrize(("dialect", "name"), [("camera", "cam_fov"), ("world", "right_kept")])
def test_missing_column_is_named(tmp_path, dialect, name):
    write_root(tmp_path, RootPlan(dialect=dialect))
    replace_column(tmp_path / FIRST, name, None)
    with pytest.raises(
        LeRobotError, match=rf"file-000.parquet: .*'{dialect}', without \['{name}'\]"
    ):
        read(tmp_path)


def test_missing_episode_column_is_named(tmp_path):
    write_root(tmp_path)
    path = tmp_path / "meta/episodes/chunk-000/file-001.parquet"
    replace_column(path, "dataset_from_index", None)
    with pytest.raises(
        LeRobotError, match=r"file-001.parquet: expected the columns \['dataset_from"
    ):
        from_lerobot(tmp_path)


WRONG_COLUMNS = {
    "cam_quat": (
        listed(np.ones((21, 3), "f4"), 3),
        r"expected 4 numbers a frame, got lists of \[3\]",
    ),
    "cam_fov": (listed(np.ones((21, 2), "i8"), 2), "expected float32, got int64"),
    "hand_kept": (listed(np.ones((21, 2), "f4"), 2), "expected bool, got float"),
    "cam_trans": (pa.array([1.0] * 21), "expected 3 numbers a frame, got double"),
    "frame_index": (pa.array([0, 1, None] * 7), "expected a value in every frame"),
    "episode_index": (pa.array([4] * 21), "expected 0, got 4 at frame 0"),
}


@pytest.mark.parametrize("name", WRONG_COLUMNS)
def test_wrong_column_is_named(tmp_path, name):
    column, message = WRONG_COLUMNS[name]
    write_root(tmp_path)
    replace_column(tmp_path / FIRST, name, column)
    place = rf"file-000.parquet, episode 0: {name}: {message}"
    with pytest.raises(LeRobotError, match=place):
        read(tmp_path)


WRONG_VALUES = {
    "cam_quat": ("camera", 1.5, "cam_quat: expected unit quaternions, got 1.5"),
    "cam_trans": ("camera", np.nan, "cam_trans: expected finite numbers"),
    "cam_fov": ("camera", 0.0, "fov_vh_rad: expected 0 < x"),
    "right_mano_orient6d": ("camera", 0.0, "hand_state: expected two independent rows"),
    "right_mano_betas": ("camera", np.nan, "hand_state: expected finite"),
    "extrinsics_w2c": ("world", 2.0, "extrinsics_w2c: expected a last row of 0 0 0 1"),
    "right_orient_world": ("world", 1.1, "right_orient_world: expected rotation matrices"),
    "right_hand_pose": ("world", -1.0, "right_hand_pose: expected rotation matrices"),
    "frame_index": ("camera", 2, "frame_index: expected 1, got 2 at frame 1"),
}


@pytest.mark.parametrize("name", WRONG_VALUES)
def test_wrong_values_are_refused_or_skipped(tmp_path, name, caplog):
    dialect, factor, message = WRONG_VALUES[name]
    write_root(tmp_path, RootPlan(dialect=dialect))
    column = pq.read_table(tmp_path / FIRST)[name].combine_chunks()
    values = np.array(column.to_pylist())
    values[1] = values[1] * factor
    wrong = pa.array(values) if values.ndim == 1 else listed(values, values.shape[1])
    replace_column(tmp_path / FIRST, name, wrong.cast(column.type))
    with pytest.raises(LeRobotError, match=message):
        read(tmp_path)
    with caplog.at_level(logging.WARNING):
        found = read(tmp_path, on_error="skip")
    assert [e.key[-1] for e in found] == ["1", "2", "3", "4"]
    assert message.split(":")[0] in caplog.text


def test_places_that_cannot_be(tmp_path):
    write_root(tmp_path)
    path = tmp_path / "meta/episodes/chunk-000/file-000.parquet"
    good = pq.read_table(path)
    replace_column(path, "length", pa.array([12, 90, 20]))
    with pytest.raises(LeRobotError, match="episode 1: expected its frames within its 21 rows"):
        read(tmp_path)
    replace_column(path, "length", pa.array([13, 9, 20]))
    with pytest.raises(LeRobotError, match="episode 1: expected its frames after the one before"):
        read(tmp_path)
    replace_column(path, "length", pa.array([0, 9, 20]))
    with pytest.raises(LeRobotError, match="length: expected at least 1"):
        from_lerobot(tmp_path)
    pq.write_table(good, path)
    replace_column(path, "episode_index", pa.array([0, 0, 2]))
    with pytest.raises(LeRobotError, match="episode_index: expected each once, got 0 twice"):
        from_lerobot(tmp_path)


def test_text_that_points_nowhere(tmp_path):
    write_root(tmp_path)
    tasks = tmp_path / "meta/tasks.parquet"
    pq.write_table(pq.read_table(tasks).slice(0, 1), tasks)
    with pytest.raises(LeRobotError, match=r"atomic_segments: expected a task_index .*, got 1"):
        read(tmp_path)


@pytest.mark.parametrize("given", ["[{", '["pour water"]', '[{"task_index": 1}]'])
def test_segments_of_another_make(tmp_path, given):
    write_root(tmp_path, RootPlan(lengths=(12,)))
    path = tmp_path / "meta/episodes/chunk-000/file-000.parquet"
    replace_column(path, "atomic_segments", pa.array([given]))
    with pytest.raises(LeRobotError, match="episode 0: atomic_segments: expected"):
        read(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda told: "{", "mint_episode: expected JSON"),
        (lambda told: json.dumps({**told, "schema_version": 99}), "upgrade this one"),
        (lambda told: json.dumps({"key": told["key"]}), "mint_episode: expected the entries"),
        (lambda told: json.dumps({**told, "key": "A.b"}), "key: expected only a-z"),
    ],
)
def test_own_exports_are_checked_too(tmp_path, change, message):
    to_lerobot([make_episode(9)], tmp_path / "out")
    path = tmp_path / "out/meta/episodes/chunk-000/file-000.parquet"
    (told,) = pq.read_table(path)["mint_episode"].to_pylist()
    replace_column(path, "mint_episode", pa.array([change(json.loads(told))]))
    with pytest.raises(LeRobotError, match=message):
        read(tmp_path / "out")


def test_segments_are_cut_to_the_episode_and_it_says_so(tmp_path):
    write_root(tmp_path, RootPlan(lengths=(12,)))
    path = tmp_path / "meta/episodes/chunk-000/file-000.parquet"
    segment = {"atomic_index": 0, "task_index": 1, "start_frame": 6, "end_frame": 30}
    replace_column(path, "atomic_segments", pa.array([[segment]]))
    (episode,) = read(tmp_path)
    assert [(s.start, s.end) for s in episode.text] == [(6, 12)]
    assert episode.meta["warnings"][0] == "atomic segment 0: frames 6 to 30 of 12 were cut"


def test_image_size_is_needed_and_can_be_given(tmp_path):
    write_root(tmp_path)
    edit_info(tmp_path, features={})
    with pytest.raises(LeRobotError, match="pass image_size_hw"):
        read(tmp_path)
    assert read(tmp_path, image_size_hw=(480, 640))[0].image_size_hw == (480, 640)


def test_a_root_without_shapes_says_so(tmp_path):
    write_root(tmp_path, RootPlan(dialect="world", lengths=(8,)))
    replace_column(tmp_path / FIRST, "observation.state", None)
    (episode,) = read(tmp_path)
    assert not hand_state.unpack(episode.hand_state).shape_params.any()
    assert "no hand shape in the source" in episode.meta["warnings"][0]


# ----------------------------------------------------------------------------------------- writing


def test_a_writer_that_stops_leaves_nothing(tmp_path):
    def broken():
        yield make_episode(9)
        raise RuntimeError("power cut")

    with pytest.raises(RuntimeError, match="power cut"):
        to_lerobot(broken(), tmp_path / "out", file_bytes=1)
    assert list(tmp_path.iterdir()) == []


def test_refuses_what_lerobot_cannot_say(tmp_path):
    folder, episode = tmp_path / "out", make_episode(9)
    with pytest.raises(LeRobotError, match="episodes: expected at least one"):
        to_lerobot([], folder)
    with pytest.raises(LeRobotError, match="key: expected each once, got synthetic-0 twice"):
        to_lerobot([episode, episode], folder)
    with pytest.raises(LeRobotError, match="expected 30 frames a second"):
        to_lerobot([make_episode(9, fps=25.0)], folder)
    uneven = replace(episode, timestamps_s=episode.timestamps_s + 0.002 * (np.arange(9) == 4))
    with pytest.raises(LeRobotError, match=r"0.002 s at frame 4 .*extra=True"):
        to_lerobot([uneven], folder)
    with pytest.raises(LeRobotError, match="expected 'camera' or 'world', got 'both'"):
        to_lerobot([episode], folder, "both")
    with pytest.raises(ValueError, match="expected 'raise' or 'skip'"):
        from_lerobot(folder, on_error="ignore")
    assert not folder.exists()
    to_lerobot([episode], folder)
    with pytest.raises(LeRobotError, match="expected a new or an empty folder"):
        to_lerobot([episode], folder)
