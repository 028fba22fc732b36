"""Actions of the robot, candidate actions, and predicted effects."""

from __future__ import annotations

from typing import NamedTuple

import jax
from jaxtyping import Array, Bool, Int

from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.runtime.pytree import PyTreeNode


class Action(PyTreeNode):
    """One action of the robot; every field may carry leading batch axes.

    Attributes:
      kind: an `ActionKind`, int32.
      object: index of the pushed or picked object, int32; beside N objects, N stands for the found target. 0 for kinds
        that move none.
      T_world_gripper: gripper pose where a push starts or a grasp closes, shape (..., 4, 4).
      displacement: translation of the gripper while it pushes, in the world [m], shape (..., 3); zero for other kinds.
      T_world_place: gripper pose where the object is released or a push ends, shape (..., 4, 4).
      q7: angle of joint 7 during the whole motion [rad].
      opening: distance between the fingers during the approach [m]; 0 is closed.
    """

    kind: jax.Array
    object: jax.Array
    T_world_gripper: jax.Array
    displacement: jax.Array
    T_world_place: jax.Array
    q7: jax.Array
    opening: jax.Array


class Sample(PyTreeNode):
    """A sampled action.

    Attributes:
      action: the action; of kind NONE if none is possible.
      wrist: index of its wrist angle.
      grippers, bodies: poses of the gripper and of the object that may touch a hidden target, shape (PLACES, 4, 4);
        None for an action that touches nothing.
    """

    action: Action
    wrist: jax.Array
    grippers: jax.Array | None = None
    bodies: jax.Array | None = None


class DrawnCandidate(NamedTuple):
    """Index of a drawn candidate among those of one kind.

    Attributes:
      object: index of the object.
      number: index among the V x D candidates of the object.
      wanted: whether the draft is used; if not, it may hold anything.
    """

    object: Int[Array, ""]
    number: Int[Array, ""]
    wanted: Bool[Array, ""]


class Prediction(PyTreeNode):
    """Predicted effect of an action.

    Attributes:
      scene: the objects afterwards.
      moved: which objects the action moves, shape (N,).
      possible: whether it can be executed as predicted.
    """

    scene: Superquadrics
    moved: jax.Array
    possible: jax.Array


class Candidates(PyTreeNode):
    """Candidate actions of one kind for each object of a scene, among which one is drawn (paper B.5).

    Each of N objects has V gripper poses, each with D distances.

    Attributes:
      T_world_gripper: gripper pose where the push starts or the grasp closes, shape (N, V, 4, 4).
      weight: sampling weight among the candidates of the object, shape (N, V); 0 if implausible.
      reached: whether arm, hand and shelf allow the motion, shape (N, V, D).
      hits: which objects the gripper or the grasped object hits, shape (N, V, N).
      enters: whether gripper or object enters space where the target may be, shape (N, V, D).
    """

    T_world_gripper: jax.Array
    weight: jax.Array
    reached: jax.Array
    hits: jax.Array
    enters: jax.Array
