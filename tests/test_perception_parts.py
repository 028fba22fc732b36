"""Segments that one superquadric does not explain become bodies of several; all others stay as they are."""

import itertools

import hypothesis.extra.numpy as arrays
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mechsearch_jax.envs.camera.recognisers import recogniser
from mechsearch_jax.envs.camera.snapshot import Snapshot
from mechsearch_jax.envs.scenes.household import body_at, standing_height, thing_of
from mechsearch_jax.envs.world.world import from_scenario
from mechsearch_jax.geometry.bodies import world_parts
from mechsearch_jax.geometry.superquadric import Superquadrics, gauge
from mechsearch_jax.perception.explanation import as_segmented
from mechsearch_jax.perception.parts.divisions import BOX, CYLINDER, ELLIPSOID, best_cut
from mechsearch_jax.perception.parts.in_parts import PartsConfig, depth_noise, in_parts
from mechsearch_jax.perception.parts.joining import join_floating, separate
from mechsearch_jax.perception.parts.unions import (
    Evidence,
    Table,
    UnionCosts,
    distance,
    entries,
    select_union,
    union_cost,
)
from mechsearch_jax.perception.recogniser import labelled
from mechsearch_jax.perception.recognition import ShapeNetwork
from mechsearch_jax.perception.refinement import RefinementConfig
from mechsearch_jax.shapes.compound import inside, solids
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import Body, Scenario, pieces_of, rotation_matrix
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

CAMERA, SHELF, TARGET = Camera(), Shelf(), Target.of("cylinder")
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
HIDDEN = Body("cylinder", TARGET.half_size, (0.7, -0.2, SHELF.board + TARGET.half_size[2]), UPRIGHT)


def thing(name, x, y, yaw=0.0):
    compound = thing_of(name).compound
    return body_at(compound, x, y, SHELF.board + standing_height(compound), yaw)


def plain(shape, half, x, y):
    return Body(shape, half, (x, y, SHELF.board + half[2]), UPRIGHT)


THINGS = (
    thing("wine-bottle", 0.55, -0.05),
    thing("teapot", 0.55, 0.3, 0.4),
    plain("box", (0.04, 0.03, 0.06), 0.55, 0.1),
)
PLAIN = (plain("box", (0.03, 0.05, 0.07), 0.55, -0.05), plain("cylinder", (0.03, 0.03, 0.06), 0.55, 0.2))


def seen(*bodies):
    """The labelled image of bodies, its view, and what one superquadric makes of each segment."""
    world = from_scenario(Scenario("parts", bodies, HIDDEN))
    snapshot = Snapshot(CAMERA, SHELF, world)
    view, keys, eyes = snapshot.view, jax.random.split(jax.random.key(2)), recogniser("masks", TARGET)
    image, _ = labelled(eyes.core, keys[0], CAMERA, view, SHELF, eyes.images(jax.random.key(1), snapshot))
    return image, view, as_segmented(keys, image, ShapeNetwork.of(), view.camera, SHELF, TARGET, RefinementConfig())


def recognised(bodies):
    image, view, base = seen(*bodies)
    return base, in_parts(image, base, view.camera, SHELF, PartsConfig())


def count(objects):
    return np.asarray(objects.parts.valid.sum(axis=1) * objects.valid)


def parts_of(objects, slot):
    return world_parts(jax.tree.map(lambda a: a[slot : slot + 1], objects))


def in_common(body, parts):
    """Intersection over union of a body's volume and that of parts in the world."""
    points = body.position + np.random.default_rng(0).uniform(-0.2, 0.2, (2**17, 3))
    local = (points - body.position) @ rotation_matrix(body.quaternion)
    whole = np.any([inside(piece, local) for piece in solids(pieces_of(body).pieces)], axis=0)
    held = np.zeros_like(whole)
    for i in np.flatnonzero(parts.valid):
        there = jnp.asarray((points - np.asarray(parts.position[i])) @ np.asarray(parts.rotation[i]), jnp.float32)
        held |= np.asarray(gauge(parts.size[i], parts.exponents[i], there)) <= 1.0
    return (whole & held).sum() / (whole | held).sum()


@pytest.fixture(scope="module")
def household():
    return recognised(THINGS)


@pytest.mark.slow
def test_a_bottle_and_a_teapot_are_described_better_by_parts(household):
    base, found = household
    assert (count(found.objects)[:2] > 1).all()
    for slot, body in enumerate(THINGS[:2]):
        one, several = (in_common(body, parts_of(each.objects, slot)) for each in (base, found))
        assert several > max(one + 0.02, 0.85)
    assert (found.confidence[:2] > base.confidence[:2]).all()


@pytest.mark.slow
def test_what_one_superquadric_explains_stays_as_it_is_to_the_bit(household):
    base, found = household
    assert count(found.objects).tolist()[2:] == [1] + [0] * 5
    for before, after in zip(
        jax.tree.leaves(base.objects), jax.tree.leaves(found.objects.replace(parts=None)), strict=True
    ):
        np.testing.assert_array_equal(before[2:], after[2:])
    np.testing.assert_array_equal(base.confidence[2:], found.confidence[2:])
    np.testing.assert_array_equal(base.measures.misfit[2:], found.measures.misfit[2:])


@pytest.mark.slow
def test_a_scene_of_boxes_and_cylinders_is_the_same_with_and_without_parts():
    base, found = recognised(PLAIN)
    assert count(found.objects).tolist() == [1, 1] + [0] * 6
    for before, after in zip(
        jax.tree.leaves(base), jax.tree.leaves(found.replace(objects=found.objects.replace(parts=None))), strict=True
    ):
        np.testing.assert_array_equal(before, after)
    only = jax.tree.map(lambda a: a[:, 0], found.objects.parts)
    np.testing.assert_array_equal(only.size[:2], base.objects.size[:2])
    assert not only.position.any()


@pytest.mark.slow
def test_a_segment_that_floats_is_another_ones_where_bodies_are_joined():
    """A bottle whose neck is a segment of its own: with `join_floating` both are one body, else each has a slot."""
    image, view, _ = seen(thing("wine-bottle", 0.55, -0.05))
    high = (image.labels == 0) & (image.points[..., 2] > SHELF.board + 0.2)
    assert 20 < int(jnp.sum(high)) < int(jnp.sum(image.labels == 0))
    divided = image.replace(labels=jnp.where(high, 1, image.labels).astype(image.labels.dtype))
    keys = jax.random.split(jax.random.key(2))
    base = as_segmented(keys, divided, ShapeNetwork.of(), view.camera, SHELF, TARGET, RefinementConfig())
    assert np.asarray(base.objects.valid)[:2].all()
    config = PartsConfig(rounds=1, refits=1, points=128, rays=128)

    def none_floats(parts, evidence, board):
        return join_floating(parts, evidence, board + 1.0)

    ways = (separate, join_floating, none_floats)
    kept, joined, other = (in_parts(divided, base, view.camera, SHELF, config, joining) for joining in ways)
    assert np.asarray(kept.objects.valid)[:2].tolist() == [True, True]
    np.testing.assert_array_equal(kept.labels, divided.labels)
    assert np.asarray(joined.objects.valid)[:2].tolist() == [True, False]
    assert joined.labels.dtype == divided.labels.dtype
    np.testing.assert_array_equal(joined.labels == 0, divided.labels >= 0)
    assert np.asarray(joined.changed)[0]
    assert np.asarray(joined.confidence)[1] == 0.0
    assert np.sum(np.asarray(joined.objects.parts.valid)[0]) >= 2
    np.testing.assert_array_equal(other.labels, kept.labels)
    np.testing.assert_array_equal(other.objects.parts.valid, kept.objects.parts.valid)


@pytest.mark.slow
def test_bodies_of_parts_are_the_same_alone_traced_and_in_a_batch():
    (image, view, base), (other, _, plain_base) = seen(*THINGS), seen(*PLAIN)
    config = PartsConfig(rounds=1, refits=1, points=128, rays=128)

    def run(image, base):
        return in_parts(image, base, view.camera, SHELF, config)

    alone = [run(image, base), run(other, plain_base)]
    traced = jax.jit(run)(image, base)
    pair = jax.tree.map(lambda a, b: jnp.stack([jnp.asarray(a), jnp.asarray(b)]), (image, base), (other, plain_base))
    batch = jax.jit(jax.vmap(run))(*pair)
    for one, again in zip(jax.tree.leaves(alone[0]), jax.tree.leaves(traced), strict=True):
        np.testing.assert_allclose(one, again, atol=2e-4)
    for i, one in enumerate(alone):
        np.testing.assert_array_equal(count(one.objects), count(jax.tree.map(lambda a, i=i: a[i], batch).objects))
        for first, second in zip(jax.tree.leaves(one.objects), jax.tree.leaves(batch.objects), strict=True):
            np.testing.assert_allclose(first, second[i], atol=2e-3)


SELECT, COST = (jax.jit(of, static_argnames="costs") for of in (select_union, union_cost))
SIZES = st.tuples(*[st.floats(0.01, 0.1)] * 3)


def solid(size, exponents):
    turn = jnp.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    fields = (jnp.array([size]), jnp.array([exponents]), jnp.array([[0.5, 0.1, 0.3]]), turn[None], jnp.array([True]))
    return Superquadrics(*fields)


@settings(max_examples=30, deadline=None)
@given(SIZES, arrays.arrays(np.float64, (16, 3), elements=st.floats(-1, 1)))
def test_points_on_an_ellipsoid_have_no_distance_and_the_sign_says_the_side(size, directions):
    directions = np.where(np.linalg.norm(directions, axis=1, keepdims=True) > 0.1, directions, [[0.0, 0.6, 0.8]])
    ball = solid(size, ELLIPSOID)
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)

    def at(scale):
        world = scale * unit * np.array(size) @ np.asarray(ball.rotation[0], float).T + np.asarray(
            ball.position[0], float
        )
        return np.asarray(distance(ball, jnp.asarray(world, jnp.float32))[0])

    np.testing.assert_allclose(at(1.0), 0.0, atol=1e-5)
    assert (at(1.1) > 0).all()
    assert (at(0.9) < 0).all()


@settings(max_examples=30, deadline=None)
@given(
    SIZES,
    st.sampled_from([BOX, CYLINDER, ELLIPSOID]),
    arrays.arrays(np.float64, (8, 3), elements=st.floats(-0.05, 0.05)),
)
def test_rays_enter_at_the_surface(size, exponents, towards):
    one, origin = solid(size, exponents), jnp.array([-0.4, 0.0, 0.5])
    directions = jnp.asarray(towards, jnp.float32) + one.position - origin[None]
    enter = np.asarray(entries(one, origin, directions, 0.0)[0])
    points = np.asarray(origin) + np.where(np.isfinite(enter), enter, 0.0)[:, None] * np.asarray(directions)
    off = np.asarray(distance(one, jnp.asarray(points))[0])
    np.testing.assert_allclose(off[np.isfinite(enter)], 0.0, atol=1e-4)
    through = np.asarray(distance(one, jnp.asarray(directions + origin[None]))[0]) < -1e-4
    assert np.isfinite(enter[through]).all()


def evidence(points, rays, pixels=1000.0):
    zero = jnp.zeros
    return Evidence(
        zero((points, 3)), jnp.full(points, pixels / points), zero(3), zero((rays, 3)), zero(rays), 1.0, pixels, 0.0
    )


@settings(max_examples=20, deadline=None)
@example(np.ones((6, 12)), np.zeros((6, 10), bool), 0)
@given(
    arrays.arrays(np.float64, (6, 12), elements=st.floats(0, 1)),
    arrays.arrays(bool, (6, 10)),
    st.integers(0, 5),
)
def test_the_union_is_no_worse_than_any_one_or_two_and_costs_what_is_said(misfit, through, first):
    table, costs, of = Table(jnp.asarray(misfit, jnp.float32), jnp.asarray(through)), UnionCosts(), evidence(12, 10)
    slots, cost = SELECT(table, jnp.array([first, 6, 6, 6]), of, costs)

    def price(chosen):
        return float(COST(table, jnp.isin(jnp.arange(6), jnp.array(chosen)), of, costs))

    chosen = sorted({int(slot) for slot in slots} - {6})
    assert chosen
    assert float(cost) == pytest.approx(price(chosen), abs=0.1)
    best = min(price(group) for size in (1, 2) for group in itertools.combinations(range(6), size))
    assert float(cost) <= best + 0.1


def test_a_step_is_found_where_it_is():
    along = jnp.linspace(0.0, 0.2, 200)
    features = jnp.where(along < 0.13, 0.0, 0.03)[:, None]
    cut = best_cut(along, features, jnp.ones(200, bool))
    assert float(cut) == pytest.approx(0.13, abs=0.01)
    assert not np.isfinite(best_cut(along, features, jnp.arange(200) < 2))


def test_the_noise_of_the_depth_is_measured_on_the_segments_alone():
    image, _, base = seen(*PLAIN)
    # 1 mm in a random direction.
    assert 0.0004 < float(depth_noise(image, base.labels)) < 0.0009
    assert float(depth_noise(image, jnp.full_like(base.labels, -2))) == 0.0
