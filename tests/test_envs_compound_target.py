"""A target that is a compound in the world: its files, arrays and image, how it rests, in trials and in the batch."""

import json
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_envs_simulator import pose, take_out

from mechsearch_jax.envs.camera.simulated_camera import PALETTE, observe, target_pixels
from mechsearch_jax.envs.camera.snapshot import Snapshot, objects_on_the_board, oracle, sight_of
from mechsearch_jax.envs.episode.episodes import target_of
from mechsearch_jax.envs.simulators.batch_model import ROOM, cells_of, compound_fields, fitting, room_for
from mechsearch_jax.envs.simulators.native import NativeWorld
from mechsearch_jax.envs.simulators.simulator import SimulatorConfig
from mechsearch_jax.envs.trials import native as trials
from mechsearch_jax.envs.world import model
from mechsearch_jax.envs.world.mismatch import ASSUMED_CELL, TrueCell
from mechsearch_jax.envs.world.world import (
    BODIES,
    TARGET,
    bodies_of,
    fallen_over,
    from_scenario,
    slots,
    with_target,
)
from mechsearch_jax.geometry.bodies import PARTS
from mechsearch_jax.geometry.superquadric import empty
from mechsearch_jax.robot.gripper import Gripper
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.shapes.compound import CONVEX, Piece
from mechsearch_jax.workspace import scenario as scenarios
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import Body, Scenario
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target, load_target

UPRIGHT = (1.0, 0.0, 0.0, 0.0)
SHELF = Shelf()
BOX = Body("box", (0.02, 0.08, 0.06), (0.5, 0.15, SHELF.board + 0.06), UPRIGHT)
MUG = Target.from_parts(
    (
        Piece("cylinder", (0.03, 0.03, 0.045)),
        Piece("box", (0.004, 0.005, 0.03), (0.05, 0.0, 0.0)),
        Piece("box", (0.012, 0.005, 0.004), (0.038, 0.0, 0.026)),
        Piece("box", (0.012, 0.005, 0.004), (0.038, 0.0, -0.026)),
    ),
    density=500.0,
    friction=0.5,
)
WEDGE = ((-0.025, -0.02, -0.04), (0.025, -0.02, -0.04), (-0.025, 0.02, -0.04), (0.025, 0.02, -0.04), (0.0, 0.0, 0.06))
TENT = Target.from_parts((Piece(CONVEX, (0.0, 0.0, 0.0), vertices=WEDGE),))
TALL = Target.from_parts((Piece("box", (0.03, 0.03, 0.15)), Piece("box", (0.01, 0.06, 0.01))))


def standing(target, x=0.65, y=0.1, yaw=0.0):
    """The body of a target on the board."""
    turn = (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))
    return Body(target.shape, target.half_size, (x, y, SHELF.board + target.bottom), turn, target.compound)


def hidden(target, *objects, **place):
    return Scenario("hidden", objects, standing(target, **place))


@pytest.mark.parametrize("target", [MUG, TENT], ids=["mug", "polyhedron"])
def test_a_scenario_with_a_compound_target_is_written_and_read(tmp_path, target):
    scene = hidden(target, BOX, yaw=0.5)
    scenarios.save_scenario(scene, tmp_path / "scene.json")
    again = scenarios.load_scenario(tmp_path / "scene.json")
    assert again == scene
    assert again.content_hash == scene.content_hash
    assert json.loads((tmp_path / "scene.json").read_text())["version"] == 2
    assert target_of(again, Target()) == target
    assert hash(target_of(again, Target())) == hash(target)


def test_only_a_world_whose_target_is_a_compound_knows_one():
    cylinder = Body("cylinder", (0.02, 0.02, 0.05), (0.7, 0.0, 0.4545), UPRIGHT)
    plain, things = Scenario("plain", (BOX,), cylinder), Scenario("things", (standing(MUG),), cylinder)
    assert from_scenario(plain).compounds is from_scenario(plain).target is from_scenario(things).target is None
    assert from_scenario(things).compounds is not None
    world = from_scenario(hidden(MUG, BOX))
    assert world.compounds is not None
    assert world.target is not None
    assert bodies_of(world)[TARGET].compound == MUG.compound
    assert bodies_of(world)[0].shape == "box"


def test_a_plain_world_gets_the_targets_pieces():
    scene = hidden(MUG, BOX, yaw=0.5)
    world = from_scenario(scene)
    plain = world.replace(compounds=None, target=None)
    again = with_target(plain, MUG)
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(world), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6)
    assert with_target(plain, Target.box()) is plain


def test_objects_beside_a_compound_target_have_parts_only_if_one_is_a_compound():
    """With parts all programs of a decision are twice as large."""

    def seen(scene):
        return Snapshot(Camera(), SHELF, from_scenario(scene))

    objects = objects_on_the_board(seen(hidden(MUG, BOX)))
    assert objects.parts is None
    plain = objects_on_the_board(seen(Scenario("plain", (BOX,), standing(Target.cylinder()))))
    jax.tree.map(np.testing.assert_array_equal, objects, plain)
    assert oracle(jax.random.key(0), seen(hidden(MUG, BOX))).objects.parts is None
    both = hidden(MUG, BOX, standing(TALL, x=0.5, y=-0.1))
    assert objects_on_the_board(seen(both)).parts.capacity == PARTS
    # Where it is not known which bodies are compounds, all have room for parts.
    traced = jax.eval_shape(lambda world: objects_on_the_board(Snapshot(Camera(), SHELF, world)), seen(both).world)
    assert traced.parts.capacity == PARTS


def test_the_camera_sees_the_target_in_its_own_colour():
    image = observe(Camera().scaled(4), from_scenario(hidden(MUG)))
    there = np.asarray(image.segmentation) == TARGET
    assert there.sum() > 100
    shades = np.asarray(image.colour)[there] / PALETTE[TARGET]
    np.testing.assert_allclose(shades, np.repeat(shades[:, :1], 3, axis=1), atol=1e-5)


@pytest.mark.parametrize("place", [{"x": 0.46, "y": 0.35}, {"x": 0.72, "y": -0.2}], ids=["near", "far"])
def test_all_of_a_tall_target_is_counted(place):
    world = from_scenario(hidden(TALL, **place))
    whole = int((np.asarray(observe(Camera(), world).segmentation) == TARGET).sum())
    assert int(target_pixels(Camera(), world)) == whole
    sight = sight_of(Camera(), SHELF, TALL)
    assert int(target_pixels(Camera(), world, sight.window)) == whole
    assert bool(Snapshot(Camera(), SHELF, world).target_seen)
    assert sight_of(Camera(), SHELF, Target.box()).window == sight_of(Camera(), SHELF).window


@pytest.mark.parametrize("target", [MUG, TENT, TALL], ids=["mug", "polyhedron", "tall"])
def test_it_stands_where_it_is_put(target):
    simulator = NativeWorld()
    before = simulator.reset(hidden(target, BOX, yaw=0.5))
    outcome = simulator.settle()
    assert bool(outcome.settled)
    assert not np.asarray(outcome.fallen).any()
    np.testing.assert_allclose(simulator.world.position, before.position, atol=1e-3)
    assert simulator.world.rotation[TARGET][2, 2] > 0.999
    assert simulator.scenario("after").target.compound == target.compound


def test_the_hand_takes_it_out():
    simulator = NativeWorld()
    simulator.reset(hidden(MUG, x=0.6, y=0.1, yaw=math.pi))
    outcome = simulator.execute(take_out(pose(0.6, 0.1, 0.05)))
    assert bool(outcome.retrieved), outcome.reason()


def test_a_found_target_stands_in_trials_as_what_it_is():
    cell, simulation = trials.TrialSetup(MUG, SHELF, Gripper()), SimulatorConfig()
    at, nothing = jnp.array([0.6, 0.1, 0.5]), jax.device_get(empty(TARGET))
    for found in (True, False):
        world = jax.device_get(trials.trial_world(MUG, SHELF, nothing, at, jnp.array(found)))
        scene = trials.scene_at_rest(cell, simulation, world, nothing, 1.0)
        assert scene is not None
        assert not scene.diverged
        body = scene._bodies[TARGET]
        assert (body is not None) == found
        if found:
            assert body.compound == MUG.compound
            rests = scene._data.joint(f"body{TARGET}").qpos[:3]
            np.testing.assert_allclose(rests, (0.6, 0.1, SHELF.board + MUG.bottom), atol=1e-3)


@pytest.mark.slow
def test_the_batch_model_holds_the_target_itself():
    scenes = [hidden(TENT, BOX, yaw=0.5), hidden(TENT, standing(MUG, 0.5, -0.1), x=0.7)]
    factors = np.linspace(0.5, 1.5, BODIES)
    cells = [ASSUMED_CELL, TrueCell(friction=0.5, mass=2.0, body_friction=factors, body_mass=factors[::-1])]
    worlds = [from_scenario(scene) for scene in scenes]
    world = jax.tree.map(lambda *leaves: jax.device_put(np.stack(leaves)), *worlds)
    assert room_for(world) == {**ROOM, TARGET: TENT.compound}
    blank = model.compile_model(SHELF, Camera(), compounds=room_for(world))
    assert fitting(world, room_for(world)) is world
    fields = compound_fields(blank, world, cells_of(blank, cells))
    for w, (scene, cell) in enumerate(zip(scenes, cells, strict=True)):
        own = NativeWorld()
        own.place(slots(scene), cell)
        for name in ("body_mass", "body_inertia", "body_invweight0", "body_iquat", "body_gravcomp"):
            body = blank.body(f"body{TARGET}").id
            found, wanted = np.asarray(getattr(fields, name))[w, body], getattr(own._model, name)[body]
            np.testing.assert_allclose(found, wanted, 1e-5, 1e-7, err_msg=name)
        geoms = [np.flatnonzero(m.geom_bodyid == m.body(f"body{TARGET}").id) for m in (blank, own._model)]
        assert len(geoms[0]) == len(geoms[1]) == 1
        for name in ("friction", "size", "rbound", "pos", "quat"):
            found, wanted = np.asarray(getattr(fields, f"geom_{name}"))[w, geoms[0]], own._model
            np.testing.assert_allclose(found, getattr(wanted, f"geom_{name}")[geoms[1]], 1e-5, 1e-6, err_msg=name)


BODY = {
    "density": 500,
    "friction": 0.4,
    "pieces": [{"shape": "box", "half_size": [0.03, 0.02, 0.05], "position": [0, 0, 0], "quaternion": list(UPRIGHT)}],
}


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ({"shape": "box"}, "must be a JSON object with pieces or mesh, density and friction"),
        ({**BODY, "position": [0, 0, 0]}, 'unknown key "position"'),
        ({**BODY, "quaternion": [1, 1, 0, 0]}, "quaternion: its norm is"),
        ({**BODY, "pieces": []}, "pieces: must be a list of at least one piece"),
    ],
)
def test_what_is_wrong_with_a_target_file_is_named(tmp_path, value, message):
    (tmp_path / "body.json").write_text(json.dumps(value))
    with pytest.raises(InputError) as caught:
        load_target(tmp_path / "body.json")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_compound_that_is_upside_down_has_fallen_over_and_a_cylinder_stands_on_either_end():
    flipped = np.diag([1.0, -1.0, -1.0])
    assert fallen_over(flipped, MUG.solid.ends_alike)
    assert not fallen_over(flipped, Target.cylinder().solid.ends_alike)
    for target in (MUG, Target.cylinder()):
        assert not fallen_over(np.eye(3), target.solid.ends_alike)
        assert fallen_over(np.eye(3)[[1, 2, 0]], target.solid.ends_alike)
