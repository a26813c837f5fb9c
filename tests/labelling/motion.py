"""Exact smooth two-hand motion seen from a moving head, to be spoilt by tests."""

import numpy as np

from mint_hub.geometry import hand_state, rigid
from mint_hub.geometry.rotations import rotvec_to_matrix


def wave(times, seed, size, channels):
    """Sum of three slow sines a channel, (T, channels)."""
    rng = np.random.default_rng(seed)
    frequency = rng.uniform(0.1, 0.6, (3, 1, channels))
    phase = rng.uniform(0, 2 * np.pi, (3, 1, channels))
    amplitude = rng.uniform(0.3, 1, (3, 1, channels)) * size / 3
    return (amplitude * np.sin(2 * np.pi * frequency * times[:, None] + phase)).sum(axis=0)


def exact_motion(frames=300, seed=0):
    """Return (hand_state (T, 2, 109) float32 camera frame, T_camera_from_world (T, 4, 4))."""
    times = np.arange(frames) / 30
    head = rigid.rigid(rotvec_to_matrix(wave(times, seed, 0.3, 3)), wave(times, seed + 1, 0.1, 3))
    T_camera_from_world = rigid.inverse(head)
    states = []
    for side, middle in enumerate(([-0.2, 0.1, 0.5], [0.2, 0.1, 0.5])):
        position = np.array(middle) + wave(times, seed + 2 + side, 0.15, 3)
        turn = rotvec_to_matrix(wave(times, seed + 4 + side, 0.8, 3))
        wrist = T_camera_from_world @ rigid.rigid(turn, position)
        fingers = rotvec_to_matrix(wave(times, seed + 6 + side, 0.6, 45).reshape(frames, 15, 3))
        shape = np.full((frames, 10), 0.1 * (side + 1))
        state = hand_state.HandState.from_matrices(
            wrist[:, :3, 3], wrist[:, :3, :3], fingers, shape
        )
        states.append(np.asarray(state.pack()))
    return np.stack(states, axis=1).astype(np.float32), T_camera_from_world
