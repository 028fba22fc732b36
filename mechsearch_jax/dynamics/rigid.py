"""Rigid motions of objects: in the plane, in the hand, and from one gripper pose to another."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mechsearch_jax.geometry.bodies import grasped_shape
from mechsearch_jax.geometry.footprints import QUARTER_TURN, headings, turned
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import compose, inverse, make, matmul, rotate, transform, yaw_rotation


def rigid_motion(
    scene: Superquadrics, before: Float[Array, "n 2"], after: Float[Array, "n 2"], turn: Float[Array, " n"]
) -> Superquadrics:
    """Objects moved in the plane from `before` to `after` [m] and turned about the vertical through `before` [rad]."""
    arm = turned(turn, scene.position[:, :2] - before) + after
    return scene.replace(
        position=jnp.concatenate([arm, scene.position[:, 2:]], axis=-1),
        rotation=matmul(yaw_rotation(turn), scene.rotation),
    )


def in_hand(scene: Superquadrics, index: Int[Array, ""], T_world_grasp: Float[Array, "4 4"]) -> Float[Array, "3 3"]:
    """`R_world_object` of an object once the fingers have closed on it.

    An approximation: an object with flat sides turns about its vertical axis until the nearest side lies flat against
    a finger, and does not shift; a round object stays as it is. Of a body of several parts it is the grasped one that
    turns about its centre or stays, and takes the others with it.
    """
    rotation = scene.rotation[index]
    if scene.parts is None:
        now = headings(rotation, scene.exponents[index])
    else:
        shape = grasped_shape(scene, index, T_world_grasp[:3, 3])
        now = headings(shape.rotation, shape.exponents)
    skew = jnp.arctan2(T_world_grasp[1, 2], T_world_grasp[0, 2]) - now.yaw
    skew = skew - QUARTER_TURN * jnp.round(skew / QUARTER_TURN)
    return matmul(yaw_rotation(jnp.where(now.round, 0.0, skew)), rotation)


def held_pose(scene: Superquadrics, index: Int[Array, ""], T_world_grasp: Float[Array, "4 4"]) -> Float[Array, "4 4"]:
    """`T_world_object` of an object once the fingers have closed on it, turned `in_hand`."""
    rotation, position = in_hand(scene, index, T_world_grasp), scene.position[index]
    if scene.parts is None:
        return make(rotation, position)
    middle = grasped_shape(scene, index, T_world_grasp[:3, 3]).position
    turn = matmul(rotation, scene.rotation[index].T)
    return make(rotation, middle + rotate(turn, position - middle))


def pick_and_place(
    scene: Superquadrics, index: Int[Array, ""], T_world_grasp: Float[Array, "4 4"], T_world_place: Float[Array, "4 4"]
) -> Superquadrics:
    """The scene after an object, turned `in_hand`, has moved with the gripper from one pose to the other."""
    motion = compose(T_world_place, inverse(T_world_grasp))
    held = held_pose(scene, index, T_world_grasp)
    position = transform(motion, held[:3, 3])
    rotation = matmul(motion[:3, :3], held[:3, :3])
    return scene.replace(
        position=scene.position.at[index].set(position), rotation=scene.rotation.at[index].set(rotation)
    )
