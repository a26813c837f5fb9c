"""`mint-hub label`: calls that are wrong, the doctor, exit codes, and a checkpoint's labels.

Detection is made up where videos are labelled: two hands wherever one looks.
"""

import json

import pytest

from mint_hub.cli import main
from mint_hub.labelling import build
from mint_hub.labelling.backends import BACKENDS
from mint_hub.labelling.cascade import Cascade
from mint_hub.loaders.reader import CorpusReader
from tests import video_files
from tests.labelling.fake_stages import Cut, Invent
from tests.labelling.test_light_stages import FakeDetect
from tests.small_model import small_model


@pytest.fixture(autouse=True)
def no_environments(tmp_path, monkeypatch):
    monkeypatch.setenv("MINT_HUB_ENVIRONMENTS", str(tmp_path / "environments"))


@pytest.fixture
def folder(tmp_path):
    videos = tmp_path / "videos"
    videos.mkdir()
    for name in ("a", "b"):
        video_files.video(videos / f"{name}.mp4", 60)
    return videos


@pytest.fixture
def label(folder, tmp_path):
    def run(*arguments, videos=folder):
        return main(["label", str(videos), "-o", str(tmp_path / "out"), "--quiet", *arguments])

    return run


@pytest.fixture
def fakes(monkeypatch, tmp_path):
    """The cascade is a fake one, whose clips ``faults`` misbehave; returns them."""
    faults = {}

    def fake_cascade(work, *, chosen, settings):
        log = str(tmp_path / "calls.txt")
        return Cascade([Cut(), Invent(Invent.Settings(log=log, faults=dict(faults)))])

    monkeypatch.setattr(build, "build_cascade", fake_cascade)
    return faults


# ------------------------------------------------------------------------- calls that are wrong


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--backend camera", "--backend: expected STAGE=NAME, got 'camera'"),
        ("--backend camera=colmap", "backend of camera: expected one of sfm, megasam"),
        ("--backend kamera=sfm", "stage: expected one of normalise, detect"),
        ("--backend intrinsics=given", "expected one of fov_deg, focal_px and lens"),
        ("--backend hands=hawor", "HaWoR (setting checkout: its path)"),
        ("--set accept.min_s", "--set: expected STAGE.SETTING=VALUE"),
        ("--set accept=3", "--set: expected STAGE.SETTING=VALUE"),
        ("--set kamera.x=1", "stage: expected one of normalise, detect"),
        ("--set detect.x=1", "detect=mediapipe: expected settings among height"),
        ("--set accept.min_s=long", "accept=default, min_s: expected float, got 'long'"),
        ("--set accept.min_s=true", "accept=default, min_s: expected float, got True"),
        ("--set accept.wrist_depth_m=[0.1]", "wrist_depth_m: expected tuple[float, float]"),
        ("--set describe.cut=never", "describe=annotations, cut: expected"),
        ("--set filter.low_score=3", "low_score, high_score: expected 0 <= low <= high <= 1"),
        ("--scale 0", "scale: expected a positive factor, got '0'"),
        ("--scale 0.42m:1,2", "LENGTH:u1,v1-u2,v2@t"),
        ("--lens {f", "--lens: expected JSON or a .json file"),
        ("--lens no/such.json", "--lens: no/such.json: No such file"),
        ('--lens {"f":500,"model":"mirror"}', "--lens: lens, model"),
        ("--lens [[1,2],[3,4]]", "--lens: lens, K: expected"),
        ("--lens 5", "--lens: lens, K: expected"),
        ("--annotations no/such.csv", "--annotations: expected a file"),
        ("--source Mine!", "config: expected only a-z, 0-9, '_' and '-', got 'Mine!'"),
    ],
)
def test_calls_that_are_wrong(label, capsys, tmp_path, arguments, message):
    assert label(*arguments.split(" ")) == 2
    captured = capsys.readouterr()
    assert message in captured.err
    assert captured.err.startswith("mint-hub label: ")
    assert "Traceback" not in captured.err
    assert not list(tmp_path.glob("out/labelling/w*/*"))  # no video was touched


def test_no_folder_to_write_and_none_to_read(folder, label, tmp_path, capsys):
    assert main(["label", str(folder)]) == 2
    assert "-o, --out: expected the folder of the corpus" in capsys.readouterr().err
    for name in ("nothing", "looks_like_one.mp4"):
        (tmp_path / name).mkdir()
        assert label(videos=tmp_path / name) == 2
        assert "expected a folder with videos" in capsys.readouterr().err
    with pytest.raises(SystemExit) as stop:
        main(["label"])
    assert stop.value.code == 2


# ---------------------------------------------------------------------------------- the doctor


def test_doctor_lists_every_backend(capsys):
    assert main(["label", "doctor"]) == 0
    lines = capsys.readouterr().out.splitlines()
    heads = [line for line in lines if not line.startswith(" ")]
    assert [head.split()[0] for head in heads] == [f"{b.stage}={b.name}" for b in BACKENDS]
    for head in heads:
        name, rest = head.split(maxsplit=1)
        following = lines[lines.index(head) + 1 :]
        lacks = bool(following) and following[0].strip().startswith("needs ")
        assert lacks != rest.startswith("ready"), name
    text = "\n".join(lines)
    assert "git clone --recursive https://github.com/princeton-vl/DROID-SLAM" in text


def test_doctor_takes_settings(tmp_path, capsys):
    def head(*arguments):
        assert main(["label", "doctor", *arguments]) == 0
        lines = capsys.readouterr().out.splitlines()
        return next(line for line in lines if line.startswith("intrinsics=given"))

    assert "lacks" in head()
    assert "ready" in head("--backend", "intrinsics=given", "--set", "intrinsics.fov_deg=90")
    for wrong in (["--backend", "camera=colmap"], ["--set", "camera.zoom=2"], ["--set", "x.y=1"]):
        assert main(["label", "doctor", *wrong]) == 2
        assert "expected" in capsys.readouterr().err


# ----------------------------------------------------------------------------- what comes of it


def test_labels_resumes_and_reviews(label, fakes, tmp_path, capsys):
    assert label("--source", "mine", "--review") == 0
    captured = capsys.readouterr()
    assert "(100.0 %): 4 episodes, 120 frames" in captured.out
    assert captured.out.count("review: ") == 4
    assert "a: 2 episodes, 2.0 of 2.0 s kept" in captured.err
    for page in tmp_path.glob("out/labelling/review/*/episode.html"):
        assert page.with_suffix(".mp4").is_file()
    assert label("--source", "mine", "--review") == 0
    captured = capsys.readouterr()
    assert "a: finished before, skipped" in captured.err
    assert "4 episodes, 120 frames" in captured.out
    assert "review: " not in captured.out


def test_a_failure_is_told_and_done_again_when_asked(label, fakes, folder, capsys):
    fakes["b-00"] = "raise"
    fakes["b-01"] = "raise"
    (folder / "c.mp4").write_bytes(b"")
    assert label() == 1
    captured = capsys.readouterr()
    assert "c: failed: " in captured.err
    assert "not a video, but empty" in captured.err
    assert "b: ZeroDivisionError: no parallax" in captured.out
    assert "(50.0 %): 2 episodes, 60 frames" in captured.out
    fakes.clear()
    video_files.video(folder / "c.mp4", 60)
    assert label("--retry-failed") == 0
    assert "(100.0 %): 6 episodes, 180 frames" in capsys.readouterr().out


def test_a_rejected_video_is_no_failure(label, fakes, capsys):
    fakes |= {"b-00": "reject", "b-01": "reject"}
    assert label() == 0
    assert "b: camera: too dark" in capsys.readouterr().out


# --------------------------------------------------------------------------------- a checkpoint


@pytest.fixture
def two_hands(monkeypatch):
    """All stages are the chosen ones, but detection is made up."""
    real = build.build_cascade

    def with_hands(work, **choices):
        stages = real(work, **choices).stages
        return Cascade([FakeDetect() if s.stage == "detect" else s for s in stages])

    monkeypatch.setattr(build, "build_cascade", with_hands)


LENIENT = [
    "camera.presence_threshold=-1000",
    "accept.min_inside_share=0",
    "accept.camera_jump_m=1e9",
    "accept.camera_jump_deg=180",
    "accept.hand_jump_m=1e9",
    "accept.wrist_depth_m=[-1e9, 1e9]",
    "accept.camera_speed_m_s=1e9",
]


def test_labels_of_a_checkpoint_are_the_same_records(label, two_hands, tmp_path, capsys):
    checkpoint = str(tmp_path / "checkpoint")
    small_model(window=16).save_pretrained(checkpoint)
    assert label("--checkpoint", checkpoint, "--set", "camera.presence_threshold=1000") == 0
    assert "a: accept: too few frames with a hand" in capsys.readouterr().out
    lenient = [word for setting in LENIENT for word in ("--set", setting)]
    assert label("--checkpoint", checkpoint, *lenient) == 0
    assert "2 episodes, 120 frames" in capsys.readouterr().out
    splits = [p.name for p in (tmp_path / "out/user").iterdir() if p.is_dir()]
    episodes = [e for split in splits for e in CorpusReader(tmp_path / "out", "user", split)]
    assert sorted(e.key for e in episodes) == ["a-0000", "b-0000"]
    for episode in episodes:
        backends = {s["stage"]: s["backend"] for s in episode.meta["provenance"]["stages"]}
        assert [backends[s] for s in ("intrinsics", "camera", "hands")] == ["mint"] * 3
        assert episode.presence.all()
        assert str(tmp_path) not in str(episode.meta["provenance"])


def test_a_checkpoint_that_is_not_there(label, two_hands, capsys):
    assert label("--checkpoint", "no/such/folder") == 2
    assert "MINT checkpoint no/such/folder: " in capsys.readouterr().err


# ------------------------------------------------------------------------------- what is chosen


def test_a_known_lens_needs_no_other_intrinsics(label, monkeypatch, tmp_path):
    told = []

    def remember(work, *, chosen, settings):
        told.append((chosen, settings))
        raise ValueError("enough")

    monkeypatch.setattr(build, "build_cascade", remember)
    K = [[50, 0, 31.5], [0, 50, 23.5], [0, 0, 1]]
    file = tmp_path / "lens.json"
    file.write_text(json.dumps(K))
    for given in (json.dumps(K), str(file), json.dumps({"K": K})):
        assert label("--lens", given) == 2
        lens = {"lens": {"K": K}}
        assert told.pop() == ({"intrinsics": "given"}, {"undistort": lens, "intrinsics": lens})
    assert label("--lens", json.dumps(K), "--backend", "intrinsics=sfm", "--scale", "1.5") == 2
    known = {"undistort": {"lens": {"K": K}}, "scale": {"known": ["1.5"]}}
    assert told.pop() == ({"intrinsics": "sfm"}, known)
