"""The stages around the heavy ones together, from a video file to episodes.

Detection, camera and hands are made up from the source time alone, each clip's camera in a world
and a unit of its own.
"""

import json
from dataclasses import dataclass, replace

import numpy as np
import pytest

from mint_hub.geometry import hand_state, rigid
from mint_hub.geometry.rotations import rotvec_to_matrix
from mint_hub.labelling.cascade import Cascade
from mint_hub.labelling.label import label_videos
from mint_hub.labelling.records import CameraPath, Detections, Hands, Intrinsics
from mint_hub.labelling.stage import Outcome, Resources, report_of, reported
from mint_hub.labelling.stages.accept import Accept
from mint_hub.labelling.stages.clean import Clean
from mint_hub.labelling.stages.describe import Describe
from mint_hub.labelling.stages.hand_filter import HandFilter
from mint_hub.labelling.stages.metric_scale import MetricScale, MetricScaleSettings
from mint_hub.labelling.stages.normalise import Normalise
from mint_hub.labelling.stages.stitch import Stitch
from mint_hub.labelling.stages.undistort import Undistort
from mint_hub.loaders.schema import Episode
from tests import video_files as make
from tests.labelling.motion import exact_motion

SECONDS, RATE = 20, 30


class Fake:
    """What fakes share: settings without content, and a report."""

    backend, version = "fake", "1"
    needs, gives = (), ()
    resources = Resources()

    @dataclass(frozen=True)
    class Settings:
        pass

    settings = Settings()

    def run_clip(self, clip, video):
        return Outcome((reported(clip, report_of(self), **self.made(clip)),))

    def close(self):
        pass


class FakeDetect(Fake):
    """Two hands, none from 8 to 10.5 s, three from 14 to 14.5 s."""

    stage = "detect"

    def made(self, clip):
        t = clip.source_timestamps_s + 1e-6
        counts = np.where((t >= 8) & (t < 10.5), 0, np.where((t >= 14) & (t < 14.5), 3, 2))
        n = counts.sum()
        return {
            "detections": Detections(
                frame=np.repeat(np.arange(len(t), dtype=np.int32), counts),
                box_xyxy=np.zeros((n, 4), np.float32),
                score=np.full(n, 0.9, np.float32),
                right_score=np.zeros(n, np.float32),
                landmarks_uv=np.zeros((n, 21, 2), np.float32),
                landmarks_m=np.zeros((n, 21, 3), np.float32),
            )
        }


class FakeLabels(Fake):
    """Everything else, of one exact motion."""

    stage = "camera"

    def made(self, clip):
        state, T = exact_motion(SECONDS * RATE, seed=3)
        frames = np.round(clip.source_timestamps_s * RATE).astype(int)
        rng = np.random.default_rng(frames[0])
        own = rigid.rigid(rotvec_to_matrix(rng.normal(0, 1, 3)), rng.normal(0, 1, 3))
        T = T[frames] @ rigid.inverse(own)
        T[:, :3, 3] *= rng.uniform(0.5, 2)
        two = np.ones((len(frames), 2), np.float32)
        presence = two > 0
        presence[40:45, 0] = False
        state = np.where(presence[..., None], state[frames], hand_state.absent(()))
        return {
            "intrinsics": Intrinsics((1.2, 1.45), "fake", 1.0),
            "camera": CameraPath(T, presence[:, 1], 100 * two[:, 0], 0.5, "fake"),
            "hands": Hands(
                state.astype(np.float32), presence, 0.9 * two, ~(two > 0),
                "mint", "template", "fake", two,
            ),
        }  # fmt: skip


@pytest.fixture(scope="module")
def labelled(tmp_path_factory):
    folder = tmp_path_factory.mktemp("light")
    file = make.video(folder / "film.mp4", SECONDS * RATE)
    table = folder / "text.csv"
    table.write_text("start,end,side,text\n1,4,left,reaches\n16,30,,lifts with both hands\n")
    work = str(folder / "work")
    cascade = Cascade(
        [
            Normalise(Normalise.Settings(work_dir=work, piece_s=4.0, min_tail_s=1.5)),
            FakeDetect(),
            HandFilter(),
            Undistort(),
            FakeLabels(),
            Stitch(),
            MetricScale(MetricScaleSettings(("1.0",))),
            Clean(),
            Describe(Describe.Settings(path=str(table))),
            Accept(),
        ]
    )
    report = label_videos({"film": file}, folder / "corpus", cascade)
    return report, folder / "corpus"


def test_hours_add_up(labelled):
    report, _ = labelled
    assert report.problems == ""
    assert report.reasons == {}
    lost = {reason: 3600 * hours for reason, hours in report.hours_lost.items()}
    assert lost == {
        "filter: no hand for more than 1 s": pytest.approx(2.5, abs=1e-3),
        "filter: more than two hands": pytest.approx(0.5, abs=1e-3),
        # Of 12 .. 16 s, the fifth piece, 14.5 s on is too short; the sixth begins at 15 s.
        "filter: too short": pytest.approx(0.5, abs=1e-3),
    }
    assert 3600 * report.hours_kept == pytest.approx(SECONDS - 3.5, abs=1e-3)


def test_pieces_are_one_world_again(labelled):
    _, corpus = labelled
    paths = sorted(corpus.glob("labelling/videos/film/episodes/*.npz"))
    episodes = [Episode.load(path) for path in paths]
    spans = [(round(e.timestamps_s[0], 2), e.num_frames) for e in episodes]
    assert spans == [(0.0, 240), (10.5, 105), (15.0, 150)]
    _, T = exact_motion(SECONDS * RATE, seed=3)
    for episode, (start_s, frames) in zip(episodes, spans, strict=True):
        first = round(start_s * RATE)
        exact = rigid.inverse(T[first : first + frames])[:, :3, 3]
        ours = rigid.inverse(episode.T_camera_from_world)[:, :3, 3]
        apart = [np.linalg.norm(x[:, None] - x[None], axis=-1) for x in (ours, exact)]
        scale = apart[0].sum() / apart[1].sum()
        np.testing.assert_allclose(apart[0], scale * apart[1], atol=1e-5)
        assert episode.presence.all()
        assert episode.filled[40:45, 0].all()
    assert [[(t.text, t.side, t.start, t.end) for t in e.text] for e in episodes] == [
        [("reaches", "left", 30, 120)],
        [],
        [("lifts with both hands", "both", 30, 150)],
    ]


def test_provenance_holds_every_stage(labelled):
    _, corpus = labelled
    path = min(corpus.glob("labelling/videos/film/episodes/*.npz"))
    stages = Episode.load(path).meta["provenance"]["stages"]
    names = [item["stage"] for item in stages]
    for name in ("normalise", "filter", "undistort", "stitch", "scale", "clean", "describe"):
        assert name in names
    (stitched,) = [s for s in stages if s["stage"] == "stitch" and "pieces" in s["numbers"]]
    assert [piece["frame"] for piece in stitched["numbers"]["pieces"]] == [0, 90, 180]
    assert json.loads(json.dumps(stages)) == stages


def test_a_video_without_hands_is_rejected_for_that(tmp_path):
    class Nobody(FakeDetect):
        def made(self, clip):
            found = super().made(clip)["detections"]
            return {"detections": replace(found, score=np.zeros_like(found.score))}

    file = make.video(tmp_path / "a.mp4", 90)
    stages = [Normalise(Normalise.Settings(work_dir=str(tmp_path / "w"))), Nobody(), HandFilter()]
    report = label_videos({"a": file}, tmp_path / "corpus", Cascade(stages))
    assert report.rejected == ["a"]
    assert report.reasons == {"a": "filter: no hand for more than 1 s"}
