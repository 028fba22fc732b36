"""A target that was found is searched for again once it is neither seen nor can be where it was seen last."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax import planner
from mechsearch_jax.actions import no_action
from mechsearch_jax.actions.registry import ActionKind
from mechsearch_jax.belief.moved_target import nearest_candidate
from mechsearch_jax.envs.camera.simulated_camera import target_pixels
from mechsearch_jax.envs.world.world import from_scenario
from mechsearch_jax.geometry.transforms import make, translate
from mechsearch_jax.observation import Observation
from mechsearch_jax.workspace import scenario
from mechsearch_jax.workspace.detector import found_pixels

UPRIGHT = (1.0, 0.0, 0.0, 0.0)
BOX = scenario.Body("box", (0.048, 0.028, 0.08), (0.5, 0.135, 0.4845), UPRIGHT)
ASIDE = dataclasses.replace(BOX, position=(0.5, -0.2, 0.4845))
# The box hides a target there, and not if it stands aside.
BEHIND = (0.62, 0.07)
OPEN = (0.6, 0.35)


def cylinder(place):
    return scenario.Body("cylinder", (0.02, 0.02, 0.05), (*place, 0.4545), UPRIGHT)


def shows(problem, box, place):
    """Pixels of a target at a place that the camera sees."""
    return int(target_pixels(problem.camera, from_scenario(scenario.Scenario("one", (box,), cylinder(place)))))


def seen(box, place=None):
    """What is recognised of a box, and of the target at a place; of a target that is not seen without one."""
    pose = jnp.float32([*(place or (0.0, 0.0)), 0.0])
    return Observation(scenario.superquadrics([box]), jnp.array(place is not None), pose)


def push(start, way):
    T = make(jnp.float32([[0.5, 0.0, 0.8660254], [0.0, -1.0, 0.0], [0.8660254, 0.0, -0.5]]), jnp.float32(start))
    way = jnp.float32(way)
    kind = jnp.int32(ActionKind.PUSH)
    return no_action().replace(kind=kind, T_world_gripper=T, displacement=way, T_world_place=translate(T, way))


@pytest.fixture(scope="module")
def look(problem):
    """Folds observations into the belief of one who knows nothing, each after what was done before it."""

    def fold(first, *others):
        belief, before = planner.initial_belief(problem), first
        for observation, action in ((first, no_action()), *others):
            belief = planner.update_belief(problem, belief, observation, before, action)
            before = observation
        return belief

    return fold


def can_be_at(problem, belief, place):
    return bool(belief.exists[nearest_candidate(problem.poses, jnp.float32([*place, 0.0]))])


def test_a_false_detection_is_forgotten(problem, look):
    assert shows(problem, BOX, OPEN) > 3 * found_pixels(problem.camera)
    wrong, right = look(seen(BOX, OPEN)), look(seen(BOX))
    assert wrong.found
    again = look(seen(BOX, OPEN), (seen(BOX), no_action()))
    assert not again.found
    assert not again.restarts
    assert not again.grasps.feasible.any()
    np.testing.assert_array_equal(again.exists, right.exists)
    assert can_be_at(problem, again, BEHIND)
    # What is found anew is found.
    assert look(seen(BOX, OPEN), (seen(BOX), no_action()), (seen(ASIDE, BEHIND), no_action())).found


def test_a_target_that_is_hidden_again_stays_found(problem, look):
    assert shows(problem, ASIDE, BEHIND) > 3 * found_pixels(problem.camera)
    assert shows(problem, BOX, BEHIND) <= found_pixels(problem.camera)
    belief = look(seen(ASIDE, BEHIND), (seen(BOX), push((0.5, -0.25, 0.48), (0.0, 0.15, 0.0))))
    assert belief.found
    np.testing.assert_allclose(belief.found_pose[:2], BEHIND, rtol=1e-6)
    assert belief.grasps.feasible.any()


def test_a_target_that_was_shoved_out_of_sight_is_searched_for_where_it_is(problem, look):
    before = dataclasses.replace(BOX, position=(0.5, 0.0, 0.4845))
    start = (0.53, 0.075)
    assert shows(problem, before, start) > found_pixels(problem.camera)
    # The box comes to stand where the target was, and the target behind it.
    assert shows(problem, BOX, BEHIND) <= found_pixels(problem.camera)
    belief = look(seen(before, start), (seen(BOX), push((0.5, -0.06, 0.48), (0.0, 0.135, 0.0))))
    assert not belief.found
    assert can_be_at(problem, belief, BEHIND)
    # Or it slid away from where it was in plain sight.
    gone = look(seen(BOX, OPEN), (seen(BOX), push((0.6, 0.45, 0.48), (0.0, -0.15, 0.0))))
    assert not gone.found
    assert can_be_at(problem, gone, BEHIND)


def test_a_target_of_which_little_would_be_seen_stays_found(problem, look):
    """A sensor may miss two thirds of it, and what hides it may be recognised as too narrow."""
    limit = found_pixels(problem.camera)
    places = [(BEHIND[0], y) for y in np.arange(0.07, 0.2, 0.003)]
    here = next(place for place in places if limit < shows(problem, BOX, place) < 2.2 * limit)
    assert look(seen(BOX, here), (seen(BOX), no_action())).found


@pytest.mark.slow
def test_a_batch_forgets_as_one_does(problem, look):
    views = [seen(BOX, OPEN), seen(ASIDE, BEHIND)]
    beliefs = jax.tree.map(lambda *a: jnp.stack(a), *(look(view) for view in views))
    update = jax.vmap(lambda belief: planner.update_belief(problem, belief, seen(BOX), seen(BOX), no_action()))
    assert update(beliefs).found.tolist() == [False, True]
