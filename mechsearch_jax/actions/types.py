"""The action of a robot, and what a sampled one comes to."""

from __future__ import annotations

from typing import NamedTuple

import flax.struct
import jax
from jaxtyping import Array, Bool, Int

from mechsearch_jax.geometry.superquadric import Superquadrics


class Action(flax.struct.PyTreeNode):
    """One action of the robot; every field may carry leading batch axes.

    Attributes:
      kind: an `ActionKind`, int32.
      object: index of the object that is pushed or picked, int32; N stands for a found target, beside N objects. 0 for
        kinds that move none.
      T_world_gripper: gripper pose where a push starts, or where something is grasped, shape (..., 4, 4).
      displacement: translation of the gripper while it pushes, in the world [m], shape (..., 3); zero for other kinds.
      T_world_place: gripper pose where the object is released, shape (..., 4, 4); for a push, the pose where it ends.
      q7: angle of joint 7 during the whole motion [rad].
      opening: distance between the fingers while the gripper approaches [m]; 0 is closed.
    """

    kind: jax.Array
    object: jax.Array
    T_world_gripper: jax.Array
    displacement: jax.Array
    T_world_place: jax.Array
    q7: jax.Array
    opening: jax.Array


class Sample(flax.struct.PyTreeNode):
    """A sampled action.

    Attributes:
      action: the action; of kind NONE where none is possible.
      wrist: index of its wrist angle.
      grippers, bodies: places of the gripper and of the object that touch what is there, shape (PLACES, 4, 4); None for
        an action that touches nothing.
    """

    action: Action
    wrist: jax.Array
    grippers: jax.Array | None = None
    bodies: jax.Array | None = None


class DrawnWay(NamedTuple):
    """Which way of moving which object was drawn.

    Attributes:
      object: index of the object.
      number: of the way and its distance, among V times D.
      wanted: whether it is looked at; where it is not, what comes of it means nothing.
    """

    object: Int[Array, ""]
    number: Int[Array, ""]
    wanted: Bool[Array, ""]


class Draft(flax.struct.PyTreeNode):
    """What one way of moving an object comes to, before it is chosen.

    Attributes:
      possible: whether it can be done.
      action: the action, if it can.
      wrist: index of its wrist angle.
      grippers: places of the gripper that touch what is there, shape (PLACES, 4, 4).
      bodies: places of the object that touch what is there, shape (PLACES, 4, 4).
    """

    possible: jax.Array
    action: Action
    wrist: jax.Array
    grippers: jax.Array
    bodies: jax.Array


class Prediction(flax.struct.PyTreeNode):
    """What an action is predicted to do.

    Attributes:
      scene: the objects afterwards.
      moved: which of them the action moves, shape (N,).
      possible: whether it can be executed as predicted.
    """

    scene: Superquadrics
    moved: jax.Array
    possible: jax.Array


class Ways(flax.struct.PyTreeNode):
    """The ways in which one kind of action can move each object of a scene, and what stands in the way.

    Attributes:
      T_world_gripper: where the gripper goes, shape (N, V, 4, 4).
      weight: sampling weight of each beside the others of its object, shape (N, V); 0 where it is not worth a look.
      reached: whether arm, hand and shelf allow it, by distance, shape (N, V, D).
      hits: which objects are run into, shape (N, V, N).
      enters: whether gripper or object would enter space where the target may be, by distance, shape (N, V, D).
    """

    T_world_gripper: jax.Array
    weight: jax.Array
    reached: jax.Array
    hits: jax.Array
    enters: jax.Array
