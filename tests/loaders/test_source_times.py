"""Times of stored frames in few bytes: exact, cut with the frames, and older files are read."""

import json
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mint_hub.loaders.fields import EpisodeError
from mint_hub.loaders.members import META, decode, encode
from mint_hub.loaders.meta_member import canonical_json
from mint_hub.loaders.source_times import REGULAR_TOLERANCE_S, pack, unpack
from mint_hub.loaders.video import iter_frames
from tests import video_files
from tests.episodes import make_episode

examples = settings(deadline=None, max_examples=60)


def shown(rate: Fraction, ticks: int, num_frames: int, start: int = 0) -> list[float]:
    """Times of the stored frames nearest to 30 frames a second, as a container says them."""
    stored = [
        float(Fraction(start + round(k / rate * ticks), ticks))
        for k in range(2 + int(num_frames * rate / 30))
    ]
    wanted = stored[0] + np.arange(num_frames) / 30
    return [stored[int(np.argmin(np.abs(np.array(stored) - t)))] for t in wanted]


RATES = [
    (Fraction(30), 15360),
    (Fraction(30000, 1001), 30000),
    (Fraction(30000, 1001), 1000),
    (Fraction(24000, 1001), 24000),
    (Fraction(25), 12800),
    (Fraction(50), 90000),
    (Fraction(60000, 1001), 90000),
]


@pytest.mark.parametrize(("rate", "ticks"), RATES)
@pytest.mark.parametrize("start", [0, 12345])
def test_native_rates_take_less_than_a_byte_a_frame(rate, ticks, start):
    times = shown(rate, ticks, 600, start)
    packed = pack(times)
    assert unpack(json.loads(json.dumps(packed)), 600) == times
    assert len(json.dumps(packed, separators=(",", ":"))) < 600


@examples
@given(
    steps=st.lists(st.integers(0, 9000), max_size=60),
    repeats=st.integers(1, 5),
    ticks=st.sampled_from([1, 1000, 12800, 90000, 10**6, 10**9]),
    first=st.integers(-(10**6), 10**9),
)
def test_any_ticks_come_back_to_the_bit(steps, repeats, ticks, first):
    counts = np.cumsum([first, *steps * repeats]).tolist()
    times = [count / ticks for count in counts]
    packed = pack(times)
    assert isinstance(packed, dict)
    back = unpack(json.loads(json.dumps(packed)), len(times))
    assert back == times
    assert pack(back) == packed


@examples
@given(
    times=st.lists(
        st.none() | st.booleans() | st.text(max_size=3) | st.integers() | st.floats(width=64)
    )
)
def test_anything_else_is_the_list_itself_or_equal_to_a_microsecond(times):
    packed = pack(times)
    back = unpack(packed, len(times))
    if isinstance(packed, list):
        assert repr(back) == repr(times)
    else:
        np.testing.assert_allclose(back, times, rtol=0, atol=REGULAR_TOLERANCE_S)
        assert "fps" in packed or back == times


@examples
@given(start=st.floats(0, 1e4), fps=st.floats(1, 240), count=st.integers(2, 300))
def test_start_and_rate_are_enough_where_they_say_it_all(start, fps, count):
    times = (start + np.arange(count) / fps).tolist()
    packed = pack(times)
    np.testing.assert_allclose(unpack(packed, count), times, rtol=0, atol=REGULAR_TOLERANCE_S)
    assert len(json.dumps(packed)) < 150
    assert pack(unpack(packed, count)) == packed


def test_a_predicted_episode_keeps_to_470_bytes_a_frame():
    """What ``MintRunner`` says of a minute, the five worst seams included."""
    seam = {"start": 1234, "rotation_deg": 0.123456789012345, "translation_m": 0.0123456789012}
    provenance = {
        "task": "egocentric-hands",
        "model": "somebody/mint-large",
        "revision": "0123456789abcdef" * 2,
        "settings": {f"setting_{i}": None for i in range(16)},
        "seams": {"count": 75, "worst": [seam] * 5},
    }
    meta = {
        "source_timestamps_s": shown(Fraction(30000, 1001), 30000, 1800),
        "conventions": "camera: world-to-camera, OpenCV axes, metres; hands: camera frame",
        "hand_model": "mint-hand-template-1",
        "provenance": provenance,
    }
    made = make_episode(1800, meta=meta)
    members = encode(made)
    in_tar = sum(512 + -(-len(data) // 512) * 512 for data in members.values())
    assert in_tar / 1800 <= 470
    assert decode(members).meta == made.meta


def test_a_variable_frame_rate_comes_back_to_the_bit_and_is_cut_with_the_frames(tmp_path):
    rng = np.random.default_rng(0)
    path = video_files.vfr(tmp_path / "v.mkv", np.cumsum(rng.integers(15, 60, 50)).tolist())
    frames = list(iter_frames(path))
    times = [frame.source_timestamp_s for frame in frames]
    assert len(set(np.diff(times).round(6))) > 5
    made = make_episode(len(frames), meta={"source_timestamps_s": times})
    members = encode(made)
    assert isinstance(json.loads(members[META])["meta"]["source_timestamps_s"], dict)
    back = decode(members)
    assert back.meta["source_timestamps_s"] == times
    cut = back.window(7, 11)
    assert cut.meta["source_timestamps_s"] == times[7:18]
    assert decode(encode(cut)).meta["source_timestamps_s"] == times[7:18]


def in_full(made) -> dict[str, bytes]:
    members = encode(made)
    values = json.loads(members[META])
    values["meta"]["source_timestamps_s"] = made.meta["source_timestamps_s"]
    return {**members, META: canonical_json(values)}


def test_older_files_that_hold_the_list_are_read():
    made = make_episode(24)
    assert decode(in_full(made)).meta == decode(encode(made)).meta == made.meta


REGULAR = {"start_s": 0.0, "fps": 30.0, "count": 24}
TICKS = {"ticks_a_second": 30, "first": 0, "step": 1, "blocks": [[[0], 23]]}


@pytest.mark.parametrize(
    "form",
    [
        {**REGULAR, "count": 10**15},
        {**REGULAR, "fps": 0.0},
        {**REGULAR, "fps": "30"},
        {**TICKS, "blocks": [[[0], 10**15]]},
        {**TICKS, "blocks": [[[0], 30], [[0], -7]]},
        {**TICKS, "blocks": [[[0.5], 23]]},
        {**TICKS, "blocks": 7},
        {**TICKS, "ticks_a_second": 0},
        {**TICKS, "first": 10**400},
        {"first": 0},
        [0.0] * 23,
        "0, 1, 2",
    ],
)
def test_a_short_form_that_cannot_be_is_refused(form):
    members = encode(make_episode(24))
    values = json.loads(members[META])
    values["meta"]["source_timestamps_s"] = form
    with pytest.raises(EpisodeError, match=r"source_timestamps_s: expected .*\(episode synthetic"):
        decode({**members, META: canonical_json(values)})


def test_the_bytes_of_an_episode_do_not_depend_on_how_its_times_were_stored():
    made = replace(make_episode(24), key="a")
    assert encode(decode(in_full(made)))[META] == encode(decode(encode(made)))[META]
