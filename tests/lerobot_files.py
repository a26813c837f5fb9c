"""Small LeRobot v3 roots made to the published contract, without the code under test."""

import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.spatial.transform import Rotation

from mint_hub.loaders.schema import Episode
from tests.episodes import make_episode

FPS = 30.0
IMAGE_SIZE_HW = (384, 512)
SIDES = ("left", "right")


@dataclass
class RootPlan:
    """What a root contains; ``per_file`` episodes go into each data file."""

    lengths: tuple[int, ...] = (12, 9, 20, 8, 15)
    dialect: str = "camera"
    source: str | None = "ego4d"
    per_file: int = 2
    first_episode: int = 0
    first_row: int = 0
    seed: int = 0
    placeholder: str = "canonical"
    rows_per_group: int | None = None
    video: bool = True
    episode_columns: dict = field(default_factory=dict)

    def episodes(self) -> list[Episode]:
        """The motion that the root says, before it is written in any dialect."""
        size = {"image_size_hw": IMAGE_SIZE_HW}
        pairs = enumerate(self.lengths)
        return [make_episode(n, self.seed + i, key=f"t-{i}", **size) for i, n in pairs]


def write_root(folder: Path, plan: RootPlan | None = None) -> list[Episode]:
    """Write a root and return the motion in it."""
    plan = plan or RootPlan()
    episodes = plan.episodes()
    tasks: dict[str, int] = {}
    tables, rows = {}, []
    at = plan.first_row
    for i, episode in enumerate(episodes):
        chunk, file = 0, i // plan.per_file
        text = _text(i, episode.num_frames, tasks)
        frames = {
            **_counters(plan.first_episode + i, at, episode, text),
            **(_camera if plan.dialect == "camera" else _world)(episode, plan.placeholder),
        }
        tables.setdefault((chunk, file), []).append(_table(frames))
        rows.append(_episode_row(plan, i, episode.num_frames, (chunk, file), at, text))
        at += episode.num_frames
    features = {}
    for (chunk, file), parts in tables.items():
        table = pa.concat_tables(parts)
        features = {name: _feature(table.schema.field(name).type) for name in table.column_names}
        path = folder / f"data/chunk-{chunk:03d}/file-{file:03d}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(table, path, row_group_size=plan.rows_per_group)
    # Two files of episode metadata, whose bounds are not those of the data files.
    for number, part in enumerate((rows[:3], rows[3:])):
        if part:
            path = folder / f"meta/episodes/chunk-000/file-{number:03d}.parquet"
            path.parent.mkdir(parents=True, exist_ok=True)
            pq.write_table(pa.Table.from_pylist(part), path)
    frame = pd.DataFrame({"task_index": list(tasks.values())}, index=list(tasks))
    frame.to_parquet(folder / "meta/tasks.parquet")
    (folder / "meta/info.json").write_text(json.dumps(_info(plan, at - plan.first_row, features)))
    return episodes


def frame_table(folder: Path) -> pa.Table:
    """All frames of a root in the order of its files."""
    return pa.concat_tables([pq.read_table(p) for p in sorted(folder.glob("data/*/*.parquet"))])


def episode_rows(folder: Path) -> list[dict]:
    """All rows of meta/episodes."""
    files = sorted(folder.glob("meta/episodes/*/*.parquet"))
    return [row for path in files for row in pq.read_table(path).to_pylist()]


def replace_column(path: Path, name: str, values: pa.Array | None) -> None:
    """Put another column in a parquet file's place, or take it out."""
    table = pq.read_table(path)
    number = table.schema.get_field_index(name)
    if values is None:
        table = table.remove_column(number)
    else:
        table = table.set_column(number, name, values)
    pq.write_table(table, path)


def edit_info(folder: Path, **changes: object) -> None:
    """Change entries of info.json."""
    path = folder / "meta/info.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


def _text(number: int, length: int, tasks: dict[str, int]) -> dict:
    """A goal for the whole episode, and in even ones two steps with a gap between them."""
    goal = f"make tea {number // 2}"
    tasks.setdefault(goal, len(tasks))
    task_index = np.full(length, tasks[goal])
    texts, atomic = [goal], []
    steps = [("open the jar", 0, length // 3), ("pour water", length // 2, length)]
    for ordinal, (text, start, end) in enumerate(steps if number % 2 == 0 else []):
        tasks.setdefault(text, len(tasks))
        task_index[start:end] = tasks[text]
        atomic.append(
            {
                "atomic_index": ordinal,
                "task_index": tasks[text],
                "start_frame": start,
                "end_frame": end,
            }
        )
        texts.append(text)
    hand = (-1, 0, 1)[number % 3]
    return {"tasks": texts, "atomic": atomic, "task_index": task_index, "main_type": hand}


def _counters(number: int, at: int, episode: Episode, text: dict) -> dict:
    length = episode.num_frames
    return {
        "index": np.arange(at, at + length),
        "episode_index": np.full(length, number),
        "frame_index": np.arange(length),
        "task_index": text["task_index"],
        "main_type": np.full(length, text["main_type"]),
        "timestamp": np.arange(length) / FPS,
        "state_mask": episode.presence,
    }


def _camera(episode: Episode, placeholder: str) -> dict:
    T = episode.T_camera_from_world
    quat = Rotation.from_matrix(T[:, :3, :3]).as_quat()
    quat *= np.where(quat[:, 3:] < 0, -1, 1)
    columns = {
        "hand_kept": episode.presence,
        "cam_trans": T[:, :3, 3].astype("f4"),
        "cam_quat": quat.astype("f4"),
        "cam_fov": episode.fov_vh_rad,
    }
    for hand, side in enumerate(SIDES):
        state = np.array(episode.hand_state[:, hand])
        if placeholder != "canonical":
            state[~episode.presence[:, hand]] = 0.0 if placeholder == "zeros" else np.nan
        columns[f"{side}_mano_transl_cam"] = state[:, 0:3]
        columns[f"{side}_mano_orient6d"] = state[:, 3:9]
        columns[f"{side}_mano_pose6d"] = state[:, 9:99]
        columns[f"{side}_mano_betas"] = state[:, 99:109]
    return columns


def _world(episode: Episode, placeholder: str) -> dict:
    T = episode.T_camera_from_world
    R, t = T[:, :3, :3], T[:, :3, 3]
    height, width = episode.image_size_hw
    vertical, horizontal = episode.fov_vh_rad.T.astype("f8")
    zero, one = np.zeros(len(T)), np.ones(len(T))
    f_x, f_y = width / 2 / np.tan(horizontal / 2), height / 2 / np.tan(vertical / 2)
    intrinsics = [f_x, zero, width / 2 * one, zero, f_y, height / 2 * one, zero, zero, one]
    state_122 = np.zeros((len(T), 122))
    columns = {
        "fov": np.stack([horizontal, vertical], axis=-1),
        "intrinsics": np.stack(intrinsics, axis=-1),
        "extrinsics_w2c": T.reshape(-1, 16),
        "observation.state": state_122,
    }
    for hand, side in enumerate(SIDES):
        state, there = episode.hand_state[:, hand].astype("f8"), episode.presence[:, hand]
        wrist, joints = _matrix(state[:, 3:9]), _matrix(state[:, 9:99].reshape(-1, 15, 6))
        transl = np.einsum("tji,tj->ti", R, state[:, 0:3] - t)
        orient = np.swapaxes(R, -1, -2) @ wrist
        angles = [
            Rotation.from_matrix(m.reshape(-1, 3, 3)).as_euler("xyz").reshape(len(T), -1)
            for m in (wrist, joints)
        ]
        part = np.concatenate([state[:, 0:3], *angles, state[:, 99:109]], axis=-1)
        state_122[:, 61 * hand : 61 * hand + 61] = np.where(there[:, None], part, 0)
        filler = {"zeros": 0.0, "nan": np.nan}.get(placeholder)
        transl[~there] = 0 if filler is None else filler
        orient[~there] = np.eye(3) if filler is None else filler
        joints[~there] = np.eye(3) if filler is None else filler
        columns[f"{side}_transl_world"] = transl
        columns[f"{side}_orient_world"] = orient.reshape(-1, 9)
        columns[f"{side}_hand_pose"] = joints.reshape(-1, 135)
        columns[f"{side}_kept"] = there
    return columns


def _matrix(rot6d: np.ndarray) -> np.ndarray:
    a, b = rot6d[..., :3], rot6d[..., 3:]
    a = a / np.linalg.norm(a, axis=-1, keepdims=True)
    b = b - (a * b).sum(-1, keepdims=True) * a
    b = b / np.linalg.norm(b, axis=-1, keepdims=True)
    return np.stack([a, b, np.cross(a, b)], axis=-2)


def _table(frames: dict) -> pa.Table:
    arrays = {}
    for name, values in frames.items():
        values = np.ascontiguousarray(values)
        flat = pa.array(values.reshape(-1))
        one = values.ndim == 1
        arrays[name] = flat if one else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
    return pa.table(arrays)


def _feature(kind: pa.DataType) -> dict:
    listed = pa.types.is_fixed_size_list(kind)
    dtype = {"float": "float32", "double": "float64"}.get(str(kind.value_type if listed else kind))
    name = dtype or str(kind.value_type if listed else kind)
    return {"dtype": name, "shape": [kind.list_size if listed else 1], "names": None}


def _episode_row(
    plan: RootPlan, number: int, length: int, place: tuple[int, int], at: int, text: dict
) -> dict:
    key = "videos/observation.images.ego"
    video = {
        f"{key}/chunk_index": 0,
        f"{key}/file_index": number,
        f"{key}/from_timestamp": 2.0 * number,
    }
    return {
        "episode_index": plan.first_episode + number,
        "length": length,
        "tasks": text["tasks"],
        "atomic_segments": text["atomic"],
        "data/chunk_index": place[0],
        "data/file_index": place[1],
        "dataset_from_index": at,
        "dataset_to_index": at + length,
        **(video if plan.video else {}),
        **{name: values[number] for name, values in plan.episode_columns.items()},
    }


def _info(plan: RootPlan, num_frames: int, features: dict) -> dict:
    shape = [*IMAGE_SIZE_HW, 3]
    image = {"dtype": "video", "shape": shape, "names": ["height", "width", "channel"]}
    return {
        "codebase_version": "v3.0",
        "robot_type": "ego_hand",
        "total_episodes": len(plan.lengths),
        "total_frames": num_frames,
        "chunks_size": 1000,
        "fps": FPS,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "features": {**features, "observation.images.ego": image},
        "hand_frame": plan.dialect,
        **({"_source_dataset": plan.source} if plan.source else {}),
    }
