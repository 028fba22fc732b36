"""What touched what during a recorded motion: by MuJoCo's collision detection at the recorded poses."""

# The bindings of MuJoCo come without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import functools
from collections.abc import Sequence

import mujoco
import numpy as np

from mechsearch_jax.envs.simulators.simulator import ARM, ROBOT
from mechsearch_jax.envs.simulators.trace import Trace
from mechsearch_jax.envs.world import model as models
from mechsearch_jax.envs.world.world import BODIES
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import Body
from mechsearch_jax.workspace.shelf import Shelf

# The number of a body, or what else may touch one: a part of the robot or of the shelf, in words.
Party = int | str
# Two that touch, in one order only.
Touch = frozenset[Party]

# Parts of the shelf in words, by their geometries; what stands on the board touches it anyway.
WALLS = {
    "back_plane": "the back wall",
    "back_box": "the back wall",
    "left_plane": "the left wall",
    "left_box": "the left wall",
    "right_plane": "the right wall",
    "right_box": "the right wall",
    "ceiling_box": "the upper board",
    "board_box": "the board",
}
HAND, FOREARM = "the hand", "the arm"
_HAND = ("hand", "left_finger", "right_finger")


@functools.cache
def _blank(shelf: Shelf) -> mujoco.MjModel:
    return models.compile_model(shelf, Camera())


def touches(shelf: Shelf, bodies: Sequence[Body | None], trace: Trace) -> list[frozenset[Touch]]:
    """What touches what at each row of a trace; what stands on the board touches it, which does not count.

    Args:
      shelf: of the scene.
      bodies: in their slots, the target last.
      trace: of the motion.
    """
    compounds = models.compounds_in(bodies)
    blank = models.compile_model(shelf, Camera(), compounds=compounds) if compounds else _blank(shelf)
    model = models.with_bodies(blank, bodies)
    parties = _parties(model)
    data, parked = mujoco.MjData(model), models.initial_state(model, bodies).qpos[ROBOT:].reshape(BODIES, 7)
    there = np.array([body is not None for body in bodies])
    rows = []
    for i in range(len(trace.time)):
        poses = np.where(there[:, None], np.concatenate([trace.position[i], trace.quaternion[i]], axis=1), parked)
        data.qpos[:] = np.concatenate([trace.q[i], trace.fingers[i], poses.reshape(-1)])
        mujoco.mj_fwdPosition(model, data)
        pairs = {frozenset((parties[c.geom1], parties[c.geom2])) for c in data.contact}
        rows.append(frozenset(pair for pair in pairs if len(pair) == 2 and None not in pair))
    return rows


def _parties(model: mujoco.MjModel) -> list[Party | None]:
    """Whose each geometry is; None for the plane that bodies stand on."""
    slots = models.geometry_slots(model)
    named = []
    for i in range(model.ngeom):
        name, body = model.geom(i).name, model.body(model.geom_bodyid[i]).name
        part = HAND if body in _HAND else FOREARM if body.startswith("link") else WALLS.get(name)
        named.append(int(slots[i]) if slots[i] >= 0 else part)
    return named
