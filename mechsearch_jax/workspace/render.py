"""Depth images of superquadrics, by the first crossing of each ray with each surface (docs/method.md, "Depth")."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.geometry import superquadric
from mechsearch_jax.geometry.bodies import placed_parts, world_parts
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import make, rotate, transform
from mechsearch_jax.runtime.own_settings import in_own_settings
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.workspace.camera import Camera, pixel_rays, project, rays

NEWTON_STEPS = 8
GRAZING = 2e-3


def _slab_chord(size, origin, direction):
    """Where rays enter and leave the box around a superquadric; `enter > leave` if they miss."""
    safe = jnp.where(jnp.abs(direction) < 1e-9, jnp.where(direction < 0, -1e-9, 1e-9), direction)
    a, b = (jnp.broadcast_to(side - origin, safe.shape) / safe for side in (-size, size))
    return jnp.max(jnp.minimum(a, b), axis=-1), jnp.min(jnp.maximum(a, b), axis=-1)


def cast(
    size: Float[Array, "3"],
    exponents: Float[Array, "2"],
    origin: Float[Array, "3"],
    direction: Float[Array, "*batch 3"],
) -> Float[Array, "*batch"]:
    """First crossings of rays with one superquadric, in its own frame.

    The gauge is convex along a ray, and at least 1 where the ray enters the bounding box: Newton's method from there
    approaches the first crossing from the near side, and a gauge that stops falling before it reaches 1 is a miss.

    Returns:
      The ray parameters of the crossings, infinite for a miss; differentiable in all arguments where finite.
    """
    enter, leave = _slab_chord(size, origin, direction)

    def gauge(t):
        # Coordinate by coordinate: vectors would be kept in memory for every pixel and step.
        places = [jnp.abs((origin[k] + t * direction[..., k]) / size[k]) for k in range(3)]
        return superquadric.unit_gauge(places, exponents)

    def value_and_slope(t):
        return jax.jvp(gauge, (t,), (jnp.ones_like(t),))

    def newton(_, t):
        value, slope = value_and_slope(t)
        step = jnp.where(slope < 0, (1.0 - value) / jnp.where(slope < 0, slope, -1.0), 0.0)
        return jnp.clip(t + jnp.maximum(step, 0.0), enter, jnp.maximum(enter, leave))

    t = jax.lax.stop_gradient(jax.lax.fori_loop(0, NEWTON_STEPS, newton, jnp.maximum(enter, 0.0)))
    value, slope = value_and_slope(t)
    hit = (enter <= leave) & (leave > 0.0) & (value <= 1.0 + GRAZING)
    # One more, differentiated step: by the implicit function theorem its gradient is that of the crossing.
    slope = jax.lax.stop_gradient(slope)
    descending = slope < -1e-6
    refined = t + jnp.where(descending, (1.0 - value) / jnp.where(descending, slope, -1.0), 0.0)
    return jnp.where(hit, refined, jnp.inf)


def object_depth(
    scene_object: Superquadrics,
    origin: Float[Array, "3"],
    directions: Float[Array, "*batch 3"],
) -> Float[Array, "*batch"]:
    """Depth of one object (a `Superquadrics` without its object axis) along world rays [m]; infinite for misses.

    The depth of a body of several parts is the least of theirs.
    """
    if scene_object.parts is not None:
        depths = jax.lax.map(lambda part: object_depth(part, origin, directions), placed_parts(scene_object))
        return jnp.min(depths, axis=0)
    inverse = scene_object.rotation.T
    local_origin = rotate(inverse, origin - scene_object.position)
    local = rotate(inverse, directions)
    depth = cast(scene_object.size, scene_object.exponents, local_origin, local.reshape(-1, 3))
    return jnp.where(scene_object.valid, depth, jnp.inf).reshape(local.shape[:-1])


@in_own_settings
def render_depth(camera: Camera, scene: Superquadrics) -> Float[Array, "h w"]:
    """Depth image of a scene, object by object and then the nearest.

    Args:
      camera: pinhole camera.
      scene: superquadrics with fields (N, ...).

    Returns:
      Depth along the optical axis [m], shape (height, width); infinite where no object is seen.
    """
    origin, directions = jnp.array(camera.position), rays(camera)
    depths = jax.lax.map(lambda part: object_depth(part, origin, directions), world_parts(scene))
    return jnp.min(depths, axis=0)


class Window(PyTreeNode):
    """One object's image: the depth at every `stride`-th pixel of a part of the camera's image.

    Attributes:
      depth: infinite beside the object, shape (h, w) [m].
      corner: row and column of the first pixel, int32, shape (2,).
      stride: number of the image's rows and columns for each row and column of the window, int32.
    """

    depth: jax.Array
    corner: jax.Array
    stride: jax.Array


def window_place(
    camera: Camera, scene_object: Superquadrics, window: tuple[int, int] | Float[Array, "2"]
) -> tuple[Int[Array, "2"], Int[Array, ""]]:
    """First row and column, and stride, of a window that contains the image of an object.

    The stride is the smallest with which the window contains the image of the object's bounding box, as far as it lies
    in the camera's image.
    """
    corners = jnp.stack(jnp.meshgrid(*[jnp.array([-1.0, 1.0])] * 3, indexing="ij"), axis=-1).reshape(8, 3)
    T_world_object = make(scene_object.rotation, scene_object.position)
    pixels, _ = project(camera, transform(T_world_object, corners * scene_object.size[None]))
    # Clip one pixel beyond the image, so that an object outside of it stays outside.
    limit = jnp.array([camera.height, camera.width], jnp.float32)
    low, high = (jnp.clip(bound, -1.0, limit) for bound in (jnp.min(pixels, axis=0), jnp.max(pixels, axis=0)))
    extent = jnp.array(window, jnp.float32)
    stride = jnp.maximum(jnp.max(jnp.ceil((jnp.ceil(high - low) + 1.0) / extent)), 1.0)
    corner = jnp.round((low + high) / 2.0 - (stride * extent - 1.0) / 2.0)
    return corner.astype(jnp.int32), stride.astype(jnp.int32)


@functools.partial(jax.jit, static_argnames=("window",))
def object_window(
    camera: Camera, scene_object: Superquadrics, window: tuple[int, int], part: Superquadrics | None = None
) -> Window:
    """Depth of one object in a window of fixed size around its image, with a stride if the image is larger.

    If a part of it is given, in the world, the window is the same, but the depth that part's.
    """
    corner, stride = window_place(camera, scene_object, window)
    rows, columns = jnp.meshgrid(jnp.arange(window[0]), jnp.arange(window[1]), indexing="ij")
    middle = (stride - 1) / 2.0
    row, column = rows * stride + corner[0] + middle, columns * stride + corner[1] + middle
    shown = scene_object if part is None else part
    depth = object_depth(shown, jnp.array(camera.position), pixel_rays(camera, row, column))
    return Window(depth, corner, stride)


def _window_pixels(
    corner: Int[Array, " n"], stride: Int[Array, " n"], size: int, count: int
) -> tuple[Int[Array, "n {count}"], Bool[Array, "n {count}"]]:
    """Along one axis, the index in each window of each pixel of an image, and whether it is in the window."""
    index = (jnp.arange(count)[None] - corner[:, None]) // stride[:, None]
    return jnp.clip(index, 0, size - 1), (index >= 0) & (index < size)


def merge_windows(camera: Camera, windows: Window) -> Float[Array, "height width"]:
    """The depth image of a scene from its objects' windows, which have a leading axis."""
    n, h, w = windows.depth.shape
    row, among_rows = _window_pixels(windows.corner[:, 0], windows.stride, h, camera.height)
    column, among_columns = _window_pixels(windows.corner[:, 1], windows.stride, w, camera.width)
    image = jnp.full((camera.height, camera.width), jnp.inf)
    # One after the other: their minimum along an axis would take a table of n images.
    for i in range(n):
        depth = windows.depth[i, row[i, :, None], column[i, None, :]]
        image = jnp.minimum(image, jnp.where(among_rows[i, :, None] & among_columns[i, None], depth, jnp.inf))
    return image
