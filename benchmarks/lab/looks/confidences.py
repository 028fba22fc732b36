"""How often a recognised object is right by its stated confidence, on scenes of `SceneConfig.real`, and the constants
of `perception.confidence` that scenes like them give.

Images are made as in training, from a seed that training refuses, and segmented by the network. An object stands for
the thing that most of its pixels show, and is right if its centre is within `CENTRE` and its axes within `ANGLE`.
Constants are fitted to every other scene, and judged on the rest.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Array, Float, Key
from scipy.optimize import minimize

from mechsearch_jax.benchmarks.lab.looks.scoring import turned_by
from mechsearch_jax.envs.world.world import TARGET
from mechsearch_jax.images.cloud import BLOCK, shelf_view
from mechsearch_jax.perception.confidence import logarithms
from mechsearch_jax.perception.doubt import Thing
from mechsearch_jax.perception.explanation import Fitted
from mechsearch_jax.perception.recogniser import ViewRecogniser, large_segments
from mechsearch_jax.perception.recognition import LabelledImage
from mechsearch_jax.shapes import by_shape
from mechsearch_jax.train.loop import HELD_OUT_SEED
from mechsearch_jax.train.scenes import Capture, Scene, SceneConfig, noise_names, random_scene, taken
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

# An object is right with its centre and its axes within these [m], [degrees].
CENTRE, ANGLE = 0.01, 10.0
# Segments of at most so many pixels are left out, about as many as at robots.
LEAST = 25.0
CONFIDENCES = (0.0, 0.5, 0.8, 0.9, 0.95, 0.98, 1.01)
# Of the fit: keeps the constants finite.
_PRIOR = 1e-4
# The first scene: those before are for the networks' scores.
_FIRST = 5000
_SCENES, _VIEW = SceneConfig.real(), shelf_view(block=BLOCK)


@jax.jit
def _look(core: ViewRecogniser, key: Key[Array, ""]) -> tuple[Scene, Capture, Fitted]:
    making, sensing, drawing, fitting = jax.random.split(key, 4)
    scene, seen = taken(sensing, random_scene(making, _SCENES, Shelf(), _VIEW), _SCENES)
    camera = scene.camera
    ahead = jnp.array(camera.rotation)[:, 2]
    depth = jnp.sum((seen.points - jnp.array(camera.position).reshape(1, 1, 3)) * ahead.reshape(1, 1, 3), axis=-1)
    of_target = seen.labels == TARGET
    labels = large_segments(core.segmenter(drawing, scene.shelf, seen.points, of_target), LEAST)
    image = LabelledImage(seen.points, depth, labels, of_target)
    keys, target = jax.random.split(fitting), Target.cylinder()
    return scene, seen, core.fitter(keys, image, core.shapes, camera, scene.shelf, target, core.refinement, LEAST)


def looked_at(scenes: int, report: Callable[[int], None] = lambda done: None) -> pd.DataFrame:
    """A row for every recognised object: `scene`, `sensor`, whether it is the `usual` shelf, its stated `confidence`,
    the three `logarithms` of its measures, and whether it is `right`.

    Args:
      scenes: how many are looked at.
      report: called with the number of those that are done.
    """
    core, names = ViewRecogniser.of(Target.cylinder()), noise_names(_SCENES)
    first = jax.random.key(HELD_OUT_SEED)
    rows = []
    for number in range(scenes):
        scene, seen, fitted = jax.device_get(_look(core, jax.random.fold_in(first, _FIRST + number)))
        usual = abs(scene.shelf.back - scene.shelf.front - (Shelf().back - Shelf().front)) < 1e-6
        about = np.asarray(logarithms(fitted.measures))
        for slot in np.flatnonzero(fitted.objects.valid).tolist():
            stated = {"confidence": float(fitted.confidence[slot]), "logarithms": about[slot], "usual": bool(usual)}
            right = _is_right(scene, seen.labels[fitted.labels == slot], fitted, slot)
            rows.append({"scene": number, "sensor": names[int(seen.sensor)], **stated, "right": right})
        report(number + 1)
    return pd.DataFrame(rows)


def _is_right(scene: Scene, shown: np.ndarray, fitted: Fitted, slot: int) -> bool:
    """Whether an object is right, of whose pixels the true labels are given."""
    things = shown[shown >= 0]
    if 2 * len(things) <= len(shown):
        return False
    i, world, objects = int(np.bincount(things).argmax()), scene.world, fitted.objects
    is_round = bool(by_shape(world.kind[i], lambda shape: shape.round, np))
    truth = _thing(world.half_size[i], is_round, world.rotation[i], world.position[i])
    is_round = bool(objects.exponents[slot, 1] > 0.5)
    answer = _thing(objects.size[slot], is_round, objects.rotation[slot], objects.position[slot])
    return bool(np.linalg.norm(truth.position - answer.position) < CENTRE and turned_by(truth, answer) < ANGLE)


def _thing(size: Array, is_round: bool, rotation: Array, position: Array) -> Thing:
    return Thing("", np.asarray(size), is_round, np.asarray(rotation), np.asarray(position))


def constants(about: Float[np.ndarray, "n 3"], right: np.ndarray) -> Float[np.ndarray, " 4"]:
    """The constants with which objects are most likely right as they are: a bias, and one for each logarithm."""
    columns, wrong = np.column_stack([np.ones(len(about)), about]), ~right

    def cost(weights: np.ndarray) -> float:
        odds = columns @ weights
        return float(np.mean(np.logaddexp(0.0, odds) - wrong * odds) + _PRIOR * weights @ weights)

    return minimize(cost, np.zeros(columns.shape[1])).x


def reliability(confidence: Float[np.ndarray, " n"], right: np.ndarray) -> list[dict[str, Any]]:
    """How many objects are right, and are said to be, by ranges of confidence."""
    lines = []
    for low, high in itertools.pairwise(CONFIDENCES):
        within = (confidence >= low) & (confidence < high)
        if within.any():
            shares = {"right": float(np.mean(right[within])), "stated": float(np.mean(confidence[within]))}
            lines.append({"from": low, "to": min(high, 1.0), "objects": int(within.sum()), **shares})
    return lines
