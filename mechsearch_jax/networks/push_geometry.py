"""Input features of the push network: objects, contacts and walls, along the push and across it."""

from __future__ import annotations

import functools
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mechsearch_jax.geometry.footprints import Footprints, footprints
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import transform
from mechsearch_jax.networks.push_contacts import (
    DEEPEST,
    DIRECTIONS,
    REACH,
    Meetings,
    dot,
    fan,
    meetings,
    norm,
    perpendicular,
    pusher_distance,
    reach,
)
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.workspace.shelf import Shelf

# Number of points of the gripper.
POINTS = 192
# Decay length of the weights of points behind the first contact [m]; the power of these weights that gives stricter
# ones without another exponential.
SOFTNESS, STRICTER = 0.015, 5
# Length of chains of objects that push each other, in the estimate of which object is reached when.
CHAIN = 4
# Units of the network's inputs and outputs: lengths [m], angles [rad].
_LENGTH = 0.1
# The inward normals of the back, right and left walls, and of the front edge, which is no wall.
NORMALS = np.array([[-1.0, 0.0], [0.0, 1.0], [0.0, -1.0], [1.0, 0.0]], np.float32)
_IS_EDGE = np.array([0.0, 0.0, 0.0, 1.0], np.float32)
MIRRORED_DIRECTIONS = (-np.arange(DIRECTIONS)) % DIRECTIONS


class Parity(PyTreeNode):
    """Features by their parity under reflection at the frame's first axis; any leading axes.

    Attributes:
      even: unchanged: lengths, and components along the axis.
      odd: with changed sign: components across the axis.
    """

    even: jax.Array
    odd: jax.Array


class PushGeometry(PyTreeNode):
    """Input features of a push, in the frame of `PushConfig`; lengths in units of 10 cm unless [m] is given.

    Attributes:
      objects: of each object, shapes (N, ...).
      pairs: of object j relative to object i, shapes (N, N, ...).
      walls: of each wall relative to each object, shapes (N, 4, ...).
      wall_near: 1 at the wall, 0 from `REACH` on, shape (N, 4).
      carry: how far each object would be carried if nothing turned or slid off [m], shape (N,).
      heading: unit vector of the push in the frame, shape (2,).
      axis: first axis of the frame in the world, a planar unit vector, shape (2,).
      round: which objects are round, shape (N,).
      valid: which slots hold an object, shape (N,).
    """

    objects: Parity
    pairs: Parity
    walls: Parity
    wall_near: jax.Array
    carry: jax.Array
    heading: jax.Array
    axis: jax.Array
    round: jax.Array
    valid: jax.Array


def _soft_contacts(distance: Array, level: Array, points: Array, heading: Array) -> tuple[Array, Array]:
    """Where points (P, 3), moved along the heading by distances (N, P), first touch, strictly and less so; (N, 3)."""
    first = jnp.min(jnp.where(level, distance, REACH), axis=1, keepdims=True)
    # Points at other heights may be reached long before; the inner `where` prevents an overflow.
    weight = jnp.where(level, jnp.exp((first - jnp.where(level, distance, first)) / SOFTNESS), 0.0)

    def mean(weight):
        total = jnp.maximum(jnp.sum(weight, axis=1), 1e-6)
        place = jnp.matmul(weight, points, precision=jax.lax.Precision.HIGHEST)
        way = jnp.sum(weight * distance, axis=1)[:, None] * jnp.append(heading, 0.0)[None]
        return (place + way) / total[:, None]

    return mean(weight**STRICTER), mean(weight)


class PushStart(PyTreeNode):
    """A push as it begins.

    Attributes:
      prints: footprints of the objects, fields (N, ...).
      tilt: 10 (1 - cos) of each object's angle of lean, 0 if a face is level, shape (N,).
      points: surface of the gripper in the world [m], shape (P, 3).
      T_world_gripper: its pose, shape (4, 4).
      displacement: of the gripper in the plane [m], shape (2,).
      faces: positions of the inner faces of the back, right and left walls, and of the front edge, along their inward
        normals [m], shape (4,).
      board: height of the shelf's board [m].
    """

    prints: Footprints
    tilt: jax.Array
    points: jax.Array
    T_world_gripper: jax.Array
    displacement: jax.Array
    faces: jax.Array
    board: jax.Array


def push_start(
    shelf: Shelf,
    scene: Superquadrics,
    pusher: Float[Array, "p 3"],
    T_world_gripper: Float[Array, "4 4"],
    displacement: Float[Array, "3"],
) -> PushStart:
    """The start of a push; see `push_model.PushModel` for the arguments.

    Args:
      shelf: walls; those farther than `REACH` from an object have no effect on it.
      scene: the objects, fields (N, ...).
      pusher: surface of the closed gripper in its own frame [m]; the first `POINTS` must cover all of it.
      T_world_gripper: first pose.
      displacement: of the gripper [m]; the vertical component is neglected.
    """
    walls = shelf.walls
    return PushStart(
        prints=footprints(scene),
        tilt=10.0 * (1.0 - jnp.max(jnp.abs(scene.rotation[:, 2, :]), axis=-1)),
        points=transform(T_world_gripper, pusher[:POINTS]),
        T_world_gripper=T_world_gripper,
        displacement=displacement[:2],
        faces=jnp.array([-walls.back, walls.right, -walls.left, shelf.front]),
        board=jnp.float32(shelf.board),
    )


def _framed(axis: Array, vectors: Array) -> Array:
    """Planar vectors (..., 2) in the frame whose first axis is `axis`."""
    x, y = (a.reshape(*[1] * (vectors.ndim - 1), 2) for a in (axis, perpendicular(axis)))
    return jnp.stack([dot(vectors, x), dot(vectors, y)], axis=-1)


def _pairs(prints: Footprints, met: Meetings, carry: Array, heading: Array, axis: Array) -> Parity:
    """Features of object j in the frame of object i, (N, N, ...)."""
    offset = prints.position[None] - prints.position[:, None]
    overlap = jnp.minimum(prints.high[:, None], prints.high[None]) - jnp.maximum(prints.low[:, None], prints.low[None])
    onward = jnp.clip(met.distance, -DEEPEST, REACH)
    # How far i carries j.
    passed = jnp.maximum(carry[:, None] - jnp.maximum(onward, 0.0), 0.0)
    gap, breadth = (jnp.clip(a, -DEEPEST, REACH) for a in (met.gap, met.breadth))
    lengths = [onward, onward.T, passed, passed.T, gap, jnp.clip(overlap, -0.05, 0.2), breadth]
    # Relative to the centre of i; relative to j it differs by the offset, which is a feature.
    side = met.middle[..., None] * perpendicular(heading)[None, None]
    normal = _framed(axis, met.normal)
    offset, side = _framed(axis, offset) / _LENGTH, _framed(axis, side) / _LENGTH
    vectors = jnp.stack([offset, normal, jnp.swapaxes(normal, 0, 1), side], axis=-2)
    even = jnp.concatenate([jnp.stack(lengths, axis=-1) / _LENGTH, vectors[..., 0]], axis=-1)
    return Parity(even=even, odd=vectors[..., 1])


def _walls(prints: Footprints, faces: Array, axis: Array) -> tuple[Parity, Array]:
    """`walls` and `wall_near` of `PushGeometry`."""
    n = prints.yaw.shape[0]
    normals = jnp.asarray(NORMALS)
    toward = reach(prints, jnp.broadcast_to(normals[:, None], (4, n, 2))).T
    gap = dot(prints.position[:, None], normals[None]) - faces[None] - toward
    gap = jnp.clip(gap, -0.05, REACH)
    near = 1.0 - jnp.maximum(gap, 0.0) / REACH
    edge = jnp.broadcast_to(jnp.asarray(_IS_EDGE)[None], (n, 4))
    inwards = jnp.broadcast_to(_framed(axis, normals)[None], (n, 4, 2))
    even = jnp.stack([gap / _LENGTH, near, edge, inwards[..., 0]], axis=-1)
    return Parity(even=even, odd=inwards[..., 1:]), near


def _extents(prints: Footprints, axis: Array) -> Parity:
    """Extents of each object in directions that begin with the axis [m], (N, ...)."""
    rays = fan(axis)
    extents = reach(prints, jnp.broadcast_to(rays[:, None], (DIRECTIONS, prints.yaw.shape[0], 2))).T
    opposite, half = extents[:, MIRRORED_DIRECTIONS], DIRECTIONS // 2
    return Parity(even=0.5 * (extents + opposite)[:, : half + 1], odd=0.5 * (extents - opposite)[:, 1:half])


def _reached(prints: Footprints, met: Meetings, direct: Array, length: Array) -> tuple[Array, Array]:
    """Length of the push until the gripper or other objects reach each object, and how far it is then carried [m]."""
    valid = prints.valid[:, None]
    other = ~jnp.eye(prints.yaw.shape[0], dtype=bool) & valid & valid.T
    onward = jnp.where(other, jnp.maximum(met.distance, 0.0), REACH)
    reached = direct
    for _ in range(CHAIN):
        reached = jnp.minimum(reached, jnp.min(reached[:, None] + onward, axis=0))
    return reached, jnp.maximum(length - reached, 0.0)


def _swept_band(start: PushStart, level: Array, heading: Array) -> tuple[Array, Array]:
    """Middle and half breadth, across the push, of the band that the gripper sweeps at each object's height."""
    across = dot(start.points[None, :, :2] - start.prints.position[:, None], perpendicular(heading)[None, None])
    low = jnp.min(jnp.where(level, across, REACH), axis=1)
    high = jnp.max(jnp.where(level, across, -REACH), axis=1)
    level_at_all = jnp.any(level, axis=1)
    return jnp.where(level_at_all, 0.5 * (low + high), 0.0), jnp.where(level_at_all, 0.5 * (high - low), 0.0)


def _hand_directions(T_world_gripper: Array, axis: Array) -> tuple[Array, Array]:
    """The hand's planar approach direction, and the vector at twice the angle of its closing direction, in the frame.

    Twice the angle, for the hand is the same after half a turn about its approach.
    """
    approach, closing = (_framed(axis, T_world_gripper[None, :2, i])[0] for i in (2, 1))
    return approach, jnp.stack([closing[0] ** 2 - closing[1] ** 2, 2.0 * closing[0] * closing[1]])


class _HandMeeting(NamedTuple):
    """What the gripper meets on its way; N objects.

    Attributes:
      met: what the objects meet along the heading.
      direct: after how long a way the gripper reaches each itself [m].
      reached, carry: as `_reached` says [m].
      touching: 1 where it touches from the start, down to 0 where it never does, shape (N, 1).
      contacts: where it first touches, strictly and less so, from each object's foot; 0 where it never does [m].
      middle, breadth: as `_swept_band` says [m].
    """

    met: Meetings
    direct: Float[Array, " n"]
    reached: Float[Array, " n"]
    carry: Float[Array, " n"]
    touching: Float[Array, "n 1"]
    contacts: list[Float[Array, "n 3"]]
    middle: Float[Array, " n"]
    breadth: Float[Array, " n"]


def _hand_meeting(start: PushStart, heading: Array, length: Array) -> _HandMeeting:
    prints, points = start.prints, start.points
    distance, level = pusher_distance(prints, points, heading)
    level &= prints.valid[:, None]
    direct = jnp.min(jnp.where(level, distance, REACH), axis=1)
    met = meetings(prints, heading)
    reached, carry = _reached(prints, met, direct, length)
    touching = jnp.maximum(1.0 - direct / REACH, 0.0)[:, None]
    base = jnp.concatenate([prints.position, prints.low[:, None]], axis=1)
    contacts = [(c - base) * touching for c in _soft_contacts(distance, level, points, heading)]
    return _HandMeeting(met, direct, reached, carry, touching, contacts, *_swept_band(start, level, heading))


def _spread(prints: Footprints, vector: Array) -> Array:
    """The same vector for every object."""
    return jnp.broadcast_to(vector[None], (len(prints.yaw), *vector.shape))


def _vectors(
    start: PushStart, frame: Literal["push", "world"], hand: _HandMeeting, heading: Array, axis: Array, length: Array
) -> Float[Array, "n k 2"]:
    """Planar vectors of each object, along the axis and across it: distances over `_LENGTH`, then directions."""
    prints, T_world_gripper = start.prints, start.T_world_gripper
    framed = functools.partial(_framed, axis)
    to_gripper = T_world_gripper[None, :2, 3] - prints.position
    planar = [
        to_gripper,
        hand.contacts[0][:, :2],
        hand.contacts[1][:, :2],
        hand.middle[:, None] * perpendicular(heading)[None],
    ]
    units = [_spread(prints, direction) for direction in _hand_directions(T_world_gripper, axis)]
    if frame == "world":
        back, right, left, front = start.faces
        room = 0.5 * jnp.stack([front - back, right - left])
        carry = hand.carry
        planar += [prints.position - room[None], carry[:, None] * heading[None], to_gripper + (length * heading)[None]]
        units += [_spread(prints, framed(heading[None])[0])]
    return jnp.concatenate([framed(jnp.stack(planar, axis=1)) / _LENGTH, jnp.stack(units, axis=1)], axis=1)


def push_geometry(start: PushStart, frame: Literal["push", "world"] = "push") -> PushGeometry:
    """The network's input features of a push.

    Args:
      start: see there.
      frame: see `PushConfig`.
    """
    prints, T_world_gripper = start.prints, start.T_world_gripper
    length = norm(start.displacement)
    heading = jnp.where(length > 1e-6, start.displacement / jnp.maximum(length, 1e-6), jnp.array([1.0, 0.0]))
    axis = heading if frame == "push" else jnp.array([1.0, 0.0])
    hand = _hand_meeting(start, heading, length)
    vectors = _vectors(start, frame, hand, heading, axis, length)
    lengths = jnp.stack(
        [
            prints.low - start.board,
            prints.high - prints.low,
            _spread(prints, length),
            hand.direct,
            hand.reached,
            hand.carry,
            jnp.maximum(length - hand.direct, 0.0),
            hand.contacts[0][:, 2],
            hand.contacts[1][:, 2],
            hand.breadth,
            T_world_gripper[2, 3] - prints.low,
        ],
        axis=1,
    )
    plain = jnp.stack(
        [
            prints.round.astype(jnp.float32),
            start.tilt,
            _spread(prints, T_world_gripper[2, 2]),
            hand.touching[:, 0],
            (hand.reached < length).astype(jnp.float32),
        ],
        axis=1,
    )
    extents, (walls, near) = _extents(prints, axis), _walls(prints, start.faces, axis)
    return PushGeometry(
        objects=Parity(
            even=jnp.concatenate([lengths / _LENGTH, plain, vectors[..., 0], extents.even / _LENGTH], axis=1),
            odd=jnp.concatenate([vectors[..., 1], extents.odd / _LENGTH], axis=1),
        ),
        pairs=_pairs(prints, hand.met, hand.carry, heading, axis),
        walls=walls,
        wall_near=near,
        carry=hand.carry,
        heading=_framed(axis, heading[None])[0],
        axis=axis,
        round=prints.round,
        valid=prints.valid,
    )
