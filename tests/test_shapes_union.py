"""The union of a compound's pieces: distances, cuts and support against float64 references of single pieces."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_workspace_target import BOTTLE, CUP, TEE

from mechsearch_jax.shapes import PRIMITIVES, union
from mechsearch_jax.shapes.compound import CONVEX, Compound, Piece, centred, faces, half_extents, inside, mesh, solids
from mechsearch_jax.shapes.solid import solid_of, surface
from mechsearch_jax.shapes.union import field_of

LEANING = (math.cos(0.3), 0.0, math.sin(0.3), 0.0)
OCTAHEDRON = tuple(tuple(0.03 * s * (i == j) for j in range(3)) for i in range(3) for s in (1.0, -1.0))
MIXED = (
    Piece("capsule", (0.015, 0.015, 0.05), (0.0, 0.0, 0.0), LEANING),
    Piece("ellipsoid", (0.03, 0.02, 0.015), (0.02, 0.01, 0.03)),
    Piece(CONVEX, (0.0, 0.0, 0.0), (-0.03, 0.0, 0.02), vertices=OCTAHEDRON),
    Piece("box", (0.01, 0.02, 0.03), (0.0, 0.03, -0.02), LEANING),
)
COMPOUNDS = {
    name: centred(Compound(pieces, 600.0, 0.5))[0]
    for name, pieces in {"bottle": BOTTLE, "cup": CUP, "tee": TEE, "mixed": MIXED}.items()
}
everyone = pytest.mark.parametrize("compound", COMPOUNDS.values(), ids=COMPOUNDS.keys())


def components(points):
    return [points[..., i] for i in range(3)]


def cut_of(piece, origin, direction):
    """Where rays enter one piece, float64."""
    R, t = piece.rotation, np.array(piece.position)
    start, along = (origin - t) @ R, direction @ R
    if piece.shape != CONVEX:
        return PRIMITIVES[piece.shape].cut(list(start.T), list(along.T), np.array(piece.half_size), np)
    near, far = np.full(len(start), -np.inf), np.full(len(start), np.inf)
    for *normal, offset in faces(piece):
        speed, gap = along @ normal, offset - start @ normal
        near = np.where(speed < 0, np.maximum(near, gap / speed), near)
        far = np.where(speed > 0, np.minimum(far, gap / speed), far)
    return np.where((near <= far) & (near > 0), near, np.inf)


@everyone
def test_a_ray_enters_where_it_enters_the_first_piece(compound):
    rng = np.random.default_rng(0)
    origin = rng.normal(size=(2000, 3))
    origin *= 0.6 / np.linalg.norm(origin, axis=1, keepdims=True)
    direction = rng.uniform(-0.08, 0.08, (2000, 3)) - origin
    expected = np.min([cut_of(piece, origin, direction) for piece in solids(compound.pieces)], axis=0)
    found = union.cut(compound, components(origin), components(direction), 0.0, np)
    assert np.isfinite(expected).sum() > 200
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    single = jax.jit(lambda o, d: union.cut(compound, components(o), components(d), 0.0, jnp))
    found = np.asarray(single(jnp.float32(origin), jnp.float32(direction)))
    both = np.isfinite(found) & np.isfinite(expected)
    # In single precision rays along an edge may miss it.
    assert (np.isfinite(found) != np.isfinite(expected)).mean() < 0.002
    np.testing.assert_allclose(found[both], expected[both], atol=1e-4)
    larger, smaller = (union.cut(compound, components(origin), components(direction), by, np) for by in (3e-3, -3e-3))
    assert np.all((larger <= found + 1e-4) | ~np.isfinite(found))
    assert np.all(smaller >= expected - 1e-9)


@everyone
def test_distance_is_the_least_of_the_pieces(compound):
    points = np.random.default_rng(1).uniform(-0.1, 0.1, (3000, 3))
    away = union.distance(compound, components(points), np)
    within = np.any([inside(piece, points) for piece in solids(compound.pieces)], axis=0)
    assert 30 < within.sum() < 2900
    assert np.array_equal(away < 0, within)
    function = lambda points: union.distance(compound, components(points), jnp)  # noqa: E731
    single = np.asarray(jax.jit(function)(jnp.float32(points)))
    np.testing.assert_allclose(single, away, atol=1e-5)
    np.testing.assert_allclose(np.asarray(function(jnp.float32(points))), single, atol=1e-6)
    one = jax.vmap(lambda point: union.distance(compound, [point[i] for i in range(3)], jnp))
    np.testing.assert_allclose(np.asarray(one(jnp.float32(points))), single, atol=1e-6)
    slope = jax.vmap(jax.grad(lambda p: union.distance(compound, [p[i] for i in range(3)], jnp)))(jnp.float32(points))
    assert np.isfinite(np.asarray(slope)).all()
    on_it = surface(compound, 800)
    np.testing.assert_allclose(union.distance(compound, components(on_it), np), 0.0, atol=8e-4)
    np.testing.assert_allclose(field_of(compound).at(on_it), 0.0, atol=2e-3)


@everyone
@settings(max_examples=20, deadline=None)
@given(yaw=st.floats(-4.0, 4.0), seed=st.integers(0, 1000))
def test_distance_and_cut_turn_with_the_body(compound, yaw, seed):
    c, s = math.cos(yaw), math.sin(yaw)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    turn = (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))

    def turned(piece):
        quaternion = multiplied(turn, piece.quaternion)
        return Piece(piece.shape, piece.half_size, tuple((R @ piece.position).tolist()), quaternion, piece.vertices)

    rotated = Compound(tuple(turned(piece) for piece in compound.pieces), compound.density, compound.friction)
    points = np.random.default_rng(seed).uniform(-0.1, 0.1, (100, 3))
    away = union.distance(compound, components(points), np)
    np.testing.assert_allclose(union.distance(rotated, components(points @ R.T), np), away, atol=1e-6)
    origin = np.array([[-0.7, 0.1, 0.3]])
    direction = points - origin
    expected = union.cut(compound, components(origin), components(direction), 0.0, np)
    found = union.cut(rotated, components(origin @ R.T), components(direction @ R.T), 0.0, np)
    # A ray along an edge may miss it.
    assert (np.isfinite(found) == np.isfinite(expected)).mean() > 0.98
    both = np.isfinite(found) & np.isfinite(expected)
    np.testing.assert_allclose(found[both], expected[both], atol=1e-5)


def multiplied(a, b):
    """The product of two quaternions (w, x, y, z)."""
    w, x, y, z = a
    p, q, r, s = b
    return (
        w * p - x * q - y * r - z * s,
        w * q + x * p + y * s - z * r,
        w * r - x * s + y * p + z * q,
        w * s + x * r - y * q + z * p,
    )


@everyone
def test_support_and_outline_contain_all_of_it(compound):
    solid = solid_of(compound, half_extents(compound))
    corners = np.concatenate([np.asarray(mesh(piece).vertices) for piece in solids(compound.pieces)])
    directions = np.random.default_rng(2).normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    against, along = solid.extent(directions, np)
    outermost = (corners @ directions.T).max(axis=0)
    assert np.all(along >= outermost - 1e-9)
    # Meshes of round pieces lie inside of them.
    np.testing.assert_allclose(along, outermost, atol=1e-3)
    np.testing.assert_allclose(against, (corners @ -directions.T).max(axis=0), atol=1e-3)
    rim = solid.rim()
    following = np.roll(rim, -1, axis=0)
    normal = np.stack([(following - rim)[:, 1], -(following - rim)[:, 0]], axis=1)
    outside = np.einsum("pri,ri->pr", corners[:, None, :2] - rim[None], normal)
    assert outside.max() <= 1e-6
    assert solid.bottom == pytest.approx(-corners[:, 2].min(), abs=1e-3)
    assert solid.breadth <= np.linalg.norm(rim, axis=1).max()
