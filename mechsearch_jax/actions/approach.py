"""What all kinds of action share: the straight approach of the gripper against the shelf, the objects, unseen space."""

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
from mechsearch_jax.robot.gripper import arm_hits_shelf
from mechsearch_jax.robot.kinematics import line_kinematics
from mechsearch_jax.workspace.shelf import hits_shelf

# Number of poses on each stretch of a motion where it is followed closely.
CLOSE_WAYPOINTS = 12
# At how many places an action's gripper and object are tested against unseen space.
PLACES = 5


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


def approach_clear(space: ActionSpace, tables: ActionTables, opening: np.ndarray, wrist: np.ndarray, T, mask):
    """Whether the arm reaches along the approaches to poses (C, 4, 4) and nothing of it touches the shelf."""

    def clear(tables, row, i):
        q7 = tables.q7[jnp.asarray(opening)[i], jnp.asarray(wrist)[i]]
        q, reachable = line_kinematics(row[i], jnp.float32(space.gripper.approach), q7, space.waypoints)
        return reachable & ~jnp.any(arm_hits_shelf(q, space.shelf))

    def touches(tables, row, i):
        points = transform(row[i], tables.clouds[jnp.asarray(opening)[i], jnp.asarray(wrist)[i]].T)
        return jnp.any(hits_shelf(space.shelf, points))

    reached = masked_vmap(clear, mask, tables, T, block=512)
    return reached & ~masked_vmap(touches, reached, tables, T, block=512)


def approach_enters(tables: ActionTables, possible: PossibleSpace, opening: int, wrist, T, mask):
    """Whether the swept gripper enters possible space, for poses (C, 4, 4) where the mask is true."""

    def entering(tables, row, i):
        T, possible = row
        points = transform(T[i], tables.clouds[opening, jnp.asarray(wrist)[i]].T)
        return jnp.any(enters(jax.tree.map(lambda a: a[...], possible), points))

    return masked_vmap(entering, mask, tables, (T, possible))
