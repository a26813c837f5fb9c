"""The user's own MANO files: found, read without unpickling, kept once as safetensors.

MANO may not be shipped: each user registers at https://mano.is.tue.mpg.de and downloads
``MANO_RIGHT.pkl`` and ``MANO_LEFT.pkl``. The files stay where the user put them; the conversion
goes only into a cache folder that the caller names.
"""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import Any, Final

import numpy as np
from safetensors.numpy import load_file, save

from mint_hub.conventions import JOINT_NAMES, JOINT_PARENTS, MANO_FINGERTIP_VERTICES, SIDES, Side
from mint_hub.geometry.hand_state import NUM_JOINT_ROTATIONS, NUM_SHAPE_PARAMS
from mint_hub.geometry.plain_pickle import Opaque, UnreadablePickleError, load_plain_pickle

MANO_FILE_NAMES: Final[dict[Side, str]] = {"left": "MANO_LEFT.pkl", "right": "MANO_RIGHT.pkl"}
MANO_SUBFOLDERS: Final = ("", "models", "mano", "mano_v1_2/models")
REGISTRATION: Final = "https://mano.is.tue.mpg.de"

ManoTensors = dict[str, np.ndarray]
"""The arrays of one MANO file, under its own names: v_template (V, 3), shapedirs (V, 3, 10),
posedirs (V, 3, 135), J_regressor (16, V), weights (V, 16), float64; f (F, 3) int64."""

_FIELDS: Final = ("v_template", "shapedirs", "posedirs", "J_regressor", "weights", "f")


def find_mano_files(folder: Path | str) -> dict[Side, Path]:
    """Find the MANO files in a folder, or in one of the sub-folders they are usually unpacked to.

    Returns:
        The files found by side: "right" always, "left" where present.

    Raises:
        FileNotFoundError: no MANO_RIGHT.pkl (the message says where to get it).

    """
    folder = Path(folder)
    found: dict[Side, Path] = {}
    for side in SIDES:
        candidates = (folder / sub / MANO_FILE_NAMES[side] for sub in MANO_SUBFOLDERS)
        path = next((p for p in candidates if p.is_file()), None)
        if path is not None:
            found[side] = path
    if "right" not in found:
        raise FileNotFoundError(
            f"{folder}: expected MANO_RIGHT.pkl and MANO_LEFT.pkl there (or in "
            f"{', '.join(s for s in MANO_SUBFOLDERS if s)} below it), found "
            f"{', '.join(p.name for p in found.values()) or 'neither'}. MANO may not be shipped: "
            f"register at {REGISTRATION} and download the models, or leave mano_dir out to use the "
            "hand template that comes with mint-hub"
        )
    return found


def read_mano_file(path: Path | str, cache_dir: Path | str | None = None) -> ManoTensors:
    """Read the arrays of one MANO file; nothing stored in it is executed.

    Args:
        path: MANO_RIGHT.pkl or MANO_LEFT.pkl.
        cache_dir: where to keep the arrays as safetensors, named by the file's SHA-256, so that the
            pickle is read once. Nothing is written without it.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: not a MANO hand (the message names the field), or a pickle that asks for more
            than data.

    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; MANO's files come from {REGISTRATION}")
    content = path.read_bytes()
    if cache_dir is None:
        return _mano_tensors(path, content)
    digest = hashlib.sha256(content).hexdigest()[:16]
    cached = Path(cache_dir) / f"{path.stem.lower()}-{digest}.safetensors"
    if cached.is_file():
        return _checked(load_file(cached), cached)
    tensors = _mano_tensors(path, content)
    cached.parent.mkdir(parents=True, exist_ok=True)
    partial = cached.with_suffix(f".{os.getpid()}.partial")
    partial.write_bytes(save(tensors))
    partial.replace(cached)
    return tensors


def shape_directions_for_left(left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, bool]:
    """Repair MANO_LEFT's shape directions (V, 3, 10).

    In the published file the x components equal MANO_RIGHT's, although the hand is mirrored across
    x, so that they point the wrong way; where they do, their sign is flipped.

    Returns:
        The directions, and whether they were flipped.

    """
    defective = left.shape == right.shape and np.allclose(
        left[:, 0], right[:, 0], atol=1e-6, rtol=0
    )
    if not defective or not left[:, 0].any():
        return left, False
    return left * np.array([-1.0, 1.0, 1.0])[:, None], True


def _mano_tensors(path: Path, content: bytes) -> ManoTensors:
    try:
        fields = load_plain_pickle(content)
    except UnreadablePickleError as error:
        raise UnreadablePickleError(f"{path}: refused: {error}") from error
    if not isinstance(fields, dict):
        raise ValueError(f"{path}: expected a dict of arrays, got {type(fields).__name__}")
    missing = [name for name in _FIELDS if name not in fields]
    if missing:
        raise ValueError(f"{path}: not a MANO file: {', '.join(missing)} missing")
    for name in _FIELDS:
        if isinstance(fields[name], Opaque):
            raise ValueError(f"{path}: {name}: expected an array, got a {fields[name].name}")
    _check_tree(fields.get("kintree_table"), path)
    tensors: ManoTensors = {
        name: np.asarray(fields[name], dtype=np.float64) for name in _FIELDS[:-1]
    }
    tensors["f"] = np.asarray(fields["f"]).astype(np.int64)
    tensors["shapedirs"] = np.ascontiguousarray(tensors["shapedirs"][..., :NUM_SHAPE_PARAMS])
    return _checked(tensors, path)


def _check_tree(kintree_table: Any, path: Path) -> None:
    if kintree_table is None:
        return
    parents = tuple(int(p) for p in np.asarray(kintree_table)[0])
    if parents[1:] != JOINT_PARENTS[1:]:
        raise ValueError(f"{path}: kintree_table: expected parents {JOINT_PARENTS}, got {parents}")


def _checked(tensors: ManoTensors, path: Path) -> ManoTensors:
    missing = [name for name in _FIELDS if name not in tensors]
    if missing:
        raise ValueError(f"{path}: {', '.join(missing)} missing; delete it to have it made again")
    v, j = len(tensors["v_template"]), len(JOINT_NAMES)
    expected = {
        "v_template": (v, 3),
        "shapedirs": (v, 3, NUM_SHAPE_PARAMS),
        "posedirs": (v, 3, 9 * NUM_JOINT_ROTATIONS),
        "J_regressor": (j, v),
        "weights": (v, j),
        "f": (len(tensors["f"]), 3),
    }
    for name, shape in expected.items():
        if tensors[name].shape != shape:
            raise ValueError(f"{path}: {name}: expected {shape}, got {tensors[name].shape}")
    faces = tensors["f"]
    if v <= max(MANO_FINGERTIP_VERTICES) or not 0 <= faces.min() <= faces.max() < v:
        raise ValueError(f"{path}: {v} vertices are too few for its faces and finger tips")
    return tensors
