"""The explanation for a person why a decision has no action."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from mechsearch_jax.actions.candidates import all_candidates, free_candidates
from mechsearch_jax.actions.stacks import stacks
from mechsearch_jax.belief.belief import Belief, possible_space, with_target
from mechsearch_jax.geometry.footprints import footprints
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.problem.problem import Problem


@jax.jit
def _movable(
    problem: Problem, belief: Belief, objects: Superquadrics
) -> tuple[Bool[Array, " n"], Bool[Array, " n"], Bool[Array, "n n"]]:
    """Which objects the arm can reach inside the shelf, which it can reach without hitting another object, and which
    carry (rows) which (columns)."""
    scene, is_target = with_target(problem, belief, objects)
    possible = possible_space(problem, belief, belief.exists)
    candidates = all_candidates(problem.space, scene, possible)
    is_object = scene.valid & ~is_target
    reached, free = (
        jnp.any(jnp.stack([jnp.any(which(kind), axis=(1, 2)) for kind in candidates]), axis=0) & is_object
        for which in (lambda kind: kind.reached, free_candidates)
    )
    return reached, free, stacks(problem.space, footprints(scene)).carries


def _burdens(carries: Bool[np.ndarray, "n n"]) -> str:
    """What carries what, in words; the target is last."""
    names = [*(f"object {i}" for i in range(len(carries) - 1)), "the target"]
    return "".join(f"; {names[i]} carries {names[j]}" for i, j in np.argwhere(carries))


def impasse(problem: Problem, belief: Belief, objects: Superquadrics) -> str:
    """Why no action is possible, in one line; `objects` are those recognised, without the target. Not for `jit`."""
    if not bool(belief.found) and not bool(jnp.any(belief.exists)):
        return "every place where it could stand was seen without it; it is probably not in this shelf"
    count = int(jnp.sum(objects.valid))
    if count == 0:
        return "nothing that could be moved is recognised on the shelf"
    reached, free, carries = jax.device_get(_movable(problem, belief, objects))
    burdens, reached, free = _burdens(carries), int(reached.sum()), int(free.sum())
    what = "the only object" if count == 1 else f"any of the {count} objects"
    if reached == 0:
        return f"the arm does not reach {what}, neither to grasp nor to push; is the shelf where it should be?"
    if free == 0:
        return f"the arm reaches {reached} of {count} objects, but each way to grasp or push one meets another{burdens}"
    return (
        f"{free} of {count} objects could be moved, but every sampled action is predicted to fail: to jam, tip "
        f"an object, push one over the edge, or find no place for it{burdens}"
    )
