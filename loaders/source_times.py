"""Times of the stored frames that an episode shows, in few bytes: ``meta["source_timestamps_s"]``.

A predicted episode says of every frame when the stored frame it shows was presented. As JSON
numbers that is 19 bytes a frame. Containers count time in ticks, and nearly all steps repeat, so
the ``json`` member of a sample says instead, and ``unpack`` restores the list:

- ``{"ticks_a_second", "first", "step", "blocks"}``: frame 0 is at tick ``first``; each block
  ``[changes, times]`` says ``times`` over how much longer than ``step`` the next steps are. Exact,
  to the bit, for any frame rate, constant or not.
- ``{"start_s", "fps", "count"}``: start + k / fps, for times that are no ticks but within
  REGULAR_TOLERANCE_S of that.
- the list itself, for anything else.

>>> pack([k / 25 for k in range(1000)])
{'ticks_a_second': 25, 'first': 0, 'step': 1, 'blocks': [[[0], 999]]}
>>> unpack(pack([0.0, 0.02, 0.06]), 3)
[0.0, 0.02, 0.06]
"""

import math
from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from mint_hub.loaders.fields import EpisodeError

REGULAR_TOLERANCE_S: Final = 1e-6
"""How far the times of ``{"start_s", "fps", "count"}`` may be from those that were given."""

LONGEST_BLOCK: Final = 64
"""Steps after which a pattern of steps may repeat: 30 for 29.97 frames a second in milliseconds."""

_DENOMINATORS: Final = 200_000
_MAX_TICKS_A_SECOND: Final = 10**9
_WORTH: Final = 4


def pack(times: Sequence[Any]) -> dict[str, Any] | list[Any]:
    """Return what ``unpack`` makes the same times of; the list itself where nothing shorter does.

    The same times give the same value, and so do the times that come back.
    """
    if not times or any(isinstance(t, bool) or not isinstance(t, int | float) for t in times):
        return list(times)
    seconds = np.asarray(times, np.float64)
    if np.isfinite(seconds).all():
        for ticks in (_common_ticks(seconds), 10**6, _MAX_TICKS_A_SECOND):
            if ticks is not None and _is_ticks(seconds, ticks):
                return _in_ticks(seconds, ticks)
        if (regular := _regular(seconds)) is not None:
            return regular
    return list(times)


def unpack(value: Any, num_frames: int) -> list[Any]:
    """Return the list of times that ``pack`` was given, one a frame.

    Raises:
        EpisodeError: not what ``pack`` returns, or not ``num_frames`` times.

    """
    place = "source_timestamps_s"
    if isinstance(value, list):
        given = cast("list[Any]", value)
        if len(given) != num_frames:
            raise EpisodeError(f"{place}: expected {num_frames} times, got {len(given)}")
        return given
    if not isinstance(value, Mapping):
        raise EpisodeError(f"{place}: expected times or their short form, got {value!r}")
    form = cast("Mapping[str, Any]", value)
    try:
        seconds = _restored(form, num_frames)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise EpisodeError(
            f"{place}: expected the short form of {num_frames} times, got {type(error).__name__}: "
            f"{error}"
        ) from None
    return seconds.tolist()


# ---------------------------------------------------------------------- ticks


def _is_ticks(seconds: NDArray[np.float64], ticks: int) -> bool:
    count = np.rint(seconds * ticks)
    return bool((np.abs(count) < 2**53).all() and (count / ticks == seconds).all())


def _common_ticks(seconds: NDArray[np.float64]) -> int | None:
    """The fewest ticks a second of which all times are whole numbers, found from few of them."""
    ticks = 1
    while (late := np.flatnonzero(np.rint(seconds * ticks) / ticks != seconds)).size:
        of_one = Fraction(float(seconds[late[0]])).limit_denominator(_DENOMINATORS).denominator
        if ticks % of_one == 0:
            return None  # no fraction of so small numbers
        ticks = math.lcm(ticks, of_one)
        if ticks > _MAX_TICKS_A_SECOND:
            return None
    return ticks


def _in_ticks(seconds: NDArray[np.float64], ticks: int) -> dict[str, Any]:
    count = np.rint(seconds * ticks).astype(np.int64)
    steps = np.diff(count)
    step = int(np.sort(steps)[len(steps) // 2]) if len(steps) else 0
    return {
        "ticks_a_second": ticks,
        "first": int(count[0]),
        "step": step,
        "blocks": _blocks(steps - step),
    }


def _blocks(changes: NDArray[np.int64]) -> list[list[Any]]:
    """Changes as [block, times] pairs, each the repetition that covers most from there on."""
    covered, period = _repetitions(changes)
    blocks: list[list[Any]] = []
    i, alone = 0, 0  # frames before i from ``alone`` on are in no block yet
    while i < len(changes):
        if covered[i] - period[i] < _WORTH:
            i += 1
            continue
        if alone < i:
            blocks.append([changes[alone:i].tolist(), 1])
        size = int(period[i])
        blocks.append([changes[i : i + size].tolist(), int(covered[i]) // size])
        i += int(covered[i])
        alone = i
    if alone < len(changes):
        blocks.append([changes[alone:].tolist(), 1])
    return blocks


def _repetitions(changes: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """How many changes from each one on are whole repetitions of a block, and its size; (N,)."""
    total = len(changes)
    places = np.arange(total)
    best, period = np.ones(total, np.int64), np.ones(total, np.int64)
    for size in range(1, min(LONGEST_BLOCK, total // 2) + 1):
        ends = np.append(np.flatnonzero(changes[size:] != changes[:-size]), total - size)
        same = ends[np.searchsorted(ends, places).clip(max=len(ends) - 1)] - places
        covered = size * (1 + same.clip(min=0) // size)
        better = covered - size > best - period
        best[better], period[better] = covered[better], size
    return best, period


def _regular(seconds: NDArray[np.float64]) -> dict[str, Any] | None:
    count, start = len(seconds), float(seconds[0])
    span = float(seconds[-1]) - start
    if span <= 0:
        return None
    for fps in (round((count - 1) / span, 6), (count - 1) / span):
        if fps > 0:
            error = np.abs(start + np.arange(count) / fps - seconds)
            if error.max() <= REGULAR_TOLERANCE_S:
                return {"start_s": start, "fps": fps, "count": count}
    return None


# --------------------------------------------------------------------- restore


def _restored(form: Mapping[str, Any], num_frames: int) -> NDArray[np.float64]:
    if set(form) == {"start_s", "fps", "count"}:
        if form["count"] != num_frames or not form["fps"] > 0:
            raise ValueError(f"{dict(form)}")
        return form["start_s"] + np.arange(num_frames) / form["fps"]
    if set(form) != {"ticks_a_second", "first", "step", "blocks"}:
        raise ValueError(f"the entries {sorted(form)}")
    ticks = form["ticks_a_second"]
    whole = [ticks, form["first"], form["step"], *(times for _, times in form["blocks"])]
    whole += [change for block, _ in form["blocks"] for change in block]
    if not all(type(n) is int for n in whole) or ticks < 1:
        raise ValueError("numbers that are not whole")
    size = sum(len(block) * max(times, 0) for block, times in form["blocks"])
    if size != num_frames - 1:
        raise ValueError(f"{size + 1} times")
    parts = [np.tile(np.array(block, np.int64), times) for block, times in form["blocks"]]
    steps = np.concatenate([np.zeros(1, np.int64), *(part + form["step"] for part in parts)])
    return (form["first"] + np.cumsum(steps)) / ticks
