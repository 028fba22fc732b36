"""The belief about the target: where it can still be, or where it was found (equation 4)."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from mechsearch_jax.actions.registry import ActionKind
from mechsearch_jax.actions.types import Action
from mechsearch_jax.actions.unseen_space import BORDER, PossibleSpace, bordered, enters_unmeasured, widen
from mechsearch_jax.belief.unmeasured import unmeasured_heights
from mechsearch_jax.belief.unseen_motion import moved_by, reopened, sweeps
from mechsearch_jax.existence import allowances, closer_image, free, object_views, plainly_elsewhere, undetected
from mechsearch_jax.geometry.bodies import with_parts
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import upright_pose
from mechsearch_jax.grasping.graspability import grasp_hits, graspability, pairs
from mechsearch_jax.grasping.retrieval import FoundGrasps, found_grasps, no_grasps
from mechsearch_jax.images.measured import sampled
from mechsearch_jax.observation import Observation
from mechsearch_jax.problem.problem import Problem
from mechsearch_jax.runtime.compiled import cached_jit
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.workspace.render import merge_windows
from mechsearch_jax.workspace.target_view import body_at, main_body


class Belief(PyTreeNode):
    """The belief about the target.

    Attributes:
      exists: f_t, shape (X,). It grows only where an action may have moved the target: see `update_belief`.
      found: c_t, whether the target has been seen and may still be where it was seen last.
      found_pose: that pose as x, y [m], yaw [rad].
      measured: share of each pixel of f's coarse image that was measured in the last image, shape (h, w).
      unmeasured: height up to which each cell of the board may be filled by a thing without depth [m], see
        `unmeasured.unmeasured_heights`; -inf where it was seen that nothing is.
      allowed: how many coarse pixels the target may show at each place of its candidate poses while it is hidden, shape
        (X, S); see `existence.allowances`.
      grasps: the grasps of the found target that arm and shelf allow.
      restarts: how often f became empty, and hidden or unmeasured space was opened again.
    """

    exists: jax.Array
    found: jax.Array
    found_pose: jax.Array
    measured: jax.Array
    unmeasured: jax.Array
    allowed: jax.Array
    grasps: FoundGrasps
    restarts: jax.Array


@cached_jit()
def initial_belief(problem: Problem) -> Belief:
    """The belief before the first observation: the target can be at every candidate pose."""
    config = problem.config.existence
    allowed, coarse = config.allowed(problem.camera), problem.camera.scaled(config.step(problem.camera))
    return Belief(
        exists=jnp.ones(problem.poses.shape[0], bool),
        found=jnp.array(False),
        found_pose=jnp.zeros(3),
        measured=jnp.ones((coarse.height, coarse.width)),
        unmeasured=jnp.full([size + 2 * BORDER for size in problem.target.grid], jnp.inf),
        allowed=jnp.full(problem.existence.corner.shape[:2], allowed, jnp.int32),
        grasps=no_grasps(problem.target_grasps),
        restarts=jnp.int32(0),
    )


@cached_jit()
def update_belief(
    problem: Problem,
    belief: Belief,
    observation: Observation,
    before: Observation | None = None,
    action: Action | None = None,
) -> Belief:
    """The belief after an observation: `f_t = f_{t-1} * f_hat(s_t)` (equation 4), and the target's pose if it is seen.

    A found target that is hidden again stays found at the pose where it was seen last. If it would be in plain sight
    there but is not seen, or an object stands there now, it was moved or was a false detection: it is not found any
    more, and f is reset to what the present objects allow. One observation suffices for this, so that a detector that
    misses the target once, or a sensor that measures less than a third of it, costs one decision.

    What was not measured (`Observation.measured`) shows nothing: f stays as it was there, and something without depth
    may stand there (`Belief.unmeasured`), unless it was seen to be free and nothing was done since.

    If the action may have moved a hidden target, f is first reopened (`unseen_motion.reopened`). If f becomes empty
    nevertheless, which is a contradiction, space that is hidden or not measured is opened again, and `restarts` counts
    it: where the present objects allow the target, else where they hide it though their shapes reach into it. If there
    is no such space, f stays empty: the target is probably not in the shelf.

    Args:
      problem: the constants.
      belief: before the observation.
      observation: the present one.
      before: the observation before the action; None, as `action`, if nothing was done since `belief`.
      action: executed or attempted since then.

    Raises:
      InputError: one of the last two is given without the other.
    """
    if (before is None) != (action is None):
        raise InputError("update_belief: give what was seen before the action and the action, or neither")
    everywhere = jnp.ones_like(belief.exists)
    observation = observation.with_boxes()
    settings, visible = problem.config.existence, jnp.asarray(observation.target_visible)
    tables, camera, target, objects = problem.existence, problem.camera, problem.target, observation.objects
    views = object_views(tables, camera, objects, everywhere, settings)
    step, closer_step, share = settings.step(camera), settings.closer_step(camera), observation.measured
    measured = None if share is None else sampled(camera, share, step)
    closer_measured = None if share is None else sampled(camera, share, closer_step)
    closer = closer_image(camera, objects, views, settings, closer_measured)
    allowed = allowances(tables, camera, target, views, closer, settings, measured)
    unseen = undetected(tables, camera, views, everywhere, allowed, settings, measured)
    now = jnp.any(unseen & free(views, everywhere), axis=-1)
    T_last = upright_pose(belief.found_pose, target.height(problem.shelf))
    lost = belief.found & ~visible & plainly_elsewhere(tables, camera, target, objects, closer, T_last, settings)
    # A lost target may be at any candidate pose: f was not updated while it counted as found.
    prior = belief.exists | lost
    exists = prior
    if before is not None and action is not None and not settings.as_in_paper:
        exists |= reopened(problem, exists, before.with_boxes().objects, objects, action)
    both = exists & now
    found = (belief.found & ~lost) | visible
    contradiction = ~jnp.any(both) & ~found
    exists = jnp.where(contradiction, jnp.where(jnp.any(now), now, jnp.any(unseen, axis=-1)), both)
    if measured is None:
        unmeasured = jnp.full_like(belief.unmeasured, -jnp.inf)
    else:
        unmeasured = unmeasured_heights(problem, measured, merge_windows(camera.scaled(step), views.windows))
        # What was free at the last look is free, unless something was done since.
        acted = jnp.array(False) if action is None else action.kind != ActionKind.NONE
        unmeasured = jnp.where(acted, unmeasured, jnp.minimum(unmeasured, belief.unmeasured))
    pose = jnp.where(visible, observation.target_pose, belief.found_pose)
    T_world_target = problem.target_grasps.standing(pose)
    return Belief(
        exists=jnp.where(found, belief.exists, exists),
        found=found,
        found_pose=pose,
        measured=jnp.ones_like(belief.measured) if measured is None else measured,
        unmeasured=unmeasured,
        allowed=allowed,
        grasps=found_grasps(problem.target_grasps, T_world_target, found),
        restarts=belief.restarts + contradiction,
    )


def without_grasps(belief: Belief) -> Belief:
    """The belief without grasps of the found target, for programs that are traced for a target that is not found.

    They would be masked out; without them, nothing is computed for them.
    """
    feasible, q = belief.grasps.feasible, belief.grasps.q
    # Of NumPy, since outside of `jit` to cut arrays of JAX takes a program each.
    none = np.zeros((*feasible.shape[:-1], 0), bool), np.zeros((*q.shape[:-3], 0, *q.shape[-2:]), q.dtype)
    return belief.replace(grasps=belief.grasps.replace(feasible=none[0], q=none[1]))


def without_candidates(problem: Problem, belief: Belief) -> tuple[Problem, Belief]:
    """Problem and belief without candidate poses (X = 0), for programs that are traced for a target that is found and
    stays where it is.

    f is 0 at all of them then, and g counts at the found pose alone: without them, nothing is computed for them.
    """
    return problem_without_candidates(problem), _none(belief, "exists", "allowed")


def problem_without_candidates(problem: Problem) -> Problem:
    """A problem without what has a row for each candidate pose, other than the poses themselves."""
    existence = _none(problem.existence, "T_world_target", "depth", "corner", "middle", "nearest")
    grasps = _none(problem.grasps, "T_world_target", "pair_pose", "pair_grasp", "pair_valid", "pose_pairs")
    return problem.replace(existence=existence, grasps=grasps)


def _none(table: Any, *names: str) -> Any:
    """A table without the rows of some of its arrays."""
    rows = ((name, getattr(table, name)) for name in names)
    return table.replace(**{name: np.zeros((0, *array.shape[1:]), array.dtype) for name, array in rows})


def possible_poses(
    belief: Belief, exists: Bool[Array, " x"], target_at: Bool[Array, " x"] | None = None
) -> Bool[Array, " y"]:
    """f at the candidate poses and at the found pose (Y = X + 1): one or the other.

    Args:
      belief: at the root of the search.
      exists: f of the state.
      target_at: the candidate pose nearest to where a found target was pushed; none if left out.
    """
    if target_at is None:
        target_at = jnp.zeros_like(exists)
    here = belief.found & ~jnp.any(target_at)
    return jnp.concatenate([jnp.where(belief.found, target_at, exists), here[None]])


def possible_space(problem: Problem, belief: Belief, exists: Bool[Array, " x"]) -> PossibleSpace:
    """Raster of the space that what was not seen may take; once the target is found, it is an ordinary obstacle."""
    if exists.shape[-1] == 0:
        # See `without_candidates`. No constant: XLA would compute with that as it compiles.
        grid = jnp.broadcast_to(jnp.int32(~belief.found), problem.target.grid)
    else:
        grid = jnp.sum(exists.reshape(*problem.target.grid, -1), axis=-1) * ~belief.found
    top = problem.shelf.board + problem.target.tall
    return PossibleSpace(
        target=jnp.where(bordered(widen(grid > 0)), top, -jnp.inf),
        unmeasured=belief.unmeasured,
        chance=grid / jnp.maximum(jnp.sum(grid), 1),
        origin=problem.poses[0, :2] - BORDER * problem.cell,
        cell=problem.cell,
    )


@cached_jit()
def sweeps_unmeasured(problem: Problem, belief: Belief, objects: Superquadrics, action: Action) -> Bool[Array, ""]:
    """Whether the hand, or the object that it moves, sweeps space in which something may stand that has no depth.

    Of the objects that a pushed one pushes nothing is asked: an approximation.

    Args:
      problem, belief: constants of the search, and the belief after the last look.
      objects: the recognised objects, fields (N, ...).
      action: a single action.
    """
    space = possible_space(problem, belief, belief.exists)
    after = moved_by(objects, action)
    entered = [
        jnp.any(sweep.counts & enters_unmeasured(space, sweep.points))
        for sweep in sweeps(problem, objects, after, action)
    ]
    return jnp.any(jnp.stack(entered)) & (action.kind != ActionKind.NONE)


def with_target(problem: Problem, belief: Belief, objects: Superquadrics) -> tuple[Superquadrics, Bool[Array, " n"]]:
    """The objects and, in one more slot, the target, which is absent until found; and which slot is the target's.

    The target can be pushed like any object, but does not hide itself and does not obstruct its own grasp. Among
    objects without parts a compound is its largest part alone: an approximation, which only trials in physics make up
    for. A program of bodies of four parts is twice as large.
    """
    T = belief.grasps.T_world_target
    if objects.parts is None:
        target = main_body(problem.target, T[:3, 3], T[:3, :3], belief.found)
    else:
        target = with_parts(body_at(problem.target, T[:3, 3], T[:3, :3], belief.found), objects.parts.capacity)
    everything = jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), objects, target)
    return everything, jnp.arange(everything.capacity) == objects.capacity


@cached_jit()
def graspability_map(problem: Problem, belief: Belief, objects: Superquadrics) -> Int[Array, " x"]:
    """g at every candidate pose, also where f is 0: 1, 0, -1, ... (section B.4), shape (X,)."""
    everywhere = jnp.ones(problem.poses.shape[0], bool)
    return graspability(pairs(problem.grasps), grasp_hits(problem.grasps, objects, everywhere))
