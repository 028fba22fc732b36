"""Taking the found target out of the shelf: the end of a search."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mechsearch_jax.actions.kind import Kind, Sketch
from mechsearch_jax.actions.types import Action, Prediction
from mechsearch_jax.robot.motion import MotionConfig, Reference, retrieve_reference

CODE = 3
# Length of the way out that a picture shows [m].
SHOWN_WAY_OUT = 0.5


def retrieve_action(
    T_world_gripper: Float[Array, "*batch 4 4"],
    q7: Float[Array, "*batch"],
    opening: Float[Array, "*batch"],
) -> Action:
    """The action that takes the target out; any leading axes.

    Args:
      T_world_gripper: gripper pose where the grasp closes.
      q7: angle of joint 7 [rad].
      opening: distance between the fingers on the approach [m].
    """
    return Action(
        kind=jnp.full(q7.shape, CODE, jnp.int32),
        object=jnp.zeros(q7.shape, jnp.int32),
        T_world_gripper=T_world_gripper,
        displacement=jnp.zeros((*q7.shape, 3)),
        T_world_place=T_world_gripper,
        q7=q7,
        opening=opening,
    )


@dataclasses.dataclass(frozen=True)
class Retrieve(Kind):
    """Taking the target out; `retrieval` chooses the grasp."""

    code: int = CODE
    name: str = "retrieve"
    takes_target: bool = True

    def predict(self, space, push_model, scene, untouchable, action, wrist) -> Prediction:
        """A retrieval that hits nothing leaves all objects where they are."""
        return Prediction(scene, jnp.zeros_like(scene.valid), jnp.array(True))

    def reference(self, action: Action, config: MotionConfig) -> tuple[Reference, Bool[Array, ""]]:
        """See `motion.retrieve_reference`."""
        return retrieve_reference(action.T_world_gripper, action.q7, action.opening, config)

    def sketch(self, scene, after, action: Action) -> Sketch:
        """The hand at the target, and the way out, drawn horizontally so that its direction shows in every view."""
        T = np.asarray(action.T_world_gripper, float)
        level = np.array([T[0, 2], T[1, 2], 0.0])
        way = -SHOWN_WAY_OUT * level / max(float(np.linalg.norm(level)), 1e-9)
        share = np.linspace(0.0, 1.0, 40)[:, None]
        return Sketch(T[None], float(action.opening), path=T[:3, 3] + share * way, takes_target=True)

    def describe(self, action: Action, target: int | None = None) -> str:
        return "take the target out"
