"""The scene in MuJoCo Warp: one model and state for many worlds, and a step of all of them."""

# The bindings of MuJoCo come without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import copy
import dataclasses
import functools
import warnings
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.scipy.spatial.transform import Rotation
from jaxtyping import Array, Bool

from mechsearch_jax.envs.simulators.batch_model import BodyFields, Cells, CompoundFields, body_fields, compound_fields
from mechsearch_jax.envs.simulators.simulator import ARM, ROBOT, SimulatorConfig
from mechsearch_jax.envs.simulators.warp_kernels import compile_kernels
from mechsearch_jax.envs.simulators.warp_streams import keep_streams
from mechsearch_jax.envs.world import model as models
from mechsearch_jax.envs.world.outcome import Overflow
from mechsearch_jax.envs.world.world import BODIES, TARGET, World
from mechsearch_jax.robot.kinematics import HOME
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.shapes.compound import Compound
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf

# The constraint solver's tolerance: the least that MuJoCo Warp accepts for its own models.
SOLVER_TOLERANCE = 1e-6


@dataclasses.dataclass(frozen=True)
class MjxConfig:
    """Settings of the batch simulator.

    Attributes:
      simulator: as for the native simulator; `trace_every` is ignored, there are no traces.
      contacts: capacity for contacts, per world on average; the buffer is shared.
      rows: capacity for constraint rows in every world.
      compound_contacts, compound_rows: the same of worlds of compounds, whose many solids touch more at once. C MuJoCo
        needs 55 contacts at most in household scenes with eight objects, 6 rows each; Warp may find more.
      chunk: time steps between checks whether all worlds are done.
    """

    simulator: SimulatorConfig = dataclasses.field(default_factory=SimulatorConfig)
    contacts: int = 64
    rows: int = 480
    compound_contacts: int = 96
    compound_rows: int = 720
    chunk: int = 25

    def __post_init__(self):
        for name in ("contacts", "rows", "compound_contacts", "compound_rows", "chunk"):
            if getattr(self, name) < 1:
                raise InputError(f"MjxConfig: {name} {getattr(self, name)} must be at least 1")

    def capacity(self, compounds: bool) -> tuple[int, int]:
        """The capacities for contacts and for constraint rows of a world, with or without compounds."""
        return (self.compound_contacts, self.compound_rows) if compounds else (self.contacts, self.rows)


def import_mjx() -> Any:
    """The module `mujoco.mjx`, after a check that Warp is installed.

    Raises:
      InputError: Warp cannot be imported.
    """
    try:
        import warp  # pyright: ignore[reportMissingImports]

        # By default Warp prints a line for itself and for every kernel that it loads.
        if warp.config.log_level == warp.LOG_INFO:
            warp.config.log_level = warp.LOG_WARNING
        keep_streams(warp.Stream)
        from mujoco import mjx
    except (ImportError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        raise InputError(
            f"the batch simulator needs Warp ({reason}); install it with: pip install 'mechsearch-jax[gpu]'"
        ) from error
    return mjx


def where(condition: Bool[Array, " worlds"], a: Array, b: Array) -> Array:
    """`jnp.where` with a condition per world."""
    return jnp.where(condition.reshape(-1, *[1] * (b.ndim - 1)), a, b)


class MjxModel:
    """The model that all worlds share, and functions of it.

    Attributes:
      room: the compounds in its slots, see `batch_model.room_for`; none in a model of plain worlds.
      blank: the C MuJoCo model with empty slots.
      robot: the robot's configuration at home, shape (9,).
    """

    def __init__(
        self, shelf: Shelf, camera: Camera, config: MjxConfig, room: Mapping[int, Compound] = MappingProxyType({})
    ):
        """Raises:
        InputError: Warp cannot be imported.
        """
        self._mjx = import_mjx()
        self._config = config
        self._contacts, self._rows = config.capacity(bool(room))
        self.room = room
        self._fields = CompoundFields if room else BodyFields
        blank = copy.copy(models.compile_model(shelf, camera, config.simulator.motion.timestep, room))
        # Warp has no midphase that could be disabled.
        blank.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)
        # In Warp this flag selects C MuJoCo's box-box collision instead of the general convex one, which in float32
        # misses or misjudges every tenth contact of a finger with a box.
        blank.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_NATIVECCD)
        self.blank = blank
        with warnings.catch_warnings():
            # The planes have zero friction: a contact takes the larger of the two.
            warnings.filterwarnings("ignore", message=r".*friction\[")
            model = self._mjx.put_model(blank, impl="warp")
        # Outcomes report overflows; printed from the device, they would take a line for every world and step.
        option = model.opt.replace(_impl=model.opt._impl.replace(warn_overflow=0))
        # MJX takes over the tolerance of C MuJoCo, which is too small for float32: the solver would oscillate about
        # the solution, and all worlds would wait for the slowest.
        option = option.replace(tolerance=jnp.maximum(option.tolerance, SOLVER_TOLERANCE))
        self._model = model.replace(opt=option)
        self._axes = jax.tree.map(lambda _: None, self._model).replace(
            **dict.fromkeys(self._fields.__dataclass_fields__, 0)
        )
        parked = [np.array([*models.parking_place(i), 1.0, 0.0, 0.0, 0.0]) for i in range(BODIES)]
        self._parked = jnp.asarray(np.stack(parked), jnp.float32)
        self.robot = jnp.asarray(np.concatenate([HOME, np.zeros(ROBOT - ARM)]), jnp.float32)

    def start(self, world: World, cells: Cells) -> tuple[BodyFields, Array, Array]:
        """The model's fields, configurations and commands of worlds at rest with the robot at home."""
        count = len(world.kind)
        if world.compounds is None:
            fields = body_fields(self.blank, world.kind, world.half_size, world.valid, cells)
        else:
            fields = compound_fields(self.blank, world, cells)
        upright = jnp.where(world.valid[..., None, None], world.rotation, jnp.eye(3)[None, None])
        quaternion = Rotation.from_matrix(upright.reshape(-1, 3, 3)).as_quat()[:, np.array([3, 0, 1, 2])]
        poses = jnp.concatenate([world.position, quaternion.reshape(count, BODIES, 4)], axis=-1)
        poses = jnp.where(world.valid[..., None], poses, self._parked[None]).reshape(count, -1)
        robot = jnp.broadcast_to(self.robot, (count, ROBOT))
        return fields, jnp.concatenate([robot, poses], axis=1), robot

    def make_data(self, worlds: int) -> Any:
        """The initial state of `worlds` worlds without bodies."""
        # The data need concrete numbers even while a plan is traced.
        with jax.ensure_compile_time_eval():
            # MJX commits the data to a device, which would commit all results; functions compiled for uncommitted
            # arrays would be compiled again for them.
            single = jax.device_get(self._single(self._contacts * worlds))
        return jax.jit(_repeated)(jnp.arange(worlds), single)

    def data_shapes(self, worlds: int) -> Any:
        """The shapes of `make_data`."""
        single = jax.device_get(self._single(self._contacts * worlds))
        return jax.eval_shape(_repeated, jnp.arange(worlds), single)

    def kernels(self, worlds: int) -> Callable[[], None] | None:
        """Begin to compile Warp's kernels for `worlds` worlds in another process; see `compile_kernels`."""
        device = "cpu" if jax.default_backend() == "cpu" else "cuda:0"
        batched = tuple(self._fields.__dataclass_fields__)
        return compile_kernels(self.blank, batched, worlds, self._contacts * worlds, self._rows, device)

    def step(self, fields: BodyFields, data: Any) -> Any:
        """The state of all worlds one time step later."""
        model = self._model.replace(**{name: getattr(fields, name) for name in self._fields.__dataclass_fields__})
        return jax.vmap(self._mjx.step, in_axes=(self._axes, 0))(model, data)

    def holds_target(self, contacts: Any) -> Bool[Array, " worlds"]:
        """In which worlds both fingers press on the target.

        Args:
          contacts: Warp's part of a state, `data._impl`.
        """
        return self._touches(contacts, "left") & self._touches(contacts, "right")

    def bytes_per_world(self) -> int:
        """An estimate of a world's device memory [bytes]: its state and the commands of an action.

        Each is counted with the copies that exist while one step becomes the next.
        """
        plan = self._config.simulator.motion
        stretches = 2 * (plan.approach_longest + plan.carry_longest) + 4 * plan.leave_longest + plan.transfer_longest
        longest = stretches + plan.close_steps + plan.open_steps
        # The commands of each kind of motion and of the chosen one, and the joint angles that they are computed from.
        commands = 8 * longest * ROBOT * np.dtype(np.float32).itemsize
        return 3 * sum(leaf.nbytes for leaf in jax.tree.leaves(self._single(self._contacts))) + commands

    def _single(self, contacts: int) -> Any:
        """The data of a single world."""
        return self._mjx.make_data(self.blank, impl="warp", naconmax=contacts, njmax=self._rows)

    def _touches(self, contacts: Any, side: str) -> Array:
        """In which worlds a finger presses on the target."""
        worlds = contacts.nefc.shape[0]
        owner = jnp.asarray(self.blank.geom_bodyid)
        finger = self.blank.body(f"{side}_finger").id
        target = self.blank.body(f"body{TARGET}").id
        presses = jnp.arange(len(contacts.contact__worldid)) < contacts.nacon[0]
        presses &= contacts.contact__efc_address[:, 0] >= 0
        a, b = owner[contacts.contact__geom[:, 0]], owner[contacts.contact__geom[:, 1]]
        presses &= ((a == finger) & (b == target)) | ((a == target) & (b == finger))
        return jnp.zeros(worlds, bool).at[jnp.where(presses, contacts.contact__worldid, worlds)].set(True, mode="drop")


def _repeated(places: Array, single: Any) -> Any:
    """A state for each place."""
    return jax.vmap(lambda _, data: data, in_axes=(0, None))(places, single)


def overflow_of(flags: Array) -> Array:
    """Warp's flags as flags of `Overflow`; flags of solvers that stopped early are dropped."""
    from mujoco.mjx.third_party.mujoco_warp import OverflowType

    groups = {
        Overflow.ROWS: OverflowType.NEFC | OverflowType.NJMAX_NNZ,
        Overflow.CONTACTS: OverflowType.BROADPHASE | OverflowType.NARROWPHASE,
        Overflow.SHAPES: OverflowType.CCD | OverflowType.EPA_HORIZON,
    }
    terms = [jnp.where((flags & int(mask)) != 0, int(flag), 0) for flag, mask in groups.items()]
    return functools.reduce(jnp.bitwise_or, terms).astype(jnp.int32)
