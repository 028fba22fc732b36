"""What recognised bodies are worth by the labels of a depth image. No true pose is known: how a thing stands is told
from its points."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.optimize import least_squares, linear_sum_assignment
from scipy.spatial import KDTree

from mechsearch_jax.benchmarks.real.scenes import LabelledScene
from mechsearch_jax.geometry import superquadric
from mechsearch_jax.geometry.bodies import world_parts
from mechsearch_jax.geometry.superquadric import ROUND_EXPONENT, Superquadrics
from mechsearch_jax.images.cloud import above_board
from mechsearch_jax.observation import Observation
from mechsearch_jax.runtime.own_settings import in_own_settings
from mechsearch_jax.workspace.camera import Camera, back_project, rays
from mechsearch_jax.workspace.render import object_depth
from mechsearch_jax.workspace.shelf import Shelf

# Things with fewer measured pixels in the workspace do not count; it begins so far below the board [m].
PIXELS, BELOW = 200, 0.01
# A ray passes through a body that it enters so far before the measured point, and shows one that it enters up to so far
# behind it [m].
AHEAD, BEHIND = 0.01, 0.015
# Intersections over union of what is matched, and well.
MATCHED, WELL = 0.5, 0.75
# A thing is split if two bodies show so much of it each, and mostly it; a body merges two of which it shows so much.
SPLIT, MERGED = 0.2, 0.4
# A thing's foot is hidden if so much of its lower edge borders, within so many pixels, on what is so much nearer [m].
HIDDEN, BORDER, NEARER = 0.3, 10, 0.015
# Of each thing so many points are compared with surfaces, of which points are six squares of such sides.
SAMPLE, GRID = 2500, 128


@dataclasses.dataclass(frozen=True)
class Thing:
    """What became of a labelled thing; lengths in metres, heights above the board.

    Attributes:
      number: in the mask.
      low: the height that 1% of its points are below.
      foot: whether its foot is in sight.
      on_upright: share of its points within 5 mm of the upright box or cylinder that fits it best.
      split: whether several bodies show it.
      body: the slot of its body: of its mask, or of the pairs with the largest sum of `iou`; None without one.
      iou: intersection over union of its pixels and those that show its body.
      median, p90: distance of its points from the body's surface; as all below None if it is not matched.
      passed: share of the measured rays to the body that pass through it.
      bottom: height of the body's lowest point.
      tilt: of the body's axis from the vertical, or of the nearest axis unless both are round [degrees].
    """

    number: int
    low: float
    foot: bool
    on_upright: float
    split: bool
    body: int | None = None
    iou: float = 0.0
    median: float | None = None
    p90: float | None = None
    passed: float | None = None
    bottom: float | None = None
    tilt: float | None = None


@dataclasses.dataclass(frozen=True)
class Body:
    """A recognised body.

    Attributes:
      slot: of the observation.
      confidence: as recognition says.
      thing: that it is matched with; None if with none.
      phantom: whether most of its pixels show no thing.
      merges: whether it shows several things.
    """

    slot: int
    confidence: float
    thing: int | None
    phantom: bool
    merges: bool


@in_own_settings
def scored(
    scene: LabelledScene, camera: Camera, shelf: Shelf, observation: Observation, own: Mapping[int, int] | None = None
) -> tuple[list[Thing], list[Body]]:
    """What an observation of a scene is worth.

    Args:
      scene: with its labels.
      camera, shelf: its `workspace`.
      observation: of its images.
      own: the slot of each thing, by its number, if they are those of a mask; else they are matched by pixels.
    """
    points, way = (np.asarray(a, float) for a in _cloud(camera, jnp.asarray(scene.depth)))
    lower = dataclasses.replace(shelf, board=shelf.board - BELOW)
    space = np.asarray(above_board(lower, jnp.asarray(points, jnp.float32), 0.0))
    numbers, pixels = np.unique(scene.mask[space & (scene.mask >= 0)], return_counts=True)
    numbers = numbers[pixels >= PIXELS]
    slots = np.flatnonzero(np.asarray(observation.objects.valid))
    bodies = [jax.tree.map(lambda a, k=k: jnp.asarray(np.asarray(a)[k : k + 1]), observation.objects) for k in slots]
    enter = np.asarray(_depths(camera, observation.objects))[slots]
    early = (scene.depth - enter) * np.linalg.norm(way, axis=-1) > AHEAD

    # Each body where it is the first, and nothing measured hides it.
    first = enter.min(axis=0, initial=np.inf)
    seen = np.where(space & (first < scene.depth + BEHIND), np.argmin([*enter, first], axis=0), -1)
    masks = [space & (scene.mask == number) for number in numbers]
    both = np.array([np.bincount(seen[mask] + 1, minlength=len(slots) + 1)[1:] for mask in masks])
    both = both.reshape(len(numbers), len(slots))
    of_thing, of_body = pixels[pixels >= PIXELS][:, None], np.bincount(seen.ravel() + 1, minlength=len(slots) + 1)[1:]
    iou, shown, owned = both / np.maximum(of_thing + of_body - both, 1), both / of_thing, both / np.maximum(of_body, 1)
    split = ((shown >= SPLIT) & (owned >= 0.5)).sum(axis=1) >= 2
    if own is None:
        match = {i: j for i, j in zip(*linear_sum_assignment(-iou), strict=True) if iou[i, j] > 0}
    else:
        places = {slot: j for j, slot in enumerate(slots.tolist())}
        match = {i: places[own[k]] for i, k in enumerate(numbers.tolist()) if own.get(k) in places}

    things = []
    for i, (number, mask) in enumerate(zip(numbers.tolist(), masks, strict=True)):
        low = float(np.percentile(points[mask][:, 2], 1)) - shelf.board
        cloud = np.random.default_rng(number).permutation(points[mask])[:SAMPLE]
        is_round, on_upright = upright_fit(cloud - [0.0, 0.0, shelf.board])
        thing = Thing(number, low, foot_in_sight(mask, scene.depth), on_upright, bool(split[i]))
        if (j := match.get(i)) is not None:
            thing = dataclasses.replace(thing, body=int(slots[j]), iou=float(iou[i, j]))
            if own is not None or thing.iou >= MATCHED:
                median, p90 = np.percentile(distances(bodies[j], cloud), (50, 90)).tolist()
                hit = space & np.isfinite(enter[j])
                passed = float((hit & early[j]).sum() / max(hit.sum(), 1))
                stands = {"bottom": bottom(bodies[j]) - shelf.board, "tilt": tilt(bodies[j], is_round)}
                thing = dataclasses.replace(thing, median=median, p90=p90, passed=passed, **stands)
        things.append(thing)

    matched = {thing.body: thing.number for thing in things if thing.iou >= MATCHED}
    phantom = (of_body > 0) & (owned.sum(axis=0) < 0.5)
    merges = (shown >= MERGED).sum(axis=0) >= 2
    sure = np.asarray(observation.judged().confidence, float)[slots]
    columns = (a.tolist() for a in (slots, sure, phantom, merges))
    return things, [
        Body(slot, confidence, matched.get(slot), alone and slot not in matched, several)
        for slot, confidence, alone, several in zip(*columns, strict=True)
    ]


@jax.jit
def _cloud(camera: Camera, depth: Float[Array, "h w"]) -> tuple[Float[Array, "h w 3"], Float[Array, "h w 3"]]:
    """The point of each pixel, NaN where nothing was measured, and its ray."""
    return back_project(camera, jnp.where(depth > 0, depth, jnp.nan)), rays(camera)


@jax.jit
def _depths(camera: Camera, objects: Superquadrics) -> Float[Array, "n h w"]:
    """Where the ray of each pixel enters each body, along the camera's axis [m]; infinite for a miss."""
    origin, directions = jnp.array(camera.position), rays(camera)
    return jax.lax.map(lambda body: object_depth(body, origin, directions), objects)


def distances(body: Superquadrics, points: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, " p"]:
    """Distances of world points from the surface of one body, fields (1, ...), the nearest of its parts' [m].

    From the tangent plane at the nearest of many points of the surface; beyond an edge from that point.
    """
    u, v = (a.ravel() for a in np.meshgrid(*[np.linspace(-1.0, 1.0, GRID)] * 2))
    faces = [np.insert(np.stack([u, v], axis=1), axis, side, axis=1) for axis in range(3) for side in (-1.0, 1.0)]
    parts, best = world_parts(body), np.full(len(points), np.inf)
    surfaces = _surface(parts, jnp.asarray(np.concatenate(faces), jnp.float32))
    for surface, normal, valid in zip(*(np.asarray(a) for a in (*surfaces, parts.valid)), strict=True):
        straight, nearest = KDTree(surface).query(points)
        along = np.abs(np.sum((points - surface[nearest]) * normal[nearest], axis=1))
        beside = np.sqrt(np.maximum(straight**2 - along**2, 0.0))
        near = beside < np.ptp(surface, axis=0).max() / GRID
        best = np.minimum(best, np.where(near, along, straight)) if valid else best
    return best


@jax.jit
def _surface(
    parts: Superquadrics, cube: Float[Array, "points 3"]
) -> tuple[Float[Array, "n points 3"], Float[Array, "n points 3"]]:
    """Points of each superquadric's surface in the directions of a cube's points, and the normals, in the world."""

    def one(part):
        surface = jax.vmap(superquadric.towards, (None, None, 0))(part.size, part.exponents, cube)
        slope = jax.vmap(jax.grad(lambda point: superquadric.gauge(part.size, part.exponents, point)))(surface)
        normal = slope / jnp.linalg.norm(slope, axis=-1, keepdims=True)
        return surface @ part.rotation.T + part.position[None], normal @ part.rotation.T

    return jax.vmap(one)(parts)


def bottom(body: Superquadrics) -> float:
    """z of the lowest point of one body, fields (1, ...) [m]."""
    parts = world_parts(body)
    reach = superquadric.support(parts.size, parts.exponents, parts.rotation[:, 2, :])
    return float(np.min(np.asarray(parts.position[:, 2] - reach)[np.asarray(parts.valid)]))


def tilt(body: Superquadrics, is_round: bool) -> float:
    """`Thing.tilt` by one body, fields (1, ...), of a thing that is round or not."""
    upright = np.abs(np.asarray(body.rotation[0, 2], float))
    its_own = is_round and body.exponents[0, 1] > ROUND_EXPONENT
    return float(np.degrees(np.arccos(min(upright[2] if its_own else upright.max(), 1.0))))


def upright_fit(points: Float[np.ndarray, "p 3"]) -> tuple[bool, float]:
    """Whether an upright cylinder on the board fits points better than a box, and the share of them within 5 mm of it.

    Args:
      points: above the board [m].
    """
    level, height = points[:, :2], points[:, 2]
    ends = np.minimum(np.abs(height), np.abs(height - np.percentile(height, 99.5)))
    gaps = []
    for angle in np.linspace(0.0, np.pi / 2, 30, endpoint=False):
        along = level @ np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        sides = np.percentile(along, (0.5, 99.5), axis=0)
        gaps.append(np.minimum(ends, np.abs(along[:, None] - sides[None]).min(axis=(1, 2))))
    box = min(gaps, key=lambda gap: float(np.minimum(gap, 0.01).mean()))
    side = level[ends > 0.006] if (ends > 0.006).sum() > 50 else level
    # From the circle of least squares, which has a closed form, to one that outliers do not pull.
    x, y, rest = np.linalg.lstsq(np.c_[2 * side, np.ones(len(side))], (side**2).sum(axis=1))[0]
    gap = lambda circle: np.hypot(*(side - circle[:2]).T) - circle[2]  # noqa: E731
    start = (x, y, np.sqrt(max(rest + x * x + y * y, 1e-6)))
    x, y, radius = least_squares(gap, start, loss="soft_l1", f_scale=0.003, max_nfev=50).x
    tube = np.minimum(ends, np.abs(np.hypot(*(level - (x, y)).T) - radius))
    is_round = bool(0.01 < radius < 0.2 and np.minimum(tube, 0.02).mean() < np.minimum(box, 0.02).mean())
    return is_round, float(((tube if is_round else box) < 0.005).mean())


def foot_in_sight(mask: Bool[np.ndarray, "h w"], depth: Float[np.ndarray, "h w"]) -> bool:
    """Whether little of a thing's lower edge borders on what is nearer, or on the end of the image."""
    columns = np.flatnonzero(mask.any(axis=0))
    lowest = len(mask) - 1 - np.argmax(mask[::-1, columns], axis=0)
    below = depth[np.minimum(lowest[None] + np.arange(1, BORDER)[:, None], len(mask) - 1), columns]
    next_one = np.take_along_axis(below, np.argmax(below > 0, axis=0)[None], axis=0)[0]
    hidden = (next_one > 0) & (next_one < depth[lowest, columns] - NEARER)
    # Or the image ends there.
    return bool((hidden | (lowest == len(mask) - 1)).mean() < HIDDEN)
