"""Contacts of footprints: which way objects, and points, move until they meet others, and how they meet."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mechsearch_jax.geometry.footprints import TOUCH, Footprints, turned
from mechsearch_jax.runtime.pytree import PyTreeNode

# Number of directions over half a turn in which an object's extents are features; even.
DIRECTIONS = 8
# Distances to contacts and walls are clipped to this [m]: no push is longer.
REACH = 0.25
# Lateral overlap over which a contact grows from a graze, which is no contact, to a full one [m].
GRAZE = 1e-3
# Deeper overlaps are clipped to this, and so are lateral gaps of objects that pass each other [m].
DEEPEST = 0.02
# Two objects meet along a normal that separates them until they touch; normals that separate them until up to this much
# earlier count linearly less [m].
SAME_CONTACT = 2e-3
# Least sine of the angle at which a cylinder is met, in Newton's step towards its contact.
_FLATTEST = 0.3


def dot(a: Array, b: Array) -> Array:
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1]


def perpendicular(v: Array) -> Array:
    return jnp.stack([-v[..., 1], v[..., 0]], axis=-1)


def norm(v: Array) -> Array:
    """Length of planar vectors; 0, with a gradient of 0, where they vanish."""
    square = dot(v, v)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)


def fan(axis: Array) -> Array:
    """Unit vectors in `DIRECTIONS` directions over half a turn, beginning with that of a planar vector, (K, 2)."""
    angles = jnp.arctan2(axis[1], axis[0]) + jnp.asarray(np.arange(DIRECTIONS) * np.pi / DIRECTIONS, jnp.float32)
    return jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=-1)


def reach(prints: Footprints, direction: Float[Array, "*other n 2"]) -> Float[Array, "*other n"]:
    """How far footprints (N) reach from their centres along planar unit vectors [m]."""
    lead = (1,) * (direction.ndim - 2)
    yaw, half = prints.yaw.reshape(*lead, -1), prints.half.reshape(*lead, -1, 2)
    along = dot(direction, jnp.stack([jnp.cos(yaw), jnp.sin(yaw)], axis=-1))
    across = dot(direction, jnp.stack([-jnp.sin(yaw), jnp.cos(yaw)], axis=-1))
    parts = jnp.abs(jnp.stack([along, across], axis=-1)) * half
    return jnp.where(prints.round.reshape(*lead, -1), norm(parts), parts[..., 0] + parts[..., 1])


def _slabs(width: Array, offset: Array, speed: Array) -> tuple[Array, Array]:
    """When a point at `offset` with velocity `speed` enters and leaves all slabs |x| <= width along axis -1."""
    safe = jnp.where(jnp.abs(speed) < 1e-5, 1e-5, speed)
    middle, half = -offset / safe, width / jnp.abs(safe)
    return jnp.max(middle - half, axis=-1), jnp.min(middle + half, axis=-1)


def _grazing(enters: Array, leaves: Array, overlap: Array, longest: float = REACH) -> Array:
    """A distance to a contact, at most `longest`; `longest` if the two pass each other or are past it already."""
    share = jnp.clip(jnp.minimum(overlap, leaves) / GRAZE, 0.0, 1.0)
    return share * jnp.clip(enters, -DEEPEST, longest) + (1.0 - share) * longest


def pusher_distance(
    prints: Footprints, points: Float[Array, "p 3"], heading: Float[Array, "2"], longest: float = REACH
) -> tuple[Float[Array, "n p"], Bool[Array, "n p"]]:
    """How far each point moves along a planar unit vector until it enters each footprint, at most `longest` [m].

    A distance below 0 means that it is inside. Also returns whether the point is at the height of the object.
    """
    level = (points[None, :, 2] > prints.low[:, None] - TOUCH) & (points[None, :, 2] < prints.high[:, None] + TOUCH)
    side = perpendicular(heading)
    from_centre = points[None, :, :2] - prints.position[:, None]
    lateral = dot(from_centre, side[None, None])
    widest = reach(prints, jnp.broadcast_to(side[None], prints.position.shape))[:, None]
    # Points that pass by are shifted to graze the side, which keeps values finite; their weight is 0.
    inside = jnp.clip(lateral, GRAZE / 4 - widest, widest - GRAZE / 4)
    start = from_centre + (inside - lateral)[..., None] * side[None, None]
    local = turned(-prints.yaw, start)
    speed = turned(-prints.yaw, jnp.broadcast_to(heading[None], prints.position.shape))[:, None]
    flat = _slabs(prints.half[:, None], local, speed)
    p, d = local / prints.half[:, None], speed / prints.half[:, None]
    square, product = dot(d, d), dot(p, d)
    root = jnp.sqrt(jnp.maximum(product**2 - square * (dot(p, p) - 1.0), 1e-9))
    disc = (-product - root) / square, (-product + root) / square
    enters, leaves = (jnp.where(prints.round[:, None], a, b) for a, b in zip(disc, flat, strict=True))
    return _grazing(enters, leaves, widest - jnp.abs(lateral), longest), level


class Meetings(PyTreeNode):
    """Contacts of object i with object j if i moves along the heading; leading axes (N, N).

    Distances are exact for two boxes, whose gaps are lower bounds. A cylinder's contact is computed with a
    circumscribed polygon, up to 2% wider, and then moved onto the circle by one Newton step: too early by up to 3 mm
    for near misses.

    Attributes:
      distance: how far i moves until it touches j [m]: at least `-DEEPEST`, and `REACH` if it passes by or is past.
      gap: present gap between them; negative if they overlap [m].
      normal: unit vector along which i meets j, never against the heading, (N, N, 2); for two boxes the mean if there
        are several. If i passes by, about that of a graze; if it is past, that of the earlier contact.
      middle: middle of their overlap across the heading, or of the gap, to the left of i's centre [m].
      breadth: of that overlap; negative if i passes by [m].
    """

    distance: jax.Array
    gap: jax.Array
    normal: jax.Array
    middle: jax.Array
    breadth: jax.Array


def _round_contacts(prints: Footprints, axis: Array, offset: Array) -> tuple[Array, Array]:
    """Direction and gap from footprints i to footprints j at their nearest points, if one of them is round.

    An approximation: an ellipse is replaced by a circle of its mean half-axis. Meaningless for two boxes.

    Args:
      prints: the footprints (N).
      axis: first axis of each, planar unit vectors (N, 2).
      offset: of i from j, (K, N, N, 2) [m].

    Returns:
      Unit vectors (K, N, N, 2), and gaps (K, N, N) [m], negative for overlaps. If the centre of the disc is inside the
      other footprint, the vector is 0 and the depth is underestimated.
    """
    # In the frame of the footprint that may be a box, the other one is a disc.
    disc_moves = prints.round[:, None, None]
    axis = jnp.where(disc_moves, axis[None], axis[:, None])[None]
    side = perpendicular(axis)
    flat = jnp.where(prints.round[:, None], 0.0, prints.half)
    half = jnp.where(disc_moves, flat[None], flat[:, None])[None]
    seen = jnp.where(disc_moves[None], offset, -offset)
    x, y = dot(seen, axis), dot(seen, side)
    x, y = x - jnp.clip(x, -half[..., 0], half[..., 0]), y - jnp.clip(y, -half[..., 1], half[..., 1])
    away = x[..., None] * axis + y[..., None] * side
    length = norm(away)
    radii = jnp.where(prints.round, 0.5 * (prints.half[:, 0] + prints.half[:, 1]), 0.0)
    way = jnp.where(disc_moves[None], -away, away) / jnp.maximum(length, 1e-6)[..., None]
    return way, length - (radii[:, None] + radii[None])[None]


def meetings(prints: Footprints, heading: Float[Array, "2"]) -> Meetings:
    """Where footprints (N) would meet each other along a planar unit vector."""
    n = prints.yaw.shape[0]
    rays = fan(heading)
    # A round object has no sides: two of the rays are repeated instead.
    axis = jnp.stack([jnp.cos(prints.yaw), jnp.sin(prints.yaw)], axis=-1)
    first = jnp.where(prints.round[:, None], heading[None], axis)
    sides = jnp.stack([first, perpendicular(first)], axis=1)
    # Extents of all objects along the rays, (K, N), and along each other's sides: [k, s, m] is m along those of k.
    along_rays = reach(prints, jnp.broadcast_to(rays[:, None], (DIRECTIONS, n, 2)))
    along_sides = reach(prints, jnp.broadcast_to(sides[:, :, None], (n, 2, n, 2)))
    half_sides = jnp.diagonal(along_sides, axis1=0, axis2=2).T
    offset = prints.position[:, None] - prints.position[None]
    side = perpendicular(heading)
    lateral = dot(offset, side[None, None])
    across = reach(prints, jnp.broadcast_to(side[None], prints.position.shape))
    widest = across[:, None] + across[None]
    inside = jnp.clip(lateral, GRAZE / 4 - widest, widest - GRAZE / 4)
    start = offset + (inside - lateral)[..., None] * side[None, None]

    normals = (
        jnp.broadcast_to(rays[:, None, None], (DIRECTIONS, n, n, 2)),
        jnp.broadcast_to(jnp.moveaxis(sides, 1, 0)[:, :, None], (2, n, n, 2)),
        jnp.broadcast_to(jnp.moveaxis(sides, 1, 0)[:, None], (2, n, n, 2)),
    )
    normals = jnp.concatenate(normals)
    width = jnp.moveaxis(half_sides[:, :, None] + along_sides, 1, 0)
    width = jnp.concatenate([along_rays[:, :, None] + along_rays[:, None], width, jnp.swapaxes(width, 1, 2)])
    speed = dot(normals, heading[None, None, None])
    safe = jnp.where(jnp.abs(speed) < 1e-5, 1e-5, speed)
    nearest, half = -dot(normals, start[None]) / safe, width / jnp.abs(safe)
    entries = nearest - half
    enters, leaves = jnp.max(entries, axis=0), jnp.min(nearest + half, axis=0)
    gap = jnp.max(jnp.abs(dot(normals, offset[None])) - width, axis=0)
    share = jnp.maximum(1.0 - (enters[None] - entries) / SAME_CONTACT, 0.0) * jnp.sign(speed)
    normal = jnp.sum(share[..., None] * normals, axis=0)
    length = norm(normal)[..., None]
    normal = jnp.where(length > 1e-6, normal / jnp.where(length > 1e-6, length, 1.0), 0.0)
    is_round = prints.round[:, None] | prints.round[None]
    places = [start + enters[..., None] * heading[None, None], start + leaves[..., None] * heading[None, None], offset]
    way, between = _round_contacts(prints, axis, jnp.stack(places))
    normal = jnp.where(is_round[..., None], way[0], normal)
    steepness = dot(way[:2], heading[None, None, None]) * jnp.array([1.0, -1.0]).reshape(2, 1, 1)
    step = jnp.where(is_round[None], jnp.maximum(between[:2], 0.0) / jnp.maximum(steepness, _FLATTEST), 0.0)
    enters, leaves, gap = enters + step[0], leaves - step[1], jnp.where(is_round, between[2], gap)
    # From the centre of i, j reaches from -lateral - across_j to -lateral + across_j.
    left = jnp.minimum(across[:, None], across[None] - lateral)
    right = jnp.maximum(-across[:, None], -across[None] - lateral)
    return Meetings(
        distance=_grazing(enters, leaves, widest - jnp.abs(lateral)),
        gap=gap,
        normal=normal,
        middle=0.5 * (left + right),
        breadth=left - right,
    )
