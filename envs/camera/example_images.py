"""Makes the example images of the package: `python -m mechsearch_jax.envs.camera.example_images OUT.npz`."""

from __future__ import annotations

import sys

import jax.numpy as jnp
import numpy as np

from mechsearch_jax.envs.camera.recognisers import true_labels
from mechsearch_jax.envs.camera.simulated_camera import observe
from mechsearch_jax.envs.world.world import TARGET, from_scenario
from mechsearch_jax.images.examples import Images, save_images
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.camera import Camera, back_project
from mechsearch_jax.workspace.detector import found_pixels
from mechsearch_jax.workspace.scenario import Scenario, example_scenarios, load_scenario
from mechsearch_jax.workspace.shelf import Shelf

SCENARIO = "first-light"
SEED = 0
# Standard deviation of the depth [m], and the share of pixels without one.
NOISE = 0.001
LOST = 0.005


def sensed_images(scenario: Scenario, camera: Camera | None = None, seed: int = SEED) -> Images:
    """Images of a scenario by a noisy depth camera, with the true mask.

    Args:
      scenario: what stands on the shelf.
      camera: the default camera if None.
      seed: of the noise.
    """
    camera, shelf = camera or Camera(), Shelf()
    image = observe(camera, from_scenario(scenario), shelf)
    rng = np.random.default_rng(seed)
    depth = np.asarray(image.depth)
    noisy = depth + rng.normal(0.0, NOISE, depth.shape)
    measured = np.isfinite(depth) & (rng.random(depth.shape) >= LOST)
    depth = np.where(measured, noisy, 0.0).astype(np.float32)
    points = back_project(camera, jnp.where(measured, depth, jnp.nan))
    mask = np.asarray(true_labels(points, image.segmentation, shelf))
    colour = np.round(255 * np.clip(np.asarray(image.colour), 0.0, 1.0)).astype(np.uint8)
    seen = np.sum(np.asarray(image.segmentation) == TARGET) > found_pixels(camera)
    return Images(depth, colour, mask, TARGET if seen else None, camera)


def main() -> None:
    """Write the images of `SCENARIO` to the file that the command line names."""
    if len(sys.argv) != 2:
        raise InputError("usage: python -m mechsearch_jax.envs.camera.example_images OUT.npz")
    save_images(sensed_images(load_scenario(example_scenarios()[SCENARIO])), sys.argv[1])


if __name__ == "__main__":
    main()
