"""What is measured is what ships: a searcher, an episode alone and a batch take the same step from the same images."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax.envs.camera.example_images import SCENARIO, sensed_images
from mechsearch_jax.envs.episode.closed_loop import keys_at
from mechsearch_jax.envs.episode.many_slots import ManySlots
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.envs.episode.slots import OneSlot
from mechsearch_jax.envs.world.world import from_scenario
from mechsearch_jax.perception.doubt import DoubtConfig
from mechsearch_jax.perception.recogniser import Recogniser, view_images
from mechsearch_jax.session.searcher import Searcher
from mechsearch_jax.session.whole_trajectory import TrajectoryConfig
from mechsearch_jax.workspace.scenario import example_scenarios, load_scenario

SCENE = load_scenario(example_scenarios()[SCENARIO])
# Another place of the target is another image, of a hidden one.
LATER = dataclasses.replace(SCENE, target=dataclasses.replace(SCENE.target, position=(0.62, -0.12, 0.4545)))
SEED = 5
# Sure enough to move, whatever the images show.
TRUSTING = TrajectoryConfig(doubt=DoubtConfig(missing=1.0, unexplained=1.0, passed=1.0))


@pytest.fixture(scope="module")
def images():
    return [sensed_images(scene) for scene in (SCENE, LATER)]


def recogniser_of(robot, images):
    """The `Recogniser` of an episode that sees these images, whatever its world is; with masks, which compile soon."""
    shown = view_images(robot.view, images.depth, images.colour, images.mask.astype(np.int32), None)
    return lambda key, snapshot: robot.core(snapshot.camera, snapshot.view, snapshot.shelf, shown)


def keys_of(index, count=1):
    data = jnp.stack([jax.random.key_data(jax.random.split(jax.random.key(SEED)))] * count)
    return keys_at(data, jnp.full(count, index))


def test_a_searcher_an_episode_and_a_batch_decide_the_same_from_the_same_images(problem, images):
    method = Method()
    searcher = Searcher(seed=SEED, trajectories=TRUSTING)
    searcher.problem = problem
    robot, world = searcher.recogniser, jax.tree.map(lambda a: a[None], from_scenario(SCENE))
    alone = OneSlot(problem, method.policy(), None, method.trials())
    for index, image in enumerate(images):
        step = searcher.next(image.depth, image.colour, image.mask)
        planner, environment = keys_of(index)
        alone._recogniser = recogniser_of(robot, image)
        alone.look(world, environment, [0])
        alone.decide(planner, [0])
        jax.tree.map(np.testing.assert_array_equal, step.observation, alone.state.observation)
        jax.tree.map(np.testing.assert_array_equal, step.belief, alone.state.belief)
        jax.tree.map(np.testing.assert_array_equal, step.decision, alone.decided.decision)
        if index == 0:
            # Beyond the first step, what differs in the last digits may decide between two that are as good.
            two = jax.tree.map(lambda a: jnp.concatenate([a, a]), world)
            many = ManySlots(problem, method.policy(), recogniser_of(robot, image), two, 2, method.trials())
            planner, environment = keys_of(index, 2)
            many.look(two, environment, [0, 1])
            choices = many.decide(planner, [0, 1])
            for row in (0, 1):
                assert int(choices[row].action.kind) == int(step.decision.action.kind)
                assert int(choices[row].action.object) == int(step.decision.action.object)
                ours, theirs = choices[row].action, step.decision.action
                np.testing.assert_allclose(ours.T_world_gripper, theirs.T_world_gripper, atol=1e-4)
                np.testing.assert_allclose(ours.T_world_place, theirs.T_world_place, atol=1e-4)
        assert step.trajectory is not None
        searcher.acted()
    assert isinstance(robot, Recogniser)
