"""Things are closed, stand on the origin, and their normals point outwards."""

from collections.abc import Callable

import numpy as np
import pytest

from mint_hub.synth import meshes
from mint_hub.synth.primitives import normals_of
from mint_hub.synth.world import Mesh, Texture

PAINT = Texture("noise", (0.5, 0.5, 0.5), (0.4, 0.4, 0.4))

THINGS: dict[str, Callable[[], Mesh]] = {
    "box": lambda: meshes.box((0.1, 0.2, 0.3), PAINT),
    "rounded box": lambda: meshes.rounded_box((0.1, 0.2, 0.3), 0.02, PAINT),
    "cylinder": lambda: meshes.cylinder(0.03, 0.1, PAINT, bevel=0.003),
    "cone": lambda: meshes.cone(0.03, 0.1, PAINT),
    "ball": lambda: meshes.ball(0.05, PAINT),
    "fruit": lambda: meshes.fruit(0.04, PAINT),
    "cup": lambda: meshes.cup(0.04, 0.1, PAINT, taper=0.8),
    "bowl": lambda: meshes.bowl(0.08, 0.06, PAINT),
    "plate": lambda: meshes.plate(0.12, PAINT),
    "bottle": lambda: meshes.bottle(0.035, 0.25, PAINT),
    "jar": lambda: meshes.jar(0.04, 0.12, PAINT),
    "book": lambda: meshes.book((0.15, 0.2, 0.03), PAINT),
    "knife": lambda: meshes.knife(0.22, PAINT),
    "spoon": lambda: meshes.spoon(0.18, PAINT),
    "pan": lambda: meshes.pan(0.12, PAINT),
    "banana": lambda: meshes.banana(0.2, PAINT),
    "screwdriver": lambda: meshes.screwdriver(0.2, PAINT),
    "hammer": lambda: meshes.hammer(0.3, PAINT),
    "ring": lambda: meshes.ring(0.06, 0.015, PAINT),
    "star": lambda: meshes.star(0.05, 0.03, PAINT),
    "table": lambda: meshes.table((1.4, 0.8, 0.75), PAINT),
}
WITHOUT_ENDS = {"cup", "fruit", "pan"}
"""Handles and a stalk end inside the body they belong to, open."""


def corners(mesh: Mesh):
    return (mesh.vertices[mesh.faces[:, i]].astype(np.float64) for i in range(3))


def volume(mesh: Mesh) -> float:
    a, b, c = corners(mesh)
    return float((np.cross(a, b) * c).sum() / 6)


@pytest.mark.parametrize("name", THINGS)
def test_things_stand_on_the_origin_with_normals_outwards(name):
    mesh = THINGS[name]()
    assert mesh.vertices[:, 2].min() == pytest.approx(0.0, abs=2e-4)
    assert volume(mesh) > 0
    a, b, c = corners(mesh)
    normals = normals_of(mesh)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-5)
    assert ((np.cross(b - a, c - a) * normals[mesh.faces].mean(1)).sum(-1) > 0).all()
    assert len(mesh.uv) == len(mesh.vertices) == len(normals)
    assert np.isfinite(mesh.uv).all()


@pytest.mark.parametrize("name", sorted(set(THINGS) - WITHOUT_ENDS))
def test_things_are_closed(name):
    """Every edge has a triangle on either side, once vertices at one place are one."""
    mesh = THINGS[name]()
    _, same = np.unique(mesh.vertices.round(7), axis=0, return_inverse=True)
    faces = same.ravel()[mesh.faces]
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = edges[edges[:, 0] != edges[:, 1]]
    there, back = (np.unique(e, axis=0, return_counts=True) for e in (edges, edges[:, ::-1]))
    np.testing.assert_array_equal(there[0], back[0])
    np.testing.assert_array_equal(there[1], back[1])


def test_volumes_are_those_of_geometry():
    assert volume(THINGS["box"]()) == pytest.approx(0.006)
    assert volume(meshes.cylinder(0.03, 0.1, PAINT)) == pytest.approx(np.pi * 9e-5, rel=0.02)
    assert volume(THINGS["ball"]()) == pytest.approx(4 / 3 * np.pi * 1.25e-4, rel=0.03)
    assert volume(THINGS["ring"]()) == pytest.approx(2 * np.pi**2 * 0.06 * 0.015**2, rel=0.04)


def test_merging_and_moving_keep_shapes():
    a, b = THINGS["cup"](), meshes.lifted(THINGS["box"](), 1.0, 2.0, 3.0)
    both = meshes.merged("both", a, b)
    assert volume(both) == pytest.approx(volume(a) + volume(b), rel=1e-4)
    np.testing.assert_allclose(b.vertices.mean(0), [1.0, 2.0, 3.15], atol=1e-6)


def test_a_repeat_is_a_length():
    plane = meshes.plane((3.0, 2.0), PAINT, 0.5)
    np.testing.assert_allclose(np.ptp(plane.uv, axis=0), [6.0, 4.0])
    once = meshes.plane((3.0, 2.0), PAINT, None)
    np.testing.assert_allclose(np.ptp(once.uv, axis=0), 1.0)


def test_an_outline_that_hides_from_its_middle_is_refused():
    square = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float)
    with pytest.raises(ValueError, match="counter-clockwise and star-shaped"):
        meshes.prism(square[::-1], 0.1, PAINT)
