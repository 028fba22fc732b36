"""Images that perception is measured on: scenes that no training has seen, looked at through each of the sensors."""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Mapping, Sequence
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Key

from mechsearch_jax.envs.camera.recognisers import true_labels
from mechsearch_jax.envs.world.world import TARGET, World, from_scenario
from mechsearch_jax.images.cloud import View
from mechsearch_jax.images.noise import NoiseModel, RandomDirection, TimeOfFlight, measured_depth, no_noise
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike, replacing
from mechsearch_jax.train.loop import HELD_OUT_SEED
from mechsearch_jax.train.scenes import cast_world, random_world
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import Scenario
from mechsearch_jax.workspace.shelf import Shelf

NOISES: Mapping[str, NoiseModel] = {"clean": no_noise, "gaussian": RandomDirection(), "time-of-flight": TimeOfFlight()}


class Shown(flax.struct.PyTreeNode):
    """What methods see of a scene.

    Attributes:
      points: as measured, in the world [m], shape (h, w, 3); NaN where nothing was.
      labels: the true masks, as `envs.camera.recognisers.true_labels` has them, shape (h, w).
      depth: of the points along the camera's axis [m], shape (h, w); infinite where nothing is, NaN where nothing was
        measured.
    """

    points: jax.Array
    labels: jax.Array
    depth: jax.Array


class Look(flax.struct.PyTreeNode):
    """An image of a scene, and how much of its objects it shows.

    Attributes:
      shown: the image.
      pixels: of the full image that show each object, int32, shape (8,).
      visible: that number over the one that there would be if the object stood alone, shape (8,).
    """

    shown: Shown
    pixels: jax.Array
    visible: jax.Array


@dataclasses.dataclass(frozen=True)
class Scene:
    """A scene to recognise.

    Attributes:
      name: of the scenario, or of a generated scene.
      source: "held-out", or the name of a camera and shelf, if generated; else "files".
      world: where everything stands.
    """

    name: str
    source: str
    world: World


def held_out_scenes(count: int, seed: int = 0, shelf: Shelf | None = None, source: str = "held-out") -> list[Scene]:
    """Random scenes as in training, of a seed that training refuses.

    Args:
      count: how many.
      seed: of the scenes.
      shelf: what they stand on; the default if None.
      source: what they are called.

    Raises:
      InputError: the numbers do not fit.
    """
    if count < 0:
        raise InputError(f"--scenes {count} must be at least 0")
    if not 0 <= seed < 2**31:
        raise InputError(f"--seed {seed} must be from 0 to {2**31 - 1}")
    key = jax.random.fold_in(jax.random.key(HELD_OUT_SEED), seed)
    make = jax.jit(functools.partial(random_world, shelf=shelf))
    return [Scene(f"{seed}-{i}", source, make(jax.random.fold_in(key, i))) for i in range(count)]


def scenes_of(scenarios: Sequence[Scenario]) -> list[Scene]:
    """Scenes from scenario files.

    Raises:
      InputError: two have the same name, so that results could not be told apart.
    """
    names = [scenario.name for scenario in scenarios]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(f'two scenarios have the name "{twice}"; rename one')
    return [Scene(scenario.name, "files", from_scenario(scenario)) for scenario in scenarios]


@functools.partial(jax.jit, static_argnames=("camera", "shelf", "noise", "stride"))
def look(key: Key[Array, ""], camera: Camera, shelf: Shelf, world: World, noise: NoiseModel, stride: int) -> Look:
    """The image of a scene with a sensor's noise.

    Args:
      key: PRNG key of the noise.
      camera: of which `stride` is the distance of neighbouring rays in the full image, in pixels; static.
      shelf, noise: static.
      world: the scene.
    """
    depth, owner, alone = cast_world(camera, shelf, world)
    points = noise(key, camera, depth)
    pixels = jnp.sum(owner[..., None] == jnp.arange(TARGET).reshape(1, 1, -1), axis=(0, 1))
    return Look(
        Shown(points, true_labels(points, owner, shelf), measured_depth(camera, depth, points)),
        pixels * stride**2,
        pixels / jnp.maximum(alone[:TARGET], 1),
    )


def image_of(
    scenes: Sequence[Scene], index: int, noise: str, seed: int, view: View, shelf: Shelf
) -> tuple[Key[Array, ""], Look]:
    """A key for what is measured, and the image of a scene; the same on every call.

    Args:
      scenes: of which one is looked at.
      index: which.
      noise: name of the sensor.
      seed: of the noise and the key.
      view: which rays are cast.
      shelf: what the scenes stand on.
    """
    key = jax.random.fold_in(jax.random.key(seed), list(NOISES).index(noise))
    sensing, rest = jax.random.split(jax.random.fold_in(key, index))
    return rest, look(sensing, view.camera, shelf, scenes[index].world, NOISES[noise], view.stride)


def named(noise: NoiseModel) -> str:
    """A sensor with its settings, as results name it."""
    return getattr(noise, "__name__", repr(noise))


def save_rows(value: dict[str, Any], rows: Sequence[Any], path: PathLike) -> None:
    """Write figures as JSON, and below them one line for every row, from which they follow.

    Args:
      value: the figures.
      rows: dataclasses of one kind; at least one.
      path: of the file.

    Raises:
      InputError: the file cannot be written.
    """
    columns = [field.name for field in dataclasses.fields(rows[0])]
    head = json.dumps(value | {"columns": columns}, indent=1, allow_nan=False)
    lines = (json.dumps([getattr(row, name) for name in columns], allow_nan=False) for row in rows)
    text = head.removesuffix("\n}") + ',\n "rows": [\n  ' + ",\n  ".join(lines) + "\n ]\n}\n"
    with replacing(path) as file:
        file.write(text.encode())
