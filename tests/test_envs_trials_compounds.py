"""Compounds as the planner sees them, bodies of several parts, and as trials make them compounds again."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mechsearch_jax.envs.camera.snapshot import Snapshot, objects_on_the_board, oracle
from mechsearch_jax.envs.pushing import physics_push
from mechsearch_jax.envs.scenes.household import body_at, household, standing_height
from mechsearch_jax.envs.simulators.simulator import SimulatorConfig
from mechsearch_jax.envs.trials.attempt import TrialScene
from mechsearch_jax.envs.trials.compounds import BASE_SHARE, DENSITY, FRICTION, compound_of, with_parts
from mechsearch_jax.envs.world import world
from mechsearch_jax.envs.world.world import BODIES, TARGET, bodies_of, from_scenario
from mechsearch_jax.geometry.bodies import world_parts
from mechsearch_jax.geometry.superquadric import Superquadrics, pad
from mechsearch_jax.shapes.compound import half_extents, inertial
from mechsearch_jax.shapes.parts import parts_of
from mechsearch_jax.workspace import scenario as scenarios
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import MAX_OBJECTS, Body, Scenario
from mechsearch_jax.workspace.shelf import Shelf

UPRIGHT = (1.0, 0.0, 0.0, 0.0)
UP = np.array([0.0, 0.0, 1.0])
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


def test_a_scene_without_compounds_has_no_parts():
    assert scenarios.superquadrics((BOX,)).parts is None
    assert world.true_superquadrics(from_scenario(Scenario("plain", (BOX,), TARGET_BODY))).parts is None


def test_parts_become_a_compound_of_their_volume():
    body = SCENE.objects[0]
    scene = jax.device_get(scenarios.superquadrics(SCENE.objects))
    made = compound_of(jax.tree.map(lambda leaf: leaf[0], scene.parts), UP)
    assert [piece.shape for piece in made.pieces] == ["cylinder", "box", "box", "box"]
    volume = inertial(made).mass / made.density
    assert volume == pytest.approx(inertial(body.compound).mass / body.compound.density, rel=1e-4)
    assert (made.density, made.friction) == (DENSITY, FRICTION)


def pear(rotation=None):
    """A pear as it is recognised: two ellipsoids on the board, in a body whose frame may be turned."""
    turn = np.eye(3) if rotation is None else np.asarray(rotation)
    radius, heights = np.array([0.034, 0.021]), np.array([0.034, 0.068])
    size = np.stack([[r, r, h] for r, h in zip(radius, [0.034, 0.036], strict=True)])
    middle = np.array([0.6, 0.0, Shelf().board + 0.05])
    places = np.stack([[0.6, 0.0, Shelf().board + height] for height in heights])
    parts = Superquadrics(
        *(
            jnp.asarray(field, jnp.float32)[None]
            for field in (size, np.ones((2, 2)), (places - middle) @ turn, np.stack([turn.T, turn.T]))
        ),
        valid=jnp.ones((1, 2), bool),
    )
    whole = (np.array([0.034, 0.034, 0.05]), np.ones(2), middle, turn)
    return Superquadrics(*(jnp.asarray(field, jnp.float32)[None] for field in whole), jnp.ones(1, bool), parts=parts)


@pytest.mark.parametrize("axis", [(0, 0, 0), (np.pi / 2, 0, 0), (0.3, -1.2, 2.0)])
def test_what_stands_on_an_ellipsoid_has_a_base(axis):
    turn = Rotation.from_rotvec(axis).as_matrix()
    body = jax.device_get(pear(turn))
    made = compound_of(jax.tree.map(lambda leaf: leaf[0], body.parts), turn[2])
    assert [piece.shape for piece in made.pieces] == ["ellipsoid", "ellipsoid", "cylinder"]
    base = made.pieces[-1]
    np.testing.assert_allclose(turn @ base.rotation[:, 2], UP, atol=1e-6)
    place = body.position[0] + turn @ np.array(base.position)
    np.testing.assert_allclose(place, [0.6, 0.0, Shelf().board + base.half_size[2]], atol=1e-6)
    assert base.half_size[0] == pytest.approx(BASE_SHARE * 0.034)


def test_what_stands_on_a_face_has_no_base():
    things = jax.device_get(scenarios.superquadrics(SCENE.objects)).parts
    for i in range(2):
        own = jax.tree.map(lambda leaf, i=i: leaf[i], things)
        assert len(compound_of(own, UP).pieces) == own.valid.sum()


def test_a_recognised_pear_does_not_roll_away_in_a_trial():
    objects = jax.device_get(pad(pear(), MAX_OBJECTS))
    bodies, origins = with_parts(bodies_of(physics_push.bodies(objects)), objects)
    leaning = Rotation.from_rotvec([0.0, 0.12, 0.0]).as_quat(scalar_first=True)
    bodies[0] = dataclasses.replace(bodies[0], quaternion=tuple(leaning.tolist()))
    trial = TrialScene(Shelf(), SimulatorConfig(), bodies, origins=origins)
    pose = trial.positions[9:].reshape(BODIES, 7)[0]
    np.testing.assert_allclose(pose[:2], [0.6, 0.0], atol=0.01)
    assert scenarios.rotation_matrix(pose[3:])[2, 2] > np.cos(0.02)


def test_things_rest_in_a_trial_where_they_were_recognised():
    objects = jax.device_get(objects_on_the_board(Snapshot(Camera(), Shelf(), from_scenario(SCENE))))
    boxes = bodies_of(physics_push.bodies(objects))
    boxes[TARGET] = TARGET_BODY
    bodies, origins = with_parts(boxes, objects)
    assert [body and body.shape for body in bodies] == ["compound", "compound", "box", *[None] * 5, "cylinder"]
    np.testing.assert_allclose(bodies[0].half_size, half_extents(bodies[0].compound))
    trial = TrialScene(Shelf(), SimulatorConfig(), bodies, origins=origins)
    assert not trial.diverged
    poses = trial.positions[9:].reshape(BODIES, 7)
    there = poses[:, :3] + np.einsum("nij,nj->ni", scenarios.rotation_matrix(poses[:, 3:]), origins)
    np.testing.assert_allclose(there[:2], objects.position[:2], atol=2e-3)
    np.testing.assert_allclose(there[TARGET], TARGET_BODY.position, atol=2e-3)
    assert not trial.fallen.any()
