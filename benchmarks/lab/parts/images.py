"""Images on which perception is measured: held-out scenes through each of the sensors."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Key

from mechsearch_jax.envs.camera.recognisers import true_labels
from mechsearch_jax.envs.world.world import TARGET, World, from_scenario
from mechsearch_jax.images.cloud import View
from mechsearch_jax.images.noise import NoiseModel, RandomDirection, TimeOfFlight, measured_depth, no_noise
from mechsearch_jax.runtime.errors import InputError, check_once
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.train.loop import HELD_OUT_SEED
from mechsearch_jax.train.scenes import PIXELS, cast_world, object_pixels, random_world
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import Scenario
from mechsearch_jax.workspace.shelf import Shelf

NOISES: Mapping[str, NoiseModel] = {"clean": no_noise, "gaussian": RandomDirection(), "time-of-flight": TimeOfFlight()}


class Shown(PyTreeNode):
    """The input of a method.

    Attributes:
      points: as measured, in the world [m], shape (h, w, 3); NaN where nothing was measured.
      labels: the true masks, as `envs.camera.recognisers.true_labels`, shape (h, w).
      depth: of the points along the camera's axis [m], shape (h, w); infinite where nothing is, NaN where nothing was
        measured.
    """

    points: jax.Array
    labels: jax.Array
    depth: jax.Array


class Look(PyTreeNode):
    """An image of a scene, and the visibility of its objects.

    Attributes:
      shown: the image.
      pixels: number of pixels of the full image that show each object, int32, shape (8,).
      visible: that number divided by the one without any other objects, shape (8,).
    """

    shown: Shown
    pixels: jax.Array
    visible: jax.Array


@dataclasses.dataclass(frozen=True)
class Scene:
    """A scene to recognise.

    Attributes:
      name: of the scenario, or of a generated scene.
      source: "held-out", or the name of a workcell, if generated; else "files".
      world: the true state.
    """

    name: str
    source: str
    world: World


def held_out_scenes(count: int, seed: int = 0, shelf: Shelf | None = None, source: str = "held-out") -> list[Scene]:
    """Random scenes as in training, with a seed that training refuses.

    Args:
      count: number of scenes.
      seed: of the scenes.
      shelf: of the scenes; the default if None.
      source: of the scenes.

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
      InputError: two have the same name, so that their results could not be distinguished.
    """
    check_once("two scenes", (scenario.name for scenario in scenarios))
    return [Scene(scenario.name, "files", from_scenario(scenario)) for scenario in scenarios]


@functools.partial(jax.jit, static_argnames=("camera", "shelf", "noise", "stride"))
def look(key: Key[Array, ""], camera: Camera, shelf: Shelf, world: World, noise: NoiseModel, stride: int) -> Look:
    """The image of a scene with a sensor's noise.

    Args:
      key: PRNG key of the noise.
      camera: static.
      shelf, noise: static.
      world: the scene.
      stride: distance of neighbouring rays in the full image, in pixels; static.
    """
    depth, owner, alone = cast_world(camera, shelf, world)
    points = noise(key, camera, depth)
    pixels = object_pixels(owner)
    return Look(
        Shown(points, true_labels(points, owner, shelf), measured_depth(camera, depth, points)),
        pixels * stride**2,
        pixels / jnp.maximum(alone[:TARGET], 1),
    )


def image_of(
    scenes: Sequence[Scene], index: int, noise: str, seed: int, view: View, shelf: Shelf
) -> tuple[Key[Array, ""], Look]:
    """A key for the measured method, and the image of a scene; the same on every call.

    Args:
      scenes: all scenes.
      index: of the scene.
      noise: name of the sensor.
      seed: of the noise and the key.
      view: which rays are cast.
      shelf: of the scenes.
    """
    key = jax.random.fold_in(jax.random.key(seed), list(NOISES).index(noise))
    sensing, rest = jax.random.split(jax.random.fold_in(key, index))
    return rest, look(sensing, view.camera, shelf, scenes[index].world, NOISES[noise], view.stride)


def check_images(command: str, scenes: Sequence[Scene], noises: Sequence[str]) -> None:
    """Check the scenes and the names of sensors that a command measures on.

    Raises:
      InputError: there are no scenes, or no noise, or a noise is unknown.
    """
    if not scenes:
        raise InputError(f"{command}: there are no scenes; give --scenes, or scenario files")
    if not noises:
        raise InputError(f"{command}: give at least one noise")
    unknown = next((name for name in noises if name not in NOISES), None)
    if unknown is not None:
        raise InputError(f'{command}: noise "{unknown}" is unknown; use {", ".join(NOISES)}')


def image_settings(scenes: Sequence[Scene], noises: Sequence[str], seed: int) -> dict[str, Any]:
    """The settings of measurements on images, for results."""
    sources = [scene.source for scene in scenes]
    return {
        "held_out_scenes": len(sources) - sources.count("files"),
        "scenario_files": sources.count("files"),
        "noises": {name: getattr(NOISES[name], "__name__", repr(NOISES[name])) for name in noises},
        "seed": seed,
        "least_pixels": PIXELS,
    }
