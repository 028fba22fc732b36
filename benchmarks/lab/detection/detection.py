"""How well the target is detected in simulated depth and colour images, in dim, bright and tinted light.

Every scenario is looked at as it stands, where its target mostly hides, and with the target at random free places.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from mechsearch_jax.envs.camera.colour_image import ColourSensing
from mechsearch_jax.envs.camera.recognisers import ImageRecogniser, recogniser
from mechsearch_jax.envs.camera.sensing import Sensing
from mechsearch_jax.envs.camera.simulated_camera import observe, target_pixels
from mechsearch_jax.envs.camera.snapshot import Snapshot
from mechsearch_jax.envs.episode.episodes import target_of
from mechsearch_jax.envs.world.mismatch import USUAL_HUE_GAP
from mechsearch_jax.envs.world.world import TARGET, World, from_scenario
from mechsearch_jax.images.cloud import thinned_view
from mechsearch_jax.images.colour import RED, TargetColour
from mechsearch_jax.images.detection import ColouredDepth, detect
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.versions import versions
from mechsearch_jax.workspace.camera import Camera, back_project
from mechsearch_jax.workspace.detector import found_pixels
from mechsearch_jax.workspace.scenario import Scenario
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

COLOURS: Mapping[str, tuple[float, float, float]] = {"red": RED, "blue": (0.1, 0.3, 0.8), "yellow": (0.85, 0.7, 0.1)}
EXPOSURES, NOISES = (0.5, 1.0, 1.5), (0.0, 4.0, 8.0)
# A target that shows at most so many times the threshold is barely in sight.
BARELY = 2.0
# How often a free place is drawn before a scenario goes without one, and what is left free around the target [m].
TRIES, CLEARANCE = 50, 0.005


@dataclasses.dataclass(frozen=True)
class Condition:
    """The colours in an image and the camera that takes it.

    Attributes:
      target: name of its colour, one of `COLOURS`.
      exposure, white_balance, hue_gap: as in `ColourSensing`.
      noise: standard deviation of each channel, of 255.
    """

    target: str
    exposure: float = 1.0
    noise: float = 4.0
    white_balance: float = 0.0
    hue_gap: float = USUAL_HUE_GAP

    @property
    def sensing(self) -> ColourSensing:
        """The camera."""
        numbers = self.noise / 255, self.exposure, self.white_balance, self.hue_gap
        return ColourSensing(*(np.asarray(n, np.float32) for n in numbers))


def conditions() -> list[Condition]:
    """All exposures with all noises, and beside the usual ones two tints, and objects of hues like the target's."""
    lights = [Condition("", *numbers) for numbers in itertools.product(EXPOSURES, NOISES)]
    lights += [Condition("", white_balance=w) for w in (-0.1, 0.1)] + [Condition("", hue_gap=g) for g in (20.0, 0.0)]
    return [dataclasses.replace(light, target=name) for name in COLOURS for light in lights]


@dataclasses.dataclass(frozen=True)
class Looks:
    """What is detected in N scenes.

    Attributes:
      shown: number of the target's pixels in the full image, shape (N,).
      visible: whether the detector sees the target, shape (N,).
      true, found, right: numbers of pixels in the part of the image that is used: those of the target, those that are
        taken for it, and those that are both, shape (N,).
    """

    shown: np.ndarray
    visible: np.ndarray
    true: np.ndarray
    found: np.ndarray
    right: np.ndarray

    def figures(self, threshold: float) -> dict[str, Any]:
        """Rates of detection, and precision and recall of the pixels where a target in sight is detected.

        Args:
          threshold: a target of at most this many pixels of the full image is not in sight.
        """
        in_sight = self.shown > threshold
        barely = in_sight & (self.shown <= BARELY * threshold)
        detected = in_sight & self.visible
        false = self.visible & ~in_sight
        return {
            "in_sight": int(in_sight.sum()),
            "missed": int((in_sight & ~self.visible).sum()),
            "barely_in_sight": int(barely.sum()),
            "barely_missed": int((barely & ~self.visible).sum()),
            "out_of_sight": int((~in_sight).sum()),
            "false": int(false.sum()),
            # Of a target of a few pixels, too few to count.
            "false_on_target": int((false & (2 * self.right > self.found)).sum()),
            "missed_pixels": sorted(map(int, self.shown[in_sight & ~self.visible])),
            "precision": _mean(self.right[detected] / np.maximum(self.found[detected], 1)),
            "recall": _mean(self.right[detected] / np.maximum(self.true[detected], 1)),
        }


def _mean(values: Float[np.ndarray, " n"]) -> float | None:
    return round(float(values.mean()), 4) if values.size else None


def worlds_of(scenarios: Sequence[Scenario], places: int, seed: int, shelf: Shelf) -> World:
    """Each scenario's world, and the same with its target at random places where it overlaps nothing, as a batch.

    Args:
      scenarios: at least one.
      places: number of places for each; fewer where no free ones are found.
      seed: of the places.
      shelf: on which they are.
    """
    rng = np.random.default_rng(seed)
    worlds: list[World] = []
    for scenario in scenarios:
        world = from_scenario(scenario)
        free = itertools.islice(_free_places(world, rng, shelf), places)
        moved = [world.replace(position=world.position.at[TARGET, :2].set(jnp.asarray(xy))) for xy in free]
        worlds += [world, *moved]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *worlds)


def _free_places(world: World, rng: np.random.Generator, shelf: Shelf) -> Iterable[Float[np.ndarray, " 2"]]:
    """Random x and y [m] at which circles around target and objects do not overlap."""
    position, half_size, valid = (np.asarray(a) for a in (world.position, world.half_size, world.valid))
    radius = np.linalg.norm(half_size[:, :2], axis=1)
    low = np.array([shelf.front, shelf.right]) + radius[TARGET] + CLEARANCE
    high = np.array([shelf.back, shelf.left]) - radius[TARGET] - CLEARANCE
    for _ in range(TRIES):
        xy = rng.uniform(low, high).astype(np.float32)
        gap = np.linalg.norm(position[:TARGET, :2] - xy, axis=1) - radius[:TARGET] - radius[TARGET]
        if np.all(gap[valid[:TARGET]] > CLEARANCE):
            yield xy


@functools.partial(jax.jit, static_argnames=("eyes", "camera", "shelf"))
def _looks(
    eyes: ImageRecogniser,
    camera: Camera,
    shelf: Shelf,
    worlds: World,
    keys: Key[Array, " n"],
    sensing: ColourSensing,
) -> tuple[Array, ...]:
    """The fields of `Looks`."""
    view = thinned_view(camera, shelf)

    def look(scene):
        world, key = scene
        unseen = found_pixels(camera) / view.stride**2
        images = eyes.images(key, Snapshot(camera, shelf, world, sensing=Sensing(colour=sensing)))
        shown = ColouredDepth(back_project(view.camera, images.depth), images.depth, images.colour)
        detection = detect(key, eyes.core.detector, eyes.core.target, shelf, view.camera, shown, unseen)
        truth = observe(view.camera, world, shelf).segmentation == TARGET
        counts = (jnp.sum(pixels) for pixels in (truth, detection.pixels, truth & detection.pixels))
        return target_pixels(camera, world), detection.visible, *counts

    return jax.lax.map(look, (worlds, keys))


def detection_figures(
    scenarios: Sequence[Scenario],
    places: int = 3,
    seed: int = 0,
    measured: Sequence[Condition] | None = None,
    on_progress: Callable[[int], None] = lambda done: None,
) -> dict[str, Any]:
    """Figures of detection under every condition, as JSON values.

    Args:
      scenarios: at least one, all with targets of one shape and size.
      places: of the target in each scenario, beside its own.
      seed: of the places and of the noise.
      measured: the conditions; `conditions()` if None.
      on_progress: called after every condition with the number of conditions so far.

    Raises:
      InputError: there are no scenarios, or targets differ.
    """
    targets = {target_of(scenario, Target()) for scenario in scenarios}
    if len(targets) != 1:
        raise InputError("lab detection: give scenarios, all with targets of one shape and size")
    (target,) = targets
    camera, shelf = Camera(), Shelf()
    worlds = worlds_of(scenarios, places, seed, shelf)
    count = len(worlds.kind)
    keys = jax.random.split(jax.random.key(seed), count)
    lines: list[dict[str, Any]] = []
    seconds: list[float] = []
    for done, condition in enumerate(conditions() if measured is None else measured, 1):
        eyes = recogniser("full", target, TargetColour.lit(COLOURS[condition.target]))
        assert isinstance(eyes, ImageRecogniser)
        start = time.perf_counter()
        numbers = jax.device_get(_looks(eyes, camera, shelf, worlds, keys, condition.sensing))
        seconds.append((time.perf_counter() - start) / count)
        lines.append({**dataclasses.asdict(condition), **Looks(*numbers).figures(found_pixels(camera))})
        on_progress(done)
    settings = {"scenarios": len(scenarios), "looks": count, "places": places, "seed": seed, "colours": dict(COLOURS)}
    return {
        "settings": settings,
        "versions": versions(),
        "seconds_per_look": statistics.median(seconds),
        "conditions": lines,
        "all": total(lines),
    }


def total(lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Sums of the counts of several conditions, and means of precision and recall over targets that are detected."""
    counts = ("in_sight", "missed", "barely_in_sight", "barely_missed", "out_of_sight", "false", "false_on_target")
    sums: dict[str, Any] = {name: sum(line[name] for line in lines) for name in counts}
    detected = [line["in_sight"] - line["missed"] for line in lines]
    for name in ("precision", "recall"):
        shares = [n * line[name] for n, line in zip(detected, lines, strict=True) if n]
        sums[name] = round(sum(shares) / sum(detected), 4) if shares else None
    return sums
