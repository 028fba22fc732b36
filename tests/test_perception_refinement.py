"""Refinement of wrong shapes on rendered images, and its parts against dense float64 references."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from published import published_scenarios
from scipy.spatial.transform import Rotation

from mechsearch_jax.envs.camera import simulated_camera
from mechsearch_jax.envs.world import world
from mechsearch_jax.geometry.superquadric import sample_surface
from mechsearch_jax.geometry.transforms import matmul, yaw_rotation
from mechsearch_jax.images.noise import TimeOfFlight, measured_depth
from mechsearch_jax.perception import refinement, scores
from mechsearch_jax.perception.refinement import RefinementConfig
from mechsearch_jax.shapes import shape_of
from mechsearch_jax.workspace.camera import Camera, back_project, pixel_rays, project
from mechsearch_jax.workspace.scenario import Body, Scenario, load_scenario
from mechsearch_jax.workspace.shelf import Shelf

CAMERA, SHELF = Camera().scaled(3), Shelf()
# For guesses as bad as `disturbed` makes them.
ROUGH = RefinementConfig.rough()
TURNED = (0.924, 0.0, 0.0, 0.383)
LYING = (0.7071068, 0.0, 0.7071068, 0.0)
TARGET = Body("cylinder", (0.02, 0.02, 0.05), (0.7, -0.2, 0.4545), (1.0, 0.0, 0.0, 0.0))
SCENE = Scenario(
    "scene",
    (
        Body("box", (0.054, 0.025, 0.054), (0.55, 0.22, 0.4585), TURNED),
        Body("cylinder", (0.034, 0.034, 0.107), (0.66, 0.06, 0.5115), TURNED),
        Body("box", (0.042, 0.018, 0.035), (0.52, -0.06, 0.4395), (0.866, 0.0, 0.0, 0.5)),
        Body("cylinder", (0.028, 0.028, 0.06), (0.66, -0.1, 0.4325), LYING),
        Body("box", (0.022, 0.078, 0.096), (0.68, 0.28, 0.5005), TURNED),
    ),
    TARGET,
)


def disturbed(truth, rng, size=0.07, position=0.004, yaw=5.0):
    """Recognition as it may be: wrong half-extents, centres and headings."""
    shape = truth.size.shape
    scale = np.exp(rng.normal(0, size, shape))
    scale[..., 1] = np.where(truth.exponents[..., 1] > 0.5, scale[..., 0], scale[..., 1])
    turn = yaw_rotation(jnp.asarray(np.radians(rng.normal(0, yaw, shape[:-1])), jnp.float32))
    return truth.replace(
        size=truth.size * jnp.asarray(scale, jnp.float32),
        position=truth.position + jnp.asarray(rng.normal(0, position, shape), jnp.float32),
        rotation=matmul(turn, truth.rotation),
    )


def measured(scenarios, rng, noise):
    """Points, labels and depths of scenes, and the true superquadrics; noise along random directions, as in B.1."""
    worlds = [world.from_scenario(s) for s in scenarios]
    images = [simulated_camera.observe(CAMERA, w) for w in worlds]
    depth = np.stack([i.depth for i in images])
    labels = np.stack([i.segmentation for i in images]).reshape(len(worlds), -1).astype(np.int32)
    points = np.stack([back_project(CAMERA, i.depth) for i in images]).reshape(len(worlds), -1, 3)
    direction = rng.normal(size=points.shape)
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    points = points + noise * rng.normal(size=(*points.shape[:-1], 1)) * direction
    along = (points - np.array(CAMERA.position)) @ np.array(CAMERA.rotation)[:, 2]
    depth = np.where(np.isfinite(depth), along.reshape(depth.shape), np.inf)
    truth = jax.tree.map(lambda *a: jnp.stack(a), *map(world.true_superquadrics, worlds))
    return jnp.asarray(points, jnp.float32), jnp.asarray(labels), jnp.asarray(depth, jnp.float32), truth


@functools.cache
def refiner(config=ROUGH):
    """Refines scenes one by one, so that one compiled function serves any number of them."""
    one = functools.partial(refinement.refine, CAMERA, SHELF, config=config)

    def each(*arrays):
        count = len(arrays[-1])
        results = [one(*jax.tree.map(lambda a, i=i: a[i], arrays)) for i in range(count)]
        return jax.tree.map(lambda *a: jnp.stack(a), *results)

    return each


def iou(scene, truth):
    return np.array(scores.intersection_over_union(scene, scores.sharpened(truth)))


@pytest.mark.parametrize(("noise", "least"), [pytest.param(0.0, 0.95, marks=pytest.mark.slow), (0.001, 0.93)])
def test_visible_objects_are_refined_to_their_true_shapes(noise, least):
    rng = np.random.default_rng(0)
    points, labels, depth, truth = measured([SCENE] * 6, rng, noise)
    guess = disturbed(truth, rng)
    refined = refiner()(guess, points, labels, depth)
    valid = np.array(truth.valid)
    before, after = iou(guess, truth)[valid], iou(refined.scene, truth)[valid]
    assert before.mean() < 0.8
    assert after.mean() > least
    assert after.min() > 0.75
    error = np.array(scores.centre_error(refined.scene, truth))[valid]
    assert np.median(error) < 0.0015
    assert np.all(np.array(refined.cost)[valid] < np.array(refined.initial_cost)[valid])
    # The lying cylinder stays lying, and everything else upright.
    up = np.abs(np.array(refined.scene.rotation)[..., 2, 2])
    assert np.all(up[:, 3] < 0.05)
    assert np.all(up[:, [0, 1, 2, 4]] > 0.9998)


@pytest.mark.parametrize(
    ("axis", "place", "stays"),
    [
        (0, SHELF.back - 0.001, True),
        (0, SHELF.back + 0.001, False),
        (0, SHELF.front - 0.05, True),
        (0, SHELF.front - 0.07, False),
        (1, SHELF.right - 0.001, False),
        (1, SHELF.left + 0.001, False),
        (2, SHELF.board - 0.003, True),
        (2, SHELF.board - 0.005, False),
        (2, SHELF.ceiling + 0.001, False),
    ],
)
def test_an_object_whose_centre_is_outside_of_the_shelf_is_none(axis, place, stays):
    """Without points of its own it stays where it was guessed."""
    points, labels, depth, truth = measured([SCENE], np.random.default_rng(0), 0.001)
    guess = truth.replace(position=truth.position.at[:, 1, axis].set(place))
    refined = refiner()(guess, points, jnp.where(labels == 1, -1, labels), depth)
    expected = np.array(truth.valid)
    expected[:, 1] = stays
    np.testing.assert_array_equal(refined.scene.valid, expected)


def test_a_guess_that_reaches_below_the_board_ends_on_it():
    points, labels, depth, truth = measured([SCENE], np.random.default_rng(0), 0.001)
    guess = truth.replace(position=truth.position.at[:, 1, 2].add(-0.05), size=truth.size.at[:, 1, 2].add(0.05))
    refined = refiner()(guess, points, labels, depth).scene
    # In float64, from the fitted shape's axes.
    size, R, place = (np.asarray(a[0, 1], float) for a in (refined.size, refined.rotation, refined.position))
    lowest = place[2] - np.abs(R[2]) @ size
    assert abs(lowest - SHELF.board) < 0.002


@pytest.mark.skipif(not published_scenarios(), reason="the published scenes are not beside this checkout")
@pytest.mark.slow
def test_published_scenes_with_noise():
    """Every object with at least 100 pixels at 1280 x 720, however hidden."""
    rng = np.random.default_rng(1)
    scenarios = [load_scenario(path) for path in published_scenarios()[5::8]]
    points, labels, depth, truth = measured(scenarios, rng, 0.001)
    guess = disturbed(truth, rng, size=0.1, position=0.005)
    refined = refiner()(guess, points, labels, depth)
    pixels = np.stack([np.sum(np.array(labels) == k, axis=1) for k in range(8)], axis=1)
    seen = np.array(truth.valid) & (pixels * 9 >= 100)
    assert seen.sum() > 50
    assert iou(guess, truth)[seen].mean() < 0.75
    assert iou(refined.scene, truth)[seen].mean() > 0.88


@pytest.mark.slow
def test_stray_points_do_not_undo_a_good_guess():
    """A time-of-flight camera's pixels at edges measure a mixture of what is before and behind; the network knows."""
    rng = np.random.default_rng(10)
    points, labels, depth, truth = measured([SCENE] * 4, rng, 0.0)
    sensor, keys = jax.jit(functools.partial(TimeOfFlight(), camera=CAMERA)), jax.random.split(jax.random.key(0), 4)
    points = jnp.stack([sensor(k, depth=d) for k, d in zip(keys, depth, strict=True)])
    seen = jax.vmap(functools.partial(measured_depth, CAMERA))(depth, points)
    guess = disturbed(truth, rng, size=0.015, position=0.001, yaw=1.0)
    valid = np.array(truth.valid)
    before = iou(guess, truth)[valid]
    after, rough = (
        iou(refiner(config)(guess, points.reshape(4, -1, 3), labels, seen).scene, truth)[valid]
        for config in (RefinementConfig(), ROUGH)
    )
    assert 0.85 < before.mean() < 0.95
    assert after.mean() > before.mean() + 0.01
    assert np.quantile(after - before, 0.1) > -0.02
    # What weak priors and a wide loss make of it.
    assert rough.mean() < after.mean() - 0.02


def test_a_wrong_class_is_noticed():
    rng = np.random.default_rng(2)
    points, labels, depth, truth = measured([SCENE], rng, 0.001)
    guess = disturbed(truth, rng, yaw=0.0)
    exponents = jnp.where(
        (truth.exponents[..., 1:] > 0.5),
        jnp.array(shape_of("box").exponents),
        jnp.array(shape_of("cylinder").exponents),
    )
    refined = refiner()(guess.replace(exponents=exponents), points, labels, depth)
    cylinder = np.array([h[1] > 0.5 for h in RefinementConfig().hypotheses])[np.array(refined.hypothesis)]
    clearly = [0, 1, 2, 4]
    np.testing.assert_array_equal(cylinder[0, clearly], [False, True, False, False])


def test_absent_objects_and_those_without_points_stay_as_they_are():
    rng = np.random.default_rng(3)
    points, labels, depth, truth = measured([SCENE], rng, 0.0)
    guess = disturbed(truth, rng)
    few = np.flatnonzero(labels[0] == 2)[5:]
    labels = labels.at[0, few].set(-1)
    guess = guess.replace(valid=guess.valid.at[0, 1].set(False))
    refined = refiner()(guess, points, jnp.where(labels == 0, -1, labels), depth)
    for slot in (0, 1, 2, 5, 7):
        for a, b in zip(jax.tree.leaves(refined.scene), jax.tree.leaves(guess), strict=True):
            np.testing.assert_array_equal(a[0, slot], b[0, slot])
    assert not np.allclose(refined.scene.size[0, 4], guess.size[0, 4])
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(refined.scene))
    # Nothing at all is measured: nothing moves, and nothing is NaN.
    blind = refiner()(guess, jnp.full_like(points, jnp.nan), labels * 0 - 1, jnp.full_like(depth, jnp.nan))
    for a, b in zip(jax.tree.leaves(blind.scene), jax.tree.leaves(guess), strict=True):
        np.testing.assert_array_equal(a, b)
    assert jnp.all(jnp.isfinite(blind.cost))


@pytest.mark.slow
def test_rays_bound_what_no_point_bounds():
    """A tall box is guessed 3 cm too high above what is hidden of nothing: its points end, and rays pass above."""
    rng = np.random.default_rng(4)
    points, labels, depth, truth = measured([SCENE], rng, 0.0)
    guess = truth.replace(size=truth.size.at[0, 2, 2].add(0.012), position=truth.position.at[0, 2, 2].add(0.012))
    # Points of the top face are withheld, so that only rays can tell.
    top = points[0, :, 2] > SHELF.board + 0.06
    labels = jnp.where(top[None] & (labels == 2), -1, labels)
    height = []
    for config in (ROUGH, RefinementConfig.rough(ray_noise=1e3, hypotheses=())):
        refined = refiner(config)(guess, points, labels, depth)
        height.append(float(refined.scene.size[0, 2, 2]))
    # Without hypotheses the exponents stay.
    np.testing.assert_array_equal(refined.scene.exponents, guess.exponents)
    assert abs(height[0] - 0.035) < 0.002
    assert height[1] > 0.04


@pytest.mark.slow
def test_reverse_gradients_are_finite():
    rng = np.random.default_rng(6)
    points, labels, depth, truth = measured([SCENE], rng, 0.001)
    guess = jax.tree.map(lambda a: a[0], disturbed(truth, rng))
    config = RefinementConfig(stages=((2, 0.01),), points=32, rays=32)

    def total(size, points):
        refined = refinement.refine(CAMERA, SHELF, guess.replace(size=size), points, labels[0], depth[0], config)
        return jnp.sum(refined.scene.size) + jnp.sum(refined.scene.position)

    seen = jnp.where(jnp.isfinite(points[0]), points[0], 0.0)
    for gradient in jax.grad(total, argnums=(0, 1))(guess.size, seen):
        assert jnp.all(jnp.isfinite(gradient))
        assert jnp.any(gradient != 0)


@pytest.mark.parametrize("exponents", [(0.06, 0.06), (0.2, 1.0)])
def test_jacobian_of_the_distance_is_that_of_finite_differences(exponents):
    rng = np.random.default_rng(7)
    shape = refinement._Shape(
        log_size=jnp.log(jnp.array([0.03, 0.05, 0.08])),
        position=jnp.array([0.6, 0.1, 0.5]),
        rotation=jnp.asarray(Rotation.random(random_state=rng).as_matrix(), jnp.float32),
        exponents=jnp.array(exponents),
    )
    local = sample_surface(jnp.exp(shape.log_size), shape.exponents, 60) * 1.05
    points = local @ shape.rotation.T + shape.position[None]
    distance, jacobian = jax.jit(refinement._distances)(shape, points)

    def first_order(step):
        """The gauge at the moved shape, over the gradient's length at the shape itself."""
        moved = refinement._moved(shape, step)
        size = jnp.exp(moved.log_size)
        return refinement._value_and_gradient(
            size, shape.exponents, refinement._local(moved, points - moved.position[None])
        )[0]

    _, gradient = jax.jit(refinement._value_and_gradient)(jnp.exp(shape.log_size), shape.exponents, local)
    expected = jax.jit(jax.jacfwd(first_order))(jnp.zeros(9)) / jnp.linalg.norm(gradient, axis=1)[:, None]
    np.testing.assert_allclose(jacobian, expected, atol=2e-3)
    assert jnp.all(distance > 0)


@pytest.mark.parametrize("exponents", [(0.06, 0.06), (0.2, 1.0)])
def test_support_and_closest_approach_are_those_of_dense_samples(exponents):
    rng = np.random.default_rng(8)
    shape = refinement._Shape(
        log_size=jnp.log(jnp.array([0.03, 0.05, 0.08])),
        position=jnp.array([0.6, 0.1, 0.5]),
        rotation=jnp.asarray(Rotation.random(random_state=rng).as_matrix(), jnp.float32),
        exponents=jnp.array(exponents),
    )
    surface = np.array(sample_surface(jnp.exp(shape.log_size), shape.exponents, 100_000)) @ np.array(shape.rotation).T
    for direction in ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)):
        reach = float(refinement._support(shape, direction))
        assert np.max(surface @ direction) == pytest.approx(reach, abs=6e-4)

    (row, column), _ = project(CAMERA, shape.position)
    around = jnp.arange(-25.0, 26.0, 5.0)
    directions = pixel_rays(CAMERA, *jnp.meshgrid(row + around, column + around)).reshape(-1, 3)
    free = jnp.asarray(rng.uniform(0.5, 1.2, len(directions)), jnp.float32)
    evidence = refinement._Evidence(directions, free, directions, free, free, 1.0)
    origin = jnp.array(CAMERA.position)
    points = jax.jit(refinement._closest_approach)(shape, origin, evidence)
    depth = np.linspace(0, 1, 4000)[:, None] * np.array(free)
    dense = np.array(origin) + depth[..., None] * np.array(directions)

    @jax.jit
    def gauge(world_points):
        local = refinement._local(shape, jnp.asarray(world_points, jnp.float32) - shape.position[None])
        return refinement._value_and_gradient(jnp.exp(shape.log_size), shape.exponents, local)[0]

    least = np.min(np.array(gauge(dense[::8].reshape(-1, 3))).reshape(-1, len(directions)), axis=0)
    reached = np.array(gauge(points))
    inside = least < 1.2
    assert inside.sum() > 10
    assert np.all(reached[inside] < least[inside] + 0.01)


def test_points_are_selected_evenly():
    labels = jnp.asarray(np.tile([0, 1, 2, 2], 500))
    index, weight = refinement.select(labels, jnp.int32(2), 100)
    assert jnp.all(weight == 1)
    assert jnp.all(labels[index] == 2)
    assert len(np.unique(index)) == 100
    assert np.max(np.diff(np.sort(index))) < 80
    index, weight = refinement.select(labels, jnp.int32(1), 600)
    assert jnp.sum(weight) == 500
    np.testing.assert_array_equal(np.sort(index[:500]), np.flatnonzero(labels == 1))
    assert jnp.sum(refinement.select(labels, jnp.int32(7), 100)[1]) == 0
