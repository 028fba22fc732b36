"""The numbers of objects: a planner's are of what it recognised, those of records and pictures are of bodies."""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Int

from mechsearch_jax.actions import Action
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner import Decision
from mechsearch_jax.planner.trials import TriedActions

# The number of the body that each recognised object stands for.
Bodies = Int[np.ndarray, " objects"]


def named_action(action: Action, bodies: Bodies) -> Action:
    """An action, or many, with objects named by bodies' numbers; the target, and no object, keep theirs."""
    if _are_same(bodies):
        return action
    index = np.asarray(action.object)
    inside = (index >= 0) & (index < len(bodies))
    return action.replace(object=np.where(inside, bodies[np.where(inside, index, 0)], index).astype(index.dtype))


def named_tried(tried: TriedActions, bodies: Bodies) -> TriedActions:
    """What was tried out, with objects named by bodies' numbers."""
    return tried._replace(action=named_action(tried.action, bodies))


def named_objects(objects: Superquadrics, bodies: Bodies, axis: int = 0) -> Superquadrics:
    """Objects in the slots of the bodies that they stand for; `axis` is that of the objects."""
    if _are_same(bodies):
        return objects
    return jax.tree.map(lambda a: np.take(np.asarray(a), np.argsort(bodies), axis=axis), objects)


def named_observation(observation: Observation, bodies: Bodies) -> Observation:
    """An observation with its objects in the slots of the bodies that they stand for."""
    if _are_same(bodies):
        return observation
    confidence = observation.confidence
    return observation.replace(
        objects=named_objects(observation.objects, bodies),
        confidence=None if confidence is None else np.asarray(confidence)[np.argsort(bodies)],
    )


def named_decision(decision: Decision, bodies: Bodies) -> Decision:
    """A decision, without its alternatives, that names objects by bodies' numbers."""
    if _are_same(bodies):
        return decision
    sequences = decision.sequences
    return decision.replace(
        action=named_action(decision.action, bodies),
        predicted=named_objects(decision.predicted, bodies),
        sequences=sequences.replace(
            actions=named_action(sequences.actions, bodies), after=named_objects(sequences.after, bodies, axis=1)
        ),
        alternatives=None,
    )


def _are_same(bodies: Bodies) -> bool:
    """Whether objects have the bodies' numbers."""
    return np.array_equal(bodies, np.arange(len(bodies)))
