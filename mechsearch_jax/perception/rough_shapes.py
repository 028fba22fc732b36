"""Boxes and cylinders around the points of a segment, where the recognition network has never seen such a thing.

What is wider than what the network was trained on, lies, leans or stands on its edge is first guessed from its points
alone: what of it is hidden is not guessed, and so these shapes end where the points end.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import yaw_rotation

# Exponent of nearly sharp edges, as refinement fits them.
_SHARP = 0.03
# Headings of a box that are tried.
_TURNS = 30
# Points beyond these shares along an axis may be stray, as at the edges of an image of a time-of-flight camera.
_STRAY = 0.02
# Points farther from a face than this count alike [m].
_FAR = 0.01
# Least half-extent [m]: of what shows one face only.
_THIN = 0.01
# A guess's axes in the order in which a cylinder along each of them has its own: about z, x and y.
_ALONG = ((0, 1, 2), (1, 2, 0), (2, 0, 1))
SHAPES = 2 + len(_ALONG)


def rough_shapes(
    points: Float[Array, "p 3"], valid: Bool[Array, " p"], eye: Float[Array, " 3"], board: Float[Array, ""] | float
) -> Superquadrics:
    """An upright box around points, cylinders whose axes are upright or one of the box's level axes, and a box with its
    face in the points' plane and a level edge, such as a leaning book.

    Args:
      points: in the world [m]; finite.
      valid: which points count.
      eye: where the camera is.
      board: height of what the thing stands on [m].

    Returns:
      `SHAPES` superquadrics; none is valid without points.
    """
    _, last = _ends(points[:, 2], valid)
    half_height = jnp.maximum(last - board, 2 * _THIN) / 2

    def turned(turn):
        along = jnp.stack([jnp.cos(turn), jnp.sin(turn)])
        across = jnp.stack([-along[1], along[0]])
        places = [jnp.matmul(points[:, :2], axis, precision="highest") for axis in (along, across)]
        ends = [_ends(place, valid) for place in places]
        off = [jnp.minimum(jnp.abs(p - low), jnp.abs(p - high)) for p, (low, high) in zip(places, ends, strict=True)]
        off = jnp.minimum(jnp.minimum(*off), jnp.abs(points[:, 2] - last))
        return jnp.sum(jnp.where(valid, jnp.minimum(off, _FAR), 0.0)), jnp.stack([jnp.stack(e) for e in ends])

    turns = jnp.asarray(np.arange(_TURNS) * (math.pi / 2 / _TURNS), jnp.float32)
    score, ends = jax.vmap(turned)(turns)
    best = jnp.argmin(score)
    box = _around(ends[best], turns[best], eye, half_height, board)
    # From one side less than half of a round thing is seen: its depth is its width.
    ahead = (jnp.sum(jnp.where(valid[:, None], points, 0.0), axis=0) / jnp.maximum(jnp.sum(valid), 1) - eye)[:2]
    heading = jnp.arctan2(ahead[1], ahead[0])
    _, ends_ahead = turned(heading)
    radius = (ends_ahead[1, 1] - ends_ahead[1, 0]) / 2
    ends_ahead = ends_ahead.at[0, 1].set(ends_ahead[0, 0] + 2 * radius)
    upright = _around(ends_ahead, heading, eye, half_height, board)
    guesses = [box, upright, box, box, _leaning(points, valid, eye)]
    size, position, rotation = (jnp.stack(part) for part in zip(*guesses, strict=True))
    order = jnp.asarray(((0, 1, 2), *_ALONG, (0, 1, 2)))
    size = jnp.take_along_axis(size, order, axis=1)
    rotation = jnp.take_along_axis(rotation, order[:, None, :], axis=2)
    edges = (_SHARP, _SHARP)
    exponents = jnp.asarray([edges, *[(_SHARP, 1.0)] * len(_ALONG), edges], jnp.float32)
    return Superquadrics(size, exponents, position, rotation, jnp.full(SHAPES, jnp.any(valid)))


def _leaning(points: Array, valid: Array, eye: Array) -> tuple[Array, ...]:
    """Half-extents, centre and rotation of a box of which the points show one face: its axes are level, up the face,
    and away from the eye."""
    middle = jnp.sum(jnp.where(valid[:, None], points, 0.0), axis=0) / jnp.maximum(jnp.sum(valid), 1)
    offset = jnp.where(valid[:, None], points - middle[None], 0.0)
    _, axes = jnp.linalg.eigh(jnp.matmul(offset.T, offset, precision="highest"))
    away = axes[:, 0] * jnp.where(jnp.dot(axes[:, 0], middle - eye) < 0.0, -1.0, 1.0)
    # The most level direction of the plane; any of a level plane.
    level = jnp.stack([-away[1], away[0], 0.0 * away[2]])
    length = jnp.sqrt(jnp.sum(level**2) + 1e-12)
    level = jnp.where(length > 1e-3, level / length, axes[:, 2])
    R = jnp.stack([level, jnp.cross(away, level), away], axis=1)
    ends = jnp.stack([jnp.stack(_ends(place, valid)) for place in jnp.matmul(offset, R, precision="highest").T])
    half = jnp.maximum((ends[:, 1] - ends[:, 0]) / 2, _THIN)
    centre = jnp.mean(ends, axis=1).at[2].set(ends[2, 0] + half[2])
    return half, middle + jnp.matmul(R, centre, precision="highest"), R


def _ends(values: Float[Array, " p"], valid: Bool[Array, " p"]) -> tuple[Array, Array]:
    """Where values begin and end, without stray ones."""
    count = jnp.sum(valid)
    ordered = jnp.sort(jnp.where(valid, values, jnp.inf))
    low, high = (jnp.floor(share * jnp.maximum(count - 1, 0)).astype(int) for share in (_STRAY, 1.0 - _STRAY))
    low, high = ordered[low], ordered[high]
    return jnp.where(count > 0, low, 0.0), jnp.where(count > 0, high, 0.0)


def _around(ends: Array, turn: Array, eye: Array, half_height: Array, board: Array | float) -> tuple[Array, ...]:
    """Half-extents, centre and rotation of an upright box between `ends` along its axes; thin ones reach away from the
    eye."""
    R = yaw_rotation(turn)
    half = (ends[:, 1] - ends[:, 0]) / 2
    middle = (ends[:, 0] + ends[:, 1]) / 2
    away = jnp.sign(middle - jnp.matmul(R[:2, :2].T, eye[:2], precision="highest"))
    thicker = jnp.maximum(half, _THIN)
    middle = middle + away * (thicker - half)
    level = jnp.matmul(R[:2, :2], middle, precision="highest")
    position = jnp.append(level, board + half_height)
    return jnp.append(thicker, half_height), position, R
