"""Other projects' programs: frames out to them, commands run, and what went wrong in words.

For projects that are used through their scripts and files; those that are used through functions
run in a `Worker`.
"""

import os
import signal
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

import cv2

from mint_hub.labelling.frames import clip_frames
from mint_hub.labelling.records import Clip
from mint_hub.labelling.stage import NotReadyError, StageError
from mint_hub.labelling.worker import clean_environment

_SHOW_LINES: Final = 6
_TAIL_BYTES: Final = 8192


def write_frames(clip: Clip, folder: Path, suffix: str = ".png") -> list[Path]:
    """Write the frames of a clip as pictures 000000.png, 000001.png, ... into a new folder.

    Raises:
        StageError, VideoError: as of `clip_frames`.
        OSError: the folder cannot be written.

    """
    folder.mkdir(parents=True)
    quality = [cv2.IMWRITE_JPEG_QUALITY, 98] if suffix == ".jpg" else []
    paths: list[Path] = []
    for number, image in enumerate(clip_frames(clip)):
        path = folder / f"{number:06d}{suffix}"
        done, data = cv2.imencode(suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR), quality)
        assert done, suffix
        path.write_bytes(data.tobytes())
        paths.append(path)
    return paths


def run_command(
    name: str,
    command: Sequence[str | os.PathLike[str]],
    cwd: Path,
    *,
    environment: Mapping[str, str] | None = None,
    timeout_s: float | None = None,
) -> None:
    """Run another project's program to its end; it and all it started end with a failure here.

    Args:
        name: what errors call it.
        command: program and arguments.
        cwd: folder it runs in.
        environment: variables added to this process's own.
        timeout_s: longest time it may take.

    Raises:
        NotReadyError: the program does not start.
        StageError: it failed or took too long; with its last lines.

    """
    with tempfile.TemporaryFile() as said:
        try:
            process = subprocess.Popen(
                [os.fspath(part) for part in command],
                cwd=cwd,
                stdin=subprocess.DEVNULL,
                stdout=said,
                stderr=subprocess.STDOUT,
                env={**clean_environment(), **(environment or {})},
                start_new_session=True,
            )
        except OSError as error:
            raise NotReadyError(f"{name}: {command[0]} does not run: {error}") from error
        try:
            status = process.wait(timeout_s)
        except BaseException as error:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            if isinstance(error, subprocess.TimeoutExpired):
                raise StageError(f"{name}: not done within {timeout_s:g} s, ended") from None
            raise
        if status:
            size = said.seek(0, os.SEEK_END)
            said.seek(max(0, size - _TAIL_BYTES))
            lines = [line for line in said.read().decode(errors="replace").splitlines() if line]
            how = f"signal {-status}" if status < 0 else f"status {status}"
            last = " | ".join(lines[-_SHOW_LINES:])
            raise StageError(f"{name}: ended with {how}: {last or 'it said nothing'}")
