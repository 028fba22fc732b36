"""Compounds in the simulated world: their arrays, mass and geometry in MuJoCo, how they rest, what the camera sees."""

import dataclasses

import jax
import mujoco
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from mechsearch_jax.envs.camera import simulated_camera
from mechsearch_jax.envs.simulators.native import NativeSimulator, NativeWorld
from mechsearch_jax.envs.world import model, world
from mechsearch_jax.shapes.compound import CONVEX, Compound, Piece, centred, half_extents, inertial
from mechsearch_jax.workspace.camera import Camera, rays
from mechsearch_jax.workspace.scenario import Body, Scenario, pieces_of
from mechsearch_jax.workspace.shelf import Shelf

CAMERA = Camera().scaled(8)
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
BOX = Body("box", (0.054, 0.025, 0.054), (0.55, 0.1, 0.4585), UPRIGHT)
TARGET_BODY = Body("cylinder", (0.02, 0.02, 0.05), (0.7, 0.0, 0.4545), UPRIGHT)
ON_ITS_SIDE = (0.5**0.5, 0.0, 0.5**0.5, 0.0)
BALL = tuple(map(tuple, np.round(0.03 * np.asarray(trimesh.creation.icosphere(subdivisions=1).vertices), 6).tolist()))


def body(*pieces, place=(0.6, 0.1, 0.55), turn=UPRIGHT, **matter):
    compound, _ = centred(Compound(pieces, **{"density": 500.0, "friction": 0.5, **matter}))
    return Body("compound", half_extents(compound), place, turn, compound)


MUG = (Piece("cylinder", (0.04, 0.04, 0.05)), Piece("capsule", (0.008, 0.008, 0.035), (0.055, 0.0, 0.0)))
THINGS = (
    body(*MUG, place=(0.55, 0.2, 0.4545)),
    body(
        Piece("frustum", (0.04, 0.02, 0.05)),
        Piece("ellipsoid", (0.03, 0.02, 0.02), (0, 0, 0.06)),
        place=(0.6, 0.05, 0.5),
    ),
    body(Piece("box", (0.02, 0.03, 0.05)), Piece("cylinder", (0.02, 0.02, 0.05), (0.05, 0, 0.02), ON_ITS_SIDE)),
    BOX,
)
SCENE = Scenario("things", THINGS, TARGET_BODY)


def tilted(scene, seed):
    """The scene with every compound at any rotation."""
    turns = Rotation.random(len(scene.objects), random_state=seed).as_quat(scalar_first=True)
    bodies = tuple(
        dataclasses.replace(b, quaternion=tuple(q.tolist())) for b, q in zip(scene.objects, turns, strict=True)
    )
    return dataclasses.replace(scene, objects=bodies)


def compiled(scene, skin=0.0):
    bodies = world.slots(scene)
    blank = model.compile_model(Shelf(), CAMERA, compounds=model.compounds_in(bodies), skin=skin)
    return model.with_bodies(blank, bodies, skin=skin), bodies


def test_bodies_come_back_from_a_world():
    polyhedron = body(Piece(CONVEX, (0.0,) * 3, vertices=BALL), place=(0.5, -0.1, 0.45), colour=(0.5, 0.25, 0.75))
    scene = tilted(Scenario("more", (*THINGS, polyhedron), TARGET_BODY), 0)
    again = world.bodies_of(world.from_scenario(scene))
    for given, back in zip(world.slots(scene), again, strict=True):
        assert (given is None) == (back is None)
        if given is None:
            continue
        np.testing.assert_allclose(back.position, given.position, atol=1e-6)
        np.testing.assert_allclose(back.half_size, given.half_size, atol=1e-5)
        assert (back.compound is None) == (given.compound is None)
        a, b = inertial(pieces_of(given)), inertial(pieces_of(back))
        np.testing.assert_allclose([b.mass, *b.moments], [a.mass, *a.moments], rtol=1e-4)
    assert again[4].compound.colour == polyhedron.compound.colour


def test_the_model_has_the_mass_and_the_geometry_of_the_compounds():
    made, bodies = compiled(tilted(SCENE, 1))
    state = model.initial_state(made, bodies)
    for slot, one in enumerate(bodies):
        if one is None or one.compound is None:
            continue
        weight, index = inertial(one.compound), made.body(f"body{slot}").id
        assert made.body_mass[index] == pytest.approx(weight.mass)
        np.testing.assert_allclose(made.body_inertia[index], weight.moments)
        turn = Rotation.from_quat(one.quaternion, scalar_first=True).as_matrix() @ weight.rotation
        tensor = turn @ np.diag(weight.moments) @ turn.T
        axes = state.ximat[index].reshape(3, 3)
        np.testing.assert_allclose(axes @ np.diag(made.body_inertia[index]) @ axes.T, tensor, atol=1e-9)
        geoms = np.flatnonzero(made.geom_bodyid == index)
        assert {float(made.geom_friction[g, 0]) for g in geoms} == {0.5}


def cast(made, state, camera, step):
    """Depth and body of what MuJoCo's own rays hit, for every step-th pixel."""
    directions = np.asarray(rays(camera), float)[::step, ::step]
    groups = np.array([1, 1, 0, 0, 0, 0], np.uint8)
    depth = np.full(directions.shape[:2], np.inf)
    owner = np.full(directions.shape[:2], -1)
    hit = np.zeros(1, np.int32)
    for index in np.ndindex(*depth.shape):
        way = directions[index]
        length = np.linalg.norm(way)
        far = mujoco.mj_ray(made, state, np.array(camera.position), way / length, groups, 1, -1, hit)
        if far >= 0:
            name = made.body(made.geom_bodyid[hit[0]]).name
            depth[index], owner[index] = far / length, int(name[4:]) if name.startswith("body") else 9
    return depth, owner


@pytest.mark.parametrize("seed", [0, 1])
def test_depth_is_that_of_the_rays_of_mujoco(seed):
    """An independent ray cast, of the same solids: exact but at silhouettes and grazing rays."""
    polyhedron = body(Piece(CONVEX, (0.0,) * 3, vertices=BALL), place=(0.5, -0.1, 0.45))
    scene = tilted(Scenario("more", (*THINGS, polyhedron), TARGET_BODY), seed)
    seen = simulated_camera.observe(CAMERA, world.from_scenario(scene))
    made, bodies = compiled(scene)
    depth, owner = cast(made, model.initial_state(made, bodies), CAMERA, 2)
    computed, shown = np.asarray(seen.depth)[::2, ::2], np.asarray(seen.segmentation)[::2, ::2]
    same = shown == owner
    assert {*range(5), simulated_camera.SHELF} <= {*shown[same].tolist()}
    assert same.mean() > 0.995
    finite = same & np.isfinite(depth)
    np.testing.assert_array_equal(np.isfinite(computed[same]), np.isfinite(depth[same]))
    apart = np.abs(computed[finite] - depth[finite])
    assert np.quantile(apart, 0.99) < 2e-5
    assert apart.max() < 1e-3


BALL_PIECE = Piece(CONVEX, (0.0,) * 3, vertices=BALL)
ROOF = tuple((x, y, z) for z, wide in ((-0.05, 0.04), (0.05, 0.01)) for x in (-wide, wide) for y in (-0.04, 0.04))


@pytest.mark.parametrize("pieces", [MUG, (Piece(CONVEX, (0.0,) * 3, vertices=ROOF),)], ids=["mug", "polyhedron"])
def test_normals_are_those_of_the_depth(pieces):
    """The normal of a body's smooth parts is the cross product of differences of its points in the image."""
    camera = Camera().scaled(2)
    scene = Scenario("one", (body(*pieces, place=(0.55, 0.1, 0.4545)),), TARGET_BODY)
    plain = simulated_camera.Appearance(np.ones((10, 3), np.float32), np.array((0.0, 0.0, 1.0)))
    seen = simulated_camera.observe(camera, world.from_scenario(scene), None, plain)
    depth = np.asarray(seen.depth)
    points = np.asarray(rays(camera)) * np.where(np.isfinite(depth), depth, 9.0)[..., None]
    cross = np.cross(np.diff(points, axis=1)[:-1], np.diff(points, axis=0)[:, :-1])
    cross /= np.maximum(np.linalg.norm(cross, axis=-1, keepdims=True), 1e-12)
    light = simulated_camera.AMBIENT + (1 - simulated_camera.AMBIENT) * np.maximum(np.abs(cross[..., 2]), 0.0)
    on_body = (np.asarray(seen.segmentation) == 0)[:-1, :-1]
    assert on_body.sum() > 500
    assert np.median(np.abs(np.asarray(seen.colour)[:-1, :-1, 0] - light)[on_body]) < 0.01


def test_polyhedra_look_alone_as_they_do_side_by_side():
    """Rays are cut only where they come near one, which a batch does for all its worlds together."""
    here = Scenario("here", (body(BALL_PIECE, place=(0.5, -0.1, 0.45)), BOX), TARGET_BODY)
    there = Scenario("there", (body(BALL_PIECE, place=(0.65, 0.2, 0.6), turn=ON_ITS_SIDE), BOX), TARGET_BODY)
    worlds = [world.from_scenario(scene) for scene in (here, there)]
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *worlds)
    both = jax.jit(jax.vmap(lambda one: simulated_camera.observe(CAMERA, one)))(stacked)
    for i, one in enumerate(worlds):
        alone = simulated_camera.observe(CAMERA, one)
        assert (np.asarray(alone.segmentation) == 0).sum() > 20
        np.testing.assert_array_equal(both.segmentation[i], alone.segmentation)
        np.testing.assert_allclose(both.depth[i], alone.depth, atol=1e-5)
        np.testing.assert_allclose(both.colour[i], alone.colour, atol=1e-4)


def test_a_compound_rests_on_its_pieces():
    table = (Piece("box", (0.04, 0.04, 0.005), (0, 0, 0.05)), Piece("cylinder", (0.03, 0.03, 0.025), (0, 0, 0.02)))
    one = body(*table, place=(0.6, 0.1, 0.55))
    simulator = NativeWorld()
    simulator.reset(Scenario("one", (one,), TARGET_BODY))
    outcome = simulator.settle()
    assert bool(outcome.settled)
    after = simulator.scenario("after").objects[0]
    (_, foot) = one.compound.pieces
    assert after.position[2] == pytest.approx(Shelf().board + 0.025 - foot.position[2], abs=5e-4)
    assert after.compound == one.compound


def test_a_polyhedron_rests_like_the_box_of_its_corners():
    corners = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T * (0.03, 0.02, 0.05)
    heights = []
    for piece in (
        Piece(CONVEX, (0.0,) * 3, vertices=tuple(map(tuple, corners.tolist()))),
        Piece("box", (0.03, 0.02, 0.05)),
    ):
        simulator = NativeWorld()
        simulator.reset(Scenario("one", (body(piece),), TARGET_BODY))
        simulator.settle()
        heights.append(simulator.scenario("after").objects[0].position[2])
    np.testing.assert_allclose(heights, Shelf().board + 0.05, atol=5e-4)


def test_scenes_with_and_without_compounds_run_side_by_side():
    plain = Scenario("plain", (BOX,), TARGET_BODY)
    polyhedron = Scenario("ball", (body(Piece(CONVEX, (0.0,) * 3, vertices=BALL)),), TARGET_BODY)
    simulator = NativeSimulator(threads=1)
    both = simulator.reset([plain, SCENE, polyhedron])
    assert both.compounds is not None
    assert both.valid.sum(axis=1).tolist() == [2, 5, 2]
    simulator.settle()
    assert simulator.world.compounds is not None
    alone = NativeSimulator(threads=1)
    alone.reset([plain])
    alone.settle()
    np.testing.assert_array_equal(simulator.world.position[0], alone.world.position[0])
    # What was stacked can be set again.
    simulator.load(jax.tree.map(lambda leaf: leaf[:2], simulator.world))
    np.testing.assert_allclose(simulator.world.position[0], alone.world.position[0])
