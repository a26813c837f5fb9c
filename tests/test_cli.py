"""The command line: what it writes, what it says, and the exit code of all that goes wrong."""

import json

import numpy as np
import pytest

from mint_hub.cli import main
from mint_hub.loaders.schema import Episode
from tests import video_files
from tests.model.golden import release_folder
from tests.small_model import small_model


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    folder = tmp_path_factory.mktemp("checkpoint")
    small_model(window=16).save_pretrained(folder)
    return folder


@pytest.fixture
def clips(tmp_path):
    folder = tmp_path / "clips"
    folder.mkdir()
    video_files.video(folder / "a.mp4", 20)
    video_files.video(folder / "b.mp4", 12)
    return folder


@pytest.fixture
def predict(checkpoint, tmp_path):
    def run(*arguments, model=checkpoint, out=tmp_path / "out"):
        return main(["predict", *map(str, arguments), "-o", str(out), "--model", str(model)])

    return run


def test_predict_writes_everything(predict, clips, tmp_path, capsys):
    assert predict(clips) == 0
    for key, frames in (("a", 20), ("b", 12)):
        folder = tmp_path / "out" / key
        names = {p.name for p in folder.iterdir()}
        wanted = {"episode.npz", "episode.mp4", "episode.png", "episode.html", "done.json"}
        assert names == wanted
        assert Episode.load(folder / "episode.npz").num_frames == frames
    assert (tmp_path / "out/index.html").is_file()
    assert "2 done, 0 finished before, 0 failed" in capsys.readouterr().out


def test_predict_resumes(predict, clips, tmp_path, capsys):
    predict(clips / "a.mp4", "--no-overlay")
    before = (tmp_path / "out/a/episode.npz").stat().st_mtime_ns
    assert predict(clips, "--no-overlay") == 0
    assert "1 done, 1 finished before" in capsys.readouterr().out
    assert (tmp_path / "out/a/episode.npz").stat().st_mtime_ns == before
    # other settings, an unfinished clip, or --overwrite: made again
    assert predict(clips / "a.mp4", "--no-overlay", "--smooth") == 0
    (tmp_path / "out/a/done.json").unlink()
    assert predict(clips / "a.mp4", "--no-overlay", "--smooth") == 0
    assert predict(clips / "a.mp4", "--no-overlay", "--smooth", "--overwrite") == 0
    assert capsys.readouterr().out.count("1 done, 0 finished before") == 3


def test_interrupted_run_goes_on(predict, clips, monkeypatch, capsys, tmp_path):
    from mint_hub.inference.runner import MintRunner

    run = MintRunner.run

    def stop_at_b(self, video, *args, **kwargs):
        if str(video).endswith("b.mp4"):
            raise KeyboardInterrupt
        return run(self, video, *args, **kwargs)

    monkeypatch.setattr(MintRunner, "run", stop_at_b)
    assert predict(clips, "--no-overlay") == 130
    assert "run the same command again" in capsys.readouterr().err
    monkeypatch.setattr(MintRunner, "run", run)
    assert predict(clips, "--no-overlay") == 0
    assert "1 done, 1 finished before" in capsys.readouterr().out


def test_one_bad_video_does_not_stop_the_others(predict, clips, capsys):
    (clips / "aa.mp4").write_bytes(b"this is no video")
    assert predict(clips, "--no-overlay") == 1
    captured = capsys.readouterr()
    assert "2 done, 0 finished before, 1 failed" in captured.out
    assert "aa.mp4: " in captured.err


def test_same_names_do_not_collide(predict, tmp_path):
    videos = []
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        videos.append(video_files.video(tmp_path / name / "x.mp4", 5))
    assert predict(*videos, "--no-overlay") == 0
    folders = [p for p in (tmp_path / "out").iterdir() if p.is_dir()]
    assert len(folders) == 2


def test_random_weights_are_loud(clips, tmp_path, capsys):
    arguments = [str(clips / "b.mp4"), "-o", str(tmp_path / "out"), "--random-weights"]
    assert main(["predict", *arguments, "--no-overlay"]) == 0
    assert capsys.readouterr().err.count("RANDOM WEIGHTS") == 2
    episode = Episode.load(tmp_path / "out/b/episode.npz")
    assert "RANDOM WEIGHTS" in episode.meta["warnings"][0]
    assert "RANDOM WEIGHTS" in (tmp_path / "out/b/episode.html").read_text()


def test_known_camera_and_poses(predict, clips, tmp_path):
    poses = np.tile(np.eye(4), (12, 1, 1))
    np.save(tmp_path / "poses.npy", poses)
    lens = tmp_path / "lens.json"
    lens.write_text(json.dumps({"model": "opencv", "f": 60, "distortion": [0.1, 0, 0, 0]}))
    files = ("--camera", lens, "--camera-poses", tmp_path / "poses.npy")
    assert predict(clips / "b.mp4", *files) == 0
    episode = Episode.load(tmp_path / "out/b/episode.npz")
    assert episode.K[0, 0, 0] == pytest.approx(60, rel=1e-5)
    np.testing.assert_array_equal(episode.T_camera_from_world, poses)


# --- what goes wrong ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda p: p / "absent.mp4", "absent.mp4: "),
        (lambda p: _bytes(p / "text.mp4", b"no video at all"), "not a video"),
        (lambda p: video_files.audio_only(p / "sound.mp4"), "no video stream"),
        (lambda p: video_files.no_frames(p / "empty.mkv"), "holds no frames"),
        (lambda p: video_files.cut_without_index(p / "head.mp4"), "head.mp4: "),
        (lambda p: video_files.cut_with_index(p / "cut.mp4"), "cut.mp4: "),
    ],
)
def test_bad_videos(predict, tmp_path, capsys, make, message):
    assert predict(make(tmp_path)) == 1
    assert message in capsys.readouterr().err
    assert not list((tmp_path / "out").rglob("*.npz"))


def test_unusual_videos_work(predict, tmp_path):
    one = video_files.video(tmp_path / "one.mp4", 1)
    vfr = video_files.vfr(tmp_path / "vfr.mp4", [0, 40, 50, 200, 233, 500])
    phone = video_files.rotated(tmp_path / "phone.mp4", 90)
    assert predict(one, vfr, phone) == 0
    assert Episode.load(tmp_path / "out/one/episode.npz").num_frames == 1
    variable = Episode.load(tmp_path / "out/vfr/episode.npz")
    np.testing.assert_allclose(np.diff(variable.timestamps_s), 1 / 30, atol=1e-9)
    assert len(set(variable.meta["source_timestamps_s"])) <= 6
    assert Episode.load(tmp_path / "out/phone/episode.npz").image_size_hw == (64, 48)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--camera", "[[1, 0], [0, 1]]"], "K"),
        (["--camera", "{not json"], "--camera"),
        (["--camera", "none.json"], "--camera: none.json: expected a readable file, got: No such"),
        (["--camera-poses", "none.npy"], "--camera-poses: none.npy: expected a readable file"),
    ],
)
def test_cameras_that_do_not_fit(predict, clips, capsys, arguments, message):
    assert predict(clips / "a.mp4", *arguments) in (1, 2)
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--fps", "fast"], "--fps"),
        (["--fps", "0"], "fps"),
        (["--overlap", "16"], "overlap"),
        (["--batch-size", "0"], "batch_size"),
        (["--camera-poses", "tests/conftest.py"], "--camera-poses: tests/conftest.py"),
        (["--camera-poses", "tests/golden/coverage_inputs.npz"], "--camera-poses: expected one"),
        (["--dtype", "int8"], "--dtype"),
        (["--device", "abacus"], "device: expected one of"),
        (["--device", "cuda:7"], "device: expected one of"),
        (["--mano", "no/such/folder"], "MANO_RIGHT.pkl"),
        (["--model", "no/such/folder"], "no/such/folder"),
    ],
)
def test_calls_that_are_wrong(clips, checkpoint, tmp_path, capsys, arguments, message):
    call = ["predict", str(clips), "-o", str(tmp_path / "out")]
    if "--model" not in arguments:
        call += ["--model", str(checkpoint)]
    assert main([*call, *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert "Traceback" not in error


def test_folder_without_videos(predict, tmp_path, capsys):
    (tmp_path / "nothing").mkdir()
    assert predict(tmp_path / "nothing") == 2
    assert "expected a folder with videos" in capsys.readouterr().err


def test_damaged_checkpoint(predict, clips, golden_dir, tmp_path, capsys):
    from safetensors.torch import load_file, save_file

    folder = release_folder(golden_dir, tmp_path / "damaged")
    tensors = load_file(folder / "model.safetensors")
    tensors["hand_head.query"][0, 0, 0] = float("nan")
    save_file(tensors, folder / "model.safetensors", metadata={"format": "pt"})
    assert predict(clips, model=folder) == 2
    assert "NaN or infinity" in capsys.readouterr().err
    del tensors["hand_head.query"]
    save_file(tensors, folder / "model.safetensors", metadata={"format": "pt"})
    assert predict(clips, model=folder) == 2
    assert "1 missing: hand_head.queries" in capsys.readouterr().err
    config = json.loads((folder / "config.json").read_text()) | {"camera_heads": 7}
    (folder / "config.json").write_text(json.dumps(config))
    assert predict(clips, model=folder) == 2
    assert "camera_heads" in capsys.readouterr().err


def test_nothing_asked(capsys):
    assert main([]) == 2
    with pytest.raises(SystemExit) as stop:
        main(["predict"])
    assert stop.value.code == 2


# --- info and convert-checkpoint ------------------------------------------------------------------


def test_info(checkpoint, capsys):
    assert main(["info", "--model", str(checkpoint)]) == 0
    text = capsys.readouterr().out
    for word in ("mint-hand-template-1", "torch", "cpu", "28 x 42", "tensor names"):
        assert word in text
    assert main(["info", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["python"].startswith("3.")


def test_convert_checkpoint(golden_dir, tmp_path, capsys, clips, predict):
    folder = release_folder(golden_dir, tmp_path / "release")
    assert main(["convert-checkpoint", str(folder), str(tmp_path / "ours")]) == 0
    assert "241 tensors" in capsys.readouterr().out
    assert predict(clips / "b.mp4", "--no-overlay", model=tmp_path / "ours") == 0
    assert main(["convert-checkpoint", str(folder), str(tmp_path / "ours")]) == 2
    assert "new or empty folder" in capsys.readouterr().err
    bare = release_folder(golden_dir, tmp_path / "bare", with_config=False)
    assert main(["convert-checkpoint", str(bare), str(tmp_path / "two")]) == 2
    assert "config=" in capsys.readouterr().err
    sizes = ["--config", str(folder / "config.json")]
    assert main(["convert-checkpoint", str(bare), str(tmp_path / "two"), *sizes]) == 0


def _bytes(path, data):
    path.write_bytes(data)
    return path
