"""Push models that simulate: `NativePhysics` on the CPU and `MjxPhysics` on a GPU, both `push_model.PushModel`.

The recognised objects become bodies of the nearest shapes, with the densities and frictions of the environment's
bodies, and the arm makes the push with the settings of `push_simulation`. Objects that are not at rest where they were
recognised, because their shapes overlap a little or float, come to rest first. The displacement of each pushed object
is then applied to its recognised pose; all other objects keep theirs exactly. The environment's own simulator is not
involved.

Two approximations: a superquadric whose exponent e2 is above `ROUND_EXPONENT` becomes a body of a round shape with the
same cross-section, any other a body of a shape that is not round; and unrecognised objects are absent.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.actions import Action, ActionKind, no_action
from mechsearch_jax.dynamics.push_model import PushOutcome
from mechsearch_jax.envs.pushing.push_rollouts import LOOSE, LOOSE_TURN, Poses, Simulated, differ, simulate_pushes
from mechsearch_jax.envs.pushing.pushes import push_simulation, toppled
from mechsearch_jax.envs.simulators.mjx_simulator import MjxConfig, MjxSimulator
from mechsearch_jax.envs.simulators.simulator import SimulatorConfig
from mechsearch_jax.envs.world.outcome import Overflow
from mechsearch_jax.envs.world.world import BODIES, World
from mechsearch_jax.geometry.superquadric import ROUND_EXPONENT, Superquadrics, pad
from mechsearch_jax.geometry.transforms import matmul, rotate
from mechsearch_jax.robot.motion import push_reference
from mechsearch_jax.runtime.cores import cores
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.shapes import by_shape, in_order
from mechsearch_jax.workspace.shelf import Shelf

# An object that has moved by less than this [m], and turned by less than this [rad], was not pushed.
STILL, STILL_TURN = 1e-3, 0.02
# Least half-extent of a body [m]: contact geometry is smaller than the body by `model.MARGIN`.
THINNEST = 2e-3

# Dimensions of a shelf that a simulation depends on, and their tolerance [m].
WALLS = ("front", "back", "right", "left", "board", "ceiling", "thickness")
SAME = 1e-6


def _poses(world: World) -> Poses:
    return Poses(world.position, world.rotation)


def _nearest_kind(exponents: Float[Array, "n 2"]) -> Int[Array, " n"]:
    """Codes of the shapes of superquadrics: of the shapes that agree in being round or not, the nearest in e1."""
    is_round = exponents[:, 1] > ROUND_EXPONENT
    apart = [
        jnp.where(is_round == shape.round, jnp.abs(exponents[:, 0] - shape.exponents[0]), jnp.inf)
        for shape in in_order()
    ]
    return jnp.argmin(jnp.stack(apart), axis=0).astype(jnp.int32)


def bodies(scene: Superquadrics) -> World:
    """The bodies nearest to superquadrics, in the slots of a `World`.

    Args:
      scene: fields (N, ...), N at most 9.

    Raises:
      InputError: there are more superquadrics than slots for bodies.
    """
    if scene.capacity > BODIES:
        raise InputError(f"the simulator has slots for {BODIES} bodies, not for {scene.capacity} superquadrics")
    scene = pad(scene, BODIES)
    size = jnp.maximum(scene.size, THINNEST)
    kind = _nearest_kind(scene.exponents)
    return World(
        kind=kind,
        half_size=by_shape(kind[:, None], lambda shape: shape.nearest(size, jnp), jnp),
        position=scene.position,
        rotation=scene.rotation,
        valid=scene.valid,
    )


def _outcome(shelf: Shelf, scene: Superquadrics, world: World, simulated: Simulated, failed: Array) -> PushOutcome:
    """The `PushOutcome` of a simulated push."""
    n = scene.capacity
    before, after = simulated.before, simulated.after
    turn = matmul(after.rotation, jnp.swapaxes(before.rotation, -1, -2))
    moved = (world.valid & differ(before, after, STILL, STILL_TURN) & ~failed)[:n]
    position = rotate(turn, world.position - before.position) + after.position
    rotation = matmul(turn, world.rotation)
    fell = (after.position[:, 0] < shelf.front) | (after.position[:, 2] < shelf.board)
    over = toppled(*(world.replace(position=p.position, rotation=p.rotation) for p in (before, after))) | fell
    return PushOutcome(
        scene=scene.replace(
            position=jnp.where(moved[:, None], position[:n], scene.position),
            rotation=jnp.where(moved[:, None, None], rotation[:n], scene.rotation),
        ),
        moved=moved,
        residual=jnp.where(failed, jnp.inf, 0.0),
        resolved=~failed,
        topples=jnp.where(moved & over[:n], 1.0, 0.0),
    )


@dataclasses.dataclass(frozen=True)
class NativePhysics:
    """The `PushModel` that simulates pushes in C MuJoCo; a batch under `vmap` runs at once, on several threads.

    `jax.pure_callback` hands a batch to the host in one call. A plan makes one call for the first draws of all
    sequences, and one for each further draw of the sequences without a possible action: at most as many calls as
    `PlannerConfig.draws` says. The same pushes always give the same results. The
    residual is infinite if the simulation diverges, the arm cannot follow the push, or the scene is invalid.

    Attributes:
      simulation: its settings.
      threads: number of threads; `runtime.cores.cores` if None.
    """

    simulation: SimulatorConfig = dataclasses.field(default_factory=push_simulation)
    threads: int | None = None

    def __call__(
        self, shelf: Shelf, scene: Superquadrics, pusher: Array, T_world_gripper: Array, displacement: Array, q7: Array
    ) -> PushOutcome:
        """See `push_model.PushModel`."""
        world = bodies(scene)
        reference, reachable = push_reference(T_world_gripper, displacement, q7, self.simulation.motion)
        pushes = jnp.any(displacement != 0.0)
        poses = Poses(jax.ShapeDtypeStruct((BODIES, 3), jnp.float32), jax.ShapeDtypeStruct((BODIES, 3, 3), jnp.float32))
        simulated = jax.pure_callback(
            functools.partial(simulate_pushes, self.simulation, self.threads or cores()),
            Simulated(poses, poses, jax.ShapeDtypeStruct((), jnp.bool_)),
            shelf,
            world,
            reference,
            pushes & reachable,
            vmap_method="broadcast_all",
        )
        return _outcome(shelf, scene, world, simulated, simulated.failed | (pushes & ~reachable))


@dataclasses.dataclass(frozen=True)
class MjxPhysics:
    """The `PushModel` that simulates pushes in `MjxSimulator`; a batch under `vmap` runs in one computation.

    The residual is infinite if the simulation diverges, the arm cannot follow the push, or the contact buffers
    overflow. The same pushes always give the same results on a CPU, but not on a GPU.

    Attributes:
      shelf: of the compiled model. In any other shelf every push has an infinite residual.
      config: of the simulator.
    """

    shelf: Shelf = dataclasses.field(default_factory=Shelf)
    config: MjxConfig = dataclasses.field(default_factory=lambda: MjxConfig(simulator=push_simulation()))

    def __call__(
        self, shelf: Shelf, scene: Superquadrics, pusher: Array, T_world_gripper: Array, displacement: Array, q7: Array
    ) -> PushOutcome:
        """See `push_model.PushModel`."""
        world = bodies(scene)
        pushes = jnp.any(displacement != 0.0)
        # Numbers that are not finite spread between Warp's worlds, so that scenes with any are left out.
        sound = _finite(world, T_world_gripper, displacement, q7)
        action = no_action().replace(
            kind=jnp.where(pushes & sound, ActionKind.PUSH, ActionKind.NONE).astype(jnp.int32),
            T_world_gripper=jnp.where(sound, T_world_gripper, jnp.eye(4)),
            displacement=jnp.where(sound, displacement, 0.0),
            q7=jnp.where(sound, q7, 0.0),
        )
        world = jax.tree.map(lambda a, b: jnp.where(sound, a, b), world, jax.tree.map(jnp.zeros_like, world))
        batch = jax.tree.map(lambda a: a[None], (world, action))
        simulated = jax.tree.map(lambda a: a[0], _batched(self.shelf, self.config)(*batch))
        other = jnp.any(jnp.stack([jnp.abs(getattr(shelf, name) - getattr(self.shelf, name)) > SAME for name in WALLS]))
        return _outcome(shelf, scene, world, simulated, pushes & (simulated.failed | ~sound | other))


def _finite(world: World, *arrays: Array) -> Bool[Array, ""]:
    """Whether all numbers of valid bodies and of arrays are finite."""
    leaves = (world.half_size, world.position, world.rotation)
    fine = [jnp.isfinite(a).reshape(BODIES, -1).all(axis=1) | ~world.valid for a in leaves]
    return jnp.all(jnp.stack(fine)) & jnp.all(jnp.stack([jnp.isfinite(a).all() for a in arrays]))


@functools.cache
def _batched(shelf: Shelf, config: MjxConfig) -> Callable[[World, Action], Simulated]:
    """A function that simulates worlds with a leading axis; `vmap` merges its axis with that one."""
    # The model needs concrete numbers even while a plan is traced.
    with jax.ensure_compile_time_eval():
        simulator = MjxSimulator(shelf, config=config)

    @jax.custom_batching.custom_vmap
    def simulate(world: World, action: Action) -> Simulated:
        rested, waited = simulator.simulate(world, None)
        loose = differ(_poses(world), _poses(rested), LOOSE, LOOSE_TURN).any(axis=-1)
        world = jax.tree.map(lambda a, b: jnp.where(loose.reshape(-1, *[1] * (a.ndim - 1)), a, b), rested, world)
        after, pushed = simulator.simulate(world, action)
        failed = ~(waited.took_place & pushed.took_place)
        failed |= (waited.overflow | pushed.overflow) != Overflow.NONE
        return Simulated(_poses(world), _poses(after), failed)

    @simulate.def_vmap
    def _(size: int, batched: Sequence[Any], world: World, action: Action) -> tuple[Simulated, Simulated]:
        full = jax.tree.map(
            lambda a, has: a if has else jnp.broadcast_to(a, (size, *a.shape)), (world, action), tuple(batched)
        )
        merged = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), full)
        simulated = jax.tree.map(lambda a: a.reshape(size, -1, *a.shape[1:]), simulate(*merged))
        return simulated, jax.tree.map(lambda _: True, simulated)

    return simulate
