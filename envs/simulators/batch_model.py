"""The model of many worlds at once: one compiled MJCF, and the few fields that differ between worlds.

`body_fields` computes in closed form, for thousands of worlds, what `model.with_bodies` has MuJoCo compute for one, and
`model.move_robot` sets.

Every slot of an object has room for the same number of solids of each kind, so that all scenes share one compiled
program; rows without a solid shrink to a millimetre inside the thickest one, where nothing touches them. There is no
room for convex polyhedra: Warp keeps the vertices of meshes in the model, so that every new mesh would be compiled.
"""

# The bindings of MuJoCo come without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.scipy.spatial.transform import Rotation
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.envs.world import model as models
from mechsearch_jax.envs.world.mismatch import TrueCell
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
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.shapes import PRIMITIVES, in_order
from mechsearch_jax.shapes.compound import CONVEX_CODE, Compound, Piece
from mechsearch_jax.workspace.scenario import Scenario

# Solids of each kind that an object may have.
ROWS: Mapping[str, int] = MappingProxyType({"box": 4, "cylinder": 10, "ellipsoid": 2, "capsule": 4})
_TINY = (2 * models.TINY, 2 * models.TINY, 2 * models.TINY)
_EMPTY = Compound(tuple(Piece(name, _TINY) for name, count in ROWS.items() for _ in range(count)), 1.0, 1.0)
# What the slots of all objects hold in the compiled model; that of a plain target is as in the plain one.
ROOM: Mapping[int, Compound] = MappingProxyType(dict.fromkeys(range(TARGET), _EMPTY))


class BodyFields(PyTreeNode):
    """Fields of the model that depend on the bodies' shapes and on the cell, with a leading axis for the worlds.

    Names, units and further axes (bodies, geoms, degrees of freedom) are those of MJX's model.
    """

    geom_size: jax.Array
    geom_rbound: jax.Array
    geom_aabb: jax.Array
    geom_friction: jax.Array
    body_pos: jax.Array
    body_quat: jax.Array
    body_mass: jax.Array
    body_inertia: jax.Array
    body_subtreemass: jax.Array
    body_invweight0: jax.Array
    dof_invweight0: jax.Array
    body_gravcomp: jax.Array


class Cells(PyTreeNode):
    """How the worlds differ from what the planner assumes: what of an `TrueCell` this simulator's model holds.

    Attributes:
      friction: factors on all sliding frictions, shape (worlds,).
      body_friction, mass: factors on the sliding friction, and on mass and inertia, of each body, shape (worlds, 9).
      position, quaternion: of the robot's first link in the world, shapes (worlds, 3) [m] and (worlds, 4).
    """

    friction: jax.Array
    body_friction: jax.Array
    mass: jax.Array
    position: jax.Array
    quaternion: jax.Array


def cells_of(blank: mujoco.MjModel, cells: Sequence[TrueCell]) -> Cells:
    """The cells of all worlds, float32; their physics are left out."""
    poses = [models.base_pose(blank, cell.T_world_base) for cell in cells]
    columns = (
        [cell.friction for cell in cells],
        [cell.body_friction for cell in cells],
        [cell.mass * cell.body_mass for cell in cells],
        [position for position, _ in poses],
        [quaternion for _, quaternion in poses],
    )
    return Cells(*(jax.device_put(np.array(column, np.float32)) for column in columns))


def body_fields(
    blank: mujoco.MjModel,
    kind: Int[Array, "worlds 9"],
    half_size: Float[Array, "worlds 9 3"],
    valid: Bool[Array, "worlds 9"],
    cells: Cells,
    weights: tuple[Float[Array, "worlds 9"], Float[Array, "worlds 9 3"]] | None = None,
    shaped: range = range(BODIES),
) -> BodyFields:
    """The fields of a model whose slots hold the bodies of each world, float32; traceable.

    Args:
      blank: the compiled model with empty slots.
      kind, half_size, valid: of the bodies, as in a `World`.
      cells: of the worlds.
      weights: masses [kg] and principal moments of inertia [kg m2]; those of the shapes if None.
      shaped: the slots with a geometry of every shape.
    """
    worlds = len(kind)
    mass, inertia = weights or models.masses_and_inertias(kind, half_size, jnp)
    mass = jnp.where(valid, mass, models.EMPTY_MASS)
    inertia = jnp.where(valid[..., None], inertia, models.EMPTY_INERTIA)
    mass, inertia = cells.mass * mass, cells.mass[..., None] * inertia

    fields = {}
    for name in BodyFields.__dataclass_fields__:
        value = jnp.asarray(getattr(blank, name), jnp.float32)
        fields[name] = jnp.broadcast_to(value, (worlds, *value.shape))

    fields["geom_friction"] = fields["geom_friction"].at[:, :, 0].multiply(cells.friction[:, None])
    if shaped:
        slots, factors = models.body_geometries(blank, shaped), cells.body_friction[:, shaped.start :, None]
        fields["geom_friction"] = fields["geom_friction"].at[:, slots, 0].multiply(factors)

    def put(name: str, where: np.ndarray | int, value: Array) -> None:
        fields[name] = fields[name].at[:, where].set(value.astype(jnp.float32))

    body = np.array([blank.body(f"body{i}").id for i in range(BODIES)])
    put("body_mass", body, mass)
    put("body_inertia", body, inertia)
    put("body_gravcomp", body, ~valid)
    # A free body is its whole subtree; the world's subtree is everything.
    put("body_subtreemass", body, mass)
    robot = blank.body_mass.sum() - blank.body_mass[body].sum()
    put("body_subtreemass", 0, robot + mass.sum(axis=1))

    link = blank.body("link1").id
    put("body_pos", link, cells.position)
    put("body_quat", link, cells.quaternion)

    # The inverse of a free body's mass matrix is diagonal; its rotations share the mean, as in mj_setConst.
    inverse = jnp.stack([1 / mass, (1 / inertia).mean(axis=-1)], axis=-1)
    put("body_invweight0", body, inverse)
    dof = np.concatenate([np.arange(6) + blank.joint(f"body{i}").dofadr[0] for i in range(BODIES)])
    put("dof_invweight0", dof, jnp.repeat(inverse, 3, axis=-1).reshape(worlds, -1))

    for shape in in_order() if shaped else ():
        geom = np.array([blank.geom(models.geometry_name(shape, i)).id for i in shaped])
        used = (valid & (kind == shape.code))[:, shaped.start :]
        half = jnp.where(used[..., None], half_size[:, shaped.start :] - models.MARGIN, models.TINY)
        put("geom_size", geom, shape.geometry_size(half, jnp))
        put("geom_rbound", geom, shape.bounding_radius(half, jnp))
        put("geom_aabb", geom, jnp.concatenate([jnp.zeros_like(half), half], axis=-1))
    fields["geom_aabb"] = fields["geom_aabb"].reshape(worlds, -1, 2, 3)
    return BodyFields(**fields)


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
