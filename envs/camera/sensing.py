"""What a camera senses that is not where the planner takes it to be, or that measures otherwise than usual.

All of it is data, so that a sweep over it compiles once.
"""

from __future__ import annotations

import dataclasses
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mechsearch_jax.envs.camera.colour_image import ColourSensing
from mechsearch_jax.envs.camera.holes import HOLES, DrawnHoles
from mechsearch_jax.envs.camera.sensors import SENSORS, Sensor
from mechsearch_jax.envs.camera.simulated_camera import Image
from mechsearch_jax.envs.world.mismatch import Mismatch, TrueCell
from mechsearch_jax.envs.world.world import TARGET, World
from mechsearch_jax.geometry.footprints import extents
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import inverse, matmul, transform
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.workspace.camera import Camera

Bodies = TypeVar("Bodies", World, Superquadrics)


class Place(PyTreeNode):
    """Where the world is in the planner's frame, which is that of the robot's base; see `Mismatch`.

    Attributes:
      T_base_world: pose of the world in the base's frame, shape (..., 4, 4).
      T_seen_world: where it seems to be to a planner that takes the camera to be elsewhere, shape (..., 4, 4).
    """

    T_base_world: jax.Array | np.ndarray
    T_seen_world: jax.Array | np.ndarray


class Sensing(PyTreeNode):
    """How what is seen in an episode differs from what the planner assumes.

    Attributes:
      place: where the world is; None where the planner takes it to be.
      noise: of the depth; None for the recogniser's.
      colour: of the colour image; None for the recogniser's.
      sizes: factors on the objects' true half-extents along their own axes, shape (..., 8, 3); None for none.
      holes: of the depth; None for none.
    """

    place: Place | None = None
    noise: Sensor | None = None
    colour: ColourSensing | None = None
    sizes: jax.Array | np.ndarray | None = None
    holes: DrawnHoles | None = None


def sensing_of(mismatch: Mismatch, cell: TrueCell) -> Sensing | None:
    """The sensing of an episode, as NumPy arrays; None if it is as the planner assumes."""
    place, noise, colour, sizes, holes = None, None, None, None, None
    if mismatch.moves_camera:
        T_base_world = np.linalg.inv(cell.T_world_base)
        T_seen_world = np.linalg.inv(cell.T_base_moved) @ T_base_world
        place = Place(*(np.asarray(T, np.float32) for T in (T_base_world, T_seen_world)))
    if mismatch.measures_otherwise:
        noise = SENSORS[mismatch.sensor]
        scatter = mismatch.depth_noise if mismatch.sensor == "ideal" else noise.scatter
        missing = mismatch.missing_depth + noise.missing * (1.0 - mismatch.missing_depth)
        noise = jax.tree.map(np.float32, noise.replace(scatter=scatter, missing=missing))
    if mismatch.colours_otherwise:
        numbers = (mismatch.colour_noise, mismatch.exposure, mismatch.white_balance, mismatch.hue_gap)
        colour = ColourSensing(*(np.asarray(n, np.float32) for n in numbers))
    if mismatch.resizes:
        sizes = np.asarray(cell.seen_size[:TARGET], np.float32)
    if mismatch.holes != "none":
        kinds = jax.tree.map(
            lambda n: np.asarray(n, bool if isinstance(n, bool) else np.float32), HOLES[mismatch.holes]
        )
        holes = DrawnHoles(np.asarray(cell.holes_seed, np.uint32), kinds)
    parts = place, noise, colour, sizes, holes
    return None if all(part is None for part in parts) else Sensing(*parts)


def true_camera(camera: Camera, sensing: Sensing | None) -> Camera:
    """A camera where it is in the world, from where the planner takes it to be."""
    if sensing is None or sensing.place is None:
        return camera
    T_world_seen = inverse(jnp.asarray(sensing.place.T_seen_world))
    rotation = matmul(T_world_seen[:3, :3], jnp.array(camera.rotation))
    position = transform(T_world_seen, jnp.array(camera.position))
    rows = tuple(tuple(rotation[i, j] for j in range(3)) for i in range(3))
    return dataclasses.replace(camera, rotation=rows, position=tuple(position[i] for i in range(3)))


def sensed_depth(camera: Camera, world: World, image: Image, sensing: Sensing | None) -> Float[Array, "h w"]:
    """The true depth of an image [m], infinite where nothing is, NaN where it is not measured.

    Args:
      camera: of the image.
      world: the bodies in it.
      image: as `observe` returns it.
      sensing: of the episode.
    """
    if sensing is None or sensing.holes is None:
        return image.depth
    return jnp.where(sensing.holes.of(camera, world, image), jnp.nan, image.depth)


def as_seen(bodies: Bodies, sensing: Sensing | None) -> Bodies:
    """Bodies where they seem to be to the planner."""
    return bodies if sensing is None or sensing.place is None else _moved(bodies, sensing.place.T_seen_world)


def resized(objects: Superquadrics, sensing: Sensing | None) -> Superquadrics:
    """Objects as large as they seem to be, each with its lowest point as low as before.

    An approximation: a body of several parts keeps its proportions, and has the mean of its factors.
    """
    if sensing is None or sensing.sizes is None:
        return objects
    factors = jnp.asarray(sensing.sizes)
    parts = objects.parts
    if parts is not None:
        factors = jnp.broadcast_to(jnp.exp(jnp.mean(jnp.log(factors), axis=-1, keepdims=True)), factors.shape)
        scale = factors[:, None]
        parts = parts.replace(size=parts.size * scale, position=parts.position * scale)
    larger = objects.replace(size=objects.size * factors, parts=parts)
    down = jnp.array([[0.0], [0.0], [1.0]])
    lower = extents(larger, down) - extents(objects, down)
    return larger.replace(position=larger.position + lower * down.T)


def in_base(bodies: Bodies, sensing: Sensing | None) -> Bodies:
    """Bodies where they are in the frame of the robot's base."""
    return bodies if sensing is None or sensing.place is None else _moved(bodies, sensing.place.T_base_world)


def _moved(bodies: Bodies, T: Float[Array | np.ndarray, "*batch 4 4"]) -> Bodies:
    T = jnp.asarray(T)[..., None, :, :]
    return bodies.replace(
        position=transform(T, bodies.position), rotation=matmul(T[..., :3, :3], jnp.asarray(bodies.rotation))
    )
