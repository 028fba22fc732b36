"""What bodies touch, and why one that did not come to rest moves on, in words."""

# The bindings of MuJoCo come without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import jax
import mujoco
import numpy as np
from jaxtyping import Bool, Float

from mechsearch_jax.envs.world import model as models
from mechsearch_jax.envs.world.world import TARGET, World, bodies_of
from mechsearch_jax.shapes import shape_of
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import Body, rotation_matrix
from mechsearch_jax.workspace.shelf import Shelf

# The shelf's geometry that bodies touch, and by how much it is drawn in itself [m].
_SHELF = {
    "board_plane": ("the board", models.MARGIN),
    "back_plane": ("the back wall", models.MARGIN),
    "right_plane": ("the right wall", models.MARGIN),
    "left_plane": ("the left wall", models.MARGIN),
    "ceiling_box": ("the upper board", 0.0),
}
# A body whose nearest axis is farther than this from the vertical leans [rad].
LEANS = math.radians(3.0)
# Bodies that are not farther apart than this touch, to the eye [m].
APART = 1e-3


class Touch(NamedTuple):
    """A contact of a body.

    Attributes:
      body: its slot.
      other: what it touches: another slot, or a part of the shelf in words.
      overlap: how far one is inside the other [m]; negative if they are a little apart.
      normal: unit vector from the other into the body, in the world.
    """

    body: int
    other: int | str
    overlap: float
    normal: Float[np.ndarray, " 3"]

    @property
    def what(self) -> str:
        """What is touched, in words."""
        return self.other if isinstance(self.other, str) else name_of(self.other)


def name_of(slot: int) -> str:
    """The body in a slot, in words."""
    return "the target" if slot == TARGET else f"object {slot}"


def touches(model: mujoco.MjModel, data: mujoco.MjData) -> list[Touch]:
    """All contacts of bodies with each other and with the shelf; those between two bodies once for each.

    Args:
      model: with bodies.
      data: of which the contacts are up to date.
    """
    slot, found = models.geometry_slots(model), []
    for contact in data.contact:
        first, second = (int(contact.geom1), int(contact.geom2))
        # The normal is from the first to the second.
        for geom, other, sign in ((second, first, 1.0), (first, second, -1.0)):
            there, drawn_in = _SHELF.get(model.geom(other).name, (int(slot[other]), models.MARGIN))
            if slot[geom] >= 0 and there != -1:
                overlap = models.MARGIN + drawn_in - float(contact.dist)
                found.append(Touch(int(slot[geom]), there, overlap, sign * contact.frame[:3].copy()))
    return found


def unrest(world: World, restless: Bool[np.ndarray, " 9"], shelf: Shelf, i: int) -> tuple[str, ...]:
    """What bodies do that did not come to rest, a few words for each, as "object 0 leans on the back wall".

    Args:
      world: in which they were stopped; fields with a leading axis for the worlds.
      restless: which ones.
      shelf: of the worlds.
      i: which world.
    """
    if not restless.any():
        return ()
    bodies = bodies_of(jax.tree.map(lambda leaf: leaf[i], jax.device_get(world)))
    model = models.compile_model(shelf, Camera(), compounds=models.compounds_in(bodies))
    model = models.with_bodies(model, bodies)
    # What moves may be a little apart just now.
    model.geom_margin += APART
    contacts = touches(model, models.initial_state(model, bodies))
    return tuple(
        f"{name_of(slot)} {_does(body, [touch for touch in contacts if touch.body == slot])}"
        for slot, body in enumerate(bodies)
        if body is not None and restless[slot]
    )


def _does(body: Body, contacts: Iterable[Touch]) -> str:
    """What a body with these contacts does."""
    contacts = sorted(contacts, key=lambda touch: float(touch.normal[2]))
    if not contacts:
        return "falls"
    upright = np.abs(rotation_matrix(body.quaternion)[2])
    sideways, below = contacts[0], contacts[-1]
    if upright.max() < math.cos(LEANS) and sideways.other != below.other:
        return f"leans on {sideways.what}"
    if _is_round(body) and upright[2] < math.sin(LEANS):
        return f"rolls on {below.what}"
    return f"tips over on {below.what}" if upright.max() < math.cos(LEANS) else f"slides on {below.what}"


def _is_round(body: Body) -> bool:
    """Whether a body rolls where it lies on its side."""
    if body.compound is not None:
        return any(piece.shape not in ("box", "convex") for piece in body.compound.pieces)
    return shape_of(body.shape).round
