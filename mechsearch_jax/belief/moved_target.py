"""Predicted pushes of a found target: its new pose is represented by the nearest candidate pose.

An approximation: g is that of the candidate's grasps, at most half a cell away. They are a tenth of a found target's
grasps and are checked less closely (not along x, and not for links 2 to 5). After the real push, the dense set of
grasps at the observed pose decides.
"""

from __future__ import annotations

import math

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import matmul, rotate
from mechsearch_jax.problem.problem import Problem
from mechsearch_jax.workspace.target_view import main_body

# How far beyond the outermost candidate poses a target may be pushed, in cells of their grid.
BEYOND = 1.0


def nearest_candidate(poses: Float[Array, "x 3"], pose: Float[Array, " 3"], turn: float = math.pi) -> Int[Array, ""]:
    """Index of the candidate nearest to a pose; poses are x, y [m] and yaw [rad], which repeats after a turn.

    Args:
      poses: a grid of positions and yaws.
      pose: of the target.
      turn: as `Target.turn` [rad]; static.
    """
    angle = poses[:, 2] - pose[2]
    if turn != math.pi:
        angle = angle * (math.pi / turn)
    distance2 = jnp.sum((poses[:, :2] - pose[None, :2]) ** 2, axis=1)
    # On a grid of positions and yaws the weight does not matter, as long as it survives rounding.
    return jnp.argmin(distance2 + 1e-3 * jnp.sin(angle) ** 2)


def candidate_of(problem: Problem, scene: Superquadrics, is_target: Bool[Array, " n"]) -> Bool[Array, " x"]:
    """Mask of the candidate pose nearest to the target of a scene; `is_target` marks the target's slot."""
    slot = jnp.argmax(is_target)
    position, rotation = scene.position[slot], scene.rotation[slot]
    if problem.target.is_compound and scene.parts is None:
        # The slot holds its largest part.
        part = main_body(problem.target, jnp.zeros(3), jnp.eye(3), jnp.array(True))
        rotation = matmul(rotation, part.rotation.T)
        position = position - rotate(rotation, part.position)
    pose = jnp.stack([position[0], position[1], jnp.arctan2(rotation[1, 0], rotation[0, 0])])
    return jnp.arange(problem.poses.shape[0]) == nearest_candidate(problem.poses, pose, problem.target.turn)


def beyond_candidates(problem: Problem, position: Float[Array, "n 3"]) -> Bool[Array, " n"]:
    """Which positions are more than `BEYOND` cells outside of the candidate poses, where g is not defined."""
    places, margin = problem.poses[:, :2], BEYOND * problem.cell
    low, high = jnp.min(places, axis=0) - margin, jnp.max(places, axis=0) + margin
    return jnp.any((position[:, :2] < low[None]) | (position[:, :2] > high[None]), axis=-1)
