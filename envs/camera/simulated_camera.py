"""What the camera sees: an exact ray-cast of the bodies and the shelf.

Every ray is cut with every body in closed form: neither a display nor OpenGL is needed, and depth is exact to float32.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from functools import partial
from operator import add, sub

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.envs.camera.compound_rays import cast_solids, solid_normals
from mechsearch_jax.envs.world.model import shelf_corners
from mechsearch_jax.envs.world.world import BODIES, TARGET, World
from mechsearch_jax.geometry.transforms import rotate
from mechsearch_jax.runtime.compiled import cached_jit
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.shapes import by_shape, in_order, shape_of
from mechsearch_jax.shapes.compound import MOST_SOLIDS
from mechsearch_jax.workspace.camera import Camera, pixel_rays, project, rays
from mechsearch_jax.workspace.detector import found_pixels
from mechsearch_jax.workspace.shelf import Shelf

BACKGROUND, SHELF = -1, BODIES

# Colour of each slot, the target (red, as in the paper) and the shelf.
PALETTE = np.array(
    [
        (0.35, 0.55, 0.80),
        (0.95, 0.75, 0.35),
        (0.45, 0.72, 0.45),
        (0.62, 0.47, 0.75),
        (0.40, 0.75, 0.75),
        (0.85, 0.60, 0.70),
        (0.65, 0.52, 0.42),
        (0.60, 0.65, 0.35),
        (0.7282, 0.1558, 0.2099),
        (0.82, 0.79, 0.74),
    ],
    np.float32,
)
BACKGROUND_COLOUR = (1.0, 1.0, 1.0)
LIGHT = (-0.62, 0.25, 0.74)
AMBIENT = 0.55
# Windows around the target have a multiple of so many rows and columns.
WINDOW_BLOCK = 16
# Half-extents of a usual target, 0.1 m tall [m].
USUAL_HALF_SIZE = (0.02, 0.02, 0.05)
# What the shelf is made of.
_BOARD = shape_of("box")


class Image(PyTreeNode):
    """An image of the shelf.

    Attributes:
      depth: along the camera's axis [m], shape (h, w); infinite where a ray hits nothing.
      segmentation: what a pixel shows, int8, shape (h, w): -1 nothing, 0 to 7 an object's slot, 8 the target, 9 the
        shelf.
      colour: red, green and blue in 0 to 1, shape (h, w, 3).
    """

    depth: jax.Array
    segmentation: jax.Array
    colour: jax.Array


class Appearance(PyTreeNode):
    """How the bodies and the shelf look.

    Attributes:
      colours: red, green and blue in 0 to 1 of each object's slot, the target and the shelf, shape (10, 3).
      light: the direction towards the light, in the world, of any length, shape (3,).
    """

    colours: jax.Array | np.ndarray
    light: jax.Array | np.ndarray


def _local(rotation: Array, vector: Array) -> list[Array]:
    """The components of world vectors (..., 3) in a body's frame."""
    x, y, z = (vector[..., k] for k in range(3))
    return [rotation[0, i] * x + rotation[1, i] * y + rotation[2, i] * z for i in range(3)]


def cast_body(
    camera: Camera, world: World, slot: Array | int, directions: Float[Array, "*pixels 3"]
) -> Float[Array, "*pixels"]:
    """Depth of one body along rays from the camera [m]; infinite where a ray misses it.

    Args:
      camera: where the rays start.
      world: the bodies.
      slot: the body's.
      directions: of unit depth, as `pixel_rays` returns them.
    """
    origin = _local(world.rotation[slot], jnp.array(camera.position) - world.position[slot])
    direction = _local(world.rotation[slot], directions)
    cuts = [partial(shape.cut, origin, direction, world.half_size[slot], jnp) for shape in in_order()]
    shown = jax.lax.switch(world.kind[slot], cuts)
    return jnp.where(world.valid[slot], shown, jnp.inf)


def _cast_bodies(
    camera: Camera, world: World, directions: Float[Array, "*pixels 3"]
) -> tuple[Float[Array, "*pixels"], Int[Array, "*pixels"]]:
    """Depth along each ray and the slot of the first body that it hits; infinity and -1 where it hits none."""
    if world.compounds is not None:
        depth, solid = cast_solids(camera, world, directions)
        return depth, (solid // MOST_SOLIDS).astype(jnp.int8)

    def nearer(i, best):
        depth, owner = best
        candidate = jax.lax.cond(
            world.valid[i],
            lambda i: cast_body(camera, world, i, directions),
            lambda _: jnp.full(directions.shape[:-1], jnp.inf, directions.dtype),
            i,
        )
        return jnp.minimum(depth, candidate), jnp.where(candidate < depth, jnp.int8(i), owner)

    nothing = jnp.full(directions.shape[:-1], jnp.inf, directions.dtype)
    none = jnp.full(directions.shape[:-1], BACKGROUND, jnp.int8)
    return jax.lax.fori_loop(0, BODIES, nearer, (nothing, none))


def cast_shelf(camera: Camera, shelf: Shelf, directions: Float[Array, "*pixels 3"]) -> Float[Array, "*pixels"]:
    """Depth of the empty shelf along rays from the camera [m]; infinite where a ray misses it."""
    depth = jnp.full(directions.shape[:-1], jnp.inf, directions.dtype)
    for name, (low, high) in shelf_corners(shelf).items():
        centre, half = ([sign(a, b) / 2 for a, b in zip(high, low, strict=True)] for sign in (add, sub))
        origin = [jnp.float32(camera.position[i] - centre[i]) for i in range(3)]
        towards = [directions[..., i] for i in range(3)]
        shown = _BOARD.cut(origin, towards, jnp.array(half, jnp.float32), jnp)
        depth = jnp.minimum(depth, shown if name == "board" else jnp.where(shelf.is_open(name), jnp.inf, shown))
    return depth


def mirrored_depth(camera: Camera, world: World, shelf: Shelf) -> Float[Array, "h w"]:
    """Depth of the bodies' mirror images in a board without end [m]; infinite where a ray meets none.

    A ray that the board reflects is one that starts as far below the board as the camera stands above.
    """
    x, y, z = camera.position
    below = dataclasses.replace(camera, position=(x, y, 2.0 * shelf.board - z))
    return _cast_bodies(below, world, rays(camera) * jnp.array([[[1.0, 1.0, -1.0]]]))[0]


def _normals(camera: Camera, shelf: Shelf, world: World, directions: Array, depth: Array, owner: Array) -> Array:
    """Outward normals in the world, from each point's place on its body or in the shelf."""
    flat = depth.shape
    directions, depth, owner = directions.reshape(-1, 3), depth.reshape(-1), owner.reshape(-1)
    point = jnp.array([camera.position]) + directions * jnp.where(jnp.isfinite(depth), depth, 0.0)[:, None]
    slot = jnp.clip(owner, 0, TARGET)
    rotation = world.rotation[slot]
    offset = point - world.position[slot]
    local = rotate(jnp.swapaxes(rotation, -1, -2), offset)
    half = world.half_size[slot]
    chosen = by_shape(world.kind[slot][..., None], lambda shape: shape.normal(local, half, jnp), jnp)
    chosen = chosen / jnp.maximum(jnp.linalg.norm(chosen, axis=-1, keepdims=True), 1e-9)
    body = rotate(rotation, chosen)
    walls = _wall_normals(shelf, point)
    return jnp.where((owner == SHELF)[:, None], walls, body).reshape(*flat, 3)


def _wall_normals(shelf: Shelf, point: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Outward normals of the shelf at points on it."""
    x, y, z = (point[..., k] for k in range(3))
    walls = shelf.walls
    gaps = jnp.stack(
        [jnp.abs(x - walls.back), jnp.abs(y - walls.right), jnp.abs(y - walls.left), jnp.abs(z - shelf.board)], axis=-1
    )
    normals = jnp.array([(-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (-1.0, 0.0, 0.0)])
    wall = jnp.where(jnp.min(gaps, axis=-1) < 1e-4, jnp.argmin(gaps, axis=-1), 4)
    return normals[wall]


def _first_solids(camera: Camera, shelf: Shelf, world: World, directions: Array) -> tuple[Array, Array, Array]:
    """Depth, owner and normal of what rays hit first, as `_first_bodies` of a world with compounds."""
    depth, solid = cast_solids(camera, world, directions)
    behind = cast_shelf(camera, shelf, directions)
    owner = jnp.where(behind < depth, jnp.int8(SHELF), (solid // MOST_SOLIDS).astype(jnp.int8))
    depth = jnp.minimum(depth, behind)
    reached = directions * jnp.where(jnp.isfinite(depth), depth, 0.0)[..., None]
    point = jnp.array([camera.position]) + reached.reshape(-1, 3)
    body = solid_normals(world, point, solid.reshape(-1))
    normals = jnp.where((owner == SHELF).reshape(-1, 1), _wall_normals(shelf, point), body)
    return depth, owner, normals.reshape(directions.shape)


def _first_bodies(camera: Camera, shelf: Shelf, world: World, directions: Array) -> tuple[Array, Array, Array]:
    """Depth along each ray, what it hits first, as `Image.segmentation`, and the normal there."""
    if world.compounds is not None:
        return _first_solids(camera, shelf, world, directions)
    depth, owner = _cast_bodies(camera, world, directions)
    behind = cast_shelf(camera, shelf, directions)
    owner = jnp.where(behind < depth, jnp.int8(SHELF), owner)
    depth = jnp.minimum(depth, behind)
    return depth, owner, _normals(camera, shelf, world, directions, depth, owner)


@cached_jit()
def observe(camera: Camera, world: World, shelf: Shelf | None = None, appearance: Appearance | None = None) -> Image:
    """The camera's image of the shelf and everything on it; the robot is out of the way.

    Args:
      camera: the camera.
      world: the bodies.
      shelf: the shelf; the default shelf if None.
      appearance: of everything in the image; that of pictures, `PALETTE` or a compound's own colour in the light from
        `LIGHT`, if None.
    """
    shelf = shelf or Shelf()
    appearance = _pictured(world) if appearance is None else appearance
    directions = rays(camera)
    depth, owner, normals = _first_bodies(camera, shelf, world, directions)
    light = _unit(appearance.light)
    shade = AMBIENT + (1.0 - AMBIENT) * jnp.maximum(sum(normals[..., k] * light[k] for k in range(3)), 0.0)
    colour = jnp.asarray(appearance.colours)[jnp.clip(owner, 0, SHELF)] * shade[..., None]
    colour = jnp.where((owner == BACKGROUND)[..., None], jnp.array([[BACKGROUND_COLOUR]]), colour)
    return Image(depth, owner, colour)


def _pictured(world: World) -> Appearance:
    """The appearance in pictures: objects that are compounds have their own colours, if they have any."""
    colours: jax.Array | np.ndarray = PALETTE
    if world.compounds is not None:
        given = world.compounds.matter.colour
        if world.target is not None:
            given = given.at[TARGET].set(jnp.nan)
        bodies = jnp.where(jnp.isnan(given), PALETTE[:BODIES], given)
        colours = jnp.concatenate([bodies, PALETTE[BODIES:]])
    return Appearance(colours, np.array(LIGHT))


def _unit(vector: jax.Array | np.ndarray) -> jax.Array | np.ndarray:
    """A vector of length 1, by the library of the argument, so that a constant stays as exact as it is."""
    library = np if isinstance(vector, np.ndarray) else jnp
    return vector / library.linalg.norm(vector)


def target_window(camera: Camera, half_size: Sequence[float] = USUAL_HALF_SIZE) -> int:
    """Side of a window of a camera's image that holds a target anywhere on the shelf, in pixels.

    Args:
      camera: must not be traced. Recalibrating a camera hardly ever changes the window.
      half_size: of the target [m]; one that is smaller than the usual has the usual one's window.
    """
    larger = max(math.hypot(*map(float, half_size)) / math.hypot(*USUAL_HALF_SIZE), 1.0)
    side = math.ceil(0.36 * larger * max(camera.fx, camera.fy) / WINDOW_BLOCK) * WINDOW_BLOCK
    return min(side, max(camera.width, camera.height))


def window_of(camera: Camera, world: World) -> int:
    """`target_window` of the target in a world; the usual one's if it is no compound."""
    if world.target is not None:
        return target_window(camera, world.target.room)
    return target_window(camera)


def target_pixels(camera: Camera, world: World, window: int | None = None) -> Int[Array, ""]:
    """How many pixels of the target the camera sees: those of `observe`, counted in a window around the target only.

    The shelf is left out: it hides none of the bodies on it from this camera.

    Args:
      camera: the camera.
      world: the bodies.
      window: side of the window; `window_of` if None; required for a traced camera.
    """
    return pixels_in_window(camera, world, window or window_of(camera, world))


@cached_jit(static_argnames=("window",))
def pixels_in_window(camera: Camera, world: World, window: int) -> Int[Array, ""]:
    """`target_pixels` in a window of a given side in pixels, which is static."""
    return _pixels_in_window(camera, world, window, 1)


@cached_jit(static_argnames=("window", "stride"))
def pixels_in_windows(
    camera: Camera,
    world: World,
    places: Float[Array, "b 3"],
    turns: Float[Array, "b 3 3"],
    window: int,
    stride: int,
) -> Int[Array, " b"]:
    """`pixels_in_window` with the target at each of several places, in every `stride`-th row and column alone.

    Args:
      camera, world: the scene.
      places, turns: `t_world_target` [m] and `R_world_target`.
      window, stride: in pixels; static.
    """

    def pixels(place: Array, turn: Array) -> Int[Array, ""]:
        position, rotation = world.position.at[TARGET].set(place), world.rotation.at[TARGET].set(turn)
        return _pixels_in_window(camera, world.replace(position=position, rotation=rotation), window, stride)

    return jax.lax.map(lambda where: pixels(*where), (places, turns), batch_size=8)


def _pixels_in_window(camera: Camera, world: World, window: int, stride: int) -> Int[Array, ""]:
    """`target_pixels` in a window, in every `stride`-th of its rows and columns."""
    centre, _ = project(camera, world.position[TARGET])
    corner = jnp.floor(centre - (window - 1) / 2)
    steps = jnp.arange(0, window, stride)
    rows = corner[0] + steps[:, None] + jnp.zeros((1, len(steps)))
    columns = corner[1] + steps[None, :] + jnp.zeros((len(steps), 1))
    inside = (rows >= 0) & (rows < camera.height) & (columns >= 0) & (columns < camera.width)
    _, owner = _cast_bodies(camera, world, pixel_rays(camera, rows, columns))
    return jnp.sum(inside & (owner == TARGET))


def is_found(camera: Camera, world: World, window: int | None = None) -> Bool[Array, ""]:
    """Whether the detector sees the target: more of its pixels than `found_pixels`, 100 at 1280 x 720.

    Args:
      camera, world, window: as of `target_pixels`.
    """
    # Not weakly typed, so that functions that take it are compiled once.
    return jnp.asarray(target_pixels(camera, world, window) > found_pixels(camera), bool)
