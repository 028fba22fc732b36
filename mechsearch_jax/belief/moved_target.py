"""A found target that was pushed, in prediction: the candidate pose that stands for where it is then.

An approximation: g is that of the candidate's grasps, which are a tenth of those that a found target has and are looked
at less closely (not along x, and not with links 2 to 5), at a place that is half a cell away at most. Once the push has
happened, the dense set at the pose that is seen decides.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.problem.problem import Problem

# How far beyond the outermost candidate poses a target may be pushed, in cells of their grid.
BEYOND = 1.0


def nearest_candidate(poses: Float[Array, "x 3"], pose: Float[Array, " 3"]) -> Int[Array, ""]:
    """Index of the candidate pose that is nearest to a pose, both as x, y [m] and yaw [rad], which repeats after half a
    turn.

    Args:
      poses: all positions with all yaws, so that the nearest of both is among them.
      pose: of the target.
    """
    away = jnp.sum((poses[:, :2] - pose[None, :2]) ** 2, axis=1)
    # Any weight that rounding does not swallow finds the same one, since positions and yaws make a grid.
    return jnp.argmin(away + 1e-3 * jnp.sin(poses[:, 2] - pose[2]) ** 2)


def candidate_of(problem: Problem, scene: Superquadrics, is_target: Bool[Array, " n"]) -> Bool[Array, " x"]:
    """The candidate pose that is nearest to where the target is in a scene, as a mask of all of them.

    Args:
      problem: what does not change.
      scene: the objects and the target.
      is_target: which of them is the target.
    """
    slot = jnp.argmax(is_target)
    position, rotation = scene.position[slot], scene.rotation[slot]
    pose = jnp.stack([position[0], position[1], jnp.arctan2(rotation[1, 0], rotation[0, 0])])
    return jnp.arange(problem.poses.shape[0]) == nearest_candidate(problem.poses, pose)


def beyond_candidates(problem: Problem, position: Float[Array, "n 3"]) -> Bool[Array, " n"]:
    """Which positions are more than `BEYOND` cells outside of what the candidate poses cover: nothing tells g there."""
    places, beyond = problem.poses[:, :2], BEYOND * problem.cell
    low, high = jnp.min(places, axis=0) - beyond, jnp.max(places, axis=0) + beyond
    return jnp.any((position[:, :2] < low[None]) | (position[:, :2] > high[None]), axis=-1)
