"""What was not measured: it rules no pose out, frees no place, and nothing is moved through it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import mechsearch_jax as ms
from mechsearch_jax import planner
from mechsearch_jax.actions import ActionKind
from mechsearch_jax.actions.kinds.nothing import no_action
from mechsearch_jax.actions.unseen_space import BORDER
from mechsearch_jax.belief.belief import sweeps_unmeasured
from mechsearch_jax.belief.impasse import impasse
from mechsearch_jax.envs.camera.simulated_camera import observe
from mechsearch_jax.envs.world.world import TARGET, from_scenario
from mechsearch_jax.geometry.superquadric import empty, pad
from mechsearch_jax.images.cloud import thinned_view, view
from mechsearch_jax.images.measured import measured_share, sampled, share_step
from mechsearch_jax.observation import Observation
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import example_scenarios, load_scenario, superquadrics

SCENE = load_scenario(example_scenarios()["first-light"])
IMAGES = ms.example_images()
# Stands in front of the target, which is hidden behind it alone.
FRONT = 0


def seen(problem, objects, depth=IMAGES.depth):
    """An observation of objects in a depth image, without the target."""
    rays = thinned_view(problem.camera, problem.shelf)
    share = measured_share(problem.camera, rays, rays.of(jnp.asarray(depth, jnp.float32)))
    return Observation(objects, jnp.array(False), jnp.zeros(3), measured=share)


@pytest.fixture(scope="module")
def whole(problem):
    """All objects, everything measured."""
    return seen(problem, pad(superquadrics(SCENE.objects), 8))


@pytest.fixture(scope="module")
def holed(problem):
    """The object in front has no depth, and is not recognised."""
    depth = np.where(IMAGES.mask == FRONT, 0.0, IMAGES.depth)
    return seen(problem, pad(superquadrics(SCENE.objects[FRONT + 1 :]), 8), depth)


def look(problem, observation, belief=None, *last):
    return planner.update_belief(problem, belief or planner.initial_belief(problem), observation, *last)


def nearest(problem, position):
    return int(np.argmin(np.linalg.norm(np.asarray(problem.poses)[:, :2] - np.asarray(position)[:2], axis=1)))


def cell(problem, position):
    """Row and column of a place in the raster of the board."""
    first = np.asarray(problem.poses)[0, :2] - BORDER * np.asarray(problem.cell)
    return tuple(np.round((np.asarray(position)[:2] - first) / np.asarray(problem.cell)).astype(int))


@pytest.mark.parametrize("stride", [1, 2])
def test_shares_are_those_of_the_blocks_of_the_image(stride):
    camera = Camera()
    step = share_step(camera)
    depth = np.where(np.random.default_rng(0).random((camera.height, camera.width)) < 0.3, np.nan, 0.8)
    rays = view(camera, (0, camera.height), (0, camera.width), stride)
    share = np.asarray(measured_share(camera, rays, rays.of(jnp.asarray(depth, jnp.float32))))
    rows, columns = camera.height // step, camera.width // step
    expected = np.array(
        [
            [
                np.isfinite(
                    depth[r * step : (r + 1) * step, c * step : (c + 1) * step][
                        -r * step % stride :: stride, -c * step % stride :: stride
                    ]
                ).mean()
                for c in range(columns)
            ]
            for r in range(rows)
        ]
    )
    np.testing.assert_allclose(share, expected, atol=1e-6)


def test_blocks_without_a_ray_take_the_nearest():
    camera = Camera()
    rays = view(camera, (0, camera.height), (0, camera.width), 10)
    depth = jnp.full((rays.camera.height, rays.camera.width), 0.8).at[:, :10].set(jnp.nan)
    share = np.asarray(measured_share(camera, rays, depth))
    assert set(np.unique(share)) == {0.0, 1.0}
    assert (share[:, :13] == 0).all() and (share[:, 15:] == 1).all()  # noqa: PT018


def test_finer_images_have_the_shares_of_their_blocks():
    camera, step = Camera(), share_step(Camera())
    share = jnp.asarray(np.random.default_rng(0).random((camera.height // step, camera.width // step)), jnp.float32)
    assert sampled(camera, share, step) is share
    finer = np.asarray(sampled(camera, share, 1))
    assert finer.shape == (camera.height, camera.width)
    np.testing.assert_array_equal(finer[3 : share.shape[0] * step : step, 3 : share.shape[1] * step : step], share)


def test_where_everything_is_measured_f_is_as_if_nothing_was_asked(problem, whole):
    asked, not_asked = (look(problem, o) for o in (whole, whole.replace(measured=None)))
    np.testing.assert_array_equal(asked.exists, not_asked.exists)
    np.testing.assert_array_equal(asked.allowed, not_asked.allowed)
    assert np.isneginf(asked.unmeasured).all()
    assert np.isneginf(not_asked.unmeasured).all()


def test_a_thing_without_depth_hides_what_is_behind_it_and_may_be_there(problem, whole, holed):
    truth = nearest(problem, SCENE.target.position)
    before, now = look(problem, whole), look(problem, holed)
    assert bool(before.exists[truth])
    assert bool(now.exists[truth])
    # Without the question it is seen and empty.
    assert not bool(look(problem, holed.replace(measured=None)).exists[truth])
    assert bool(now.exists.sum() < 100)
    front = SCENE.objects[FRONT]
    height = float(now.unmeasured[cell(problem, front.position)])
    assert front.position[2] + 0.5 * front.half_size[2] < height
    measured = SCENE.objects[FRONT + 1 :]
    assert all(np.isneginf(now.unmeasured[cell(problem, body.position)]) for body in measured)


def test_scattered_pixels_neither_open_the_shelf_nor_rule_the_truth_out(problem, whole):
    depth = np.where(np.random.default_rng(0).random(IMAGES.depth.shape) < 0.3, 0.0, IMAGES.depth)
    before, now = look(problem, whole), look(problem, seen(problem, whole.objects, depth))
    assert bool(jnp.all(now.exists | ~before.exists))
    assert int(now.exists.sum()) < 1.2 * int(before.exists.sum())
    assert np.isfinite(now.unmeasured).mean() < 0.01


def test_a_board_that_loses_most_of_its_pixels_in_patches_leaves_the_shelf_seen(problem, whole):
    wavy = gaussian_filter(np.random.default_rng(0).standard_normal(IMAGES.depth.shape), 3.5)
    of_shelf = ~np.isin(IMAGES.mask, np.arange(len(SCENE.objects)))
    depth = np.where(of_shelf & (wavy < np.quantile(wavy, 0.6)), 0.0, IMAGES.depth)
    before, now = look(problem, whole), look(problem, seen(problem, whole.objects, depth))
    assert bool(jnp.all(now.exists | ~before.exists))
    assert int(now.exists.sum()) < 1.5 * int(before.exists.sum())


def test_what_was_seen_to_be_free_stays_free_until_something_is_done(problem, whole, holed):
    free = look(problem, whole)
    again = look(problem, holed.replace(objects=whole.objects), free)
    assert np.isneginf(again.unmeasured).all()
    done = no_action().replace(kind=jnp.int32(ActionKind.PUSH))
    moved = look(problem, holed, free, whole, done)
    assert np.isfinite(moved.unmeasured).any()


def test_actions_through_what_was_not_measured_are_told(problem, whole, holed):
    x, y, z = SCENE.objects[FRONT].position
    T = jnp.array([[0.0, 0.0, 1.0, x - 0.12], [0.0, -1.0, 0.0, y], [1.0, 0.0, 0.0, z], [0.0, 0.0, 0.0, 1.0]])
    push = no_action().replace(
        kind=jnp.int32(ActionKind.PUSH),
        object=jnp.int32(7),
        T_world_gripper=T,
        T_world_place=T.at[0, 3].add(0.1),
        displacement=jnp.array([0.1, 0.0, 0.0]),
    )
    for observation, expected in ((holed, True), (whole, False)):
        belief = look(problem, observation)
        assert bool(sweeps_unmeasured(problem, belief, observation.objects, push)) == expected
        assert not bool(sweeps_unmeasured(problem, belief, observation.objects, no_action()))


@pytest.mark.slow
def test_a_batch_is_the_same(problem, whole, holed):
    both = jax.tree.map(lambda a, b: jnp.stack([a, b]), whole, holed)
    batched = jax.vmap(lambda o: look(problem, o))(both)
    for i, one in enumerate((whole, holed)):
        alone = look(problem, one)
        np.testing.assert_array_equal(batched.exists[i], alone.exists)
        np.testing.assert_array_equal(batched.unmeasured[i], alone.unmeasured)


def test_f_that_is_empty_opens_no_space_that_is_seen(problem, whole, holed):
    nothing = seen(problem, empty(8))
    belief = look(problem, nothing)
    assert int(belief.restarts) == 1
    assert not bool(belief.exists.any())
    assert "not in this shelf" in impasse(problem, belief, nothing.objects)
    # What is hidden or was not measured is open again.
    opened = look(problem, holed, belief)
    assert bool(opened.exists[nearest(problem, SCENE.target.position)])
    assert int(opened.exists.sum()) < 100


def test_where_the_target_can_be_nowhere_nothing_is_moved(problem, whole):
    belief = look(problem, whole)
    belief = belief.replace(exists=jnp.zeros_like(belief.exists))
    # As the tests of the planner call it, so that it is compiled once.
    decision = ms.search_for_grasp()(jax.random.key(0), problem, belief, whole.replace(measured=None))
    assert int(decision.action.kind) == ActionKind.NONE


@pytest.mark.parametrize("step", [(0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (0.5, 0.5), (3.71, -13.43), (5.07, -6.58)])
def test_a_target_in_sight_without_depth_may_be_where_it_is_between_the_poses(problem, step):
    """Its nearest poses show a strip beside the hole that it makes; steps are of the grid, from the shelf's middle."""
    middle = problem.poses[9 * problem.target.grid[1] + 22, :2] + jnp.array(step) * problem.cell
    target = dataclasses.replace(SCENE.target, position=(*map(float, middle), SCENE.target.position[2]))
    scene = dataclasses.replace(SCENE, objects=(), target=target)
    image = observe(problem.camera, from_scenario(scene), problem.shelf)
    depth = np.where(np.asarray(image.segmentation) == TARGET, np.nan, np.asarray(image.depth))
    belief = look(problem, seen(problem, empty(8), depth))
    assert bool(belief.exists[nearest(problem, middle)])
    # And hardly elsewhere.
    assert int(jnp.sum(belief.exists)) < 40
