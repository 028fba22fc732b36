"""Grasps of a compound from the side: where two opposite sides of it are near enough for the fingers to close on.

A closing is a level line between the fingers, across the approach. On lines in several directions, at several heights
and depths, the body's sections that fit between the fingers are candidates. A closing counts where the pads of the
closed fingers meet material that faces them, opposite each other, and where the open gripper touches the body nowhere
on its straight way in.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float, Int

from mechsearch_jax.robot.gripper import Gripper, RobotPart, finger_parts, primitives_in_gripper
from mechsearch_jax.robot.pads import between
from mechsearch_jax.shapes.compound import Compound
from mechsearch_jax.shapes.solid import surface
from mechsearch_jax.shapes.union import Field, field_of

# Directions of the approach over a full turn, and the most closings of a body.
DIRECTIONS, MOST = 24, 16
# Heights of closings, least distance from the body's lowest and highest points, and steps of the depth along the
# approach and along a line [m].
HEIGHTS, FROM_BOTTOM, FROM_TOP, DEPTH, ALONG = 7, 0.012, 0.005, 0.004, 0.001
# Surface this far from where a pad comes to rest touches it [m]; the least share of the pads' lines that do; and the
# largest angles between the closing direction and the surface's normal there, and the line of the forces [rad].
TOUCH, LEAST_CONTACT, FACING = 0.0015, 0.2, math.radians(14)
# Share of the lines that touch beyond which more gain nothing.
ENOUGH = 0.5
# Points of the body's surface that the open gripper must not meet, and how deep they may be in it [m].
BODY_POINTS, SLACK = 1500, 0.0015
# What a closing loses for each metre from the vertical axis through the centre of mass, and from the usual height.
OFF_AXIS, OFF_HEIGHT = 3.0, 3.0
# The angle by which the gripper points down where the pads are tried [rad].
USUAL_TILT = math.radians(25)
# Closings nearer than this in direction [rad] and place [m] are alike.
ALIKE, ALIKE_PLACE = math.radians(10), 0.012


@dataclasses.dataclass(frozen=True, eq=False)
class Closings:
    """Lines on which the fingers close on a body.

    Attributes:
      yaw: direction of the approach, seen from above [rad], shape (c,).
      point: the middle between the fingers, in the body's frame [m], shape (c, 3).
      tilts: indices of the angles by which the gripper may point down, for each.
    """

    yaw: Float[np.ndarray, " c"]
    point: Float[np.ndarray, "c 3"]
    tilts: tuple[tuple[int, ...], ...]


@dataclasses.dataclass(frozen=True, eq=False)
class _Line:
    """A candidate: its yaw [rad], its middle [m], and how good it is."""

    yaw: float
    point: np.ndarray
    score: float


def axes(yaw: float, tilt: float) -> Float[np.ndarray, "3 3"]:
    """The gripper's axes as columns: `grasp_frames.gripper_rotation` of angles [rad], in double precision."""
    c, s, cosine, sine = math.cos(yaw), math.sin(yaw), math.cos(tilt), math.sin(tilt)
    return np.array([[c * sine, s, c * cosine], [s * sine, -c, s * cosine], [cosine, 0.0, -sine]])


def closings(
    compound: Compound, gripper: Gripper, yaws: Sequence[float] | None, tilts: Sequence[float], height: float
) -> Closings:
    """The best different closings on a compound, at most `MOST`.

    Args:
      compound: centred.
      gripper: that grasps.
      yaws: directions of the approach of a solid of revolution [rad]; None for any other body, which is tried in
        `DIRECTIONS` directions.
      tilts: angles by which the gripper points down [rad].
      height: usual height above the centre of mass [m].
    """
    body = surface(compound, BODY_POINTS)
    if yaws is None:
        directions = tuple(2 * math.pi * i / DIRECTIONS for i in range(DIRECTIONS))
        return _chosen(_lines(compound, gripper, directions, height), gripper, body, tilts, MOST)
    angles = tuple(yaws)[:: math.ceil(len(yaws) / MOST)]
    lines = _lines(compound, gripper, (0.0,), height)
    return _turned(_chosen(lines, gripper, body, tilts, max(MOST // len(angles), 1)), angles)


def level_grasps(
    compound: Compound,
    gripper: Gripper,
    yaws: Sequence[float] | None,
    tilts: Sequence[float],
    wrists: int,
    height: float,
) -> tuple[Float[np.ndarray, "g 4 4"], Int[np.ndarray, " g"]]:
    """`T_body_gripper` of the `closings` at the tilts that they allow, each with all of so many angles of joint 7, and
    the index of that angle.

    Args:
      compound, gripper, yaws, tilts, height: as of `closings`.
      wrists: number of angles of joint 7.
    """
    found = closings(compound, gripper, yaws, tilts, height)
    each = [(i, tilt) for i in range(len(found.yaw)) for tilt in found.tilts[i]]
    T = np.tile(np.eye(4), (len(each), 1, 1))
    for pose, (i, tilt) in zip(T, each, strict=True):
        pose[:3, :3], pose[:3, 3] = axes(found.yaw[i], tilts[tilt]), found.point[i]
    return np.repeat(T, wrists, axis=0), np.tile(np.arange(wrists), len(T))


def _turned(single: Closings, angles: Sequence[float]) -> Closings:
    """Closings of yaw 0 about the vertical axis, at each of several angles [rad]."""
    turns = [axes(angle, 0.0)[:, [2, 1, 0]] * [1.0, -1.0, 1.0] for angle in angles]
    return Closings(
        np.repeat(np.array(angles), len(single.yaw)),
        np.concatenate([single.point @ turn.T for turn in turns]),
        single.tilts * len(angles),
    )


@functools.lru_cache(maxsize=32)
def _lines(compound: Compound, gripper: Gripper, angles: tuple[float, ...], height: float) -> tuple[_Line, ...]:
    """All candidates, the best first."""
    field = field_of(compound)
    low, high = _ends(field)
    usual = min(height, 0.6 * high)
    found = []
    for yaw in angles:
        for z in (*np.linspace(low + FROM_BOTTOM, max(high - FROM_TOP, low + FROM_BOTTOM), HEIGHTS), usual):
            found += _at_height(field, gripper, yaw, z, usual)
    return tuple(sorted(found, key=lambda line: -line.score))


def _ends(field: Field) -> tuple[float, float]:
    """The least and the largest height of the body [m]."""
    inside = np.nonzero((field.values < 0.0).any(axis=(0, 1)))[0]
    return tuple(float(field.low[2] + field.step * i) for i in (inside[0], inside[-1]))  # pyright: ignore[reportReturnType]


def _at_height(field: Field, gripper: Gripper, yaw: float, z: float, usual: float) -> Iterator[_Line]:
    """The candidates of a direction [rad] at a height [m]."""
    # Of a level line, whatever the tilt.
    up, across, ahead = axes(yaw, 0.0).T
    reach = float(np.linalg.norm(np.maximum(np.abs(field.low), np.abs(field.high))[:2]))
    depths, lateral = np.arange(-reach, reach, DEPTH), np.arange(-reach, reach, ALONG)
    points = depths[:, None, None] * ahead + lateral[None, :, None] * across + z * up
    material = field.at(points) < 0.0
    places = []
    for row, depth in zip(material, depths, strict=True):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], row, [False]]).astype(int)))
        starts, stops = edges[::2], edges[1::2]
        for i in range(len(starts)):
            for j in range(i, len(starts)):
                first, last = lateral[starts[i]], lateral[stops[j] - 1]
                if last - first <= gripper.usable_opening:
                    places.append(depth * ahead + 0.5 * (first + last) * across + z * up)
    if not places:
        return
    R = np.broadcast_to(axes(yaw, USUAL_TILT), (len(places), 3, 3))
    for centre, share in zip(*held(field, gripper, R, np.stack(places)), strict=True):
        if share > 0.0:
            off_axis, off_height = float(np.linalg.norm(centre[:2])), abs(float(centre[2]) - usual)
            yield _Line(yaw, centre, min(float(share), ENOUGH) - OFF_AXIS * off_axis - OFF_HEIGHT * off_height)


def held(
    field: Field,
    gripper: Gripper,
    R_body_gripper: Float[np.ndarray, "k 3 3"],
    point: Float[np.ndarray, "k 3"],
    askew: float = FACING,
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, " k"]]:
    """Where the middle between the closed pads is [m], and which share of the pads' lines touches the body.

    Args:
      field: of the body.
      gripper: that grasps.
      R_body_gripper: how it is turned.
      point: the middle between the open fingers [m].
      askew: largest angles between the closing direction and the surface's normal, and the line of the forces [rad].

    Returns:
      The share is 0 where the fingers do not hold.
    """
    across = R_body_gripper[:, :, 1]
    ends, starts = between(field, R_body_gripper, point, gripper.max_opening)
    missing = np.isnan(ends)
    rest = np.stack(
        [np.where(missing, np.inf, ends).min(axis=1)[:, 0], np.where(missing, -np.inf, ends).max(axis=1)[:, 1]], 1
    )
    touching = np.abs(ends - rest[:, None]) < TOUCH
    share = touching.mean(axis=1).min(axis=1)
    share[(rest[:, 1] - rest[:, 0] > gripper.usable_opening) | (share < LEAST_CONTACT)] = 0.0
    holding = np.flatnonzero(share)
    across, touching = across[holding], touching[holding]
    places = starts[holding, :, None] + ends[holding, ..., None] * across[:, None, None]
    outward = np.array([-1.0, 1.0])[:, None] * across[:, None]
    facing = np.einsum("klsi,ksi->kls", field.slope(places + 0.001 * outward[:, None]), outward)
    force = np.diff(np.nanmean(np.where(touching[..., None], places, np.nan), axis=1), axis=1)[:, 0]
    fails = np.nanmedian(np.where(touching, facing, np.nan), axis=1).min(axis=1) < math.cos(askew)
    fails |= np.sum(force * across, axis=1) < math.cos(askew) * np.linalg.norm(force, axis=1)
    share[holding[fails]] = 0.0
    middle = np.zeros(len(share))
    middle[holding] = rest[holding].sum(axis=1) / 2
    return point + middle[:, None] * R_body_gripper[:, :, 1], share


def _chosen(
    lines: Sequence[_Line], gripper: Gripper, body: Float[np.ndarray, "n 3"], tilts: Sequence[float], most: int
) -> Closings:
    """The best lines that differ, and that the open gripper reaches at some tilt; every direction has its turn."""
    chosen: list[_Line] = []
    allowed: list[tuple[int, ...]] = []
    hand = OpenHand.of(gripper)
    left = list(lines)
    used: dict[float, int] = {}
    while left and len(chosen) < most:
        # The direction with the fewest closings is served first, by its best line.
        line = min(left, key=lambda line: (used.get(line.yaw, 0) + _crowd(line, chosen), -line.score))
        left.remove(line)
        if any(_alike(line, other) for other in chosen):
            continue
        free = tuple(i for i, tilt in enumerate(tilts) if hand.too_deep(body, axes(line.yaw, tilt), line.point) == 0.0)
        if free:
            chosen.append(line)
            allowed.append(free)
            used[line.yaw] = used.get(line.yaw, 0) + 1
    return Closings(
        np.array([line.yaw for line in chosen]),
        np.array([line.point for line in chosen]).reshape(-1, 3),
        tuple(allowed),
    )


def _crowd(line: _Line, chosen: list[_Line]) -> int:
    """Number of chosen lines of nearly the same direction."""
    return sum(math.cos(line.yaw - other.yaw) > math.cos(math.radians(20)) for other in chosen)


def _alike(a: _Line, b: _Line) -> bool:
    near = float(np.linalg.norm(a.point - b.point)) < ALIKE_PLACE
    return near and math.cos(a.yaw - b.yaw) > math.cos(ALIKE)


@dataclasses.dataclass(frozen=True, eq=False)
class OpenHand:
    """Boxes in or around the hand's and the open fingers' primitives.

    Links 6 and 7 are behind the hand, beyond the reach of a body between the fingers.

    Attributes:
      half: their half-extents [m], shape (b, 3).
      origin, axes: their centres [m], shape (b, 3), and axes as columns, shape (b, 3, 3), in the gripper's frame.
    """

    half: Float[np.ndarray, "b 3"]
    origin: Float[np.ndarray, "b 3"]
    axes: Float[np.ndarray, "b 3 3"]

    @classmethod
    def of(cls, gripper: Gripper) -> OpenHand:
        """The boxes of a gripper, a little smaller than its parts."""
        count = 5 + 2 * len(finger_parts())
        parts: Sequence[RobotPart] = primitives_in_gripper(gripper, gripper.max_opening, 0.0)[:count]
        T = np.stack([part.T_frame_primitive for part in parts])
        return cls(np.maximum(np.array([part.size for part in parts]) - SLACK, 1e-3), T[:, :3, 3], T[:, :3, :3])

    @property
    def corners(self) -> Float[np.ndarray, "c 3"]:
        """Corners of the boxes in the gripper's frame [m]."""
        signs = np.stack(np.meshgrid(*3 * [[-1.0, 1.0]], indexing="ij"), axis=-1).reshape(-1, 3)
        return (self.origin[:, None] + (signs * self.half[:, None]) @ np.swapaxes(self.axes, 1, 2)).reshape(-1, 3)

    def too_deep(
        self, body: Float[np.ndarray, "n 3"], R_body_gripper: Float[np.ndarray, "3 3"], point: Float[np.ndarray, " 3"]
    ) -> float:
        """How far the open hand must stop short of a point so that it meets the body nowhere on its straight way in.

        The way of each surface point, seen from the gripper, ends at it and begins far ahead of it.

        Args:
          body: points on its surface [m].
          R_body_gripper, point: where the gripper closes [m].

        Returns:
          the distance [m], 0 if it need not.
        """
        turned = (body - point) @ R_body_gripper @ np.concatenate(list(self.axes), axis=1)
        seen = turned.reshape(-1, len(self.half), 3) - np.einsum("bi,bij->bj", self.origin, self.axes)
        along = self.axes[:, 2]
        step = 1.0 / np.where(np.abs(along) < 1e-9, 1e-9, along)
        middle, wide = -seen * step, self.half * np.abs(step)
        near, far = (middle - wide).max(axis=2), (middle + wide).min(axis=2)
        # The point's way relative to the gripper: from far ahead (+z) down to where it is.
        return max(float(np.max(far, where=near <= far, initial=0.0)), 0.0)
