"""Random pushes, executed by the robot in simulation, with their outcomes: training data of push models.

A world undergoes a few pushes before it is drawn anew, so that the data include objects that touch, lean on walls, or
lie. All worlds are simulated at once, by `MjxSimulator` on a GPU or by `NativeSimulator` on a CPU.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Key

from mechsearch_jax.actions import Action, ActionConfig, ActionKind, ActionTables, action_tables
from mechsearch_jax.actions.kinds.push import away_from_robot, contact_height
from mechsearch_jax.dynamics.push_model import LOW_CONTACT
from mechsearch_jax.envs.simulators.simulator import Simulator, SimulatorConfig
from mechsearch_jax.envs.world.world import TARGET, World, superquadrics
from mechsearch_jax.geometry import superquadric
from mechsearch_jax.geometry.footprints import bounding_half_extents, footprints
from mechsearch_jax.geometry.transforms import back_off, inverse, make, transform, translate
from mechsearch_jax.networks.push_contacts import pusher_distance
from mechsearch_jax.robot.grasp_frames import gripper_rotation
from mechsearch_jax.robot.gripper import Gripper, arm_hits_shelf
from mechsearch_jax.robot.kinematics import path_kinematics
from mechsearch_jax.robot.motion import MotionConfig
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.shapes import by_shape
from mechsearch_jax.workspace.shelf import Shelf, hits_shelf

# An object whose vertical has turned by more than this has fallen over [rad].
TOPPLED = math.radians(15)
# Distance from which the gripper is brought up to the object [m]; far enough to overlap no object.
_AWAY = 0.6


@dataclasses.dataclass(frozen=True)
class PushesConfig:
    """Distribution of the drawn pushes; ranges are sampled uniformly.

    Attributes:
      actions: the tilt of the gripper, its wrists, and the heights of planned pushes.
      lengths: range of the gripper's travel [m].
      sideways: share of pushes to the left or right; the others go forward or diagonally.
      forward: largest angle between the latter and +x [rad].
      yaw: largest angle between the gripper's approach and +x, seen from above [rad].
      gap: range of the distance between gripper and object where a push starts [m].
      planned: share of pushes at the height that the planner would choose; the others are at a random one, and topple
        more.
      highest: largest random height [m].
      tries: number of pushes drawn in a world at once; the first possible one is taken.
      renewed: probability that a world is drawn anew after a push.
      renewed_toppled: the same if an object has fallen over.
    """

    actions: ActionConfig = dataclasses.field(default_factory=ActionConfig)
    lengths: tuple[float, float] = (0.02, 0.2)
    sideways: float = 0.65
    forward: float = math.radians(70)
    yaw: float = math.radians(30)
    gap: tuple[float, float] = (0.005, 0.015)
    planned: float = 0.8
    highest: float = 0.16
    tries: int = 24
    renewed: float = 0.2
    renewed_toppled: float = 0.7


class Pushes(PyTreeNode):
    """Pushes and their outcomes; every field has a leading axis for the pushes.

    Attributes:
      before, after: all bodies, the target last.
      object: index of the body to push, int32.
      T_world_gripper: pose of the gripper at the start, shape (n, 4, 4).
      displacement: of the gripper [m], shape (n, 3).
      q7: angle of joint 7 [rad], shape (n,).
      toppled: which bodies fell over, or off the board, shape (n, 9).
      fallen: which fell off the board, shape (n, 9).
      lane: pushes of different lanes are of different scenes, int32.
    """

    before: World
    after: World
    object: jax.Array
    T_world_gripper: jax.Array
    displacement: jax.Array
    q7: jax.Array
    toppled: jax.Array
    fallen: jax.Array
    lane: jax.Array


def push_simulation() -> SimulatorConfig:
    """Simulation settings of pushes: as in an episode, but without most of the way in and out.

    Approximations: the hand drags nothing along on the omitted rest of the way out, and bodies that have not come to
    rest 0.4 s after the retreat are taken to rest where they are.
    """
    # Everywhere counts as outside: there is no way along x.
    gripper = Gripper(approach=0.03, outside=(math.inf,))
    motion = MotionConfig(gripper=gripper, approach_longest=150, leave_longest=1)
    return SimulatorConfig(motion=motion, settle_steps=100)


def push_tables(config: PushesConfig, gripper: Gripper | None = None) -> ActionTables:
    """The gripper's point clouds; grasps, which are unused here, get the same wrist angles."""
    return action_tables(gripper or Gripper(), config.actions.push_wrists, config.actions)


class _Try(PyTreeNode):
    """A push that was drawn, and whether it is possible."""

    action: Action
    possible: jax.Array


def _draw(key: Array, config: PushesConfig, shelf: Shelf, approach: float, tables: ActionTables, world: World) -> _Try:
    """A random push of a random object in a world."""
    keys = jax.random.split(key, 12)
    actions = config.actions
    scene = superquadrics(world)
    prints = footprints(scene)
    weight = jnp.where(world.valid.at[TARGET].set(False), 0.0, -jnp.inf)
    index = jax.random.categorical(keys[0], weight)
    pushed = jax.tree.map(lambda a: a[index], prints)
    extent = bounding_half_extents(scene)[index]

    sideways = jax.random.bernoulli(keys[1], config.sideways)
    quarter = jnp.where(jax.random.bernoulli(keys[2]), math.pi / 2, -math.pi / 2)
    ahead = jax.random.uniform(keys[3], minval=-config.forward, maxval=config.forward)
    angle = jnp.where(sideways, quarter, ahead)
    heading = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    across = away_from_robot(heading, jnp)
    length = jax.random.uniform(keys[4], minval=config.lengths[0], maxval=config.lengths[1])
    yaw = jax.random.uniform(keys[5], minval=-config.yaw, maxval=config.yaw)
    rotation = gripper_rotation(yaw, jnp.float32(actions.push_tilt))

    # Sideways the fingers reach past the object's front up to past its centre, else anywhere behind it.
    wide = jnp.abs(across[0]) * extent[0] + jnp.abs(across[1]) * extent[1]
    near = jnp.where(sideways, actions.push_depths[0] / 2 - wide, -0.8 * wide)
    far = jnp.where(sideways, 1.5 * actions.push_depths[1], 0.8 * wide)
    shift = jax.random.uniform(keys[6]) * (far - near) + near

    tall = pushed.high - pushed.low
    along = jnp.abs(heading[0]) * extent[0] + jnp.abs(heading[1]) * extent[1]
    planned, _ = contact_height(actions, pushed.round, along, tall)
    any_height = jax.random.uniform(
        keys[7], minval=LOW_CONTACT, maxval=jnp.clip(tall, LOW_CONTACT + 1e-3, config.highest)
    )
    height = jnp.where(jax.random.bernoulli(keys[8], config.planned), planned, any_height)

    away = pushed.position + shift * across - _AWAY * heading
    T_away = make(rotation, jnp.append(away, shelf.board + height))
    single = jax.tree.map(lambda a: a[None], pushed)
    distance, level = pusher_distance(single, transform(T_away, tables.pusher), heading, 2 * _AWAY)
    first = jnp.min(jnp.where(level, distance, 2 * _AWAY))
    gap = jax.random.uniform(keys[9], minval=config.gap[0], maxval=config.gap[1])
    T = translate(T_away, jnp.append((first - gap) * heading, 0.0))
    displacement = jnp.append(length * heading, 0.0)
    end = translate(T, displacement)

    wrist = jax.random.randint(keys[10], (), 0, len(actions.push_wrists))
    q7, cloud = tables.q7[1, wrist], tables.clouds[1, wrist].T
    back = jnp.float32(approach)
    middle = translate(T, 0.5 * displacement)
    q, reachable = path_kinematics(jnp.stack([back_off(T, back), T, middle, end, back_off(end, back)]), q7)
    free = reachable & ~jnp.any(arm_hits_shelf(q, shelf))
    for pose in (T, end):
        free &= ~jnp.any(hits_shelf(shelf, transform(pose, cloud)))
    T_body_gripper = inverse(make(scene.rotation, scene.position))
    local = transform(T_body_gripper[:, None], transform(T, cloud)[None])
    inside = jnp.any(superquadric.gauge(scene.size[:, None], scene.exponents[:, None], local) < 1.0, axis=1)
    free &= ~jnp.any(inside & scene.valid)
    action = Action(
        kind=jnp.int32(ActionKind.PUSH),
        object=index.astype(jnp.int32),
        T_world_gripper=T,
        displacement=displacement,
        T_world_place=end,
        q7=q7,
        opening=jnp.float32(0.0),
    )
    return _Try(action, free & (first < 2 * _AWAY) & jnp.any(world.valid[:TARGET]))


def draw_push(
    key: Key[Array, ""],
    world: World,
    tables: ActionTables,
    config: PushesConfig,
    shelf: Shelf,
    approach: float = Gripper().approach,
) -> tuple[Action, Bool[Array, ""]]:
    """A random push that the arm can make: it enters the shelf without contact and can leave it again.

    Contacts of gripper and links during the push are left to the simulation.

    Args:
      key: PRNG key.
      world: the scene.
      tables: of `push_tables`.
      config, shelf, approach: static; the last is the length of the straight way in [m].

    Returns:
      The push, and whether it is possible; if not, its kind is NONE.
    """
    draw = functools.partial(_draw, config=config, shelf=shelf, approach=approach, tables=tables, world=world)
    tries = jax.vmap(draw)(jax.random.split(key, config.tries))
    first = jnp.argmax(tries.possible)
    action: Action = jax.tree.map(lambda a: a[first], tries.action)
    possible = tries.possible[first]
    return action.replace(kind=jnp.where(possible, action.kind, ActionKind.NONE)), possible


def toppled(before: World, after: World) -> Bool[Array, "*batch n"]:
    """Which bodies stand on another face than before; lying bodies that have rolled do not count."""
    up = before.rotation[..., 2, :], after.rotation[..., 2, :]
    return before.valid & (by_shape(before.kind, lambda shape: shape.fall(*up, jnp), jnp) < math.cos(TOPPLED))


def generate_pushes(
    key: Key[Array, ""],
    worlds: int,
    rounds: int,
    simulator: Simulator,
    draw_world: Callable[[Array], World],
    config: PushesConfig | None = None,
    shelf: Shelf | None = None,
    on_progress: Callable[[int, int], None] = lambda rounds, pushes: None,
) -> Pushes:
    """Push in many worlds, several times in sequence.

    Args:
      key: PRNG key; with `NativeSimulator` the same key gives the same pushes.
      worlds: number of worlds at once; each is a separate lane.
      rounds: number of pushes in sequence; a world where none is possible skips a round.
      simulator: simulates them.
      draw_world: a random scene from a key; pure.
      config, shelf: see there.
      on_progress: called after each round with the number of rounds and of pushes so far.

    Returns:
      The pushes that were executed as commanded, on the host.
    """
    config, shelf = config or PushesConfig(), shelf or Shelf()
    tables = push_tables(config)
    chunk = min(worlds, 256)

    def mapped(function):
        return jax.jit(lambda *a: jax.lax.map(lambda row: function(*row), a, batch_size=chunk))

    new_worlds = mapped(draw_world)
    draw = mapped(lambda k, world: draw_push(k, world, tables, config, shelf))
    fell_over = jax.jit(toppled)
    renew = np.ones(worlds, bool)
    parts: list[Pushes] = []
    count = 0
    for i in range(rounds):
        scene_key, push_key, renew_key = jax.random.split(jax.random.fold_in(key, i), 3)
        if renew.any():
            simulator.load(new_worlds(jax.random.split(scene_key, worlds)), None if i == 0 else renew)
        before = simulator.world
        assert before is not None
        before = jax.tree.map(jnp.copy, before)
        action, possible = draw(jax.random.split(push_key, worlds), before)
        outcome = simulator.execute(action, possible)
        after = simulator.world
        assert after is not None
        fallen = outcome.fallen & before.valid
        over = fell_over(before, after) | fallen
        sound = np.asarray(possible & outcome.took_place & (outcome.overflow == 0))
        # A body that is stopped in its fall would go on falling in the next push.
        lost = np.asarray(jnp.any(fallen, axis=1) | ~outcome.settled) | ~sound
        chance = np.where(np.asarray(jnp.any(over, axis=1)), config.renewed_toppled, config.renewed)
        renew = lost | (np.asarray(jax.random.uniform(renew_key, (worlds,))) < chance)
        pushes = Pushes(
            before=before,
            after=after,
            object=action.object,
            T_world_gripper=action.T_world_gripper,
            displacement=action.displacement,
            q7=action.q7,
            toppled=over,
            fallen=fallen,
            lane=jnp.arange(worlds, dtype=jnp.int32),
        )
        parts.append(jax.tree.map(lambda a, sound=sound: np.asarray(a)[sound], pushes))
        count += int(sound.sum())
        on_progress(i + 1, count)
    return joined(parts)


def joined(parts: list[Pushes]) -> Pushes:
    """The concatenation of pushes; lanes are unchanged."""
    return jax.tree.map(lambda *a: np.concatenate(a), *parts)


@dataclasses.dataclass(frozen=True)
class Generation:
    """Number of generated pushes, and their portions; each portion begins with new scenes.

    Attributes:
      seed: of everything.
      pushes: least number in all.
      worlds: simulated at once.
      rounds: pushes in sequence in a portion.
    """

    seed: int
    pushes: int
    worlds: int
    rounds: int = 8

    def __post_init__(self):
        for name in ("pushes", "worlds", "rounds"):
            if getattr(self, name) < 1:
                raise InputError(f"train push: --{name} {getattr(self, name)} must be at least 1")
        if self.seed < 0:
            raise InputError(f"train push: --seed {self.seed} must not be negative")


def engine_name(gpu: bool) -> str:
    """The name of the class that `engine` returns."""
    return "MjxSimulator" if gpu else "NativeSimulator"


def engine(gpu: bool, threads: int | None = None) -> Simulator:
    """The simulator of pushes for a machine with or without a GPU.

    Raises:
      InputError: the batch simulator needs Warp, which cannot be imported.
    """
    if not gpu:
        from mechsearch_jax.envs.simulators.native import NativeSimulator

        return NativeSimulator(threads, push_simulation())
    from mechsearch_jax.envs.simulators.mjx_simulator import MjxConfig, MjxSimulator

    return MjxSimulator(config=MjxConfig(simulator=push_simulation()))
