"""Which detection is which hand: tracks over frames, and one side for each track.

Detectors name the side of a hand anew in every frame, and are often wrong. Here detections are
first joined to tracks by where they are; then each track as a whole is a left or a right hand, by
the sum of what its detections say and of how often it is the leftmost of two. Of two tracks of one
side at a time, the better supported stays.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from mint_hub.conventions import LEFT, RIGHT, SIDES
from mint_hub.labelling.records import Detections

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class TrackSettings:
    """How detections become tracks, and tracks hands.

    Attributes:
        reach: how far a hand may have moved since it was last seen, as a share of its size in the
            image; for a frame more that it was not seen, a quarter of that is added.
        gap_frames: frames that a track may go unseen; they stay unseen, only the name goes on.
        size_ratio: the larger of two successive sizes divided by the smaller, at most.
        side_cost: what a wholly wrong side adds to a distance (of reach) when hands are matched.
        swap_evidence: a track is cut in two where it came near another or was not seen, if the
            two parts each say so much (in sure frames) that they are different hands.
        leftmost_weight: what being the leftmost (rightmost) of two hands of a frame counts, next to
            a sure side score, which counts 1.
        least_frames: shorter tracks are no hands.

    """

    reach: float = 0.6
    gap_frames: int = 12
    size_ratio: float = 2.0
    side_cost: float = 0.3
    swap_evidence: float = 6.0
    leftmost_weight: float = 0.5
    least_frames: int = 3


@dataclass(frozen=True, eq=False)
class Track:
    """One hand through a clip.

    Attributes:
        side: LEFT or RIGHT.
        detections: (N,) detections, in order of frame; one a frame.
        right_evidence: sum over detections of -1 (surely left) to 1 (surely right), and what the
            order of two hands says.
        agreement: share of its detections whose own side is the track's.
        score: mean detector score.

    """

    side: int
    detections: Ints
    right_evidence: float
    agreement: float
    score: float


@dataclass(frozen=True, eq=False)
class HandTracks:
    """What became of the detections of a clip.

    Attributes:
        index: (T, 2) int32 detection of each hand, left first; -1 where none.
        tracks: those in ``index``.
        flips: detections whose own side was not their track's.
        dropped: detections in no track, or in one that had to give way.

    """

    index: NDArray[np.int32]
    tracks: tuple[Track, ...]
    flips: int
    dropped: int


@dataclass(eq=False)
class _Open:
    """A track being made."""

    members: list[int] = field(default_factory=list[int])
    right: float = 0.5

    def add(self, detection: int, right_score: float) -> None:
        self.members.append(detection)
        self.right += 0.2 * (right_score - self.right)


def hand_tracks(
    found: Detections, num_frames: int, settings: TrackSettings | None = None
) -> HandTracks:
    """Join detections to at most one left and one right hand a frame.

    Args:
        found: detections of a clip, in order of frame; without any, no hand is found.
        num_frames: T.
        settings: thresholds.

    Raises:
        ValueError: detections out of order, or of frames that the clip does not have.

    """
    settings = settings or TrackSettings()
    frame = found.frame
    if len(frame) and (np.any(np.diff(frame) < 0) or frame[0] < 0 or frame[-1] >= num_frames):
        raise ValueError(
            f"detections.frame: expected numbers in order from 0 to {num_frames - 1}, got "
            f"{int(frame.min())} to {int(frame.max())}"
            f"{'' if np.all(np.diff(frame) >= 0) else ', not in order'}"
        )
    centre, size = _places(found)
    usable = np.isfinite(centre).all(1) & (size > 0)
    joined = _associate(found, centre, size, usable, settings)
    evidence = _right_evidence(found, centre, joined, settings)
    parts = [
        part
        for track in joined
        for part in _without_swaps(track, joined, found, centre, size, evidence, settings)
    ]
    parts = [part for part in parts if len(part) >= settings.least_frames]
    return _one_a_side(parts, found, evidence, num_frames, settings)


def _places(found: Detections) -> tuple[Floats, Floats]:
    """Centres (N, 2) and sizes (N,) of boxes, pixels; NaN where a box is not finite."""
    box = found.box_xyxy.astype(np.float64)
    box[~np.isfinite(box)] = np.nan
    return (box[:, :2] + box[:, 2:]) / 2, np.linalg.norm(box[:, 2:] - box[:, :2], axis=1)


def _associate(
    found: Detections,
    centre: Floats,
    size: Floats,
    usable: NDArray[np.bool_],
    settings: TrackSettings,
) -> list[Ints]:
    """Match each frame's detections to the tracks that are open (Kuhn 1955)."""
    done: list[_Open] = []
    live: list[_Open] = []
    bounds = np.flatnonzero(np.diff(found.frame, prepend=-1, append=-1))
    for start, stop in pairwise(bounds.tolist()) if len(found.frame) else ():
        now = int(found.frame[start])
        here = [int(i) for i in range(start, stop) if usable[i]]
        late = [t for t in live if now - found.frame[t.members[-1]] > settings.gap_frames + 1]
        done += late
        live = [t for t in live if t not in late]
        cost = np.array(
            [[_distance(found, centre, size, t, i, settings) for i in here] for t in live]
        ).reshape(len(live), len(here))
        rows, columns = linear_sum_assignment(np.minimum(cost, 1e3))
        taken: set[int] = set()
        for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
            if np.isfinite(cost[row, column]):
                live[row].add(here[column], float(found.right_score[here[column]]))
                taken.add(here[column])
        for i in here:
            if i not in taken:
                live.append(_Open([i], float(found.right_score[i])))
    return [np.array(t.members, np.int64) for t in done + live]


def _distance(
    found: Detections, centre: Floats, size: Floats, track: _Open, i: int, settings: TrackSettings
) -> float:
    """Distance of a detection from a track's end, 1 at the reach; infinite beyond."""
    last = track.members[-1]
    frames = int(found.frame[i] - found.frame[last])
    scale = (size[i] + size[last]) / 2
    if max(size[i], size[last]) > settings.size_ratio * min(size[i], size[last]):
        return np.inf
    reach = settings.reach * (1 + 0.25 * (frames - 1)) * scale
    shift = found.landmarks_uv[i] - found.landmarks_uv[last]
    moved = float(np.linalg.norm(shift, axis=-1).mean())
    if not np.isfinite(moved):
        moved = float(np.linalg.norm(centre[i] - centre[last]))
    if moved > reach and _overlap(found.box_xyxy[i], found.box_xyxy[last]) < 0.3:
        return np.inf
    return moved / reach + settings.side_cost * abs(float(found.right_score[i]) - track.right)


def _overlap(a: NDArray[np.float32], b: NDArray[np.float32]) -> float:
    """Intersection over union of two boxes."""
    sides = np.maximum(np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2]), 0)
    shared = float(sides.prod())
    union = float((a[2:] - a[:2]).prod() + (b[2:] - b[:2]).prod()) - shared
    return shared / union if union > 0 else 0.0


def _right_evidence(
    found: Detections, centre: Floats, joined: list[Ints], settings: TrackSettings
) -> Floats:
    """What each detection says for right (1) against left (-1), with the order of two: (N,)."""
    own = 2 * found.right_score.astype(np.float64) - 1
    evidence = np.where(np.isfinite(own), own, 0) * np.nan_to_num(found.score.astype(np.float64))
    long = [t for t in joined if len(t) >= settings.least_frames]
    members = np.concatenate(long) if long else np.zeros(0, np.int64)
    counts = np.bincount(found.frame[members], minlength=1)
    pairs = members[counts[found.frame[members]] == 2]
    pairs = pairs[np.lexsort((centre[pairs, 0], found.frame[pairs]))].reshape(-1, 2)
    evidence[pairs[:, 0]] -= settings.leftmost_weight
    evidence[pairs[:, 1]] += settings.leftmost_weight
    return evidence


def _without_swaps(
    track: Ints,
    joined: list[Ints],
    found: Detections,
    centre: Floats,
    size: Floats,
    evidence: Floats,
    settings: TrackSettings,
) -> list[Ints]:
    """Cut a track where two hands may have been confused, if its parts are of different sides."""
    total = np.cumsum(evidence[track])
    before, after = total[:-1], total[-1] - total[:-1]
    apart = (before * after < 0) & (
        np.minimum(np.abs(before), np.abs(after)) >= settings.swap_evidence
    )
    if not apart.any():
        return [track]
    doubtful = np.diff(found.frame[track]) > 2
    others = np.concatenate([other for other in joined if other is not track] or [track[:0]])
    for i in range(len(track) - 1):
        near_time = others[np.abs(found.frame[others] - found.frame[track[i]]) <= 2]
        gaps = np.linalg.norm(centre[near_time] - centre[track[i]], axis=1)
        doubtful[i] |= bool(np.any(gaps < 0.5 * size[track[i]]))
    strength = np.where(apart & doubtful, np.abs(before) + np.abs(after), 0)
    cut = int(strength.argmax())
    if strength[cut] == 0:
        return [track]
    halves = track[: cut + 1], track[cut + 1 :]
    rest = [other for other in joined if other is not track]
    return [
        part
        for half in halves
        for part in _without_swaps(half, [*rest, *halves], found, centre, size, evidence, settings)
    ]


def _one_a_side(
    parts: list[Ints],
    found: Detections,
    evidence: Floats,
    num_frames: int,
    settings: TrackSettings,
) -> HandTracks:
    """Give sides to tracks, the best supported first.

    A frame in which a side is already taken speaks against that side as much as a sure detection
    does (two hands seen together are one of each). Frames taken on the side it gets are lost to a
    track; one that keeps too few is no hand of the wearer.
    """
    index = np.full((num_frames, len(SIDES)), -1, np.int32)
    taken = np.zeros((num_frames, len(SIDES)), bool)
    support = [float(np.nan_to_num(found.score[p]).sum() + abs(evidence[p].sum())) for p in parts]
    tracks: list[Track] = []
    for i in np.argsort(-np.array(support), kind="stable").tolist():
        part, frames = parts[i], found.frame[parts[i]]
        right = float(evidence[part].sum())
        free = ~taken[frames]
        room = int(free[:, RIGHT].sum()) - int(free[:, LEFT].sum())
        side = RIGHT if right + room > 0 else LEFT
        kept = part[free[:, side]]
        if len(kept) < settings.least_frames:
            continue
        index[found.frame[kept], side] = kept
        taken[found.frame[kept[0]] : found.frame[kept[-1]] + 1, side] = True
        own = (found.right_score[kept] > 0.5) == (side == RIGHT)
        score = float(np.nan_to_num(found.score[kept]).mean())
        tracks.append(Track(side, kept, right, float(own.mean()), score))
    members = sum(len(t.detections) for t in tracks)
    right = found.right_score > 0.5
    flips = sum(int((right[t.detections] != (t.side == RIGHT)).sum()) for t in tracks)
    return HandTracks(index, tuple(tracks), flips, len(found.frame) - members)
