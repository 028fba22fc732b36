"""Stacks: what carries something is not moved before it, and what is on top is an object like others."""


import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from mechsearch_jax.geometry.footprints import footprints, supports
from mechsearch_jax.geometry.superquadric import EDGE_EXPONENT, Superquadrics, pad

BOARD = 0.4045
SUPPORTS = jax.jit(lambda scene: supports(footprints(scene)))


def turn(yaw=0.0, tilt=0.0):
    """A rotation by a tilt about y, then by a yaw."""
    c, s, d, t = np.cos(yaw), np.sin(yaw), np.cos(tilt), np.sin(tilt)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.array([[d, 0, t], [0, 1, 0], [-t, 0, d]])


def scene_of(*bodies, capacity=5):
    """Bodies of (half-extents, x, y, lowest point above the board, rotation, whether round)."""
    half, x, y, low, rotation, is_round = (list(rows) for rows in zip(*bodies, strict=True))
    half, rotation = np.float32(half), np.float32(rotation)
    tall = np.abs(rotation[:, 2]) * half
    # Of a round body that leans, its circle's reach.
    reach = np.where(is_round, np.hypot(tall[:, 0], tall[:, 1]), tall[:, 0] + tall[:, 1]) + tall[:, 2]
    return pad(
        Superquadrics(
            size=jnp.array(half),
            exponents=jnp.array([[EDGE_EXPONENT, 1.0 if r else EDGE_EXPONENT] for r in is_round], jnp.float32),
            position=jnp.array(np.column_stack([x, y, BOARD + np.array(low) + reach]), jnp.float32),
            rotation=jnp.array(rotation),
            valid=jnp.ones(len(half), bool),
        ),
        capacity,
    )


def pairs(scene):
    return {(int(i), int(j)) for i, j in np.argwhere(SUPPORTS(scene))}


def box(half, x, y, low=0.0, yaw=0.0, tilt=0.0):
    return half, x, y, low, turn(yaw, tilt), False


def test_each_of_three_carries_the_next():
    tower = [box((0.04, 0.03, 0.03), 0.6, 0.1), box((0.03, 0.03, 0.02), 0.61, 0.1, 0.06, 0.4)]
    can = (0.025, 0.025, 0.03), 0.6, 0.09, 0.1, turn(), True
    assert pairs(scene_of(*tower, can, box((0.03, 0.03, 0.06), 0.6, 0.18))) == {(0, 1), (1, 2)}
    # Recognised a little too high or too low; and one that lies across two.
    assert pairs(scene_of(tower[0], box((0.03, 0.03, 0.02), 0.61, 0.1, 0.067))) == {(0, 1)}
    assert pairs(scene_of(tower[0], box((0.03, 0.03, 0.02), 0.61, 0.1, 0.053))) == {(0, 1)}
    bridge = box((0.02, 0.12, 0.01), 0.6, 0.175, 0.06)
    assert pairs(scene_of(tower[0], box((0.04, 0.03, 0.03), 0.6, 0.25), bridge)) == {(0, 2), (1, 2)}


def test_what_has_its_lowest_point_on_the_board_or_hangs_beside_is_carried_by_nothing():
    low, tall = box((0.04, 0.03, 0.03), 0.6, 0.1), box((0.02, 0.02, 0.1), 0.545, 0.1, 0.0, 0.0, 0.4)
    # It leans on the box, and its footprint is over it; a thin book, and another that is recognised into it.
    assert pairs(scene_of(low, tall)) == set()
    assert pairs(scene_of(box((0.05, 0.05, 0.004), 0.6, 0.1), box((0.05, 0.05, 0.004), 0.64, 0.1, 0.002))) == set()
    assert pairs(scene_of(low, box((0.03, 0.03, 0.02), 0.6, 0.159, 0.06))) == set()
    assert pairs(scene_of(low, box((0.03, 0.03, 0.02), 0.6, 0.1, 0.08))) == set()
    gone = scene_of(low, box((0.03, 0.03, 0.02), 0.6, 0.1, 0.06))
    assert pairs(gone) == {(0, 1)}
    assert pairs(gone.replace(valid=gone.valid.at[0].set(False))) == set()


numbers = st.floats(0.0, 1.0, width=32)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(*[numbers] * 7, st.booleans()), min_size=2, max_size=5), numbers, numbers, numbers)
def test_stacks_do_not_depend_on_where_and_how_turned_the_scene_is(rows, yaw, x, y):
    bodies = []
    for half_x, half_y, half_z, at_x, at_y, low, own, is_round in rows:
        half = 0.02 + 0.03 * np.array([half_x, half_x if is_round else half_y, half_z])
        # Heights that are not at the edge of what counts.
        heights = [0.0, *(2 * b[0][2] + b[3] for b in bodies), *(2 * b[0][2] + b[3] + 0.02 for b in bodies)]
        foot = heights[min(int(low * len(heights)), len(heights) - 1)]
        bodies.append((half, 0.1 * at_x, 0.1 * at_y, foot, turn(3.0 * own), is_round))
    scene, R = scene_of(*bodies), np.float32(turn(6.3 * yaw))
    moved = scene.replace(
        position=scene.position @ R.T + jnp.array([[x, y, 0.0]]), rotation=jnp.array(R)[None] @ scene.rotation
    )
    both = np.stack([SUPPORTS(s) for s in (scene, moved)])
    # Shortest way out of each other by 64-bit projections, as polygons of many corners.
    clear = np.abs(overlap(bodies) - 0.004) > 2e-3
    feet = np.array([b[3] for b in bodies])
    tops = feet + 2 * np.array([b[0][2] for b in bodies])
    near = np.abs(np.abs(feet[None] - tops[:, None]) - 0.01) > 1e-4
    n = len(bodies)
    np.testing.assert_array_equal(*(b[:n, :n] & clear & near for b in both))
    upon = (np.abs(feet[None] - tops[:, None]) < 0.01) & (overlap(bodies) > 0.004)
    upon &= feet[None] > (0.5 * (feet + tops))[:, None]
    exact = clear & near & ~np.logical_or.outer(*[[b[5] for b in bodies]] * 2)
    np.testing.assert_array_equal(both[0][:n, :n] & exact, upon & exact)
    assert pairs(scene_of(*((*b[:3], 0.0, *b[4:]) for b in bodies))) == set()


def overlap(bodies):
    """How far each pair of footprints overlaps at least in any of 720 directions."""
    angles = np.arange(720) * np.pi / 720
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    directions = np.concatenate([directions, *(b[4][:2, :2].T for b in bodies)])
    reach = []
    for half, *_, rotation, is_round in bodies:
        along = np.abs(directions @ rotation[:2, :2]) * half[:2]
        reach.append(np.hypot(*along.T) if is_round else along.sum(axis=1))
    at = np.array([[b[1], b[2]] for b in bodies]) @ directions.T
    reach = np.array(reach)
    return (reach[:, None] + reach[None] - np.abs(at[:, None] - at[None])).min(axis=-1)
