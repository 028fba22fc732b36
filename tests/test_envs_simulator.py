"""The native simulator: what every motion primitive does to the world."""

import dataclasses
import math
import subprocess
import sys

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from published import published_scenarios

from mechsearch_jax.actions import Action, ActionKind, kind_of, no_action, retrieve_action
from mechsearch_jax.actions.trajectory import reference_motion
from mechsearch_jax.envs.simulators import simulator
from mechsearch_jax.envs.simulators.native import NativeWorld
from mechsearch_jax.envs.world import model, world
from mechsearch_jax.envs.world.world import BODIES, TARGET
from mechsearch_jax.geometry.transforms import make
from mechsearch_jax.robot.arm_config import ARMS, PANDA
from mechsearch_jax.robot.grasp_frames import gripper_rotation
from mechsearch_jax.robot.gripper import arm_hits_shelf
from mechsearch_jax.robot.kinematics import (
    HOME,
    forward_kinematics,
    gripper_pose,
    line_kinematics,
)
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.shapes import shape_of
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import Body, Scenario, load_scenario
from mechsearch_jax.workspace.shelf import Shelf

BOARD = Shelf().board
WRISTS = tuple(math.pi / 4 + math.radians(a) for a in (15, -60, 60, -15, -45, 30, -30, 0, 45))
TARGET_BODY = Body("cylinder", (0.02, 0.02, 0.05), (0.72, -0.2, BOARD + 0.05), (1.0, 0.0, 0.0, 0.0))


def standing(shape, half, x, y, yaw=0.0):
    return Body(shape, half, (x, y, BOARD + half[2]), (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)))


def scene(*objects, target=TARGET_BODY):
    return Scenario("scene", tuple(objects), target)


TILT = math.radians(20)


def pose(x, y, z, yaw=0.0, tilt=TILT):
    """A gripper pose as the planner makes them; z above the board."""
    return make(gripper_rotation(jnp.float32(yaw), jnp.float32(tilt)), jnp.array([x, y, BOARD + z], jnp.float32))


def wrist_for(*poses):
    """An angle of joint 7 with which the arm makes the straight approach to every pose without touching the shelf."""
    for q7 in WRISTS:
        lines = [line_kinematics(T, jnp.float32(0.3), jnp.float32(q7), 16) for T in poses]
        if all(bool(ok) and not bool(arm_hits_shelf(q, Shelf()).any()) for q, ok in lines):
            return jnp.float32(q7)
    raise AssertionError("the test's poses are out of reach")


def push(T, displacement, index=0):
    displacement = jnp.array(displacement, jnp.float32)
    end = T.at[:3, 3].add(displacement)
    return Action(
        kind=jnp.int32(ActionKind.PUSH),
        object=jnp.int32(index),
        T_world_gripper=T,
        displacement=displacement,
        T_world_place=end,
        q7=wrist_for(T, end),
        opening=jnp.float32(0.0),
    )


def pick_and_place(T, place, index=0):
    return Action(
        kind=jnp.int32(ActionKind.PICK_AND_PLACE),
        object=jnp.int32(index),
        T_world_gripper=T,
        displacement=jnp.zeros(3),
        T_world_place=place,
        q7=wrist_for(T, place),
        opening=jnp.float32(0.08),
    )


def take_out(T, q7=None):
    return retrieve_action(T, wrist_for(T) if q7 is None else jnp.float32(q7), jnp.float32(0.08))


@pytest.fixture(scope="module")
def sim():
    return NativeWorld()


def moved(sim, before, index=0):
    return np.asarray(sim.world.position[index] - before.position[index])


def test_the_model_has_the_robot_of_the_kinematics():
    compiled = model.compile_model(Shelf(), Camera())
    data = mujoco.MjData(compiled)
    rng = np.random.default_rng(0)
    for _ in range(5):
        q = rng.uniform(PANDA.lower, PANDA.upper)
        data.qpos[:7] = q
        mujoco.mj_kinematics(compiled, data)
        frames = np.asarray(forward_kinematics(jnp.asarray(q, jnp.float32)))
        for i in range(7):
            np.testing.assert_allclose(data.body(f"link{i + 1}").xpos, frames[i, :3, 3], atol=2e-6)
            np.testing.assert_allclose(data.body(f"link{i + 1}").xmat.reshape(3, 3), frames[i, :3, :3], atol=2e-6)
        np.testing.assert_allclose(data.site("gripper").xpos, gripper_pose(q)[:3, 3], atol=2e-6)
        np.testing.assert_allclose(data.site("gripper").xmat.reshape(3, 3), gripper_pose(q)[:3, :3], atol=2e-6)
    for arm in ARMS.values():
        assert (compiled.jnt_range[:7, 0] <= np.array(arm.least) + 1e-6).all()
        assert (compiled.jnt_range[:7, 1] >= np.array(arm.most) - 1e-6).all()


@pytest.mark.parametrize("body", [standing("box", (0.03, 0.02, 0.05), 0.6, 0.1), TARGET_BODY])
def test_bodies_have_the_mass_and_inertia_of_their_shape(body):
    kind = "cylinder" if body.shape == "cylinder" else "box"
    size = body.half_size if kind == "box" else (body.half_size[0], body.half_size[2], 0.0)
    density = shape_of(kind).density
    geom = f'<geom type="{kind}" size="{size[0]} {size[1]} {size[2]}" density="{density}"/>'
    alone = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><body name="it"><freejoint/>{geom}</body></worldbody></mujoco>'
    )
    mass, inertia = model.mass_and_inertia(body)
    assert mass == pytest.approx(alone.body("it").mass[0])
    np.testing.assert_allclose(np.sort(inertia), np.sort(alone.body("it").inertia))
    compiled = model.with_bodies(model.compile_model(Shelf(), Camera()), [body] + [None] * (BODIES - 1))
    assert compiled.body("body0").mass[0] == pytest.approx(mass)
    assert compiled.body("body1").mass[0] < 0.01


def test_reset_keeps_the_scenario_exactly_and_rest_does_not_move_it(sim):
    start = scene(
        standing("box", (0.054, 0.025, 0.054), 0.6, 0.1, 0.3), standing("cylinder", (0.024, 0.024, 0.067), 0.5, 0)
    )
    before = sim.reset(start)
    np.testing.assert_allclose(before.position, world.from_scenario(start).position)
    outcome = sim.settle()
    assert outcome.settled
    np.testing.assert_allclose(sim._data.qpos[: len(HOME)], HOME, atol=1e-3)
    assert not outcome.fallen.any()
    assert np.abs(np.asarray(sim.world.position - before.position)).max() < 5e-4
    again = sim.scenario("again")
    assert [b.shape for b in again.objects] == ["box", "cylinder"]
    np.testing.assert_allclose(again.target.position, start.target.position, atol=5e-4)


def test_nothing_native_imports_the_batch_simulator():
    code = """
import sys
import mechsearch_jax.envs.simulators.native, mechsearch_jax.envs.episode.episodes, mechsearch_jax.envs.scenes.generator
sys.exit(any(name.startswith(("mujoco.mjx", "warp", "mechsearch_jax.envs.simulators.mjx")) for name in sys.modules))
"""
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_more_objects_than_slots_are_refused(sim):
    with pytest.raises(InputError, match="9 objects are too many"):
        sim.reset(scene(*[standing("box", (0.01, 0.01, 0.02), 0.45 + 0.03 * i, 0.1) for i in range(9)]))


@pytest.mark.parametrize("distance", [0.05, 0.15, -0.1])
@pytest.mark.parametrize(
    "body",
    [
        standing("box", (0.054, 0.025, 0.054), 0.55, 0.1),
        standing("cylinder", (0.032, 0.032, 0.067), 0.55, 0.1),
        standing("box", (0.042, 0.018, 0.035), 0.55, 0.1),
    ],
    ids=["box", "cylinder", "low-box"],
)
def test_a_push_moves_the_object_by_the_distance_less_the_gap(sim, body, distance):
    gap, side = 0.01, math.copysign(1.0, distance)
    before = sim.reset(scene(body))
    start = pose(0.595, 0.1 - side * (body.half_size[1] + 0.1025 + gap), 0.04, tilt=math.radians(30))
    outcome = sim.execute(push(start, (0.0, distance, 0.0)))
    change = moved(sim, before)
    assert outcome.reason() is None
    assert not outcome.fallen.any()
    assert side * change[1] == pytest.approx(abs(distance) - gap, abs=0.012)
    assert abs(change[0]) < 0.02
    assert sim.world.rotation[0, 2, 2] > 0.999
    assert np.abs(moved(sim, before, TARGET)).max() < 1e-3


@pytest.mark.parametrize(
    ("body", "depth", "height", "tilt"),
    [
        (standing("cylinder", (0.024, 0.024, 0.067), 0.6, 0.1), 0.004, 0.1, 20),
        (standing("cylinder", (0.034, 0.034, 0.107), 0.6, 0.1), 0.012, 0.15, 20),
        (standing("box", (0.03, 0.012, 0.06), 0.6, 0.1), 0.01, 0.08, 30),
        (standing("box", (0.054, 0.025, 0.054), 0.6, 0.1), 0.034, 0.08, 20),
        (standing("box", (0.078, 0.022, 0.096), 0.6, 0.1), 0.06, 0.12, 20),
        (standing("cylinder", (0.028, 0.028, 0.03), 0.6, 0.1), 0.008, 0.045, 30),
    ],
)
def test_a_pick_and_place_puts_the_object_where_commanded(sim, body, depth, height, tilt):
    """Grasped `depth` in front of its centre and turned by 0.3 rad about its own axis."""
    turn, goal = 0.3, np.array([0.55, 0.22])
    before = sim.reset(scene(body))
    grasp = pose(0.6 - depth, 0.1, height, 0.0, math.radians(tilt))
    place = pose(goal[0] - depth * math.cos(turn), goal[1] - depth * math.sin(turn), height, turn, math.radians(tilt))
    outcome = sim.execute(pick_and_place(grasp, place))
    assert outcome.reason() is None
    assert outcome.settled
    assert np.linalg.norm(np.asarray(sim.world.position[0, :2]) - goal) < 0.01
    assert abs(float(sim.world.position[0, 2]) - body.position[2]) < 1e-3
    rotation = np.asarray(sim.world.rotation[0])
    assert rotation[2, 2] > 0.999
    if body.shape == "box":
        assert abs(math.atan2(rotation[1, 0], rotation[0, 0]) - turn) < math.radians(4)
    assert np.abs(moved(sim, before, TARGET)).max() < 1e-3


def test_a_held_object_stays_where_it_is_in_the_hand(sim):
    body = standing("cylinder", (0.032, 0.032, 0.067), 0.6, 0.1)
    sim.reset(scene(body))
    action, plan = pick_and_place(pose(0.59, 0.1, 0.1), pose(0.5, 0.2, 0.1)), sim.config.motion
    sim.execute(action)
    trace = sim.trace
    reference, _ = reference_motion(kind_of(int(action.kind)), action, plan)
    closed, opens = (float(step) * plan.timestep for step in (reference.closed, reference.opens))
    held = (trace.time > closed + 0.1) & (trace.time < opens)
    T = np.asarray(gripper_pose(trace.q[held]))
    offset = trace.position[held, 0] - T[:, :3, 3]
    local = np.einsum("fji,fj->fi", T[:, :3, :3], offset)
    assert held.sum() > 30
    assert np.ptp(local, axis=0).max() < 0.02


def test_a_hand_that_closes_on_nothing_reports_a_drop(sim):
    before = sim.reset(scene(standing("cylinder", (0.024, 0.024, 0.067), 0.6, 0.1)))
    outcome = sim.execute(pick_and_place(pose(0.5, 0.3, 0.1), pose(0.55, 0.2, 0.1)))
    assert outcome.reason() == "dropped"
    assert np.abs(moved(sim, before)).max() < 1e-3


def test_a_body_that_never_comes_to_rest_is_reported():
    """In 0.2 s it has not fallen from 10 cm above the board; in 6 s it has."""
    high = dataclasses.replace(TARGET_BODY, position=(0.6, 0.1, BOARD + 0.15))
    for steps, rests in ((50, False), (1500, True)):
        single = NativeWorld(config=simulator.SimulatorConfig(settle_steps=steps))
        single.reset(scene(target=high))
        outcome = single.settle()
        assert bool(outcome.settled) == rests
        assert outcome.reason() is None


def test_what_is_out_of_reach_moves_nothing(sim):
    before = sim.reset(scene(standing("cylinder", (0.024, 0.024, 0.067), 0.6, 0.1)))
    far = pose(1.3, 0.1, 0.1)
    action = dataclasses.replace(no_action(), kind=jnp.int32(ActionKind.PUSH), T_world_gripper=far)
    outcome = sim.execute(action)
    assert outcome.reason() == "unreachable"
    assert outcome.steps == 0
    assert len(sim.trace.time) == 0
    np.testing.assert_array_equal(sim.world.position, before.position)
    retrieval = sim.execute(take_out(far, math.pi / 4))
    assert retrieval.reason() == "unreachable"
    assert not retrieval.retrieved


def test_an_object_that_leaves_the_board_has_fallen(sim):
    body = standing("cylinder", (0.024, 0.024, 0.067), 0.5, 0.1)
    sim.reset(scene(body))
    outcome = sim.execute(pick_and_place(pose(0.496, 0.1, 0.1), pose(0.39, 0.1, 0.1)))
    assert outcome.fallen[0]
    assert not outcome.fallen[1:].any()


def test_an_object_that_is_pushed_over_the_front_edge_has_fallen(sim):
    sim.reset(scene(standing("cylinder", (0.024, 0.024, 0.067), 0.43, 0.1)))
    outcome = sim.execute(push(pose(0.505, 0.1 - 0.1365, 0.04, tilt=math.radians(30)), (-0.05, 0.12, 0.0)))
    assert outcome.fallen[0]
    assert not outcome.fallen[1:].any()
    assert outcome.reason() is None


@pytest.mark.parametrize("place", [(0.6, 0.1), (0.7, 0.2), (0.65, 0.25)])
@pytest.mark.parametrize("shape", ["cylinder", "box"])
def test_a_retrieval_takes_the_target_out(sim, shape, place):
    half = (0.02, 0.02, 0.05) if shape == "cylinder" else (0.015, 0.02, 0.05)
    bystander = standing("box", (0.03, 0.012, 0.06), 0.65, -0.2)
    before = sim.reset(scene(bystander, target=standing(shape, half, *place)))
    grasp = pose(*place, 0.06, tilt=math.radians(30))
    retrieval = sim.execute(take_out(grasp))
    assert retrieval.retrieved
    assert retrieval.reason() is None
    assert retrieval.held
    assert retrieval.outside
    assert not retrieval.fallen.any()
    assert sim.world.position[TARGET, 0] < Shelf().front
    assert np.abs(moved(sim, before)).max() < 1e-3


def test_a_retrieval_that_grasps_beside_the_target_misses(sim):
    sim.reset(scene(target=standing("cylinder", (0.02, 0.02, 0.05), 0.6, 0.1)))
    grasp = pose(0.55, 0.3, 0.06)
    retrieval = sim.execute(take_out(grasp))
    assert retrieval.reason() == "missed"
    assert not retrieval.retrieved


def test_a_retrieval_that_throws_an_object_down_does_not_count(sim):
    target = standing("cylinder", (0.02, 0.02, 0.05), 0.6, 0.1)
    at_the_edge = standing("cylinder", (0.024, 0.024, 0.03), 0.425, 0.1)
    sim.reset(scene(at_the_edge, target=target))
    retrieval = sim.execute(take_out(pose(0.6, 0.1, 0.06)))
    assert retrieval.held
    assert retrieval.outside
    assert retrieval.fallen[0]
    assert retrieval.reason() == "fallen"
    assert not retrieval.retrieved


def test_a_retrieval_is_not_blamed_for_what_fell_before(sim):
    target = standing("cylinder", (0.02, 0.02, 0.05), 0.6, 0.1)
    in_front = standing("cylinder", (0.024, 0.024, 0.067), 0.5, 0.1)
    sim.reset(scene(in_front, target=target))
    assert sim.execute(pick_and_place(pose(0.496, 0.1, 0.1), pose(0.39, 0.3, 0.1))).fallen[0]
    retrieval = sim.execute(take_out(pose(0.6, 0.1, 0.06)))
    assert retrieval.fallen[0]
    assert retrieval.reason() is None
    assert retrieval.retrieved


def test_an_arm_that_shoves_a_box_against_the_wall_is_held_up(sim):
    """The hand is to go 8 cm farther than the wall lets the box go; the box stays where that leaves it."""
    box = standing("box", (0.078, 0.048, 0.1), 0.6, Shelf().left - 0.078)
    before = sim.reset(scene(box))
    start = pose(0.62, box.position[1] - 0.048 - 0.1125, 0.06, tilt=math.radians(30))
    action = push(start, (0.0, 0.05, 0.0)).replace(displacement=jnp.array([0.0, 0.12, 0.0]))
    outcome = sim.execute(action.replace(T_world_place=start.at[1, 3].add(0.12)))
    assert outcome.reason() == "the arm was held up"
    assert outcome.tracking_error > 2 * sim.config.tracking_bound
    assert np.abs(moved(sim, before)).max() > 0.005


def test_an_arm_that_only_shoves_an_object_is_not_held_up(sim):
    sim.reset(scene(standing("box", (0.078, 0.022, 0.096), 0.55, 0.1)))
    outcome = sim.execute(push(pose(0.595, 0.1 - 0.1345, 0.04, tilt=math.radians(30)), (0.0, 0.15, 0.0)))
    assert outcome.reason() is None
    assert 0 < outcome.tracking_error < sim.config.tracking_bound / 2


def test_the_same_actions_give_the_same_world():
    start = scene(standing("box", (0.054, 0.025, 0.054), 0.55, 0.1), standing("box", (0.03, 0.012, 0.06), 0.55, 0.2))
    action = push(pose(0.595, 0.1 - 0.1375, 0.04, tilt=math.radians(30)), (0.0, 0.15, 0.0))
    ends = []
    for _ in range(2):
        fresh = NativeWorld()
        fresh.reset(start)
        fresh.execute(action)
        fresh.execute(action)
        ends.append(fresh.trace)
    np.testing.assert_array_equal(ends[0].position, ends[1].position)
    used = NativeWorld()
    used.reset(scene())
    used.execute(action)
    used.reset(start)
    used.execute(action)
    used.execute(action)
    np.testing.assert_array_equal(used.trace.position, ends[0].position)


def test_the_arm_follows_its_reference(sim):
    """Within a millimetre of the hand's path in free space."""
    sim.reset(scene())
    grasp, place = pose(0.6, 0.1, 0.2), pose(0.5, 0.25, 0.2)
    action = pick_and_place(grasp, place)
    plan = sim.config.motion
    reference, reachable = reference_motion(kind_of(int(action.kind)), action, plan)
    outcome = sim.execute(action)
    assert outcome.reason() == "dropped"
    steps = np.rint(sim.trace.time / plan.timestep).astype(int)
    inside = steps <= int(reference.length)
    reached = np.asarray(gripper_pose(sim.trace.q[inside]))[:, :3, 3]
    wanted = np.asarray(gripper_pose(reference.q[steps[inside] - 1]))[:, :3, 3]
    ahead = np.asarray(gripper_pose(reference.q[np.minimum(steps[inside], len(reference.q) - 1)]))[:, :3, 3]
    error = np.minimum(np.linalg.norm(reached - wanted, axis=1), np.linalg.norm(reached - ahead, axis=1))
    assert reachable
    assert error.max() < 1e-3


def test_home_is_clear_of_the_shelf():
    q = jnp.asarray(HOME)
    assert not arm_hits_shelf(q, Shelf())
    assert gripper_pose(q)[0, 3] < Shelf().front - 0.1


@pytest.mark.skipif(not published_scenarios(), reason="the published scenes are not next to this checkout")
def test_published_scenes_rest(sim):
    for path in published_scenarios()[::10]:
        before = sim.reset(load_scenario(path))
        outcome = sim.settle()
        assert outcome.settled, path.name
        assert not outcome.fallen.any(), path.name
        assert np.abs(np.asarray(sim.world.position - before.position)).max() < 2e-3, path.name
