"""Candidates for the parts of a body: subsets of a segment's points, and shapes guessed from them.

Lengths are in metres; coordinates are in the upright frame of a body: z up, x along its most level axis.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import matmul, rotate
from mechsearch_jax.perception.scores import EDGE
from mechsearch_jax.runtime.pytree import PyTreeNode

# Sharp edges, as refinement fits them.
SHARP = 0.03
BOX, CYLINDER, ELLIPSOID = (SHARP, SHARP), (SHARP, 1.0), (1.0, 1.0)
# Bins of a coordinate at whose borders points are divided.
BINS = 24
# Each side of a division has at least this share of the points.
LEAST_SHARE = 0.04
# Points this near to the board belong to a part that stands on it [m].
STANDING = 0.015
# Shares of points beyond which extents do not reach.
TAIL = 0.01
# Smallest half-extent of a guess [m].
SMALLEST = 0.004
# Rotations whose z is the frame's z, x or y.
_UP = np.eye(3, dtype=np.float32)
_ALONG_X = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]], np.float32)
_ALONG_Y = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]], np.float32)


class Frame(PyTreeNode):
    """The upright frame of a body.

    Attributes:
      position: the body's centre in the world [m], shape (3,).
      rotation: `R_world_frame`, shape (3, 3).
      view: unit vector in the frame, level, from the camera to the body, shape (2,).
      board: height of the board in the frame [m].
    """

    position: jax.Array
    rotation: jax.Array
    view: jax.Array
    board: jax.Array


def frame_of(body: Superquadrics, eye: Float[Array, "3"], board: Array | float) -> Frame:
    """The upright frame of one body, without the axis of the bodies."""
    towards = (body.position - eye).at[2].set(0.0)
    towards = towards / jnp.maximum(jnp.linalg.norm(towards), 1e-6)
    level = body.rotation[:, jnp.argmin(jnp.abs(body.rotation[2]))].at[2].set(0.0)
    stands = jnp.abs(body.rotation[2, 2]) > 0.7
    round_ = (body.exponents[1] > EDGE) & stands
    # A standing cylinder has no level axes of its own.
    x = jnp.where(round_ | (jnp.linalg.norm(level) < 0.5), towards, level)
    x = x / jnp.maximum(jnp.linalg.norm(x), 1e-6)
    up = jnp.array([0.0, 0.0, 1.0])
    rotation = jnp.stack([x, jnp.cross(up, x), up], axis=-1)
    view = rotate(rotation.T, towards)[:2]
    return Frame(body.position, rotation, view, board - body.position[2])


def in_frame(frame: Frame, points: Float[Array, "p 3"]) -> Float[Array, "p 3"]:
    """World points in the frame."""
    return rotate(frame.rotation.T, points - frame.position[None])


def best_cut(along: Float[Array, " p"], features: Float[Array, "p f"], member: Bool[Array, " p"]) -> Array:
    """The value of a coordinate that divides points into the two most uniform sides, by the squares of their features'
    deviations; infinite if either side would have too few points."""
    weight = member.astype(jnp.float32)
    total = jnp.sum(weight)
    low = jnp.min(jnp.where(member, along, jnp.inf))
    high = jnp.max(jnp.where(member, along, -jnp.inf))
    step = jnp.maximum(high - low, 1e-6) / BINS
    number = jnp.clip(jnp.floor((along - low) / step), 0, BINS - 1)
    held = jax.nn.one_hot(jnp.where(member, number, -1).astype(jnp.int32), BINS)
    mean = jnp.sum(features * weight[:, None], axis=0) / jnp.maximum(total, 1.0)
    sums = jnp.einsum("pb,pf->bf", held, (features - mean[None]) * weight[:, None], precision="highest")
    below, count = jnp.cumsum(sums, axis=0)[:-1], jnp.cumsum(jnp.sum(held, axis=0))[:-1]
    above, rest = -below, total - count
    gain = jnp.sum(below**2, axis=1) / jnp.maximum(count, 1.0) + jnp.sum(above**2, axis=1) / jnp.maximum(rest, 1.0)
    possible = jnp.minimum(count, rest) >= jnp.maximum(LEAST_SHARE * total, 3.0)
    best = jnp.argmax(jnp.where(possible, gain, -1.0))
    return jnp.where(jnp.any(possible), low + step * (best + 1), jnp.inf)


def features_of(frame: Frame, local: Float[Array, "p 3"]) -> Float[Array, "p 3"]:
    """What is alike on one part: how far points are along the view, how far from the middle across it, and how high."""
    ahead = local[:, 0] * frame.view[0] + local[:, 1] * frame.view[1]
    across = local[:, 1] * frame.view[0] - local[:, 0] * frame.view[1]
    return jnp.stack([ahead, jnp.abs(across), 0.5 * local[:, 2]], axis=-1)


def halves(
    frame: Frame, local: Float[Array, "p 3"], member: Bool[Array, " p"], axis: int
) -> tuple[Bool[Array, " p"], Bool[Array, " p"]]:
    """The points on both sides of the best cut along an axis of the frame."""
    features = features_of(frame, local)
    used = features[:, :2] if axis == 2 else features
    cut = best_cut(local[:, axis], used, member)
    return member & (local[:, axis] <= cut) & jnp.isfinite(cut), member & (local[:, axis] > cut)


def _extents(values: Float[Array, " p"], member: Bool[Array, " p"]) -> tuple[Array, Array]:
    """Between which values nearly all of the members lie."""
    ordered = jnp.sort(jnp.where(member, values, jnp.inf))
    count = jnp.sum(member)
    low = jnp.floor(TAIL * (count - 1)).astype(jnp.int32)
    high = jnp.maximum(count - 1 - low, 0)
    return jnp.where(count > 0, ordered[low], 0.0), jnp.where(count > 0, ordered[high], 0.0)


def guesses(frame: Frame, local: Float[Array, "p 3"], member: Bool[Array, " p"]) -> Superquadrics:
    """Shapes that points may belong to, fields (8, ...), in the world.

    A box, a cylinder and an ellipsoid around the body's axis; the same where the points are; cylinders there that lie
    along x and y. What is hidden is taken to be as deep as the lesser of what is seen across and upright.
    """
    (x0, x1), (y0, y1), (z0, z1) = (_extents(local[:, i], member) for i in range(3))
    z0 = jnp.where(z0 - frame.board < STANDING, frame.board, z0)
    tall, middle = z1 - z0, (z0 + z1) / 2
    across = local[:, 1] * frame.view[0] - local[:, 0] * frame.view[1]
    ahead = local[:, 0] * frame.view[0] + local[:, 1] * frame.view[1]
    (a0, a1), (r0, _) = _extents(across, member), _extents(ahead, member)
    wide = a1 - a0

    def deep(low, high, other, view):
        """Middle and depth along a level axis of which perhaps only the near side is seen."""
        hidden = jnp.minimum(other, tall)
        length = jnp.where(high - low < 0.5 * hidden, hidden, high - low)
        near = jnp.where(view > 0, low, high)
        return near + jnp.where(view > 0, 0.5, -0.5) * length, length

    x, long = deep(x0, x1, y1 - y0, frame.view[0])
    y, broad = deep(y0, y1, x1 - x0, frame.view[1])
    seen = jnp.stack([x, y, middle])
    radius = wide / 2
    r, a = r0 + radius, (a0 + a1) / 2
    standing = jnp.stack([r * frame.view[0] - a * frame.view[1], r * frame.view[1] + a * frame.view[0], middle])
    level = jnp.sqrt(local[:, 0] ** 2 + local[:, 1] ** 2)
    about = _extents(level, member)[1]
    on_axis = jnp.stack([0.0 * middle, 0.0 * middle, middle])
    box = jnp.stack([jnp.maximum(jnp.abs(x0), jnp.abs(x1)), jnp.maximum(jnp.abs(y0), jnp.abs(y1)), tall / 2])

    def near(low, high, half, view):
        return jnp.where(view > 0, low + half, high - half)

    half = tall / 2
    along_x = (jnp.stack([half, half, long / 2]), jnp.stack([x, near(y0, y1, half, frame.view[1]), middle]))
    along_y = (jnp.stack([half, half, broad / 2]), jnp.stack([near(x0, x1, half, frame.view[0]), y, middle]))
    round_ = jnp.stack([about, about, half])
    there = jnp.stack([radius, radius, half])
    rows = (
        (BOX, box, on_axis, _UP),
        (CYLINDER, round_, on_axis, _UP),
        (ELLIPSOID, round_, on_axis, _UP),
        (BOX, jnp.stack([long, broad, tall]) / 2, seen, _UP),
        (CYLINDER, there, standing, _UP),
        (ELLIPSOID, there, standing, _UP),
        (CYLINDER, *along_x, _ALONG_X),
        (CYLINDER, *along_y, _ALONG_Y),
    )
    exponents, size, place, turn = zip(*rows, strict=True)
    turns = jnp.asarray(np.stack(turn))
    return Superquadrics(
        size=jnp.maximum(jnp.stack(size), SMALLEST),
        exponents=jnp.array(exponents, jnp.float32),
        position=rotate(frame.rotation[None], jnp.stack(place)) + frame.position[None],
        rotation=matmul(jnp.broadcast_to(frame.rotation, turns.shape), turns),
        valid=jnp.full(len(rows), jnp.sum(member) > 0),
    )
