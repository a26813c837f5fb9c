"""HOT3D's MANO annotations: read line by line, and made hand states with the user's MANO files.

A line is a time and, for hand "0" (left) and "1" (right), 15 coefficients of MANO's PCA basis, the
wrist's orientation and MANO's ``transl`` in the world, and 10 shape numbers. Joint rotations are
``hands_mean + coefficients @ hands_components`` as rotation vectors (MANO, Romero et al. 2017,
eq. 6), each side with its own file's basis.

Where MANO's files are missing, these numbers are all that is known of the hands. They go to a file
of their own (``save``), never into an episode's JSON: no reader could use them there.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from os import PathLike
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import LEFT, LEFT_MIRROR, SIDES, Side
from mint_hub.geometry import hand_state as hands
from mint_hub.geometry import rigid
from mint_hub.geometry.hand_model import HandModel
from mint_hub.geometry.mano_files import find_mano_files
from mint_hub.geometry.plain_pickle import load_plain_pickle
from mint_hub.geometry.rotations import quat_xyzw_to_matrix, rotvec_to_matrix
from mint_hub.loaders.episode_file import read_arrays, write_arrays
from mint_hub.loaders.fields import EpisodeError, require_window
from mint_hub.loaders.trajectory_files import json_lines, pose_from_numbers

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Hot3DHands:
    """What is annotated of both hands (left, right) at T frames, in the world.

    Attributes:
        timestamps_ns: (T,) int64, the recording's own clock.
        there: (T, 2) bool, whether a hand is annotated; where not, its numbers say nothing.
        pca: (T, 2, C) coefficients of MANO's PCA basis, C = 15 in HOT3D.
        transl: (T, 2, 3) MANO's transl, metres: not the wrist, which is the rest wrist J0 away.
        quat_xyzw: (T, 2, 4) orientation of the wrist.
        betas: (T, 2, 10) MANO's shape numbers.
        masks: HOT3D's own masks of these frames by name (mask_...), each (T,) bool.
        uid: name of the recording, ``meta["uid"]`` of its episodes.

    """

    timestamps_ns: NDArray[np.int64]
    there: NDArray[np.bool_]
    pca: Float
    transl: Float
    quat_xyzw: Float
    betas: Float
    masks: dict[str, NDArray[np.bool_]] = field(default_factory=dict[str, NDArray[np.bool_]])
    uid: str = ""

    @property
    def num_frames(self) -> int:
        """T."""
        return len(self.there)

    @classmethod
    def read(cls, path: Path, stamps: NDArray[np.int64]) -> "Hot3DHands":
        """Read the hands at exactly these times (T,) ns.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: names file, line, expected and got.

        """
        frame_of = {int(stamp): k for k, stamp in enumerate(stamps)}
        found: list[tuple[int, int, list[float], list[float], list[float]]] = []
        for line, record in json_lines(path):
            place = f"{path}, line {line}"
            try:
                frame = frame_of.get(record["timestamp_ns"])
                each = cast("Mapping[str, Any]", record["hand_poses"]) if frame is not None else {}
                for index, hand in each.items():
                    w, *xyz = hand["wrist_xform"]["q_wxyz"]
                    numbers = [*hand["wrist_xform"]["t_xyz"], *xyz, w]
                    pose_from_numbers(f"hand {index}", numbers)
                    found.append((frame or 0, int(index), numbers, hand["pose"], hand["betas"]))
                    _check_hand(index, hand, len(found[0][3]))
            except (KeyError, TypeError, ValueError) as error:
                raise ValueError(
                    f"{place}: expected hand_poses of '0' (left) and '1' (right) with pose, betas "
                    f"and wrist_xform, got {type(error).__name__}: {error}"
                ) from None
        count, size = len(stamps), len(found[0][3]) if found else 0
        hands_read = cls(
            np.array(stamps, np.int64),
            np.zeros((count, 2), bool),
            np.zeros((count, 2, size)),
            np.zeros((count, 2, 3)),
            np.tile([0.0, 0, 0, 1], (count, 2, 1)),
            np.zeros((count, 2, hands.NUM_SHAPE_PARAMS)),
        )
        for frame, hand, numbers, pca, betas in found:
            at = (frame, hand)
            hands_read.there[at] = True
            hands_read.transl[at], hands_read.quat_xyzw[at] = numbers[:3], numbers[3:]
            hands_read.pca[at], hands_read.betas[at] = pca, betas
        return hands_read

    def where(self, frames: NDArray[np.bool_]) -> "Hot3DHands":
        """Only the frames (T,) that are available."""
        return replace(self, there=self.there & frames[:, None])

    def window(self, start: int, length: int) -> "Hot3DHands":
        """Return frames start .. start + length - 1.

        Raises:
            ValueError: the frames are not all there, or length < 1.

        """
        require_window(start, length, self.num_frames)
        part = slice(start, start + length)
        arrays = {name: getattr(self, name)[part] for name in _ARRAYS}
        masks = {name: mask[part] for name, mask in self.masks.items()}
        return Hot3DHands(**arrays, masks=masks, uid=self.uid)

    def save(self, path: str | PathLike[str]) -> Path:
        """Write one ``.npz`` of plain arrays, named as the attributes; equal hands, equal bytes."""
        arrays = {name: np.asarray(getattr(self, name)) for name in (*_ARRAYS, _UID)}
        return write_arrays(arrays | self.masks, Path(path))

    @classmethod
    def load(cls, path: str | PathLike[str]) -> "Hot3DHands":
        """Read what ``save`` wrote. Nothing is unpickled.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: not whole, or not such a file; names it.

        """
        try:
            arrays = read_arrays(Path(path))
        except EpisodeError as error:
            raise EpisodeError(f"{path}: {error}") from None
        masks = {name: arrays.pop(name) for name in list(arrays) if name.startswith("mask_")}
        if arrays.keys() != {*_ARRAYS, _UID}:
            expected = ", ".join((*_ARRAYS, _UID))
            raise EpisodeError(f"{path}: expected {expected}, got {sorted(arrays)}")
        uid = str(arrays.pop(_UID))
        return cls(**arrays, masks=masks, uid=uid)  # pyright: ignore[reportArgumentType]

    def states(self, T_camera_from_world: Float, mano_dir: Path) -> Float:
        """Hand states (T, 2, 109) in the camera frame; absent where not annotated.

        The wrist is MANO's transl plus the rest wrist J0 of the shape, which MANO does not rotate.

        Raises:
            FileNotFoundError: no MANO_RIGHT.pkl in the folder.
            ValueError: a file is not a MANO hand, naming the field.

        """
        model, bases = HandModel.from_mano(mano_dir), pca_bases(mano_dir, self.pca.shape[-1])
        state = np.asarray(hands.absent(self.there.shape), np.float64)
        for hand, side in enumerate(SIDES):
            at = np.flatnonzero(self.there[:, hand])
            mean, components = bases[side]
            true = rotvec_to_matrix((mean + self.pca[at, hand] @ components).reshape(-1, 15, 3))
            betas = self.betas[at, hand]
            wrist = self.transl[at, hand] + np.asarray(model.rest_joints(betas, side))[:, 0]
            T_world_from_wrist = rigid.rigid(quat_xyzw_to_matrix(self.quat_xyzw[at, hand]), wrist)
            T_camera_from_wrist = T_camera_from_world[at] @ T_world_from_wrist
            state[at, hand] = hands.HandState.from_matrices(
                T_camera_from_wrist[:, :3, 3],
                T_camera_from_wrist[:, :3, :3],
                hands.mirror_rotations(true) if hand == LEFT else true,
                betas,
            ).pack()
        return state


_UID: Final = "uid"
_ARRAYS: Final = tuple(f.name for f in fields(Hot3DHands) if f.name not in ("masks", _UID))


def _check_hand(index: str, hand: Mapping[str, Any], num_coefficients: int) -> None:
    if index not in ("0", "1"):
        raise ValueError(f"hand {index!r}")
    for name, size in (("pose", num_coefficients), ("betas", hands.NUM_SHAPE_PARAMS)):
        values = np.asarray(hand[name], np.float64)
        if values.shape != (size,) or not np.isfinite(values).all():
            raise ValueError(f"{name} of hand {index}: {values.shape} instead of {size} numbers")


def pca_bases(mano_dir: Path, count: int) -> dict[Side, tuple[Float, Float]]:
    """Mean (45,) and first components (count, 45) of both hands' joint rotation vectors.

    Without MANO_LEFT.pkl the left hand's are the right hand's mirror image, as its mesh is.
    """
    files = find_mano_files(mano_dir)
    bases: dict[Side, tuple[Float, Float]] = {}
    for side in ("right", "left"):
        if side not in files:
            signs = np.tile(LEFT_MIRROR, hands.NUM_JOINT_ROTATIONS)
            mean, components = bases["right"]
            bases[side] = (mean * signs, components * signs)
            continue
        path = files[side]
        fields = load_plain_pickle(path)
        read: list[Float] = []
        for name, shape in (("hands_mean", (45,)), ("hands_components", (45, 45))):
            values = fields.get(name)
            if not isinstance(values, np.ndarray) or values.shape != shape:
                got = getattr(values, "shape", type(values).__name__)
                raise ValueError(f"{path}: {name}: expected {shape}, got {got}")
            read.append(values.astype(np.float64))
        bases[side] = (read[0], read[1][:count])
    return bases
