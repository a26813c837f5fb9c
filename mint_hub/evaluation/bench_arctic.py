"""ARCTIC's egocentric view in the protocol's camera, from the user's own download.

Read below ``arctic_data/data``: ``raw_seqs/<subject>/<sequence>.mano.npy`` and
``.egocam.dist.npy`` (never through pickle), ``splits_json/protocol_p1.json`` or ``_p2``,
``meta/misc.json`` (how far pictures and truth are apart) and ``cropped_images/<s>/<seq>/0``.

A pose is 45 numbers to which MANO's mean pose is added, and the left hand is MANO's file as it is,
without the sign repair of its shape directions: its joints are where ARCTIC's own code puts them.
The lens is OpenCV's with eight numbers; pictures are undistorted to 672 x 480 with the sequence's K
scaled from 2800 x 2000, principal point included.
"""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import MANO_FINGERTIP_VERTICES, MODEL_FPS, SIDES
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
)
from mint_hub.geometry import hand_state as hands
from mint_hub.geometry import rigid
from mint_hub.geometry.camera import K_to_fov_vh
from mint_hub.geometry.hand_asset import HandAsset, closed_mesh
from mint_hub.geometry.hand_model import HandModel
from mint_hub.geometry.lenses import OpenCVLens, Rectification, rectification
from mint_hub.geometry.mano_files import find_mano_files, read_mano_file
from mint_hub.geometry.plain_pickle import load_plain_npy
from mint_hub.geometry.rotations import rotvec_to_matrix
from mint_hub.loaders.hot3d import HANDS_UNAVAILABLE
from mint_hub.loaders.hot3d_hands import pca_bases
from mint_hub.loaders.schema import Episode

Float = NDArray[np.float64]

SIZE_HW: Final = (480, 672)
CALIBRATED_HW: Final = (2000, 2800)
EGO_VIEW: Final = "0"
MISC: Final = "meta/misc.json"
GET: Final = "register and download at https://arctic.is.tue.mpg.de"
HAND_FIELDS: Final = {"rot": 3, "pose": 45, "trans": 3}


class ArcticBenchmark(Benchmark):
    """The sequences of a split of protocol p1 or p2."""

    def __init__(self, source: Source) -> None:
        self.source, self.title = source, f"ARCTIC {source.protocol}"
        self.published = "arctic"
        self._root = _root(Path(source.root))
        split = source.split or "val"
        path = self._root / "splits_json" / f"protocol_{source.protocol}.json"
        lists = _read_json(path)
        if split not in lists:
            raise BenchmarkError(f"{path}: --split: expected one of {sorted(lists)}, got {split!r}")
        self._sequences: list[str] = sorted(lists[split])
        self._offsets = _read_json(self._root / MISC)
        self.notes = ("pictures undistorted to 672 x 480, K of each sequence",)
        if source.mano_dir is None:
            self.notes += ("cameras only: hands need your MANO files (--mano)",)
        missing = [s for s in self._sequences if not self._file(s, "egocam.dist.npy").is_file()]
        if missing:
            raise MissingFilesError(
                f"{self._file(missing[0], 'egocam.dist.npy')}: expected the truth of "
                f"{len(self._sequences)} sequences of {source.protocol} {split}, found none of "
                f"{len(missing)} of them; {GET}"
            )

    def __len__(self) -> int:
        return len(self._sequences)

    def clip(self, i: int) -> Clip:
        """Read sequence ``i``."""
        name = self._sequences[i]
        camera = ego_camera(self._file(name, "egocam.dist.npy"))
        episode = self._episode(name, camera)
        first, paths, why = self._pictures(name, episode.num_frames)
        frames = None
        if paths:
            episode = episode.window(first, len(paths))
            frames = _ArcticFrames(paths, camera)
        return Clip(
            key=episode.key,
            truth=episode,
            K=camera.K,
            image_size_hw=SIZE_HW,
            frames=frames,
            hand_model=_hand_model(self.source.mano_dir),
            source="arctic",
            hands=self.source.mano_dir is not None,
            without_frames=why,
        )

    def num_frames(self, i: int) -> int:
        """Return the length of sequence ``i``, from its cameras and the names of its pictures."""
        name = self._sequences[i]
        count = len(ego_camera(self._file(name, "egocam.dist.npy")).T_camera_from_world)
        return len(self._pictures(name, count)[1]) or count

    def _pictures(self, name: str, count: int) -> tuple[int, tuple[Path, ...], str]:
        """Find the pictures of ``count`` frames: the first that has one, the files, why none."""
        subject, sequence = name.split("/")
        folder = self._root / "cropped_images" / subject / sequence / EGO_VIEW
        if not folder.is_dir():
            return 0, (), f"{folder}: expected the egocentric pictures, found none; {GET}"
        about: Any = self._offsets.get(subject)
        offset = about.get("ioi_offset") if isinstance(about, dict) else None
        if not isinstance(offset, int):
            path = self._root / MISC
            lost = f"{path}: expected ioi_offset of {subject}, which pairs pictures and truth"
            return 0, (), f"{lost}, found none; {GET}"
        paths = [folder / f"{k + offset:05d}.jpg" for k in range(count)]
        there = [k for k, path in enumerate(paths) if path.is_file()]
        if len(there) < count - 2 * max(offset, 1) or not there:
            raise MissingFilesError(
                f"{folder}: expected about {count} pictures, got {len(there)}; "
                f"is the download whole? {GET}"
            )
        first, last = there[0], there[-1]
        if last - first + 1 != len(there):
            lost = next(p for p in paths[first:last] if not p.is_file())
            raise MissingFilesError(f"{lost}: no such picture, others around it are there; {GET}")
        return first, tuple(paths[first : last + 1]), ""

    def _file(self, name: str, suffix: str) -> Path:
        return self._root / "raw_seqs" / f"{name}.{suffix}"

    def _episode(self, name: str, camera: "EgoCamera") -> Episode:
        count = len(camera.T_camera_from_world)
        state, presence = np.asarray(hands.absent((count, 2)), float), np.zeros((count, 2), bool)
        about: dict[str, Any] = {"quality": {"hands": HANDS_UNAVAILABLE}}
        if self.source.mano_dir is not None:
            path = self._file(name, "mano.npy")
            state = hand_states(path, camera.T_camera_from_world, self.source.mano_dir)
            presence = np.ones((count, 2), bool)
            about = {"hand_model": _hand_model(self.source.mano_dir).name}
        fov = np.asarray(K_to_fov_vh(camera.K, SIZE_HW), np.float32)
        return Episode(
            key=f"arctic-{name.replace('/', '-')}".lower(),
            timestamps_s=np.arange(count) / MODEL_FPS,
            T_camera_from_world=camera.T_camera_from_world,
            fov_vh_rad=np.tile(fov, (count, 1)),
            hand_state=state.astype(np.float32),
            presence=presence,
            image_size_hw=SIZE_HW,
            meta={
                "source": "arctic",
                "uid": name,
                "participant": name.split("/")[0],
                "fps": MODEL_FPS,
                "shape_space": "mano",
                "scale_status": "metric, motion capture",
                **about,
            },
        )


@dataclass(frozen=True, eq=False)
class EgoCamera:
    """The moving egocentric camera: poses (T, 4, 4), its lens at 2800 x 2000, the protocol's K."""

    T_camera_from_world: Float
    lens: OpenCVLens
    K: Float


def ego_camera(path: Path) -> EgoCamera:
    """Read ``<sequence>.egocam.dist.npy``.

    Raises:
        BenchmarkError: names file, field, expected and got.

    """
    fields = _read_fields(path)
    R = _array(path, fields, "R_k_cam_np", (-1, 3, 3))
    t = _array(path, fields, "T_k_cam_np", (len(R), 3, 1))[..., 0]
    K = _array(path, fields, "intrinsics", (3, 3))
    distortion = _array(path, fields, "dist8", (8,))
    focal = (float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
    lens = OpenCVLens(CALIBRATED_HW, *focal, tuple(distortion.tolist()))
    scale = np.array([SIZE_HW[1] / CALIBRATED_HW[1], SIZE_HW[0] / CALIBRATED_HW[0], 1.0])
    return EgoCamera(np.asarray(rigid.rigid(R, t)), lens, np.diag(scale) @ K)


def hand_states(path: Path, T_camera_from_world: Float, mano_dir: str | Path) -> Float:
    """Hand states (T, 2, 109) in the camera frame from ``<sequence>.mano.npy``.

    Raises:
        FileNotFoundError: MANO's files are missing.
        BenchmarkError: names file, field, expected and got.

    """
    fields, count = _read_fields(path), len(T_camera_from_world)
    model, bases = _hand_model(str(mano_dir)), pca_bases(Path(mano_dir), 45)
    state = np.asarray(hands.absent((count, 2)), np.float64)
    for hand, side in enumerate(SIDES):
        own = fields.get(side)
        if not isinstance(own, dict):
            raise BenchmarkError(f"{path}: {side}: expected rot, pose, trans and shape, got none")
        own = cast("Mapping[str, Any]", own)
        rot, pose, trans = (_array(path, own, n, (count, w)) for n, w in HAND_FIELDS.items())
        shape = np.broadcast_to(_array(path, own, "shape", (10,)), (count, 10)).copy()
        true = rotvec_to_matrix((bases[side][0] + pose).reshape(-1, 15, 3))
        wrist = trans + np.asarray(model.rest_joints(shape, side))[:, 0]
        T = T_camera_from_world @ rigid.rigid(rotvec_to_matrix(rot), wrist)
        stored = hands.mirror_rotations(true) if side == "left" else true
        state[:, hand] = hands.HandState.from_matrices(
            T[:, :3, 3], T[:, :3, :3], stored, shape
        ).pack()
    return state


@cache
def _hand_model(mano_dir: str | None) -> HandModel:
    """MANO as ARCTIC uses it: the left file as published; the template without MANO."""
    if mano_dir is None:
        return HandModel.template()
    repaired, files = HandModel.from_mano(mano_dir), find_mano_files(mano_dir)
    if "left" not in files:
        raise MissingFilesError(
            f"{mano_dir}: expected MANO_LEFT.pkl, found none: ARCTIC's left hands are that file's"
        )
    left = read_mano_file(files["left"])
    asset = HandAsset(
        template=left["v_template"],
        shape_directions=left["shapedirs"],
        pose_directions=left["posedirs"],
        joint_regressor=left["J_regressor"],
        skin_weights=left["weights"],
        faces=closed_mesh(read_mano_file(files["right"])["f"][:, [0, 2, 1]]),
        tip_vertices=np.array(MANO_FINGERTIP_VERTICES),
    )
    return HandModel("mano, left as published", "mano", asset, repaired.right)


@dataclass(frozen=True, eq=False)
class _ArcticFrames(Frames):
    """Undistorted pictures; files may be smaller than the calibration."""

    paths: tuple[Path, ...]
    camera: EgoCamera

    def images(self, start: int = 0) -> Iterator[Image]:
        """Yield the rectified pictures."""
        warp: Rectification | None = None
        for path in self.paths[start:]:
            image = decoded_picture(path.read_bytes(), str(path), GET)
            size = (image.shape[0], image.shape[1])
            if warp is None or warp.source_size_hw != size:
                if abs(size[1] * CALIBRATED_HW[0] / (size[0] * CALIBRATED_HW[1]) - 1) > 0.01:
                    raise BenchmarkError(
                        f"{path}: expected the aspect ratio of 2800 x 2000, got "
                        f"{size[1]} x {size[0]}"
                    )
                warp = rectification(self.camera.lens.resized(size), SIZE_HW, self.camera.K)
            yield warp.apply(image)

    def stamp(self) -> str:
        """Return the files' names, sizes and times as a hash."""
        return image_folder_stamp(self.paths)


def _root(given: Path) -> Path:
    for folder in (
        given,
        given / "data",
        given / "arctic_data" / "data",
        given / "data/arctic_data/data",
    ):
        if (folder / "raw_seqs").is_dir():
            return folder
    raise MissingFilesError(f"{given}: expected raw_seqs/ (ARCTIC's truth), found none; {GET}")


def _read_json(path: Path) -> dict[str, Any]:
    try:
        return json.loads(path.read_text("utf-8"))
    except FileNotFoundError:
        raise MissingFilesError(f"{path}: expected this file, found none; {GET}") from None
    except ValueError as error:
        raise BenchmarkError(f"{path}: expected JSON, got {error}") from None


def _read_fields(path: Path) -> Mapping[str, Any]:
    if not path.is_file():
        raise MissingFilesError(f"{path}: expected this file, found none; {GET}")
    try:
        loaded = load_plain_npy(path)
    except ValueError as error:
        raise BenchmarkError(f"{path}: {error}; download it again?") from None
    fields = loaded.item() if isinstance(loaded, np.ndarray) and loaded.ndim == 0 else loaded
    if not isinstance(fields, dict):
        raise BenchmarkError(f"{path}: expected a dict of arrays, got {type(fields).__name__}")
    return cast("Mapping[str, Any]", fields)


def _array(path: Path, fields: Mapping[str, Any], name: str, shape: tuple[int, ...]) -> Float:
    """A finite array of a shape; -1 is any length but none."""
    try:
        values = np.asarray(fields[name], np.float64)
    except (KeyError, TypeError, ValueError):
        raise BenchmarkError(f"{path}: {name}: expected {shape} numbers, got none") from None
    if values.ndim != len(shape) or any(
        n not in (-1, m) for n, m in zip(shape, values.shape, strict=True)
    ):
        raise BenchmarkError(f"{path}: {name}: expected shape {shape}, got {values.shape}")
    if not values.size or not np.isfinite(values).all():
        raise BenchmarkError(f"{path}: {name}: expected finite numbers")
    return values
