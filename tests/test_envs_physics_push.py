"""Pushes that are simulated inside a plan: next to the simulator itself, with failures that stay in their row."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_envs_simulator import pose, push, scene, standing

from mechsearch_jax.dynamics import named as push_models
from mechsearch_jax.dynamics.quasi_static import QuasiStatic
from mechsearch_jax.envs.pushing import physics_push
from mechsearch_jax.envs.pushing import push_models as all_push_models
from mechsearch_jax.envs.pushing.physics_push import STILL, MjxPhysics, NativePhysics
from mechsearch_jax.envs.pushing.pushes import push_simulation
from mechsearch_jax.envs.simulators.native import NativeWorld
from mechsearch_jax.envs.world.world import bodies_of, from_scenario, superquadrics
from mechsearch_jax.geometry import superquadric, transforms
from mechsearch_jax.planner import Config
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.shapes.primitives import BOX, CYLINDER
from mechsearch_jax.workspace.shelf import Shelf

SHELF = Shelf()
PUSHER = jnp.zeros((1, 3))
START = scene(
    standing("box", (0.054, 0.025, 0.054), 0.55, 0.1),
    standing("cylinder", (0.032, 0.032, 0.067), 0.6, 0.19),
    target=standing("cylinder", (0.02, 0.02, 0.05), 0.7, -0.15),
)
SCENE = superquadrics(from_scenario(START))


def sideways(x, distance, z=0.04):
    return push(pose(x, 0.1 - 0.025 - 0.1125, z, tilt=math.radians(30)), (0.0, distance, 0.0))


def stack(*trees):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


PUSHES = stack(sideways(0.585, 0.1), sideways(0.575, 0.05), sideways(0.535, 0.15), sideways(0.535, 0.1))


@functools.cache
def batch_of(model):
    """The model, jitted and mapped over scenes and pushes."""

    def one(scene, action):
        return model(SHELF, scene, PUSHER, action.T_world_gripper, action.displacement, action.q7)

    return jax.jit(jax.vmap(one))


def predicted(scenes, actions=PUSHES, model=NativePhysics()):  # noqa: B008
    return jax.device_get(batch_of(model)(scenes, actions))


def copies(one):
    return stack(*[one] * 4)


@pytest.fixture(scope="module")
def outcome():
    return predicted(copies(SCENE))


def test_a_push_ends_where_the_simulator_ends_it(outcome):
    assert (outcome.residual == 0).all()
    assert (outcome.topples == 0).all()
    simulator = NativeWorld(config=push_simulation())
    for row in range(4):
        simulator.load(from_scenario(START))
        action = jax.tree.map(lambda a, row=row: a[row], PUSHES)
        assert simulator.execute(action).reason() is None
        gap = np.linalg.norm(outcome.scene.position[row] - simulator.world.position, axis=1)
        moved = np.linalg.norm(outcome.scene.position[row] - SCENE.position, axis=1)
        assert moved[0] > 0.5 * float(action.displacement[1])
        assert (gap < 1e-3).all()
        turn = np.einsum("nij,nij->n", outcome.scene.rotation[row], np.asarray(simulator.world.rotation))
        assert (turn[np.asarray(SCENE.valid)] > 1 + 2 * math.cos(0.025)).all()


def test_what_is_not_touched_stays_exactly_where_it_is(outcome):
    same = (outcome.scene.position == np.asarray(SCENE.position)).all(axis=-1)
    assert same[:, 2:].all()
    assert not same[:, 0].any()
    # The bottle behind the box is reached by the longer pushes only.
    assert same[:, 1].tolist() == [False, True, False, False]


def test_the_same_pushes_give_the_same_results_on_any_number_of_threads(outcome):
    again = predicted(copies(SCENE))
    jax.tree.map(np.testing.assert_array_equal, outcome, again)
    alone = predicted(copies(SCENE), model=NativePhysics(threads=1))
    jax.tree.map(np.testing.assert_array_equal, outcome, alone)


@pytest.mark.slow
def test_alone_it_is_as_in_a_batch(outcome):
    action = jax.tree.map(lambda a: a[1], PUSHES)
    # References differ by 1e-6 rad, which contacts amplify.
    model = NativePhysics()
    for call in (model, jax.jit(model, static_argnums=0)):
        one = call(SHELF, SCENE, PUSHER, action.T_world_gripper, action.displacement, action.q7)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b[1], atol=5e-3), one, outcome)


def test_an_error_stays_in_its_row(outcome, tmp_path, monkeypatch):
    # Where MuJoCo writes its log of what diverged.
    monkeypatch.chdir(tmp_path)

    def spoil(field, value):
        return SCENE.replace(**{field: getattr(SCENE, field).at[1].set(value)})

    mirror = jnp.diag(jnp.float32([1, 1, -1]))
    scenes = stack(SCENE, spoil("position", jnp.nan), spoil("position", 1e11), spoil("rotation", mirror))
    result = predicted(scenes)
    assert np.isinf(result.residual).tolist() == [False, True, True, True]
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[0], b[0]), result, outcome)
    assert (result.topples == 0).all()
    np.testing.assert_array_equal(result.scene.position[1:], scenes.position[1:])


def test_a_push_out_of_reach_fails_and_one_of_no_length_does_nothing(outcome):
    far = PUSHES.T_world_gripper.at[0, 0, 3].add(0.8)
    still = PUSHES.displacement.at[1].set(0.0)
    result = predicted(copies(SCENE), PUSHES.replace(T_world_gripper=far, displacement=still))
    assert np.isinf(result.residual).tolist() == [True, False, False, False]
    np.testing.assert_array_equal(result.scene.position[:2], [SCENE.position] * 2)
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[2:], b[2:]), result, outcome)


def test_shapes_that_overlap_come_to_rest_before_they_are_pushed():
    # In the distance two boxes share 1.5 mm, and one floats.
    more = [standing("box", (0.03, 0.03, 0.05), 0.7, y) for y in (0.3, 0.3585)]
    overlapping = superquadrics(from_scenario(scene(*START.objects, *more)))
    floating = overlapping.replace(position=overlapping.position.at[2, 2].add(1.5e-3))
    result = predicted(copies(floating))
    assert (result.residual == 0).all()
    moved = np.linalg.norm(result.scene.position - np.asarray(floating.position), axis=-1)
    assert (moved[:, 2:4] == 0).all()
    assert (moved[:, 0] > 0.03).all()


def test_superquadrics_become_the_nearest_boxes_and_cylinders():
    rotation = transforms.yaw_rotation(jnp.float32([0.3, 0.0, 1.0]))
    given = superquadric.Superquadrics(
        size=jnp.float32([[0.03, 0.04, 0.05], [0.02, 0.03, 0.06], [0.03, 0.03, 1e-4]]),
        exponents=jnp.float32([[0.2, 0.3], [0.2, 0.9], [0.4, 0.2]]),
        position=jnp.float32([[0.6, 0.0, 0.5]] * 3),
        rotation=rotation,
        valid=jnp.ones(3, bool),
    )
    nearest = [body for body in bodies_of(physics_push.bodies(given)) if body is not None]
    assert [body.shape for body in nearest] == ["box", "cylinder", "box"]
    np.testing.assert_allclose(nearest[0].half_size, (0.03, 0.04, 0.05), rtol=1e-6)
    np.testing.assert_allclose(nearest[1].half_size, (math.sqrt(6e-4), math.sqrt(6e-4), 0.06), rtol=1e-6)
    assert nearest[2].half_size[2] == pytest.approx(physics_push.THINNEST)
    back = physics_push.bodies(SCENE)
    assert back.kind[:2].tolist() == [BOX, CYLINDER]
    with pytest.raises(InputError, match="9 bodies, not for 12"):
        physics_push.bodies(superquadric.empty(12))


def test_every_name_stands_for_models(monkeypatch):
    assert all_push_models.push_models("quasi-static") == (QuasiStatic(), QuasiStatic())
    physics = all_push_models.push_models("physics")
    assert physics.first == NativePhysics()
    assert physics.later == push_models.own_push_model("learned")
    assert Config().push_model == "learned"
    # The same objects, so that nothing is compiled twice.
    assert all_push_models.push_models("physics") is physics
    with pytest.raises(InputError, match="needs a simulator"):
        push_models.own_push_model("physics")
    for refuse in (all_push_models.push_models, push_models.own_push_model):
        with pytest.raises(InputError, match='"guess" is unknown; use quasi-static, learned, physics'):
            refuse("guess")


@pytest.mark.slow
def test_the_batch_simulator_predicts_what_the_native_one_does(outcome):
    # In a map within a map, as in a batch of plans; one of the four rows is no scene.
    rows = np.array([0, 2])
    model = MjxPhysics()
    nan = SCENE.replace(position=SCENE.position.at[1].set(jnp.nan))
    scenes = stack(SCENE, nan)

    def one(scene, action):
        return model(SHELF, scene, PUSHER, action.T_world_gripper, action.displacement, action.q7)

    actions = jax.tree.map(lambda a: a[rows], PUSHES)
    both = jax.jit(jax.vmap(jax.vmap(one, in_axes=(None, 0)), in_axes=(0, None)))
    outcomes = jax.device_get(both(scenes, actions))
    assert np.isinf(outcomes.residual).tolist() == [[False] * 2, [True] * 2]
    gap = np.linalg.norm(outcomes.scene.position[0] - outcome.scene.position[rows], axis=-1)
    assert (gap < 5e-3).all()
    assert (gap[:, 3:] == 0).all()
    assert np.linalg.norm(outcomes.scene.position[0, :, 0] - np.asarray(SCENE.position[0]), axis=-1).min() > 10 * STILL
    np.testing.assert_array_equal(outcomes.scene.position[1], nan.position[None].repeat(2, 0))


def pushing(problem):
    """The problem where nothing but pushes can be done."""
    actions = dataclasses.replace(problem.config.actions, actions=("push",))
    return problem.replace(config=dataclasses.replace(problem.config, actions=actions))
