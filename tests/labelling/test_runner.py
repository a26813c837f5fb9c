"""The runner: no clip lost, none done twice, every failure kept with its reason."""

import errno
import os
import random
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest

from mint_hub.labelling import record_files
from mint_hub.labelling.cascade import Cascade, FullDiskError
from mint_hub.labelling.label import label_videos
from mint_hub.labelling.manifest import read
from mint_hub.loaders.integrity import verify
from mint_hub.loaders.reader import CorpusReader
from tests import video_files as make
from tests.labelling.fake_stages import Cut, Invent

VIDEOS = 3
CLIPS = 3


@pytest.fixture(scope="module")
def videos(tmp_path_factory):
    """Three videos of three seconds: nine clips."""
    folder = tmp_path_factory.mktemp("videos")
    paths = [make.video(folder / f"v{i}.mp4", 30 * CLIPS) for i in range(VIDEOS)]
    return {path.stem: path for path in paths}


def cascade(tmp_path, **settings):
    log = tmp_path / "calls.txt"
    return Cascade([Cut(), Invent(Invent.Settings(log=str(log), **settings))])


def calls(tmp_path):
    log = tmp_path / "calls.txt"
    return log.read_text().split() if log.exists() else []


def rows(out):
    return {(r.video, r.clip): r for r in read(out / "labelling" / "manifest.jsonl")}


def keys(out):
    return sorted(
        episode.key
        for split in ("train", "validation")
        if (out / "user" / split).exists()
        for episode in CorpusReader(out, "user", split)
    )


ALL = sorted(f"v{i}-{j:02d}" for i in range(VIDEOS) for j in range(CLIPS))


def test_everything_becomes_verified_shards(tmp_path, videos):
    out = tmp_path / "out"
    report = label_videos(videos, out, cascade(tmp_path))
    assert keys(out) == ALL
    assert verify(out, "full").ok
    assert report.problems == ""
    assert report.hours_lost == {}
    assert report.hours_kept == pytest.approx(VIDEOS * CLIPS / 3600)
    assert report.done == sorted(videos)
    assert {row.state for row in rows(out).values()} == {"done"}
    episode = next(iter(CorpusReader(out, "user", "train")))
    assert episode.meta["provenance"]["stages"][0]["stage"] == "camera"
    assert episode.meta["scale_status"] == "pseudo-label; not metric, scale unknown"


def test_a_second_call_does_nothing_again(tmp_path, videos):
    out = tmp_path / "out"
    label_videos(videos, out, cascade(tmp_path))
    before = {p: p.stat().st_mtime_ns for p in (out / "user").rglob("*") if p.is_file()}
    report = label_videos(videos, out, cascade(tmp_path))
    assert sorted(calls(tmp_path)) == ALL
    assert report.skipped == sorted(videos)
    assert report.num_episodes == len(ALL)
    assert {p: p.stat().st_mtime_ns for p in before} == before


def test_another_video_joins_the_shards(tmp_path, videos):
    out = tmp_path / "out"
    first = {"v0": videos["v0"]}
    label_videos(first, out, cascade(tmp_path))
    label_videos({"v1": videos["v1"]}, out, cascade(tmp_path))
    assert keys(out) == [key for key in ALL if key < "v2"]
    assert len(calls(tmp_path)) == 2 * CLIPS


@pytest.mark.parametrize(
    ("fault", "state", "reason"),
    [
        ("raise", "failed", "ZeroDivisionError: no parallax"),
        ("stage error", "failed", "this clip is beyond me"),
        ("reject", "rejected", "too dark"),
    ],
)
def test_one_bad_clip_costs_itself_only(tmp_path, videos, fault, state, reason):
    out = tmp_path / "out"
    report = label_videos(videos, out, cascade(tmp_path, faults={"v1-01": fault}))
    assert keys(out) == [key for key in ALL if key != "v1-01"]
    row = rows(out)["v1", "v1-01"]
    assert (row.state, row.reason, row.stage) == (state, reason, "camera")
    assert report.hours_lost == {f"camera: {reason}": pytest.approx(1 / 3600)}
    assert report.hours_in == pytest.approx(report.hours_kept + sum(report.hours_lost.values()))


def test_failures_are_done_again_only_when_asked(tmp_path, videos):
    out = tmp_path / "out"
    faulty = {"v1-01": "raise"}
    label_videos(videos, out, cascade(tmp_path, faults=faulty))
    again = label_videos(videos, out, cascade(tmp_path, faults=faulty))
    assert again.hours_lost == {"camera: ZeroDivisionError: no parallax": pytest.approx(1 / 3600)}
    (tmp_path / "calls.txt").unlink()
    label_videos(videos, out, cascade(tmp_path, faults=faulty), retry_failed=True)
    assert calls(tmp_path) == []  # the other clips' files are still there; the bad one fails again
    assert rows(out)["v1", "v1-01"].state == "failed"


def test_an_unreadable_video_among_good_ones(tmp_path, videos):
    bad = tmp_path / "bad.mp4"
    bad.write_bytes(b"not a video")
    out = tmp_path / "out"
    report = label_videos({**videos, "bad": bad}, out, cascade(tmp_path))
    assert keys(out) == ALL
    assert report.failed == ["bad"]
    assert "bad.mp4" in report.reasons["bad"]
    assert rows(out)["bad", ""].state == "failed"


def test_a_full_disk_stops_the_run_and_loses_nothing(tmp_path, videos, monkeypatch):
    out = tmp_path / "out"
    save, left = record_files.save, [6]

    def full(path, value, fingerprint=""):
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        save(path, value, fingerprint)

    monkeypatch.setattr(record_files, "save", full)
    with pytest.raises(FullDiskError, match="no room left"):
        label_videos(videos, out, cascade(tmp_path))
    assert not (out / "user").exists()
    monkeypatch.setattr(record_files, "save", save)
    report = label_videos(videos, out, cascade(tmp_path))
    assert keys(out) == ALL
    assert report.hours_lost == {}
    assert len(calls(tmp_path)) == len(ALL) + 1  # the one whose file found no room


# ----------------------------------------------------------------- killed and interrupted

SCRIPT = """
import sys
from pathlib import Path
from mint_hub.labelling.cascade import Cascade
from mint_hub.labelling.label import label_videos
from tests.labelling.fake_stages import Cut, Invent
folder, out, log = map(Path, sys.argv[1:4])
stages = [Cut(), Invent(Invent.Settings(log=str(log), sleep_s=0.15))]
videos = {p.stem: p for p in sorted(folder.glob("*.mp4"))}
try:
    label_videos(videos, out, Cascade(stages))
except KeyboardInterrupt:
    sys.exit(130)
"""


def begin(videos, out, log):
    folder = next(iter(videos.values())).parent
    root = Path(__file__).parents[2]
    return subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(SCRIPT), folder, out, log],
        cwd=root,
        env={**os.environ, "PYTHONPATH": str(root)},
        stderr=subprocess.PIPE,
        # Started in the background, a shell's children ignore interruptions, and so would this one.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def wait_for_calls(log, number, process):
    """Wait until so many clips were done, or the process ended."""
    while process.poll() is None:
        if log.exists() and len(log.read_text().split()) >= number:
            return
        time.sleep(0.002)


def same_labels(one, other):
    for split in ("train", "validation"):
        if not (one / "user" / split).exists():
            assert not (other / "user" / split).exists()
            continue
        mine, theirs = CorpusReader(one, "user", split), CorpusReader(other, "user", split)
        assert [e.key for e in mine] == [e.key for e in theirs]
        for a, b in zip(mine, theirs, strict=True):
            np.testing.assert_array_equal(a.T_camera_from_world, b.T_camera_from_world)
            np.testing.assert_array_equal(a.hand_state, b.hand_state)
            np.testing.assert_array_equal(a.timestamps_s, b.timestamps_s)


@pytest.mark.slow
def test_killed_at_ten_random_moments(tmp_path, videos):
    out, log = tmp_path / "out", tmp_path / "calls.txt"
    moments = random.Random(7)
    kills = 0
    for _ in range(10):
        process = begin(videos, out, log)
        done = len(calls(tmp_path))
        wait_for_calls(log, min(done + moments.choice((0, 1, 1, 2)), len(ALL)), process)
        time.sleep(moments.uniform(0, 0.06))
        kills += process.poll() is None
        process.kill()
        process.communicate()
    process = begin(videos, out, log)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors.decode()
    assert kills >= 5
    assert keys(out) == ALL
    assert set(calls(tmp_path)) == set(ALL)
    assert len(calls(tmp_path)) <= len(ALL) + kills  # only what was under way is done again
    whole = tmp_path / "whole"
    label_videos(videos, whole, cascade(tmp_path))
    same_labels(out, whole)


def test_interrupted_and_resumed(tmp_path, videos):
    out, log = tmp_path / "out", tmp_path / "calls.txt"
    process = begin(videos, out, log)
    wait_for_calls(log, 2, process)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors.decode()
    before = calls(tmp_path)
    label_videos(videos, out, cascade(tmp_path, sleep_s=0.15))  # as in SCRIPT
    assert keys(out) == ALL
    assert len(calls(tmp_path)) <= len(ALL) + 1
    assert calls(tmp_path)[: len(before)] == before


# --------------------------------------------------------------------------------- Ray


@pytest.fixture
def on_ray():
    pytest.importorskip("ray", reason="ray is not installed (extra labelling)")
    from mint_hub.labelling.ray_runner import OnRay

    return OnRay


def test_ray_gives_the_same_labels(tmp_path, videos, on_ray):
    here, there = tmp_path / "here", tmp_path / "there"
    label_videos(videos, here, cascade(tmp_path))
    stages = cascade(tmp_path)
    report = label_videos(videos, there, stages, executor=on_ray(stages, num_cpus=2))
    assert report.hours_lost == {}
    same_labels(here, there)


def test_ray_retries_a_dead_worker_and_isolates_a_poison_clip(tmp_path, videos, on_ray):
    out = tmp_path / "out"
    stages = cascade(tmp_path, faults={"v0-00": "die once", "v1-01": "die", "v2-02": "raise"})
    report = label_videos(videos, out, stages, executor=on_ray(stages, num_cpus=2))
    assert keys(out) == [key for key in ALL if key not in ("v1-01", "v2-02")]
    poison = rows(out)["v1", "v1-01"]
    assert poison.state == "failed"
    assert poison.reason.startswith("worker died 3 times: ")
    assert poison.attempt == 3
    assert sum(report.hours_lost.values()) == pytest.approx(2 / 3600)


def test_ray_actors_go_over_to_another_stage_where_there_is_no_room(
    tmp_path, videos, on_ray, monkeypatch
):
    started = []
    start = on_ray._started

    def remembered(self, position):
        started.append(position)
        return start(self, position)

    monkeypatch.setattr(on_ray, "_started", remembered)
    stages = cascade(tmp_path)
    executor = on_ray(stages, num_cpus=1)
    label_videos(videos, tmp_path / "out", stages, executor=executor)
    assert keys(tmp_path / "out") == ALL
    assert started == [0]


def test_ray_refuses_what_the_cluster_cannot_hold(tmp_path, on_ray):
    from mint_hub.labelling.stage import Resources

    stage = Cut()
    stage.resources = Resources(cpus=1, gpus=64)
    with pytest.raises(ValueError, match=r"normalise \(fake\): expected a cluster with 64 GPU"):
        on_ray(Cascade([stage]), num_cpus=1)
