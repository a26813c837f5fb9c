import base64
import re
from dataclasses import replace
from html.parser import HTMLParser
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from mint_hub.loaders.schema import TextSegment
from mint_hub.view import summary
from mint_hub.view.plots import trajectory_plot
from mint_hub.view.summary import write_index, write_summary
from tests.episodes import make_episode


class _Page(HTMLParser):
    """Tags that are opened and closed in order, what they refer to, and the text between."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.refs: list[str] = []
        self.text: list[str] = []
        self.tags: list[str] = []
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.refs += [value for name, value in attrs if name in ("src", "href")]
        if tag not in ("meta", "img", "rect", "polyline"):
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if "style" not in self.open:
            self.text.append(data)


def _images(page):
    for ref in page.refs:
        if match := re.fullmatch(r"data:image/\w+;base64,(.*)", ref):
            data = np.frombuffer(base64.b64decode(match[1]), np.uint8)
            yield cv2.cvtColor(cv2.imdecode(data, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def test_a_page_holds_all_it_shows(tmp_path):
    episode = make_episode(20)
    path = write_summary(episode, tmp_path / "clip.html")
    page = _Page(path.read_text(encoding="utf-8"))
    assert all(ref.startswith("data:") for ref in page.refs)
    assert "script" not in page.tags
    assert "link" not in page.tags
    (plot,) = _images(page)
    np.testing.assert_array_equal(plot, trajectory_plot(episode))
    words = " ".join(page.text)
    for expected in (
        "synthetic-0",
        "0.67 s, 20 frames",
        "30 fps",
        "open the jar",
        "tests.episodes",
    ):
        assert expected in words


def test_what_people_wrote_is_shown_as_text(tmp_path):
    evil = '<script>alert(1)</script> & "quotes"'
    episode = replace(
        make_episode(6),
        text=(TextSegment("x", evil, None, 0, 6),),
        meta={"source": evil, "warnings": [evil, {"a": evil}], "provenance": {evil: evil}},
    )
    page = _Page(write_summary(episode, tmp_path / "clip.html").read_text(encoding="utf-8"))
    assert "script" not in page.tags
    assert sum(evil in text for text in page.text) >= 3
    assert "Warnings" in page.text


def test_files_beside_the_page_are_linked(tmp_path):
    episode = make_episode(6)
    episode.save(tmp_path / "my clip.npz")
    (tmp_path / "my clip.mp4").touch()
    page = _Page(write_summary(episode, tmp_path / "my clip.html").read_text(encoding="utf-8"))
    links = [ref for ref in page.refs if not ref.startswith("data:")]
    assert links == ["my%20clip.npz", "my%20clip.mp4"]


def test_stills_come_from_the_video_or_its_overlay(tmp_path, monkeypatch):
    episode = make_episode(20)
    frames = {k: np.full((120, 160, 3), 10 * k, np.uint8) for k in range(20)}
    asked = []

    def drawn(_, video, __, only):
        asked.append(video)
        return ((k, frames[k]) for k in sorted(only))

    class Frames:
        def __init__(self, path, fps, start_s):
            asked.append(path)
            self.start = round(start_s * fps)

        def __enter__(self):
            return iter([SimpleNamespace(image=frames[self.start])])

        def __exit__(self, *_):
            pass

    monkeypatch.setattr(summary, "overlay_frames", drawn)
    monkeypatch.setattr(summary, "iter_frames", Frames)
    for given in ({"video": "v.mp4"}, {"overlay": "o.mp4"}):
        path = write_summary(episode, tmp_path / "clip.html", num_stills=4, **given)
        *stills, _ = _images(_Page(path.read_text(encoding="utf-8")))
        assert [round(float(still.mean()) / 10) for still in stills] == [2, 7, 12, 17]
    assert set(asked) == {"v.mp4", "o.mp4"}


def test_short_and_empty_clips_have_a_page(tmp_path):
    nobody = replace(make_episode(1), presence=np.zeros((1, 2), bool), presence_score=None, meta={})
    text = write_summary(nobody, tmp_path / "clip.html").read_text(encoding="utf-8")
    assert "0 frames, 0.0 %" in text
    assert not re.search(r"\bnan\b", text)
    with pytest.raises(ValueError, match=r"ends in \.html"):
        write_summary(nobody, tmp_path / "clip.htm")


def test_the_index_lists_every_episode_and_every_broken_file(tmp_path):
    make_episode(30, key="first", meta={"warnings": ["a"]}).save(tmp_path / "one.npz")
    second = make_episode(15, key="second")
    second.save(tmp_path / "sub" / "two.npz")
    write_summary(second, tmp_path / "sub" / "two.html")
    (tmp_path / "three.npz").write_bytes(b"PK")
    path = write_index(tmp_path)
    page = _Page(path.read_text(encoding="utf-8"))
    words = " ".join(page.text)
    assert "2 clips · 45 frames · 1.5 s · 1 unreadable" in words
    assert "1 warning" in words
    assert "three.npz" in words
    assert "expected a whole npz file" in words
    assert page.refs == ["one.npz", "sub/two.html", "sub/two.npz"]
    again = path.read_bytes()
    assert write_index(tmp_path).read_bytes() == again


def test_an_index_needs_a_folder(tmp_path):
    assert "No episodes here yet" in write_index(tmp_path).read_text(encoding="utf-8")
    with pytest.raises(ValueError, match="expected a folder"):
        write_index(tmp_path / "none")


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (0.5, "0.5 s"),
        (59.94, "59.9 s"),
        (75.3, "1 min 15 s"),
        (3599.9, "1 h 0 min"),
        (7300, "2 h 1 min"),
    ],
)
def test_durations_read_well(seconds, words):
    assert summary._clock(seconds) == words
