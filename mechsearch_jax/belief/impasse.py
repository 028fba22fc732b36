"""The explanation for a person why a decision has no action, or one that no gain is expected of."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.actions.candidates import all_candidates, free_candidates
from mechsearch_jax.actions.stacks import stacks
from mechsearch_jax.belief.belief import Belief, possible_space, with_target
from mechsearch_jax.existence import object_views, occluders
from mechsearch_jax.geometry.footprints import footprints
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import compose
from mechsearch_jax.grasping.retrieval import found_hits
from mechsearch_jax.problem.problem import Problem
from mechsearch_jax.robot.kinematics import path_kinematics

# A target that is in the shelf in nine of ten searches is probably not there once it could be at less than this share
# of all poses.
PROBABLY_ABSENT = 0.1


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


@jax.jit
def _hides(problem: Problem, belief: Belief, objects: Superquadrics) -> Int[Array, " n"]:
    """At how many of the poses where the target can be each object hides it; see `existence.occluders`."""
    views = object_views(problem.existence, problem.camera, objects, None, problem.config.existence)
    return jnp.sum(occluders(problem.existence, views) & belief.exists[:, None] & objects.valid[None], axis=0)


@jax.jit
def _obstructs(
    problem: Problem, belief: Belief, objects: Superquadrics
) -> tuple[Bool[Array, "f n"], Bool[Array, " f"]]:
    """Which objects each grasp of the found target hits, and which grasps the arm reaches at all."""
    grasps = problem.target_grasps
    T = compose(belief.grasps.T_world_target[None], grasps.tables.T_target_gripper)
    _, reached = path_kinematics(T[:, None], grasps.tables.q7, grasps.gripper.arm)
    return found_hits(grasps, belief.grasps, objects), reached


def hindrance(problem: Problem, belief: Belief, objects: Superquadrics) -> str:
    """What keeps the target from being seen, or from being taken out, in one line; empty if nothing does. Not for
    `jit`.

    Args:
      problem, belief: constants of the search, and the belief after the last look.
      objects: the recognised objects without the target, fields (N, ...).
    """
    if not bool(belief.found):
        exists = np.asarray(belief.exists)
        counts, share = np.asarray(_hides(problem, belief, objects)), float(exists.mean())
        most = np.argsort(-counts, kind="stable")[:2]
        behind = [f"object {i} hides it at {counts[i]} of them" for i in most if counts[i]]
        behind = behind or ["no recognised object hides it there, or that was not measured"]
        absent = ", so that it is probably not in this shelf" if share < PROBABLY_ABSENT else ""
        return (
            f"{' and '.join(behind)}; they are {100 * share:.1f}% of all poses, the others were seen without it{absent}"
        )
    hits, reached = (np.asarray(a) for a in _obstructs(problem, belief, objects))
    feasible = np.asarray(belief.grasps.feasible)
    if not feasible.any():
        tilts = np.degrees(np.arcsin(np.clip(-_approach(problem, belief)[:, 2], -1.0, 1.0)))
        out, total = int((~reached).sum()), len(reached)
        span = f"tilted down by {tilts.min():.0f} to {tilts.max():.0f} degrees" if total else "of which there are none"
        return (
            f"none of its {total} grasps, {span}, is possible there in an empty shelf: {out} are out of the arm's "
            f"reach, on the way of {total - out} arm or hand meets a wall or a board"
        )
    hits = hits[feasible]
    if not hits.any(axis=1).all():
        return ""
    alone, often = ((hits & (hits.sum(axis=1, keepdims=True) <= most)).sum(axis=0) for most in (1, hits.shape[1]))
    order = sorted(range(hits.shape[1]), key=lambda i: (-alone[i], -often[i]))
    names = [f"object {i} is in the way of {often[i]}, of {alone[i]} it alone" for i in order[:2] if often[i]]
    return f"each of its {len(hits)} possible grasps meets an object: {'; '.join(names)}"


def _approach(problem: Problem, belief: Belief) -> Float[np.ndarray, "f 3"]:
    """Directions in which the hand approaches a found target with each grasp, in the world."""
    T = compose(belief.grasps.T_world_target[None], problem.target_grasps.tables.T_target_gripper)
    return np.asarray(T)[:, :3, 2]
