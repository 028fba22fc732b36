"""Scenes that trials happen in: those nearby, with bodies of parts, and tried in processes."""

import dataclasses
import os
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_envs_trials import EDGE, FIRM, LOOSE, MODEL, look, pushes, stack

from mechsearch_jax.envs.camera.snapshot import Snapshot, objects_on_the_board, oracle
from mechsearch_jax.envs.pushing import physics_push
from mechsearch_jax.envs.scenes.household import body_at, household, standing_height
from mechsearch_jax.envs.simulators.simulator import SimulatorConfig
from mechsearch_jax.envs.trials.attempt import TrialScene
from mechsearch_jax.envs.trials.compounds import BASE_SHARE, DENSITY, FRICTION, compound_of, with_parts
from mechsearch_jax.envs.trials.native import NativeTrials
from mechsearch_jax.envs.trials.nearby import Perturbations
from mechsearch_jax.envs.trials.order import Once
from mechsearch_jax.envs.trials.processes import ProcessTrials
from mechsearch_jax.envs.world import world
from mechsearch_jax.envs.world.world import BODIES, TARGET, bodies_of, from_scenario
from mechsearch_jax.geometry.bodies import world_parts
from mechsearch_jax.geometry.superquadric import Superquadrics, empty, pad
from mechsearch_jax.planner.trials import TrialResult, TrialScenes, scenes_of
from mechsearch_jax.shapes.compound import half_extents, inertial
from mechsearch_jax.shapes.parts import parts_of
from mechsearch_jax.workspace import scenario as scenarios
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import MAX_OBJECTS, Body, Scenario
from mechsearch_jax.workspace.shelf import Shelf


def scenes(rows):
    objects = empty(8)
    objects = objects.replace(size=np.tile(np.float32([0.02, 0.05, 0.08]), (8, 1)))
    objects = jax.tree.map(lambda a: np.stack([np.asarray(a)] * rows), objects)
    return TrialScenes(objects, np.zeros((rows, 3), np.float32), np.ones(rows, bool), np.ones(rows, np.float32))


def test_the_same_differences_whatever_else_is_tried():
    near = Perturbations()
    one, many = near.drawn(scenes(1), 2), near.drawn(scenes(3), 2)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(many), strict=True):
        np.testing.assert_array_equal(np.repeat(a, 3, axis=0), b)
        assert a.dtype == b.dtype
    other = near.drawn(scenes(1), 3)
    assert (one.objects.position[..., :2] != other.objects.position[..., :2]).all()
    assert near.drawn(many, 0) is many


def test_differences_are_as_large_as_they_are_said_to_be():
    near = Perturbations(place=3e-3, size=0.02)
    plain = scenes(1)
    drawn = [near.drawn(plain, n) for n in range(1, 400)]
    places = np.stack([d.objects.position - plain.objects.position for d in drawn])
    sizes = np.stack([d.objects.size / plain.objects.size - 1 for d in drawn])
    poses = np.stack([d.pose for d in drawn])
    for values, scale in ((places, 3e-3), (sizes, 0.02), (poses, 3e-3)):
        assert np.std(values[..., :2]) == pytest.approx(scale, rel=0.1)
        assert abs(np.mean(values[..., :2])) < 0.1 * scale
    # Heights, and the target's yaw.
    assert not places[..., 2].any()
    assert not poses[..., 2].any()
    np.testing.assert_allclose(sizes[..., 2], 0.0, atol=1e-6)
    assert all(d.objects.rotation is plain.objects.rotation for d in drawn)


def test_things_are_rougher_in_one_scene_and_smoother_in_another():
    near, plain = Perturbations(friction=1.5), scenes(2)
    plain = plain.replace(friction=np.float32([1.0, 0.8]))
    drawn = [near.drawn(plain, number) for number in (1, 2, 3, 4)]
    for each, power in zip(drawn, (1, -1, 0, 1), strict=True):
        np.testing.assert_allclose(each.friction, np.float32([1.0, 0.8]) * 1.5**power, rtol=1e-6)
        assert each.friction.dtype == np.float32


def test_a_value_is_computed_once_by_whichever_thread_comes_first():
    made, once, begin = [], Once(), threading.Barrier(4)

    def make(number):
        made.append(number)
        time.sleep(0.02)
        if number == 1:
            raise ValueError("no such scene")
        return f"scene {number}"

    def take(_):
        begin.wait()
        with pytest.raises(ValueError, match="no such scene"):
            once(1, lambda: make(1))
        return [once(n, lambda n=n: make(n)) for n in (0, 2)]

    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(take, range(4))) == [["scene 0", "scene 2"]] * 4
    assert sorted(made) == [0, 1, 2]


@pytest.fixture(scope="module")
def rows(problem):
    """Three scenes, the first without the target, and what is to be tried in two of them."""
    over, away, aside = pushes()
    scenes = scenes_of(*stack(look(problem, EDGE, found=False), look(problem, LOOSE), look(problem, FIRM)))
    actions = stack(stack(over, away, aside), stack(aside, over, away), stack(over, over, over))
    return scenes, actions, np.array([[True, True, True], [True, False, True], [False, False, False]])


def until_success(results):
    """What is said of each row up to its first success, after which nothing counts."""
    firsts = [[*row, TrialResult.SUCCEEDED].index(TrialResult.SUCCEEDED) for row in results.tolist()]
    return [row[: first + 1].tolist() for row, first in zip(results, firsts, strict=True)]


@pytest.mark.slow
def test_processes_say_what_this_one_says_also_after_one_of_them_died(problem, rows):
    expected = MODEL(problem, *rows)
    assert TrialResult.HARMFUL in expected
    trials = ProcessTrials(processes=2)
    try:
        (begun,) = trials.programs(problem)
        assert not begun.is_ready()
        begun.begin()()
        assert begun.is_ready()
        for dies in (False, True):
            if dies:
                os.kill(next(iter(trials._pool._processes)), signal.SIGKILL)
            results = trials(problem, *rows)
            assert until_success(results) == until_success(expected)
            assert results[2].tolist() == [TrialResult.UNKNOWN] * 3
    finally:
        trials.close()


@pytest.mark.slow
def test_of_a_scene_that_ends_its_process_nothing_is_known(problem, rows):
    @dataclasses.dataclass(frozen=True)
    class Deadly(NativeTrials):
        def in_cell(self, cell, scenes, actions, wanted):
            if scenes.found[0]:
                os._exit(1)
            return NativeTrials.in_cell(self, cell, scenes, actions, wanted)

    expected = MODEL(problem, *rows)
    trials = ProcessTrials(Deadly(), processes=2)
    try:
        with pytest.warns(UserWarning, match="a process died as it tried actions"):
            results = trials(problem, *rows)
    finally:
        trials.close()
    assert until_success(results[:1]) == until_success(expected[:1])
    assert results[1].tolist() == [TrialResult.UNKNOWN] * 3


def test_nothing_begins_where_nothing_is_to_be_tried(problem, rows):
    scenes, actions, wanted = rows
    trials = ProcessTrials(processes=2)
    assert (trials(problem, scenes, actions, wanted & False) == TrialResult.UNKNOWN).all()
    assert trials._pool is None
    trials.close()


UPRIGHT = (1.0, 0.0, 0.0, 0.0)
UP, STRAIGHT = np.array([0.0, 0.0, 1.0]), np.eye(3)
BOX = Body("box", (0.054, 0.025, 0.054), (0.55, 0.35, 0.4585), UPRIGHT)
TARGET_BODY = Body("cylinder", (0.02, 0.02, 0.05), (0.7, 0.0, 0.4545), UPRIGHT)


def standing(name, y, yaw=0.7):
    compound = household()[name].compound
    return body_at(compound, 0.6, y, Shelf().board + standing_height(compound), yaw)


SCENE = Scenario("things", (standing("mug", 0.0), standing("drill", 0.18), BOX), TARGET_BODY)


def in_world(body):
    """Position and size of every part of a compound, in the world."""
    turn = scenarios.rotation_matrix(body.quaternion)
    return {
        tuple(np.round(np.array(body.position) + turn @ part.position, 5)): part for part in parts_of(body.compound)
    }


@pytest.mark.parametrize(
    "scene",
    [
        scenarios.superquadrics(SCENE.objects),
        world.true_superquadrics(from_scenario(SCENE)),
        oracle(jax.random.key(0), Snapshot(Camera(), Shelf(), from_scenario(SCENE))).objects,
    ],
    ids=["scenario", "world", "oracle"],
)
def test_true_shapes_are_bodies_of_the_parts(scene):
    assert scene.capacity == MAX_OBJECTS
    assert scene.valid.tolist() == [True] * 3 + [False] * 5
    assert scene.parts.valid.sum(axis=1).tolist()[:3] == [4, 4, 1]
    parts = world_parts(scene)
    count = scene.parts.capacity
    for i in range(2):
        wanted = in_world(SCENE.objects[i])
        for p in range(i * count, (i + 1) * count):
            place = min(wanted, key=lambda place: np.linalg.norm(place - np.asarray(parts.position[p])))
            np.testing.assert_allclose(parts.position[p], place, atol=1e-4)
            np.testing.assert_allclose(np.sort(parts.size[p]), np.sort(wanted[place].size), atol=1e-6)
    np.testing.assert_allclose(scene.size[2], BOX.half_size, atol=1e-6)
    np.testing.assert_allclose(scene.position[2], BOX.position, atol=1e-6)


def test_parts_become_a_compound_of_their_volume():
    body = SCENE.objects[0]
    scene = jax.device_get(scenarios.superquadrics(SCENE.objects))
    made = compound_of(jax.tree.map(lambda leaf: leaf[0], scene.parts), UP)
    assert [piece.shape for piece in made.pieces] == ["cylinder", "box", "box", "box"]
    volume = inertial(made).mass / made.density
    assert volume == pytest.approx(inertial(body.compound).mass / body.compound.density, rel=1e-4)
    assert (made.density, made.friction) == (DENSITY, FRICTION)


def pear(turn=STRAIGHT, lie=STRAIGHT):
    """A pear as it is recognised, two ellipsoids on the board.

    Args:
      turn: rotation of the body's frame in the world; the pear stands as it does whatever that is.
      lie: rotation of the lower ellipsoid in the world.
    """
    foot = np.array([0.6, 0.0, Shelf().board])
    size = np.array([[0.036, 0.030, 0.033], [0.021, 0.021, 0.036]])
    below = np.linalg.norm(size[0] * lie[2])
    places = foot + np.array([[0.0, 0.0, below], [0.0, 0.0, below + 0.04]])
    middle = foot + np.array([0.0, 0.0, 0.05])
    fields = (size, np.ones((2, 2)), (places - middle) @ turn, np.stack([turn.T @ lie, turn.T]))
    parts = Superquadrics(*(jnp.asarray(field, jnp.float32)[None] for field in fields), valid=jnp.ones((1, 2), bool))
    whole = (np.array([0.036, 0.036, 0.05]), np.ones(2), middle, turn)
    return Superquadrics(*(jnp.asarray(field, jnp.float32)[None] for field in whole), jnp.ones(1, bool), parts=parts)


# Rotations of the lower ellipsoid, and its semi-axes seen from above.
LYING = [((0, 0, 0.4), (0.036, 0.030)), ((np.pi / 2, 0, 0), (0.036, 0.033)), ((0, np.pi / 2, 0), (0.033, 0.030))]


@pytest.mark.parametrize("turn", [(0, 0, 0), (np.pi / 2, 0, 0), (0.3, -1.2, 2.0)])
@pytest.mark.parametrize(("lie", "level"), LYING)
def test_what_stands_on_an_ellipsoid_has_a_base(turn, lie, level):
    turn, lie = (Rotation.from_rotvec(vector).as_matrix() for vector in (turn, lie))
    body = jax.device_get(pear(turn, lie))
    made = compound_of(jax.tree.map(lambda leaf: leaf[0], body.parts), turn[2])
    assert [piece.shape for piece in made.pieces] == ["ellipsoid", "ellipsoid", "cylinder"]
    base = made.pieces[-1]
    np.testing.assert_allclose(turn @ base.rotation[:, 2], UP, atol=1e-6)
    place = body.position[0] + turn @ np.array(base.position)
    np.testing.assert_allclose(place, [0.6, 0.0, Shelf().board + base.half_size[2]], atol=1e-6)
    assert base.half_size[0] == pytest.approx(BASE_SHARE * min(level), rel=1e-5)


def test_the_base_of_a_tilted_ellipsoid_is_where_it_touches_the_board():
    lie = Rotation.from_rotvec([0.5, 0.7, 0.2]).as_matrix()
    body = jax.device_get(pear(lie=lie))
    base = compound_of(jax.tree.map(lambda leaf: leaf[0], body.parts), UP).pieces[-1]
    sphere = np.random.default_rng(0).normal(size=(400_000, 3))
    size, position = body.parts.size[0, 0], body.position[0] + body.parts.position[0, 0]
    points = position + (sphere / np.linalg.norm(sphere, axis=1, keepdims=True) * size) @ lie.T
    lowest = points[points[:, 2].argmin()]
    np.testing.assert_allclose((body.position[0] + base.position)[:2], lowest[:2], atol=1e-3)


@pytest.mark.parametrize("name", ["mug", "drill", "apple", "pear", "teapot", "salt-shaker"])
def test_true_household_things_stand_on_feet_of_their_own(name):
    own = jax.tree.map(lambda leaf: leaf[0], jax.device_get(scenarios.superquadrics((standing(name, 0.0),))).parts)
    assert len(compound_of(own, UP).pieces) == own.valid.sum()


def test_a_recognised_pear_does_not_roll_away_in_a_trial():
    objects = jax.device_get(pad(pear(), MAX_OBJECTS))
    bodies = with_parts(bodies_of(physics_push.bodies(objects)), objects)
    leaning = Rotation.from_rotvec([0.0, 0.12, 0.0]).as_quat(scalar_first=True)
    bodies[0] = dataclasses.replace(bodies[0], quaternion=tuple(leaning.tolist()))
    trial = TrialScene(Shelf(), SimulatorConfig(), bodies)
    pose = trial.positions[9:].reshape(BODIES, 7)[0]
    np.testing.assert_allclose(pose[:2], [0.6, 0.0], atol=0.01)
    assert scenarios.rotation_matrix(pose[3:])[2, 2] > np.cos(0.02)


def test_things_rest_in_a_trial_where_they_were_recognised():
    objects = jax.device_get(objects_on_the_board(Snapshot(Camera(), Shelf(), from_scenario(SCENE))))
    boxes = bodies_of(physics_push.bodies(objects))
    boxes[TARGET] = TARGET_BODY
    bodies = with_parts(boxes, objects)
    assert [body and body.shape for body in bodies] == ["compound", "compound", "box", *[None] * 5, "cylinder"]
    np.testing.assert_allclose(bodies[0].half_size, half_extents(bodies[0].compound))
    trial = TrialScene(Shelf(), SimulatorConfig(), bodies)
    assert not trial.diverged
    poses = trial.positions[9:].reshape(BODIES, 7)
    places = np.array([body.position for body in bodies if body is not None])
    np.testing.assert_allclose(poses[[0, 1, 2, TARGET], :3], places, atol=2e-3)
    assert not trial.fallen.any()
