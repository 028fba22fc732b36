"""Tests that all kinds of action share: the gripper's way in against shelf, objects and unseen space."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mechsearch_jax.actions.config import ActionSpace, ActionTables
from mechsearch_jax.actions.unseen_space import PossibleSpace, cloud_enters
from mechsearch_jax.geometry.bodies import surfaces
from mechsearch_jax.geometry.collision import Clouds, clouds_of
from mechsearch_jax.geometry.masked import masked_vmap, taken
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import translate
from mechsearch_jax.robot.entry import crossing_length, crossing_poses

# Number of poses on each stretch of a motion that is tested closely.
CLOSE_WAYPOINTS = 12
# Number of places where an action's gripper and object are tested against unseen space.
PLACES = 5
# Number of places where a gripper is tested on its crossing. Crossings are at most 17 cm long, so that places are at
# most 3.4 cm apart: less than the fingers measure along x at any yaw, so that the swept volume has no gaps. An
# approximation: crossings to a found target from 75 degrees to the side are up to 24 cm long, and places 4.9 cm apart.
CROSSING_PLACES = 5
# Number of places where an object in the hand is tested on its straight way in or out.
SWEPT_PLACES = 7


def object_clouds(scene: Superquadrics, count: int) -> Float[Array, "n 3 p"]:
    """Points on the surfaces of every object's parts in its own frame, as rows of coordinates [m]."""
    return jnp.swapaxes(surfaces(scene, count), -1, -2)


def swept_places(T_world_object, direction, distance, steps=SWEPT_PLACES):
    """Poses of an object moved along a direction by 0 to `distance` [m], shape (..., steps, 4, 4)."""
    share = jnp.linspace(0.0, distance, steps).reshape(*[1] * (T_world_object.ndim - 2), steps, 1)
    T = jnp.broadcast_to(T_world_object[..., None, :, :], (*T_world_object.shape[:-2], steps, 4, 4))
    return translate(T, share * direction[..., None, :])


def gripper_clouds(tables: ActionTables) -> Clouds:
    """Clouds that the gripper sweeps on its way in, then those of the gripper at rest; see `cloud_index`."""
    swept, still = (a.reshape(-1, *a.shape[2:]) for a in (tables.clouds, tables.still))
    # Repeated points change no collision.
    longer = jnp.pad(still, ((0, 0), (0, 0), (0, swept.shape[-1] - still.shape[-1])), mode="edge")
    return clouds_of(jnp.concatenate([swept, longer]))


def cloud_index(tables: ActionTables, opening, wrist, still: bool = False):
    """Index in `gripper_clouds` for an opening (`OPEN` or `CLOSED`) and a wrist; swept, or `still` for at rest."""
    openings, wrists = tables.q7.shape
    return (still * openings + opening) * wrists + wrist


def crossing_places(space: ActionSpace, T: Float[Array, "c 4 4"]) -> tuple[Float[Array, "c k 4 4"], Bool[Array, " c"]]:
    """Poses of the gripper on its crossings to poses T, and which T have a crossing.

    Crossings end at the nearest place outside: beyond lies the free space in front of the shelf.
    """
    outside = space.gripper.nearest_outside
    places = crossing_poses(T, outside, space.gripper, CROSSING_PLACES)
    return places, crossing_length(T, outside, space.gripper) > 0.0


def approach_enters(tables: ActionTables, possible: PossibleSpace, cloud, T, mask):
    """Whether the swept gripper enters possible space at poses (C, 4, 4); False where the mask is."""

    def entering(clouds, possible, row):
        T, cloud = row
        return cloud_enters(possible, T, taken(clouds, cloud[None])[0])

    return masked_vmap(entering, mask, gripper_clouds(tables).points, possible, (T, jnp.asarray(cloud)))
