"""The protocol of push models, implemented in `quasi_static`, `learned` and, by simulation, `envs.pushing`."""

from __future__ import annotations

from typing import Protocol

import jax
from jaxtyping import Array

from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.workspace.shelf import Shelf

# Largest height of a push's contact, in half widths of the object along the push, for boxes and for round objects.
# Higher up, friction at the board (0.4 and 0.6) topples them. A contact below `LOW_CONTACT` [m] never does.
LEVERAGE = (1.8, 1.5)
LOW_CONTACT = 0.03


class PushOutcome(PyTreeNode):
    """The predicted outcome of a push.

    Attributes:
      scene: the objects afterwards.
      moved: which of them the push moved; the others are exactly where they were, shape (N,).
      residual: deepest remaining penetration [m]: of the hand at its goal, of walls, or of objects with one another.
        Not finite if the model failed.
      resolved: whether the residual is within the model's accuracy (`QuasiStatic.max_penetration`,
        `LearnedPush.max_penetration`).
      topples: probability that an object falls over, shape (N,).
    """

    scene: Superquadrics
    moved: jax.Array
    residual: jax.Array
    resolved: jax.Array
    topples: jax.Array


class PushModel(Protocol):
    """Predicts a push; interchangeable (docs/method.md, "Pushes")."""

    def __call__(
        self, shelf: Shelf, scene: Superquadrics, pusher: Array, T_world_gripper: Array, displacement: Array, q7: Array
    ) -> PushOutcome:
        """Predict a push; a push of zero length changes nothing.

        Args:
          shelf: walls; may be traced.
          scene: objects before the push, fields (N, ...).
          pusher: surface of the closed gripper in its own frame, shape (P, 3) [m].
          T_world_gripper: first pose, shape (4, 4).
          displacement: of the gripper, shape (3,) [m].
          q7: angle of joint 7, which decides the arm's configuration [rad]; models without an arm ignore it.
        """
        ...
