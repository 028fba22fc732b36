"""Contacts of footprints with the gripper, with walls and with each other.

Bodies of several parts touch with the footprints of these, and each contact is that of the part that is in it deepest.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mechsearch_jax.geometry.footprints import Footprints, dot, in_world, turned
from mechsearch_jax.geometry.masked import masked_vmap
from mechsearch_jax.workspace.shelf import Shelf

BOUNDARY_POINTS = 24


def point_depth(half, is_round, points):
    """How deep points are inside a footprint, in its own frame; broadcast, negative outside."""
    gap = half - jnp.abs(points)
    scaled = points / half
    square = dot(scaled, scaled)
    norm = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
    mean = 0.5 * (half[..., 0] + half[..., 1])
    return jnp.where(is_round, (1.0 - norm) * mean, jnp.minimum(gap[..., 0], gap[..., 1]))


def point_normal(half, is_round, points):
    """Outward normal of a footprint at points inside it, in its own frame; broadcast."""
    gap = half - jnp.abs(points)
    sign = jnp.where(points < 0, -1.0, 1.0)
    x_is_nearer = gap[..., 0] < gap[..., 1]
    flat = jnp.stack([jnp.where(x_is_nearer, sign[..., 0], 0.0), jnp.where(x_is_nearer, 0.0, sign[..., 1])], axis=-1)
    gradient = points / half / half
    length = jnp.sqrt(jnp.maximum(dot(gradient, gradient), 1e-12))
    return jnp.where(is_round[..., None], gradient / length[..., None], flat)


def deepest(depth, points):
    """Depth and place of the deepest of the points along the last axis of `depth`."""
    i = jnp.argmax(depth, axis=-1)[..., None]
    return jnp.take_along_axis(depth, i, axis=-1)[..., 0], jnp.take_along_axis(points, i[..., None], axis=-2)[..., 0, :]


def outline_points(prints):
    """Points on the outline of every footprint, in the world seen from above, shape (N, BOUNDARY_POINTS, 2) [m]."""
    angle = np.arange(BOUNDARY_POINTS) * 2 * np.pi / BOUNDARY_POINTS
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    square = circle / np.abs(circle).max(axis=-1, keepdims=True)
    unit = jnp.where(prints.round[:, None, None], jnp.float32(circle)[None], jnp.float32(square)[None])
    return turned(prints.yaw[:, None], unit * prints.half[:, None, :]) + prints.position[:, None, :]


def pusher_contacts(prints, points):
    """Of each footprint with the gripper's points: the depth, the direction in which it gives way, and the place of the
    contact from its centre."""
    shapes = in_world(prints)
    depth, point = deepest(*pusher_depth(shapes, points))
    away = -turned(shapes.yaw, point_normal(shapes.half, shapes.round, point))
    arm = turned(shapes.yaw, point)
    if prints.parts is None:
        return depth, away, arm
    n, p = prints.parts.valid.shape
    arm = arm.reshape(n, p, 2) + turned(prints.yaw[:, None], prints.parts.position)
    return _deepest_of(depth.reshape(n, p), away.reshape(n, p, 2), arm)


def pusher_depth(prints, points):
    """Depth of the gripper's points in each footprint, -1 at other heights, and their positions in its frame."""
    local = turned(-prints.yaw[:, None], points[None, :, :2] - prints.position[:, None, :])
    depth = point_depth(prints.half[:, None, :], prints.round[:, None], local)
    level = (points[None, :, 2] > prints.low[:, None]) & (points[None, :, 2] < prints.high[:, None])
    return jnp.where(level & prints.valid[:, None], depth, -1.0), local


def pair_contacts(prints):
    """For every ordered pair (i, j): the deepest contact, the direction in which j has to give way, and the place from
    its centre."""
    if prints.parts is not None:
        return _body_contacts(prints)
    outline = outline_points(prints)
    into_j = turned(-prints.yaw[None, :, None], outline[:, None] - prints.position[None, :, None, :])
    depth, point = deepest(point_depth(prints.half[None, :, None, :], prints.round[None, :, None], into_j), into_j)
    normal = point_normal(prints.half[None], prints.round[None], point)
    yaw = jnp.broadcast_to(prints.yaw[None, :], depth.shape)
    direction, arm = -turned(yaw, normal), turned(yaw, point)
    # The reverse: a corner of j inside a face of i, where j gives way along i's normal.
    other_direction = -jnp.swapaxes(direction, 0, 1)
    world = arm + prints.position[None, :, :]
    other_arm = jnp.swapaxes(world, 0, 1) - prints.position[None, :, :]
    swap = depth < depth.T
    deeper = jnp.where(swap[..., None], other_direction, direction), jnp.where(swap[..., None], other_arm, arm)
    both = prints.valid[:, None] & prints.valid[None, :] & ~jnp.eye(prints.valid.size, dtype=bool)
    return jnp.where(both, jnp.maximum(depth, depth.T), -1.0), *deeper


def _body_contacts(prints):
    """`pair_contacts` of bodies with parts, which may pass above each other; -1 deep if all of two are far apart."""
    shapes, (n, p) = in_world(prints), prints.parts.valid.shape
    body = np.arange(n * p) // p
    reach = jnp.sqrt(dot(shapes.half, shapes.half))
    offset = shapes.position[None] - shapes.position[:, None]
    near = dot(offset, offset) < (reach[:, None] + reach[None]) ** 2
    near &= jnp.maximum(shapes.low[:, None], shapes.low[None]) < jnp.minimum(shapes.high[:, None], shapes.high[None])
    near &= shapes.valid[:, None] & shapes.valid[None] & (body[:, None] != body[None])

    def contact(_, shapes, pair):
        first, second = (jax.tree.map(lambda a, k=k: a[k][None], shapes) for k in pair)
        depth, normal, place = _corners(first, second)
        # The reverse: a corner of the second inside a face of the first.
        back, back_normal, back_place = _corners(second, first)
        swap = (depth < back)[..., None]
        deeper = jnp.maximum(depth, back), jnp.where(swap, back_normal, -normal), jnp.where(swap, back_place, place)
        return jax.tree.map(lambda a: a[0, 0], deeper)

    pairs = tuple(jnp.asarray(a.reshape(-1)) for a in np.indices(near.shape))
    contacts = masked_vmap(contact, near.reshape(-1), None, shapes, pairs, block=64)
    depth, direction, place = (
        jnp.swapaxes(a.reshape(n, p, n, p, *a.shape[1:]), 1, 2).reshape(n, n, p * p, *a.shape[1:]) for a in contacts
    )
    apart = ~jnp.swapaxes(near.reshape(n, p, n, p), 1, 2).reshape(n, n, p * p)
    depth, direction, place = _deepest_of(jnp.where(apart, -1.0, depth), direction, place)
    return depth, direction, place - prints.position[None]


def _deepest_of(depth, *vectors):
    """The deepest of contacts along the last axis of `depth`, (..., K): its depth, and its vectors, (..., K, 2)."""
    i = jnp.argmax(depth, axis=-1)[..., None]
    chosen = (jnp.take_along_axis(v, i[..., None], axis=-2)[..., 0, :] for v in vectors)
    return jnp.take_along_axis(depth, i, axis=-1)[..., 0], *chosen


def _corners(prints, others):
    """Of each footprint's outline in each other footprint: the largest depth, the other's outward normal there, and the
    place; in the world."""
    outline = outline_points(prints)
    into = turned(-others.yaw[None, :, None], outline[:, None] - others.position[None, :, None, :])
    depth, point = deepest(point_depth(others.half[None, :, None, :], others.round[None, :, None], into), into)
    yaw = jnp.broadcast_to(others.yaw[None, :], depth.shape)
    normal = turned(yaw, point_normal(others.half[None], others.round[None], point))
    return depth, normal, turned(yaw, point) + others.position[None]


def wall_depth(shelf, prints):
    """How deep outlines are in the back, right and left walls, shape (N, B, 3) [m]; and the outlines, (N, B, 2).

    B is `BOUNDARY_POINTS` for each part.
    """
    shapes = in_world(prints)
    outline = outline_points(shapes)
    x, y = outline[..., 0], outline[..., 1]
    walls = shelf.walls
    depth = jnp.stack([x - walls.back, walls.right - y, y - walls.left], axis=-1)
    if prints.parts is None:
        return depth, outline
    n = prints.valid.size
    return jnp.where(shapes.valid[:, None, None], depth, -1.0).reshape(n, -1, 3), outline.reshape(n, -1, 2)


def unresolved(shelf: Shelf, before: Footprints, after: Footprints, points: Float[Array, "p 3"]) -> Float[Array, ""]:
    """Deepest penetration after a push [m]: of gripper, walls, and objects beyond what was there before; at least 0.

    Args:
      shelf: walls.
      before, after: the objects.
      points: surface of the gripper where the push ends, in the world [m].
    """
    held = jnp.max(pusher_depth(in_world(after), points)[0])
    jammed = jnp.max(pair_contacts(after)[0]) - jnp.maximum(jnp.max(pair_contacts(before)[0]), 0.0)
    wall = jnp.max(jnp.where(after.valid[:, None], jnp.max(wall_depth(shelf, after)[0], axis=1), -1.0))
    return jnp.maximum(jnp.maximum(jnp.maximum(held, jammed), wall), 0.0)
