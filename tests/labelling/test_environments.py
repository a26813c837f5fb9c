"""Environments: made once, whole or not at all, and honest when they cannot be made."""

import subprocess
import sys
import threading
import zipfile
from pathlib import Path

import pytest

from mint_hub.labelling.environments import Environment
from mint_hub.labelling.stage import NotReadyError


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    path = tmp_path / "environments"
    monkeypatch.setenv("MINT_HUB_ENVIRONMENTS", str(path))
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    return path


@pytest.fixture(scope="session")
def wheel(tmp_path_factory) -> Path:
    """A package of one module, as a wheel, so that pip needs no network."""
    path = tmp_path_factory.mktemp("wheels") / "tiny_thing-1.0-py3-none-any.whl"
    info = "tiny_thing-1.0.dist-info"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("tiny_thing.py", "ANSWER = 42\n")
        archive.writestr(
            f"{info}/METADATA", "Metadata-Version: 2.1\nName: tiny-thing\nVersion: 1.0\n"
        )
        archive.writestr(
            f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
        )
        archive.writestr(f"{info}/RECORD", "")
    return path


def tiny(wheel: Path) -> Environment:
    return Environment("tiny", (f"tiny-thing @ {wheel.as_uri()}",), ("tiny_thing",))


def answer(python: Path) -> str:
    code = "import tiny_thing; print(tiny_thing.ANSWER)"
    return subprocess.check_output([python, "-c", code], text=True).strip()


def test_this_interpreter_is_used_when_it_will_do(folder):
    here = Environment("here", ("numpy>=2", "tomli; python_version < '3'"), ("numpy",))
    assert here.ready() is None
    assert here.python() == Path(sys.executable)
    assert here.where() == sys.executable
    assert not folder.exists()


@pytest.mark.parametrize(
    ("requirement", "module"),
    [("numpy<1", "numpy"), ("no-such-thing-at-all", "numpy"), ("numpy", "no_such_module")],
)
def test_this_interpreter_will_not_do(requirement, module, folder):
    environment = Environment("other", (requirement,), (module,))
    missing = environment.ready()
    assert missing is not None
    assert requirement in missing
    assert str(folder) in missing
    assert not folder.exists()  # asking makes nothing


def test_made_once_and_again_after_a_kill(wheel, folder, capfd, monkeypatch):
    environment = tiny(wheel)
    python = environment.python()
    assert answer(python) == "42"
    assert folder in python.parents
    assert environment.ready() is None
    assert capfd.readouterr().err.count("making an environment for tiny") == 1
    made = python.parents[1]
    stamp = (made / "made.json").stat().st_mtime_ns
    assert environment.python() == python
    assert (made / "made.json").stat().st_mtime_ns == stamp
    # as a kill in the middle leaves it: files, but no mark
    (made / "made.json").unlink()
    next(made.rglob("tiny_thing.py")).unlink()
    assert environment.ready() is not None
    monkeypatch.setenv("PYTHONPATH", str(folder))  # which would lead the other Python astray
    assert answer(environment.python()) == "42"


def test_two_makers_at_once(wheel, folder, capfd):
    found: list[Path] = []
    threads = [threading.Thread(target=lambda: found.append(tiny(wheel).python())) for _ in "ab"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 2
    assert found[0] == found[1]
    assert answer(found[0]) == "42"
    assert capfd.readouterr().err.count("making an environment") == 1


def test_pip_without_a_network_says_why(folder):
    environment = Environment("absent", ("a-package-that-is-not-there==3",), ("absent",))
    with pytest.raises(NotReadyError, match="pip failed") as caught:
        environment.python()
    assert "No matching distribution found for a-package-that-is-not-there==3" in str(caught.value)
    assert environment.ready() is not None


def test_a_folder_that_cannot_be_written(wheel, tmp_path, monkeypatch):
    file = tmp_path / "file"
    file.write_text("in the way")
    monkeypatch.setenv("MINT_HUB_ENVIRONMENTS", str(file / "below"))
    with pytest.raises(NotReadyError, match="MINT_HUB_ENVIRONMENTS"):
        tiny(wheel).python()


def test_what_is_no_environment():
    with pytest.raises(ValueError, match="name"):
        Environment("../x", (), ())
    with pytest.raises(ValueError, match=r"requirements.*'\?\?'"):
        Environment("x", ("??",), ())
