"""Other projects' programs: frames out, and how a command ended."""

import os
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from mint_hub.labelling.external import run_command, write_frames
from mint_hub.labelling.stage import NotReadyError, StageError
from tests import video_files as make
from tests.labelling.research_projects import clip_of


def test_frames_are_written_as_they_are_shown(tmp_path):
    clip = clip_of(make.video(tmp_path / "a.mp4", 30), 5, first=7)
    paths = write_frames(clip, tmp_path / "png" / "scene")
    assert [path.name for path in paths] == [f"{i:06d}.png" for i in range(5)]
    for number, path in enumerate(paths):
        image = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
        assert make.frame_number(image) == 7 + number
        red = image[2, 2].astype(int)
        assert red[0] > red[2] + 100
    jpg = write_frames(clip, tmp_path / "jpg", ".jpg")
    near = np.abs(cv2.imread(str(jpg[0])).astype(int) - cv2.imread(str(paths[0])))
    assert near.mean() < 4
    with pytest.raises(FileExistsError):
        write_frames(clip, tmp_path / "jpg")


def python(code: str) -> list[str]:
    return [sys.executable, "-c", code]


def test_a_command_runs_where_and_with_what_it_is_told(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", "elsewhere")
    code = "import os; open('out', 'w').write(os.environ['A'] + os.environ.get('PYTHONPATH', ''))"
    run_command("try", python(code), tmp_path, environment={"A": "b"})
    assert (tmp_path / "out").read_text() == "b"


def test_a_command_that_fails(tmp_path):
    code = "print('x' * 100000); print('reason'); raise SystemExit(3)"
    with pytest.raises(StageError, match=r"try: ended with status 3: .*\| reason$") as caught:
        run_command("try", python(code), tmp_path)
    assert len(str(caught.value)) < 10000
    with pytest.raises(StageError, match="signal 9: it said nothing"):
        run_command("try", python("import os; os.kill(os.getpid(), 9)"), tmp_path)
    with pytest.raises(NotReadyError, match="does not run"):
        run_command("try", [tmp_path / "nothing"], tmp_path)


def test_a_command_that_takes_too_long_goes_with_all_it_started(tmp_path):
    code = """
import subprocess, sys, time
child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
open("pid", "w").write(str(child.pid))
time.sleep(600)
"""
    with pytest.raises(StageError, match="not done within 2 s"):
        run_command("try", python(code), tmp_path, timeout_s=2.0)
    pid = int((tmp_path / "pid").read_text())
    end = time.monotonic() + 20
    while _runs(pid) and time.monotonic() < end:
        time.sleep(0.05)
    assert not _runs(pid)


def _runs(pid: int) -> bool:
    try:
        os.kill(pid, 0)
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except (ProcessLookupError, FileNotFoundError):
        return False
