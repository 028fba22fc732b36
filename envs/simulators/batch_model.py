"""The model of many worlds at once: one compiled MJCF, and the few fields that differ between worlds.

`body_fields` computes in closed form, for thousands of worlds, what `model.with_bodies` has MuJoCo compute for one, and
`model.move_robot` sets.
"""

# The bindings of MuJoCo come without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.envs.world import model as models
from mechsearch_jax.envs.world.mismatch import TrueCell
from mechsearch_jax.envs.world.world import BODIES
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.shapes import in_order


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
