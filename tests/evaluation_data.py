"""Truth and predictions for the tests of evaluation, and known ways to spoil them."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from mint_hub.geometry import hand_state as hands
from mint_hub.geometry import rigid
from mint_hub.loaders.schema import Episode
from tests.episodes import make_episode


def true_episode(number: int, num_frames: int = 60) -> Episode:
    """An episode whose camera does not zoom."""
    made = make_episode(num_frames, seed=number, key=f"clip-{number}")
    return replace(made, fov_vh_rad=np.tile(made.fov_vh_rad[:1], (num_frames, 1)))


def save_all(episodes, folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for episode in episodes:
        episode.save(folder / f"{episode.key}.npz")
    return folder


def moved(episode: Episode, metres: float) -> Episode:
    """Hands too far by so many metres along z."""
    state = episode.hand_state.copy()
    state[..., 2] += np.where(episode.presence, metres, 0)
    return replace(episode, hand_state=state)


def noisy(episode: Episode, metres: float, seed: int = 0) -> Episode:
    """Wrists and camera centres with noise."""
    rng = np.random.default_rng(seed)
    state = episode.hand_state.copy()
    state[..., :3] += rng.normal(0, metres, state[..., :3].shape) * episode.presence[..., None]
    T = np.array(episode.T_world_from_camera)
    T[:, :3, 3] += rng.normal(0, metres, (len(T), 3))
    return replace(episode, hand_state=state, T_camera_from_world=np.asarray(rigid.inverse(T)))


def without_hands(episode: Episode) -> Episode:
    return replace(
        episode,
        hand_state=hands.absent(episode.presence.shape),
        presence=np.zeros_like(episode.presence),
    )
