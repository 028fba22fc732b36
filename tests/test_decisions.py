"""Decisions: of their version, the same alone, in a batch and under other settings of JAX, and within a budget."""

import dataclasses
import importlib.util
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mechsearch_jax as ms
from mechsearch_jax.envs.camera.example_images import SCENARIO, sensed_images
from mechsearch_jax.envs.episode.closed_loop import keys_at
from mechsearch_jax.envs.episode.many_slots import ManySlots
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.envs.episode.slots import OneSlot
from mechsearch_jax.envs.world.world import from_scenario
from mechsearch_jax.geometry import superquadric
from mechsearch_jax.perception.doubt import DoubtConfig
from mechsearch_jax.perception.recogniser import Recogniser, view_images
from mechsearch_jax.runtime.compiled import CachedJit
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.own_settings import OWN, in_own_settings, own_settings
from mechsearch_jax.runtime.versions import DECISION_VERSION
from mechsearch_jax.session.searcher import Searcher
from mechsearch_jax.session.whole_trajectory import TrajectoryConfig
from mechsearch_jax.workspace.render import render_depth
from mechsearch_jax.workspace.scenario import example_scenarios, load_scenario

GOLDENS = Path(__file__).parent / "goldens"
HOW = "write the golden anew: python tests/goldens/decisions.py"


@pytest.fixture(scope="module")
def golden():
    spec = importlib.util.spec_from_file_location("decisions", GOLDENS / "decisions.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def check(golden, now):
    number, before = golden.kept()
    assert number == DECISION_VERSION, f"DECISION_VERSION is {DECISION_VERSION}, the golden's {number}: {HOW}"
    changed = list(golden.differences({name: before[name] for name in before.keys() & now.keys()}, now))
    assert not changed, f"decisions changed: raise DECISION_VERSION and {HOW}\n" + "\n".join(changed)


def test_decisions_from_true_shapes_are_those_of_their_version(golden, problem):
    check(golden, golden.from_true_shapes(problem))


@pytest.mark.slow
@pytest.mark.always
def test_decisions_from_images_are_those_of_their_version(golden, problem):
    check(golden, golden.from_images(problem))


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


@pytest.mark.slow
@pytest.mark.always
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


@pytest.fixture
def others():
    """The settings of somebody else."""
    with jax.enable_x64(True), jax.debug_nans(True), jax.debug_infs(True), jax.numpy_dtype_promotion("strict"):
        yield


def dtypes(tree):
    return {
        np.dtype(leaf.dtype) for leaf in jax.tree.leaves(tree) if not jnp.issubdtype(leaf.dtype, jax.dtypes.extended)
    }


def test_the_settings_hold_inside_and_others_outside(others):
    with own_settings():
        assert {name: getattr(jax.config, name) for name in OWN} == OWN
    assert jax.config.jax_enable_x64
    assert in_own_settings(lambda: jnp.zeros(3).dtype)() == np.float32
    assert jnp.zeros(3).dtype == np.float64


def marked(x):
    return jnp.where(x > 0, x, jnp.nan), jnp.arange(3), jnp.inf * x


def test_a_kept_function_computes_in_32_bits_and_marks_with_nan(others):
    kept = CachedJit(marked, on_disk=False)
    for prepare in (False, True):
        if prepare:
            kept.prepare(jnp.zeros(2))
        results = kept(jnp.zeros(2))
        assert dtypes(results) == {np.dtype(np.float32), np.dtype(np.int32)}
        assert np.isnan(results[0]).all()


def test_a_search_is_the_same_under_other_settings(problem, others):
    images = ms.example_images()
    given = ms.Superquadrics(
        size=jnp.array([[0.03, 0.03, 0.06]]),
        exponents=jnp.array([[0.2, 0.2]]),
        position=jnp.array([[0.58, 0.1, 0.4645]]),
        rotation=jnp.eye(3)[None],
        valid=jnp.ones(1, bool),
    )
    assert given.size.dtype == np.float64
    objects = superquadric.pad(given, 8)
    observation = ms.Observation(objects, jnp.array(False), jnp.zeros(3))
    belief = ms.update_belief(problem, ms.initial_belief(problem), observation)
    decision = ms.search_for_grasp()(jax.random.key(0), problem, belief, observation)
    for result in (belief, decision):
        assert np.dtype(np.float64) not in dtypes(result)
    motion = ms.joint_trajectory(problem, decision.action, observation=observation)
    assert motion.position.dtype == np.float32
    render_depth(images.camera, objects)
    # As without them.
    with own_settings():
        plain = ms.Observation(
            jax.tree.map(lambda a: jnp.asarray(np.asarray(a)), objects), jnp.array(False), jnp.zeros(3)
        )
        same = ms.search_for_grasp()(jax.random.key(0), problem, belief, plain)
    np.testing.assert_array_equal(decision.action.T_world_gripper, same.action.T_world_gripper)


def test_a_flag_with_which_xla_computes_wrong_numbers_is_refused(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=false --xla_backend_optimization_level=0")
    with pytest.raises(InputError, match=r"^XLA_FLAGS: --xla_backend_optimization_level=0 [^\n]*$"):
        in_own_settings(lambda: None)()
    monkeypatch.setenv("XLA_FLAGS", "--xla_backend_optimization_level=1")
    in_own_settings(lambda: None)()
