"""The doctor says what is ready, what is missing, where it comes from, and makes nothing."""

import sys

import pytest

from mint_hub.labelling.backends import BACKENDS, Backend, backend_of
from mint_hub.labelling.doctor import doctor
from mint_hub.labelling.environments import Environment
from mint_hub.labelling.readiness import Lack, check, path_lacks, python_for, python_lacks
from mint_hub.labelling.stage import NotReadyError


@pytest.fixture(autouse=True)
def environments(tmp_path, monkeypatch):
    folder = tmp_path / "environments"
    monkeypatch.setenv("MINT_HUB_ENVIRONMENTS", str(folder))
    return folder


def one(stage: str, name: str, **settings):
    given = {f"{stage}={name}": settings} if settings else None
    (found,) = doctor(given, [backend_of(stage, name)])
    return found


def test_every_backend_in_order(environments):
    found = doctor()
    assert [(r.stage, r.backend) for r in found] == [(b.stage, b.name) for b in BACKENDS]
    for readiness in found:
        assert readiness.ready == (not readiness.lacks) == (not readiness.where)
        assert f"{readiness.stage}={readiness.backend}" in str(readiness)
        if readiness.default:
            assert readiness.ready or readiness.automatic, readiness
    assert not environments.exists()


def test_an_environment_comes_by_itself():
    found = one("detect", "mediapipe")
    assert (found.ready, found.automatic) == (False, True)
    assert "mediapipe==0.10.21" in found.lacks
    assert "on first use" in str(found)
    assert one("detect", "mediapipe", python=sys.executable).ready
    assert not one("detect", "mediapipe", python="/no/such/python").automatic


def test_files_of_the_user_do_not(tmp_path):
    found = one("camera", "droid_slam")
    assert (found.ready, found.automatic) == (False, False)
    assert "DROID-SLAM" in found.lacks
    assert "github.com/princeton-vl/DROID-SLAM" in found.where
    (tmp_path / "checkout" / "droid_slam").mkdir(parents=True)
    (tmp_path / "droid.pth").touch()
    settings = {"checkout": str(tmp_path / "checkout"), "weights": str(tmp_path / "droid.pth")}
    almost = one("camera", "droid_slam", **settings)
    assert almost.lacks == "an interpreter (setting python)"
    assert one("camera", "droid_slam", **settings, python=sys.executable).ready
    # part comes by itself, part does not
    assert not one("detect", "yolo").automatic


def test_settings_that_a_backend_cannot_do_without():
    found = one("intrinsics", "given")
    assert not found.ready
    assert "fov_deg" in found.lacks
    assert one("intrinsics", "given", fov_deg=90.0).ready


def test_a_module_that_is_not_installed(monkeypatch):
    monkeypatch.setitem(sys.modules, "mint_hub.inference.runner", None)
    monkeypatch.delitem(sys.modules, "mint_hub.labelling.stages.mint", raising=False)
    found = one("hands", "mint")
    assert not found.ready
    assert "mint_hub.inference.runner" in found.lacks


def test_settings_that_nobody_has():
    with pytest.raises(ValueError, match=r"settings: expected backends among .*'camera=colmap'"):
        doctor({"camera=colmap": {}})
    with pytest.raises(ValueError, match=r"expected settings among .*'x'"):
        one("detect", "mediapipe", x=1)
    assert doctor(backends=[Backend("detect", "mediapipe", "mediapipe_hands:MediaPipeHands", "")])


def test_paths(tmp_path):
    def what(*lacks: Lack) -> str:
        return "; ".join(lack.what for lack in lacks)

    assert what(*path_lacks("weights", "", "a net", "w")) == "a net (setting weights: its path)"
    missing = path_lacks("weights", str(tmp_path / "x"), "a net", "w")
    assert "where nothing is" in what(*missing)
    inside = path_lacks("checkout", str(tmp_path), "it", "w", "a.py", "b.py")
    assert what(*inside).endswith("no a.py, b.py in it")
    (tmp_path / "a.py").touch()
    assert path_lacks("checkout", str(tmp_path), "it", "w", "a.py") == ()
    check(())
    with pytest.raises(NotReadyError, match=r"missing: .*nothing is; w; and it at"):
        check((*missing, *inside))


def test_interpreters(tmp_path):
    here = Environment("here", ("numpy",), ("numpy",))
    assert str(python_for("", here)) == sys.executable
    assert str(python_for(sys.executable, None)) == sys.executable
    assert python_lacks("", here) == ()
    assert python_lacks("sh") == ()  # found on the path
    file = tmp_path / "python"
    file.touch()
    for python in ("", str(tmp_path), str(file), str(tmp_path / "none")):
        assert len(python_lacks(python)) == 1
        with pytest.raises(NotReadyError, match="setting python"):
            python_for(python)
