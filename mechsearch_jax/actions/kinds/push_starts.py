"""Start poses of pushes: the closed hand beside an object, or behind it along the push (paper appendix B.5)."""

from __future__ import annotations

import itertools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from mechsearch_jax.actions.config import ActionConfig, ActionSpace
from mechsearch_jax.actions.kinds.object_grasps import PASSING_GAP
from mechsearch_jax.dynamics.push_model import LOW_CONTACT
from mechsearch_jax.geometry.footprints import TOUCH, Footprints, extents, turned
from mechsearch_jax.geometry.masked import masked_vmap
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import make, transform
from mechsearch_jax.robot.grasp_frames import gripper_rotation

# A push within these angles of +x or -x starts behind the object, any other beside it [rad].
BEHIND = (math.radians(75), math.radians(45))


class PushStarts(NamedTuple):
    """Start poses of pushes relative to an object, V of them; constants.

    Attributes:
      heading: unit vector of the push, seen from above, shape (V, 2).
      across: unit vector across the push, away from the robot, shape (V, 2).
      share: offset of the finger tips across the push, as a share of the object's half extent, shape (V,).
      depth: offset across the push in addition [m], shape (V,).
      yaw: angle between the gripper's approach and +x, seen from above [rad], shape (V,).
      wrist: index of the wrist angle, shape (V,).
    """

    heading: Float[np.ndarray, "v 2"]
    across: Float[np.ndarray, "v 2"]
    share: Float[np.ndarray, " v"]
    depth: Float[np.ndarray, " v"]
    yaw: Float[np.ndarray, " v"]
    wrist: Int[np.ndarray, " v"]


def planar_unit(angle: float) -> Float[np.ndarray, "2"]:
    """The unit vector at an angle from +x towards +y [rad]; exact along the axes."""
    vector = np.array([math.cos(angle), math.sin(angle)])
    return np.where(np.abs(vector) < 1e-12, 0.0, vector).astype(np.float32)


def away_from_robot(heading: Shaped[Any, "2"], xp: Any) -> Shaped[Any, "2"]:
    """Unit vector across a heading, pointing away from the robot; `xp` is NumPy or `jax.numpy`."""
    return xp.stack([xp.abs(heading[1]), -heading[0] * xp.where(heading[1] < 0, -1.0, 1.0)])


def contact_height(
    config: ActionConfig, is_round: Bool[Array, "*batch"], along: Float[Array, "*batch"], tall: Float[Array, "*batch"]
) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
    """Height of the finger tips above the board in a push, and largest height of the first contact [m].

    Args:
      config: static.
      is_round: whether the pushed object is round.
      along: its half extent along the push [m].
      tall: its height [m].
    """
    leverage = jnp.where(is_round, config.push_leverage[1], config.push_leverage[0]) * along
    return jnp.clip(jnp.minimum(leverage, 0.75 * tall), LOW_CONTACT, config.push_height), leverage


def push_starts(config: ActionConfig, wrists: int) -> PushStarts:
    """Start poses of pushes: for each direction, each place across it, and each yaw and wrist of the gripper.

    Beside an object the finger tips reach just past its front, or past its centre so that the palm pushes. Behind it
    the places are spread over its width.

    Args:
      config: static.
      wrists: number of angles of joint 7.
    """
    rows = []
    for angle in config.push_directions:
        if BEHIND[0] < abs(angle) < math.pi - BEHIND[1]:
            places = zip((-1.0, 0.0), config.push_depths, strict=True)
            postures = tuple(itertools.product(config.push_yaws, range(wrists)))
        else:
            places = ((share, 0.0) for share in config.push_offsets)
            postures = config.push_postures
        heading = planar_unit(angle)
        for (share, depth), (yaw, wrist) in itertools.product(places, postures):
            rows.append((heading, away_from_robot(heading, np), share, depth, yaw, wrist))
    *numbers, wrist = zip(*rows, strict=True)
    heading, across, share, depth, yaw = (np.asarray(a, np.float32) for a in numbers)
    return PushStarts(heading, across, share, depth, yaw, np.asarray(wrist))


def _exit_distance(half, is_round, points, direction):
    """How far points must move along a direction to leave a footprint, in its frame; 0 if they never are inside."""
    safe = jnp.where(jnp.abs(direction) < 1e-6, 1e-6, direction)
    a, b = (-half - points) / safe, (half - points) / safe
    enter, leave = jnp.max(jnp.minimum(a, b), axis=-1), jnp.min(jnp.maximum(a, b), axis=-1)
    flat = jnp.where(enter < leave, leave, 0.0)
    p, d = points / half, direction / half
    dd, pd, pp = jnp.sum(d * d, axis=-1), jnp.sum(p * d, axis=-1), jnp.sum(p * p, axis=-1)
    square = pd**2 - dd * (pp - 1.0)
    meets = square > 0
    circle = jnp.where(meets, (-pd + jnp.sqrt(jnp.where(meets, square, 1.0))) / dd, 0.0)
    return jnp.maximum(jnp.where(is_round, circle, flat), 0.0)


def _half_extents(scene: Superquadrics, vectors: Float[np.ndarray, "v 2"]) -> Float[Array, "n v"]:
    """How far objects reach from their centres along planar unit vectors, many of them equal [m]."""
    unique, row = np.unique(vectors, axis=0, return_inverse=True)
    return extents(scene, jnp.asarray(np.pad(unique, ((0, 0), (0, 1))).T))[:, row.reshape(-1)]


def object_pushes(
    space: ActionSpace, scene: Superquadrics, prints: Footprints, fresh: Bool[Array, " n"]
) -> tuple[Float[Array, "n v 4 4"], Float[Array, "n v"]]:
    """Gripper poses where pushes start, at `push_gap` from each object, or from the footprint that bounds a body of
    several parts, and their sampling weights.

    The weight is 1 if the first contact is so low that it cannot topple the object, else 0. Computed for `fresh`
    objects only, in the order of `push_starts`.
    """
    shelf, config = space.shelf, space.config
    starts = push_starts(config, space.wrists)
    n, v = scene.capacity, len(starts.yaw)
    rotation = gripper_rotation(jnp.asarray(starts.yaw), jnp.full(v, config.push_tilt, jnp.float32))
    wide = _half_extents(scene, starts.across)
    along = _half_extents(scene, starts.heading)
    place = prints.position[:, None] + (starts.share[None] * wide)[..., None] * starts.across[None]
    place = place + (starts.depth[:, None] * starts.across)[None]
    tall = jnp.broadcast_to((prints.high - shelf.board)[:, None], (n, v))
    height, leverage = contact_height(config, jnp.broadcast_to(prints.round[:, None], (n, v)), along, tall)
    centre = jnp.concatenate([place, (shelf.board + height)[..., None]], axis=-1)
    T = make(jnp.broadcast_to(rotation[None], (n, v, 3, 3)), centre)
    # The pose of hand and fingers does not depend on the wrist's angle.
    begins = np.column_stack([starts.heading, starts.share, starts.depth, starts.yaw])
    _, first, alike = np.unique(begins, axis=0, return_index=True, return_inverse=True)
    headings = starts.heading[first]

    def clear(shared, _, row):
        (shelf, pusher), (body, T, heading) = shared, row
        world = transform(T, pusher)
        level = (world[:, 2] > body.low - config.push_gap) & (world[:, 2] < body.high + config.push_gap)
        local = turned(-body.yaw, world[:, :2] - body.position[None])
        heading = turned(-body.yaw, -heading)
        # The palm may pass close to the object's front; only along the push it keeps the whole gap.
        grown = body.half + PASSING_GAP
        away = _exit_distance(grown[None], body.round, local, jnp.broadcast_to(heading[None], local.shape))
        away = jnp.where(level, away, 0.0)
        farthest = jnp.max(away)
        touching = level & (away > farthest - TOUCH)
        lowest = jnp.min(jnp.where(touching, world[:, 2], jnp.inf))
        return farthest + config.push_gap - PASSING_GAP, lowest - shelf.board

    bodies = jax.tree.map(lambda a: jnp.repeat(a, len(first), axis=0), prints.replace(parts=None))
    rows = (bodies, T[:, first].reshape(-1, 4, 4), np.tile(headings, (n, 1)))
    measured = masked_vmap(clear, jnp.repeat(fresh, len(first)), (shelf, space.tables.pusher), None, rows)
    distance, contact = (a.reshape(n, len(first))[:, alike.reshape(-1)] for a in measured)
    stable = contact <= jnp.maximum(leverage, LOW_CONTACT)
    back = -distance[..., None] * starts.heading[None]
    return T.at[..., :2, 3].add(back), stable.astype(jnp.float32)
