"""What all kinds of action share: the gripper's way in against the shelf, the objects and unseen space."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mechsearch_jax.actions.config import ActionSpace, ActionTables
from mechsearch_jax.actions.unseen_space import PossibleSpace, enters
from mechsearch_jax.geometry import superquadric
from mechsearch_jax.geometry.collision import Pair, any_inside
from mechsearch_jax.geometry.masked import masked_vmap
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import compose, inverse, make, transform
from mechsearch_jax.graspability import boxes_overlap
from mechsearch_jax.robot.entry import arm_enters, crossing_length, crossing_poses
from mechsearch_jax.workspace.shelf import hits_shelf

# Number of poses on each stretch of a motion where it is followed closely.
CLOSE_WAYPOINTS = 12
# At how many places an action's gripper and object are tested against unseen space.
PLACES = 5
# At how many places of its crossing a gripper is tested. Crossings are at most 17 cm long, which leaves 3.4 cm from
# place to place: less than the fingers measure along x, however they are turned, so that what is swept has no gaps.
CROSSING_PLACES = 5


def object_clouds(scene: Superquadrics, count: int) -> Float[Array, "n 3 p"]:
    """Surface points of every object in its own frame, as rows of coordinates [m]."""
    return jnp.swapaxes(superquadric.sample_surface(scene.size, scene.exponents, count), -1, -2)


def swept_object(cloud, R_object_gripper, distance, steps=7):
    """An object's surface at several places on its way along the gripper's -z, in its own frame, as rows."""
    shift = -R_object_gripper[:, 2, None] * (jnp.arange(steps) * (distance / (steps - 1)))[None]
    return (cloud[:, :, None] + shift[:, None, :]).reshape(3, -1)


def gripper_hits(tables: ActionTables, opening, wrist, T, scene: Superquadrics, mask):
    """Which objects the swept gripper hits: poses (C, 4, 4) against objects (N), where the mask (C, N) is true.

    `opening` and `wrist` say for each pose which of the clouds is meant.
    """
    c, n = mask.shape
    opening, wrist = jnp.broadcast_to(opening, c), jnp.asarray(wrist)

    def pair(tables, row, i):
        T, opening, wrist, scene = row
        k, j = i // n, i % n
        cloud = tables.clouds[opening[k], wrist[k]]
        T_object_world = inverse(make(scene.rotation[j], scene.position[j]))
        return Pair(cloud, compose(T_object_world, T[k]), scene.size[j], scene.exponents[j])

    T_gripper_object = compose(inverse(T)[:, None], make(scene.rotation, scene.position)[None])
    low, high = tables.low[opening, wrist], tables.high[opening, wrist]
    near = boxes_overlap(low[:, None], high[:, None], T_gripper_object, scene.size[None])
    return any_inside((mask & near).reshape(-1), pair, tables, (T, opening, wrist, scene)).reshape(c, n)


def crossing_hits(space: ActionSpace, tables: ActionTables, opening, wrist, T, scene: Superquadrics, mask):
    """Which objects the gripper hits on its crossings to poses (C, 4, 4), where the mask (C, N) is true.

    It is tested as far as the nearest place outside: what follows lies in front of the shelf.
    """
    (c, n), gripper = mask.shape, space.gripper
    outside = gripper.nearest_outside
    places = crossing_poses(T, outside, gripper, CROSSING_PLACES).reshape(-1, 4, 4)
    crosses = mask & (crossing_length(T, outside, gripper) > 0.0)[:, None]
    still = tables.replace(clouds=tables.still, low=jnp.min(tables.still, axis=-1), high=jnp.max(tables.still, axis=-1))
    wrist = jnp.repeat(jnp.broadcast_to(wrist, c), CROSSING_PLACES)
    hits = gripper_hits(still, opening, wrist, places, scene, jnp.repeat(crosses, CROSSING_PLACES, axis=0))
    return jnp.any(hits.reshape(c, CROSSING_PLACES, n), axis=1)


def approach_clear(space: ActionSpace, tables: ActionTables, opening: np.ndarray, wrist: np.ndarray, T, mask):
    """Whether the arm follows the ways in to poses (C, 4, 4) and nothing of it touches the shelf."""

    def touches(tables, row, i):
        points = transform(row[i], tables.clouds[jnp.asarray(opening)[i], jnp.asarray(wrist)[i]].T)
        return jnp.any(hits_shelf(space.shelf, points))

    reached = arm_enters(space.shelf, space.gripper, space.waypoints, T, tables.q7[opening, wrist], mask)
    return reached & ~masked_vmap(touches, reached, tables, T, block=512)


def approach_enters(tables: ActionTables, possible: PossibleSpace, opening: int, wrist, T, mask):
    """Whether the swept gripper enters possible space, for poses (C, 4, 4) where the mask is true."""

    def entering(tables, row, i):
        T, possible = row
        points = transform(T[i], tables.clouds[opening, jnp.asarray(wrist)[i]].T)
        return jnp.any(enters(jax.tree.map(lambda a: a[...], possible), points))

    return masked_vmap(entering, mask, tables, (T, possible))
