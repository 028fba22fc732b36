"""Candidate grasps of objects: from the side, with the fingers closing horizontally (paper B.5)."""

from __future__ import annotations

import dataclasses
import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.geometry.footprints import QUARTER_TURN, Footprints, in_world
from mechsearch_jax.geometry.transforms import make
from mechsearch_jax.robot.grasp_frames import gripper_rotation
from mechsearch_jax.robot.gripper import Gripper
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.shelf import Shelf

# Least distance of the palm from an object's front, and of the finger tips' centres from the board [m].
PASSING_GAP = 0.003
LOWEST = 0.025
# Distance of the palm's flat front behind the finger tips' centres; the palm also extends as far above them [m].
PALM = 0.033
# From the back of the shelf no hand comes [rad].
LARGEST_YAW = math.pi / 2 + 1e-3


@dataclasses.dataclass(frozen=True)
class BoxGrasp:
    """A side grasp of an object with flat sides.

    Attributes:
      face: the side that the gripper approaches: 0 is the most square to +x, 1 the next. Sides that do not fit between
        the fingers, or whose normal is farther from +x than `ObjectGraspConfig.max_yaw`, come last.
      turn: angle of the approach from square to that side, as a share of the largest possible one; positive towards +x.
        The object turns in the hand as the fingers close.
      drop: distance of the grasp below the object's top [m].
      reach: how far the fingers reach past its front, as a share of the largest reach that the palm allows.
    """

    face: int = 0
    turn: float = 0.0
    drop: float = 0.03
    reach: float = 1.0

    def __post_init__(self):
        if self.face not in range(4) or not (-1 <= self.turn <= 1 and 0 < self.reach <= 1 and self.drop > 0):
            raise InputError(f"{self}: face must be 0 to 3, turn in -1 to 1, reach in 0 to 1, drop above 0 m")


@dataclasses.dataclass(frozen=True)
class ObjectGraspConfig:
    """How objects are grasped.

    Attributes:
      boxes: grasps of an object with flat sides.
      round_drops: distances of the grasp below a round object's top, used in turn over its approach directions, of
        which there are as many as `boxes` [m].
      tilts: angles by which the gripper points downwards [rad].
      max_yaw: largest angle between the approach to a flat side and +x [rad]. A box that stands across at a wall can
        often be grasped from its free narrow side alone, with a level hand.
      max_turn: largest angle between the approach and the normal of the grasped side [rad].
      min_turn: smaller angles are treated as square [rad].
      turn_gap: least free part of the opening when the approach is turned [m].
    """

    boxes: tuple[BoxGrasp, ...] = (
        BoxGrasp(drop=0.02),
        BoxGrasp(reach=0.7),
        BoxGrasp(drop=0.045, reach=0.7),
        BoxGrasp(turn=0.5),
        BoxGrasp(turn=1.0, drop=0.02),
        BoxGrasp(turn=1.0),
        BoxGrasp(turn=-1.0),
        BoxGrasp(face=1, turn=0.5),
        BoxGrasp(face=1, turn=1.0),
    )
    round_drops: tuple[float, ...] = (0.03, 0.04)
    tilts: tuple[float, ...] = (math.radians(10), math.radians(20), math.radians(30))
    max_yaw: float = math.radians(90)
    max_turn: float = math.radians(22)
    min_turn: float = math.radians(5)
    turn_gap: float = 0.004

    def __post_init__(self):
        if not (self.boxes and self.round_drops and self.tilts):
            raise InputError("ObjectGraspConfig: boxes, round_drops and tilts must each have at least one entry")
        if not 0.0 < self.max_yaw <= LARGEST_YAW:
            raise InputError(
                f"ObjectGraspConfig: max_yaw {self.max_yaw} rad must be above 0 and at most {LARGEST_YAW:.4f}"
            )


def grasp_variants(config: ObjectGraspConfig, wrists: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Index in `boxes`, index of the wrist and tilt [rad] of each candidate grasp, each of shape (A,)."""
    grid = np.meshgrid(np.arange(len(config.boxes)), config.tilts, np.arange(wrists), indexing="ij")
    box, tilt, wrist = (g.reshape(-1) for g in grid)
    return box, wrist, tilt.astype(np.float32)


def _largest_turn(width: Array, depth: Array, opening: float, config: ObjectGraspConfig) -> Array:
    """Largest angle of the approach from square at which an object of these half-extents fits in the hand [rad]."""
    radius = jnp.sqrt(width**2 + depth**2)
    half_opening = 0.5 * (opening - config.turn_gap)
    wide = radius > half_opening
    room = jnp.arcsin(jnp.where(wide, half_opening / radius, 0.0)) - jnp.arctan2(width, depth)
    return jnp.where(wide, jnp.clip(room, 0.0, config.max_turn), config.max_turn)


def object_grasps(
    shelf: Shelf,
    gripper: Gripper,
    prints: Footprints,
    config: ObjectGraspConfig,
    max_yaw: float,
    wrists: int,
    above: Float[Array, " n"] | None = None,
) -> tuple[Float[Array, "n a 4 4"], Bool[Array, "n a"]]:
    """Side grasps of objects that stand or lie on the board or on each other.

    Round objects are grasped through their axis from directions spread over `max_yaw`, others by `config.boxes`. A body
    of several parts is grasped by those that fit between the fingers, in turns.

    Args:
      shelf: the shelf.
      gripper: the gripper.
      prints: the objects seen from above, leading axis N.
      config: static.
      max_yaw: largest angle between the approach to a round object and +x [rad]; for flat sides see `config`.
      wrists: number of angles of joint 7.
      above: how far above the board each stands [m]; None for on it.

    Returns:
      Gripper poses in the world, in the order of `grasp_variants`, and whether the object fits between the fingers.
    """
    if prints.parts is not None:
        above = None if above is None else jnp.repeat(above, prints.parts.valid.shape[1])
        of_parts = object_grasps(shelf, gripper, in_world(prints), config, max_yaw, wrists, above)
        return _by_turns(prints, *of_parts, grasp_variants(config, wrists)[0])
    box, _, tilt = grasp_variants(config, wrists)
    n, a, count = prints.yaw.shape[0], len(box), len(config.boxes)
    is_round = prints.round[:, None]
    rank, share, box_drop, box_reach = np.array([dataclasses.astuple(b) for b in config.boxes], np.float32)[box].T

    faces = prints.yaw[:, None] + QUARTER_TURN * jnp.arange(4)[None]
    faces = jnp.arctan2(jnp.sin(faces), jnp.cos(faces))
    suits = jnp.tile(2 * prints.half[:, ::-1] <= gripper.usable_opening, 2) & (jnp.abs(faces) <= config.max_yaw)
    by_yaw = jnp.argsort(jnp.abs(faces) + jnp.where(suits, 0.0, 2 * jnp.pi), axis=1)
    face = jnp.take_along_axis(by_yaw, jnp.broadcast_to(rank.astype(np.int32)[None], (n, a)), axis=1)
    square = jnp.take_along_axis(faces, face, axis=1)
    depth = jnp.where(face % 2 == 0, prints.half[:, :1], prints.half[:, 1:])
    width = jnp.where(face % 2 == 0, prints.half[:, 1:], prints.half[:, :1])
    turn = share[None] * _largest_turn(width, depth, gripper.usable_opening, config)
    directions = np.linspace(-max_yaw, max_yaw, count) if count > 1 else np.zeros(1)
    yaw = jnp.where(is_round, jnp.float32(directions[box])[None], square - jnp.where(square < 0, -turn, turn))
    fits = (2 * width <= gripper.usable_opening) & (jnp.abs(yaw) <= jnp.where(is_round, max_yaw, config.max_yaw) + 1e-3)
    fits &= is_round | (share == 0.0)[None] | (jnp.abs(turn) > config.min_turn)
    front = jnp.where(is_round, depth, depth * jnp.cos(turn) + width * jnp.abs(jnp.sin(turn)))

    round_drop = np.asarray(config.round_drops, np.float32)[box % len(config.round_drops)]
    drop = jnp.where(is_round, round_drop[None], box_drop[None])
    lowest = shelf.board + LOWEST + (0.0 if above is None else above[:, None])
    z = jnp.maximum(prints.high[:, None] - drop, lowest)
    # The palm must not hit the object: its front, or its top edge if the palm reaches that high.
    c, t = np.cos(tilt), np.tan(tilt)
    above = jnp.clip(prints.high[:, None] - z, 0.0, jnp.float32(PALM * np.sin(tilt) + PALM * c)[None])
    reach = jnp.float32(PALM / c)[None] - above * jnp.float32(t)[None] - PASSING_GAP
    reach = jnp.where(is_round, jnp.maximum(reach, 0.0), reach * box_reach[None])
    offset = jnp.maximum(front - reach, 0.0)
    x = prints.position[:, None, 0] - offset * jnp.cos(yaw)
    y = prints.position[:, None, 1] - offset * jnp.sin(yaw)
    rotation = gripper_rotation(yaw, jnp.broadcast_to(jnp.asarray(tilt)[None], (n, a)))
    return make(rotation, jnp.stack([x, y, z], axis=-1)), fits & prints.valid[:, None]


def _by_turns(
    prints: Footprints, T: Float[Array, "parts a 4 4"], fits: Bool[Array, "parts a"], box: Int[np.ndarray, " a"]
) -> tuple[Float[Array, "n a 4 4"], Bool[Array, "n a"]]:
    """Of the grasps of all parts, those of each body: every variant is one of a part that it fits, the largest first.

    Args:
      prints: the bodies, with parts.
      T, fits: of `object_grasps` for all parts.
      box: index of each variant in `ObjectGraspConfig.boxes`, over which the parts take turns.
    """
    parts = prints.parts
    assert parts is not None
    n, p = parts.valid.shape
    T, fits = T.reshape(n, p, *T.shape[1:]), fits.reshape(n, p, -1)
    volume = jnp.where(parts.valid, parts.half[..., 0] * parts.half[..., 1] * (parts.high - parts.low), 0.0)
    rank = jnp.sum((volume[:, None] > volume[:, :, None]) & parts.valid[:, None], axis=-1)
    count = jnp.maximum(jnp.sum(parts.valid, axis=1), 1)
    turn = (rank[..., None] - box[None, None]) % count[:, None, None]
    part = jnp.argmin(jnp.where(fits, turn, p), axis=1)[:, None]
    chosen = jnp.take_along_axis(T, part[..., None, None], axis=1)[:, 0]
    return chosen, jnp.take_along_axis(fits, part, axis=1)[:, 0]
