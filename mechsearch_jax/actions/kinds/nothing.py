"""Doing nothing: the decision if no action is possible, or every action that was tried did harm."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np

from mechsearch_jax.actions.kind import Kind, Sketch
from mechsearch_jax.actions.types import Action, Prediction

CODE = 0


def no_action() -> Action:
    """The action that does nothing."""
    # Copies of the host's arrays: outside of `jit` each JAX operation is a program.
    return Action(
        kind=jnp.asarray(np.int32(CODE)),
        object=jnp.asarray(np.int32(0)),
        T_world_gripper=jnp.asarray(np.eye(4, dtype=np.float32)),
        displacement=jnp.asarray(np.zeros(3, np.float32)),
        T_world_place=jnp.asarray(np.eye(4, dtype=np.float32)),
        q7=jnp.asarray(np.float32(0.0)),
        opening=jnp.asarray(np.float32(0.0)),
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
