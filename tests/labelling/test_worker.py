"""Workers: what goes in comes out, and every way to fail is told apart."""

import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from mint_hub.labelling.stage import NotReadyError, StageError
from mint_hub.labelling.stages import worker_side
from mint_hub.labelling.worker import Worker, WorkerDiedError, WorkerTimeoutError

SCRIPT = """
import os, signal, sys, time

print("a library that greets on import")

def same(arrays, **values):
    return arrays, values

def chatter(arrays):
    os.write(1, b"x" * 200_000)
    print("words")
    return {}, {"pid": os.getpid()}

def fail(arrays, text):
    raise ValueError("first line\\n" + text)

def die(arrays, number):
    print("about to go", file=sys.stderr, flush=True)
    os.kill(os.getpid(), number)
    time.sleep(60)

def leave(arrays, status):
    sys.exit(status)

def hang(arrays):
    time.sleep(600)

def paths(arrays):
    return {}, {"paths": [os.path.basename(p) for p in sys.path], "argv": len(sys.argv)}

def objects(arrays):
    return {"x": __import__("numpy").array([object()])}, {}

if __name__ == "__main__":
    from worker_side import serve

    names = (same, chatter, fail, die, leave, hang, paths, objects)
    serve({f.__name__: f for f in names})
"""


@pytest.fixture(scope="module")
def script(tmp_path_factory):
    path = tmp_path_factory.mktemp("worker") / "script.py"
    path.write_text(SCRIPT)
    return path


@pytest.fixture
def worker(script):
    with Worker(sys.executable, script, "try") as one:
        yield one


@pytest.fixture(scope="module")
def kept(script):
    """One process for the tests that leave it as it was."""
    with Worker(sys.executable, script, "try") as one:
        yield one


def alive(pid: int) -> bool:
    """Whether the process runs (one that ended and nobody asked after does not)."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def wait_until(condition, limit_s=30.0):
    end = time.monotonic() + limit_s
    while not condition() and time.monotonic() < end:
        time.sleep(0.05)
    return condition()


dtypes = st.sampled_from(["?", "u1", "<i2", ">i4", "<i8", "<f2", "<f4", ">f8", "<c8"])
arrays = hnp.arrays(dtypes, hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4))


@settings(deadline=None, max_examples=40)
@given(given_arrays=st.dictionaries(st.text(max_size=5), arrays, max_size=3))
def test_arrays_come_back_as_they_went(given_arrays):
    parts = b"".join(bytes(p) for p in worker_side.encode({"method": "m"}, given_arrays))
    place = 0

    def read_into(view):
        nonlocal place
        view[:] = parts[place : place + len(view)]
        place += len(view)

    header, got = worker_side.decode(read_into)
    assert header == {"method": "m"}
    assert place == len(parts)
    assert list(got) == list(given_arrays)
    for name, array in given_arrays.items():
        assert got[name].dtype == array.dtype
        assert got[name].shape == array.shape
        assert got[name].tobytes() == array.tobytes()


def test_a_call_goes_there_and_back(kept):
    strided = np.arange(24, dtype=np.float32).reshape(4, 6)[::2, ::-1]
    out, values = kept.call("same", {"a": strided, "none": np.zeros((0, 3))}, x=1.5, y=["é", None])
    np.testing.assert_array_equal(out["a"], strided)
    assert out["none"].shape == (0, 3)
    assert values == {"x": 1.5, "y": ["é", None]}
    out["a"][0] = 0  # what comes back may be written to
    assert kept.call("same", where=Path("a/b"), n=np.float32(0.5))[1] == {"where": "a/b", "n": 0.5}


def test_big_arrays(kept):
    big = np.random.default_rng(0).integers(0, 255, (80 << 20,), np.uint8)
    out, _ = kept.call("same", {"big": big, "small": np.float64(3)})
    assert np.array_equal(out["big"], big)
    assert out["small"] == 3


def test_what_is_printed_harms_nothing(kept):
    first = kept.call("chatter")[1]["pid"]
    assert kept.call("chatter")[1]["pid"] == first == kept.pid


def test_an_exception_is_a_stage_error_and_the_worker_goes_on(kept):
    pid = kept.call("chatter")[1]["pid"]
    with pytest.raises(
        StageError, match=r"^try, fail: ValueError: first line and the last\n"
    ) as caught:
        kept.call("fail", text="and the last")
    assert not isinstance(caught.value, WorkerDiedError)
    assert "in fail" in caught.value.__notes__[0]
    assert kept.call("chatter")[1]["pid"] == pid


def test_what_cannot_be_sent(kept):
    with pytest.raises(StageError, match=r"expected one of .*'same'.* got 'nothing'"):
        kept.call("nothing")
    with pytest.raises(StageError, match="array of numbers or bools, got object"):
        kept.call("objects")
    with pytest.raises(TypeError, match="numbers or bools, got object"):
        kept.call("same", {"x": np.array([object()])})
    with pytest.raises(TypeError, match="plain value"):
        kept.call("same", x=object())
    assert kept.call("same", x=1)[1] == {"x": 1}


def test_the_scripts_folder_is_not_importable(kept):
    _, values = kept.call("paths")
    assert "stages" not in values["paths"]
    assert values["argv"] == 1


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSEGV, signal.SIGTERM])
def test_death_by_signal_names_it_and_the_next_call_works(worker, number):
    with pytest.raises(WorkerDiedError, match=f"signal {number.name}") as caught:
        worker.call("die", number=int(number))
    assert "about to go" in str(caught.value)
    assert worker.call("same", x=2)[1] == {"x": 2}


def test_leaving_names_the_status(worker):
    with pytest.raises(WorkerDiedError, match="ended with status 7"):
        worker.call("leave", status=7)
    assert worker.call("same")[1] == {}


def test_death_between_calls_is_nobodys_loss(worker):
    os.kill(worker.call("chatter")[1]["pid"], signal.SIGKILL)
    assert wait_until(lambda: worker._process.popen.poll() is not None)
    assert worker.call("same", x=3)[1] == {"x": 3}


def test_a_hanging_call_is_ended(worker):
    worker.call("same")
    pid = worker.pid
    with pytest.raises(WorkerTimeoutError, match=r"try, hang: no answer within 0\.3 s"):
        worker.call("hang", timeout_s=0.3)
    assert worker.pid is None
    assert not alive(pid)
    assert worker.call("same", x=4)[1] == {"x": 4}


def test_close_ends_the_process(worker):
    worker.call("same")
    pid = worker.pid
    worker.close()
    worker.close()
    assert not alive(pid)


def test_no_pipe_is_left_open(worker):
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(3):
        worker.call("same")
        worker.close()
    assert len(os.listdir("/proc/self/fd")) == before


def test_scripts_that_never_serve(tmp_path):
    script = tmp_path / "broken.py"
    script.write_text("import a_package_nobody_has")
    with pytest.raises(NotReadyError, match="No module named 'a_package_nobody_has'"):
        Worker(sys.executable, script, "broken").call("x")
    script.write_text("import os, signal; os.kill(os.getpid(), signal.SIGABRT)")
    with pytest.raises(WorkerDiedError, match="SIGABRT"):
        Worker(sys.executable, script, "broken").call("x")
    script.write_text("import time; time.sleep(600)")
    with pytest.raises(WorkerTimeoutError, match="did not serve within"):
        Worker(sys.executable, script, "broken", start_timeout_s=0.5).call("x")
    with pytest.raises(NotReadyError, match="does not run"):
        Worker(tmp_path / "no-python", script, "broken").call("x")


def test_ends_with_its_parent(script, tmp_path):
    """Even a parent that is killed in the middle of a call leaves no worker behind."""
    note = tmp_path / "pid"
    code = f"""
    import sys
    from mint_hub.labelling.worker import Worker
    worker = Worker(sys.executable, {str(script)!r}, "try")
    worker.call("same")
    open({str(note)!r}, "w").write(str(worker.pid))
    worker.call("hang")
    """
    root = Path(__file__).parents[2]
    parent = subprocess.Popen([sys.executable, "-c", textwrap.dedent(code)], cwd=root)
    try:
        assert wait_until(lambda: note.exists() and note.read_text())
        pid = int(note.read_text())
        assert alive(pid)
    finally:
        parent.kill()
        parent.wait()
    assert wait_until(lambda: not alive(pid))


def test_a_worker_script_cannot_serve_by_itself():
    with pytest.raises(RuntimeError, match="Worker starts it"):
        worker_side.serve({})
