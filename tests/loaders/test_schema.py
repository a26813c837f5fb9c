import doctest
import hashlib
import io
import json
import os
import pickle
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mint_hub.geometry import hand_state
from mint_hub.geometry.camera import project
from mint_hub.geometry.hand_model import HandModel
from mint_hub.loaders import schema
from mint_hub.loaders.schema import (
    ARRAY_FIELDS,
    SCHEMA_VERSION,
    Episode,
    EpisodeError,
    TextSegment,
)
from tests.episodes import make_episode

settings.register_profile("episodes", deadline=None, max_examples=20)
settings.load_profile("episodes")


@pytest.fixture(scope="module")
def episode() -> Episode:
    return make_episode(24, seed=3)


# ------------------------------------------------------------------ record


def test_arrays_are_those_declared_and_cannot_be_written(episode):
    episode = replace(episode, filled=np.zeros((24, 2), bool))
    for spec in ARRAY_FIELDS:
        array = getattr(episode, spec.name)
        assert array.dtype == np.dtype(spec.dtype)
        assert array.shape == tuple(24 if n == "T" else n for n in spec.shape)
        with pytest.raises(ValueError, match="read-only"):
            array[0] = array[1]


def test_the_callers_arrays_are_neither_shared_nor_frozen(episode):
    times = np.arange(24) / 30
    made = replace(episode, timestamps_s=times)
    times[3] = -1.0
    assert made.timestamps_s[3] == 3 / 30


def test_kinds_convert_upwards_only(episode):
    assert replace(episode, timestamps_s=range(24)).timestamps_s.dtype == np.float64
    with pytest.raises(EpisodeError, match=r"presence: expected dtype bool, got float"):
        replace(episode, presence=episode.presence.astype(float))


def _with(array, index, value):
    changed = np.array(array)
    changed[index] = value
    return changed


@pytest.mark.parametrize(
    ("field", "change", "message"),
    [
        ("key", lambda _: "a.b", r"key: expected only a-z.*got 'a\.b'"),
        ("key", lambda _: "", "key: expected"),
        ("hand_state", lambda x: x[..., :108], r"\(T, 2, 109\) with T = 24, got \(24, 2, 108\)"),
        ("hand_state", lambda x: x[:-1], r"with T = 24, got \(23, 2, 109\)"),
        ("hand_state", lambda x: _with(x, (5, 1, 0), np.inf), r"finite numbers, got inf at \(5, 1"),
        ("hand_state", lambda x: x.astype(complex), "expected dtype float32, got complex128"),
        ("hand_state", lambda x: np.full(x.shape, 1e300), "expected finite numbers, got inf"),
        ("hand_state", lambda x: _with(x, (7, 0, slice(3, 9)), 0), "frame 7, left joint 0"),
        ("hand_state", lambda x: _with(x, (7, 1, slice(9, 15)), 2), "frame 7, right joint 1"),
        ("hand_state", lambda _: [[1], [1, 2]], "expected an array, got list"),
        ("timestamps_s", lambda x: x[::-1], r"increasing times, got \[0\.76.* at frame 0"),
        ("timestamps_s", lambda x: _with(x, 4, x[3]), "increasing times.* at frame 3"),
        ("timestamps_s", lambda x: x[:0], "at least one frame"),
        ("T_camera_from_world", lambda x: 2 * x, "last row"),
        ("T_camera_from_world", lambda x: _with(x, (2, 0, 0), 3), "R Rᵀ = I.* at frame 2"),
        ("T_camera_from_world", lambda x: x * [[-1], [1], [1], [1]], "reflection at frame 0"),
        ("fov_vh_rad", lambda x: _with(x, (1, 1), 0), r"0 < x < 3\.14.*, got 0\.0 at \(1, 1\)"),
        ("fov_vh_rad", lambda x: _with(x, (1, 1), 60), "got 60"),
        ("presence_score", lambda x: _with(x, (0, 0), 1.5), "0 <= x <= 1, got 1.5"),
        ("filled", lambda _: np.ones((24, 2), bool), "hands that are present.* frame 12, left"),
        ("filled", lambda _: np.zeros((23, 2), bool), r"with T = 24, got \(23, 2\)"),
        ("filled", lambda _: np.zeros((24, 2)), "expected dtype bool, got float64"),
        ("image_size_hw", lambda _: (480, 0), "positive sizes"),
        ("image_size_hw", lambda _: (480.0, 640), "whole number, got 480.0"),
        ("image_size_hw", lambda _: 480, "expected \\(height, width\\)"),
        (
            "text",
            lambda _: (TextSegment("x", "", None, 0, 25),),
            "'x' end: expected at most T",
        ),
        ("text", lambda _: ({"id": "x"},), "expected TextSegments"),
        ("text", lambda _: None, "text: expected a tuple of TextSegments, got None"),
        ("text", lambda _: 3, "text: expected a tuple of TextSegments, got 3"),
        (
            "meta",
            lambda _: {"a": [{"b": float("nan")}]},
            r"meta\['a'\]\[0\]\['b'\]: expected",
        ),
        ("meta", lambda _: {"a": np.float32(1)}, r"meta\['a'\]: expected a JSON value"),
        ("meta", lambda _: {1: 2}, "expected names as keys, got 1"),
        ("meta", lambda _: {"fps": -1}, "expected a positive number, got -1"),
        ("meta", lambda _: {"source_timestamps_s": [0.0]}, "a list of 24"),
    ],
)
def test_errors_name_field_expectation_and_episode(episode, field, change, message):
    with pytest.raises(EpisodeError, match=message) as caught:
        replace(episode, **{field: change(getattr(episode, field))})
    assert field.split("_")[0] in str(caught.value)
    if field != "key":
        assert "(episode synthetic-0)" in str(caught.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"side": "both hands"}, "expected left, right, both or None, got 'both hands'"),
        ({"start": 3}, "expected frames 0 <= start < end, got start 3, end 3"),
        ({"end": 2.0}, "'x' end: expected a whole number, got 2.0"),
        ({"start": True}, "got True"),
        ({"id": 7}, "text segment id: expected str, got 7"),
    ],
)
def test_text_segments_are_checked(change, message):
    with pytest.raises(EpisodeError, match=message):
        TextSegment(**{"id": "x", "text": "t", "side": None, "start": 0, "end": 3, **change})


def test_repr_is_one_line_that_says_what_it_is(episode):
    assert repr(episode).startswith("Episode('synthetic-0', 24 frames, 0.80 s at 30 fps, left ")


# ----------------------------------------------------------------- derived


def test_rate_comes_from_meta_else_from_the_timestamps(episode):
    bare = {k: v for k, v in episode.meta.items() if k != "fps"}
    assert replace(episode, meta=bare).fps == 30.0
    assert replace(episode, meta=bare, timestamps_s=np.arange(24) / 25 + 7).fps == 25.0
    assert replace(episode, meta={**bare, "fps": 10}).fps == 10.0
    assert episode.window(0, 1).duration_s == pytest.approx(1 / 30)


def test_world_and_camera_agree(episode):
    T = episode.T_camera_from_world
    np.testing.assert_allclose(
        T @ episode.T_world_from_camera, np.tile(np.eye(4), (24, 1, 1)), atol=1e-9
    )
    np.testing.assert_allclose(
        T[:, None] @ episode.wrist_world(), episode.wrist_camera(), atol=1e-9
    )
    world, camera = episode.joints_world(), episode.joints_camera()
    back = np.einsum("tij,thkj->thki", T[:, :3, :3], world) + T[:, None, None, :3, 3]
    np.testing.assert_allclose(back, camera, atol=1e-5)


def test_absent_hands_are_nan_and_present_ones_are_not(episode):
    there = episode.presence
    assert not there.all()
    for derived in (
        episode.joints_camera(),
        episode.joints_world(),
        episode.wrist_camera(),
        episode.wrist_world(),
    ):
        finite = np.isfinite(derived).all(axis=(-1, -2))
        nan = np.isnan(derived).all(axis=(-1, -2))
        np.testing.assert_array_equal(finite, there)
        np.testing.assert_array_equal(nan, ~there)


def test_first_keypoint_is_the_wrist(episode):
    np.testing.assert_allclose(
        episode.joints_camera()[:, :, 0], episode.wrist_camera()[..., :3, 3], atol=1e-6
    )


def test_world_hand_states_give_the_world_joints(episode):
    model = HandModel.template()
    joints = np.asarray(model.keypoints(episode.hand_state_world()))
    there = episode.presence
    np.testing.assert_allclose(joints[there], episode.joints_world(model)[there], atol=1e-5)
    world, stored = (
        hand_state.unpack(episode.hand_state_world()),
        hand_state.unpack(episode.hand_state),
    )
    np.testing.assert_array_equal(world.joint_rot6d_rows, stored.joint_rot6d_rows)
    np.testing.assert_array_equal(world.shape_params, stored.shape_params)


def test_k_sees_the_edge_of_the_field_of_view_at_the_edge_of_the_image(episode):
    vertical, horizontal = episode.fov_vh_rad.astype(float).T / 2
    corner = np.stack([np.tan(horizontal), np.tan(vertical), np.ones(24)], axis=-1)
    for k in range(24):
        uv, _ = project(corner[k], episode.K[k])
        np.testing.assert_allclose(uv, (640, 480), rtol=1e-6)


# ------------------------------------------------------------------ window


@given(data=st.data())
def test_a_window_of_a_window_is_a_window(episode, data):
    start = data.draw(st.integers(0, 23))
    length = data.draw(st.integers(1, 24 - start))
    inner = data.draw(st.integers(0, length - 1))
    size = data.draw(st.integers(1, length - inner))
    twice = episode.window(start, length).window(inner, size)
    assert twice.allclose(episode.window(start + inner, size), atol=0)
    np.testing.assert_array_equal(twice.hand_state, episode.hand_state[start + inner :][:size])


def test_the_whole_window_is_the_episode(episode):
    assert episode.window(0, 24).allclose(episode, atol=0)


def test_windows_cut_text_and_per_frame_meta(episode):
    window = episode.window(10, 6)
    assert window.meta["window_start"] == 10
    assert window.meta["source_timestamps_s"] == episode.meta["source_timestamps_s"][10:16]
    assert [(s.id, s.start, s.end) for s in window.text] == [("a", 0, 2), ("b", 0, 6)]
    assert [s.id for s in episode.window(12, 2).text] == ["b"]


def test_windows_cut_what_is_filled(episode):
    assert episode.filled is None
    assert episode.window(10, 6).filled is None
    filled = episode.presence & (np.arange(24) % 3 == 0)[:, None]
    window = replace(episode, filled=filled).window(10, 6)
    np.testing.assert_array_equal(window.filled, filled[10:16])


@pytest.mark.parametrize(("start", "length"), [(-1, 3), (0, 0), (22, 3), (24, 1)])
def test_windows_beyond_the_frames_are_refused(episode, start, length):
    with pytest.raises(EpisodeError, match=f"got start {start}, length {length}"):
        episode.window(start, length)


def test_allclose_sees_every_field(episode):
    changes = {
        "key": "other",
        "timestamps_s": episode.timestamps_s + 1e-3,
        "T_camera_from_world": _with(episode.T_camera_from_world, (3, 0, 3), 9),
        "fov_vh_rad": episode.fov_vh_rad + np.float32(1e-3),
        "hand_state": _with(episode.hand_state, (3, 0, 108), 9),
        "presence": ~episode.presence,
        "presence_score": None,
        "filled": np.zeros((24, 2), bool),
        "image_size_hw": (640, 480),
        "text": (),
        "meta": {},
    }
    assert episode.allclose(replace(episode))
    for name, value in changes.items():
        assert not episode.allclose(replace(episode, **{name: value})), name
    assert not episode.allclose(episode.window(0, 23))


# -------------------------------------------------------------- dict, file

json_values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)


@given(
    num_frames=st.integers(1, 12),
    seed=st.integers(0, 99),
    scored=st.booleans(),
    marked=st.booleans(),
    text=st.text(),
    extra=json_values,
)
def test_file_and_dict_give_back_the_episode(
    tmp_path_factory, num_frames, seed, scored, marked, text, extra
):
    segment = TextSegment("ü", text, None, 0, num_frames)
    made = replace(make_episode(num_frames, seed, meta={"extra": extra}), text=(segment,))
    if not scored:
        made = replace(made, presence_score=None)
    if marked:
        made = replace(made, filled=made.presence & (np.arange(num_frames) % 2 == 0)[:, None])
    path = made.save(tmp_path_factory.mktemp("episode") / "x.npz")
    assert Episode.load(path).allclose(made, atol=0)
    assert Episode.from_dict(made.to_dict()).allclose(made, atol=0)
    listed = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in made.to_dict().items()}
    assert Episode.from_dict(json.loads(json.dumps(listed))).allclose(made, atol=0)


def test_equal_episodes_are_equal_bytes_that_plain_numpy_reads(episode, tmp_path):
    paths = [make_episode(24, seed=3).save(tmp_path / name) for name in ("a.npz", "b/c.npz")]
    assert len({hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}) == 1
    with np.load(paths[0], allow_pickle=False) as plain:
        assert json.loads(str(plain["meta"])) == episode.meta
        np.testing.assert_array_equal(plain["hand_state"], episode.hand_state)


def test_saving_is_all_or_nothing(episode, tmp_path, monkeypatch):
    path = episode.save(tmp_path / "x.npz")
    before = path.read_bytes()

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        episode.window(0, 5).save(path)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["x.npz"]


def test_other_suffixes_are_refused(episode, tmp_path):
    with pytest.raises(EpisodeError, match=r"x\.npy: expected a name that ends in \.npz"):
        episode.save(tmp_path / "x.npy")
    assert not os.listdir(tmp_path)


def _rewrite(path: Path, drop: str = "", **members: object) -> None:
    with zipfile.ZipFile(path) as archive:
        content = {name: archive.read(name) for name in archive.namelist()}
    content.pop(drop + ".npy", None)
    for name, value in members.items():
        buffer = io.BytesIO()
        np.lib.format.write_array(buffer, np.asarray(value), allow_pickle=True)
        content[name + ".npy"] = buffer.getvalue()
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in content.items():
            archive.writestr(name, data)


class _Bomb:
    def __reduce__(self):
        return pytest.fail, ("unpickled",)


@pytest.mark.parametrize(
    ("drop", "members", "message"),
    [
        ("fov_vh_rad", {}, "fov_vh_rad: expected this field, got none"),
        ("meta", {}, "meta: expected this member, got none"),
        ("key", {}, "key: expected this member, got none"),
        ("schema_version", {}, "schema_version: expected this member, got none"),
        ("", {"meta": "{"}, "meta: expected JSON, got"),
        ("", {"meta": "3"}, "meta: expected a mapping, got int"),
        ("", {"text": '[{"id": "x"}]'}, r"text segment: expected \['end', .*got \['id'\]"),
        ("", {"surprise": 1}, "surprise: expected a field of an episode"),
        ("", {"key": np.array([_Bomb()], dtype=object)}, "key: expected a plain npy array"),
        ("", {"schema_version": 1.5}, "schema_version: expected a whole number"),
        ("", {"schema_version": 0}, "schema_version: expected at least 1, got 0"),
        ("", {"schema_version": -1}, "schema_version: expected at least 1, got -1"),
        (
            "",
            {"presence": np.zeros((3, 2), bool)},
            r"presence: expected shape \(T, 2\) with T = 24",
        ),
        (
            "",
            {"schema_version": SCHEMA_VERSION + 1},
            "at most 1, got 2: written by a newer",
        ),
    ],
)
def test_tampered_files_are_refused(episode, tmp_path, drop, members, message):
    path = episode.save(tmp_path / "x.npz")
    _rewrite(path, drop, **members)
    with pytest.raises(EpisodeError, match=message) as caught:
        Episode.load(path)
    assert str(path) in str(caught.value)


@given(data=st.data())
def test_files_cut_short_or_overwritten_are_refused(episode, tmp_path_factory, data):
    path = episode.save(tmp_path_factory.mktemp("cut") / "x.npz")
    whole = path.read_bytes()
    path.write_bytes(whole[: data.draw(st.integers(0, len(whole) - 1))])
    with pytest.raises(EpisodeError, match=r"x\.npz: "):
        Episode.load(path)
    with zipfile.ZipFile(io.BytesIO(whole)) as archive:
        payload = archive.getinfo("hand_state.npy")
    at = payload.header_offset + 400 + data.draw(st.integers(0, payload.file_size - 400))
    path.write_bytes(whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :])
    with pytest.raises(EpisodeError, match=r"x\.npz: "):
        Episode.load(path)


def test_a_missing_file_says_so(tmp_path):
    with pytest.raises(FileNotFoundError):
        Episode.load(tmp_path / "none.npz")


def test_episodes_travel_between_processes(episode):
    assert pickle.loads(pickle.dumps(episode)).allclose(episode, atol=0)


def test_the_examples_in_the_docs_hold():
    assert doctest.testmod(schema).failed == 0
