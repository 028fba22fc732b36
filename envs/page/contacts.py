"""What touched what during a recorded motion: by MuJoCo's collision detection at the recorded poses."""

# The bindings of MuJoCo come without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Mapping, Sequence

import mujoco
import numpy as np

from mechsearch_jax.envs.simulators.simulator import ROBOT
from mechsearch_jax.envs.simulators.trace import Trace
from mechsearch_jax.envs.world import model as models
from mechsearch_jax.envs.world.world import BODIES, TARGET
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import Body
from mechsearch_jax.workspace.shelf import Shelf

# The slot of a body, or what else may touch one, in words: a part of the robot or of the shelf.
Party = int | str
# Two that touch, in either order.
Touch = frozenset[Party]

HAND, ARM = "the hand", "the arm"
ROBOT_PARTS = (HAND, ARM)
# Parts of the shelf by their geometries. What stands on the board touches the plane in it, which does not count.
_SHELF = {
    "back_plane": "the back wall",
    "back_box": "the back wall",
    "left_plane": "the left wall",
    "left_box": "the left wall",
    "right_plane": "the right wall",
    "right_box": "the right wall",
    "ceiling_box": "the upper board",
    "board_box": "the board",
}
WALLS = frozenset(_SHELF.values())
_HAND = ("hand", "left_finger", "right_finger")
# A body that is farther from where it was moves [m]; for so many rows before it may have been touched.
STIRRED, ROWS_BEFORE = 2e-3, 2
# What is no farther apart touches, and may have touched between two rows of a trace [m].
TOUCHING, BESIDE = 2e-4, 0.01


def touches(
    shelf: Shelf, bodies: Sequence[Body | None], trace: Trace, within: float = TOUCHING
) -> list[frozenset[Touch]]:
    """What touches what at each row of a trace.

    Args:
      shelf: of the scene.
      bodies: in their slots, the target last.
      trace: of the motion.
      within: what is so near to each other counts [m].
    """
    model = models.with_bodies(_blank(shelf, bodies), bodies)
    # MuJoCo adds the margins of two geometries, which are smaller than what they stand for.
    model.geom_margin[:] = models.MARGIN + within / 2
    parties, data = _parties(model), mujoco.MjData(model)
    parked = models.initial_state(model, bodies).qpos[ROBOT:].reshape(BODIES, 7)
    there = np.array([body is not None for body in bodies])[:, None]
    rows = []
    for i in range(len(trace.time)):
        poses = np.where(there, np.concatenate([trace.position[i], trace.quaternion[i]], axis=1), parked)
        data.qpos[:] = np.concatenate([trace.q[i], trace.fingers[i], poses.reshape(-1)])
        mujoco.mj_fwdPosition(model, data)
        pairs = {frozenset((parties[c.geom1], parties[c.geom2])) for c in data.contact}
        rows.append(frozenset(pair for pair in pairs if len(pair) == 2 and None not in pair))
    return rows


def chain(row: Collection[Touch], last: Collection[Party]) -> tuple[Party, ...]:
    """The shortest chain of things that touch from the robot to one of some parties; empty if there is none."""
    reached: list[tuple[Party, ...]] = [(part,) for part in ROBOT_PARTS]
    seen: set[Party] = set(ROBOT_PARTS)
    for path in reached:
        beside = {other for pair in row if path[-1] in pair for other in pair - {path[-1]}} - seen
        for party in sorted(beside, key=str):
            if party in last:
                return (*path, party)
            if isinstance(party, int):
                reached.append((*path, party))
                seen.add(party)
    return ()


def knocked(
    rows: Sequence[Collection[Touch]], near: Callable[[], Sequence[Collection[Touch]]], trace: Trace, victim: int
) -> tuple[Party, ...]:
    """By what the robot moved a body: the robot's part, what it moved first, ..., the body; empty if that is not clear.

    Each but the robot began to move as the one before it touched it and moved, and not before.

    Args:
      rows: what touched what at each row of the trace.
      near: what was within `BESIDE` of what, for where nothing touched: between two rows things may meet and part.
      trace: of the motion.
      victim: slot of the body.
    """
    moved = np.linalg.norm(trace.position - trace.position[:1], axis=-1) > STIRRED
    begins = {k: int(np.argmax(moved[:, k])) for k in range(BODIES) if moved[:, k].any()}
    path: list[Party] = [victim]
    while isinstance(body := path[0], int):
        if body not in begins:
            return ()
        mover = _mover(rows, begins, body, path)
        mover = _mover(near(), begins, body, path) if mover is None else mover
        if mover is None:
            return ()
        path.insert(0, mover)
    return tuple(path)


def _mover(
    rows: Sequence[Collection[Touch]], begins: Mapping[int, int], body: int, known: Sequence[Party]
) -> Party | None:
    """What touched a body as it began to move, and moved itself: the robot, or else what moved first; None if nothing.

    Args:
      rows: what touched what at each row of a trace.
      begins: the row at which each body began to move.
      body: its slot.
      known: what moved later.
    """
    pairs = set().union(*rows[max(begins[body] - ROWS_BEFORE, 0) : begins[body] + 1])
    beside = {party for pair in pairs if body in pair for party in pair - {body}} - set(known)
    if robot := [part for part in ROBOT_PARTS if part in beside]:
        return robot[0]
    movers = [k for k in beside if isinstance(k, int) and k in begins and begins[k] <= begins[body]]
    return min(movers, key=lambda k: begins[k]) if movers else None


def named(party: Party, hidden: bool = False) -> str:
    """A party in words.

    Args:
      party: to be named.
      hidden: whether the robot does not know where the target is.
    """
    if party == TARGET:
        return "the hidden target" if hidden else "the target"
    return f"object {party}" if isinstance(party, int) else party


def pressed(path: Sequence[Party], hidden: bool = False, now: bool = False) -> str:
    """A chain of `chain` in words: "the hand pressed object 0 against the left wall".

    Args:
      path: the chain.
      hidden: whether the robot does not know where the target is.
      now: in the present tense.
    """
    first, *others = path
    if len(others) == 1:
        return f"{first} {'runs' if now else 'ran'} into {named(others[0], hidden)}"
    words = f"{first} {'presses' if now else 'pressed'} {named(others[0], hidden)} against {named(others[1], hidden)}"
    return words + "".join(f", and that against {named(party, hidden)}" for party in others[2:])


@functools.cache
def _plain(shelf: Shelf) -> mujoco.MjModel:
    return models.compile_model(shelf, Camera())


def _blank(shelf: Shelf, bodies: Sequence[Body | None]) -> mujoco.MjModel:
    compounds = models.compounds_in(bodies)
    return models.compile_model(shelf, Camera(), compounds=compounds) if compounds else _plain(shelf)


def _parties(model: mujoco.MjModel) -> list[Party | None]:
    """Whose each geometry is; None for the plane that bodies stand on."""
    slots = models.geometry_slots(model)
    parties: list[Party | None] = []
    for i in range(model.ngeom):
        body = model.body(model.geom_bodyid[i]).name
        part = HAND if body in _HAND else ARM if body.startswith("link") else _SHELF.get(model.geom(i).name)
        parties.append(int(slots[i]) if slots[i] >= 0 else part)
    return parties
