"""Images of scenes for `benchmarks.lab.looks.looks`: MuJoCo casts the rays, colours are those of recognition `full`."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, UInt8

from mechsearch_jax.envs.camera.colour_image import LEVELS, ColourSensing, drawn_appearance, scene_key, sensed_colour
from mechsearch_jax.envs.camera.simulated_camera import AMBIENT
from mechsearch_jax.envs.cell.simulated_cell import BACKGROUND_COLOUR, ROBOT_COLOUR, SensorNoise, SimulatedCell
from mechsearch_jax.envs.world.mismatch import USUAL_HUE_GAP
from mechsearch_jax.envs.world.world import from_scenario
from mechsearch_jax.images.colour import RED
from mechsearch_jax.images.noise import TimeOfFlight, depth_of
from mechsearch_jax.problem.workcell import Workcell
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.scenario import Scenario


@dataclasses.dataclass(frozen=True, eq=False)
class Picture:
    """An image of a scene before noise.

    Attributes:
      depth: [m], shape (H, W); infinite where nothing is.
      colour: shape (H, W, 3).
      owner: the body's slot of each pixel, the target last; larger or negative for anything else.
    """

    depth: Float[np.ndarray, "h w"]
    colour: UInt8[np.ndarray, "h w 3"]
    owner: Int[np.ndarray, "h w"]


def taken(workcell: Workcell, scenario: Scenario, target: tuple[float, float, float] = RED) -> Picture:
    """The image of a scene; the arm is at home.

    Objects and light are those that recognition `full` sees in an episode of this scene.

    Args:
      workcell: camera, shelf and arm.
      scenario: what stands on the shelf.
      target: the target's colour, red, green and blue in 0 to 1.
    """
    cell = SimulatedCell(workcell, scenario, noise=SensorNoise(0.0, 0.0, 0.0))
    depth, normal, owner = cell.shown()
    look = drawn_appearance(scene_key(from_scenario(scenario)), target, USUAL_HUE_GAP)
    colours = np.array([*np.asarray(look.colours, float), ROBOT_COLOUR, BACKGROUND_COLOUR])
    light = np.asarray(look.light, float)
    shade = AMBIENT + (1.0 - AMBIENT) * np.maximum(normal @ (light / np.linalg.norm(light)), 0.0)
    # A negative owner takes the last colour.
    colour = colours[owner] * np.where(owner < 0, 1.0, shade)[..., None]
    levels = np.round(LEVELS * np.clip(colour, 0.0, 1.0)).astype(np.uint8)
    return Picture(depth.astype(np.float32), levels, owner.astype(np.int8))


def noisy_depth(workcell: Workcell, picture: Picture, noise: str, seed: int) -> Float[np.ndarray, "h w"]:
    """The depth image as a sensor measures it [m]; 0 where nothing was measured.

    Raises:
      InputError: the noise is unknown.
    """
    depth = picture.depth
    match noise:
        case "clean":
            measured = depth
        case "gaussian":
            measured = depth + np.random.default_rng(seed).normal(0.0, 0.001, depth.shape)
        case "time-of-flight":
            points = TimeOfFlight()(jax.random.key(seed), workcell.camera, jnp.asarray(depth))
            measured = np.asarray(depth_of(workcell.camera, points))
        case _:
            raise InputError(f'lab looks: noise "{noise}" is unknown; use clean, gaussian or time-of-flight')
    return np.where(np.isfinite(measured), measured, 0.0).astype(np.float32)


def noisy_colour(picture: Picture, seed: int) -> UInt8[np.ndarray, "h w 3"]:
    """The colour image as the camera of recognition `full` takes it."""
    clean = jnp.asarray(picture.colour, jnp.float32) / LEVELS
    colour = sensed_colour(jax.random.fold_in(jax.random.key(seed), 1), clean, ColourSensing())
    return np.round(LEVELS * np.asarray(colour)).astype(np.uint8)
