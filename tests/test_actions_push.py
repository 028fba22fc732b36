"""Where pushes begin, in every direction, and how they are put into words."""

import dataclasses
import math

import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax.actions import ActionConfig, ActionSpace, action_tables, no_action
from mechsearch_jax.actions.kinds.push import Push, object_pushes, push_starts
from mechsearch_jax.dynamics.push_model import LOW_CONTACT
from mechsearch_jax.geometry import footprints, superquadric, transforms
from mechsearch_jax.robot.gripper import Gripper
from mechsearch_jax.shapes import shape_of
from mechsearch_jax.workspace.shelf import Shelf

SHELF, CONFIG = Shelf(), ActionConfig()
SIDEWAYS = (math.pi / 2, -math.pi / 2)
TABLES = action_tables(Gripper(), CONFIG.push_wrists, CONFIG)
SHAPES = ("box", "cylinder")


def space_of(**changes):
    config = dataclasses.replace(CONFIG, **changes)
    return ActionSpace(SHELF, TABLES, Gripper(), config, math.pi / 4, 4)


def proposed(space, scene):
    return object_pushes(space, scene, footprints.footprints(scene), scene.valid)


STARTS = jax.jit(proposed)


def standing(shape, half, yaw, x=0.6, y=0.1):
    return superquadric.Superquadrics(
        size=jnp.float32([half]),
        exponents=jnp.float32([shape_of(shape).exponents]),
        position=jnp.float32([[x, y, SHELF.board + half[2]]]),
        rotation=transforms.yaw_rotation(jnp.float32([yaw])),
        valid=jnp.ones(1, bool),
    )


def half_size(shape, length, width, height):
    return (length, length, height) if shape == "cylinder" else (length, width, height)


sizes = st.tuples(st.floats(0.015, 0.08), st.floats(0.015, 0.08), st.floats(0.03, 0.1))
ALL_ROUND = space_of(push_directions=tuple(np.radians([90, -90, 0, 20, -35, 65, -75, 115, -130, 150, 180])))


@hypothesis.given(shape=st.sampled_from(SHAPES), sizes=sizes, yaw=st.floats(-np.pi, np.pi))
@hypothesis.settings(deadline=None, max_examples=40)
def test_pushes_begin_a_gap_away_from_their_object_and_most_meet_it_then(shape, sizes, yaw):
    half = half_size(shape, *sizes)
    scene = standing(shape, half, yaw)
    T = np.asarray(STARTS(ALL_ROUND, scene)[0][0], np.float64)
    heading = push_starts(ALL_ROUND.config, ALL_ROUND.wrists).heading
    c, s = np.cos(yaw), np.sin(yaw)
    meets = []
    for pose, way in zip(T, heading, strict=True):
        world = np.asarray(TABLES.pusher, np.float64) @ pose[:3, :3].T + pose[:3, 3]
        level = world[world[:, 2] < SHELF.board + 2 * half[2], :2] - np.asarray(scene.position[0, :2], np.float64)

        def inside(by, level=level, way=way):
            local = (level + by * way) @ np.array([[c, -s], [s, c]])
            return np.hypot(*local.T) < half[0] if shape == "cylinder" else (np.abs(local) < half[:2]).all(axis=1)

        assert (np.asarray(scene.position[0, :2]) - pose[:2, 3]) @ way > 0.0
        assert not any(inside(by).any() for by in np.linspace(0.0, CONFIG.push_gap - 1e-4, 6))
        meets.append(any(inside(by).any() for by in np.linspace(CONFIG.push_gap, 0.02, 21)))
    # Others graze the margin around the object, or a corner, first.
    assert np.mean(meets) > 0.5


@pytest.mark.parametrize("shape", SHAPES)
def test_pushes_of_the_paper_are_beside_the_object_at_two_depths(shape):
    half, yaw = half_size(shape, 0.03, 0.05, 0.08), 0.4
    scene = standing(shape, half, yaw)
    space = space_of(push_directions=SIDEWAYS)
    T, weight = STARTS(space, scene)
    assert T.shape == (1, 36, 4, 4)
    T = np.asarray(T[0]).reshape(2, 2, 3, 3, 4, 4)
    x, y, z = np.moveaxis(T[..., :3, 3], -1, 0)
    wide, along = (
        (half[0], half[0])
        if shape == "cylinder"
        else [abs(a * half[0]) + abs(b * half[1]) for a, b in ((np.cos(yaw), np.sin(yaw)), (np.sin(yaw), np.cos(yaw)))]
    )
    np.testing.assert_allclose(x[:, 0], 0.6 - wide + 0.02, atol=1e-6)
    np.testing.assert_allclose(x[:, 1], 0.6 + 0.02, atol=1e-6)
    assert (y[0] < 0.1 - half[0]).all()
    assert (y[1] > 0.1 + half[0]).all()
    limit = min(CONFIG.push_leverage[shape == "cylinder"] * along, 0.75 * 2 * half[2])
    np.testing.assert_allclose(z - SHELF.board, np.clip(limit, LOW_CONTACT, CONFIG.push_height), atol=1e-6)
    approach = np.arctan2(T[..., 1, 2], T[..., 0, 2])
    np.testing.assert_allclose(
        approach, np.broadcast_to(np.array(CONFIG.push_yaws)[:, None], approach.shape), atol=1e-6
    )
    # Whatever the wrist, the fingers are at the same place.
    np.testing.assert_array_equal(T, np.broadcast_to(T[:, :, :, :1], T.shape))
    starts = push_starts(space.config, space.wrists)
    np.testing.assert_array_equal(starts.wrist.reshape(12, 3), np.broadcast_to(np.arange(3), (12, 3)))
    np.testing.assert_array_equal(starts.heading, np.repeat(np.float32([[0, 1], [0, -1]]), 18, axis=0))
    assert set(np.unique(weight)) == {0.0, 1.0}


@pytest.mark.parametrize("shape", SHAPES)
def test_further_directions_come_after_the_papers_and_change_nothing_about_them(shape):
    scene = standing(shape, half_size(shape, 0.03, 0.05, 0.08), 0.4)
    few, many = (STARTS(space_of(push_directions=angles), scene) for angles in (SIDEWAYS, CONFIG.push_directions))
    assert many[0].shape[1] == 36 + 5 * len(CONFIG.push_offsets) * len(CONFIG.push_postures)
    for a, b in zip(few, many, strict=True):
        np.testing.assert_array_equal(a, b[:, :36])


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("turn", [0.3, 0.9])
def test_pushes_turn_with_the_object_and_the_hand(shape, turn):
    half = half_size(shape, 0.03, 0.05, 0.08)
    starts = []
    for angle in (0.0, turn):
        space = space_of(push_directions=(0.1 + angle,), push_postures=((angle - 0.5, 1), (angle, 2)))
        starts.append([np.asarray(a[0]) for a in STARTS(space, standing(shape, half, 0.2 + angle))])
    (T, stable), (turned, turned_stable) = starts
    centre = transforms.make(jnp.eye(3), jnp.float32([0.6, 0.1, 0.0]))
    about = transforms.make(transforms.yaw_rotation(jnp.float32(turn)), jnp.float32([0.6, 0.1, 0.0]))
    expected = transforms.compose(about, transforms.compose(transforms.inverse(centre), jnp.asarray(T)))
    np.testing.assert_allclose(turned, expected, atol=2e-6)
    np.testing.assert_array_equal(stable, turned_stable)


def test_pushes_are_the_same_with_and_without_compilation_and_in_a_batch():
    space = space_of(push_directions=(*SIDEWAYS, 0.0, -1.1), push_postures=((0.0, 0),))
    scenes = [standing("box", (0.03, 0.05, 0.08), 0.4), standing("cylinder", (0.03, 0.03, 0.06), 0.0, 0.5, -0.1)]
    one_by_one = [STARTS(space, scene) for scene in scenes]
    stacked = jax.tree.map(lambda *a: jnp.stack(a), *scenes)
    batch = jax.jit(jax.vmap(lambda scene: proposed(space, scene)))(stacked)
    for i, alone in enumerate(one_by_one):
        for a, b, c in zip(alone, jax.tree.map(lambda a, i=i: a[i], batch), proposed(space, scenes[i]), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-6)
            np.testing.assert_allclose(a, c, atol=1e-6)


@pytest.mark.parametrize(
    ("degrees", "words"),
    [
        (0, "forward"),
        (15, "forward"),
        (-35, "forward and to the right"),
        (65, "forward and to the left"),
        (90, "to the left"),
        (-90, "to the right"),
        (115, "back and to the left"),
        (180, "back"),
        (-180, "back"),
    ],
)
def test_a_push_tells_where_it_goes(degrees, words):
    angle = math.radians(degrees)
    way = 0.1 * jnp.float32([math.cos(angle), math.sin(angle), 0.0])
    action = no_action().replace(object=jnp.int32(2), displacement=way)
    assert Push().describe(action) == f"push object 2 by 10 cm {words}"
