"""Check whether an observation explains its depth image: if not, the robot must not move.

An `Observation` has no measure of confidence. But points above the board must lie on recognised surfaces, and no ray
may pass through a recognised object.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mechsearch_jax.images.cloud import (
    OVERHANG,
    View,
    above_board,
    hanging,
    high_in_opening,
    shelf_view,
    surfaces,
    thinned_view,
    walled,
)
from mechsearch_jax.observation import Observation
from mechsearch_jax.perception.recogniser import Setting
from mechsearch_jax.runtime.compiled import cached_jit
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.shapes.parts import parts_of
from mechsearch_jax.shapes.solid import Solid
from mechsearch_jax.workspace.camera import Camera, back_project, measured
from mechsearch_jax.workspace.detector import SAMPLED, found_pixels
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.sight import ends_in_shelf, enters
from mechsearch_jax.workspace.target import Target

# At most about so many pixels of the shelf's part of the image are used, spread evenly over it.
PIXELS = 20_000
# Shares of fewer points than this are ignored.
FEWEST_POINTS = 50
# Points within this distance of the shelf's faces count as the shelf [m].
FACES = 0.012
# How far before its place a wall that is seen may be measured [m].
WALLS = 0.02
# A surface is lost if more than this share of its points is on nothing that is recognised.
LOST = 0.6
# Objects that fewer rays reach are ignored.
FEWEST_RAYS = 20
# Width of the square inside a round object, relative to its diameter.
INSCRIBED = 0.7
# How far a ray has to pass through the inner part of a compound, whose pieces may be thin, in tolerances.
DEEP = 3.0


@dataclasses.dataclass(frozen=True)
class DoubtConfig:
    """When recognition is too doubtful to move.

    The defaults come from 24 published scenes, recognised with 1 mm and time-of-flight noise, with and without masks:
    there the shares were at most 0.04, except for one wrongly recognised object.

    Attributes:
      tolerance: how far a point may be from a recognised surface, and how deep a ray may pass through an object [m].
      missing: largest share of the shelf's part of the image without a measured depth.
      unexplained: largest share of the points above the board that are on no recognised surface.
      passed: largest share of the rays towards an object that pass through it.
    """

    tolerance: float = 0.012
    missing: float = 0.5
    unexplained: float = 0.08
    passed: float = 0.15

    def __post_init__(self):
        if not (self.tolerance > 0 and math.isfinite(self.tolerance)):
            raise InputError(f"DoubtConfig: tolerance {self.tolerance} must be positive, in metres")
        for name in ("missing", "unexplained", "passed"):
            if not 0 <= getattr(self, name) <= 1:
                raise InputError(f"DoubtConfig: {name} {getattr(self, name)} must be a share from 0 to 1")


class Doubt(NamedTuple):
    """How badly an observation explains its depth image; shares from 0 to 1.

    Attributes:
      missing: share of the shelf's part of the image without a measured depth.
      unexplained: share of the points above the board that are on no recognised surface.
      passed: share of the rays that reach the worst object and pass through it.
      worst: name of that object; empty if no ray reaches any object.
    """

    missing: float
    unexplained: float
    passed: float
    worst: str

    def reason(self, config: DoubtConfig) -> str | None:
        """Why recognition is too doubtful, in one line; None if it is not."""
        checks = (
            (self.missing, config.missing, "of the shelf's part of the depth image are not measured"),
            (self.unexplained, config.unexplained, "of what stands on the board is on no recognised object"),
            (self.passed, config.passed, f"of the rays that reach {self.worst} pass through where it was recognised"),
        )
        for share, most, what in checks:
            if share > most:
                return f"{100 * share:.0f} % {what}; at most {100 * most:.0f} % may be"
        return None


@dataclasses.dataclass(frozen=True, eq=False)
class Thing:
    """A recognised object or target: name, half-extents [m], whether it is round about z, and its pose in the world."""

    name: str
    size: Float[np.ndarray, "3"]
    is_round: bool
    rotation: Float[np.ndarray, "3 3"]
    position: Float[np.ndarray, "3"]

    def local(self, vectors: np.ndarray) -> np.ndarray:
        """World directions in its frame."""
        return vectors @ self.rotation

    def gap(self, points: np.ndarray) -> np.ndarray:
        """Approximate distance of world points from its surface, inside or outside [m]."""
        local = self.local(points - self.position)
        past = np.abs(local) - self.size
        if self.is_round:
            across = np.hypot(local[:, 0] / self.size[0], local[:, 1] / self.size[1]) - 1.0
            past = np.stack([across * min(self.size[:2]), past[:, 2]], axis=1)
        return np.abs(np.linalg.norm(np.maximum(past, 0.0), axis=1) + np.minimum(past.max(axis=1), 0.0))

    def crossed(self, origin: np.ndarray, rays: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
        """Where rays enter and leave its inner part, smaller by about a tolerance [m], in lengths of the rays; they
        miss it where they would leave it first."""
        inner = np.maximum(self.size - tolerance, 0.3 * self.size)
        if self.is_round:
            inner[:2] *= INSCRIBED
        start, way = self.local(origin - self.position), self.local(rays)
        way = np.where(np.abs(way) < 1e-9, 1e-9, way)
        ends = np.sort(np.stack([(-inner - start) / way, (inner - start) / way]), axis=0)
        return ends[0].max(axis=1), ends[1].min(axis=1)


@dataclasses.dataclass(frozen=True, eq=False)
class CompoundThing(Thing):
    """A target of several pieces: its largest part as a thing, and all of it where points and rays are judged.

    Attributes:
      solid: the target's geometry.
      R_world_target, place: pose of the target.
    """

    solid: Solid
    R_world_target: Float[np.ndarray, "3 3"]
    place: Float[np.ndarray, "3"]

    def gap(self, points: np.ndarray) -> np.ndarray:
        local = (points - self.place) @ self.R_world_target
        return np.abs(self.solid.distance(local[:, :2], local[:, 2], np))

    def crossed(self, origin: np.ndarray, rays: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
        """Rays cross the inner part where they first enter it, and then for `DEEP` tolerances."""
        start = (origin - self.place) @ self.R_world_target
        along = rays @ self.R_world_target
        enter = self.solid.cut([np.full(len(along), s) for s in start], list(along.T), -tolerance, np)
        return enter, np.where(np.isfinite(enter), enter + DEEP * tolerance, -np.inf)


def recognition_doubt(
    setting: Setting,
    observation: Observation,
    depth: Float[np.ndarray, "height width"],
    tolerance: float = DoubtConfig.tolerance,
) -> Doubt:
    """How badly an observation explains its depth image. Takes milliseconds; not for `jit`.

    Args:
      setting: gives camera, shelf and target, such as a problem or a `Recogniser`.
      observation: without batch axes.
      depth: as `Recogniser` takes it [m].
      tolerance: as in `DoubtConfig` [m].

    Raises:
      InputError: the image is not of the camera's size, or the camera does not see the shelf.
    """
    camera, shelf = setting.camera, setting.shelf
    if np.shape(depth) != (camera.height, camera.width):
        raise InputError(f"depth image: its shape is {np.shape(depth)}, not {(camera.height, camera.width)}")
    rays, depths = _seen(camera, shelf, np.asarray(depth, float))
    origin, known = np.array(camera.position, float), measured(depths)
    judged = known[ends_in_shelf(shelf, origin, rays)]
    missing = 1.0 - float(judged.mean()) if len(judged) else 1.0
    finite = known & np.isfinite(depths)
    points = origin + np.where(finite, depths, np.nan)[:, None] * rays
    before_walls = jax.tree.map(np.asarray, _walled(shelf, jnp.asarray(points, jnp.float32)))
    points = points[_on_the_board(before_walls, points)]
    rays, depths = rays[known], depths[known]
    things = things_of(shelf, setting.target, observation)

    gap = np.full(len(points), np.inf)
    for thing in things:
        gap = np.minimum(gap, thing.gap(points))
    enough = len(points) >= FEWEST_POINTS
    unexplained = float((gap > tolerance).mean()) if enough else 0.0
    passed = [(_passed(thing, origin, rays, depths, tolerance), thing.name) for thing in things]
    return Doubt(missing, unexplained, *max(passed, default=(0.0, "")))


def lost_faults(setting: Setting, observation: Observation, depth: Float[np.ndarray, "h w"]) -> tuple[str, ...]:
    """Warnings if surfaces on the shelf, large enough for an object, lie on nothing that is recognised, or hang in its
    opening.

    Where nothing at all is recognised, `plausibility.sight_faults` says so.

    Args:
      setting, observation, depth: as of `recognition_doubt`.

    Raises:
      InputError: the camera does not see the shelf.
    """
    camera, shelf = setting.camera, setting.shelf
    things = things_of(shelf, setting.target, observation)
    if not things:
        return ()
    view = thinned_view(camera, shelf)
    seen = _surfaces(view, shelf, view.of(jnp.asarray(depth, jnp.float32)))
    points, standing, hangs, number = (np.asarray(a) for a in seen)
    above = points[hangs]
    points, number = points[standing & ~hangs], number[standing & ~hangs]
    least = SAMPLED * found_pixels(camera)
    faults = []
    if len(above) * view.stride**2 > least:
        faults.append(
            f"depth image: something hangs in the shelf's opening down to z = {np.percentile(above[:, 2], 2):.3f} m "
            "and is no object; if it belongs to the shelf, give that height as shelf.ceiling, lest the robot hit it"
        )
    gap = np.full(len(points), np.inf)
    for thing in things:
        gap = np.minimum(gap, thing.gap(points))
    surface = np.unique(number, return_inverse=True)[1]
    pixels = np.bincount(surface) * view.stride**2
    off = np.bincount(surface, gap > DoubtConfig.tolerance) * view.stride**2
    lost = np.flatnonzero((pixels > least) & (off > LOST * pixels))
    if not len(lost):
        return tuple(faults)
    largest = lost[np.argmax(pixels[lost])]
    x, y, z = points[surface == largest].mean(axis=0)
    more = f", nor do {len(lost) - 1} others" if len(lost) > 1 else ""
    return (
        *faults,
        f"recognition: what shows {pixels[largest]} pixels at ({x:.2f}, {y:.2f}, {z:.2f}) m does not lie on anything "
        f"that is recognised{more}",
    )


@jax.jit
def _walled(shelf: Shelf, points: Float[Array, "*batch 3"]) -> Shelf:
    return walled(shelf, points, FACES, WALLS)


@cached_jit()
def _surfaces(view: View, shelf: Shelf, depth: Array) -> tuple[Array, Array, Array, Array]:
    """Points of a view, which of them are on the shelf and which hang in its opening, and the numbers of their
    surfaces."""
    points = back_project(view.camera, jnp.where(measured(depth), depth, jnp.nan))
    standing = above_board(shelf, points)
    number = surfaces(points, standing)
    return points, above_board(_walled(shelf, points), points, FACES), hanging(shelf, points, standing, number), number


def check_recognition(setting: Setting, observation: Observation, depth: Any, config: DoubtConfig) -> None:
    """Check that an observation explains its depth image; arguments as in `recognition_doubt`.

    Raises:
      InputError: it is too doubtful; the message gives the reason.
    """
    doubt = recognition_doubt(setting, observation, np.asarray(depth), config.tolerance)
    if reason := doubt.reason(config):
        raise InputError(f"recognition is too doubtful to move: {reason}; look again")


def _seen(camera: Camera, shelf: Shelf, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rays through the shelf's opening, scaled to unit depth, and their depths [m]; 0 where nothing was measured."""
    whole = shelf_view(camera, shelf, 1)
    stride = max(1, math.ceil(math.sqrt(whole.camera.width * whole.camera.height / PIXELS)))
    rows = whole.row + np.arange(0, whole.camera.height, stride)
    columns = whole.column + np.arange(0, whole.camera.width, stride)
    v, u = np.meshgrid((rows + 0.5 - camera.cy) / camera.fy, (columns + 0.5 - camera.cx) / camera.fx, indexing="ij")
    rays = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3) @ np.array(camera.rotation, float).T
    depths = depth[np.ix_(rows, columns)].reshape(-1)
    # Beside the opening there may be nothing to measure.
    into = enters(shelf, np.array(camera.position), rays)
    return rays[into], np.where(np.isnan(depths), 0.0, depths)[into]


def _on_the_board(shelf: Shelf, points: np.ndarray) -> np.ndarray:
    x, y, z = points.T
    deep = (x > shelf.front - OVERHANG) & (x < shelf.back - FACES)
    wide = (y > shelf.right + FACES) & (y < shelf.left - FACES)
    within = deep & wide & (z > shelf.board + FACES) & (z < shelf.ceiling - FACES)
    return within & ~high_in_opening(shelf, points)


def things_of(shelf: Shelf, target: Target, observation: Observation) -> list[Thing]:
    """The recognised objects, and the target if it is visible; `observation` has no batch axes."""
    objects = observation.objects
    sizes, exponents, positions, rotations, valid = (
        np.asarray(a, float)
        for a in (objects.size, objects.exponents, objects.position, objects.rotation, objects.valid)
    )
    things = [
        Thing(f"object {i}", sizes[i], bool(exponents[i, 1] > 0.5), rotations[i], positions[i])
        for i in np.flatnonzero(valid)
    ]
    if bool(observation.target_visible):
        x, y, yaw = np.asarray(observation.target_pose, float)
        turned = np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]])
        things.append(_target_thing(target, turned, np.array([x, y, target.height(shelf)])))
    return things


def _target_thing(target: Target, rotation: np.ndarray, position: np.ndarray) -> Thing:
    name = "the target"
    if target.compound is None:
        return Thing(name, np.array(target.half_size), target.exponents[1] > 0.5, rotation, position)
    part = max(parts_of(target.compound), key=lambda part: float(np.prod(part.size)))
    place = position + rotation @ part.position
    return CompoundThing(
        name, part.size, part.exponents[1] > 0.5, rotation @ part.rotation, place, target.solid, rotation, position
    )


def _passed(thing: Thing, origin: np.ndarray, rays: np.ndarray, depths: np.ndarray, tolerance: float) -> float:
    """Share of the rays through the inner part of an object whose measured depth is beyond it."""
    enter, leave = thing.crossed(origin, rays, tolerance)
    reaches = (enter < leave) & (depths > enter - 3.0 * tolerance)
    if reaches.sum() < FEWEST_RAYS:
        return 0.0
    return float((depths[reaches] > leave[reaches]).mean())
