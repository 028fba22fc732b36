"""The batch simulator: what it makes of every kind of action, next to what the native simulator makes of it.

The first call compiles for about a minute, of which Warp's part is kept on disk (`WARP_CACHE_PATH`).
"""

import dataclasses
import math
import sys
import types
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_envs_simulator import pick_and_place, pose, push, scene, standing, take_out

from mechsearch_jax.actions import ActionKind, no_action, retrieve_action
from mechsearch_jax.envs.simulators import mjx_step, simulator
from mechsearch_jax.envs.simulators.batch_model import BodyFields, body_fields, cells_of
from mechsearch_jax.envs.simulators.mjx_simulator import MjxConfig, MjxSimulator
from mechsearch_jax.envs.simulators.native import NativeWorld
from mechsearch_jax.envs.simulators.simulator import Simulator, SimulatorConfig
from mechsearch_jax.envs.world import model
from mechsearch_jax.envs.world.mismatch import ASSUMED_CELL, Mismatch, TrueCell
from mechsearch_jax.envs.world.outcome import Overflow
from mechsearch_jax.envs.world.world import TARGET, from_scenario, slots
from mechsearch_jax.robot.motion import Reference
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.session.preparing import prepare
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf

BOX = standing("box", (0.054, 0.025, 0.054), 0.55, 0.1)
BOTTLE = standing("cylinder", (0.032, 0.032, 0.067), 0.6, 0.1)
GOAL = standing("cylinder", (0.02, 0.02, 0.05), 0.65, 0.25)


def stack(*trees):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


def angle(a, b):
    """Angle between rotations [degrees]."""
    cosine = (np.einsum("...ij,...ij->...", np.asarray(a), np.asarray(b)) - 1) / 2
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def sideways(distance=0.15):
    """A push of `BOX` to the left."""
    return push(pose(0.595, 0.1 - 0.025 - 0.1125, 0.04, tilt=math.radians(30)), (0.0, distance, 0.0))


def out_of_reach():
    return dataclasses.replace(no_action(), kind=jnp.int32(ActionKind.PUSH), T_world_gripper=pose(1.3, 0.1, 0.1))


def native_of(start, action):
    """The native simulator's outcome and world."""
    single = NativeWorld()
    single.reset(start)
    return single.execute(action), single.world


def test_the_fields_of_every_world_are_those_that_mujoco_computes():
    blank = model.compile_model(Shelf(), Camera())
    scenes = [scene(BOX, BOTTLE), scene(), scene(*[BOTTLE] * 8, target=standing("box", (0.015, 0.02, 0.05), 0.6, 0.1))]
    worlds = stack(*[from_scenario(s) for s in scenes])
    moved = Mismatch(friction=0.5, mass=2.0, friction_spread=2.0, mass_spread=1.5, shelf_shift=0.01, shelf_turn=2.0)
    cells = [ASSUMED_CELL, moved.drawn(scenes[1], 0, Camera(), Shelf()), TrueCell(friction=2.0)]
    of_worlds = jax.jit(partial(body_fields, blank))
    fields = of_worlds(worlds.kind, worlds.half_size, worlds.valid, cells_of(blank, cells))
    for i, (start, cell) in enumerate(zip(scenes, cells, strict=True)):
        native = NativeWorld()
        native.place(slots(start), cell)
        compiled = native._model
        for name in BodyFields.__dataclass_fields__:
            value = np.asarray(getattr(fields, name)[i])
            np.testing.assert_allclose(value, getattr(compiled, name).reshape(value.shape), 2e-6, 1e-7, err_msg=name)


def test_commands_are_those_of_the_native_simulator():
    draw = np.random.default_rng(0).normal
    shapes = {"q": (20, 7), "velocity": (20, 7), "fingers": (20,), "start": (8,)}
    drawn = {name: jnp.asarray(draw(size=shape), jnp.float32) for name, shape in shapes.items()}
    reference = Reference(**drawn, **dict.fromkeys(("length", "closed", "opens"), jnp.int32(20)))
    batch = mjx_step.commands(jax.tree.map(lambda leaf: leaf[None], reference))
    np.testing.assert_allclose(batch[0], simulator.controls(reference), atol=1e-6)


def test_commands_say_where_the_arm_would_be_if_nothing_held_it_up():
    """The command leads the reference by the motors' lag; the reference comes back out of it, also in many steps."""
    timestep, worlds = SimulatorConfig().motion.timestep, 2
    phase = np.linspace(0, 6, 1500)[:, None] * [1, 2, 0.5, 1, 3, 1, 2]
    q = np.stack([np.sin(phase + world) for world in range(worlds)])
    velocity = np.diff(q, axis=1, prepend=q[:, :1]) / timestep
    start = np.concatenate([q[:, 0], np.zeros((worlds, 1))], axis=1)
    over = [jnp.full(worlds, q.shape[1], jnp.int32)] * 3
    reference = Reference(*(jnp.asarray(a, jnp.float32) for a in (q, velocity, q[..., 0], start)), *over)
    commands = mjx_step.commands(reference)[..., :7]

    def one(last, now):
        there = simulator.unhindered(last, now, timestep)
        return there, there

    _, followed = jax.lax.scan(one, reference.start[:, :7], jnp.moveaxis(commands, 1, 0))
    np.testing.assert_allclose(jnp.moveaxis(followed, 0, 1), q, atol=1e-5)


def test_actions_of_two_kinds_are_mixed_by_world():
    taken = retrieve_action(jnp.stack([pose(0.6, 0.1, 0.06)] * 3), jnp.zeros(3), jnp.full(3, 0.08))
    mixed = jax.tree.map(lambda a, b: a.at[1].set(b), taken, no_action())
    assert mixed.kind.tolist() == [ActionKind.RETRIEVE, ActionKind.NONE, ActionKind.RETRIEVE]
    np.testing.assert_array_equal(mixed.T_world_gripper[1], np.eye(4))
    np.testing.assert_array_equal(mixed.T_world_gripper[2], taken.T_world_gripper[2])


@pytest.mark.slow
def test_a_retrieval_fails_when_the_arm_is_held_up_and_by_what_falls_meanwhile():
    """What the compiled functions make of the states before and after, without stepping anything: in the first world
    nothing happens, then the box falls, then it had fallen before, then the arm is held up, twice in worlds that also
    slipped or diverged."""
    count = 6
    world = stack(*[from_scenario(scene(BOX, target=GOAL))] * count)
    bodies = jnp.tile(jnp.float32([0.6, 0.0, 0.5, 1.0, 0.0, 0.0, 0.0]), (count, 9, 1)).at[2, 0, 0].set(0.39)
    out = bodies.at[:, TARGET, 0].set(0.3).at[1, 0, 0].set(0.39)
    robot = jnp.zeros((count, 9))
    before, after = (jnp.concatenate([robot, b.reshape(count, -1)], axis=1) for b in (bodies, out))
    actions = stack(*[take_out(pose(0.65, 0.25, 0.06, tilt=math.radians(30)))] * count)
    bound = SimulatorConfig().tracking_bound

    @jax.jit
    def judged(actions, world):
        data, config = types.SimpleNamespace(ctrl=robot, qpos=before), SimulatorConfig()
        task, _ = mjx_step.acting(data, actions, jnp.ones(count, bool), jnp.zeros(9), config)
        progress = mjx_step.begin(task, data).replace(
            error=bound * jnp.array([0.99, 0.5, 0.5, 1.01, 2.0, 2.0]), diverged=jnp.arange(count) == 5
        )
        in_hand = jnp.arange(count) != 4
        return mjx_step.verdicts(Shelf(), config, task, progress, world, after, in_hand)[1]

    outcome = judged(actions, world)
    held_up = "the arm was held up"
    assert [outcome.reason(i) for i in range(count)] == [None, "fallen", None, held_up, held_up, "unstable"]
    assert outcome.retrieved.tolist() == [True, False, True, False, False, False]
    assert outcome.took_place.tolist() == [True] * 5 + [False]
    assert outcome.fallen[:, 0].tolist() == [False, True, True, False, False, False]
    np.testing.assert_allclose(outcome.tracking_error / bound, [0.99, 0.5, 0.5, 1.01, 2.0, 0.0], rtol=1e-5)


def test_without_warp_one_line_tells_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "warp", None)
    with pytest.raises(InputError, match=r"pip install 'mechsearch-jax\[gpu\]'") as complaint:
        MjxSimulator()
    assert "\n" not in str(complaint.value)


@pytest.fixture(scope="module")
def sim():
    return MjxSimulator()


def test_what_it_is_given_has_to_fit(sim):
    with pytest.raises(InputError, match="reset it"):
        MjxSimulator.settle(sim)
    with pytest.raises(InputError, match="no scenarios"):
        sim.reset([])
    with pytest.raises(InputError, match="1 worlds cannot be set in part"):
        sim.load(stack(from_scenario(scene(BOX))), np.array([True]))
    sim.reset([scene(BOX)] * 2)
    with pytest.raises(InputError, match="for 2 worlds"):
        sim.execute(stack(no_action()))
    with pytest.raises(InputError, match="kind 9 is unknown"):
        sim.execute(stack(no_action(), no_action().replace(kind=jnp.int32(9))))
    assert isinstance(sim, Simulator)


@pytest.mark.slow
@pytest.mark.always
def test_a_push_ends_where_the_native_simulator_has_it_and_other_worlds_stay(sim):
    """One batch: a push, a push out of reach, one that is not to be executed, and one in which the arm is held up."""
    wide = standing("box", (0.078, 0.048, 0.1), 0.6, Shelf().left - 0.078)
    starts = [scene(BOX), scene(BOX), scene(BOTTLE), scene(wide)]
    before = sim.reset(starts)
    np.testing.assert_array_equal(before.position[2], from_scenario(starts[2]).position)
    behind = pose(0.62, wide.position[1] - 0.1605, 0.06, tilt=math.radians(30))
    into_the_wall = push(behind, (0.0, 0.05, 0.0)).replace(
        displacement=jnp.array([0.0, 0.12, 0.0]), T_world_place=behind.at[1, 3].add(0.12)
    )
    actions = stack(sideways(), out_of_reach(), sideways(), into_the_wall)
    outcomes = sim.execute(actions, jnp.array([True, True, False, True]))
    assert [outcomes.reason(i) for i in range(4)] == [None, "unreachable", None, "the arm was held up"]
    assert outcomes.settled.all()
    assert not outcomes.overflow.any()
    # What is crushed against the wall may spring away.
    assert not outcomes.fallen[:3].any()
    outcome, world = native_of(starts[0], sideways())
    assert outcomes.steps[:3].tolist() == [int(outcome.steps), 0, 0]
    assert float(outcomes.tracking_error[0]) == pytest.approx(float(outcome.tracking_error), rel=0.1)
    assert outcomes.tracking_error[1:3].tolist() == [0.0, 0.0]
    held_up, _ = native_of(starts[3], into_the_wall)
    assert held_up.reason() == outcomes.reason(3)
    assert float(outcomes.tracking_error[3]) == pytest.approx(float(held_up.tracking_error), rel=0.5)
    assert np.abs(np.asarray(sim.world.position[0] - world.position)).max() < 2e-3
    assert angle(sim.world.rotation[0], world.rotation).max() < 1.5
    assert float(sim.world.position[0, 0, 1]) > 0.2
    for i in (1, 2):
        np.testing.assert_array_equal(sim.world.position[i], before.position[i])
        np.testing.assert_array_equal(sim.world.rotation[i], before.rotation[i])


@pytest.mark.slow
def test_every_world_has_its_own_cell(sim):
    moved, heavy = Mismatch(shelf_shift=0.01, shelf_turn=1.0), Mismatch(friction=0.5, mass=2.0)
    cells = {1: moved.drawn(scene(BOX), 0, Camera(), Shelf()), 2: heavy.drawn(scene(BOX), 0, Camera(), Shelf())}
    sim.set_cells(cells)
    sim.reset([scene(BOX)] * 4)
    outcomes = sim.execute(stack(*[sideways(0.05)] * 4), jnp.array([False, True, True, True]))
    ends = np.asarray(sim.world.position)[:, 0]
    for i in (1, 2, 3):
        native = NativeWorld()
        native.reset(scene(BOX), cells.get(i, ASSUMED_CELL))
        assert native.execute(sideways(0.05)).reason() == outcomes.reason(i)
        assert np.abs(ends[i] - native.world.position[0]).max() < 2e-3
    assert np.linalg.norm(ends[1] - ends[3]) > 4e-3
    # The next episodes have the usual cell, where none is set.
    sim.replace({1: scene(BOX), 2: scene(BOX)})
    for name in ("body_pos", "geom_friction", "body_mass"):
        field = np.asarray(getattr(sim._fields, name))
        np.testing.assert_array_equal(field[1:3], field[:1].repeat(2, axis=0))
    with pytest.raises(InputError, match="usual physics"):
        sim.set_cells({0: TrueCell(physics="fine-step")})
    with pytest.raises(InputError, match="the arm never stops"):
        sim.set_cells({0: TrueCell(arm_stop=0.04)})


@pytest.mark.slow
def test_worlds_need_not_wait_for_each_other_and_nothing_is_left_to_compile(sim, monkeypatch):
    """What is prepared is all: of JAX, and of Warp's kernels. Each world is what it is in a batch that waits."""
    starts = [scene(BOX), scene(BOX, BOTTLE), scene(BOX)]
    actions = stack(sideways(0.05), sideways(0.12), out_of_reach())
    sim = MjxSimulator(sim.shelf, sim.camera, sim.config)
    shapes = jax.tree.map(lambda a: jax.ShapeDtypeStruct((3, *a.shape), a.dtype), from_scenario(starts[0]))
    prepare(sim.programs(shapes), lambda text: None)
    from warp._src.context import Module

    compiled, compiling = [], Module._compile

    def noted(module, *args, **options):
        if compiling(module, *args, **options):
            compiled.append(module.name)

    monkeypatch.setattr(Module, "_compile", noted)
    sim.reset(starts)

    def note(event, seconds, **about):
        if event.endswith("backend_compile_duration"):
            compiled.append(about.get("fun_name"))

    jax.monitoring.register_event_duration_secs_listener(note)
    try:
        outcome = sim.execute(actions)
        together = jax.device_get(sim.world)
        sim.reset(starts)
        sim.begin(actions, jax.device_put(np.array([True, False, False])))
        with pytest.raises(InputError, match="world 0 is moving"):
            sim.begin(actions)
        assert sim.advance(1)[0].tolist() == [True, False, False]
        # Of two that begin, one has nothing to do, and is done at once.
        sim.begin(actions, jax.device_put(np.array([False, True, True])))
        done, refused = sim.advance(1)
        assert done.tolist() == [False, False, True]
        assert refused.reason(2) == "unreachable"
        sim.begin(actions, jax.device_put(np.array([True, False, False])))
        steps = [sim.advance(1) for _ in range(2)]
        sim.replace({0: starts[1]})
    finally:
        jax.monitoring.unregister_event_duration_listener(note)
    assert [done.tolist() for done, _ in steps] in (
        [[True, False, False], [False, True, False]],
        [[False, True, False], [True, False, False]],
    )
    (late,) = [outcome for done, outcome in steps if done[1]]
    assert int(late.steps[1]) == int(outcome.steps[1])
    for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(jax.device_get(sim.world)), strict=True):
        np.testing.assert_array_equal(a[1:], b[1:])
    np.testing.assert_array_equal(sim.world.position[0], from_scenario(starts[1]).position)
    assert compiled == []


@pytest.mark.slow
def test_all_kinds_at_once_agree_with_the_native_simulator(sim):
    picked = pick_and_place(pose(0.59, 0.1, 0.1), pose(0.5, 0.22, 0.1))
    off_the_board = pick_and_place(pose(0.596, 0.1, 0.1), pose(0.39, 0.1, 0.1))
    taken = take_out(pose(0.65, 0.25, 0.06, tilt=math.radians(30)))
    cases = [
        (scene(BOX), sideways()),
        (scene(BOTTLE), picked),
        (scene(BOX, target=GOAL), taken),
        (scene(BOTTLE), pick_and_place(pose(0.5, 0.3, 0.1), pose(0.55, 0.2, 0.1))),
        (scene(BOX, target=GOAL), take_out(pose(0.55, 0.3, 0.06))),
        (scene(BOTTLE, target=GOAL), off_the_board),
        (scene(BOTTLE), no_action()),
    ]
    sim.reset([start for start, _ in cases])
    outcomes = sim.execute(stack(*[action for _, action in cases]))
    assert sim._go_on._cache_size() <= 2
    for i, (start, action) in enumerate(cases):
        outcome, world = native_of(start, action)
        assert outcomes.reason(i) == outcome.reason()
        assert float(outcomes.tracking_error[i]) == pytest.approx(float(outcome.tracking_error), rel=0.1)
        assert abs(int(outcomes.steps[i]) - int(outcome.steps)) <= 100
        np.testing.assert_array_equal(outcomes.fallen[i], outcome.fallen)
        if not outcome.fallen.any():
            assert np.abs(np.asarray(sim.world.position[i] - world.position)).max() < 3e-3
            assert angle(sim.world.rotation[i], world.rotation).max() < 2
    assert outcomes.retrieved.tolist() == [i == 2 for i in range(len(cases))]
    assert bool(outcomes.held[2] & outcomes.outside[2])
    assert outcomes.fallen[5, 0]

    # The world goes on from there, without a new compilation; what fell before spoils no retrieval.
    compiled = sim._go_on._cache_size()
    again = sim.execute(stack(*[taken] * len(cases)), jnp.arange(len(cases)) == 5)
    assert again.reason(5) is None
    assert bool(again.held[5])
    assert bool(again.retrieved[5])
    assert bool(again.fallen[5, 0])
    assert not bool(again.fallen[5, TARGET])
    assert sim._go_on._cache_size() == compiled


@pytest.mark.slow
def test_a_world_that_diverges_touches_no_other(sim):
    """One world's mass is not a number: it gets its state back, and its neighbours never notice."""
    starts, actions = [scene(BOX)] * 3, stack(*[sideways()] * 3)
    sim.reset(starts)
    sim.execute(actions)
    fine = sim.world
    before = sim.reset(starts)
    sim._fields = sim._fields.replace(body_mass=sim._fields.body_mass.at[1].set(jnp.nan))
    outcomes = sim.execute(actions)
    assert [outcomes.reason(i) for i in range(3)] == [None, "unstable", None]
    assert outcomes.settled.tolist() == [True, False, True]
    np.testing.assert_allclose(sim.world.position[1], before.position[1], atol=1e-6)
    for i in (0, 2):
        np.testing.assert_allclose(sim.world.position[i], fine.position[i], atol=1e-5)
    # Healed, it is a world like any other.
    kept = sim.world.position[0]
    sim.load(before, np.array([False, True, False]))
    np.testing.assert_array_equal(sim.world.position[0], kept)
    np.testing.assert_array_equal(sim.world.position[1], before.position[1])
    healed = sim.execute(actions, jnp.array([False, True, False]))
    assert healed.reason(1) is None
    np.testing.assert_allclose(sim.world.position[1], fine.position[1], atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("config", "flag"), [(MjxConfig(rows=30), Overflow.ROWS), (MjxConfig(contacts=2), Overflow.CONTACTS)]
)
def test_what_overflows_is_reported(config, flag):
    """The target alone has rows enough, which are its own; the contacts are everybody's."""
    small = MjxSimulator(config=config)
    small.reset([scene(BOX, BOTTLE, target=GOAL), scene()])
    hold = jnp.broadcast_to(small._data.ctrl, (5, *small._data.ctrl.shape))
    overflow = small.follow(hold).overflow
    assert int(overflow[0]) & flag
    assert bool(int(overflow[1]) & flag) == (flag is Overflow.CONTACTS)
