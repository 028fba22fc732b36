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


def worlds(count):
    return jax.tree.map(lambda a: jnp.stack([a] * count), from_scenario(SCENE))


def keys_of(index, count=1):
    data = jnp.stack([jax.random.key_data(jax.random.split(jax.random.key(SEED)))] * count)
    return keys_at(data, jnp.full(count, index))


def test_a_searcher_and_an_episode_decide_the_same_from_the_same_images(problem, images):
    """To the bit, over two steps, trials included, where a robot has no reason to refuse a motion."""
    method = Method()
    searcher = Searcher(seed=SEED, trajectories=dataclasses.replace(TRUSTING, beside=0.0))
    searcher.problem = problem
    assert isinstance(searcher.recogniser, Recogniser)
    alone, world = OneSlot(problem, method.policy(), None, method.trials()), worlds(1)
    for index, image in enumerate(images):
        step = searcher.next(image.depth, image.colour, image.mask)
        planner, environment = keys_of(index)
        alone._recogniser = recogniser_of(searcher.recogniser, image)
        alone.look(world, environment, [0])
        alone.decide(planner, [0])
        jax.tree.map(np.testing.assert_array_equal, step.observation, alone.state.observation)
        jax.tree.map(np.testing.assert_array_equal, step.belief, alone.state.belief)
        jax.tree.map(np.testing.assert_array_equal, step.decision, alone.decided.decision)
        assert step.trajectory is not None
        searcher.acted()


@pytest.mark.slow
def test_a_batch_decides_the_same_as_an_episode_alone_from_the_same_images(problem, images):
    """At the first step: later, what differs in the last digits may decide between two that are as good."""
    method, robot, image = Method(), Recogniser(problem), images[0]
    alone = OneSlot(problem, method.policy(), recogniser_of(robot, image), method.trials())
    many = ManySlots(problem, method.policy(), recogniser_of(robot, image), worlds(2), 2, method.trials())
    (single, environment), (planner, environments) = keys_of(0), keys_of(0, 2)
    alone.look(worlds(1), environment, [0])
    many.look(worlds(2), environments, [0, 1])
    expected, choices = alone.decide(single, [0])[0].action, many.decide(planner, [0, 1])
    for row in (0, 1):
        action = choices[row].action
        assert (int(action.kind), int(action.object)) == (int(expected.kind), int(expected.object))
        np.testing.assert_allclose(action.T_world_gripper, expected.T_world_gripper, atol=1e-4)
        np.testing.assert_allclose(action.T_world_place, expected.T_world_place, atol=1e-4)
