"""Random places of scenes: shelves and table tops of other sizes, and cameras that look at them."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Key

from mechsearch_jax.envs.world.world import World
from mechsearch_jax.images.cloud import middle
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf

# How far the walls of a room are from a table top's space [m].
_FAR = 4.0
# A camera is at least this far from bodies [m]; else it is moved back in so many such steps.
_CLEAR, _STEP, _STEPS = 0.15, 0.05, 32
# Rows of the height above the board of what the camera looks at, and deviation of its place [m].
_AIM, _OFF = (0.0, 0.12), 0.07


@dataclasses.dataclass(frozen=True)
class Places:
    """Distribution of shelves, table tops and cameras; ranges are uniform.

    A table top has no walls; its space bounds what counts as a thing. It has the middle of the usual shelf.

    Attributes:
      tables: share of table tops.
      table, shelf: ranges of the depth, width and height of their spaces [m].
      spread: range of the share of a table top's space over which things are spread, along both of its sides.
      distance: range of the camera's distance from the middle of the bodies [m]; those too near a body are moved back.
      elevation, shelf_elevation: ranges of the angle by which it looks down, on a table top and into a shelf [rad].
      azimuth, shelf_azimuth: largest angle by which it stands to a side [rad].
      density: range of the pixels of a view's image for a metre at that distance.
    """

    tables: float = 0.7
    table: tuple[tuple[float, float], ...] = ((0.5, 0.8), (0.7, 1.2), (0.5, 0.7))
    shelf: tuple[tuple[float, float], ...] = ((0.28, 0.5), (0.4, 0.9), (0.24, 0.45))
    spread: tuple[float, float] = (0.35, 0.9)
    distance: tuple[float, float] = (0.4, 1.6)
    elevation: tuple[float, float] = (np.deg2rad(10.0), np.deg2rad(60.0))
    shelf_elevation: tuple[float, float] = (0.0, np.deg2rad(28.0))
    azimuth: float = np.deg2rad(90.0)
    shelf_azimuth: float = np.deg2rad(30.0)
    density: tuple[float, float] = (260.0, 620.0)

    def __post_init__(self):
        ranges = {name: (getattr(self, name),) for name in ("spread", "distance", "density")}
        for name, limits in {**ranges, "table": self.table, "shelf": self.shelf}.items():
            if len(limits) not in (1, 3) or not all(0 < low <= high for low, high in limits):
                raise InputError(f"Places: {name} {getattr(self, name)} must be ranges of positive numbers")
        for name in ("elevation", "shelf_elevation"):
            low, high = getattr(self, name)
            if not 0 <= low <= high < np.pi / 2:
                raise InputError(f"Places: {name} {getattr(self, name)} must be a range within 0 to pi / 2")
        if not (0 <= self.tables <= 1 and self.spread[1] <= 1 and min(self.azimuth, self.shelf_azimuth) >= 0):
            raise InputError("Places: tables and spread must be from 0 to 1, azimuth and shelf_azimuth at least 0")


def _uniform(key: Array, limits: tuple[float, float]) -> Array:
    return jax.random.uniform(key, minval=limits[0], maxval=limits[1])


def draw_place(key: Key[Array, ""], places: Places, usual: Shelf) -> tuple[Shelf, Shelf, Bool[Array, ""]]:
    """The space in which things are looked for, the boards around it, and whether it is a table top's."""
    pick, *keys = jax.random.split(key, 8)
    is_table = jax.random.bernoulli(pick, places.tables)
    sizes = [
        jnp.where(is_table, _uniform(k, table), _uniform(k, shelf))
        for k, table, shelf in zip(keys, places.table, places.shelf, strict=False)
    ]
    x, y, board = middle(usual)
    space = {"front": x - sizes[0] / 2, "back": x + sizes[0] / 2, "right": y - sizes[1] / 2, "left": y + sizes[1] / 2}
    spawn = []
    for i, centre in enumerate((x, y)):
        span = sizes[i] * jnp.where(is_table, _uniform(keys[3 + i], places.spread), 0.8)
        shift = jax.random.uniform(keys[5 + i], minval=-0.5, maxval=0.5) * (0.95 * sizes[i] - span)
        spawn.append((centre + shift - span / 2, centre + shift + span / 2))
    space |= {"ceiling": board + sizes[2], "spawn_x": spawn[0], "spawn_y": spawn[1]}
    shelf = dataclasses.replace(usual, **space)
    far = {name: space[name] - _FAR for name in ("front", "right")}
    far |= {name: space[name] + _FAR for name in ("back", "left", "ceiling")}
    # The board of a shelf sticks out of it no more than in the usual one.
    around = {name: jnp.where(is_table, far[name], space[name]) for name in far}
    return shelf, dataclasses.replace(shelf, **around), is_table


def draw_camera(
    key: Key[Array, ""], places: Places, world: World, shelf: Shelf, is_table: Bool[Array, ""], usual: Camera
) -> Camera:
    """A camera that looks at the bodies, with the size of the usual one's image."""
    keys = jax.random.split(key, 6)
    share = world.valid / jnp.maximum(jnp.sum(world.valid), 1)
    centre = jnp.where(
        jnp.any(world.valid), jnp.sum(share[:, None] * world.position, axis=0), jnp.stack(middle(_arrays(shelf)))
    )
    aim = centre.at[2].set(shelf.board + _uniform(keys[0], _AIM))
    aim = aim.at[:2].add(_OFF * jax.random.normal(keys[1], (2,)))
    elevation = jnp.where(is_table, _uniform(keys[2], places.elevation), _uniform(keys[2], places.shelf_elevation))
    most = jnp.where(is_table, places.azimuth, places.shelf_azimuth)
    azimuth = most * jax.random.uniform(keys[3], minval=-1.0)
    back = jnp.stack(
        [-jnp.cos(elevation) * jnp.cos(azimuth), jnp.cos(elevation) * jnp.sin(azimuth), jnp.sin(elevation)]
    )
    distances = _uniform(keys[4], places.distance) + _STEP * jnp.arange(_STEPS)
    spots = aim[None] + distances[:, None] * back[None]
    reach = jnp.linalg.norm(world.half_size, axis=-1) + _CLEAR
    apart = jnp.linalg.norm(spots[:, None] - world.position[None], axis=-1) > reach[None]
    distance = distances[jnp.argmax(jnp.all(apart | ~world.valid[None], axis=1))]
    focal = distance * jnp.exp(_uniform(keys[5], (float(np.log(places.density[0])), float(np.log(places.density[1])))))
    right = jnp.stack([jnp.sin(azimuth), jnp.cos(azimuth), jnp.zeros(())]) * -1.0
    return Camera(
        width=usual.width,
        height=usual.height,
        fx=focal,  # pyright: ignore[reportArgumentType]
        fy=focal,  # pyright: ignore[reportArgumentType]
        cx=jnp.float32(usual.width / 2),
        cy=jnp.float32(usual.height / 2),
        rotation=tuple(tuple(row) for row in jnp.stack([right, jnp.cross(-back, right), -back], axis=1)),
        position=tuple(aim + distance * back),
    )


def _arrays(shelf: Shelf) -> Shelf:
    return jax.tree.map(jnp.float32, shelf)
