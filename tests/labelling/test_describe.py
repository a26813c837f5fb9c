"""Describing: annotations of each source reach the right frames, and nothing else does."""

import doctest
import json
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mint_hub.labelling.label import open_video
from mint_hub.labelling.records import Clip, StageReport, Video
from mint_hub.labelling.stage import NotReadyError, StageError, lost_seconds
from mint_hub.labelling.stages import annotations
from mint_hub.labelling.stages.annotations import Described, described, read_csv, side_of
from mint_hub.labelling.stages.describe import NO_TEXT, Describe, DescribeWithModel, told
from tests import video_files as make

REPORT = StageReport("describe", "test", "1")


def video(folder=Path(), source="user", uid="u", seconds=30.0, start_s=0.0, clips=((0, 900),)):
    """A video of half a minute in clips (first frame, end)."""
    made = tuple(
        Clip(
            f"v-{i:04d}", Path("v.mp4"), 0, (48, 64), 30.0,
            start_s + np.arange(start, stop) / 30,
        )
        for i, (start, stop) in enumerate(clips)
    )  # fmt: skip
    return Video("v", uid, source, folder / "v.mp4", seconds, 30.0, (48, 64), start_s, made)


def told_texts(done):
    return [[(t.text, t.side, t.start, t.end) for t in clip.text] for clip in done.clips]


def describe(made, **values):
    return Describe(Describe.Settings(**values)).run_video(made)


# ---------------------------------------------------------------- readers


def moment(time_s, text, uid):
    return {
        "timestamp_sec": time_s,
        "timestamp_frame": round(time_s * 30),
        "narration_text": text,
        "annotation_uid": uid,
    }


@pytest.fixture
def ego4d(tmp_path):
    first = [
        moment(1.0, "#C C picks up a knife with his left hand", "a"),
        moment(3.0, "#O A man X walks", "b"),
        moment(3.5, "#C C cuts the dough #unsure", "c"),
        moment(12.0, "#C C lifts the tray with both hands", "d"),
        moment(12.0, "#C C looks around", "e"),
        moment(29.0, "#C C sits", "f"),
        moment(31.0, "#C C after the end", "g"),
        moment(20.0, "#unsure", "h"),
    ]
    second = [moment(2.0, "#C C does something else", "z")]
    values = {
        "u": {
            "narration_pass_1": {"narrations": first, "summaries": []},
            "narration_pass_2": {"narrations": second},
        },
        "only-second": {"narration_pass_2": {"narrations": second}},
        "redacted": {"status": "redacted"},
    }
    path = tmp_path / "narration.json"
    path.write_text(json.dumps(values))
    return path


def test_ego4d(ego4d):
    said = described(video(), str(ego4d))
    assert [(s.start_s, s.stop_s, s.text, s.side, s.id) for s in said] == [
        (1.0, 3.0, "C picks up a knife with his left hand", "left", "a"),  # to the next moment
        (3.5, 7.5, "C cuts the dough", None, "c"),  # four seconds at most
        (12.0, 16.0, "C lifts the tray with both hands", "both", "d"),
        (12.0, 16.0, "C looks around", None, "e"),
        (29.0, 30.0, "C sits", None, "f"),  # to the end of the video
    ]
    assert {(s.rule, s.source) for s in said} == {("point", "ego4d narration_pass_1")}
    (second,) = described(video(uid="only-second"), str(ego4d), "ego4d", 1.5)
    assert (second.start_s, second.stop_s, second.source) == (2.0, 3.5, "ego4d narration_pass_2")
    for uid in ("unknown", "redacted"):
        assert described(video(uid=uid), str(ego4d)) == []


@settings(max_examples=50, deadline=None)
@given(times=st.lists(st.floats(0, 29.9), min_size=1, max_size=20))
def test_moments_become_intervals_that_do_not_overlap(times, tmp_path_factory):
    path = tmp_path_factory.mktemp("ego4d") / "n.json"
    narrations = [moment(t, f"#C C does {i}", str(i)) for i, t in enumerate(times)]
    path.write_text(json.dumps({"u": {"narration_pass_1": {"narrations": narrations}}}))
    said = annotations.read_ego4d(path, "u", 30.0)
    assert sorted(s.start_s for s in said) == sorted(times)
    assert all(0 < s.stop_s - s.start_s <= annotations.POINT_S + 1e-9 for s in said)
    for one in said:
        assert not any(one.start_s < t < one.stop_s for t in times)


EPIC = """narration_id,participant_id,video_id,narration_timestamp,start_timestamp,stop_timestamp,start_frame,stop_frame,narration,verb,verb_class,noun,noun_class,all_nouns,all_noun_classes
P01_01_0,P01,P01_01,00:00:01.089,00:00:00.14,00:00:03.37,8,202,open door,open,3,door,3,['door'],[3]
P01_01_1,P01,P01_01,00:00:02.629,00:01:02.5,00:01:04,5,6,,turn-on,6,light,114,['light'],[114]
P01_02_0,P01,P01_02,00:00:02.629,00:00:04.37,00:00:06.17,262,370,wash hands,wash,6,hands,114,['hand'],[114]
"""  # noqa: E501


def test_epic(tmp_path):
    path = tmp_path / "EPIC_100_train.csv"
    path.write_text(EPIC)
    said = described(video(uid="P01_01", seconds=70.0), str(path))
    assert [(s.id, s.start_s, s.stop_s, s.text, s.rule, s.source) for s in said] == [
        ("P01_01_0", 0.14, 3.37, "open door", "interval", "epic"),
        ("P01_01_1", 62.5, 64.0, "turn-on light", "interval", "epic"),
    ]
    assert described(video(uid="P09_01"), str(path)) == []


def test_table_of_the_user(tmp_path):
    path = tmp_path / "mine.csv"
    path.write_text("\ufeffstart, end,side,text\n0:01.5,3,Left,pours\n5,6,,holds with both hands\n")
    said = described(video(), str(path))
    assert [(s.start_s, s.stop_s, s.text, s.side, s.id) for s in said] == [
        (1.5, 3.0, "pours", "left", "mine-2"),
        (5.0, 6.0, "holds with both hands", "both", "mine-3"),
    ]
    path.write_text("video,start,end,text,id\nu,1,2,a,x\nother,1,2,b,y\n")
    assert [(s.text, s.id) for s in described(video(), str(path))] == [("a", "x")]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("start,text\n1,a\n", r"expected the columns end, got \['start', 'text'\]"),
        ("start,end,text\n1,b,c\n", "line 2, end: expected seconds or h:m:s, got 'b'"),
        ("start,end,text\n\n2,1,c\n", "line 3: expected 0 <= start < end, got 2 and 1"),
        ("start,end,text\n1,nan,c\n", "expected 0 <= start < end"),
        ("start,end,text,side\n1,2,c,up\n", "line 2, side: expected left, right, both"),
        ("", "expected the columns start, end, text"),
    ],
)
def test_tables_that_cannot_be_read(tmp_path, text, message):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=rf"bad\.csv.*{message}"):
        read_csv(path, "u")


def test_json_that_cannot_be_read(tmp_path):
    path = tmp_path / "n.json"
    for text, message in (
        ("{", "expected JSON"),
        ("[]", "expected narrations by video, got list"),
        ('{"u": {"narration_pass_1": {"narrations": [{"timestamp_sec": "x"}]}}}', "narration 0"),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=message):
            described(video(), str(path), "ego4d")
        path.unlink()


BOTH_WAYS = {
    "llm_type": "reversible",
    "llm_description": "Open the box with the right hand.",
    "llm_description2": "Close the box.",
    "which_llm_description": "1",
}


def test_egodex_sidecar(tmp_path):
    made = video(tmp_path, "egodex", "fold/12", clips=((0, 300), (270, 900)))
    assert described(made, "") == []  # nothing there: no text, no failure
    (tmp_path / "v.json").write_text(json.dumps(BOTH_WAYS))
    text = "Open the box with the right hand."
    assert told_texts(describe(made)) == [[(text, "right", 0, 300)], [(text, "right", 0, 630)]]
    folder = tmp_path / "texts" / "fold"
    folder.mkdir(parents=True)
    (folder / "12.json").write_text(json.dumps({**BOTH_WAYS, "which_llm_description": "2"}))
    (said,) = described(made, str(tmp_path / "texts"))
    assert (said.text, said.rule, said.source) == ("Close the box.", "whole", "egodex")


class FakeFile(SimpleNamespace):
    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass


def test_egodex_hdf5(tmp_path, monkeypatch):
    made = video(tmp_path, "egodex")
    (tmp_path / "v.hdf5").write_bytes(b"")
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(NotReadyError, match=r"v\.hdf5: .* install h5py"):
        described(made, "")
    attributes = {name: value.encode() for name, value in BOTH_WAYS.items()}
    h5py = SimpleNamespace(File=lambda path, mode: FakeFile(attrs=attributes, path=path, mode=mode))
    monkeypatch.setitem(sys.modules, "h5py", h5py)
    assert described(made, "")[0].text == "Open the box with the right hand."


@pytest.mark.parametrize(
    ("text", "side"),
    [
        ("C picks a cup with her left hand", "left"),
        ("C drops it from the RIGHT hand", "right"),
        ("passes it from the left hand to the right hand", "both"),
        ("wipes left and right hands", "both"),
        ("holds it with two hands", "both"),
        ("turns left", None),
        ("left the handle", None),
        ("washes hands", None),
    ],
)
def test_side_of_a_text(text, side):
    assert side_of(text) == side


def test_what_is_not_there(tmp_path):
    assert described(video(), "") == []
    with pytest.raises(NotReadyError, match=r"annotations at .*none\.json, got no file"):
        described(video(), str(tmp_path / "none.json"))
    with pytest.raises(ValueError, match="format: expected one of auto"):
        Describe(Describe.Settings(format="srt"))
    with pytest.raises(ValueError, match="cut: expected one of none, segments"):
        Describe(Describe.Settings(cut="words"))


# ---------------------------------------------------------------- joining and cutting


def test_frames_and_provenance(tmp_path):
    """A video whose clock starts late: annotations count from its first frame."""
    path = tmp_path / "t.csv"
    path.write_text("start,end,text,id\n1,2,a,x\n9.5,12,b,y\n25,40,c,z\n")
    made = video(start_s=50.0, clips=((0, 300), (300, 600), (600, 900)))
    done = describe(made, path=str(path))
    assert told_texts(done) == [
        [("a", None, 30, 60), ("b", None, 285, 300)],
        [("b", None, 0, 60)],
        [("c", None, 150, 300)],
    ]
    segments = done.clips[0].reports[-1].numbers["segments"]
    assert [s["id"] for s in segments] == ["x", "y"]
    assert segments[0] == {
        "id": "x", "source": "csv", "start_s": 51.0, "stop_s": 52.0, "rule": "interval",
    }  # fmt: skip
    assert done.clips[0].reports[-1].numbers["file"] == "t.csv"
    assert done.reports[-1].numbers["segments"] == 3
    assert done.lost == ()


def test_without_annotations_clips_go_on_without_text():
    done = describe(video())
    assert told_texts(done) == [[]]
    assert done.lost == ()


def said(*spans):
    return [
        Described(a, b, f"t{i}", None, str(i), "interval", "test") for i, (a, b) in enumerate(spans)
    ]


def test_cut_by_segments():
    """Overlapping segments stay together, touching ones do not, silence is lost."""
    (clip,) = video().clips
    spans = [(2.0, 5.0), (4.0, 7.0), (7.0, 9.0), (20.0, 40.0)]
    outcome = told(clip, said(*spans), "segments", REPORT)
    assert [(c.key, c.start_s, c.num_frames) for c in outcome.clips] == [
        ("v-0000-t0060", 2.0, 150),
        ("v-0000-t0210", 7.0, 60),
        ("v-0000-t0600", 20.0, 300),
    ]
    assert [[(t.text, t.start, t.end) for t in c.text] for c in outcome.clips] == [
        [("t0", 0, 90), ("t1", 60, 150)],
        [("t2", 0, 60)],
        [("t3", 0, 300)],
    ]
    assert [[s["id"] for s in c.reports[-1].numbers["segments"]] for c in outcome.clips] == [
        ["0", "1"],
        ["2"],
        ["3"],
    ]
    kept = [(c.start_s, c.stop_s) for c in outcome.clips]
    assert lost_seconds((0.0, 30.0), kept, outcome.lost) == {
        f"describe: {NO_TEXT}": pytest.approx(13.0)
    }
    whole = told(clip, said((0.0, 30.0)), "segments", REPORT)
    assert [(c.key, c.num_frames) for c in whole.clips] == [("v-0000", 900)]
    none = told(clip, [], "segments", REPORT)
    assert none.clips == ()
    assert none.lost[0].seconds == pytest.approx(30)


def test_a_segment_shorter_than_a_frame_has_one():
    (clip,) = video().clips
    (text,) = told(clip, said((1.005, 1.01)), "none", REPORT).clips[0].text
    assert (text.start, text.end) == (30, 31)
    last = told(clip, said((29.99, 29.999)), "none", REPORT).clips[0].text[0]
    assert (last.start, last.end) == (899, 900)
    assert told(clip, said((30.0, 31.0), (-2.0, 0.0)), "none", REPORT).clips[0].text == ()


@settings(max_examples=60, deadline=None)
@given(
    spans=st.lists(st.tuples(st.integers(-50, 320), st.integers(1, 200)), min_size=0, max_size=8)
)
def test_cutting_keeps_exactly_the_frames_that_have_text(spans):
    (clip,) = video(clips=((0, 300),)).clips
    seconds = [(a / 30, (a + n) / 30) for a, n in spans]
    outcome = told(clip, said(*seconds), "segments", REPORT)
    expected, kept = np.zeros(300, bool), np.zeros(300, int)
    for a, n in spans:
        expected[max(a, 0) : max(a + n, 0)] = True
    for part in outcome.clips:
        start = round(part.start_s * 30)
        kept[start : start + part.num_frames] += 1
        covered = np.zeros(part.num_frames, bool)
        for text in part.text:
            covered[text.start : text.end] = True
        assert covered.all()
    assert (kept == expected).all()
    silent = sum(round(x.seconds * 30) for x in outcome.lost)
    assert silent + expected.sum() == 300


# ---------------------------------------------------------------- a model of the user's


def fake_describer(pictures, times_s):
    """Say which frame each picture shows."""
    fake_describer.asked.append((pictures.shape, times_s))
    text = " ".join(str(make.frame_number(p)) for p in pictures)
    return [{"start_s": times_s[0], "stop_s": times_s[0] + 0.5, "text": text, "side": "right"}]


fake_describer.asked = []


@pytest.fixture
def filmed(tmp_path, monkeypatch):
    module = SimpleNamespace(describer=fake_describer, mute=lambda *_: [{"text": "x"}])
    monkeypatch.setitem(sys.modules, "my_model", module)
    made = open_video("v", make.video(tmp_path / "v.mp4", 60, rate=25), "user")
    times = np.round(np.arange(10, 60) / 30 * 25) / 25
    clip = Clip("v-0000", Path("elsewhere.mp4"), 0, (24, 32), 30.0, times)
    return replace(made, clips=(clip,))


def test_a_model_sees_pictures_of_the_source_video(filmed):
    stage = DescribeWithModel(DescribeWithModel.Settings("my_model:describer", 4, height=24))
    fake_describer.asked.clear()
    (clip,) = stage.run_clip(filmed.clips[0], filmed).clips
    ((shape, times),) = fake_describer.asked
    assert shape == (4, 24, 32, 3)
    frames = [0, 16, 33, 49]
    np.testing.assert_array_equal(times, filmed.clips[0].source_timestamps_s[frames])
    (text,) = clip.text
    assert text.text == " ".join(str(round(t * 25) % 30) for t in times)
    assert (text.side, text.start) == ("right", 0)
    (segment,) = clip.reports[-1].numbers["segments"]
    assert segment["source"] == "my_model:describer"
    stage.close()


def test_a_model_that_is_not_there_or_talks_nonsense(filmed):
    def run(name):
        settings = DescribeWithModel.Settings(describer=name)
        return DescribeWithModel(settings).run_clip(filmed.clips[0], filmed)

    with pytest.raises(NotReadyError, match="setting describer"):
        run("")
    with pytest.raises(NotReadyError, match="no_such_module:x cannot be had"):
        run("no_such_module:x")
    with pytest.raises(NotReadyError, match="my_model:nobody"):
        run("my_model:nobody")
    with pytest.raises(StageError, match="my_model:mute: expected start_s < stop_s"):
        run("my_model:mute")
    with pytest.raises(ValueError, match="expected package"):
        run("my_model")
    with pytest.raises(ValueError, match="pictures, height"):
        DescribeWithModel(DescribeWithModel.Settings(pictures=0))


def test_examples():
    result = doctest.testmod(annotations)
    assert result.attempted > 0
    assert result.failed == 0
