"""Hands by HaWoR (Zhang et al. 2025, arXiv 2501.02973), its camera-frame part.

HaWoR gives MANO's parameters. MANO's ``transl`` is not the wrist: the rest wrist J0 of the shape is
added, for which the user's own MANO files are needed. Gaps are left to the clean stage, which marks
what it fills. This adapter was run on recorded files only, made to what HaWoR's scripts write, and
not with the project itself, which needs an NVIDIA GPU.
"""

import json
import os
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import SIDES
from mint_hub.geometry.hand_model import HandModel
from mint_hub.geometry.hand_state import HandState, absent, mirror_rotations
from mint_hub.geometry.rotations import nearest_rotation
from mint_hub.labelling.external import write_frames
from mint_hub.labelling.readiness import Lack, path_lacks
from mint_hub.labelling.records import Clip, Hands, Video
from mint_hub.labelling.stage import (
    LOCAL,
    Outcome,
    Resources,
    StageError,
    report_of,
    reported,
    require,
)
from mint_hub.labelling.stages.research import ResearchStage, focal_px

SCORE: Final = 0.5
"""HaWoR does not say how sure it is."""

_SHAPES: Final = {
    "init_root_orient": (3, 3),
    "init_hand_pose": (15, 3, 3),
    "init_trans": (3,),
    "init_betas": (10,),
}


@dataclass(frozen=True)
class HaworSettings:
    """Settings of `HaworHands`.

    Attributes:
        checkout: folder of HaWoR's repository, its weights in place.
        weights: ``hawor.ckpt``; that of the checkout when empty.
        mano_dir: folder with MANO_RIGHT.pkl (and MANO_LEFT.pkl); the one in the checkout when
            empty.
        python: the interpreter it was installed for.
        timeout_s: for a clip.

    """

    checkout: str = field(default="", metadata=LOCAL)
    weights: str = field(default="", metadata=LOCAL)
    mano_dir: str = field(default="", metadata=LOCAL)
    python: str = field(default="", metadata=LOCAL)
    timeout_s: float = 7200.0


class HaworHands(ResearchStage):
    """Stage "hands", backend "hawor"."""

    stage: str = "hands"
    backend: str = "hawor"
    version: str = "1"
    needs: tuple[str, ...] = ("intrinsics",)
    gives: tuple[str, ...] = ("hands",)
    resources: Resources = Resources(cpus=2.0, gpus=1.0, memory_gib=12.0)

    def __init__(self, settings: HaworSettings | None = None) -> None:
        self.settings = settings or HaworSettings()

    def files_lack(self) -> tuple[Lack, ...]:
        """Return what is missing of the user's files."""
        clone = "git clone --recursive https://github.com/ThunderVVV/HaWoR, and install it"
        hub = "hawor.ckpt of huggingface.co/ThunderVVV/HaWoR (CC BY-NC-ND: mind its licence)"
        site = "register at mano.is.tue.mpg.de and download MANO (its licence forbids shipping it)"
        script = "scripts/scripts_test_video/hawor_video.py"
        detector = "weights/external/detector.pt"
        checkout = self.settings.checkout
        return (
            *path_lacks("checkout", checkout, "HaWoR", clone, script, detector),
            *path_lacks("weights", self._inside("weights"), "HaWoR's weights", hub),
            *path_lacks("mano_dir", self._inside("mano_dir"), "MANO", site, "MANO_RIGHT.pkl"),
        )

    def run_clip(self, clip: Clip, video: Video) -> Outcome:
        """Estimate both hands of every frame.

        Raises:
            StageError: intrinsics are missing, HaWoR fails, or its files are not as expected.
            NotReadyError: checkout, weights, MANO or interpreter are missing.

        """
        require(self, clip)
        with tempfile.TemporaryDirectory(prefix="mint-hub-hawor-") as folder:
            scene = Path(folder) / clip.key
            scene.mkdir()
            write_frames(clip, scene / "extracted_images", ".jpg")
            _, values = self.call(
                "hawor",
                {},
                checkout=os.path.abspath(self.settings.checkout),
                checkpoint=os.path.abspath(self._inside("weights")),
                video=str(scene.with_suffix(".mp4")),
                focal=float(np.mean(focal_px(clip))),
            )
            if values["frames"] != clip.num_frames:
                raise StageError(
                    f"hawor: expected {clip.num_frames} frames, it saw {values['frames']}"
                )
            model = HandModel.from_mano(self._inside("mano_dir"))
            hands = read_hands(scene / "cam_space", clip.num_frames, model)
        present = hands.presence.mean(0)
        report = report_of(self, left=float(present[0]), right=float(present[1]))
        return Outcome((reported(clip, report, hands=hands),))

    def _inside(self, setting: str) -> str:
        given = getattr(self.settings, setting)
        inside = {"weights": "weights/hawor/checkpoints/hawor.ckpt", "mano_dir": "_DATA/data/mano"}
        checkout = self.settings.checkout
        return given or (os.path.join(checkout, inside[setting]) if checkout else "")


def read_hands(folder: Path, num_frames: int, model: HandModel) -> Hands:
    """Read what HaWoR wrote: ``0/`` (left) and ``1/`` (right), a file of every stretch of frames.

    ``FIRST_LAST.json`` holds, of frames FIRST .. LAST: ``init_root_orient`` (1, T, 3, 3) and
    ``init_hand_pose`` (1, T, 15, 3, 3), rotations of that hand itself; ``init_trans`` (1, T, 3),
    MANO's transl, metres, camera frame; ``init_betas`` (1, T, 10).

    Args:
        folder: HaWoR's ``cam_space``; missing where it saw no hand.
        num_frames: T of the clip.
        model: the user's MANO hand, which knows the rest wrist of a shape.

    Raises:
        StageError: a file is not as expected.

    """
    state = np.asarray(absent((num_frames, len(SIDES))), np.float32)
    presence = np.zeros((num_frames, len(SIDES)), bool)
    for hand, side in enumerate(SIDES):
        for file in sorted((folder / str(hand)).glob("*.json"), key=_first):
            values, first = _read(file, num_frames)
            at = slice(first, first + len(values["init_trans"]))
            joints = nearest_rotation(values["init_hand_pose"])
            betas = values["init_betas"]
            wrist = values["init_trans"] + np.asarray(model.rest_joints(betas, side))[:, 0]
            parts = HandState.from_matrices(
                wrist,
                nearest_rotation(values["init_root_orient"]),
                mirror_rotations(joints) if side == "left" else joints,
                betas,
            )
            state[at, hand] = np.asarray(parts.pack())
            presence[at, hand] = True
    shape = presence.shape
    return Hands(
        hand_state=state,
        presence=presence,
        score=np.where(presence, np.float32(SCORE), np.float32(0)),
        filled=np.zeros(shape, bool),
        shape_space=model.shape_space,
        hand_model=model.name,
        source="hawor",
        residual_px=np.full(shape, np.nan, np.float32),
    )


def _first(file: Path) -> int:
    first, _, last = file.stem.partition("_")
    if not (first.isdigit() and last.isdigit()):
        raise StageError(f"hawor: expected FIRST_LAST.json, got {file.name}")
    return int(first)


def _read(file: Path, num_frames: int) -> tuple[Mapping[str, NDArray[np.float64]], int]:
    first, last = (int(number) for number in file.stem.split("_"))
    if not 0 <= first <= last < num_frames:
        raise StageError(f"hawor: expected frames below {num_frames}, got {file.name}")
    try:
        stored: dict[str, Any] = json.loads(file.read_text())
        values = {name: np.array(stored[name], np.float64) for name in _SHAPES}
    except (ValueError, KeyError, TypeError) as error:
        raise StageError(f"hawor: {file.name}: {type(error).__name__}: {error}") from error
    for name, shape in _SHAPES.items():
        expected = (1, last - first + 1, *shape)
        if values[name].shape != expected or not np.isfinite(values[name]).all():
            got = values[name].shape
            raise StageError(f"hawor: {file.name}: {name}: expected {expected}, got {got}")
    return {name: value[0] for name, value in values.items()}, first
