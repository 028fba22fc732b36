"""The pose of a target of known shape from its visible points."""

from __future__ import annotations

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mechsearch_jax.geometry.transforms import yaw_rotation
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

ITERATIONS = 12
# Residuals beyond this have linear cost (Huber): mixed pixels at edges, and points of other objects [m].
OUTLIER = 0.003
# Damping of a step, relative to the normal equations' diagonal, and the longest step [m, m, rad].
DAMPING = 1e-3
LONGEST_STEP = (0.01, 0.01, 0.3)


def distance(target: Target, shelf: Shelf, pose: Float[Array, " 3"], points: Float[Array, "p 3"]) -> Float[Array, " p"]:
    """Signed distance [m] of world points to the surface of a target at a pose x, y [m] and yaw [rad]."""
    level = points[:, :2] - pose[None, :2]
    if not target.solid.round:
        R = yaw_rotation(pose[2])
        level = level[:, :1] * R[None, 0, :2] + level[:, 1:] * R[None, 1, :2]
    return target.solid.distance(level, points[:, 2] - target.height(shelf), jnp)


def start_yaws(target: Target, count: int) -> Float[Array, " n"]:
    """Yaws to begin fits with [rad]: `count` over half a turn, twice as many over a full one, one if it is round."""
    if target.solid.round:
        return jnp.zeros(1)
    return jnp.arange(round(count * target.turn / math.pi)) * (math.pi / count)


def _cost(residual, weight):
    size = jnp.abs(residual)
    return jnp.sum(weight * jnp.where(size < OUTLIER, 0.5 * size**2, OUTLIER * (size - 0.5 * OUTLIER)))


def descend(
    residuals: Callable[[Array], Array],
    weight: Float[Array, " p"],
    start: Float[Array, " n"],
    longest: tuple[float, ...] = LONGEST_STEP,
) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    """Robust damped Gauss-Newton from a start; a step is kept only if it lowers the cost.

    Args:
      residuals: of P points at a pose of N numbers [m].
      weight: of the points.
      start: the first pose.
      longest: step in each of its numbers.

    Returns:
      The last pose, and its cost.
    """

    def step(state, _):
        pose, cost, damping = state
        r, J = residuals(pose), jax.jacfwd(residuals)(pose)
        w = weight * jnp.minimum(1.0, OUTLIER / jnp.maximum(jnp.abs(r), 1e-9))
        JtJ = jnp.sum(w[:, None, None] * J[:, :, None] * J[:, None, :], axis=0)
        gradient = jnp.sum((w * r)[:, None] * J, axis=0)
        scale = jnp.diag(JtJ)
        # Directions that the points do not determine, such as the yaw of a round target, do not change.
        H = JtJ + jnp.diag(damping * scale + jnp.where(scale > 0, 1e-9, 1.0))
        move = jnp.clip(-jnp.linalg.solve(H, gradient), -jnp.array(longest), jnp.array(longest))
        trial = pose + move
        trial_cost = _cost(residuals(trial), weight)
        better = trial_cost < cost
        pose, cost = jnp.where(better, trial, pose), jnp.where(better, trial_cost, cost)
        return (pose, cost, damping * jnp.where(better, 0.3, 10.0)), None

    first = (start, _cost(residuals(start), weight), jnp.float32(DAMPING))
    (pose, cost, _), _ = jax.lax.scan(step, first, None, length=ITERATIONS)
    return pose, cost


def target_poses(
    target: Target,
    shelf: Shelf,
    camera_position: Float[Array, " 3"],
    points: Float[Array, "p 3"],
    valid: Bool[Array, " p"],
    sides: tuple[float, ...] = (0.0,),
) -> tuple[Float[Array, "n 3"], Float[Array, " n"]]:
    """Poses of an upright target that stands on the board, each fitted from a start of its own, and their costs.

    Robust least squares of the distance between points and surface. A flat face of which a narrow part is seen fits
    equally well anywhere along itself: there the poses differ, and only what else is seen can tell them apart.

    Args:
      target: static.
      shelf: on which it stands.
      camera_position: in the world [m].
      points: in the world [m], shape (P, 3).
      valid: which of them are the target's, shape (P,). If none are, the poses are meaningless, but finite.
      sides: where the starts are from the middle of the points, across the view, in radii; for each there is one of
        each of eight yaw angles, unless the target is round.
    """
    weight = valid.astype(jnp.float32)
    points = jnp.where(valid[:, None], points, 0.0)
    count = jnp.maximum(jnp.sum(weight), 1.0)
    centre = jnp.sum(points, axis=0)[:2] / count
    away = centre - camera_position[:2]
    away = away / jnp.maximum(jnp.sqrt(jnp.sum(away**2) + 1e-12), 1e-6)
    across = jnp.stack([-away[1], away[0]])
    # The visible side is nearer to the camera than the centre, by about two thirds of the radius on average.
    radius = target.solid.breadth
    xy = (centre + away * (0.65 * radius))[None] + radius * jnp.array(sides)[:, None] * across[None]
    yaws = start_yaws(target, 8)
    starts = jnp.concatenate([jnp.repeat(xy, len(yaws), axis=0), jnp.tile(yaws, len(sides))[:, None]], axis=1)
    residuals = lambda pose: distance(target, shelf, pose, points)  # noqa: E731
    poses, costs = jax.vmap(lambda start: descend(residuals, weight, start))(starts)
    turned = jnp.zeros_like(costs) if target.solid.round else jnp.mod(poses[:, 2], target.turn)
    return poses.at[:, 2].set(turned), costs
