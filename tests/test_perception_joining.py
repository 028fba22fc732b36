"""Recognised bodies that float are joined to those that they touch."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mechsearch_jax.geometry import superquadric
from mechsearch_jax.geometry.bodies import PARTS
from mechsearch_jax.perception.parts.joining import FLOATS, TOUCHES, join_floating
from mechsearch_jax.perception.parts.unions import Evidence

BOARD = 0.4
SIDE = 0.02


def cubes(*places, parts=1):
    """Bodies of upright cubes at x and at heights of their undersides above the board, with points all over them."""
    n = len(places)
    scene = superquadric.empty(n, PARTS)
    there = np.zeros((n, PARTS), bool)
    there[:, :parts] = True
    centres = np.zeros((n, PARTS, 3), np.float32)
    for i, (x, low) in enumerate(places):
        centres[i] = x, 0.0, BOARD + low + SIDE
    size = np.full((n, PARTS, 3), SIDE, np.float32)
    pieces = scene.parts.replace(
        valid=there, position=centres, size=size, exponents=np.full((n, PARTS, 2), 0.2, np.float32)
    )
    side = np.linspace(-SIDE, SIDE, 9)
    grid = np.stack(np.meshgrid(side, side, side, indexing="ij"), axis=-1).reshape(-1, 3)
    shell = grid[np.max(np.abs(grid), axis=1) > SIDE - 1e-6].astype(np.float32)
    points = centres[:, :1] + shell[None]
    count = points.shape[1]
    evidence = Evidence(
        points=points,
        point_weight=np.ones((n, count), np.float32),
        origin=np.zeros((n, 3), np.float32),
        directions=np.ones((n, 1, 3), np.float32),
        free=np.zeros((n, 1), np.float32),
        ray_weight=np.ones(n, np.float32),
        pixels=np.full(n, float(count), np.float32),
        exact=np.full(n, 0.002, np.float32),
    )
    return jax.tree.map(jnp.asarray, (pieces, evidence))


def owners(*places, parts=1):
    after, owner = join_floating(*cubes(*places, parts=parts), BOARD)
    return after, np.asarray(owner).tolist()


def test_a_piece_that_stands_on_another_one_belongs_to_it():
    after, owner = owners((0.0, 0.0), (0.2, 0.0), (0.0, 2 * SIDE + 0.5 * TOUCHES))
    assert owner == [0, 1, 0]
    assert np.sum(np.asarray(after.valid), axis=1).tolist() == [2, 1, 0]
    heights = np.sort(np.asarray(after.position)[0, :2, 2])
    np.testing.assert_allclose(heights, BOARD + SIDE + np.array([0.0, 2 * SIDE + 0.5 * TOUCHES]), atol=1e-6)


def test_what_stands_or_touches_nothing_stays_as_it_is():
    for places in (
        ((0.0, 0.0), (2 * SIDE + 0.5 * TOUCHES, 0.0)),
        ((0.0, 0.0), (0.0, 2 * SIDE + 2 * TOUCHES)),
        ((0.0, 0.0), (2 * SIDE + 0.5 * TOUCHES, 0.5 * FLOATS)),
    ):
        before = cubes(*places)[0]
        after, owner = owners(*places)
        assert owner == list(range(len(places)))
        jax.tree.map(np.testing.assert_array_equal, after, before)


def test_a_tower_is_one_body_whatever_its_order():
    step = 2 * SIDE + 0.5 * TOUCHES
    for order in ((0, 1, 2), (2, 1, 0), (1, 2, 0)):
        after, owner = owners(*((0.0, k * step) for k in order))
        assert len(set(owner)) == 1
        assert np.sum(np.asarray(after.valid)) == 3


@settings(deadline=None, max_examples=10)
@given(st.lists(st.tuples(st.floats(0.0, 0.3), st.floats(0.0, 0.2)), min_size=3, max_size=3))
@pytest.mark.slow
def test_eager_compiled_and_batched_agree(places):
    arguments = cubes(*places)
    eager = join_floating(*arguments, BOARD)
    compiled = jax.jit(join_floating)(*arguments, jnp.float32(BOARD))
    batched = jax.vmap(join_floating, in_axes=(0, 0, None))(*jax.tree.map(lambda a: a[None], arguments), BOARD)
    for other in (compiled, jax.tree.map(lambda a: a[0], batched)):
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), eager, other)
    # What is joined stays so.
    parts, owner = jax.device_get(eager)
    assert all(owner[owner[i]] == owner[i] for i in range(len(places)))
    assert [bool(parts.valid[i].any()) for i in range(len(places))] == [owner[i] == i for i in range(len(places))]
