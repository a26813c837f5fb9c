"""Signed distances: exact where a formula is known, and true to the meshes that are drawn."""

import numpy as np
import pytest

from mint_hub.synth.solids import Block, Raised, Rod, Turned, Union, gradient, turned
from mint_hub.synth.things import KINDS_OOD, KINDS_TRAIN, make_thing
from mint_hub.synth.world import Texture

POINTS = np.random.default_rng(1).uniform(-0.2, 0.2, (400, 3))
TEXTURE = Texture("noise", (0.5, 0.4, 0.3), (0.3, 0.3, 0.2))


def test_a_turned_half_circle_is_a_ball():
    angle = np.linspace(0, np.pi, 721)
    profile = [(0.1 * np.sin(a), -0.1 * np.cos(a)) for a in angle]
    distance = turned(profile).distance(POINTS)
    assert np.allclose(distance, np.linalg.norm(POINTS, axis=1) - 0.1, atol=2e-6)


def test_a_raised_square_is_a_block():
    half = 0.06
    square = ((-half, -half), (half, -half), (half, half), (-half, half))
    raised, block = Raised(square, 0.1), Block((2 * half, 2 * half, 0.1))
    assert np.allclose(raised.distance(POINTS), block.distance(POINTS))


def test_a_rod_is_a_turned_capsule():
    rod = Rod((0, 0, 0.02), (0, 0, 0.1), 0.02)
    angle = np.linspace(0, np.pi / 2, 361)
    low = [(0.02 * np.sin(a), 0.02 - 0.02 * np.cos(a)) for a in angle]
    high = [(0.02 * np.cos(a), 0.1 + 0.02 * np.sin(a)) for a in angle]
    capsule = Turned((*low, *high))
    assert np.allclose(rod.distance(POINTS), capsule.distance(POINTS), atol=2e-6)


def test_a_union_is_as_near_as_its_nearest_part():
    parts = Block((0.1, 0.1, 0.1)), Rod((0.1, 0, 0), (0.2, 0, 0), 0.01)
    both = Union(parts).distance(POINTS)
    assert np.array_equal(both, np.minimum(*(p.distance(POINTS) for p in parts)))


@pytest.mark.parametrize("kind", [*KINDS_TRAIN, *KINDS_OOD])
def test_solids_are_what_is_drawn(kind):
    """Vertices lie near the solid's surface; no distance is more than the way to a point."""
    for seed in range(3):
        thing = make_thing(kind, np.random.default_rng(seed), TEXTURE, "red")
        vertices = thing.mesh.vertices.astype(float)
        away = np.abs(thing.solid.distance(vertices))
        assert np.median(away) < 0.006, kind
        assert vertices[:, 2].min() > -1e-4
        assert np.hypot(*vertices[:, :2].T).max() < 1.3 * thing.radius + 0.005
        a, b = POINTS[:200], POINTS[200:]
        slope = np.abs(thing.solid.distance(a) - thing.solid.distance(b))
        assert (slope <= np.linalg.norm(a - b, axis=1) + 1e-9).all()
        assert thing.name.startswith("red ")


def test_gradient_points_away_from_the_surface():
    box = Block((0.1, 0.1, 0.1))
    up = gradient(box, np.array([[0.0, 0.0, 0.15], [0.0, 0.0, 0.09]]))
    assert np.allclose(up, [0, 0, 1])
