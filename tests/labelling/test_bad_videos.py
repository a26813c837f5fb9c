"""Bad videos among good ones: each is accepted or refused for the right reason, nothing crashes.

Detection, intrinsics, camera and hands are made up, all else is real; the slow test at the end is
the whole cascade on real clips, killed and interrupted on its way.
"""

import os
import random
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest

from mint_hub.geometry import hand_state
from mint_hub.labelling.cascade import Cascade
from mint_hub.labelling.doctor import doctor
from mint_hub.labelling.label import label_videos
from mint_hub.labelling.manifest import read
from mint_hub.labelling.stages import sfm_gate
from mint_hub.labelling.stages.accept import Accept
from mint_hub.labelling.stages.clean import Clean
from mint_hub.labelling.stages.describe import Describe
from mint_hub.labelling.stages.hand_filter import HandFilter
from mint_hub.labelling.stages.metric_scale import MetricScale, MetricScaleSettings
from mint_hub.labelling.stages.normalise import Normalise
from mint_hub.labelling.stages.stitch import Stitch
from mint_hub.labelling.stages.undistort import Undistort
from mint_hub.loaders.integrity import verify
from mint_hub.loaders.schema import Episode
from mint_hub.loaders.video import iter_frames
from tests import video_files as make
from tests.labelling.test_light_stages import Fake, FakeDetect, FakeLabels


def zero_bytes(path):
    path.write_bytes(b"")


def no_video(path):
    path.write_bytes(bytes(range(256)) * 40)


def folder(path):
    path.mkdir()


def nothing(path):
    """Leave the place empty."""


def portrait(path):
    make.video(path, 60, (48, 64), prepare=lambda stream: stream.set_display_rotation(90))


def uhd(path):
    make.video(path, 60, (2160, 3840), options={"preset": "ultrafast"})


FAILED = {
    "zero_bytes": (zero_bytes, "not a video, but empty"),
    "no_video": (no_video, "not a video"),
    "folder": (folder, "folder.mp4"),
    "nothing": (nothing, "no such file"),
    "audio_only": (make.audio_only, "no video stream; it holds audio"),
    "no_end": (make.cut_without_index, "cut short: an mp4 without its index"),
}
REJECTED = {
    "five_fps": (lambda p: make.video(p, 20, rate=5), "normalise: frame rate too low"),
    "one_frame": (lambda p: make.video(p, 1), "normalise: video shorter than 1 s"),
    "no_hands": (lambda p: make.video(p, 90), "filter: no hand for more than 1 s"),
    "crowd": (lambda p: make.video(p, 90), "filter: more than two hands"),
    "still": (lambda p: make.video(p, 90), f"intrinsics: {sfm_gate.STILL}"),
    "border": (lambda p: make.video(p, 90), "accept: hands only at the border"),
}
ACCEPTED = {
    "good": (lambda p: make.video(p, 90), 3.0),
    "portrait": (portrait, 2.0),
    "uhd": (uhd, 2.0),
    "ten_fps": (lambda p: make.video(p, 30, rate=10), 3.0),
    "damaged": (lambda p: make.damaged(p, 45), 1.5),
}


class Detect(FakeDetect):
    """Two hands, and what the video's name says."""

    def run_clip(self, clip, video):
        self.video = video.key
        return super().run_clip(clip, video)

    def made(self, clip):
        found = super().made(clip)["detections"]
        if self.video == "no_hands":
            found = replace(found, score=np.zeros_like(found.score))
        if self.video == "crowd":
            twice = {name: np.concatenate([value] * 2) for name, value in vars(found).items()}
            order = np.argsort(twice["frame"], kind="stable")
            found = replace(found, **{name: value[order] for name, value in twice.items()})
        return {"detections": found}


class StillIntrinsics(Fake):
    """Refuses the video that is named so."""

    stage = "intrinsics"

    def run_video(self, video):
        if video.key != "still":
            return video
        lost = tuple(clip.lost(self.stage, sfm_gate.STILL) for clip in video.clips)
        return replace(video, clips=(), lost=(*video.lost, *lost))


class Labels(FakeLabels):
    """Smooth exact motion; of the video named so, hands that are hardly in the picture."""

    def run_clip(self, clip, video):
        self.video = video.key
        return super().run_clip(clip, video)

    def made(self, clip):
        made = super().made(clip)
        if self.video == "border":
            states = np.tile(hand_state.absent((2,)), (clip.num_frames, 1, 1))
            states[..., :3] = [0.0, 0.35, 0.5]
            hands = made["hands"]
            present = np.ones_like(hands.presence)
            made["hands"] = replace(hands, hand_state=states.astype(np.float32), presence=present)
        return made


@pytest.fixture(scope="module")
def labelled(tmp_path_factory):
    """Label all of them in one call."""
    place = tmp_path_factory.mktemp("bad")
    videos = {}
    for name, (made, _) in (FAILED | REJECTED | ACCEPTED).items():
        videos[name] = place / f"{name}.mp4"
        made(videos[name])
    loose = Accept.Settings(min_s=1.0)
    stages = [
        Normalise(Normalise.Settings(work_dir=str(place / "work"))),
        Detect(),
        HandFilter(HandFilter.Settings(min_s=1.0)),
        StillIntrinsics(),
        Undistort(),
        Labels(),
        Stitch(),
        MetricScale(MetricScaleSettings(("1.0",))),
        Clean(),
        Describe(),
        Accept(loose),
    ]
    report = label_videos(videos, place / "corpus", Cascade(stages))
    rows = {(r.video, r.clip): r for r in read(place / "corpus/labelling/manifest.jsonl")}
    return report, rows, place / "corpus"


@pytest.mark.parametrize("name", FAILED)
def test_what_is_no_video_fails_and_says_so(labelled, name):
    report, rows, _ = labelled
    assert name in report.failed
    assert FAILED[name][1] in report.reasons[name]
    assert f"{name}.mp4" in report.reasons[name]
    assert (rows[name, ""].state, rows[name, ""].reason) == ("failed", report.reasons[name])


@pytest.mark.parametrize("name", REJECTED)
def test_what_cannot_be_labelled_is_rejected_and_says_why(labelled, name):
    report, rows, _ = labelled
    assert name in report.rejected
    assert report.reasons[name].startswith(REJECTED[name][1])
    assert rows[name, ""].state == "rejected"
    assert rows[name, ""].reason in report.reasons[name]


@pytest.mark.parametrize("name", ACCEPTED)
def test_what_is_only_unusual_is_labelled(labelled, name):
    report, rows, corpus = labelled
    assert name not in report.reasons
    assert rows[name, ""].state == "done"
    paths = (corpus / f"labelling/videos/{name}/episodes").glob("*.npz")
    episodes = [Episode.load(path) for path in paths]
    assert sum(e.duration_s for e in episodes) == pytest.approx(ACCEPTED[name][1], abs=0.11)


def test_pictures_of_every_size_are_upright_and_small(labelled):
    _, _, corpus = labelled

    def size(name):
        return Episode.load(
            corpus / f"labelling/videos/{name}/episodes/{name}-0000.npz"
        ).image_size_hw

    assert size("good") == (48, 64)
    assert size("portrait") == (64, 48)
    assert size("uhd") == (384, 682)


def test_hours_add_up_and_shards_hold_the_rest(labelled):
    report, rows, corpus = labelled
    assert report.problems == ""
    assert verify(corpus, "full").ok
    assert report.num_episodes == len(ACCEPTED)
    assert report.hours_in == pytest.approx(report.hours_kept + sum(report.hours_lost.values()))
    assert "normalise: the video is damaged from here on" in report.hours_lost
    assert not any("unaccounted" in reason for reason in report.hours_lost)
    assert {row.state for row in rows.values()} <= {"done", "failed", "rejected"}


# ----------------------------------------------------------- the real cascade, killed and resumed


def beginning(source: Path, target: Path, frames: int) -> None:
    """Write the first frames of a real clip, as sharp as they are."""
    with av.open(str(target), "w") as container, iter_frames(source) as images:
        stream = container.add_stream("libx264", rate=30, options={"crf": "12"})
        stream.height, stream.width = images.info.image_size_hw
        stream.pix_fmt = "yuv420p"
        for _, frame in zip(range(frames), images, strict=False):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame.image, format="rgb24")))
        container.mux(stream.encode())


@pytest.mark.real
@pytest.mark.slow
def test_the_real_cascade_killed_and_interrupted_goes_on(tmp_path, real_dir):
    lacking = [r for r in doctor() if r.default and not r.ready]
    if lacking:
        pytest.skip(f"{lacking[0].stage}={lacking[0].backend} lacks {lacking[0].lacks}")
    for i in range(2):
        beginning(real_dir / f"hot3d/clip-{i}.mp4", tmp_path / f"v{i}.mp4", 75)
    zero_bytes(tmp_path / "v2.mp4")
    out, root = tmp_path / "out", Path(__file__).parents[2]
    code = "import sys; from mint_hub.cli import main; sys.exit(main(sys.argv[1:]))"
    call = [sys.executable, "-c", code, "label", *(f"{tmp_path}/v{i}.mp4" for i in range(3))]
    call += ["-o", str(out), "--quiet", "--keep-work", "--backend", "intrinsics=given"]
    call += ["--set", "intrinsics.focal_px=221.8"]
    environment = {**os.environ, "PYTHONPATH": str(root)}

    def finished():
        return {p: p.stat().st_mtime_ns for p in out.glob("labelling/work/*/*/*.npz")}

    moments, interrupted = random.Random(3), []
    for ending in (signal.SIGKILL, signal.SIGINT, signal.SIGKILL, signal.SIGKILL):
        before = finished()
        process = subprocess.Popen(call, env=environment, stderr=subprocess.PIPE)
        more = moments.randint(1, 6)
        while process.poll() is None and len(finished()) < len(before) + more:
            time.sleep(0.02)
        time.sleep(moments.uniform(0, 1))
        if process.poll() is None:
            process.send_signal(ending)
            interrupted.append(finished())
        process.communicate(timeout=60)
    last = subprocess.run(call, env=environment, capture_output=True, text=True, check=False)
    assert last.returncode == 1, last.stderr  # one of the videos is none
    assert len(interrupted) >= 2
    for earlier in interrupted:  # nothing that was finished was done again
        assert earlier.items() <= finished().items()
    rows = {(r.video, r.clip): r for r in read(out / "labelling/manifest.jsonl")}
    assert [rows[f"v{i}", ""].state for i in range(3)] == ["done", "done", "failed"]
    assert verify(out, "full").ok
    for i in range(2):
        episode = Episode.load(out / f"labelling/videos/v{i}/episodes/v{i}-0000.npz")
        assert episode.num_frames == 75
        assert episode.presence.any(1).mean() > 0.5
