"""Doing nothing: the decision if no action is possible, or every action that was tried did harm."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from mechsearch_jax.actions.kind import Kind, Sketch
from mechsearch_jax.actions.types import Action, Prediction

CODE = 0


def no_action() -> Action:
    """The action that does nothing."""
    return Action(
        kind=jnp.int32(CODE),
        object=jnp.int32(0),
        T_world_gripper=jnp.eye(4),
        displacement=jnp.zeros(3),
        T_world_place=jnp.eye(4),
        q7=jnp.float32(0.0),
        opening=jnp.float32(0.0),
    )


@dataclasses.dataclass(frozen=True)
class Nothing(Kind):
    """Doing nothing."""

    code: int = CODE
    name: str = "none"

    def predict(self, space, push_model, scene, untouchable, action, wrist) -> Prediction:
        """Nothing changes; marked impossible, since it achieves nothing."""
        return Prediction(scene, jnp.zeros_like(scene.valid), jnp.array(False))

    def sketch(self, scene, after, action) -> Sketch:
        """Nothing to show."""
        return Sketch()

    def describe(self, action: Action, target: int | None = None) -> str:
        return "do nothing"
