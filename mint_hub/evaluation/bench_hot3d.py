"""HOT3D in the protocol's camera: raw sequences and HOT3D-Clips, from the user's own download.

Images are fisheye (FISHEYE624) and Aria's lie on their side. Both are undone in one resampling to
an upright pinhole of 480 x 480 with f = 207.8 and its principal point at 239.8. Truth is what
`loaders.hot3d` reads: without the user's MANO files cameras only.

Get it: https://www.projectaria.com/datasets/hot3D (raw), and for clips
https://huggingface.co/datasets/bop-benchmark/hot3d.
"""

import json
import tarfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.evaluation.clips import (
    Benchmark,
    BenchmarkError,
    Clip,
    Frames,
    Image,
    MissingFilesError,
    Source,
    decoded_picture,
    image_folder_stamp,
    knows_hands,
    truth_model,
)
from mint_hub.geometry import hand_state as hands
from mint_hub.geometry import rigid
from mint_hub.geometry.camera import K_to_fov_vh
from mint_hub.geometry.lenses import Fisheye624Lens, Lens, Rectification, rectification
from mint_hub.geometry.rotations import matrix_to_quat_xyzw, rotvec_to_matrix
from mint_hub.loaders.hot3d import HANDS_UNAVAILABLE, HEADSET, UPRIGHT_FROM_ARIA, from_hot3d
from mint_hub.loaders.hot3d_hands import Hot3DHands
from mint_hub.loaders.schema import Episode
from mint_hub.loaders.trajectory_files import pose_from_numbers

SIZE_HW: Final = (480, 480)
FOCAL: Final = 207.8
CENTRE: Final = 239.8
PROTOCOL_K: Final = np.array([[FOCAL, 0, CENTRE], [0, FOCAL, CENTRE], [0, 0, 1.0]])
GET: Final = (
    "get sequences from https://www.projectaria.com/datasets/hot3D, or clips from "
    "https://huggingface.co/datasets/bop-benchmark/hot3d"
)
SHAPES: Final = "__hand_shapes.json__"
CLIP_FRAMES: Final = 150


class Hot3DBenchmark(Benchmark):
    """Every sequence folder and every clip (tar) below a folder."""

    def __init__(self, source: Source) -> None:
        self.source, self.title, self.published = source, "HOT3D", "hot3d"
        root = Path(source.root)
        if not root.is_dir():
            raise MissingFilesError(f"{root}: expected your HOT3D download, found no folder; {GET}")
        sequences = {p.parent for p in root.rglob(HEADSET)}
        tars = set(root.rglob("clip-*.tar"))
        if source.split is not None:
            tars = {p for p in tars if p.parent.name == source.split}
        self._items = sorted(sequences | tars)
        if not self._items:
            raise MissingFilesError(
                f"{root}: expected HOT3D sequences ({HEADSET} in each) or HOT3D-Clips "
                f"(clip-*.tar), found neither; {GET}"
            )
        self.notes = ("pictures rectified to 480 x 480, f = 207.8, upright",)
        if source.mano_dir is None:
            self.notes += ("cameras only: hands need your MANO files (--mano)",)

    def __len__(self) -> int:
        return len(self._items)

    def clip(self, i: int) -> Clip:
        """Read clip ``i``."""
        item = self._items[i]
        read = _read_sequence if item.is_dir() else _read_clip
        return read(item, self.source)

    def num_frames(self, i: int) -> int:
        """Return the length of clip ``i``; of a sequence, its cameras tell."""
        item = self._items[i]
        if not item.is_dir():
            return CLIP_FRAMES
        return _read_sequence(item, replace(self.source, mano_dir=None)).truth.num_frames


@dataclass(frozen=True, eq=False)
class Upright:
    """From raw pictures of a lens to the protocol's upright ones."""

    warp: Rectification
    turned: bool

    @classmethod
    def of(cls, lens: Lens, turned: bool) -> "Upright":
        """``turned``: raw pictures are turned a quarter clockwise to stand upright.

        Turning moves column c of the rows to row c, and row r to column 479 - r: the raw pinhole
        has its principal point where that makes the protocol's.
        """
        K = PROTOCOL_K.copy()
        if turned:
            K[1, 2] = SIZE_HW[0] - 1 - CENTRE
        return cls(rectification(lens, SIZE_HW, K), turned)

    def apply(self, image: Image) -> Image:
        """Return the protocol's (480, 480, 3) picture of a raw one, grey or RGB."""
        made = self.warp.apply(image if image.ndim == 3 else np.repeat(image[..., None], 3, -1))
        return np.ascontiguousarray(np.rot90(made, -1)) if self.turned else made


def in_protocol(episode: Episode) -> Episode:
    """Give the record of an upright stream the protocol's camera; its pose stays."""
    fov = np.asarray(K_to_fov_vh(PROTOCOL_K, SIZE_HW), np.float32)
    meta = {k: v for k, v in episode.meta.items() if k != "lens"}
    return replace(
        episode,
        fov_vh_rad=np.tile(fov, (episode.num_frames, 1)),
        image_size_hw=SIZE_HW,
        meta={**meta, "protocol": "HOT3D 480 x 480, f 207.8, c 239.8"},
    )


def _clip(episode: Episode, frames: Frames | None, source: Source, why: str) -> Clip:
    model, known = truth_model(episode, source.mano_dir), knows_hands(episode)
    if known:
        episode = replace(episode, meta={**episode.meta, "hand_model": model.name})
    return Clip(
        key=episode.key,
        truth=episode,
        K=PROTOCOL_K,
        image_size_hw=SIZE_HW,
        frames=frames,
        hand_model=model,
        source="hot3d",
        hands=known,
        without_frames="" if frames else why,
    )


# ------------------------------------------------------------------------------ raw


def _read_sequence(folder: Path, source: Source) -> Clip:
    stream = source.stream or ("1201-1" if (folder / "camera_models.json").is_file() else "214-1")
    try:
        raw = from_hot3d(folder, stream, mano_dir=source.mano_dir)
    except FileNotFoundError as error:
        if "MANO_RIGHT" in str(error):  # not a file of the benchmark
            raise
        lost = f"{error.filename}: expected this file, found none" if error.filename else error
        raise MissingFilesError(f"{lost}; is the download whole? {GET}") from None
    except ValueError as error:
        if str(folder) not in str(error):
            raise
        raise BenchmarkError(f"{error}; is the download whole? {GET}") from None
    first = int(raw.meta["provenance"]["first_timestamp_ns"])
    stamps = first + np.round(raw.timestamps_s * 1e9).astype(np.int64)
    upright = Upright.of(
        Lens.from_dict(raw.meta["lens"]), raw.meta["image_turn_clockwise_deg"] == 90
    )
    images = folder / "images" / stream
    why = (
        f"{images}: expected the stream's pictures as NANOSECONDS.jpg or .png, extracted from "
        f"recording.vrs (https://github.com/facebookresearch/vrs), found none"
    )
    frames = _StampedFrames.find(images, stamps, upright) if images.is_dir() else None
    return _clip(in_protocol(raw), frames, source, why)


@dataclass(frozen=True, eq=False)
class _StampedFrames(Frames):
    """Picture files named by their time."""

    paths: tuple[Path, ...]
    upright: Upright

    @classmethod
    def find(cls, folder: Path, stamps: NDArray[np.int64], upright: Upright) -> "_StampedFrames":
        there = {int(p.stem): p for p in folder.iterdir() if p.stem.isdigit()}
        known = np.array(sorted(there), np.int64)
        paths: list[Path] = []
        for stamp in stamps:  # times in an episode are float seconds: good to a microsecond
            near = known[np.abs(known - stamp) <= 1000]
            if not len(near):
                raise MissingFilesError(
                    f"{folder}: expected the picture at {stamp} ns, found none ({len(known)} "
                    f"pictures of {len(stamps)} are there); is the download whole?"
                )
            paths.append(there[int(near[0])])
        return cls(tuple(paths), upright)

    def images(self, start: int = 0) -> Iterator[Image]:
        """Yield the upright pictures."""
        for path in self.paths[start:]:
            yield self.upright.apply(decoded_picture(path.read_bytes(), str(path), GET))

    def stamp(self) -> str:
        """Return the files' names, sizes and times as a hash."""
        return image_folder_stamp(self.paths)


# ---------------------------------------------------------------------------- clips


def _read_clip(path: Path, source: Source) -> Clip:
    """One tar of 150 frames; its hands where the split publishes them."""
    with _opened(path) as tar:
        names = set(tar.getnames())
        keys = sorted(n.removesuffix(".cameras.json") for n in names if n.endswith(".cameras.json"))
        if len(keys) != CLIP_FRAMES:
            raise BenchmarkError(
                f"{path}: expected {CLIP_FRAMES} frames, got {len(keys)}; download it again"
            )
        cameras = [_json(tar, f"{key}.cameras.json", path) for key in keys]
        infos = [_json(tar, f"{key}.info.json", path) for key in keys]
        annotated = SHAPES in names and all(f"{key}.hands.json" in names for key in keys)
        poses = [_json(tar, f"{key}.hands.json", path) for key in keys] if annotated else []
        shapes = _json(tar, SHAPES, path) if annotated else {}
    stream = source.stream or ("214-1" if "214-1" in cameras[0] else "1201-1")
    try:
        lens, T_world_from_camera = _clip_cameras(cameras, stream)
        stamps = np.array([int(info["ref_timestamp_ns"]) for info in infos], np.int64)
        there = _clip_hands(poses, shapes, stamps) if annotated else None
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise BenchmarkError(
            f"{path}: expected HOT3D-Clips' cameras, info and hands, got "
            f"{type(error).__name__}: {error}"
        ) from None
    turned = "214-1" in cameras[0]  # only Aria has an RGB stream, and all of Aria's lie
    episode = _clip_episode(path, stamps, T_world_from_camera, there, source, stream, turned)
    frames = _TarFrames(
        path, tuple(f"{k}.image_{stream}.jpg" for k in keys), Upright.of(lens, turned)
    )
    lost = [name for name in frames.names if name not in names]
    why = f"{path}: expected {lost[0]}, found none" if lost else ""
    return _clip(episode, None if lost else frames, source, why)


def _clip_cameras(cameras: list[Any], stream: str) -> tuple[Lens, NDArray[np.float64]]:
    """The lens of the first frame (calibration moves by far less than a pixel), and the poses."""
    calibration = cameras[0][stream]["calibration"]
    kind = str(calibration["projection_model_type"])
    if "FISHEYE624" not in kind.upper():
        raise ValueError(f"projection_model_type: expected FISHEYE624, got {kind!r}")
    size = (int(calibration["image_height"]), int(calibration["image_width"]))
    lens = Fisheye624Lens.from_params(calibration["projection_params"], size)
    return lens, np.stack([_pose(camera[stream]["T_world_from_camera"]) for camera in cameras])


def _pose(fields: Any) -> NDArray[np.float64]:
    w, *xyz = fields["quaternion_wxyz"]
    return pose_from_numbers("T_world_from_camera", [*fields["translation_xyz"], *xyz, w])


def _clip_hands(poses: list[Any], shapes: Any, stamps: NDArray[np.int64]) -> Hot3DHands:
    """MANO's numbers; wrist_xform is axis-angle and MANO's transl, in the world."""
    count = len(poses)
    there = np.zeros((count, 2), bool)
    pca, xform = np.zeros((count, 2, 15)), np.zeros((count, 2, 6))
    for k, frame in enumerate(poses):
        for hand, side in enumerate(("left", "right")):
            mano = (frame.get(side) or {}).get("mano_pose")
            if mano is not None:  # registration may have failed in single frames
                there[k, hand] = True
                pca[k, hand], xform[k, hand] = mano["thetas"], mano["wrist_xform"]
    betas = np.broadcast_to(np.asarray(shapes["mano"], float), (count, 2, 10)).copy()
    quat = np.asarray(matrix_to_quat_xyzw(rotvec_to_matrix(xform[..., :3])))
    return Hot3DHands(stamps, there, pca, xform[..., 3:], quat, betas)


def _clip_episode(
    path: Path,
    stamps: NDArray[np.int64],
    T_world_from_camera: NDArray[np.float64],
    annotated: Hot3DHands | None,
    source: Source,
    stream: str,
    turned: bool,
) -> Episode:
    if turned:
        T_upright_from_raw = rigid.rigid(np.array(UPRIGHT_FROM_ARIA), np.zeros(3))
        T_world_from_camera = T_world_from_camera @ rigid.inverse(T_upright_from_raw)
    T_camera_from_world = np.asarray(rigid.inverse(T_world_from_camera))
    count = len(stamps)
    state, presence = np.asarray(hands.absent((count, 2)), float), np.zeros((count, 2), bool)
    quality: dict[str, Any] = {"quality": {"hands": HANDS_UNAVAILABLE}}
    if annotated is None:
        quality = {"quality": {"hands": "unavailable: this split does not publish them"}}
    elif source.mano_dir is not None:
        state = annotated.states(T_camera_from_world, Path(source.mano_dir))
        presence, quality = annotated.there, {}
    raw = Episode(
        key=f"hot3d-{path.stem}-{stream}".lower(),
        timestamps_s=(stamps - stamps[0]) * 1e-9,
        T_camera_from_world=T_camera_from_world,
        fov_vh_rad=np.ones((count, 2), np.float32),
        hand_state=state.astype(np.float32),
        presence=presence,
        image_size_hw=SIZE_HW,
        meta={
            "source": "hot3d",
            "uid": path.stem,
            "stream": stream,
            "fps": round(1e9 / float(np.median(np.diff(stamps))), 2),
            "shape_space": "mano",
            "scale_status": "metric, motion capture",
            **quality,
        },
    )
    return in_protocol(raw)


@dataclass(frozen=True, eq=False)
class _TarFrames(Frames):
    """Pictures in a clip's tar."""

    path: Path
    names: tuple[str, ...]
    upright: Upright

    def images(self, start: int = 0) -> Iterator[Image]:
        """Yield the upright pictures."""
        with _opened(self.path) as tar:
            for name in self.names[start:]:
                yield self.upright.apply(
                    decoded_picture(_member(tar, name, self.path), f"{self.path}: {name}", GET)
                )

    def stamp(self) -> str:
        """Return the file's name, size and time as a hash."""
        return image_folder_stamp([self.path])


def _opened(path: Path) -> tarfile.TarFile:
    try:
        return tarfile.open(path)
    except (tarfile.TarError, EOFError) as error:
        raise BenchmarkError(
            f"{path}: expected a whole tar, got {error}; download it again"
        ) from None


def _member(tar: tarfile.TarFile, name: str, path: Path) -> bytes:
    try:
        file = tar.extractfile(name)
        data = file.read() if file is not None else b""
    except (KeyError, tarfile.TarError, EOFError) as error:
        raise BenchmarkError(f"{path}: {name}: {error}; download it again") from None
    if not data:
        raise BenchmarkError(f"{path}: {name}: expected data, got none; download it again")
    return data


def _json(tar: tarfile.TarFile, name: str, path: Path) -> Any:
    try:
        return json.loads(_member(tar, name, path))
    except ValueError as error:
        raise BenchmarkError(f"{path}: {name}: expected JSON, got {error}") from None
