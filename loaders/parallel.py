"""One function over many items, in several processes, with the results in the items' order."""

import multiprocessing
import os
import sys
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from typing import Any, Literal, TypeVar

from mint_hub.loaders.tar_layout import CorpusError

T = TypeVar("T")

_function: Callable[[Any], Any] | None = None
"""What this process does with every item; set in worker processes only."""

_left: Any = None
"""Shared by all: its ``value`` is true once nobody waits for results; set in workers only."""


def in_order(
    function: Callable[[Any], T],
    items: Iterable[Any],
    num_procs: int = 1,
    batch: int = 16,
    start: Literal["spawn", "fork", "forkserver"] | None = None,
) -> Generator[T]:
    """Yield ``function(item)`` for every item, in their order, whatever the number of processes.

    Items are taken a few batches ahead of the reader, never all at once. ``function`` travels to
    each process once. Processes end with the generator, and also when their parent is killed: one
    that is closed, or that raises, waits for the items in hand and leaves those that wait. They
    start as Python has it by default, or as ``start`` says: what holds threads or graphics must
    not be forked. Each computes with its share of the cores.

    Raises:
        CorpusError: a process died. What ``function`` raises is raised here.

    """
    if num_procs <= 1:
        yield from map(function, items)
        return
    stream = iter(items)
    waiting: deque[Future[list[T]]] = deque()
    try:
        context = multiprocessing.get_context(start)
        # Without a lock, which a process that dies could keep. The pool could not cancel these: all
        # that wait here are in its queue to the processes.
        left: Any = context.RawValue("b", 0)
        with ProcessPoolExecutor(num_procs, context, _begin, (function, left, num_procs)) as pool:
            try:
                while part := list(islice(stream, batch)):
                    waiting.append(pool.submit(_do, part))
                    if len(waiting) > 2 * num_procs:
                        yield from waiting.popleft().result()
                while waiting:
                    yield from waiting.popleft().result()
            finally:
                left.value = 1
    except BrokenProcessPool:
        raise CorpusError(
            "a worker process died (out of memory?): call again, with a lower num_procs"
        ) from None


def _begin(function: Callable[[Any], Any], left: Any, num_procs: int) -> None:
    global _function, _left
    _function, _left = function, left
    _share_cores(num_procs)
    threading.Thread(target=_leave_with_parent, daemon=True).start()


def _share_cores(num_procs: int) -> None:
    """Leave the others theirs: with a thread for every core in every process, each waits on all."""
    share = max(1, (os.cpu_count() or 1) // num_procs)
    os.environ.setdefault("OMP_NUM_THREADS", str(share))  # read by what is loaded later
    if (torch := sys.modules.get("torch")) is not None:
        torch.set_num_threads(min(torch.get_num_threads(), share))


def _leave_with_parent() -> None:
    """End this process when its parent was killed; it would wait for work for ever."""
    if (parent := multiprocessing.parent_process()) is not None:
        parent.join()
        os._exit(1)


def _do(items: list[Any]) -> list[Any]:
    assert _function is not None
    return [_function(item) for item in items if not _left.value]
