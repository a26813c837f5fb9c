"""A worker: a script in a process, and maybe a Python, of its own, called over a pipe.

    with Worker(python, script, "mediapipe") as worker:
        arrays, values = worker.call("detect", {"images": images}, max_hands=4)

The script's half is `mint_hub.labelling.stages.worker_side`, where the messages are described.
The process starts with the first call, ends with `close`, and ends with this process whatever
becomes of it. Works where there are POSIX pipes and sessions.
"""

import os
import selectors
import signal
import subprocess
import threading
import time
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, Self

from numpy.typing import NDArray

from mint_hub.labelling.stage import NotReadyError, StageError
from mint_hub.labelling.stages import worker_side

_KEEP_LINES: Final = 200
_SHOW_LINES: Final = 5
_CHUNK: Final = 1 << 20
_NOT_INHERITED: Final = ("PYTHONPATH", "PYTHONHOME", "PYTHONSTARTUP", "__PYVENV_LAUNCHER__")

Arrays = dict[str, NDArray[Any]]


class WorkerDiedError(StageError):
    """The worker's process ended in the middle of a call; the next call starts a new one."""


class WorkerTimeoutError(WorkerDiedError):
    """The worker gave no answer in time and was ended; the next call starts a new one."""


class _PipeClosedError(Exception):
    """The other end of a pipe is gone."""


class _LateError(Exception):
    """The deadline passed."""


class Worker:
    """A stand-alone script that answers calls in a process of its own.

    Calls from several threads take turns. What the script prints goes nowhere; its last lines are
    shown when it dies.

    Args:
        python: the interpreter that runs it.
        script: a file that ends in ``worker_side.serve``.
        name: what errors call it.
        timeout_s: longest time a call may take, None for as long as it likes.
        start_timeout_s: longest time from start until it serves; imports can be slow.
        environment: variables added to this process's own.

    """

    def __init__(
        self,
        python: str | os.PathLike[str],
        script: str | os.PathLike[str],
        name: str,
        *,
        timeout_s: float | None = None,
        start_timeout_s: float = 300.0,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self.python, self.script, self.name = Path(python), Path(script), name
        self.timeout_s, self.start_timeout_s = timeout_s, start_timeout_s
        self.environment = dict(environment or {})
        self._process: _Process | None = None
        self._lock = threading.RLock()

    def call(
        self,
        method: str,
        arrays: Mapping[str, NDArray[Any]] | None = None,
        *,
        timeout_s: float | None = None,
        **values: Any,
    ) -> tuple[Arrays, dict[str, Any]]:
        """Have the worker do something.

        Args:
            method: one that the script serves.
            arrays: numbers or bools.
            timeout_s: for this call, instead of the worker's own.
            values: plain JSON values (numpy scalars and paths are made plain).

        Returns:
            Arrays and values that the method returned.

        Raises:
            StageError: the method raised; the message is in one line, the traceback a note.
            WorkerDiedError: the process ended: by which signal or status, and its last words.
            WorkerTimeoutError: no answer in time.
            NotReadyError: the interpreter is missing, or the script ended before it served.
            TypeError: arrays or values that a message cannot hold.

        """
        parts = worker_side.encode({"method": method, "values": values}, dict(arrays or {}))
        limit_s = self.timeout_s if timeout_s is None else timeout_s
        with self._lock:
            process = self._started()
            header, out = self._ask(process, method, parts, limit_s)
        if "error" in header:
            error = StageError(f"{self.name}, {method}: {header['error']}")
            error.add_note(header["traceback"])
            raise error
        return out, header["values"]

    def close(self) -> None:
        """End the process, if there is one; a later call starts another."""
        with self._lock:
            process, self._process = self._process, None
            if process is not None:
                process.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def pid(self) -> int | None:
        """Number of the process, None before the first call and after `close`."""
        return self._process.popen.pid if self._process else None

    def _ask(
        self, process: "_Process", method: str, parts: list[memoryview], limit_s: float | None
    ) -> tuple[dict[str, Any], Arrays]:
        deadline = None if limit_s is None else time.monotonic() + limit_s
        try:
            process.send(parts, deadline)
            return worker_side.decode(lambda view: process.receive(view, deadline))
        except _LateError:
            self.close()
            raise WorkerTimeoutError(
                f"{self.name}, {method}: no answer within {limit_s:g} s, the worker was ended"
            ) from None
        except _PipeClosedError:
            self._process = None
            how = process.ended()
            raise WorkerDiedError(f"{self.name}, {method}: the worker {how}") from None
        except BaseException:  # an interrupt in the middle leaves half a message in the pipe
            self.close()
            raise

    def _started(self) -> "_Process":
        if self._process is not None:
            if self._process.popen.poll() is None:
                return self._process
            self.close()  # it died between calls: nothing is lost
        process = _Process(self.python, self.script, self.environment, self.name)
        deadline = time.monotonic() + self.start_timeout_s
        try:
            worker_side.decode(lambda view: process.receive(view, deadline))
        except _LateError:
            process.close()
            raise WorkerTimeoutError(
                f"{self.name}: {self.script.name} did not serve within {self.start_timeout_s:g} s"
            ) from None
        except _PipeClosedError:
            how = process.ended()
            message = f"{self.name}: {self.script.name} never served: run by {self.python} it {how}"
            if (process.popen.returncode or 0) < 0:
                raise WorkerDiedError(message) from None
            raise NotReadyError(message) from None
        except BaseException:
            process.close()
            raise
        self._process = process
        return process


class _Process:
    """One run of the script: its process, its two pipes and its last words."""

    def __init__(
        self, python: Path, script: Path, environment: Mapping[str, str], name: str
    ) -> None:
        request_out, self._request = os.pipe()
        self._answer, answer_in = os.pipe()
        command = [str(python), worker_side.__file__, str(script.resolve())]
        command += [str(request_out), str(answer_in), str(os.getpid())]
        try:
            self.popen = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                pass_fds=(request_out, answer_in),
                env={**clean_environment(), **environment},
                start_new_session=True,
            )
        except OSError as error:
            os.close(self._request)
            os.close(self._answer)
            raise NotReadyError(f"{name}: {python} does not run: {error}") from error
        finally:
            os.close(request_out)
            os.close(answer_in)
        self._words: deque[str] = deque(maxlen=_KEEP_LINES)
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()
        for end in (self._request, self._answer):
            os.set_blocking(end, False)

    def send(self, parts: list[memoryview], deadline: float | None) -> None:
        for part in parts:
            rest = part
            while len(rest):
                _wait(self._request, selectors.EVENT_WRITE, deadline)
                try:
                    rest = rest[os.write(self._request, rest[:_CHUNK]) :]
                except BlockingIOError:
                    continue
                except BrokenPipeError:
                    raise _PipeClosedError from None

    def receive(self, view: memoryview, deadline: float | None) -> None:
        while len(view):
            _wait(self._answer, selectors.EVENT_READ, deadline)
            try:
                count = os.readv(self._answer, [view])
            except BlockingIOError:
                continue
            if not count:
                raise _PipeClosedError
            view = view[count:]

    def ended(self) -> str:
        """Say how a process ended that closed its pipes; end it if it did not."""
        try:
            self.popen.wait(5.0)
        except subprocess.TimeoutExpired:
            self._kill()
        self._listener.join(2.0)
        code = self.popen.returncode
        self.close()
        words = "\n".join(list(self._words)[-_SHOW_LINES:])
        how = f"ended with status {code}"
        if code < 0:
            try:
                how = f"was ended by signal {signal.Signals(-code).name}"
            except ValueError:
                how = f"was ended by signal {-code}"
        return how + (f"; its last words:\n{words}" if words else "; it said nothing")

    def close(self) -> None:
        """End the process and all it started."""
        self._kill()
        self._listener.join(2.0)
        for end in (self._request, self._answer):
            if end >= 0:
                os.close(end)
        self._request = self._answer = -1

    def _kill(self) -> None:
        if self.popen.poll() is None:
            with suppress(ProcessLookupError):  # it ended just now
                os.killpg(self.popen.pid, signal.SIGKILL)
            self.popen.wait()

    def _listen(self) -> None:
        assert self.popen.stdout is not None
        with self.popen.stdout as lines:
            for line in lines:
                if text := line.decode(errors="replace").rstrip():
                    self._words.append(text[:500])


def clean_environment() -> dict[str, str]:
    """Return this process's variables without those that would lead another Python astray."""
    return {k: v for k, v in os.environ.items() if k not in _NOT_INHERITED}


def _wait(descriptor: int, event: int, deadline: float | None) -> None:
    """Wait until a pipe can be used; `_LateError` once the deadline is over."""
    left_s = None if deadline is None else deadline - time.monotonic()
    if left_s is not None and left_s <= 0:
        raise _LateError
    with selectors.DefaultSelector() as selector:
        selector.register(descriptor, event)
        if not selector.select(left_s):
            raise _LateError
