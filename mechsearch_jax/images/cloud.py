"""Point clouds of the objects on the shelf, from the part of the image that shows them, without the shelf.

Of a camera's full image only a `View` is used: the rows and columns in which the space above the board can appear,
every `stride`-th of them. Training renders exactly these rays, so that points have the same density on objects in
training and in `view.of(depth)`.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, Shaped

from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.workspace.camera import Camera, project
from mechsearch_jax.workspace.shelf import Shelf

POINTS = 2048
STRIDE = 2
# Points within this distance of the shelf's faces count as the shelf [m].
MARGIN = 0.004
# Points are a wall's or near it up to this distance; a wall is measured up to `OFF` from its place [m]. It is seen with
# so many points near it, of which such a share are within so many standard deviations of its noise; bins of distances.
NEAR_WALL, OFF = 0.025, 0.012
_WALL_POINTS, _WALL_SHARE, _DEVIATIONS, _BINS = 100, 0.7, 2.5, 50
# Least share of points clearly behind a wall's place, where nothing but a noisy wall is measured.
_BEHIND = 0.05
# A surface hangs in the shelf's opening if such a share of it is in the upper half, up to so far behind its edge [m].
HANGING, LIP = 0.9, 0.02
# How far objects may stick out over the board's front edge [m].
OVERHANG = 0.06
# The default camera's view has a multiple of so many rows and columns. Otherwise a recalibrated camera, whose view is a
# few pixels larger or smaller, would recompile everything.
BLOCK = 8
# Views of all other cameras and poses have one of these numbers of rows and columns, also where they end beyond the
# image: the first for images of at most VGA, else the second; the last where that would have less than this share of
# the density of the networks' training.
SIZES, LEAST_DENSITY = ((240, 320), (256, 488), (352, 688)), 0.7
VGA = (480, 640)
# Pixels in a block of `draw`.
_BLOCK = 64
# Neighbouring pixels are on different surfaces if their points are farther apart by this than those beside them, of
# whose distance slanted surfaces explain no more than the second length [m].
_JUMP, _STEEPEST = 0.01, 0.02
# Rounds of spreading the numbers of connected pixels; each doubles how far they reach.
_SPREADS = 12
# Surfaces of at least so many pixels have at least about so many points in a cloud.
_SMALL, _LEAST = 16, 24


@functools.partial(jax.tree_util.register_dataclass, data_fields=("camera", "row", "column", "stride"), meta_fields=())
@dataclasses.dataclass(frozen=True)
class View:
    """Every `stride`-th ray of a part of a camera's image: a pytree, of which only the sizes are static.

    Attributes:
      camera: the pinhole camera whose image consists of exactly these rays.
      row, column: of the first ray in the full image.
      stride: distance of neighbouring rays in the full image, in pixels.
    """

    camera: Camera
    row: int
    column: int
    stride: int

    def of(self, image: Shaped[Array, "height width *channels"]) -> Shaped[Array, "h w *channels"]:
        """The view's pixels of a full image; beyond it NaN, or an integer that is no label."""
        rows, columns = (
            first + self.stride * jnp.arange(count)
            for first, count in ((self.row, self.camera.height), (self.column, self.camera.width))
        )
        return image.at[rows].get(mode="fill").at[:, columns].get(mode="fill")

    def cut(self, image: Shaped[np.ndarray, "height width *channels"]) -> Shaped[np.ndarray, "h w *channels"]:
        """The same of a view that lies in the image, on the host: another size of views compiles nothing."""
        part = image[self.row :: self.stride, self.column :: self.stride]
        return part[: self.camera.height, : self.camera.width]

    def is_inside(self, camera: Camera) -> Bool[Array, "h w"]:
        """Which rays lie in the image of the camera that it is a view of."""
        rows, columns = (self.stride * jnp.arange(count) for count in (self.camera.height, self.camera.width))
        return (self.row + rows < camera.height)[:, None] & (self.column + columns < camera.width)[None]

    def inside(self, camera: Camera) -> View:
        """The rays of it that lie in the image of a camera, which it is a view of; on the host."""
        height = min(self.camera.height, -(-(camera.height - self.row) // self.stride))
        width = min(self.camera.width, -(-(camera.width - self.column) // self.stride))
        return dataclasses.replace(self, camera=dataclasses.replace(self.camera, height=height, width=width))


def view(camera: Camera, rows: tuple[int, int], columns: tuple[int, int], stride: int = 1) -> View:
    """The view of a range of rows and columns (first, last + 1) of a camera's image.

    Raises:
      InputError: the ranges are empty or outside the image, or the stride is not positive.
    """
    inside = 0 <= rows[0] < rows[1] <= camera.height and 0 <= columns[0] < columns[1] <= camera.width
    if not inside or stride < 1:
        raise InputError(
            f"view: rows {rows}, columns {columns}, stride {stride} do not fit an image of "
            f"{camera.height} rows and {camera.width} columns"
        )
    size = (-(-(rows[1] - rows[0]) // stride), -(-(columns[1] - columns[0]) // stride))
    return _view_from(camera, (rows[0], columns[0]), size, stride)


def _view_from(camera: Camera, first: tuple[int, int], size: tuple[int, int], stride: int) -> View:
    """The view that begins at a pixel of the image."""
    seen = dataclasses.replace(
        camera,
        height=size[0],
        width=size[1],
        fx=camera.fx / stride,
        fy=camera.fy / stride,
        cx=(camera.cx - first[1] - 0.5) / stride + 0.5,
        cy=(camera.cy - first[0] - 0.5) / stride + 0.5,
    )
    return View(seen, *first, stride)


def shelf_view(camera: Camera | None = None, shelf: Shelf | None = None, stride: int = STRIDE, block: int = 1) -> View:
    """The part of the image in which things on the board can appear, up to 0.25 m above it.

    Camera and shelf must not be traced, for they decide the view's shape.

    Args:
      camera, shelf: the defaults if None.
      stride: distance of neighbouring rays, in pixels.
      block: the view's numbers of rows and columns are multiples of this, if the image is large enough.

    Raises:
      InputError: the camera does not see the shelf.
    """
    camera, shelf = camera or Camera(), shelf or Shelf()
    low, high = _extent(camera, shelf)
    sizes = (camera.height, camera.width)
    rows, columns = (_in_blocks(low[i], high[i], sizes[i], stride, block) for i in range(2))
    return view(camera, rows, columns, stride)


def _extent(camera: Camera, shelf: Shelf) -> tuple[list[int], list[int]]:
    """First and last + 1 row and column of the part of the image in which things on the board can appear.

    Raises:
      InputError: the camera does not see the shelf.
    """
    tops = (shelf.board, min(shelf.board + 0.25, shelf.ceiling))
    sides = ((shelf.front - OVERHANG, shelf.back), (shelf.right, shelf.left), tops)
    corners = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(8, 3)
    # Not traced even if the caller is.
    with jax.ensure_compile_time_eval():
        pixels, depth = (np.asarray(a) for a in project(camera, jnp.array(corners, jnp.float32)))
    low = np.maximum(np.floor(pixels.min(axis=0)), 0).astype(int)
    high = np.minimum(np.ceil(pixels.max(axis=0)) + 1, (camera.height, camera.width)).astype(int)
    if (depth <= 0).any() or (low >= high).any():
        raise InputError("shelf_view: the camera does not look into the shelf; check its pose")
    return low.tolist(), high.tolist()


def _in_blocks(first: int, end: int, size: int, stride: int, block: int) -> tuple[int, int]:
    """A range of pixels that contains the given one, with a multiple of `block` rays if the image is long enough."""
    count = -(-(end - first) // stride)
    count = min(-(-count // block) * block, -(-size // stride))
    span = (count - 1) * stride + 1
    first = min(first, size - span)
    return first, first + span


def middle(shelf: Shelf) -> tuple[Any, Any, Any]:
    """The middle of the board's top [m]: numbers, or arrays if the shelf is traced."""
    return (shelf.front + shelf.back) / 2, (shelf.right + shelf.left) / 2, shelf.board


def distance(camera: Camera, shelf: Shelf) -> float:
    """Distance of the camera from the middle of the board's top [m]; at least 1 nm."""
    return max(float(np.linalg.norm(np.subtract(camera.position, middle(shelf)))), 1e-9)


def density(camera: Camera, shelf: Shelf) -> float:
    """A camera's pixels per metre across its view, at the middle of the board."""
    return camera.fx / distance(camera, shelf)


def thinned_view(camera: Camera, shelf: Shelf) -> View:
    """The shelf's part of a camera's image for networks, thinned to about the density of their training.

    Views of one camera have one of two `SIZES`, so that another pose compiles nothing, or the size of the default
    camera's where they see the shelf as it does. They may end beyond the image. Camera and shelf must not be traced.

    Raises:
      InputError: the camera does not see the shelf.
    """
    finer = density(camera, shelf) / density(Camera(), Shelf())
    stride = max(1, round(STRIDE * finer))
    tight = shelf_view(camera, shelf, stride, BLOCK)
    if (tight.camera.height, tight.camera.width) == _usual_size():
        return tight
    low, high = _extent(camera, shelf)
    # The least strides with which all of it fits.
    sizes = SIZES[0 if camera.height <= VGA[0] and camera.width <= VGA[1] else 1], SIZES[2]
    strides = [max(stride, *(-(-(high[i] - low[i]) // size[i]) for i in range(2))) for size in sizes]
    sparse = strides[0] > stride and STRIDE * finer / strides[0] < LEAST_DENSITY
    size, stride = sizes[sparse], strides[sparse]
    last = (camera.height - size[0] * stride, camera.width - size[1] * stride)
    return _view_from(camera, (max(min(low[0], last[0]), 0), max(min(low[1], last[1]), 0)), size, stride)


@functools.cache
def _usual_size() -> tuple[int, int]:
    seen = shelf_view(block=BLOCK).camera
    return seen.height, seen.width


class PointCloud(PyTreeNode):
    """P points in the world, of which any may be absent.

    Attributes:
      points: [m], shape (P, 3); finite even where absent.
      valid: whether the slot holds a point, shape (P,).
      pixel: row * width + column of each point's pixel, int32, shape (P,).
    """

    points: jax.Array
    valid: jax.Array
    pixel: jax.Array


def cloud_of(points: Float[Array, "h w 3"]) -> PointCloud:
    """The cloud of an image of points [m], such as that of `camera.back_project`; NaN points are absent."""
    flat = points.reshape(-1, 3)
    valid = jnp.isfinite(flat).all(axis=-1)
    return PointCloud(jnp.where(valid[:, None], flat, 0.0), valid, jnp.arange(flat.shape[0], dtype=jnp.int32))


def above_board(shelf: Shelf, points: Float[Array | np.ndarray, "*batch 3"], margin: float = MARGIN) -> Any:
    """Whether points lie in the free space of the shelf, farther than `margin` [m] from its faces. False for NaN."""
    x, y, z = (points[..., i] for i in range(3))
    deep = (x > shelf.front - OVERHANG) & (x < shelf.back - margin)
    wide = (y > shelf.right + margin) & (y < shelf.left - margin)
    return deep & wide & (z > shelf.board + margin) & (z < shelf.ceiling - margin)


def walled(shelf: Shelf, points: Float[Array, "*batch 3"], margin: float = MARGIN, most: float = OFF) -> Shelf:
    """The shelf with walls that are moved inwards until `margin` [m] before them lies nothing that is measured of them,
    where noise is so large that some of it lies behind them.

    A wall is where most points are near its place; those behind it tell its noise. Else, as where things stand near a
    wall that is not seen, it stays. So does the board: on it, not at the walls, stand things.

    Args:
      shelf: may be traced.
      points: of an image [m]; NaN where nothing was measured.
      margin: see above.
      most: how far before a wall's place its points can end [m].
    """
    x, y, z = (points[..., i].reshape(-1) for i in range(3))
    walls = shelf.walls
    upright = (z > shelf.board + NEAR_WALL) & (z < shelf.ceiling - NEAR_WALL)
    deep = upright & (x > shelf.front) & (x < shelf.back - NEAR_WALL)
    wide = upright & (y > shelf.right + NEAR_WALL) & (y < shelf.left - NEAR_WALL)

    def inwards(before, beside):
        place = (jnp.arange(_BINS) + 0.5) * (2 * NEAR_WALL / _BINS) - NEAR_WALL
        within = beside & (jnp.abs(before) < NEAR_WALL)
        index = jnp.where(within, (before + NEAR_WALL) * (_BINS / (2 * NEAR_WALL)), 0.0).astype(jnp.int32)
        count = jnp.zeros(_BINS).at[index].add(within * 1.0)
        smooth = jnp.convolve(count, jnp.ones(5), mode="same")
        densest = place[jnp.argmax(jnp.where(jnp.abs(place) <= OFF, smooth, -1.0))]
        most_there = jnp.where(jnp.abs(place - densest) < 2.5e-3, count, 0.0)
        at = jnp.sum(most_there * place) / jnp.maximum(jnp.sum(most_there), 1.0)
        behind = count * (place <= at)
        noise = jnp.sqrt(jnp.sum(behind * (place - at) ** 2) / jnp.maximum(jnp.sum(behind), 1.0))
        total, end = jnp.sum(count), at + _DEVIATIONS * noise
        on_it = jnp.sum(jnp.where(jnp.abs(place - at) <= _DEVIATIONS * noise + 1e-3, count, 0.0))
        seen = (total >= _WALL_POINTS) & (on_it > _WALL_SHARE * total)
        seen &= jnp.sum(jnp.where(place < -MARGIN / 2, count, 0.0)) > _BEHIND * total
        return jnp.where(seen, jnp.clip(end, margin, jnp.maximum(margin, most)) - margin, 0.0)

    return dataclasses.replace(
        shelf,
        back=shelf.back - inwards(walls.back - x, wide),
        right=shelf.right + inwards(y - walls.right, deep),
        left=shelf.left - inwards(walls.left - y, deep),
    )


def numbered(down: Bool[Array, "above w"], right: Bool[Array, "h before"]) -> Int[Array, "h w"]:
    """A number for each pixel, the same for connected pixels: that of one of them in the order of rows.

    Each round takes the least number of the neighbours, and of the pixel that has the number.

    Args:
      down, right: whether each pixel is connected with the one below it, and with the one to its right.
    """
    height, width = right.shape[0], down.shape[1]
    number = jnp.arange(height * width, dtype=jnp.int32).reshape(height, width)

    def spread(_, number):
        big = jnp.int32(height * width)
        lower = jnp.pad(jnp.where(down, number[1:], big), ((0, 1), (0, 0)), constant_values=height * width)
        upper = jnp.pad(jnp.where(down, number[:-1], big), ((1, 0), (0, 0)), constant_values=height * width)
        after = jnp.pad(jnp.where(right, number[:, 1:], big), ((0, 0), (0, 1)), constant_values=height * width)
        before = jnp.pad(jnp.where(right, number[:, :-1], big), ((0, 0), (1, 0)), constant_values=height * width)
        least = jnp.minimum(number, jnp.minimum(jnp.minimum(lower, upper), jnp.minimum(after, before)))
        flat = number.reshape(-1)
        flat = flat.at[flat].min(least.reshape(-1))
        flat = flat[flat]
        return flat[flat].reshape(height, width)

    return jax.lax.fori_loop(0, _SPREADS, spread, number)


def surfaces(points: Float[Array, "h w 3"], standing: Bool[Array, "h w"]) -> Int[Array, "h w"]:
    """A number for each pixel, the same for the pixels of a surface: those that are connected without a jump in depth.

    Args:
      points: [m]; NaN where nothing was measured.
      standing: the pixels that are connected; the others have numbers of their own.
    """

    def connected(axis):
        step = jnp.linalg.norm(jnp.diff(points, axis=axis), axis=-1)
        count = step.shape[axis]
        padded = jnp.pad(jnp.nan_to_num(step), [(1, 1) if a == axis else (0, 0) for a in range(2)])
        before, after = (jax.lax.slice_in_dim(padded, i, i + count, axis=axis) for i in (0, 2))
        both = [jax.lax.slice_in_dim(standing, i, i + count, axis=axis) for i in (0, 1)]
        return both[0] & both[1] & (step < _JUMP + jnp.minimum(jnp.maximum(before, after), _STEEPEST))

    return numbered(connected(0), connected(1))


def high_in_opening(shelf: Shelf, points: Shaped[Any, "*batch 3"]) -> Bool[Any, "*batch"]:
    """Whether points [m] are in the upper half of the shelf's opening, where the lip of the upper board hangs. A shelf
    without a ceiling has no upper half."""
    return (points[..., 2] > (shelf.board + shelf.walls.ceiling) / 2) & (points[..., 0] < shelf.front + LIP)


def hanging(
    shelf: Shelf, points: Float[Array, "h w 3"], standing: Bool[Array, "h w"], surface: Int[Array, "h w"]
) -> Bool[Array, "h w"]:
    """The pixels of surfaces that hang in the shelf's opening, such as the lip of the upper board: nothing stands
    before the opening that could hide what they stand on.

    Args:
      shelf: in the image.
      points: [m]; NaN where nothing was measured.
      standing, surface: as of `surfaces`.
    """
    opening = standing & high_in_opening(shelf, points)
    number = surface.reshape(-1)
    pixels, there = (
        jnp.zeros(number.size, jnp.int32).at[number].add(chosen.reshape(-1).astype(jnp.int32))
        for chosen in (standing, opening)
    )
    return standing & (there > HANGING * pixels)[surface]


def draw(key: Key[Array, ""], chosen: Bool[Array, " p"], count: int) -> tuple[Int[Array, " count"], Int[Array, ""]]:
    """Random indices of true elements in ascending order, one from each of `count` equal shares of them.

    Neighbouring shares may give the same element, and do if there are few; if none is true, all indices are 0.

    Returns:
      The indices, and how many elements are true.
    """
    blocks = jnp.pad(chosen, (0, -chosen.size % _BLOCK)).reshape(-1, _BLOCK)
    ends = jnp.cumsum(jnp.sum(blocks, axis=1, dtype=jnp.int32))
    total = ends[-1]
    share = (jnp.arange(count) + jax.random.uniform(key, (count,))) / count
    rank = jnp.minimum(jnp.floor(share * total).astype(jnp.int32), jnp.maximum(total - 1, 0))
    block = jnp.minimum(jnp.searchsorted(ends, rank, side="right", method="scan"), len(ends) - 1)
    within = rank - jnp.where(block > 0, ends[block - 1], 0)
    passed = jnp.cumsum(blocks[block], axis=1, dtype=jnp.int32)
    index = block * _BLOCK + jnp.sum(passed <= within[:, None], axis=1)
    return jnp.where(total > 0, index, 0).astype(jnp.int32), total


def resample(
    key: Key[Array, ""], cloud: PointCloud, count: int = POINTS, surface: Int[Array, " p"] | None = None
) -> PointCloud:
    """A cloud of `count` of the valid points, up- or down-sampled at random (paper appendix B.1).

    A cloud without valid points stays without.

    Args:
      key: PRNG key.
      cloud: the points.
      count: how many are drawn.
      surface: the number of each point's surface, below the number of points. Of each with at least `_SMALL` points
        about `_LEAST` are drawn, as far as it has so many; without it small surfaces may be left out.
    """
    if surface is None:
        index, total = draw(key, cloud.valid, count)
    else:
        total = jnp.sum(cloud.valid, dtype=jnp.int32)
        size = jnp.zeros(cloud.valid.size, jnp.int32).at[surface].add(cloud.valid.astype(jnp.int32))[surface]
        most = jnp.where(size >= _SMALL, jnp.minimum(size, _LEAST) / jnp.maximum(size, 1), 0.0)
        ends = jnp.cumsum(jnp.where(cloud.valid, jnp.maximum(1.0, most * total / count), 0.0))
        share = (jnp.arange(count) + jax.random.uniform(key, (count,))) / count
        index = jnp.searchsorted(ends, share * ends[-1], side="right", method="scan")
        index = jnp.minimum(index, cloud.valid.size - 1)
    taken = jax.tree.map(lambda a: a[index], cloud)
    return taken.replace(valid=jnp.broadcast_to(total > 0, (count,)))
