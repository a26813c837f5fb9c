"""Make a world from a seed: a room, a person, things, what is done with them, and who looks.

>>> world = make_world(3, "train", num_frames=30)
>>> world.num_frames, world.preset
(30, 'train')
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import MODEL_FPS, SIDES, Side
from mint_hub.geometry.hand_model import HandModel
from mint_hub.geometry.hand_state import HandState, absent
from mint_hub.geometry.rigid import inverse, rigid
from mint_hub.geometry.rotations import rotvec_to_matrix
from mint_hub.synth.activities import TRAIN, Activity
from mint_hub.synth.activities_ood import OOD
from mint_hub.synth.actors import Arm, Item
from mint_hub.synth.camera_motion import HeadStyle, camera_path, draw_style, median_steps
from mint_hub.synth.collisions import Collisions, collisions
from mint_hub.synth.hand_pose import HandProxy, joint_rotations
from mint_hub.synth.motion import PoseTrack, smooth_noise
from mint_hub.synth.person import Person
from mint_hub.synth.presets import (
    FOV_STEPS,
    GENERATOR,
    REVISION,
    SHAPE_STEPS,
    Preset,
    key_of,
    on_grid,
    preset_named,
    rng_of,
)
from mint_hub.synth.room import Painter, Room, draw_room, lights, posed, standing
from mint_hub.synth.tabletop import Tabletop
from mint_hub.synth.things import Thing, make_thing
from mint_hub.synth.world import Body, Hands, TextSegment, World

__all__ = ["make_world"]

Floats = NDArray[np.float64]

_ATTEMPTS: Final = 5
_ENOUGH: Final = 0.03
_LESS: Final = {
    **{"bowl": 0.3, "plate": 0.25, "parcel": 0.25, "pan": 0.3},
    **{"switch": 0.4, "book": 0.5},
}
"""Kinds that are drawn less often than others: few clips need more than one."""

_BOTH_ARMS: Final = ("both", "hand over")
_TOUCHING: Final = 0.04
_SKIN_LIGHT: Final = np.array([0.62, 0.36, 0.26])
_SKIN_DARK: Final = np.array([0.075, 0.034, 0.020])


def make_world(seed: int, preset: str = "train", num_frames: int | None = None) -> World:
    """Make the world of a seed: the same seed, preset and length give the same world.

    Args:
        seed: any number from 0; for a bench, the number of its clip (see ``presets.seed_of``).
        preset: one of ``presets.PRESETS``.
        num_frames: of the clip; drawn from the preset's range without it.

    Raises:
        ValueError: an unknown preset, a negative seed, no frames, a clip that a bench has not.

    """
    kind = preset_named(preset)
    if seed < 0 or (kind.clips is not None and seed >= kind.clips):
        there = "0 or more" if kind.clips is None else f"0 to {kind.clips - 1}"
        raise ValueError(f"seed: expected {there} for {preset}, got {seed}")
    if num_frames is not None and num_frames < 1:
        raise ValueError(f"num_frames: expected at least 1, got {num_frames}")
    rng = rng_of(preset, seed)
    low, high = kind.num_frames
    drawn = int(rng.integers(low, high + 1))
    times = np.arange(num_frames or drawn) / MODEL_FPS
    cast = _Cast.draw(rng, kind)
    best: tuple[Tabletop, Collisions] | None = None
    for attempt in range(_ATTEMPTS):
        own = rng_of(preset, seed, attempt)
        table = _play(own, kind, cast, times)
        found = collisions(table, times[:: max(1, len(times) // 90)], cast.exists, seed)
        if best is None or found.share < best[1].share:
            best = table, found
        if found.share < _ENOUGH:
            break
    assert best is not None
    filming = rng_of(preset, seed, _ATTEMPTS)
    return _film(filming, kind, cast, best[0], times, seed, best[1])


@dataclass(frozen=True, eq=False)
class _Cast:
    """Who and where: everything that does not depend on what happens."""

    room: Room
    person: Person
    exists: tuple[bool, bool]
    skin: Floats

    @classmethod
    def draw(cls, rng: np.random.Generator, preset: Preset) -> _Cast:
        room = draw_room(rng, preset)
        sizes = preset.hand_size[int(rng.integers(len(preset.hand_size)))]
        shape = rng.uniform(*preset.other_shape, 10) * rng.choice([-1.0, 1.0], 10)
        if preset.other_shape[0] == 0:
            shape *= rng.uniform(0, 1, 10) ** 0.5
        shape[0] = rng.uniform(*sizes)
        proxy = HandProxy.of(on_grid(shape, SHAPE_STEPS))
        aside = float(rng.uniform(*preset.eye_aside) * rng.choice([-1, 1]))
        eye = np.array([aside, -rng.uniform(*preset.eye_back), rng.uniform(*preset.eye_up)])
        dominant: Side = "right" if rng.random() < 0.75 else "left"
        person = Person(
            proxy,
            eye,
            rng.uniform(0.24, 0.32),
            rng.uniform(0.06, 0.14),
            rng.uniform(0.85, 1.35),
            dominant,
        )
        alone = rng.random()
        exists = (alone >= 0.09 or dominant == "left", alone >= 0.09 or dominant == "right")
        tone = rng.beta(0.9, 1.4)
        skin = np.exp((1 - tone) * np.log(_SKIN_LIGHT) + tone * np.log(_SKIN_DARK))
        skin = skin * rng.uniform(0.92, 1.08, 3)
        person = replace(person, habits=int(rng.integers(1 << 31)))
        return cls(room, person, exists, skin)


# ---------------------------------------------------------------------- what happens


def _play(rng: np.random.Generator, preset: Preset, cast: _Cast, times: Floats) -> Tabletop:
    """Let the arms act until the clip is over."""
    items = _lay(rng, preset, cast)
    idle: dict[Side, str] = {
        side: str(rng.choice(["rest", "loose_fist", "lap"], p=[0.6, 0.15, 0.25])) for side in SIDES
    }
    for side, there in zip(SIDES, cast.exists, strict=True):
        if not there:
            idle[side] = "lap"
    begin = float(rng.uniform(-2.2, 0.1))
    table = Tabletop.begin(cast.person, rng, items, idle, begin)
    table.reach_y = (0.17, min(0.46, cast.room.table_size[1] - 0.1))
    acting = [a for a, there in zip(table.arms.values(), cast.exists, strict=True) if there]
    end = float(times[-1]) + 0.2
    helper = next((a for a in acting if a.side != cast.person.dominant), None)
    table_of = {**TRAIN, **OOD}
    options = {name: table_of[name] for name in preset.activities}
    together = [name for name in _BOTH_ARMS if name in options]
    if all(cast.exists) and together and rng.random() < 0.5:
        for name in rng.permutation(together):
            if _try(options[str(name)][0], table, acting[int(rng.integers(2))], cast.exists):
                break
    elif helper is not None:
        helper.free_at += float(rng.uniform(0.2, 3.0))
    while min(a.free_at for a in acting) < end:
        arm = min(acting, key=lambda a: a.free_at)
        _act(rng, table, arm, options, cast.exists)
    return table


def _act(
    rng: np.random.Generator,
    table: Tabletop,
    arm: Arm,
    options: dict[str, tuple[Activity, float]],
    exists: tuple[bool, bool],
) -> None:
    """One thing more for an arm: an activity, then perhaps rest, out of sight now and then."""
    names = list(options)
    weights = np.array([options[n][1] for n in names])
    order = rng.choice(len(names), len(names), replace=False, p=weights / weights.sum())
    start = arm.free_at
    for number in order:
        name = names[int(number)]
        if not all(exists) and name in _BOTH_ARMS:
            continue
        if _try(options[name][0], table, arm, exists):
            break
    else:
        arm.free_at = start + float(rng.uniform(0.3, 0.9))
        if arm.idle == "working":
            _rest(rng, table, arm)
        return
    arm.idle = "working"
    lazy = 0.35 if arm.side == table.person.dominant else 0.7
    if rng.random() < lazy:
        _rest(rng, table, arm)
    arm.free_at += float(rng.uniform(0.0, 0.35))


def _try(activity: Activity, table: Tabletop, arm: Arm, exists: tuple[bool, bool]) -> bool:
    """Do an activity unless it cannot be done, or hands would go through things."""
    mark, start = table.mark(), arm.free_at
    if activity(table, arm, start):
        times = np.arange(start, max(arm.free_at, start + 0.1), 0.08)
        if collisions(table, times, exists, 0).share <= _TOUCHING:
            return True
    table.back_to(mark)
    return False


def _rest(rng: np.random.Generator, table: Tabletop, arm: Arm) -> None:
    where = str(rng.choice(["rest", "loose_fist", "lap"], p=[0.55, 0.15, 0.30]))
    table.go_idle(arm, arm.free_at, where)
    wait = rng.uniform(0.2, 1.0) if arm.side == table.person.dominant else rng.uniform(0.4, 2.4)
    arm.free_at += float(wait)


def _lay(rng: np.random.Generator, preset: Preset, cast: _Cast) -> list[Item]:
    """Put things within reach, apart from each other, long ones lying across."""
    kinds = list(preset.kinds)
    if "bowl" in kinds and rng.random() < 0.6:
        first = [
            str(rng.choice(["bowl", "mug", "cup", "plate"])),
            str(rng.choice(["bottle", "can"])),
        ]
    elif "pan" in kinds:
        first = [str(rng.choice(["knife", "hammer", "screwdriver"]))]
    else:
        first = [str(rng.choice(["parcel", "bowl", "sponge"]))] if "parcel" in kinds else []
    weights = np.array([_LESS.get(kind, 1.0) for kind in kinds])
    count = int(rng.integers(4, 8))
    wanted = first + [str(k) for k in rng.choice(kinds, count, p=weights / weights.sum())]
    items: list[Item] = []
    painter = Painter(rng, preset)
    deepest = min(0.47, cast.room.table_size[1] - 0.08)
    for kind in wanted:
        colour, texture = painter.paint()
        thing = make_thing(kind, rng, texture, colour)
        large = "both" in thing.roles
        for _ in range(30):
            side = 1 if len(items) % 2 else -1
            x = rng.uniform(-0.08, 0.08) if large else side * rng.uniform(-0.04, 0.34)
            y = rng.uniform(0.17 + 0.3 * thing.radius, deepest)
            gaps = [np.hypot(*(o.at[:2] - (x, y))) - o.thing.radius - thing.radius for o in items]
            near = min(gaps, default=1.0)
            if near > (0.09 if large or any("both" in o.thing.roles for o in items) else 0.035):
                items.append(Item(thing, PoseTrack(standing(x, y, 0.0, _yaw(rng, thing, x)))))
                break
    return items


def _yaw(rng: np.random.Generator, thing: Thing, x: float) -> float:
    """How a thing stands: handles to the side, flat things as one works with them."""
    if thing.kind == "mug":
        return float(rng.uniform(-0.6, 0.6)) + (np.pi if rng.random() < 0.5 else 0.0)
    if thing.roles & {"both", "wipe", "slide", "press"} or thing.kind == "carton":
        return float(rng.normal(0, 0.22))
    if thing.roles & {"tool"} or thing.kind in ("marker", "spoon", "banana"):
        return float(np.sign(x) * -0.5 + rng.normal(0, 0.35))
    return float(rng.uniform(0, 2 * np.pi))


# ---------------------------------------------------------------------------- filming


def _film(
    rng: np.random.Generator,
    preset: Preset,
    cast: _Cast,
    table: Tabletop,
    times: Floats,
    seed: int,
    found: Collisions,
) -> World:
    fov_v, fov_h, size = _optics(rng, preset)
    sway = float(rng.uniform(*preset.sway))
    style = draw_style(rng, cast.person.eye, sway, fov_v, float(times[-1]) + 1 / MODEL_FPS)
    T_camera_from_work = _filmed(style, table, times, preset)
    turn = rng.uniform(0, 2 * np.pi)
    place = np.array([rng.uniform(-1, 1), rng.uniform(-1, 1), cast.room.table_height])
    T_world_from_work = np.asarray(
        rigid(np.asarray(rotvec_to_matrix(np.array([0, 0, turn]))), place)
    )
    poses = table.item_poses(times, seed)
    hands, forearms = _hands(cast, table, times, poses, T_camera_from_work, seed)
    bodies = [*cast.room.bodies]
    bodies += [Body(thing.mesh, T, True) for thing, T in cast.room.clutter]
    bodies += [posed(i.thing.mesh, T, True) for i, T in zip(table.items, poses, strict=True)]
    drift = 1 + rng.uniform(0, 0.12) * smooth_noise(rng, times, 1, 0.3)[:, 0]
    exposure = np.clip(drift * rng.uniform(0.8, 1.2), 0.5, 1.7)
    moved = tuple(Body(b.mesh, T_world_from_work @ b.T_world_from_body, b.movable) for b in bodies)
    return World(
        key=key_of(preset.name, seed),
        bodies=moved,
        lights=lights(rng),
        hands=Hands(
            hand_state=hands,
            exists=np.tile(np.array(cast.exists), (len(times), 1)),
            skin_colour=np.tile(cast.skin, (2, 1)),
            forearm_direction=forearms @ T_world_from_work[:3, :3].T,
            forearm_length_m=float(rng.uniform(0.24, 0.29)),
            sleeve=Painter(rng, preset).cloth() if rng.random() < 0.68 else None,
        ),
        T_camera_from_world=T_camera_from_work @ inverse(T_world_from_work),
        fov_vh_rad=(fov_v, fov_h),
        image_size_hw=size,
        exposure=exposure.astype(np.float32),
        text=_sentences(table, times, seed, preset.name),
        seed=seed,
        preset=preset.name,
        meta=_meta(cast, table, found),
    )


def _optics(rng: np.random.Generator, preset: Preset) -> tuple[float, float, tuple[int, int]]:
    """Fields of view (vertical, horizontal) and image size; no view is taller than the preset's."""
    low, high = np.deg2rad(preset.fov_h_deg[int(rng.integers(len(preset.fov_h_deg)))])
    tallest = np.tan(np.deg2rad(preset.fov_v_most_deg) / 2)
    widest = {size: 2 * float(np.arctan(tallest * size[1] / size[0])) for size in preset.sizes_hw}
    fitting = [size for size in preset.sizes_hw if widest[size] > low + 0.02]
    size = fitting[int(rng.integers(len(fitting)))]
    fov_h = float(on_grid(rng.uniform(low, min(high, widest[size])), FOV_STEPS))
    return 2 * float(np.arctan(np.tan(fov_h / 2) * size[0] / size[1])), fov_h, size


def _filmed(style: HeadStyle, table: Tabletop, times: Floats, preset: Preset) -> Floats:
    """The camera's path, livelier until it moves as much as the preset asks for."""
    strength = 1.0
    path = camera_path(style, table.gaze, times, strength)
    for _ in range(12):
        metres, degrees = median_steps(path) if len(times) > 1 else (np.inf, np.inf)
        if metres >= preset.least_step[0] and degrees >= preset.least_step[1]:
            break
        strength *= 1.15
        path = camera_path(style, table.gaze, times, strength)
    else:
        assert not any(preset.least_step), "no strength moves this camera enough"
    return path


def _hands(
    cast: _Cast,
    table: Tabletop,
    times: Floats,
    poses: list[Floats],
    T_camera_from_work: Floats,
    seed: int,
) -> tuple[NDArray[np.float32], Floats]:
    """Hand states (T, 2, 109) in the camera frame, and forearms (T, 2, 3) in the workplace."""
    wrists, angles = table.hands(times, poses, seed)
    states = np.asarray(absent((len(times), 2)))
    forearms = np.zeros((len(times), 2, 3))
    shape = np.tile(cast.person.proxy.shape_params, (len(times), 1))
    for h, side in enumerate(SIDES):
        seen = T_camera_from_work @ wrists[side]
        at = wrists[side][:, :3, 3]
        forearms[:, h] = cast.person.elbow(side, at) - at
        if cast.exists[h]:
            joints = joint_rotations(angles[side])
            state = HandState.from_matrices(seen[:, :3, 3], seen[:, :3, :3], joints, shape)
            states[:, h] = np.asarray(state.pack())
    forearms /= np.linalg.norm(forearms, axis=-1, keepdims=True)
    return states.astype(np.float32), forearms


def _sentences(table: Tabletop, times: Floats, seed: int, preset: str) -> tuple[TextSegment, ...]:
    """What was said, cut to the clip, in order."""
    out: list[TextSegment] = []
    for said in sorted(table.said, key=lambda s: (s.start, s.end, s.text)):
        start, end = (round(t * MODEL_FPS) for t in (said.start, said.end))
        start, end = max(start, 0), min(end, len(times))
        if end - start >= 2:
            name = f"{preset}-{seed:x}-{len(out)}"
            side: Any = said.side
            out.append(TextSegment(name, said.text, side, start, end))
    return tuple(out)


def _meta(cast: _Cast, table: Tabletop, found: Collisions) -> dict[str, Any]:
    person = cast.person
    sizes = {
        "table_height_m": cast.room.table_height,
        "eye_above_table_m": float(person.eye[2]),
        "hand_size": float(person.proxy.shape_params[0]),
    }
    return {
        "generator": f"{GENERATOR}.{REVISION}",
        "dominant": person.dominant,
        "hand_model": HandModel.template().name,
        "things": [item.thing.name for item in table.items],
        "collision_share": round(found.share, 4),
        "deepest_mm": round(1000 * found.deepest, 2),
        **{name: round(value, 4) for name, value in sizes.items()},
    }
