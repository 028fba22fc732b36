"""Physics of simulated worlds that differ from those which trials assume: contacts and time steps."""

# The bindings of MuJoCo come without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Callable, Mapping

import mujoco

from mechsearch_jax.envs.world.mismatch import PhysicsName

FINE_STEP, COARSE_STEP = 0.002, 0.005
# Time constants of contacts, twice MuJoCo's default and twice that of the robot's contacts [s].
SOFT, SOFT_ROBOT = 0.04, 0.02
# Iterations of MuJoCo's solver against slip.
NO_SLIP = 10


def _fine(model: mujoco.MjModel) -> None:
    model.opt.timestep = FINE_STEP


def _coarse(model: mujoco.MjModel) -> None:
    model.opt.timestep = COARSE_STEP


def _soft(model: mujoco.MjModel) -> None:
    robot = model.geom_priority > 0
    model.geom_solref[:, 0] = SOFT
    model.geom_solref[robot, 0] = SOFT_ROBOT


def _soft_friction(model: mujoco.MjModel) -> None:
    model.opt.impratio = 1.0


def _pyramidal(model: mujoco.MjModel) -> None:
    model.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    # Without them most of what is grasped slips out of the hand.
    model.opt.noslip_iterations = NO_SLIP


# Each changes a model of the usual physics.
PHYSICS: Mapping[PhysicsName, Callable[[mujoco.MjModel], None]] = {
    "usual": lambda model: None,
    "fine-step": _fine,
    "coarse-step": _coarse,
    "soft-contacts": _soft,
    "soft-friction": _soft_friction,
    "pyramidal-cone": _pyramidal,
}
