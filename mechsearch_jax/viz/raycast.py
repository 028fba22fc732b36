"""Ray casting of solids without OpenGL, in closed form.

A solid is any surface with a closed-form intersection with rays, such as the shapes of bodies. Static solids are cast
once into a `Picture`, over which moving ones are drawn. NumPy suffices: 16 ms for about 50 solids that fill a quarter
of an image of 576 x 403 pixels.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from mechsearch_jax.shapes.primitives import Surface

if TYPE_CHECKING:
    from mechsearch_jax.workspace.camera import Camera

# A solid nearer to the camera's plane than this is cast in the whole image [m].
NEAREST = 0.02
# Rays along each side of a pixel.
RAYS = 2
# A pixel has an edge if one of its colours, of 255, differs by more than this from that of the next pixel.
EDGE = 8
# Rays that are cut at once: few enough for their numbers to stay in the processor's cache.
LOT = 32768
# Rows of the image in which a solid is taken to be equally wide.
BAND = 4
# Corners of a box in half-extents, and the pairs of them that its edges join.
CORNERS = np.array(list(itertools.product((-1, 1), repeat=3)), np.float32)
JOINED = np.array([(i, i + step) for step in (1, 2, 4) for i in range(8) if not i & step])

Colour = tuple[float, float, float]


@dataclasses.dataclass(frozen=True, eq=False)
class VisibleSolid:
    """A visible solid.

    Attributes:
      surface: its shape.
      half_size: half-extents [m], shape (3,).
      rotation: `R_world_solid`, shape (3, 3).
      position: `t_world_solid` [m], shape (3,).
      colour: red, green and blue, 0 to 1.
    """

    surface: Surface
    half_size: Float[np.ndarray, " 3"]
    rotation: Float[np.ndarray, "3 3"]
    position: Float[np.ndarray, " 3"]
    colour: Colour


@dataclasses.dataclass(frozen=True, eq=False)
class Picture:
    """An image with `RAYS` x `RAYS` rays for each pixel, which come first in its arrays.

    Attributes:
      depth: along the camera's axis [m], infinite where nothing is, shape (rays, h, w).
      colour: 8 bits per channel, shape (rays, h, w, 3).
    """

    depth: Float[np.ndarray, "rays h w"]
    colour: UInt8[np.ndarray, "rays h w 3"]

    @functools.cached_property
    def pixels(self) -> UInt8[np.ndarray, "h w 3"]:
        """The image; each pixel is the mean of its rays."""
        return _mean(self.colour)


def _mean(colour: UInt8[np.ndarray, "rays *pixels 3"]) -> UInt8[np.ndarray, "*pixels 3"]:
    return ((colour.sum(axis=0, dtype=np.uint16) + RAYS**2 // 2) // RAYS**2).astype(np.uint8)


class _Placed(NamedTuple):
    """Solids before an eye, those with the same surface side by side.

    Attributes:
      groups: each surface, and the index of its first solid and that after its last.
      numbers: half-extents, the eye's position and its axes to the right, down and forward, all in the solid's frame,
        shape (15, solids).
      light: direction from which it comes in the solid's frame, shape (3, solids).
      colour: 0 to 255, shape (3, solids).
      first, end: the first column that may show a solid in each row, and the one after the last, shape (solids, h).
    """

    groups: list[tuple[Surface, int, int]]
    numbers: Float[np.ndarray, "15 solids"]
    light: Float[np.ndarray, "3 solids"]
    colour: Float[np.ndarray, "3 solids"]
    first: Int[np.ndarray, "solids h"]
    end: Int[np.ndarray, "solids h"]

    def in_frames(self, solid: Int[np.ndarray, " n"], rays: Float[np.ndarray, "2 n"]) -> list[Float[np.ndarray, "3 n"]]:
        """Half-extents of solids, in ascending order, and origins and directions of rays in their frames."""
        counts = np.bincount(solid, minlength=self.numbers.shape[1])
        half, origin, right, down, forward = np.repeat(self.numbers, counts, axis=1).reshape(5, 3, -1)
        return [half, origin, right * rays[0] + down * rays[1] + forward]


class Eye:
    """A camera that casts rays."""

    def __init__(self, camera: Camera, light: Colour, ambient: float, background: Colour):
        """Args:
        camera: of the pixels; each has `RAYS` x `RAYS` rays.
        light: direction from which it comes.
        ambient: share of the light that reaches every side.
        background: colour beside the solids.
        """
        self._rotation = np.array(camera.rotation, np.float32)
        self._position = np.array(camera.position, np.float32)
        self._focal, self._centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
        self._width, self._height = camera.width, camera.height
        places = ((np.arange(RAYS * count) + 0.5) / RAYS for count in (camera.width, camera.height))
        grid = np.meshgrid(*((place - c) / f for place, c, f in zip(places, self._centre, self._focal, strict=True)))
        rays = np.array(grid, np.float32).reshape(2, camera.height, RAYS, camera.width, RAYS)
        # To the right and down, of unit depth, shape (rays, 2, pixels).
        self._rays = np.ascontiguousarray(rays.transpose(2, 4, 0, 1, 3)).reshape(RAYS**2, 2, -1)
        self._background = np.round(255 * np.array(background)).astype(np.uint8)
        self._light = np.array(light, np.float32) / np.float32(np.linalg.norm(light))
        self._ambient = ambient

    def picture(self, solids: Iterable[VisibleSolid]) -> Picture:
        """A picture of solids."""
        shape = (RAYS**2, self._height, self._width)
        picture = Picture(np.full(shape, np.inf, np.float32), np.tile(self._background, (*shape, 1)))
        for solid in solids:
            placed = self._placed([solid])
            for each in zip(self._rays, picture.depth, picture.colour, strict=True):
                self._cast(placed, *self._pairs(placed), *each)
        return picture

    def images(self, moments: Iterable[Iterable[VisibleSolid]], behind: Picture) -> list[UInt8[np.ndarray, "h w 3"]]:
        """The images of solids before the same picture."""
        return [self.pixels(solids, behind) for solids in moments]

    def pixels(self, solids: Iterable[VisibleSolid], behind: Picture) -> UInt8[np.ndarray, "h w 3"]:
        """The image of solids before a picture: one ray for a pixel without an edge, all of them for one with an edge.

        An edge between a pixel's first ray and another of its rays is between the first rays of this pixel and of that
        to its right or below it, too.
        """
        image, depth, placed = behind.pixels.copy(), behind.depth[0].copy(), self._placed(solids)
        self._cast(placed, *self._pairs(placed), self._rays[0], depth, image)
        drawn = depth < behind.depth[0]
        rows, columns = np.nonzero(_edges(image, drawn))
        depth, colour, drawn = behind.depth[:, rows, columns], behind.colour[:, rows, columns], drawn[rows, columns]
        colour[0, drawn] = image[rows, columns][drawn]
        solid, ray = np.nonzero((placed.first[:, rows] <= columns) & (columns < placed.end[:, rows]))
        rays = self._rays[..., rows * self._width + columns]
        for each in itertools.islice(zip(rays, depth, colour, strict=True), 1, None):
            self._cast(placed, solid, ray, *each)
        image[rows, columns] = _mean(colour)
        return image

    def _cast(
        self,
        placed: _Placed,
        solid: Int[np.ndarray, " n"],
        ray: Int[np.ndarray, " n"],
        rays: Float[np.ndarray, "2 rays"],
        depth: Float[np.ndarray, "*rays"],
        colour: UInt8[np.ndarray, "*rays 3"],
    ) -> None:
        """Draw solids over `depth` and `colour`; each of `solid`, in ascending order, may be met by its `ray`."""
        depth, colour, met = depth.reshape(-1), colour.reshape(-1, 3), []
        for surface, *group in placed.groups:
            begin, end = np.searchsorted(solid, group)
            for start in range(begin, end, LOT):
                i, r = (each[start : min(start + LOT, end)] for each in (solid, ray))
                half, origin, direction = placed.in_frames(i, rays.take(r, axis=1))
                with np.errstate(all="ignore"):
                    far = surface.cut(list(origin), list(direction), half, np)
                hit = np.flatnonzero(far < depth[r])
                met.append((surface, i[hit], r[hit], far[hit]))
                np.minimum.at(depth, r[hit], far[hit])
        for surface, *hits in met:
            nearest = np.flatnonzero(hits[2] == depth[hits[1]])
            i, r, far = (each[nearest] for each in hits)
            half, origin, direction = placed.in_frames(i, rays.take(r, axis=1))
            normal = surface.normal((origin + far * direction).T, half.T, np).T
            length = np.sqrt((normal**2).sum(axis=0))
            lit = (normal * placed.light.take(i, axis=1)).sum(axis=0) / np.maximum(length, 1e-9)
            shade = self._ambient + (1.0 - self._ambient) * np.maximum(lit, 0.0)
            colour[r] = np.round(shade * placed.colour.take(i, axis=1)).T

    def _placed(self, solids: Iterable[VisibleSolid]) -> _Placed:
        solids = sorted(solids, key=lambda solid: type(solid.surface).__name__)
        fields = ("rotation", "position", "half_size", "colour")
        rotation, position, half, colour = (np.array([getattr(s, f) for s in solids], np.float32) for f in fields)
        groups, begin = [], 0
        for surface, group in itertools.groupby(solid.surface for solid in solids):
            groups.append((surface, begin, begin := begin + len(list(group))))
        origin = np.einsum("sj,sjk->sk", self._position - position, rotation)
        numbers = np.concatenate([half, origin, (self._rotation.T @ rotation).reshape(-1, 9)], axis=1)
        corners = (CORNERS * half[:, None]) @ rotation.swapaxes(1, 2) + (position - self._position)[:, None]
        return _Placed(
            groups,
            np.ascontiguousarray(numbers.T),
            (self._light @ rotation).T,
            255 * colour.T,
            *self._spans(corners @ self._rotation),
        )

    def _pairs(self, placed: _Placed) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
        """Each solid with each pixel that may show it, by their indices."""
        counts = np.maximum(placed.end - placed.first, 0)
        ends = counts.cumsum().reshape(counts.shape)
        starts = placed.first + self._width * np.arange(self._height)
        pixel = np.arange(counts.sum()) + np.repeat(starts - ends + counts, counts.reshape(-1))
        return np.repeat(np.arange(len(counts)), counts.sum(axis=1)), pixel

    def _spans(self, corners: Float[np.ndarray, "solids 8 3"]) -> list[Int[np.ndarray, "solids h"]]:
        """`first` and `end` of boxes, from their corners in the camera's frame."""
        ahead = corners[..., 2] >= NEAREST
        image = corners[..., :2] / np.maximum(corners[..., 2:], NEAREST) * self._focal + self._centre
        (x, y), (u, v) = np.moveaxis(image[:, JOINED, None], (2, 4), (0, 1))
        # Where the edges of a box, from (x, y) to (u, v), enter and leave each band of rows, if they do.
        band = np.arange(0, self._height, BAND)
        rows = np.maximum(np.minimum(y, v), band), np.minimum(np.maximum(y, v), band + BAND)
        slope = (u - x) / np.where(np.abs(v - y) < 1e-6, np.inf, v - y)
        columns = np.stack([x + slope * (row - y) for row in rows])
        there = rows[0] <= rows[1]
        first = np.where(there, columns, np.inf).min(axis=(0, 2))
        end = np.where(there, columns, -np.inf).max(axis=(0, 2))
        some, every = ahead.any(axis=1, keepdims=True), ahead.all(axis=1, keepdims=True)
        first, end = np.where(every, np.floor(first), 0.0), np.where(every, np.ceil(end), self._width * some)
        columns = (np.clip(column, 0, self._width).astype(int) for column in (first, end))
        return [np.repeat(column, BAND, axis=1)[:, : self._height] for column in columns]


def _edges(image: UInt8[np.ndarray, "h w 3"], drawn: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels that differ from that to the right or below, where one of both is drawn."""
    edges = np.zeros_like(drawn)
    for axis in (0, 1):
        (a, b), (here, there) = (
            (np.moveaxis(values, axis, 0)[:-1], np.moveaxis(values, axis, 0)[1:]) for values in (image, drawn)
        )
        red, green, blue = np.moveaxis(np.maximum(a, b) - np.minimum(a, b) > EDGE, -1, 0)
        np.moveaxis(edges, axis, 0)[:-1] |= (red | green | blue) & (here | there)
    return edges
