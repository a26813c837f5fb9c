import doctest
import io
import json
import mmap
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mint_hub.geometry import hand_state as hands
from mint_hub.geometry.rotations import geodesic_angle, rot6d_rows_to_matrix
from mint_hub.loaders import members, npy_member
from mint_hub.loaders.member_table import MEMBERS, member, member_names
from mint_hub.loaders.members import (
    EXTRA,
    MAX_COMPACT_ERROR_DEG,
    META,
    ROT6D,
    STATE,
    TRAJ,
    arrays_of,
    data_offset,
    decode,
    decode_meta,
    encode,
)
from mint_hub.loaders.meta_member import META_FIELDS, canonical_json
from mint_hub.loaders.schema import SCHEMA_VERSION, Episode, EpisodeError, TextSegment
from tests.episodes import make_episode

examples = settings(deadline=None, max_examples=25)
WHERE = "ego4d-train-00012.tar"


def any_episode(num_frames: int, seed: int, *, scored: bool = True, shape_varies: bool = False):
    """Anything the schema allows: wild rotations, hands that come, go and are filled in."""
    rng = np.random.default_rng(seed)
    base = make_episode(num_frames, seed)
    presence = rng.random((num_frames, 2)) < rng.choice([0.0, 0.5, 1.0], 2)
    filled = presence & (rng.random((num_frames, 2)) < 0.3)
    rotations = Rotation.random(num_frames * 32, rng=rng).as_matrix()[:, :2].reshape(-1, 2, 96)
    shape = rng.normal(0, 2, (num_frames if shape_varies else 1, 2, 10))
    state = np.concatenate(
        [
            rng.normal(0, 1, (num_frames, 2, 3)),
            rotations,
            np.broadcast_to(shape, (num_frames, 2, 10)),
        ],
        axis=-1,
    )
    T = np.tile(np.eye(4), (num_frames, 1, 1))
    T[:, :3, :3] = Rotation.random(num_frames, rng=rng).as_matrix()
    T[:, :3, 3] = rng.normal(0, 3, (num_frames, 3))
    start = float(rng.choice([0.0, 12.5, 4321.0]))
    return replace(
        base,
        timestamps_s=start + np.arange(num_frames) / 30,
        T_camera_from_world=T,
        hand_state=np.where(presence[..., None], state, hands.absent((num_frames, 2))),
        presence=presence,
        presence_score=base.presence_score if scored else None,
        filled=filled if filled.any() else None,
    )


def rotations_of(episode: Episode) -> np.ndarray:
    state = hands.unpack(episode.hand_state.astype(np.float64))
    rows = np.concatenate([state.orientation_rot6d_rows[..., None, :], state.joint_rot6d_rows], -2)
    return rot6d_rows_to_matrix(rows)


def worst_angle_deg(a: Episode, b: Episode) -> float:
    return float(np.rad2deg(geodesic_angle(rotations_of(a), rotations_of(b)).max()))


# ------------------------------------------------------------------------------ the table


def test_the_table_is_the_published_layout():
    widths = {m.name: (m.dtype, m.width) for m in MEMBERS}
    assert widths == {
        "traj.npy": ("float32", 17),
        "rot6d.npy": ("float16", 192),
        "state.npy": ("float32", 218),
        "extra.npy": ("float32", 3),
    }
    assert {name: (s.start, s.stop) for name, s in member(TRAJ).slices.items()} == {
        "camera_translation": (0, 3),
        "camera_quat_xyzw": (3, 7),
        "fov_vh": (7, 9),
        "left_wrist": (9, 12),
        "right_wrist": (12, 15),
        "left_presence": (15, 16),
        "right_presence": (16, 17),
    }
    assert [c.width for c in member(ROT6D).columns] == [6, 90, 6, 90]
    assert member_names() == (META, TRAJ, ROT6D)
    assert member_names("lossless", extra=True) == (META, TRAJ, STATE, EXTRA)


def test_unknown_names_and_formats_are_refused():
    with pytest.raises(EpisodeError, match=r"expected one of .*, got 'depth\.npy'"):
        member("depth.npy")
    with pytest.raises(EpisodeError, match="format: expected 'compact' or 'lossless', got 'zip'"):
        encode(make_episode(4), "zip")  # type: ignore[arg-type]


# ------------------------------------------------------------------------------ round trip


@examples
@given(
    num_frames=st.integers(1, 12),
    seed=st.integers(0, 10**6),
    format=st.sampled_from(["compact", "lossless"]),
    extra=st.booleans(),
    scored=st.booleans(),
)
def test_an_episode_comes_back(num_frames, seed, format, extra, scored):
    made = any_episode(num_frames, seed, scored=scored, shape_varies=format == "lossless")
    back = decode(encode(made, format, extra))
    if format == "lossless":
        np.testing.assert_array_equal(back.hand_state, made.hand_state)
    else:
        assert worst_angle_deg(back, made) <= MAX_COMPACT_ERROR_DEG
        mine, theirs = hands.unpack(back.hand_state), hands.unpack(made.hand_state)
        np.testing.assert_array_equal(mine.translation, theirs.translation)
        np.testing.assert_array_equal(mine.shape_params, theirs.shape_params)
    np.testing.assert_array_equal(back.fov_vh_rad, made.fov_vh_rad)
    np.testing.assert_array_equal(back.presence, made.presence)
    np.testing.assert_allclose(
        back.T_camera_from_world, made.T_camera_from_world, atol=2e-6, rtol=0
    )
    np.testing.assert_array_equal(
        back.T_camera_from_world[:, :3, 3], made.T_camera_from_world[:, :3, 3].astype(np.float32)
    )
    np.testing.assert_allclose(back.timestamps_s, made.timestamps_s, atol=1e-6, rtol=0)
    if extra and scored:
        np.testing.assert_array_equal(back.presence_score, made.presence_score)
    else:
        assert back.presence_score is None
    assert (back.filled is None) == (made.filled is None)
    if made.filled is not None:
        np.testing.assert_array_equal(back.filled, made.filled)
    assert (back.key, back.text, back.image_size_hw) == (made.key, made.text, made.image_size_hw)
    assert back.meta == made.meta


@examples
@given(seed=st.integers(0, 10**6), scale=st.floats(0.05, 50), lean=st.floats(0, 0.9))
def test_rows_that_are_not_orthonormal_keep_their_rotation(seed, scale, lean):
    made = any_episode(3, seed)
    state = np.array(made.hand_state)
    rows = state[..., 3:99].reshape(3, 2, 16, 2, 3)
    rows[..., 1, :] += lean * rows[..., 0, :]
    rows *= np.float32(scale)
    made = replace(made, hand_state=state)
    assert worst_angle_deg(decode(encode(made)), made) <= MAX_COMPACT_ERROR_DEG


def test_compact_rotations_are_within_the_stated_angle():
    made = any_episode(400, 7)
    assert made.presence.any()
    worst = worst_angle_deg(decode(encode(made)), made)
    assert 0.02 < worst < 0.03


@pytest.mark.parametrize("format", ["compact", "lossless"])
def test_absent_hands_are_stored_canonically(format):
    made = make_episode(24, seed=1)
    odd = np.where(made.presence[..., None], made.hand_state, made.hand_state[:1] + np.float32(0.3))
    assert not made.presence.all()
    back = decode(encode(replace(made, hand_state=odd), format))
    gone = back.hand_state[~back.presence]
    np.testing.assert_array_equal(gone, hands.absent(gone.shape[:1]))


def test_a_hand_that_never_comes_has_no_shape():
    made = make_episode(6, gaps=False)
    made = replace(made, presence=np.tile([True, False], (6, 1)))
    shape = decode_meta(encode(made)[META])["shape"]
    there = hands.unpack(made.hand_state[0, 0]).shape_params
    np.testing.assert_array_equal(np.float32(shape[0]), there)
    assert shape[1] == [0.0] * 10


@pytest.mark.parametrize("format", ["compact", "lossless"])
def test_rows_of_a_window_are_a_window_of_the_rows(format):
    made = any_episode(20, 5)
    whole, part = arrays_of(encode(made, format)), arrays_of(encode(made.window(6, 9), format))
    for name in whole:
        np.testing.assert_array_equal(part[name], whole[name][6:15])


def test_a_shape_that_varies_needs_lossless():
    made = any_episode(30, 12, shape_varies=True)
    assert (made.presence.sum(axis=0) > 1).any()
    with pytest.raises(EpisodeError, match=r"one (left|right) shape.*use lossless.*synthetic-0"):
        encode(made)
    np.testing.assert_array_equal(decode(encode(made, "lossless")).hand_state, made.hand_state)


def test_times_off_the_grid_need_extra():
    times = np.arange(12) / 30 + np.linspace(0, 0.01, 12) ** 2 * 100
    made = replace(make_episode(12), timestamps_s=times)
    with pytest.raises(EpisodeError, match=r"timestamps_s: expected start \+ k / 30.*extra=True"):
        encode(made)
    back = decode(encode(made, extra=True))
    np.testing.assert_allclose(back.timestamps_s, times, atol=1e-6, rtol=0)


def test_times_far_from_the_rate_are_refused():
    made = make_episode(12, meta={"fps": 0.1})
    with pytest.raises(EpisodeError, match=r"start \+ k / 0\.1 within 32 s, got 109.*its fps"):
        encode(made, extra=True)


def test_lengths_beyond_float32_are_refused():
    far = np.array(make_episode(4).T_camera_from_world)
    far[2, 0, 3] = 1e39
    with pytest.raises(EpisodeError, match=r"T_camera_from_world: expected .*1e\+39.* frame 2"):
        encode(replace(make_episode(4), T_camera_from_world=far))


def test_the_rate_is_always_stated():
    made = make_episode(12, fps=25.0)
    bare = replace(made, meta={k: v for k, v in made.meta.items() if k != "fps"})
    back = decode(encode(bare))
    assert back.fps == 25.0
    assert back.meta == {**bare.meta, "fps": 25.0}


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=6,
)  # fmt: skip


@examples
@given(meta=st.dictionaries(st.text(), json_values, max_size=4), text=st.text())
def test_any_meta_and_text_come_back(meta, text):
    stated = {f.name for f in META_FIELDS if f.from_meta} | {"fps", "source_timestamps_s"}
    meta = {k: v for k, v in meta.items() if k not in stated}
    segment = TextSegment("ü", text, None, 0, 4)
    made = replace(make_episode(4), meta={"fps": 30.0, "uid": text, **meta}, text=(segment,))
    data = encode(made)[META]
    assert data == canonical_json(json.loads(data))
    back = decode(encode(made))
    assert (back.meta, back.text) == (made.meta, made.text)


# ------------------------------------------------------------------------------ the bytes


def test_equal_episodes_are_equal_bytes():
    assert encode(make_episode(24, 3), extra=True) == encode(make_episode(24, 3), extra=True)


@pytest.mark.parametrize("num_frames", [1, 9, 197, 12345])
def test_numbers_begin_where_data_offset_says(num_frames):
    for spec in MEMBERS:
        array = np.random.default_rng(0).random((num_frames, spec.width)).astype(spec.dtype)
        data = npy_member.npy_bytes(array, spec)
        start = data_offset(data)
        assert start % 64 == 0
        assert data[6:8] == b"\x01\x00"
        plain = np.frombuffer(data, np.dtype(spec.dtype).newbyteorder("<"), offset=start)
        np.testing.assert_array_equal(plain.reshape(array.shape), array)
        np.testing.assert_array_equal(np.load(io.BytesIO(data), allow_pickle=False), array)


def test_arrays_share_the_memory_that_they_are_read_from(tmp_path):
    encoded = encode(make_episode(24), extra=True)
    path = tmp_path / "members"
    path.write_bytes(b"".join(encoded.values()))
    with (
        path.open("rb") as file,
        mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as mapped,
    ):
        view, at, parts = memoryview(mapped), 0, {}
        for name, data in encoded.items():
            parts[name] = view[at : at + len(data)]
            at += len(data)
        arrays = arrays_of(parts)
        assert list(arrays) == [TRAJ, ROT6D, EXTRA]
        whole = np.frombuffer(mapped, np.uint8)
        for name, array in arrays.items():
            assert np.shares_memory(array, whole)
            assert not array.flags.writeable
            np.testing.assert_array_equal(array, arrays_of(encoded)[name])
        assert decode(parts).allclose(decode(encoded), atol=0)
        del arrays, array, whole, parts, view


def test_bytes_a_frame_of_a_mean_episode():
    meta = {
        "source": "ego4d",
        "uid": "0a1b2c3d-4e5f-6071-8293-a4b5c6d7e8f9",
        "participant": "812",
        "domain": "daily",
        "native_fps": 30.0,
        "shape_space": "mano",
        "scale_status": "enlarged, not metric",
        "pipeline": "egopipeline-1",
    }
    made = replace(make_episode(197), meta=meta)
    encoded = encode(made)
    rows = sum(array.nbytes for array in arrays_of(encoded).values())
    assert rows == 197 * 452
    assert sum(map(len, encoded.values())) / 197 <= 466
    in_tar = sum(512 + -(-len(data) // 512) * 512 for data in encoded.values())
    assert in_tar / 197 <= 470


# ------------------------------------------------------------------------------ bad input


def npy(array: np.ndarray, *, allow_pickle: bool = False) -> bytes:
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, array, (1, 0), allow_pickle=allow_pickle)
    return buffer.getvalue()


def tampered(parts: dict[str, bytes], name: str, change) -> dict[str, bytes]:
    array = np.array(np.load(io.BytesIO(parts[name]), allow_pickle=False))
    return {**parts, name: npy(change(array))}


def with_value(index, value):
    def change(array):
        array[index] = value
        return array

    return change


def with_entry(parts: dict[str, bytes], **entries) -> dict[str, bytes]:
    return {**parts, META: canonical_json({**json.loads(parts[META]), **entries})}


class Bomb:
    def __reduce__(self):
        return pytest.fail, ("unpickled",)


ARRAY_DEFECTS = [
    (TRAJ, lambda x: x.astype(float), r"traj\.npy: expected dtype float32, got float64"),
    (TRAJ, lambda x: x.astype(">f4"), r"traj\.npy: expected dtype float32, got >f4"),
    (TRAJ, lambda x: x[:, :16], r"traj\.npy: expected \(T, 17\), got \(T, 16\)"),
    (TRAJ, np.ravel, r"traj\.npy: expected \(T, 17\), got \(408,\)"),
    (TRAJ, np.asfortranarray, r"traj\.npy: expected rows one after another"),
    (TRAJ, lambda x: x[:-1], r"traj\.npy: expected 24 frames, got 23"),
    (ROT6D, lambda x: x[:0], r"rot6d\.npy: expected 24 frames, got 0"),
    (ROT6D, lambda x: np.tile(x, 2)[:, :218], r"rot6d\.npy: expected \(T, 192\), got \(T, 218\)"),
    (ROT6D, lambda x: x.astype(np.float32), r"rot6d\.npy: expected dtype float16, got float32"),
    (
        ROT6D,
        with_value((3, 100), np.nan),
        r"rot6d\.npy: expected finite numbers, got nan at frame 3, right_orientation",
    ),
    (TRAJ, with_value((5, 8), np.inf), r"traj\.npy: expected finite .* inf at frame 5, fov_vh"),
    (
        TRAJ,
        with_value((2, slice(3, 7)), [0, 0, 0, 1.01]),
        r"traj\.npy camera_quat_xyzw: expected unit quaternions, got length 1\.01 at frame 2",
    ),
    (TRAJ, with_value((2, slice(3, 7)), 0), r"camera_quat_xyzw: expected unit .* length 0 at"),
    (TRAJ, with_value((7, 16), 3), r"right_presence: expected 0, 1 or 2, got 3\.0 at frame 7"),
    (TRAJ, with_value((7, 7), 0), r"fov_vh_rad: expected 0 < x < 3\.14159, got 0\.0"),
    (
        ROT6D,
        with_value((4, slice(96, 102)), 0),
        r"hand_state: expected two independent rows .* at frame 4, right joint 0",
    ),
]  # fmt: skip


@pytest.mark.parametrize(("name", "change", "message"), ARRAY_DEFECTS)
def test_a_broken_array_is_one_clear_error(name, change, message):
    parts = tampered(encode(make_episode(24)), name, change)
    with pytest.raises(EpisodeError, match=message) as caught:
        decode(parts, WHERE)
    assert str(caught.value).endswith(f" in {WHERE}, episode synthetic-0")
    assert str(caught.value).count("synthetic-0") == 1


ENTRY_DEFECTS = [
    ({"key": "a.b"}, r"json key: expected only a-z.*got 'a\.b'"),
    ({"key": "Upper"}, "json key: expected only a-z.*got 'Upper'"),
    ({"key": None}, "json key: expected only a-z.*got None"),
    ({"schema_version": SCHEMA_VERSION + 1}, "schema_version: expected at most 1, got 2: written"),
    ({"schema_version": 0}, "schema_version: expected at least 1, got 0"),
    ({"schema_version": "1"}, "schema_version: expected integer, got '1'"),
    ({"schema_version": True}, "schema_version: expected integer, got True"),
    ({"surprise": 1}, "json surprise: expected an entry of the schema, got an unknown name"),
    ({"format": "zip"}, "json format: expected compact or lossless, got 'zip'"),
    ({"num_frames": 23, "meta": {}}, r"traj\.npy: expected 23 frames, got 24"),
    ({"num_frames": 0}, "json num_frames: expected a positive number, got 0"),
    ({"fps": -30.0}, "json fps: expected a positive number, got -30.0"),
    ({"start_s": None}, "json start_s: expected number, got None"),
    ({"start_s": 10**400}, "json start_s: expected number, got 1000"),
    ({"image_size_hw": [480]}, r"json image_size_hw: expected \(height, width\)"),
    ({"shape": [[0.0] * 10]}, r"json shape: expected \(2, 10\) finite numbers"),
    ({"shape": [[0.0] * 10, ["x"] * 10]}, r"json shape: expected \(2, 10\) finite numbers"),
    ({"text": [{"id": "x"}]}, r"json text segment: expected \['end'"),
    ({"text": "open"}, "json text: expected array, got 'open'"),
    ({"uid": 7}, "json uid: expected string, got 7"),
    ({"meta": []}, r"json meta: expected object, got \[\]"),
]


@pytest.mark.parametrize(("entries", "message"), ENTRY_DEFECTS)
def test_a_broken_entry_is_one_clear_error(entries, message):
    parts = with_entry(encode(make_episode(24)), **entries)
    with pytest.raises(EpisodeError, match=message) as caught:
        decode(parts, WHERE)
    place = "" if "key" in entries else ", episode synthetic-0"
    assert str(caught.value).endswith(f" in {WHERE}{place}")


@pytest.mark.parametrize("field", META_FIELDS, ids=lambda f: f.name)
def test_every_entry_must_be_there(field):
    parts = encode(make_episode(4))
    values = json.loads(parts[META])
    del values[field.name]
    with pytest.raises(EpisodeError, match=f"json {field.name}: expected"):
        decode({**parts, META: canonical_json(values)}, WHERE)


@pytest.mark.parametrize("name", [META, TRAJ, ROT6D])
def test_a_missing_member_is_named(name):
    parts = encode(make_episode(4))
    del parts[name]
    with pytest.raises(EpisodeError, match=rf"^{name}: expected this member, got \[.*{WHERE}"):
        decode(parts, WHERE)


def test_a_lossless_sample_does_not_pass_for_a_compact_one():
    parts = with_entry(encode(make_episode(4), "lossless"), format="compact")
    with pytest.raises(EpisodeError, match=r"rot6d\.npy: expected this member"):
        decode(parts)


def test_wrists_said_twice_must_agree():
    parts = tampered(encode(make_episode(8), "lossless"), STATE, with_value((3, 109), 9))
    with pytest.raises(EpisodeError, match=r"state\.npy: expected the wrists of traj.*frame 3"):
        decode(parts)


def test_scores_are_all_numbers_or_all_missing():
    parts = encode(make_episode(8), extra=True)
    with pytest.raises(EpisodeError, match=r"presence_score: expected finite numbers, got nan"):
        decode(tampered(parts, EXTRA, with_value((3, 1), np.nan)))
    with pytest.raises(EpisodeError, match=r"extra\.npy: .*nan at frame 3, timestamp_offset"):
        decode(tampered(parts, EXTRA, with_value((3, 0), np.nan)))


def test_nothing_is_unpickled():
    data = npy(np.array([[Bomb()]], dtype=object), allow_pickle=True)
    with pytest.raises(EpisodeError, match=r"traj\.npy: expected dtype float32, got object"):
        decode({**encode(make_episode(4)), TRAJ: data}, WHERE)


@examples
@given(data=st.data())
def test_cut_or_garbled_members_are_refused(data):
    parts = encode(make_episode(8))
    name = data.draw(st.sampled_from([META, TRAJ, ROT6D]))
    cut = data.draw(st.integers(0, len(parts[name]) - 1))
    with pytest.raises(EpisodeError, match=WHERE):
        decode({**parts, name: parts[name][:cut]}, WHERE)
    with pytest.raises(EpisodeError, match=WHERE):
        decode({**parts, name: parts[name] + b"\x01"}, WHERE)
    with pytest.raises(EpisodeError, match=WHERE):
        decode({**parts, name: data.draw(st.binary(max_size=40))}, WHERE)


@pytest.mark.parametrize(
    ("meta", "message"),
    [
        ({"uid": 7}, "uid: expected string, got 7"),
        ({"native_fps": "30"}, "native_fps: expected number, got '30'"),
        ({"note": "\ud800"}, "json: expected text that UTF-8 can say"),
    ],
)
def test_meta_that_cannot_be_written_is_refused(meta, message):
    with pytest.raises(EpisodeError, match=rf"{message}.*\(episode synthetic-0\)"):
        encode(make_episode(4, meta=meta))


def test_the_examples_in_the_docs_hold():
    from mint_hub.loaders import member_table

    for module in (members, member_table, npy_member):
        assert doctest.testmod(module).failed == 0
