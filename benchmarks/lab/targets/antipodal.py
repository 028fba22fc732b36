"""Antipodal grasps of a mesh, drawn from its surface alone: nothing here knows how the planner finds grasps.

A point of the surface is drawn by area. The line through it along the inward normal leaves the body on the other side,
perhaps more than once, as where it crosses both walls of a cup; one of these places is drawn. Both surfaces must face
the line within the friction cone. The approach is drawn about the line.
"""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

if TYPE_CHECKING:
    import trimesh

# Rays that are cut with all triangles at a time, and how far from a surface they begin [m].
RAYS, OFF = 64, 1e-5
# Points that are drawn at a time, and how often at most.
POINTS, ROUNDS = 1000, 20
# Angles about the closing axis of which the first that the arm may have is taken.
ANGLES = 64


@dataclasses.dataclass(frozen=True)
class Approaches:
    """The approaches that are drawn [rad].

    Attributes:
      max_yaw: largest angle to +x, seen from above.
      tilts: least and largest angle by which the gripper points down.
    """

    max_yaw: float = math.radians(45)
    tilts: tuple[float, float] = (0.0, math.radians(60))


@dataclasses.dataclass(frozen=True, eq=False)
class Lines:
    """Lines on which two fingers close, in the mesh's frame.

    Attributes:
      middle: the middle between the two places of contact [m], shape (k, 3).
      axis: direction of the line, shape (k, 3).
      width: distance between the places [m], shape (k,).
    """

    middle: Float[np.ndarray, "k 3"]
    axis: Float[np.ndarray, "k 3"]
    width: Float[np.ndarray, " k"]


@dataclasses.dataclass(frozen=True, eq=False)
class Crossings:
    """Where rays cross a surface.

    Attributes:
      ray, face: which ray, in ascending order, crosses which triangle, shape (h,).
      distance: from the ray's origin [m], ascending for each ray, shape (h,).
      leaves: 1 where the ray leaves the triangle's solid, -1 where it enters it, shape (h,).
    """

    ray: Int[np.ndarray, " h"]
    face: Int[np.ndarray, " h"]
    distance: Float[np.ndarray, " h"]
    leaves: Int[np.ndarray, " h"]


def crossings(
    triangles: Float[np.ndarray, "t 3 3"], origin: Float[np.ndarray, "n 3"], direction: Float[np.ndarray, "n 3"]
) -> Crossings:
    """All crossings of rays with triangles (Moeller and Trumbore, 1997).

    `trimesh` needs a spatial index that is not installed with it, and returns no order.
    """
    corner, first, second = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    parts = []
    for start in range(0, len(origin), RAYS):
        o, d = origin[start : start + RAYS, None], direction[start : start + RAYS, None]
        across = np.cross(d, second[None])
        volume = np.einsum("rti,ti->rt", across, first)
        inverse = 1.0 / np.where(np.abs(volume) < 1e-14, np.inf, volume)
        apart = o - corner[None]
        u = np.einsum("rti,rti->rt", apart, across) * inverse
        turned = np.cross(apart, first[None])
        v = np.sum(d * turned, axis=-1) * inverse
        t = np.einsum("rti,ti->rt", turned, second) * inverse
        ray, face = np.nonzero((inverse != 0.0) & (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (t > 0.0))
        order = np.lexsort((t[ray, face], ray))
        ray, face = ray[order], face[order]
        # The volume is negative where the ray runs along the triangle's normal.
        parts.append((start + ray, face, t[ray, face], np.where(volume[ray, face] < 0.0, 1, -1)))
    return Crossings(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def lines(mesh: trimesh.Trimesh, count: int, widest: float, cone: float, rng: np.random.Generator) -> Lines:
    """At most `count` lines between opposite places of a surface, fewer where few of its points have one.

    Shells that overlap are one body: only their outer surface counts.

    Args:
      mesh: closed, or made of closed shells [m].
      count: number of lines.
      widest: largest width [m].
      cone: largest angle between the line and either normal [rad].
      rng: draws.
    """
    import trimesh

    parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    found = 0
    for _ in range(ROUNDS):
        points, faces = trimesh.sample.sample_surface(mesh, POINTS, seed=int(rng.integers(2**31)))[:2]
        normals = np.asarray(mesh.face_normals)[faces]
        parts.append(_across(mesh, np.asarray(points), normals, widest, cone, rng))
        found += len(parts[-1][2])
        if found >= count:
            break
    middle, axis, width = (np.concatenate(columns)[:count] for columns in zip(*parts, strict=True))
    return Lines(middle, axis, width)


def _across(
    mesh: trimesh.Trimesh,
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    widest: float,
    cone: float,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`Lines` of points on the surface: middle, axis and width."""
    triangles, count = np.asarray(mesh.triangles), len(points)
    outward = crossings(triangles, points + OFF * normals, normals)
    inside = np.bincount(outward.ray, outward.leaves, count)
    inward = crossings(triangles, points - OFF * normals, -normals)
    # Number of shells around a ray behind each crossing: what it leaves later less what it enters.
    total = np.bincount(inward.ray, inward.leaves, count)
    passed = np.cumsum(inward.leaves)
    before = np.concatenate([[0], passed])[np.searchsorted(inward.ray, inward.ray)]
    around = total[inward.ray] - (passed - before)
    facing = np.einsum("hi,hi->h", np.asarray(mesh.face_normals)[inward.face], -normals[inward.ray])
    width = inward.distance + OFF
    good = (inside[inward.ray] == 0) & (around == 0) & (inward.leaves == 1)
    good &= (facing >= math.cos(cone)) & (width <= widest)
    places = np.flatnonzero(good)
    places = places[rng.permutation(len(places))]
    # The first of each ray, in random order.
    rays, first = np.unique(inward.ray[places], return_index=True)
    order = rng.permutation(len(rays))
    rays, chosen = rays[order], width[places[first]][order]
    return points[rays] - 0.5 * chosen[:, None] * normals[rays], -normals[rays], chosen


def gripper_poses(
    found: Lines, T_world_mesh: Float[np.ndarray, "4 4"], allowed: Approaches, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "g 4 4"], Int[np.ndarray, " g"]]:
    """`T_world_gripper` that closes on lines, each from a random one of the allowed approaches, and which line it is.

    Lines about which no drawn approach is allowed are left out. Of the two ways to hold the fingers the one is taken
    in which the gripper's x points up, as in the home configuration.
    """
    axis = found.axis @ T_world_mesh[:3, :3].T
    helper = np.where(np.abs(axis[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    u = np.cross(axis, helper)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(axis, u)
    angle = rng.uniform(-math.pi, math.pi, (len(axis), ANGLES))
    z = np.cos(angle)[..., None] * u[:, None] + np.sin(angle)[..., None] * v[:, None]
    yaw, tilt = np.arctan2(z[..., 1], z[..., 0]), np.arcsin(np.clip(-z[..., 2], -1.0, 1.0))
    good = (np.abs(yaw) <= allowed.max_yaw) & (tilt >= allowed.tilts[0]) & (tilt <= allowed.tilts[1])
    rows = np.flatnonzero(good.any(axis=1))
    ahead, y = z[rows, good[rows].argmax(axis=1)], axis[rows]
    y = np.where(np.cross(y, ahead)[:, 2:] < 0.0, -y, y)
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, :3] = np.stack([np.cross(y, ahead), y, ahead], axis=-1)
    T[:, :3, 3] = found.middle[rows] @ T_world_mesh[:3, :3].T + T_world_mesh[:3, 3]
    return T, rows
