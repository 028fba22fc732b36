"""Compounds in the model of many worlds at once.

Every slot of an object has room for the same number of solids of each kind, so that all scenes share one compiled
program; rows without a solid shrink to a millimetre inside the thickest one, where nothing touches them. There is no
room for convex polyhedra: Warp keeps the vertices of meshes in the model, so that every new mesh would be compiled.
"""

# The bindings of MuJoCo come without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.scipy.spatial.transform import Rotation
from jaxtyping import Array, Bool, Float

from mechsearch_jax.envs.simulators.batch_model import BodyFields, Cells, body_fields
from mechsearch_jax.envs.world import model as models
from mechsearch_jax.envs.world.world import (
    BODIES,
    TARGET,
    Compounds,
    Matter,
    Solids,
    World,
    alike,
    as_compounds,
    from_scenario,
)
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.shapes import PRIMITIVES
from mechsearch_jax.shapes.compound import CONVEX_CODE, Compound, Piece
from mechsearch_jax.workspace.scenario import Scenario

# Solids of each kind that an object may have.
ROWS: Mapping[str, int] = MappingProxyType({"box": 4, "cylinder": 10, "ellipsoid": 2, "capsule": 4})
_TINY = (2 * models.TINY, 2 * models.TINY, 2 * models.TINY)
_EMPTY = Compound(tuple(Piece(name, _TINY) for name, count in ROWS.items() for _ in range(count)), 1.0, 1.0)
# What the slots of all objects hold in the compiled model; that of a plain target is as in the plain one.
ROOM: Mapping[int, Compound] = MappingProxyType(dict.fromkeys(range(TARGET), _EMPTY))


class CompoundFields(BodyFields):
    """`BodyFields`, and those that differ between worlds of compounds alone."""

    geom_pos: jax.Array
    geom_quat: jax.Array
    body_iquat: jax.Array


def room_for(world: World) -> Mapping[int, Compound]:
    """What the slots of a model hold in which worlds have room; nothing in that of plain worlds.

    A target that is a compound is in the model itself, with its meshes: all worlds have the same.
    """
    if world.target is not None:
        return {**ROOM, TARGET: world.target.made_of}
    return {} if world.compounds is None else ROOM


def check_room(compounds: Compounds) -> None:
    """Check that the solids of objects fit into the model's rows.

    Raises:
      InputError: they do not, or there is a convex polyhedron.
    """
    solids = jax.device_get(compounds.solids)
    kind, valid = (np.asarray(leaf)[..., :TARGET, :] for leaf in (solids.kind, solids.valid))
    if (valid & (kind == CONVEX_CODE)).any():
        raise InputError("MjxSimulator: meshes and convex polyhedra cannot be simulated here; use the NativeSimulator")
    for name, most in ROWS.items():
        count = int((valid & (kind == PRIMITIVES[name].code)).sum(axis=-1).max())
        if count > most:
            raise InputError(
                f"MjxSimulator: an object has {count} solids of kind {name}, more than {most}; use the NativeSimulator"
            )


def fitting(world: World, room: Mapping[int, Compound]) -> World:
    """Worlds as a model takes them: plain ones as compounds of a single solid each, if it has room for compounds.

    Args:
      world: fields with a leading axis for the worlds.
      room: what the model's slots hold, see `room_for`.

    Raises:
      InputError: there are compounds and no room for them, or more solids of a kind than there is room for, or the
        target is another one.
    """
    if world.compounds is None:
        return _as_compounds(world) if room else world
    if not room:
        raise InputError("MjxSimulator: there are compounds among plain worlds; run them one set after the other")
    if room_for(world).get(TARGET) != room.get(TARGET):
        raise InputError("MjxSimulator: the worlds differ in their target; run them one set after the other")
    check_room(world.compounds)
    return world


def _as_compounds(world: World) -> World:
    rows = [jax.tree.map(lambda leaf, i=i: np.asarray(leaf)[i], world) for i in range(len(world.kind))]
    return jax.tree.map(lambda *leaves: jax.device_put(np.stack(leaves)), *(as_compounds(row) for row in rows))


def like_present(present: World | None, scenario: Scenario) -> World:
    """The world of a scenario, with the leaves of the present worlds.

    Raises:
      InputError: it has compounds, and the present worlds have none, or its target is another compound.
    """
    first: Any = jax.tree.map(lambda leaf: np.asarray(leaf)[0], present)
    world = alike([first, from_scenario(scenario)])[1]
    if jax.tree.structure(world) != jax.tree.structure(first):
        raise InputError(
            f"MjxSimulator: {scenario.name} has compounds, the scenes before it have none or another target; run them"
            " one set after the other"
        )
    return world


def compound_fields(blank: mujoco.MjModel, world: World, cells: Cells) -> CompoundFields:
    """The fields of a model whose slots hold the compounds of each world, float32; traceable.

    Args:
      blank: the compiled model with `ROOM`.
      world: with `compounds`; fields with a leading axis for the worlds.
      cells: of the worlds.
    """
    compounds = world.compounds
    assert compounds is not None
    plain = _plain_fields(blank, world, compounds.matter, cells)
    fields = {name: getattr(plain, name) for name in BodyFields.__dataclass_fields__}
    worlds = len(world.kind)
    for name in ("geom_pos", "geom_quat", "body_iquat"):
        value = jnp.asarray(getattr(blank, name), jnp.float32)
        fields[name] = jnp.broadcast_to(value, (worlds, *value.shape))

    def put(name: str, where: np.ndarray, value: Array) -> None:
        fields[name] = fields[name].at[:, where].set(value.astype(jnp.float32))

    objects: tuple[Solids, Matter] = jax.tree.map(lambda leaf: leaf[:, :TARGET], (compounds.solids, compounds.matter))
    solids, matter = objects
    there = world.valid[:, :TARGET]
    friction = cells.friction[:, None] * cells.body_friction[:, :TARGET] * matter.friction
    geoms = _geoms(blank)
    for name, rows in geoms.items():
        half, position, rotation, used = _rows(solids, there, name)
        primitive = PRIMITIVES[name]
        flat = rows.reshape(-1)
        put("geom_size", flat, primitive.geometry_size(half, jnp).reshape(worlds, -1, 3))
        put("geom_rbound", flat, primitive.bounding_radius(half, jnp).reshape(worlds, -1))
        box = jnp.stack([jnp.zeros_like(half), half], axis=-2)
        put("geom_aabb", flat, box.reshape(worlds, -1, 2, 3))
        put("geom_pos", flat, position.reshape(worlds, -1, 3))
        put("geom_quat", flat, _quaternions(rotation).reshape(worlds, -1, 4))
        sliding = jnp.broadcast_to(friction[..., None], used.shape).reshape(worlds, -1)
        fields["geom_friction"] = fields["geom_friction"].at[:, flat, 0].set(sliding)
    body = np.array([blank.body(f"body{i}").id for i in range(BODIES)])
    axes = compounds.matter.axes
    identity = jnp.broadcast_to(jnp.eye(3), axes.shape)
    put("body_iquat", body, _quaternions(jnp.where(world.valid[..., None, None], axes, identity)))
    return CompoundFields(**fields)


def _plain_fields(blank: mujoco.MjModel, world: World, matter: Matter, cells: Cells) -> BodyFields:
    """`body_fields` with the masses of compounds, and the geometry of the target alone, if that is no compound."""
    weights = matter.mass, matter.moments
    if world.target is None:
        return body_fields(blank, world.kind, world.half_size, world.valid, cells, weights, range(TARGET, TARGET + 1))
    plain = body_fields(blank, world.kind, world.half_size, world.valid, cells, weights, range(BODIES, BODIES))
    geoms = np.flatnonzero(models.geometry_slots(blank) == TARGET)
    friction = plain.geom_friction.at[:, geoms, 0].multiply(cells.body_friction[:, TARGET, None])
    return plain.replace(geom_friction=friction)


def _geoms(blank: mujoco.MjModel) -> dict[str, np.ndarray]:
    """The numbers of the geometries of each kind, shape (8, rows), in the order of `ROOM`."""
    names = [piece.shape for piece in _EMPTY.pieces]
    return {
        kind: np.array(
            [[blank.geom(f"solid{i}_{k}").id for k, name in enumerate(names) if name == kind] for i in range(TARGET)]
        )
        for kind in ROWS
    }


def _rows(
    solids: Solids, there: Bool[Array, "w 8"], name: str
) -> tuple[Float[Array, "w 8 n 3"], Float[Array, "w 8 n 3"], Float[Array, "w 8 n 3 3"], Bool[Array, "w 8 n"]]:
    """Half-extents, position and rotation of the geometries of a kind, and which of them are used."""
    of_kind = solids.valid & (solids.kind == PRIMITIVES[name].code) & there[..., None]
    order = jnp.argsort(~of_kind, axis=-1, stable=True)[..., : ROWS[name]]

    def taken(leaf: Array) -> Array:
        index = order.reshape(*order.shape, *[1] * (leaf.ndim - order.ndim))
        return jnp.take_along_axis(leaf, index, axis=2)

    used = taken(of_kind)
    half = jnp.where(used[..., None], taken(solids.half_size) - models.MARGIN, models.TINY)
    position = jnp.where(used[..., None], taken(solids.position), _hiding_place(solids)[:, :, None])
    return half, position, taken(solids.rotation), used


def _hiding_place(solids: Solids) -> Float[Array, "w 8 3"]:
    """The middle of each body's thickest solid, in its frame [m]: where rows are that are not used.

    In a thin one, such as the rim under a can, they would touch what the body stands on, with up to four contacts each.
    """
    thickness = jnp.where(solids.valid, solids.half_size.min(axis=-1), 0.0)
    thickest = jnp.argmax(thickness, axis=-1)[..., None, None]
    return jnp.take_along_axis(solids.position, thickest, axis=2)[:, :, 0]


def _quaternions(rotation: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 4"]:
    flat = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_quat()[:, np.array([3, 0, 1, 2])]
    return flat.reshape(*rotation.shape[:-2], 4)
