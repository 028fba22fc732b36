"""How near a motion comes to each body, and where: finer than planning needs it, but only where the arm is nearest.

The spheres around cells of the arm's boxes reach up to 11 mm beyond these. Where one of them is nearest to a body, 27
spheres around the parts of its cell take its place, which reach up to 4 mm beyond.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from mechsearch_jax.robot.arm_clearance import (
    ALWAYS,
    FARTHEST,
    FLOOR,
    ITSELF,
    SHELF,
    ArmBody,
    Obstacles,
    body_distance,
    clearance,
    link_poses,
    placed,
    shelf_distance,
)
from mechsearch_jax.robot.free_motion import few_rows

# No point of the arm moves farther between two tested rows: of all, and of those about the nearest one [m].
STEP, FINE_STEP = 0.02, 0.004
# By how much a distance may become larger where it is taken more finely [m].
FINER = 0.012
# Middles of the parts of a cell, in shares of its edges.
_PARTS = np.stack(np.meshgrid(*3 * [np.array([-1.0, 0.0, 1.0]) / 3], indexing="ij"), axis=-1).reshape(-1, 3)


def nearest_rows(body: ArmBody, obstacles: Obstacles, q: Float[np.ndarray, "m 7"]) -> list[tuple[str, float, int]]:
    """The name of each body, how near the arm comes to it [m], at most `FARTHEST`, and in which row.

    Distances are at most 4 mm too small, and too large by no more than what the arm does between two rows. Distances of
    the arm from itself are left out.

    Args:
      body: the arm.
      obstacles: the bodies.
      q: joint angles of the motion's rows, at least one [rad].
    """
    few = few_rows(q, STEP)
    each = clearance(body, obstacles, q[few]).each
    about: list[np.ndarray] = []
    for place, least in zip(each.argmin(axis=0), each.min(axis=0), strict=True):
        if least < FARTHEST:
            first, last = few[max(place - 1, 0)], few[min(place + 1, len(few) - 1)]
            about.append(first + few_rows(q[first : last + 1], FINE_STEP))
    rows = np.unique(np.concatenate([few[:1], *about]))
    each = clearance(body, obstacles, q[rows]).each
    found = []
    for k, name in enumerate(obstacles.names):
        if name == ITSELF:
            continue
        near = np.flatnonzero((each[:, k] < FARTHEST) & (each[:, k] <= each[:, k].min() + FINER))
        row, distance = (0, FARTHEST) if not len(near) else _refined(body, obstacles, k, q[rows[near]])
        found.append((name, float(distance), int(rows[near[row] if len(near) else 0])))
    return found


def _refined(body: ArmBody, obstacles: Obstacles, k: int, q: Float[np.ndarray, "m 7"]) -> tuple[int, float]:
    """In which row the arm is nearest to the body with a number in `Obstacles.names`, and how near [m]."""
    spheres, frames = body.fine, link_poses(q)
    centres = placed(spheres, frames)
    distances = _distance(obstacles, k, centres.reshape(-1, 3)).reshape(centres.shape[:2]) - spheres.radius
    if obstacles.names[k] == FLOOR:
        # The foot and links 1 and 2 stand on it.
        distances[:, spheres.frame < 2] = np.inf
    row, sphere = np.nonzero(distances <= distances.min() + FINER)
    edges = spheres.edges[sphere]
    local = spheres.centre[sphere, None] + np.einsum("nij,pj->npi", edges, _PARTS)
    T = frames[row, spheres.frame[sphere]]
    points = np.einsum("nij,npj->npi", T[:, :3, :3], local) + T[:, None, :3, 3]
    radius = np.where(edges.any(axis=(1, 2)), spheres.radius[sphere] / 3, spheres.radius[sphere])
    finer = _distance(obstacles, k, points.reshape(-1, 3)).reshape(points.shape[:2]).min(axis=1) - radius
    best = int(np.argmin(finer))
    return int(row[best]), min(float(finer[best]), FARTHEST)


def _distance(obstacles: Obstacles, k: int, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Distance of points to the body with a number in `Obstacles.names`, but the arm itself [m]."""
    if obstacles.names[k] == FLOOR:
        return points[:, 2] - obstacles.floor
    if obstacles.names[k] == SHELF:
        return shelf_distance(obstacles.shelf, points)
    return body_distance(obstacles, k - len(ALWAYS), points)
