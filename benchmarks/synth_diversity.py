"""How varied synthetic clips are, beside real ones: percentiles over clips and over frames.

    python benchmarks/synth_diversity.py [--clips 500] [--drawn 100] [--frames-a-clip 8]
        [--real FOLDER] [--labelled CORPUS]

What a world knows is counted in all its frames; what hides hands and how bright pictures are, in a
few frames of some clips, drawn at half size. ``--real`` is the folder of real clips that tests use:
exact camera and hands of one HOT3D recording, the annotation of one Ego4D clip, pictures of both.
``--labelled`` is a corpus that the labelling cascade made of those clips: its numbers are no truth,
and say so.
"""

import argparse
import warnings
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
from _report import write_report
from numpy.typing import NDArray

from mint_hub.conventions import SIDES
from mint_hub.geometry.arrays import runs
from mint_hub.geometry.camera import fov_vh_to_K, project
from mint_hub.geometry.hand_model import HandModel
from mint_hub.geometry.hand_state import absent, unpack
from mint_hub.geometry.rigid import inverse, umeyama
from mint_hub.geometry.rotations import geodesic_angle
from mint_hub.loaders.hot3d import from_hot3d, hot3d_hands
from mint_hub.loaders.schema import Episode
from mint_hub.loaders.video import iter_frames
from mint_hub.loaders.vitra import from_vitra
from mint_hub.synth.corruption import corrupt
from mint_hub.synth.episodes import draw_corruption, presence_of
from mint_hub.synth.presets import seed_of
from mint_hub.synth.render import Renderer
from mint_hub.synth.scene import make_world
from mint_hub.synth.world import World

PERCENTILES = (5, 25, 50, 75, 95, 99)
LEFT_FOR = 5
"""Frames that a hand has to be gone, or there, for its leaving or coming back to count."""

Floats = NDArray[np.floating[Any]]


@dataclass
class Pool:
    """Numbers by name: of every frame (or hand in a frame), and one of each clip."""

    frames: dict[str, list[Floats]] = field(default_factory=dict[str, list[Floats]])
    clips: dict[str, list[float]] = field(default_factory=dict[str, list[float]])
    counts: dict[str, Counter[str]] = field(default_factory=dict[str, Counter[str]])

    def add_frames(self, **values: Any) -> None:
        """Add numbers of frames; those that are not finite are left out."""
        for name, value in values.items():
            flat = np.asarray(value, float).ravel()
            self.frames.setdefault(name, []).append(flat[np.isfinite(flat)])

    def add_clip(self, **values: float) -> None:
        """Add a number of a clip."""
        for name, value in values.items():
            self.clips.setdefault(name, []).append(float(value))

    def count(self, name: str, words: Iterable[str]) -> None:
        """Count words."""
        self.counts.setdefault(name, Counter()).update(words)

    def told(self) -> dict[str, Any]:
        """Percentiles, shares and how many numbers there were."""
        every = {name: np.concatenate(parts) for name, parts in self.frames.items()}
        shares = {}
        for name, counter in self.counts.items():
            total = sum(counter.values())
            shares[name] = {w: round(n / total, 4) for w, n in counter.most_common()}
        return {
            "of_frames": {name: percentiles(v) for name, v in every.items() if v.size},
            "of_clips": {name: percentiles(np.array(v)) for name, v in self.clips.items()},
            "shares": shares,
        }


def percentiles(values: Floats) -> dict[str, Any]:
    """Percentiles, mean and count."""
    known = values[np.isfinite(values)]
    found = {f"p{p}": round(float(np.percentile(known, p)), 4) for p in PERCENTILES}
    return found | {"mean": round(float(known.mean()), 4), "count": int(known.size)}


# ------------------------------------------------------------------------- one clip


def add_camera(pool: Pool, T_world_from_camera: Floats) -> None:
    """Steps of a camera path (T, 4, 4) from frame to frame."""
    at, R = T_world_from_camera[:, :3, 3], T_world_from_camera[:, :3, :3]
    mm = 1000 * np.linalg.norm(np.diff(at, axis=0), axis=-1)
    deg = np.degrees(geodesic_angle(R[1:], R[:-1]))
    pool.add_frames(camera_mm_a_frame=mm, camera_deg_a_frame=deg)
    pool.add_clip(
        camera_mm_a_frame_median=np.median(mm),
        camera_deg_a_frame_median=np.median(deg),
        camera_extent_m=float(np.linalg.norm(np.ptp(at, axis=0))),
    )


def add_presence(pool: Pool, presence: NDArray[np.bool_]) -> None:
    """How much hands (T, 2) are there, and how often one leaves and comes back."""
    back = 0
    for hand in presence.T:
        gone = [(a, b) for a, b in runs(~hand) if b - a >= LEFT_FOR and a > 0 and b < len(hand)]
        back += sum(hand[max(a - LEFT_FOR, 0) : a].all() for a, _ in gone)
    number = presence.sum(1)
    pool.add_clip(
        share_left_present=presence[:, 0].mean(),
        share_right_present=presence[:, 1].mean(),
        share_no_hand=(number == 0).mean(),
        share_both_hands=(number == 2).mean(),
        hands_back_a_clip=back,
    )
    seen = [side for h, side in enumerate(SIDES) if presence[:, h].any()]
    pool.count("hands_seen_in_a_clip", [" and ".join(seen) or "none"])


def add_wrists(pool: Pool, camera: Floats, world: Floats, presence: NDArray[np.bool_]) -> None:
    """Wrists (T, 2, 3) in the camera's frame and the world's; speed where present in both frames.

    One wrist is skipped at a time where it is absent.
    """
    moving = presence[1:] & presence[:-1]
    mm = 1000 * np.linalg.norm(np.diff(world, axis=0), axis=-1)
    pool.add_frames(
        wrist_depth_m=camera[..., 2][presence],
        wrist_distance_m=np.linalg.norm(camera, axis=-1)[presence],
        wrist_mm_a_frame=mm[moving],
    )
    if moving.any():
        pool.add_clip(
            wrist_mm_a_frame_median=np.median(mm[moving]),
            wrist_mm_a_frame_p95=np.percentile(mm[moving], 95),
        )


def add_image_size(pool: Pool, joints: Floats, presence: NDArray[np.bool_], K: Floats) -> None:
    """How large hands are: diagonal of the box of the joints (T, 2, 21, 3) over the focal length.

    A size without pixels: what a hand measures at a metre's distance, in metres.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        uv, z = project(joints, K)
    whole = presence & (z > 0.01).all(-1)
    box = np.ptp(uv[whole], axis=1)
    pool.add_frames(hand_diagonal_over_focal=np.hypot(*box.T) / float(np.ravel(K)[0]))


def add_picture(pool: Pool, rgb: NDArray[np.uint8]) -> None:
    """Brightness, contrast and saturation of a picture (H, W, 3) uint8, of 255."""
    values = rgb.astype(np.float32)
    grey = values @ np.array([0.299, 0.587, 0.114], np.float32)
    pool.add_frames(
        brightness_of_255=grey.mean(),
        contrast_of_255=grey.std(),
        saturation=(np.ptp(values, -1) / np.maximum(values.max(-1), 1)).mean(),
        share_under_10_of_255=(grey < 10).mean(),
        share_over_245_of_255=(grey > 245).mean(),
        red_over_blue=values[..., 0].mean() / max(float(values[..., 2].mean()), 1e-3),
    )


def middle_finger_m(joints: Floats) -> float:
    """From the wrist along the bones to the tip of the middle finger: joints (21, 3) OpenPose."""
    chain = joints[[0, 9, 10, 11, 12]]
    return float(np.linalg.norm(np.diff(chain, axis=0), axis=-1).sum())


def add_world(pool: Pool, world: World) -> None:
    """Everything that needs no picture."""
    presence = presence_of(world)
    T = np.asarray(inverse(world.T_camera_from_world))
    wrist = np.asarray(unpack(world.hands.hand_state.astype(float)).translation)
    in_world = np.einsum("tij,thj->thi", T[:, :3, :3], wrist) + T[:, None, :3, 3]
    joints = np.asarray(HandModel.template().keypoints(world.hands.hand_state.astype(float)))
    add_camera(pool, T)
    add_presence(pool, presence)
    add_wrists(pool, wrist, in_world, presence)
    K = np.asarray(fov_vh_to_K(np.asarray(world.fov_vh_rad), world.image_size_hw))
    add_image_size(pool, joints, presence, K)
    hand = int(np.flatnonzero(world.hands.exists[0])[0])
    vertical, horizontal = np.degrees(world.fov_vh_rad)
    pool.add_clip(
        frames=world.num_frames,
        wrist_to_fingertip_mm=1000 * middle_finger_m(joints[0, hand]),
        hand_size_number=world.meta["hand_size"],
        fov_h_deg=horizontal,
        fov_v_deg=vertical,
        things=len(world.meta["things"]),
        activities=len(world.text),
        eye_above_table_m=world.meta["eye_above_table_m"],
        table_height_m=world.meta["table_height_m"],
        collision_share=world.meta["collision_share"],
        deepest_collision_mm=world.meta["deepest_mm"],
        skin_reflectance=float(np.mean(world.hands.skin_colour)),
    )
    arms = [side for side, there in zip(SIDES, world.hands.exists[0], strict=True) if there]
    pool.count("arms_of_a_clip", [" and ".join(arms)])
    pool.count("sleeves", ["bare" if world.hands.sleeve is None else "sleeve"])
    pool.count("image_size_hw", ["x".join(map(str, world.image_size_hw))])
    pool.count("verbs", [verb_of(segment.text) for segment in world.text])
    pool.count("things", [name.split()[-1] for name in world.meta["things"]])


def verb_of(sentence: str) -> str:
    """The verb of "the right hand lifts the cup": what follows the hand or hands."""
    words = sentence.lower().split()
    hands = [i for i, word in enumerate(words) if word.strip(",") in ("hand", "hands")]
    after = hands[0] + 1 if hands else 0
    return words[after] if after < len(words) else words[-1]


class Drawn:
    """Pictures of worlds at half size; a renderer for each size."""

    def __init__(self) -> None:
        self.clips = 0
        self._renderers: dict[tuple[int, int], Renderer] = {}

    def add(self, pool: Pool, world: World, count: int) -> None:
        """Draw a few frames, spread evenly."""
        height, width = (2 * round(side / 4) for side in world.image_size_hw)
        small = replace(world, image_size_hw=(height, width))
        renderer = self._renderers.get((height, width))
        if renderer is None:
            renderer = self._renderers[height, width] = Renderer((height, width))
        presence = presence_of(small)
        self.clips += 1
        for k in np.linspace(0, small.num_frames - 1, count + 2).round().astype(int)[1:-1]:
            frames = renderer.frames(small, ("rgb", "flow"), int(k), int(k) + 1)
            (seen,) = corrupt(frames, draw_corruption(world), world.seed)
            add_picture(pool, seen.rgb)
            visible = renderer.visible_fraction(small, int(k))
            pool.add_frames(visible_share=visible[presence[k]])

    def close(self) -> None:
        """Close the renderers."""
        for renderer in self._renderers.values():
            renderer.close()


def synthetic(preset: str, clips: int, seed: int, few: int, to_draw: int) -> dict[str, Any]:
    """Count ``clips`` worlds of a run with ``seed``, and draw frames of ``to_draw`` of them."""
    pool, drawn, postures = Pool(), Drawn(), list[Floats]()
    every = max(1, clips // max(to_draw, 1))
    for n in range(clips):
        begun = process_time()
        world = make_world(seed_of(preset, seed, n), preset)
        pool.add_clip(world_cpu_s=process_time() - begun)
        add_world(pool, world)
        postures.append(postures_of(world))
        if n % every == 0:
            drawn.add(pool, world, few)
        if (n + 1) % 25 == 0:
            print(f"{n + 1} of {clips} clips", flush=True)
    drawn.close()
    return pool.told() | {
        "clips_drawn": drawn.clips,
        "mean_hand_pa_mm": mean_hand_error(np.concatenate(postures)),
    }


def postures_of(world: World) -> Floats:
    """Joints (N, 21, 3) of every tenth frame in the wrist's frame, left hands mirrored."""
    kept = world.hands.hand_state[::10].astype(np.float64)
    kept[..., :9] = absent((1,))[0, :9]  # the wrist at the origin, unturned
    joints = np.asarray(HandModel.template().keypoints(kept))
    joints[:, 0] *= (-1.0, 1.0, 1.0)
    return joints[world.hands.exists[::10]]


def mean_hand_error(joints: Floats) -> float:
    """Mean PA-MPJPE, millimetres, of the mean of joints (N, 21, 3): how much hands vary."""
    mean = joints.mean(0)
    errors = [np.linalg.norm(umeyama(mean, j).apply(mean) - j, axis=-1).mean() for j in joints]
    return 1000 * float(np.mean(errors))


# ----------------------------------------------------------------------------- real


def add_episode(pool: Pool, episode: Episode, hands: bool = True) -> None:
    """What an episode of any source says."""
    add_camera(pool, episode.T_world_from_camera)
    vertical, horizontal = np.degrees(episode.fov_vh_rad[0])
    pool.add_clip(frames=episode.num_frames, fov_h_deg=horizontal, fov_v_deg=vertical)
    if hands:
        add_presence(pool, episode.presence)
        camera, world = episode.wrist_camera(), episode.wrist_world()
        add_wrists(pool, camera[..., :3, 3], world[..., :3, 3], episode.presence)
        joints = np.nan_to_num(episode.joints_camera().astype(float))
        add_image_size(pool, joints, episode.presence, episode.K[0])


def hot3d_exact(folder: Path) -> dict[str, Any]:
    """Motion capture of one recording; depth is that of MANO's transl, not of the wrist."""
    pool, episode, hands = Pool(), from_hot3d(folder), hot3d_hands(folder)
    add_episode(pool, episode, hands=False)
    T = episode.T_camera_from_world
    camera = np.einsum("tij,thj->thi", T[:, :3, :3], hands.transl) + T[:, None, :3, 3]
    add_wrists(pool, camera, hands.transl, hands.there)
    return pool.told() | {
        "notes": "exact (motion capture). Wrist speeds are exact; depth and distance are those of "
        "MANO's transl, which lies a constant 0.10 m of the world beside the wrist. 'present' is "
        "'annotated', inside the image or not, so no presence is told."
    }


def pictures(clips: Iterable[Path], every: int = 15) -> dict[str, Any]:
    """Brightness of real clips."""
    pool = Pool()
    for path in clips:
        for frame in iter_frames(path):
            if frame.index % every == 0:
                add_picture(pool, frame.image)
    return pool.told() | {"notes": f"every {every}th picture of the clips"}


def real(folder: Path, labelled: Path | None) -> dict[str, Any]:
    """Everything that can be measured of the real clips."""
    found: dict[str, Any] = {}
    for recording in sorted((folder / "hot3d_gt").glob("*/headset_trajectory.csv")):
        found["hot3d_motion_capture"] = hot3d_exact(recording.parent)
    found["hot3d_pictures"] = pictures(sorted((folder / "hot3d").glob("*.mp4")))
    found["ego4d_pictures"] = pictures(sorted((folder / "ego4d").glob("*.mp4")), every=5)
    for path in sorted((folder / "ego4d").glob("*.npy")):
        pool = Pool()
        add_episode(pool, from_vitra(path))
        found["ego4d_annotation"] = pool.told() | {
            "notes": "VITRA's annotation of one clip: pseudo-labels, right hand only; metres are "
            "its own, hands are MANO shapes read by our hand"
        }
    if labelled is not None:
        pool = Pool()
        for path in sorted(labelled.glob("labelling/videos/clip-*/episodes/*.npz")):
            add_episode(pool, Episode.load(path))
        found["hot3d_labelled"] = pool.told() | {
            "notes": "what our cascade made of the four HOT3D clips: no truth; metres come from "
            "the size of the hands and may be a third off, wrist steps hold its jitter"
        }
    return found


# --------------------------------------------------------------------------- output


def table(synth: Mapping[str, Any], others: Mapping[str, Mapping[str, Any]]) -> str:
    """One Markdown table: p5 / p50 / p95 of every number that there is."""
    columns = {"synthetic": synth, **others}
    lines = [f"| 5 / 50 / 95 % | {' | '.join(columns)} |", "| --- " * (len(columns) + 1) + "|"]
    for kind in ("of_frames", "of_clips"):
        for name in synth[kind]:
            cells = [_cell(column[kind].get(name)) for column in columns.values()]
            lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _cell(found: Mapping[str, Any] | None) -> str:
    if found is None:
        return "-"
    return " / ".join(f"{found[f'p{p}']:.3g}" for p in (5, 50, 95))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--preset", default="train")
    parser.add_argument("--clips", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0, help="of the run whose clips are counted")
    parser.add_argument("--drawn", type=int, default=100, help="clips of which frames are drawn")
    parser.add_argument("--frames-a-clip", type=int, default=8)
    parser.add_argument("--real", type=Path, help="folder of real clips")
    parser.add_argument("--labelled", type=Path, help="corpus the cascade made of the HOT3D clips")
    args = parser.parse_args()
    # Real hands are MANO's, ours read them with its mean shape: good enough for their size.
    warnings.filterwarnings("ignore", message="shape numbers of the 'mano' space")
    others = real(args.real, args.labelled) if args.real else {}
    synth = synthetic(args.preset, args.clips, args.seed, args.frames_a_clip, args.drawn)
    settings = {
        "preset": args.preset,
        "clips": args.clips,
        "seed": args.seed,
        "frames_drawn_a_clip": args.frames_a_clip,
        "drawn_at": "half size, as the clip's camera films it",
    }
    print(table(synth, others))
    print({name: synth["shares"][name] for name in synth["shares"]})
    print({name: synth[name] for name in ("clips_drawn", "mean_hand_pa_mm")})
    print(write_report("synth_diversity", {"synthetic": synth, **others}, settings))


if __name__ == "__main__":
    main()
