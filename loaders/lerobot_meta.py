"""What a LeRobot root of another project says of its episodes: name, place of origin, meta.

Nothing here depends on where a root lies or how its address was typed: equal files give equal
episodes. What tells roots apart is ``Root.identity``.
"""

import json
import re
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry.camera import fov_vh_to_K
from mint_hub.loaders import lerobot_files, lerobot_text
from mint_hub.loaders.fields import slug
from mint_hub.loaders.lerobot_columns import Dialect, LeRobotError
from mint_hub.loaders.lerobot_files import Root, read_tasks
from mint_hub.loaders.lerobot_index import INDEX_COLUMNS
from mint_hub.loaders.lerobot_origin import (
    ATTACHMENT,
    VIDEO_KEY,
    attachment,
    origin_warnings,
    stated_uid,
    video_uid,
)
from mint_hub.loaders.schema import SCHEMA_VERSION

SCALE_STATUS: Final = "scale-enlarged pseudo-label, not metric"
"""What the published labels are."""

CONVENTIONS: Final = "camera: world-to-camera, OpenCV axes, metres; hands: camera frame"

INTRINSICS_TOLERANCE: Final = 0.02
"""How far ``intrinsics`` may be from those of ``fov``, in image sides, before a warning."""

_ALIASES: Final = {"epickitchen": "epic", "epic-kitchens": "epic", "epic-kitchens-100": "epic"}
_DOMAINS: Final = {"ego4d": "daily", "epic": "kitchen", "egodex": "tabletop"}
_OTHER_COLUMNS: Final = ("tasks", "atomic_segments", "dataset_to_index")


class RootMeta:
    """Key, group and meta of the episodes of a root.

    Args:
        root: the root.
        source: name of its source; None: what info.json says, else the folder's name.
        scale_status: what the labels' lengths are.
        size: (height, width) that the field of view belongs to; None: what info.json says.

    """

    def __init__(
        self, root: Root, source: str | None, scale_status: str, size: tuple[int, int] | None
    ) -> None:
        self.root, self.source = root, source or _source_of(root)
        self.scale_status, self.size = scale_status, size
        self._tasks = read_tasks(root)

    def key(self, row: Mapping[str, Any], number: int) -> str:
        """Return the key of an episode: source, video uid or else the root's identity, number."""
        name = stated_uid(row) or self.root.identity
        return "-".join(slug(part) for part in (self.source, name, f"{number:06d}"))

    def origin(self, row: Mapping[str, Any]) -> dict[str, Any]:
        """Return source, uid and what else is known of the video, as they are in ``meta``."""
        video = attachment(row, self.root.info, self.source)
        return {"source": self.source, "uid": video_uid(row, self.root), **video}

    def described(
        self,
        entry: NDArray[Any],
        row: Mapping[str, Any],
        path: str,
        dialect: Dialect,
        got: Mapping[str, NDArray[Any]],
    ) -> dict[str, Any]:
        """Return all of an episode but its arrays.

        Args:
            entry: its record of the index.
            row: its row of meta/episodes.
            path: its data file.
            dialect: of that file.
            got: its columns, as they were read.

        """
        number, origin = int(entry["episode_index"]), self.origin(row)
        text, warnings = lerobot_text.segments(row, self._tasks, got.get("main_type"))
        if dialect == "world":
            warnings += _doubts(got, self._image_size())
        warnings += origin_warnings(row)
        provenance = self._provenance(entry, row, path, dialect)
        meta: dict[str, Any] = {
            **origin,
            "domain": _DOMAINS.get(self.source),
            "tasks": list(row.get("tasks") or ()),
            "main_hand": lerobot_text.main_hand(got.get("main_type")),
            "fps": self.root.fps,
            "scale_status": self.scale_status,
            "shape_space": "mano",
            "conventions": CONVENTIONS,
            "provenance": provenance,
            "warnings": warnings,
        }
        return {
            "key": self.key(row, number),
            "image_size_hw": self._image_size(),
            "text": [segment.to_dict() for segment in text],
            "schema_version": SCHEMA_VERSION,
            "start_s": float((provenance["video"] or {}).get("from_timestamp") or 0.0),
            "meta": {name: value for name, value in meta.items() if value is not None},
        }

    def _provenance(
        self, entry: NDArray[Any], row: Mapping[str, Any], path: str, dialect: Dialect
    ) -> dict[str, Any]:
        """Return where in which root an episode is."""
        video = {
            n.rsplit("/", 1)[1]: v for n, v in row.items() if n.startswith(f"videos/{VIDEO_KEY}/")
        }
        known = {*(c.name for c in INDEX_COLUMNS), *ATTACHMENT, *_OTHER_COLUMNS}
        other = {n: v for n, v in row.items() if n not in known and not n.startswith("videos/")}
        return {
            "format": f"LeRobot {self.root.info['codebase_version']}, {dialect} dialect",
            "root": self.root.identity,
            "file": path,
            "row": int(entry["dataset_from_index"] - entry["base"]),
            "episode_index": int(entry["episode_index"]),
            "video": video or None,
            "columns": json.loads(json.dumps(other, default=str)),
        }

    def _image_size(self) -> tuple[int, int]:
        if self.size is not None:
            return self.size
        feature = self.root.info.get("features", {}).get(VIDEO_KEY, {})
        shape, names = feature.get("shape") or (), feature.get("names") or ()
        if len(shape) != 3:
            raise LeRobotError(
                f"{self.root.name(lerobot_files.INFO)}: features[{VIDEO_KEY!r}]['shape']: expected "
                f"(height, width, 3), got {list(shape)}: pass image_size_hw"
            )
        first = [str(name)[:1] for name in names]
        height, width = (first.index("h"), first.index("w")) if {"h", "w"} <= set(first) else (0, 1)
        return int(shape[height]), int(shape[width])


def _doubts(got: Mapping[str, NDArray[Any]], image_size_hw: tuple[int, int]) -> list[str]:
    """Warnings about an episode in the world dialect."""
    doubts: list[str] = []
    if "observation.state" not in got:
        doubts.append("no hand shape in the source: zeros, the mean shape")
    if "intrinsics" in got:
        stated = got["intrinsics"].reshape(-1, 3, 3)
        apart = np.abs(fov_vh_to_K(got["fov"][:, ::-1], image_size_hw) - stated).max()
        if not apart <= INTRINSICS_TOLERANCE * max(image_size_hw):
            doubts.append(
                f"intrinsics differ by {apart:.1f} px from fov, which is used, and image size"
            )
    return doubts


def _source_of(root: Root) -> str:
    said = root.info.get("_source_dataset")
    parts = [p for p in re.split(r"[/\\]+", root.folder) if not p.lower().startswith("lerobot")]
    name = slug(str(said or (parts[-1] if parts else "lerobot")))
    return _ALIASES.get(name, name)
