"""Checks of a camera's images: whether they can be used, and warnings about parts in which nothing was measured, though
things may stand there.

Black, shiny and transparent things, and what a stereo camera sees with one eye only, have no depth.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Bool, Float, Int

from mechsearch_jax.images.cloud import BLOCK, View, above_board, density, shelf_view, thinned_view
from mechsearch_jax.images.detection import coloured_pixels
from mechsearch_jax.images.labels import CAPACITY, MISSING, more_room
from mechsearch_jax.observation import Observation
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.camera import Camera, measured
from mechsearch_jax.workspace.detector import found_pixels
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.sight import enters

# A hole counts if a square of this side at the middle of the board fits into it [m]: a small object.
SMALL = 0.025
# Rays that enter the shelf this close to the edges of an opening do not count [m].
RIM = 0.01


def check_images(
    camera: Camera,
    depth: Any,
    colour: Any = None,
    mask: Any = None,
    target_id: Any = None,
    capacity: int = CAPACITY,
) -> None:
    """Check that images can be used: all that can be said of them without their shelf.

    Args:
      camera: of the images.
      depth, colour, mask, target_id: as of a `Recogniser` ...
      capacity: ... that holds so many objects.

    Raises:
      InputError: one of them has the wrong shape, type or unit. Values are checked outside `jit` only.
    """
    size = (camera.height, camera.width)
    for name, image, shape in (("depth", depth, size), ("colour", colour, (*size, 3)), ("mask", mask, size)):
        if image is None and name != "depth":
            continue
        if image is None or not (hasattr(image, "shape") and hasattr(image, "dtype")):
            raise InputError(f"{name} image: is a {type(image).__name__}; give an array of the shape {shape}")
        if tuple(image.shape) != shape:
            turned = "; it looks transposed" if tuple(image.shape[:2]) == size[::-1] else ""
            raise InputError(
                f"{name} image: its shape is {tuple(image.shape)}, the camera's images are {shape}{turned}"
            )
    _check_depth(depth)
    if colour is not None:
        _check_colour(colour)
    if target_id is not None:
        if mask is None:
            raise InputError("target_id: names a number of a mask; give the mask too, or leave it out")
        if not jnp.issubdtype(jnp.result_type(target_id), jnp.integer) or jnp.ndim(target_id) != 0:
            raise InputError(f"target_id: {target_id} must be one whole number, that of the target in the mask")
    if mask is not None:
        _check_mask(mask, colour is None and target_id is None, capacity)


def _values(image: Any) -> np.ndarray | None:
    """Every eighth row and column, for checks of the values; None while JAX traces."""
    return None if isinstance(image, Tracer) else np.asarray(image[::8, ::8])


def _check_depth(depth: Any) -> None:
    if not jnp.issubdtype(depth.dtype, jnp.floating):
        raise InputError(f"depth image: holds {depth.dtype}; give floats in metres (millimetres divided by 1000)")
    values = _values(depth)
    if values is None:
        return
    known = values[np.isfinite(values) & (values > 0)]
    # The largest number may stand for what was not measured, or be a simulator's far plane.
    known = known[known < known.max(initial=0.0)]
    if known.size and np.median(known) > 20:
        raise InputError(f"depth image: its median is {np.median(known):.0f}; give metres, not millimetres")


def _check_colour(colour: Any) -> None:
    if colour.dtype == jnp.uint8:
        return
    if not jnp.issubdtype(colour.dtype, jnp.floating):
        raise InputError(f"colour image: holds {colour.dtype}; give floats from 0 to 1, or uint8")
    values = _values(colour)
    if values is not None and not np.all((values >= 0) & (values <= 1)):
        raise InputError("colour image: its floats must be from 0 to 1; divide 8-bit values by 255")


def _check_mask(mask: Any, blind: bool, capacity: int) -> None:
    if not jnp.issubdtype(mask.dtype, jnp.integer):
        raise InputError(
            f"mask image: holds {mask.dtype}; give whole numbers, 0 to {capacity} for objects, -1 for none"
        )
    values = _values(mask)
    if values is None:
        return
    low, high = (int(v) for v in (np.asarray(mask).min(), np.asarray(mask).max()))
    if low < MISSING or high > capacity:
        raise InputError(
            f"mask image: holds numbers from {low} to {high}; objects are 0 to {capacity}, all else -1, -2 or -3"
            f"{more_room(capacity)}"
        )
    if blind and high == capacity:
        raise InputError(
            f"mask image: {high + 1} things are too many; say with target_id which of 0 to {high} is the target"
            f"{more_room(capacity)}"
        )


@dataclasses.dataclass(frozen=True, eq=False)
class Look:
    """The images of one look, on the host.

    Attributes:
      camera, shelf: of the images; the camera sees the shelf.
      depth, colour, mask: as of a `Recogniser`.
      detector: gives the target's pixels of a colour image; None if it is not told by its colour.
    """

    camera: Camera
    shelf: Shelf
    depth: Float[np.ndarray, "h w"]
    colour: np.ndarray | None = None
    mask: Int[np.ndarray, "h w"] | None = None
    detector: Callable[[jax.Array], Any] | None = None

    @functools.cached_property
    def whole(self) -> Part:
        """Every pixel that may show the shelf."""
        return Part(self, shelf_view(self.camera, self.shelf, 1, BLOCK))

    @functools.cached_property
    def thinned(self) -> Part:
        """The pixels that recognition uses."""
        view = thinned_view(self.camera, self.shelf)
        return Part(self, view.inside(self.camera), (view.camera.height, view.camera.width))


@dataclasses.dataclass(frozen=True, eq=False)
class Part:
    """What a view shows of a look; only with a colour image and a detector it has pixels of the target's colour.

    Attributes:
      look: the look.
      view: its rays that lie in the image.
      size: rows and columns of what a detector is called with; those of the view if None.
    """

    look: Look
    view: View
    size: tuple[int, int] | None = None

    def of(self, image: np.ndarray) -> np.ndarray:
        """The view's pixels of a full image."""
        return self.view.cut(image)

    @functools.cached_property
    def depth(self) -> Float[np.ndarray, "h w"]:
        """Depth [m]; NaN where nothing was measured."""
        part = self.of(self.look.depth).astype(np.float32)
        return np.where(measured(part), part, np.float32(np.nan))

    @functools.cached_property
    def ways(self) -> Float[np.ndarray, "h w 3"]:
        """Directions of the rays in the world, of unit depth; with NumPy, which compiles nothing for another size."""
        camera = self.view.camera
        rows, columns = np.arange(camera.height), np.arange(camera.width)
        v, u = np.meshgrid((rows + 0.5 - camera.cy) / camera.fy, (columns + 0.5 - camera.cx) / camera.fx, indexing="ij")
        return (np.stack([u, v, np.ones_like(u)], axis=-1) @ np.array(camera.rotation).T).astype(np.float32)

    @functools.cached_property
    def points(self) -> Float[np.ndarray, "h w 3"]:
        """In the world [m]; NaN without a finite depth."""
        depth = np.where(np.isfinite(self.depth), self.depth, np.float32(np.nan))[..., None]
        return np.array(self.view.camera.position, np.float32) + depth * self.ways

    @functools.cached_property
    def above_board(self) -> Bool[np.ndarray, "h w"]:
        """Which pixels show something in the shelf's free space."""
        return np.asarray(above_board(self.look.shelf, self.points))

    @functools.cached_property
    def colour(self) -> Float[np.ndarray, "h w 3"]:
        """Red, green and blue in 0 to 1."""
        part = self.of(np.asarray(self.look.colour))
        return part.astype(np.float32) / np.float32(255.0 if part.dtype == np.uint8 else 1.0)

    @functools.cached_property
    def detected(self) -> Bool[np.ndarray, "h w"]:
        """The pixels of the target's colour, each judged alone."""
        return self.judged(self.colour)

    def judged(self, colour: Float[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
        """Those of another colour image of the view."""
        assert self.look.detector is not None
        height, width, _ = colour.shape
        return np.asarray(self.look.detector(self._filled(colour)))[:height, :width]

    def _filled(self, image: np.ndarray, rest: float = 0.0) -> jax.Array:
        """An image of the view with a number in the rest of `size`: nothing is compiled anew for another pose."""
        size = (*(self.size or image.shape[:2]), *image.shape[2:])
        beyond = [(0, full - count) for full, count in zip(size, image.shape, strict=True)]
        return jnp.asarray(np.pad(image, beyond, constant_values=rest))

    def elected(self, colour: Float[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
        """Those in the shelf's free space by a vote among neighbours, which is slow."""
        assert self.look.detector is not None
        chosen = coloured_pixels(self.look.detector, self._filled(colour), self._filled(self.depth, np.nan))
        height, width = self.depth.shape
        return np.asarray(chosen)[:height, :width] & self.above_board


def _numbered(pixels: Bool[np.ndarray, "h w"], around: np.ndarray | None = None) -> Int[np.ndarray, "h w"]:
    """A number for each pixel, the same for connected ones; 0 for the others."""
    from scipy import ndimage

    return np.asarray(ndimage.label(pixels, around)[0])  # pyright: ignore[reportIndexIssue]


def hole_faults(look: Look) -> tuple[str, ...]:
    """A warning if connected pixels without a measurement could hide a small object in the shelf."""
    from scipy import ndimage

    part = look.thinned
    into = _into_shelf(part)
    side = max(3, round(SMALL * density(part.view.camera, look.shelf)))
    # Single pixels in a hole may be measured, by noise.
    holes = ndimage.uniform_filter((np.isnan(part.depth) & into).astype(np.float32), 3) > 0.5
    labels = _numbered(holes)
    fits = np.asarray(ndimage.binary_erosion(holes, np.ones((side, side), bool)), bool)
    large = np.unique(labels[fits])
    if not len(large):
        return ()
    sizes = np.bincount(labels.ravel())[large]
    first = ndimage.find_objects(labels)[large[np.argmax(sizes)] - 1]
    (top, bottom), (left, right) = (
        (start + edge.start * part.view.stride, start + edge.stop * part.view.stride - 1)
        for start, edge in zip((part.view.row, part.view.column), first, strict=True)
    )
    many = f"{len(large)} holes" if len(large) > 1 else "a hole"
    return (
        f"depth image: nothing was measured in {100 * sizes.sum() / into.sum():.0f}% of the shelf's image, in {many} "
        f"(the largest in rows {top} to {bottom}, columns {left} to {right}): what is behind counts as possible, and "
        "nothing is put there",
    )


def unmeasured_target_faults(look: Look, observation: Observation) -> tuple[str, ...]:
    """A warning if the target's colour is seen where nothing was measured, and the target nowhere else.

    Args:
      look: images with colour, and a detector.
      observation: of these images, without batch axes.
    """
    if bool(observation.target_visible):
        return ()
    part = look.thinned
    labels = _numbered(part.detected & np.isnan(part.depth) & _into_shelf(part), np.ones((3, 3)))
    most = int(np.bincount(labels.ravel())[1:].max(initial=0)) * part.view.stride**2
    if most <= found_pixels(look.camera):
        return ()
    return (
        f"colour image: the target's colour is seen where nothing was measured ({most} pixels in one place): it may "
        "stand there; see that the depth camera measures it (light, angle, a matt surface)",
    )


def _into_shelf(part: Part) -> Bool[np.ndarray, "h w"]:
    """Which rays enter the shelf's free space through an opening."""
    return enters(part.look.shelf, np.array(part.view.camera.position), part.ways, RIM)
