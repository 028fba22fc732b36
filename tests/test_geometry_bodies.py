"""Bodies of several parts: they are hit and seen where any part is, whatever the order of the parts."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mechsearch_jax.existence import ExistenceConfig, object_windows
from mechsearch_jax.geometry import bodies, superquadric
from mechsearch_jax.geometry.collision import clouds_of, collisions
from mechsearch_jax.geometry.footprints import footprints
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import exponential, make, transform, yaw_rotation
from mechsearch_jax.robot.arm_hits import arm_hits
from mechsearch_jax.robot.kinematics import HOME
from mechsearch_jax.workspace import render
from mechsearch_jax.workspace.camera import Camera

COARSE = Camera().scaled(7)
WINDOW = ExistenceConfig().window
BOX, CYLINDER = (0.2, 0.2), (0.2, 1.0)
seeds = st.integers(0, 2**31 - 1)
quick = settings(deadline=None, max_examples=8)


def drawn(seed, bodies_count=3, parts=3):
    """Bodies of upright and tilted parts on the board, some of them absent, the last body altogether."""
    rng = np.random.default_rng(seed)
    shape = (bodies_count, parts)
    turn = np.float32(rng.uniform(-0.6, 0.6, (*shape, 3)))
    size = np.float32(rng.uniform(0.01, 0.05, (*shape, 3)))
    exponents = np.float32(np.array([BOX, CYLINDER, (1.0, 1.0)])[rng.integers(0, 3, shape)])
    position = np.float32(rng.uniform(-0.05, 0.05, (*shape, 3)))
    valid = (rng.random(shape) < 0.7) & (np.arange(bodies_count) < bodies_count - 1)[:, None]
    place = np.float32(rng.uniform([0.5, -0.1, 0.45], [0.7, 0.3, 0.5], (bodies_count, 3)))
    return composed(size, exponents, position, turn, valid, place, np.float32(rng.uniform(-3, 3, bodies_count)))


@jax.jit
def composed(size, exponents, position, turn, valid, place, yaw):
    """Bodies at places in the world, of parts that are turned by vectors within them."""
    parts = Superquadrics(size, exponents, position, jax.vmap(jax.vmap(exponential))(turn), valid)
    return bodies.bodies_of(parts, place, yaw_rotation(yaw))


def permuted(scene, seed):
    order = np.random.default_rng(seed).permutation(scene.parts.capacity)
    return scene.replace(parts=jax.tree.map(lambda a: jnp.asarray(np.asarray(a)[:, order]), scene.parts))


# Operations that run one by one are each compiled alone; these are called with many scenes.
bodies_of, world_parts, any_part, prints = map(
    jax.jit, (bodies.bodies_of, bodies.world_parts, bodies.any_part, footprints)
)
with_parts, surfaces = (jax.jit(function, static_argnums=1) for function in (bodies.with_parts, bodies.surfaces))
depth, gauge = jax.jit(partial(render.render_depth, COARSE)), jax.jit(superquadric.gauge)
support, sample_surface = jax.jit(superquadric.support), jax.jit(superquadric.sample_surface, static_argnums=2)
to_object_frame, surface_of = jax.jit(superquadric.to_object_frame), jax.jit(bodies.surface_of, static_argnums=2)


def single(seed):
    """Bodies of one superquadric each."""
    return world_parts(drawn(seed, parts=1))


CLOUDS = clouds_of(jnp.float32(np.random.default_rng(0).uniform(-0.02, 0.02, (2, 3, 64))))
CLOUD = np.arange(40) % 2
PLACES = make(
    jnp.broadcast_to(jnp.eye(3), (40, 3, 3)),
    jnp.float32(np.random.default_rng(1).uniform([0.45, -0.15, 0.4], [0.75, 0.35, 0.55], (40, 3))),
)


@jax.jit
def hits(scene):
    mask = jnp.broadcast_to(scene.valid[None], (len(CLOUD), scene.capacity))
    return collisions(CLOUDS, CLOUD, PLACES, scene, mask)


@jax.jit
def windows(scene):
    return object_windows(COARSE, scene, scene.valid, WINDOW, block=8)


@jax.jit
def touched(scene):
    """Hits of the arm, and of shapes that are larger and smaller."""
    q = jnp.stack([jnp.float32(HOME) + 0.4 * k * jnp.array([0.0, 1.0, 0.0, 0.5, 0.0, 0.0, 0.0]) for k in range(5)])
    return arm_hits(q, scene), hits(bodies.enlarged(scene, 0.01)), hits(bodies.slimmed(scene, 0.01, 0.5))


def same(a, b):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-5, atol=1e-5), a, b)


@quick
@given(seeds)
@pytest.mark.slow
def test_one_part_changes_no_hit_view_or_footprint(seed):
    scene = single(seed)
    split = with_parts(scene, bodies.PARTS)
    assert split.parts.capacity == bodies.PARTS
    for answer in (hits, touched, windows):
        same(answer(scene), answer(split))
    same(prints(scene), prints(split).replace(parts=None))
    same(depth(scene), depth(split))


@quick
@given(seeds)
def test_identical_parts_are_one(seed):
    scene = single(seed)
    # As many parts as the bodies of the other tests, with which it shares what is compiled.
    twice = with_parts(scene, 3)
    twice = twice.replace(parts=jax.tree.map(lambda a: jnp.asarray(np.asarray(a)[:, [0, 0, 0]]), twice.parts))
    for answer in (hits, touched, windows, lambda some: np.asarray(surfaces(some, 64))[:-1]):
        same(answer(scene), answer(twice))
    again = bodies_of(twice.parts, twice.position, twice.rotation)
    again, scene = jax.device_get((again, scene))
    for name in ("size", "exponents", "position", "rotation"):
        np.testing.assert_allclose(getattr(again, name)[scene.valid], getattr(scene, name)[scene.valid], atol=1e-6)


@quick
@given(seeds, seeds)
def test_the_order_of_parts_does_not_count(seed, other):
    scene = drawn(seed)
    swapped = permuted(scene, other)
    for answer in (hits, touched, windows, prints):
        a, b = answer(scene), answer(swapped)
        same(*(x.replace(parts=None) if answer is prints else x for x in (a, b)))
    again = bodies_of(swapped.parts, swapped.position, swapped.rotation)
    same(again.replace(parts=None), scene.replace(parts=None))


@quick
@given(seeds)
def test_a_body_is_hit_and_seen_as_its_parts_are_one_by_one(seed):
    scene = drawn(seed)
    # Far apart, too.
    wide = scene.replace(parts=scene.parts.replace(position=3.0 * np.asarray(scene.parts.position)))
    for body in (scene, wide):
        alone = world_parts(body)
        np.testing.assert_array_equal(hits(body), any_part(body, hits(alone)))
        np.testing.assert_array_equal(touched(body)[0], any_part(body, touched(alone)[0]))
        same(depth(body), depth(alone))


@quick
@given(seeds, st.sampled_from((0.0, 1.0, 1e3)))
def test_what_absent_parts_hold_does_not_count(seed, value):
    scene = drawn(seed)
    there = np.asarray(scene.parts.valid)

    def with_value(field):
        return np.where(there.reshape(*there.shape, *[1] * (field.ndim - 2)), field, np.float32(value))

    fields = {name: with_value(getattr(scene.parts, name)) for name in ("size", "position", "rotation")}
    other = scene.replace(parts=scene.parts.replace(**fields))
    assert not there.all()
    for answer in (hits, touched, windows, prints):
        a, b = answer(scene), answer(other)
        same(*(x.replace(parts=None) if answer is prints else x for x in (a, b)))
    same(depth(scene), depth(other))


def test_a_window_shows_what_the_whole_image_shows_of_a_body():
    scene = drawn(5)
    shown = windows(scene)
    assert int(jnp.max(shown.stride)) == 1
    same(render.merge_windows(COARSE, shown), depth(scene))


@quick
@given(seeds)
def test_a_body_lies_within_its_bounding_superquadric(seed):
    scene = drawn(seed, parts=2)
    points = np.asarray(surfaces(scene, 200))
    scene = jax.device_get(scene)
    outermost = gauge(scene.size[:, None], scene.exponents[:, None], points)
    # To a per cent, or the rounded edges of a box.
    assert np.all(np.where(scene.valid[:, None], outermost, 0.0) < 1.13)
    reach = np.max(np.abs(points), axis=1)[scene.valid]
    assert np.all(reach <= scene.size[scene.valid] + 1e-6)
    np.testing.assert_array_equal(scene.valid, np.any(scene.parts.valid, axis=1))


def two_parts(first, second):
    """A body of two parts, given by half-extents, exponents and places."""
    size, exponents, position = (np.float32([a, b]) for a, b in zip(first, second, strict=True))
    turn = np.broadcast_to(np.eye(3, dtype=np.float32), (2, 3, 3))
    parts = Superquadrics(size, exponents, position, turn, np.ones(2, bool))
    return bodies_of(parts, np.zeros(3, np.float32), np.eye(3, dtype=np.float32))


def test_a_bottle_is_bounded_by_a_cylinder_and_a_mug_by_a_box():
    body = ((0.03, 0.03, 0.06), CYLINDER, (0.0, 0.0, 0.0))
    bottle = two_parts(body, ((0.012, 0.012, 0.03), CYLINDER, (0.0, 0.0, 0.08)))
    np.testing.assert_allclose(bottle.exponents, CYLINDER)
    np.testing.assert_allclose(bottle.size, (0.03, 0.03, 0.085), atol=1e-6)
    np.testing.assert_allclose(bottle.position, (0.0, 0.0, 0.025), atol=1e-6)
    mug = two_parts(body, ((0.02, 0.006, 0.03), BOX, (0.045, 0.0, 0.0)))
    np.testing.assert_allclose(mug.exponents, BOX)
    np.testing.assert_allclose(mug.size, (0.0475, 0.03, 0.06), atol=1e-6)


def test_parts_move_with_their_body():
    scene = drawn(3)
    T = make(yaw_rotation(jnp.float32(0.7)), jnp.float32([0.1, -0.2, 0.05]))
    place = transform(T, scene.position)
    turn = jnp.einsum("ij,njk->nik", T[:3, :3], scene.rotation, precision="highest")
    moved = world_parts(scene.replace(position=place, rotation=turn))
    still = world_parts(scene)
    np.testing.assert_allclose(moved.position, transform(T, still.position), atol=1e-6)


def test_parts_that_there_are_share_the_points_of_a_body():
    scene = jax.device_get(drawn(7))
    points, valid = np.asarray(surfaces(scene, 96)), scene.parts.valid
    assert not valid[:2].all()
    assert valid[:2].any(axis=1).all()
    for i in range(2):
        own = jax.tree.map(lambda a, i=i: a[i], scene.parts)
        local = to_object_frame(own, points[i])
        near = np.abs(np.asarray(gauge(own.size, own.exponents, local)) - 1.0) < 1e-3
        np.testing.assert_array_equal(near[:, valid[i]].sum(axis=0) >= 96 // valid[i].sum(), True)
        assert near[:, valid[i]].any(axis=1).all()
        np.testing.assert_array_equal(surface_of(scene, np.int32(i), 96), points[i])
    np.testing.assert_allclose(np.asarray(surfaces(permuted(scene, 0), 96))[:2], points[:2], atol=1e-6)


def test_bodies_fill_slots_as_superquadrics_do():
    scene = drawn(6)
    padded = superquadric.pad(scene, 8)
    assert padded.parts.size.shape == (8, 3, 3)
    assert not np.any(padded.parts.valid[3:])
    same(hits(padded)[:, :3], hits(scene))
    sharp = scene.replace(parts=scene.parts.replace(exponents=jnp.full((3, 3, 2), 0.1)))
    assert float(jnp.min(superquadric.standard_edges(sharp).parts.exponents)) == pytest.approx(0.2)


@quick
@given(seeds)
def test_a_superquadric_reaches_as_far_as_its_farthest_point(seed):
    rng = np.random.default_rng(seed)
    size, e = np.float32(rng.uniform(0.02, 0.1, 3)), np.float32(rng.uniform(0.2, 1.8, 2))
    way = rng.normal(size=3)
    way = np.float32(way / np.linalg.norm(way))
    farthest = float(np.max(np.asarray(sample_surface(size, e, 20_000)) @ way))
    reach = float(support(size, e, way))
    assert reach == pytest.approx(farthest, rel=0.01)
    assert reach >= farthest * (1 - 1e-5)
    np.testing.assert_allclose(support(size[None], e[None], np.eye(3, dtype=np.float32)), size, rtol=1e-6)


def test_the_part_between_the_fingers_is_found():
    handle = ((0.02, 0.006, 0.03), BOX, (0.045, 0.0, 0.0))
    mug = two_parts(((0.03, 0.03, 0.06), CYLINDER, (0.0, 0.0, 0.0)), handle)
    scene = jax.tree.map(lambda a: a[None], mug)
    at = lambda point: bodies.grasped_shape(scene, jnp.int32(0), jnp.float32(point))  # noqa: E731
    np.testing.assert_allclose(at((0.055, 0.0, 0.0)).exponents, BOX)
    np.testing.assert_allclose(at((-0.01, 0.0, 0.02)).exponents, CYLINDER)
