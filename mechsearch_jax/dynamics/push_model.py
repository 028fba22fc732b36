"""What predicts a push: the protocol that is kept by `quasi_static`, by `learned` and, in simulation, by `envs`."""

from __future__ import annotations

from typing import Protocol

import flax.struct
import jax
from jaxtyping import Array

from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.workspace.shelf import Shelf

# Largest height at which a push may begin to touch, in half widths of the object along it, for boxes and for round
# objects. Higher up, friction at the board (0.4 and 0.6) topples them instead of letting them slide; but a push at the
# very bottom never does.
LEVERAGE = (1.8, 1.5)
LOW_CONTACT = 0.03


class PushOutcome(flax.struct.PyTreeNode):
    """What a push is predicted to do.

    Attributes:
      scene: the objects afterwards.
      moved: which of them the push moved; the others are exactly where they were, shape (N,).
      residual: deepest penetration that is left at the end [m]: with the hand where it was sent, of what is jammed
        against a wall, or of objects with one another. Not finite where the model failed.
      resolved: whether the push comes to an end as predicted: no more is left than the model is off by anyway, which
        each model knows of itself (`QuasiStatic.max_penetration`, `LearnedPush.max_penetration`).
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
        """Predict a push; one of no length changes nothing.

        Args:
          shelf: walls; may be traced.
          scene: objects before the push, fields (N, ...).
          pusher: surface of the closed gripper in its own frame, shape (P, 3) [m].
          T_world_gripper: where the push starts, shape (4, 4).
          displacement: how the gripper moves, shape (3,) [m].
          q7: angle of joint 7, which tells the arm's configuration [rad]; models that only know the gripper ignore it.
        """
        ...
