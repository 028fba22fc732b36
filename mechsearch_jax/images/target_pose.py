"""The pose of a target of known shape from its visible points, and what the pixels of an image say for and against it,
upright or not.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mechsearch_jax.geometry.transforms import exponential, matmul, yaw_rotation
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.shapes.solid import Solid
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

ITERATIONS = 12
# Residuals beyond this have linear cost (Huber): mixed pixels at edges, and points of other objects [m].
OUTLIER = 0.003
# Damping of a step, relative to the normal equations' diagonal, and the longest step [m, m, rad].
DAMPING = 1e-3
LONGEST_STEP = (0.01, 0.01, 0.3)
# Points within so many standard deviations of the depth's noise of the target's surface are on it, but not nearer or
# farther than these distances [m].
DEVIATIONS, LEAST_TOLERANCE, LARGEST_TOLERANCE = 4.0, 0.003, 0.008
# So far apart are pixels whose noise is compared, in pixels of a view: 1.5 cm on a surface seen face on.
APART = 6
# Least number of these that noise is measured by.
LEAST_APART = 30
# Points of the target's colour up to this far from its surface belong to a larger thing, if they are not on it [m].
BEYOND = 0.03
# The target's outline is known to this distance, for its pose is not exact [m].
OUTLINE = 0.003
# How far the target may seem to be inside of a face of the shelf [m].
INTO_SHELF = 0.01
# Where the axis of an upright target may be from the middle of its visible part, across the view and away from the
# camera, in radii: in the middle of it, or to a side where the rest is hidden.
STARTS = ((0.0, 0.65), (-0.8, 0.5), (0.8, 0.5))
# Longest step of a pose with all its degrees of freedom: position [m] and rotation vector [rad].
LONGEST_FREE_STEP = (LONGEST_STEP[0],) * 3 + (LONGEST_STEP[2],) * 3


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


class Placement(PyTreeNode):
    """A pose of the target in the world: `R_world_target`, shape (..., 3, 3), and its centre [m], shape (..., 3)."""

    rotation: jax.Array
    centre: jax.Array


class SampledPixels(PyTreeNode):
    """N pixels of an image.

    Attributes:
      rays: directions in the world, scaled to unit depth, shape (N, 3).
      points: in the world [m], shape (N, 3); NaN where nothing was measured.
      depth: of the points [m], shape (N,); infinite where there is nothing.
      coloured: whether they have the target's colour, shape (N,).
      tolerance: distance from a surface within which points are on it [m], shape (N,).
    """

    rays: jax.Array
    points: jax.Array
    depth: jax.Array
    coloured: jax.Array
    tolerance: jax.Array


class Evidence(PyTreeNode):
    """The numbers of pixels that speak for and against a placement."""

    support: jax.Array
    contrary: jax.Array

    @property
    def share(self) -> Array:
        """The share of support, 0 without any."""
        return self.support / jnp.maximum(self.support + self.contrary, 1)


def upright(target: Target, shelf: Shelf, pose: Float[Array, " 3"]) -> Placement:
    """The placement of a target that stands on the board at x, y [m] and yaw [rad]."""
    return Placement(yaw_rotation(pose[2]), jnp.stack([pose[0], pose[1], jnp.asarray(target.height(shelf))]))


def away_from(target: Target, placement: Placement, points: Float[Array, "n 3"]) -> Float[Array, " n"]:
    """Signed distance [m] of world points to the surface of the target; NaN for NaN."""
    body = matmul(points - placement.centre[None], placement.rotation)
    return target.solid.distance(body[:, :2], body[:, 2], jnp)


def evidence(target: Target, placement: Placement, origin: Float[Array, " 3"], sample: SampledPixels) -> Evidence:
    """What pixels say for and against a placement.

    For it are pixels of the target's colour on its surface. Against it are pixels in its outline that show something
    behind it, or something of its colour before it, and pixels of its colour next to it that are not on its surface or
    outside of its outline, for then it is a part of something larger. What is hidden by things of other colours counts
    for nothing.

    Args:
      target: whose shape and size are known; static.
      placement: of the target.
      origin: the camera's position in the world [m].
      sample: of the image.
    """
    away = jnp.abs(away_from(target, placement, sample.points))
    start, along = (matmul(a, placement.rotation) for a in ((origin - placement.centre)[None], sample.rays))
    start, along = ([a[..., i] for i in range(3)] for a in (start, along))
    surface = target.solid.cut(start, along, -OUTLINE, jnp)
    outline = target.solid.cut(start, along, OUTLINE, jnp)
    on_it, inside = away < sample.tolerance, jnp.isfinite(surface)
    through = inside & ~on_it & (sample.depth > surface + sample.tolerance)
    before = inside & ~on_it & (sample.depth < surface)
    like_it = sample.coloured & on_it & jnp.isfinite(outline)
    larger = sample.coloured & ~like_it & (before | (away < BEYOND))
    return Evidence(jnp.sum(like_it), jnp.sum(through | larger))


def within_shelf(target: Target, placement: Placement, shelf: Shelf) -> Bool[Array, ""]:
    """Whether a target is inside of the shelf, or open before it, but for `INTO_SHELF`."""
    against, along = target.solid.extent(placement.rotation, jnp)
    low, high = placement.centre - against, placement.centre + along
    walls = shelf.walls
    faces = (low[2] - shelf.board, low[1] - walls.right, walls.left - high[1], walls.back - high[0])
    return jnp.all(jnp.stack([jnp.asarray(face) for face in faces]) > -INTO_SHELF)


def depth_tolerance(depth: Float[Array, "h w"], chosen: Bool[Array, "h w"]) -> Float[Array, ""]:
    """Distance from a surface within which points are on it [m], by the depth's noise in the chosen pixels.

    The noise is the median size of the second differences along rows, which surfaces hardly have, or of those of the
    inverse depth of pixels `APART` along columns, where that is larger. Noise that neighbours share shows only in the
    latter, which planes and upright surfaces do not have; where the chosen pixels are too low, it is the image's.
    """
    # Half of all normal numbers of deviation 1 are below 0.6745; second differences have 6 times the variance.
    usual = 0.6745 * math.sqrt(6.0)
    second = depth[:, 2:] - 2.0 * depth[:, 1:-1] + depth[:, :-2]
    own = _median_size(jnp.where(chosen[:, 1:-1], second, jnp.nan)) / usual
    inverse = 1.0 / jnp.where(jnp.isfinite(depth), depth, jnp.nan)
    there = _apart(jnp.where(chosen, inverse, jnp.nan))
    few = jnp.sum(jnp.isfinite(there)) < LEAST_APART
    mean = jnp.nanmean(jnp.where(chosen, inverse, jnp.nan))
    shared = _median_size(jnp.where(few, _apart(inverse), there)) / mean**2 / usual
    tolerance = jnp.clip(DEVIATIONS * jnp.fmax(own, shared), LEAST_TOLERANCE, LARGEST_TOLERANCE)
    return jnp.where(jnp.isnan(tolerance), LARGEST_TOLERANCE, tolerance)


def _apart(values: Float[Array, "h w"]) -> Float[Array, "h w"]:
    """Second differences along columns, NaN where the image ends."""
    padded = jnp.pad(values, ((APART, APART), (0, 0)), constant_values=math.nan)
    return padded[2 * APART :] - 2.0 * values + padded[: -2 * APART]


def _median_size(values: Float[Array, "h w"]) -> Float[Array, ""]:
    """Of the finite ones; NaN if there are none."""
    return jnp.nanmedian(jnp.where(jnp.isfinite(values), jnp.abs(values), jnp.nan))


def upright_placements(
    target: Target, shelf: Shelf, origin: Float[Array, " 3"], points: Float[Array, "p 3"], valid: Bool[Array, " p"]
) -> Placement:
    """Placements of an upright target that fit points on its visible side, with a leading axis.

    Args:
      target: static.
      shelf: on which it stands.
      origin: the camera's position in the world [m].
      points: in the world [m].
      valid: which of them are to be on the target's surface.
    """
    weight, points, middle, outwards = _visible_side(origin, points, valid)
    level = jnp.stack([jnp.stack([-outwards[1], outwards[0]]), outwards[:2]])
    xy = middle[None, :2] + target.solid.breadth * matmul(jnp.array(STARTS), level)
    yaws = start_yaws(target, 4)
    starts = jnp.concatenate([jnp.repeat(xy, len(yaws), axis=0), jnp.tile(yaws, len(STARTS))[:, None]], axis=1)
    residuals = lambda pose: distance(target, shelf, pose, points)  # noqa: E731
    poses, _ = jax.vmap(lambda start: descend(residuals, weight, start))(starts)
    return jax.vmap(lambda pose: upright(target, shelf, pose))(poses)


def tilted_placements(
    target: Target, origin: Float[Array, " 3"], points: Float[Array, "p 3"], valid: Bool[Array, " p"]
) -> Placement:
    """Placements of a target that leans or lies, and fits points on its visible side, with a leading axis.

    Args:
      target: static.
      origin: the camera's position in the world [m].
      points: in the world [m].
      valid: which of them are to be on the target's surface.
    """
    weight, points, middle, outwards = _visible_side(origin, points, valid)
    rotations = jnp.asarray(_tilted(target.solid), jnp.float32)
    centre = middle + 0.65 * min(target.half_size) * outwards

    def placed(step: Array, rotation: Array) -> Placement:
        return Placement(matmul(exponential(step[3:]), rotation), centre + step[:3])

    def fit(rotation: Array) -> Placement:
        residuals = lambda step: away_from(target, placed(step, rotation), points)  # noqa: E731
        return placed(descend(residuals, weight, jnp.zeros(6), LONGEST_FREE_STEP)[0], rotation)

    return jax.vmap(fit)(rotations)


def _visible_side(
    origin: Float[Array, " 3"], points: Float[Array, "p 3"], valid: Bool[Array, " p"]
) -> tuple[Array, ...]:
    """Weights of points, finite points, their mean, and the level direction away from the camera."""
    weight = valid.astype(jnp.float32)
    points = jnp.where(valid[:, None], points, 0.0)
    middle = jnp.sum(points, axis=0) / jnp.maximum(jnp.sum(weight), 1.0)
    level = (middle - origin) * jnp.array([1.0, 1.0, 0.0])
    return weight, points, middle, level / jnp.maximum(jnp.sqrt(jnp.sum(level**2) + 1e-12), 1e-6)


def _tilted(solid: Solid) -> Float[np.ndarray, "starts 3 3"]:
    """Rotations to start from: upright, and lying on the side, on either side if it has two: at four angles, or at
    eight if its ends differ."""
    x, y, z = np.eye(3)
    laid: list[Any] = [np.stack([y, z, x])] if solid.round else [np.stack([y, z, x]), np.stack([z, x, y])]
    turns = [
        np.array([[math.cos(a), -math.sin(a), 0.0], [math.sin(a), math.cos(a), 0.0], [0.0, 0.0, 1.0]])
        for a in np.arange(4 if solid.ends_alike else 8) * (math.pi / 4)
    ]
    standing = turns[:1] if solid.round else turns[:2] if solid.turn <= math.pi else turns[::2]
    return np.stack([*standing, *(turn @ rotation for rotation in laid for turn in turns)])
