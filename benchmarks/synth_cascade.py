"""The labelling cascade on clips with exact truth: what it finds, how far off it is, how long.

    mint-hub evaluate trivial --on bench --cache FOLDER        (or: mint-hub synth --preset bench)
    python benchmarks/synth_cascade.py CORPUS -o FOLDER [--clips 10] [--labels FOLDER]

CORPUS holds drawn clips (CONFIG/SPLIT with mp4 members). Each mp4 goes through the whole cascade as
any video would; nothing of the truth is told to it. Detections are counted in the frames as they
were detected, before any cleaning; the camera is compared as the camera stage left it, so that a
clip that is refused later still has its numbers. ``--labels`` writes one episode for each clip, as
long as the clip, for `mint-hub evaluate FOLDER --on bench`: where the cascade kept nothing the hand
is absent and the camera stands still.
"""

import argparse
import json
import resource
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from _report import write_report
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from mint_hub.geometry.camera import project
from mint_hub.geometry.hand_state import absent
from mint_hub.geometry.metrics import trajectory_errors
from mint_hub.geometry.rigid import inverse
from mint_hub.geometry.rotations import geodesic_angle, mean_rotation
from mint_hub.labelling import record_files
from mint_hub.labelling.build import build_cascade
from mint_hub.labelling.label import FOLDER, label_videos
from mint_hub.labelling.records import Clip
from mint_hub.loaders.derived import VIDEO_MEMBER
from mint_hub.loaders.manifest import MANIFEST
from mint_hub.loaders.reader import CorpusReader
from mint_hub.loaders.schema import Episode
from mint_hub.loaders.shards import write_corpus

SEEN_SHARE = 0.3
"""A hand of which less is visible is not asked for."""

NEAR = 0.5
"""A detection is of a hand when its landmarks lie, on average, within this share of the diagonal
of the box of the hand's true joints."""

BINS = (0.0, 0.1, 0.3, 0.6, 0.9, 1.01)
INSIDE = (1, 6, 11, 16, 21, 22)
"""Edges of bins of how many joints are inside the picture; the visible share counts only what is
inside, so that a finger at the border may be fully visible."""
GUESS_FOV_H_DEG = 80.0
"""What a clip without any label is given."""

Floats = NDArray[np.floating[Any]]


# ------------------------------------------------------------------------- detector


@dataclass
class Found:
    """Which hands were detected, and which detections were of none."""

    truth: Episode
    hit: NDArray[np.bool_]
    looked: NDArray[np.bool_]
    detections: int = 0
    false: int = 0
    right_way: int = 0

    @classmethod
    def none(cls, truth: Episode) -> "Found":
        """Nothing was looked at yet."""
        shape = truth.presence.shape
        return cls(truth, np.zeros(shape, bool), np.zeros(shape[0], bool))

    def add(self, clip: Clip) -> None:
        """Match one clip's detections with the hands that are really there, frame by frame."""
        assert clip.detections is not None
        seen = clip.detections
        uv = joints_px(self.truth, clip.image_size_hw)
        for own, frame in enumerate(frames_of(clip.source_timestamps_s, self.truth)):
            self.looked[frame] = True
            here = np.flatnonzero(seen.frame == own)
            hands = np.flatnonzero(self.truth.presence[frame])
            self.detections += len(here)
            away = np.full((len(here), len(hands)), np.inf)
            for j, hand in enumerate(hands):
                size = np.hypot(*np.ptp(uv[frame, hand], axis=0))
                off = np.linalg.norm(seen.landmarks_uv[here] - uv[frame, hand], axis=-1).mean(-1)
                away[:, j] = off / max(size, 1.0)
            rows, columns = linear_sum_assignment(np.minimum(away, 1e3))
            good = away[rows, columns] < NEAR
            self.hit[frame, hands[columns[good]]] = True
            self.false += len(here) - int(good.sum())
            right = seen.right_score[here[rows[good]]] > 0.5
            self.right_way += int((right == (hands[columns[good]] == 1)).sum())

    def told(self) -> dict[str, Any]:
        """Share of hands found, by what is visible of them, and false detections."""
        truth = self.truth
        assert truth.presence_score is not None
        visible = np.where(truth.presence, truth.presence_score, -1.0)
        asked = (visible > SEEN_SHARE) & self.looked[:, None]
        bins = {}
        for low, high in pairwise(BINS):
            inside = (visible >= low) & (visible < high) & self.looked[:, None]
            bins[f"{low:g}-{min(high, 1):g}"] = [int(self.hit[inside].sum()), int(inside.sum())]
        inside_bins = {}
        number = np.where(truth.presence, joints_inside(truth), 0)
        for low, high in pairwise(INSIDE):
            inside = (number >= low) & (number < high) & asked
            inside_bins[f"{low}-{high - 1}"] = [int(self.hit[inside].sum()), int(inside.sum())]
        return {
            "hands_asked_for": int(asked.sum()),
            "hands_found": int(self.hit[asked].sum()),
            "share_found": share(int(self.hit[asked].sum()), int(asked.sum())),
            "found_of_by_visible_share": bins,
            "found_of_by_joints_inside": inside_bins,
            "detections": self.detections,
            "false_detections": self.false,
            "share_false": share(self.false, self.detections),
            "share_right_side": share(self.right_way, self.detections - self.false),
            "frames_looked_at": int(self.looked.sum()),
        }


def joints_px(truth: Episode, image_size_hw: tuple[int, int]) -> Floats:
    """Pixels (T, 2, 21, 2) of the joints in pictures of another size; NaN of absent hands."""
    with np.errstate(divide="ignore", invalid="ignore"):
        uv, _ = project(truth.joints_camera().astype(float), truth.K[:, None])
    scale = np.array(image_size_hw[::-1]) / np.array(truth.image_size_hw[::-1])
    return np.asarray(uv) * scale


def joints_inside(truth: Episode) -> NDArray[np.int64]:
    """How many of the 21 joints of each hand (T, 2) are inside the picture."""
    uv = joints_px(truth, truth.image_size_hw)
    with np.errstate(invalid="ignore"):
        inside = (uv >= 0) & (uv < np.array(truth.image_size_hw[::-1]))
    return inside.all(-1).sum(-1)


def frames_of(times_s: Floats, truth: Episode) -> list[int]:
    """Frames of the truth that these source times are of."""
    frames = np.round(np.asarray(times_s) * truth.fps).astype(int)
    return [int(f) for f in frames.clip(0, truth.num_frames - 1)]


def share(part: int, whole: int) -> float | None:
    return round(part / whole, 4) if whole else None


# --------------------------------------------------------------------------- camera


def camera_errors(clip: Clip, truth: Episode) -> dict[str, Any]:
    """Compare what the camera stage found, which has no metres yet, with the truth."""
    assert clip.camera is not None
    assert clip.intrinsics is not None
    frames = frames_of(clip.source_timestamps_s, truth)
    mine = np.asarray(inverse(clip.camera.T_camera_from_world))
    true = truth.T_world_from_camera[frames]
    errors = trajectory_errors(mine, true, truth.fps)
    turn = true[:, :3, :3] @ np.swapaxes(mine[:, :3, :3], -1, -2)
    turned = np.asarray(mean_rotation(turn)) @ mine[:, :3, :3]
    off = np.degrees(geodesic_angle(turned, true[:, :3, :3]))
    found, wanted = (np.tan(f / 2) for f in (clip.intrinsics.fov_vh_rad[1], truth.fov_vh_rad[0, 1]))
    return {
        "frames": len(frames),
        "share_of_frames": share(len(frames), truth.num_frames),
        "focal_error_percent": round(100 * (float(wanted / found) - 1), 4),
        "true_path_m": round(errors.true_path_m, 4),
        "ate_mm_sim3": round(errors.sim3.ate_mm, 4),
        "ate_percent_of_path_sim3": round(errors.sim3.ate_percent, 4),
        "rpe_translation_mm_sim3": round(errors.sim3.rpe_translation_mm, 4),
        "rpe_rotation_deg": round(errors.rpe_rotation_deg, 4),
        "rotation_deg_mean": round(float(off.mean()), 4),
        "rotation_deg_max": round(float(off.max()), 4),
        "points_shared_min": float(clip.camera.covisible.min()),
        "residual_px": round(float(clip.camera.residual_px), 4),
    }


def stage_clips(work: Path, key: str, stage: str) -> list[Clip]:
    """Return a video's clips as a stage left them, from the files of the run."""
    clips: list[Clip] = []
    for path in sorted((work / key).glob(f"[0-9][0-9]-{stage}/*.npz")):
        value, _ = record_files.load(path)
        clips += list(value.clips)
    return clips


# --------------------------------------------------------------------------- labels


def final_errors(episodes: list[Episode], truth: Episode) -> dict[str, Any]:
    """Presence, side and metres of the finished episodes."""
    made = whole(episodes, truth)
    there, said = truth.presence, made.presence
    assert truth.presence_score is not None
    asked = there & (truth.presence_score > SEEN_SHARE)
    both = there & said
    depth, true_depth = (e.wrist_camera()[..., 2, 3] for e in (made, truth))
    off = np.linalg.norm((made.wrist_camera() - truth.wrist_camera())[both][:, :3, 3], axis=-1)
    ratio = (depth / true_depth)[both]
    return {
        "share_of_frames_kept": share(sum(e.num_frames for e in episodes), truth.num_frames),
        "hands_asked_for": int(asked.sum()),
        "share_found_right_side": share(int((said & asked).sum()), int(asked.sum())),
        "hands_said": int(said.sum()),
        "share_false": share(int((said & ~there).sum()), int(said.sum())),
        "wrist_error_mm_median": round(1000 * float(np.median(off)), 1) if off.size else None,
        "wrist_depth_ratio_median": round(float(np.median(ratio)), 4) if ratio.size else None,
    }


def whole(episodes: list[Episode], truth: Episode) -> Episode:
    """One episode as long as the truth; see the module for what no label covers.

    Pieces of a clip have worlds of their own: each begins where the one before it ended.
    """
    frames = truth.num_frames
    state = np.asarray(absent((frames, 2)), np.float32)
    presence, filled = np.zeros((frames, 2), bool), np.zeros((frames, 2), bool)
    score = np.zeros((frames, 2), np.float32)
    T = np.tile(np.eye(4), (frames, 1, 1))
    width_per_height = truth.image_size_hw[1] / truth.image_size_hw[0]
    half_h = np.tan(np.radians(GUESS_FOV_H_DEG) / 2)
    fov = (2 * np.arctan(half_h / width_per_height), np.radians(GUESS_FOV_H_DEG))
    stand = np.eye(4)
    for episode in sorted(episodes, key=lambda e: e.timestamps_s[0]):
        here = frames_of(episode.timestamps_s, truth)
        path = episode.T_camera_from_world
        path = path @ np.asarray(inverse(path[0])) @ stand
        T[here], T[here[-1] + 1 :] = path, path[-1]
        stand = path[-1]
        state[here], presence[here] = episode.hand_state, episode.presence
        score[here] = episode.presence if episode.presence_score is None else episode.presence_score
        filled[here] = False if episode.filled is None else episode.filled
        fov = tuple(float(f) for f in episode.fov_vh_rad[0])
    meta = dict(episodes[0].meta) if episodes else {"source": "user", "shape_space": "mint"}
    meta.pop("source_timestamps_s", None)
    meta |= {"uid": truth.key, "frames_labelled": sum(e.num_frames for e in episodes)}
    return replace(
        truth,
        T_camera_from_world=T,
        fov_vh_rad=np.tile(np.asarray(fov, np.float32), (frames, 1)),
        hand_state=state,
        presence=presence,
        presence_score=score,
        filled=filled,
        text=(),
        meta=meta,
    )


# ------------------------------------------------------------------------------ run


def truths_of(corpus: Path, videos: Path, count: int) -> dict[str, Episode]:
    """Read the first ``count`` clips by their number, and lay their mp4s into ``videos``."""
    found = sorted(p.parent for p in corpus.rglob(MANIFEST))
    if not found:
        raise SystemExit(f"{corpus}: expected a corpus with drawn clips, found none")
    split = found[0]
    reader = CorpusReader(split.parent.parent, split.parent.name, split.name)
    order = sorted(range(len(reader)), key=lambda i: int(reader.key(i).rpartition("-")[2], 16))
    videos.mkdir(parents=True, exist_ok=True)
    truths: dict[str, Episode] = {}
    for i in order[:count]:
        truths[reader.key(i)] = reader[i]
        path = videos / f"{reader.key(i)}.mp4"
        if not path.is_file():
            path.write_bytes(bytes(reader.member(i, VIDEO_MEMBER)))
    return truths


def row_of(out: Path, key: str, truth: Episode) -> tuple[dict[str, Any], list[Episode]]:
    """Everything that is told of one clip, and its finished episodes."""
    account = json.loads((out / FOLDER / "videos" / key / "account.json").read_text())
    folder = out / FOLDER / "videos" / key / "episodes"
    episodes = [Episode.load(folder / f"{name}.npz") for name in account["episodes"]]
    work = out / FOLDER / "work"
    found = Found.none(truth)
    for clip in stage_clips(work, key, "detect"):
        found.add(clip)
    assert truth.presence_score is not None
    row = {
        "frames": truth.num_frames,
        "fov_h_deg": round(float(np.degrees(truth.fov_vh_rad[0, 1])), 2),
        "camera_path_m": round(truth.path_length_m, 3),
        "detector": found.told(),
        "camera": [camera_errors(clip, truth) for clip in stage_clips(work, key, "camera")],
        "episodes": final_errors(episodes, truth),
        "lost_s": {k: round(v, 2) for k, v in account["lost_s"].items()},
        "stage_s": account["stage_s"],
    }
    return row, episodes


def cpu_s() -> float:
    """CPU seconds of this process and of those it has waited for."""
    kinds = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    return sum(u.ru_utime + u.ru_stime for u in map(resource.getrusage, kinds))


def summary(rows: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Clips together: hands are pooled, cameras are counted by piece."""
    detector = [row["detector"] for row in rows.values()]
    found, asked, false, said = (
        sum(d[name] for d in detector)
        for name in ("hands_found", "hands_asked_for", "false_detections", "detections")
    )
    bins = {
        kind: {n: [sum(d[kind][n][k] for d in detector) for k in (0, 1)] for n in detector[0][kind]}
        for kind in ("found_of_by_visible_share", "found_of_by_joints_inside")
    }
    cameras = [camera for row in rows.values() for camera in row["camera"]]
    frames = sum(row["frames"] for row in rows.values())
    stages: dict[str, float] = {}
    for row in rows.values():
        for stage, seconds in row["stage_s"].items():
            stages[stage] = stages.get(stage, 0.0) + seconds
    result: dict[str, Any] = {
        "clips": len(rows),
        "frames": frames,
        "share_of_visible_hands_detected": share(found, asked),
        "share_of_detections_false": share(false, said),
        **bins,
        "share_of_frames_with_camera": share(sum(c["frames"] for c in cameras), frames),
        "clips_in_one_piece": sum(
            len(row["camera"]) == 1 and row["camera"][0]["share_of_frames"] == 1
            for row in rows.values()
        ),
        "clips_without_camera": sum(not row["camera"] for row in rows.values()),
        "clips_without_episode": sum(
            not row["episodes"]["share_of_frames_kept"] for row in rows.values()
        ),
        "wall_s_a_clip_second": round(sum(stages.values()) / (frames / 30), 2),
        "stage_s": {stage: round(s, 2) for stage, s in sorted(stages.items())},
    }
    for name in ("focal_error_percent", "ate_percent_of_path_sim3", "rotation_deg_mean"):
        values = [abs(c[name]) for c in cameras]
        if values:
            result[f"{name}_median"] = round(median(values), 4)
            result[f"{name}_worst"] = max(values)
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("corpus", type=Path, help="folder with drawn clips")
    parser.add_argument("-o", "--out", type=Path, required=True, help="folder of the run")
    parser.add_argument("--clips", type=int, default=10)
    parser.add_argument("--labels", type=Path, help="also write the labels as a corpus here")
    parser.add_argument("--threads", type=int, default=1, help="of the camera stages")
    args = parser.parse_args()
    truths = truths_of(args.corpus, args.out / "videos", args.clips)
    one = {stage: {"threads": args.threads} for stage in ("intrinsics", "camera")}
    cascade = build_cascade(args.out / FOLDER / "work", settings=one)
    cpu = cpu_s()
    try:
        report = label_videos(
            {key: args.out / "videos" / f"{key}.mp4" for key in truths},
            args.out,
            cascade,
            keep_work=True,
            say=lambda line: print(line, flush=True),
        )
    finally:
        cascade.close()
    cpu = cpu_s() - cpu
    rows: dict[str, dict[str, Any]] = {}
    labels: list[Episode] = []
    for key, truth in truths.items():
        rows[key], episodes = row_of(args.out, key, truth)
        labels.append(whole(episodes, truth))
        print(json.dumps({key: rows[key]}))
    if args.labels:
        print(write_corpus(labels, args.labels, "cascade", "validation", extra=True, seed=None))
    together = summary(rows)
    if not report.skipped:
        together["cpu_s_a_clip"] = round(cpu / len(rows), 2)
    results = {"together": together, "clips": rows}
    print(json.dumps(results["together"], indent=1))
    settings = {
        "clips": list(truths),
        "threads": args.threads,
        "visible_share_asked_for": SEEN_SHARE,
        "detection_near": f"mean landmark distance under {NEAR} of the true box's diagonal",
    }
    print(write_report("synth_cascade", results, settings))


if __name__ == "__main__":
    main()
