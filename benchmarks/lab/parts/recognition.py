"""Accuracy of recognition from true masks: the network, refinement and the classical method on the same images.

Every method gets the same points and masks and returns superquadrics, which are compared with the true bodies by
volumetric intersection over union and by their centres. Generated scenes come from a seed that training refuses.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from mechsearch_jax.benchmarks.lab.parts.images import Look, Scene, check_images, image_of, image_settings
from mechsearch_jax.benchmarks.lab.parts.recognition_methods import EMS_POINTS, Method, chosen_methods, shipped_methods
from mechsearch_jax.envs.world.world import TARGET, World, true_superquadrics
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.images.cloud import View, thinned_view
from mechsearch_jax.perception.scores import EDGE, centre_error, intersection_over_union, sharpened
from mechsearch_jax.problem.workcell import Workcell
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.runtime.versions import versions
from mechsearch_jax.shapes import by_shape, in_order
from mechsearch_jax.train.scenes import PIXELS
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf

# Ranges of visible shares by which figures are broken down: name, from, to below.
SHARES = (("below 30%", 0.0, 0.3), ("30 to 60%", 0.3, 0.6), ("60% and more", 0.6, np.inf))
# Least change of the intersection over union that counts as better or worse.
NOTABLE = 0.02


@dataclasses.dataclass(frozen=True)
class RecognitionRow:
    """One method's answer for one object.

    Attributes:
      source, scene, object: the object.
      shape: name of its shape.
      noise, method: their names.
      pixels, visible: as in `Look`.
      outcome: "answered"; "nothing" without an answer; "not finite" for an answer with NaN or infinity.
      iou: intersection over union with the true body; 0 if not "answered".
      centre: distance of the centres [m]; None if not "answered".
      right: whether the shape was classified correctly as round or not; None if not "answered".
    """

    source: str
    scene: str
    object: int
    shape: str
    noise: str
    method: str
    pixels: int
    visible: float
    outcome: str
    iou: float
    centre: float | None
    right: bool | None

    @property
    def key(self) -> tuple[str, str, int, str]:
        """The object and the noise."""
        return self.source, self.scene, self.object, self.noise


@dataclasses.dataclass(frozen=True)
class Time:
    """Time of a method per object; all objects of a scene are recognised at once.

    Attributes:
      compile_seconds: of the first call, minus the median of the others [s].
      seconds: for every image, its time divided by its number of objects [s], the initial method's time included.
    """

    compile_seconds: float
    seconds: tuple[float, ...]

    def value(self) -> dict[str, float]:
        """As JSON values: the median and the spread per object [s], and the number of timed images."""
        low, high = np.quantile(self.seconds, (0.1, 0.9)).tolist()
        return {
            "compile_seconds": self.compile_seconds,
            "median_seconds": statistics.median(self.seconds),
            "p10_seconds": low,
            "p90_seconds": high,
            "calls": len(self.seconds),
        }


@dataclasses.dataclass(frozen=True)
class MeasuredRecognition:
    """Results of a comparison.

    Attributes:
      rows: one for every method and every scored object in every image.
      after: for each method its `Method.after`.
      times: of each method.
      settings: scenes, noises and seed.
      versions: as `versions` returns them.
    """

    rows: tuple[RecognitionRow, ...]
    after: dict[str, str | None]
    times: dict[str, Time]
    settings: dict[str, Any]
    versions: dict[str, str]

    def summary(self) -> list[dict[str, Any]]:
        """Figures by source, noise, method and visible share: see `figures`."""
        by_key = {(row.method, *row.key): row for row in self.rows}
        groups: dict[tuple[str, str, str], list[RecognitionRow]] = {}
        for row in self.rows:
            groups.setdefault((row.source, row.noise, row.method), []).append(row)
        lines = []
        for (source, noise, method), rows in groups.items():
            for name, low, high in (("all", 0.0, np.inf), *SHARES):
                chosen = [row for row in rows if low <= row.visible < high]
                start = self.after[method]
                before = [by_key[start, *row.key] for row in chosen] if start is not None else None
                head = {"source": source, "noise": noise, "method": method, "visible": name}
                lines.append(head | figures(chosen, before))
        return lines

    def value(self) -> dict[str, Any]:
        """As JSON values, without the rows."""
        times = {name: timing.value() for name, timing in self.times.items()}
        return {
            "settings": self.settings,
            "versions": self.versions,
            "after": self.after,
            "seconds_per_object": times,
            "summary": self.summary(),
        }


def figures(rows: Sequence[RecognitionRow], before: Sequence[RecognitionRow] | None = None) -> dict[str, Any]:
    """Figures of answers; with `before`, the initial method's answers for the same objects, also the gain.

    Objects that are not "answered" count with an intersection over union of 0 and an infinite distance.
    """
    if not rows:
        return {"objects": 0}
    centres = [np.inf if row.centre is None else row.centre for row in rows]
    median = float(np.median(centres))
    answered = [row for row in rows if row.right is not None]
    value: dict[str, Any] = {
        "objects": len(rows),
        "unanswered": sum(row.outcome == "nothing" for row in rows),
        "not_finite": sum(row.outcome == "not finite" for row in rows),
        "iou_mean": float(np.mean([row.iou for row in rows])),
        "iou_median": float(np.median([row.iou for row in rows])),
        "centre_median_mm": 1e3 * median if np.isfinite(median) else None,
        "wrong_class": float(np.mean([not row.right for row in answered])) if answered else None,
    }
    if before is not None:
        gains = np.array([row.iou - start.iou for row, start in zip(rows, before, strict=True)])
        value |= {
            "gain_mean": float(np.mean(gains)),
            "gain_standard_error": float(np.std(gains) / np.sqrt(len(gains))),
            "better": float(np.mean(gains > NOTABLE)),
            "worse": float(np.mean(gains < -NOTABLE)),
        }
    return value


class _Judged(PyTreeNode):
    finite: jax.Array
    iou: jax.Array
    centre: jax.Array
    right: jax.Array


@jax.jit
def _judge(world: World, answer: Superquadrics) -> _Judged:
    truth = true_superquadrics(world)
    parts = (answer.size, answer.exponents, answer.position, answer.rotation.reshape(TARGET, 9))
    finite = jnp.stack([jnp.isfinite(part).all(axis=-1) for part in parts]).all(axis=0)
    return _Judged(
        finite=finite,
        iou=intersection_over_union(sharpened(truth), answer),
        centre=centre_error(truth, answer),
        right=(answer.exponents[:, 1] > EDGE) == by_shape(world.kind[:TARGET], lambda shape: shape.round, jnp),
    )


def _rows(scene: Scene, noise: str, method: str, image: Look, answer: Superquadrics) -> list[RecognitionRow]:
    judged, image, valid, answered = jax.device_get(
        (_judge(scene.world, answer), image, scene.world.valid, answer.valid)
    )
    kind = np.asarray(scene.world.kind)
    rows = []
    for i in np.flatnonzero(valid[:TARGET] & (image.pixels >= PIXELS)):
        outcome = "nothing" if not answered[i] else "answered" if judged.finite[i] else "not finite"
        good = outcome == "answered"
        rows.append(
            RecognitionRow(
                source=scene.source,
                scene=scene.name,
                object=int(i),
                shape=in_order()[kind[i]].name,
                noise=noise,
                method=method,
                pixels=int(image.pixels[i]),
                visible=round(float(image.visible[i]), 4),
                outcome=outcome,
                iou=round(float(judged.iou[i]), 4) if good else 0.0,
                centre=round(float(judged.centre[i]), 6) if good else None,
                right=bool(judged.right[i]) if good else None,
            )
        )
    return rows


@dataclasses.dataclass(frozen=True, eq=False)
class RecognitionBench:
    """A comparison of methods on scenes; it can repeat any part of a run.

    Attributes:
      scenes: to recognise.
      methods: by name, each after its initial method.
      noises: names of `NOISES`.
      seed: of the noise and of the methods.
      slow_scenes: number of scenes, spread evenly over all, for slow methods; None for all.
      shelf: of the scenes.
      camera: of the images.
    """

    scenes: Sequence[Scene]
    methods: Mapping[str, Method]
    noises: Sequence[str] = ("clean", "gaussian")
    seed: int = 0
    slow_scenes: int | None = None
    shelf: Shelf = dataclasses.field(default_factory=Shelf)
    camera: Camera = dataclasses.field(default_factory=Camera)

    def __post_init__(self):
        check_images("lab recognition", self.scenes, self.noises)
        if not self.methods:
            raise InputError("lab recognition: give at least one method")
        if self.slow_scenes is not None and self.slow_scenes < 1:
            raise InputError(f"lab recognition: scenes for slow methods ({self.slow_scenes}) must be at least 1")

    @property
    def view(self) -> View:
        """Which rays of the camera are cast."""
        return thinned_view(self.camera, self.shelf)

    def methods_for(self, index: int) -> dict[str, Method]:
        """The methods that are measured on a scene."""
        total = len(self.scenes)
        count = min(self.slow_scenes or total, total)
        # True for the first scene.
        everything = (index * count) % total < count
        return {name: method for name, method in self.methods.items() if everything or not method.slow}

    def image(self, index: int, noise: str) -> tuple[Key[Array, ""], Look]:
        """A key for the methods, and the image of a scene; the same on every call."""
        return image_of(self.scenes, index, noise, self.seed, self.view, self.shelf)

    def answers(self, index: int, noise: str) -> tuple[Look, dict[str, Superquadrics], dict[str, float]]:
        """The image of a scene, every method's answer, and its time including the initial method's [s]."""
        key, image = self.image(index, noise)
        jax.block_until_ready(image)
        answers: dict[str, Superquadrics] = {}
        seconds: dict[str, float] = {}
        for name, method in self.methods_for(index).items():
            initial = answers[method.after] if method.after is not None else _empty_scene()
            start = time.perf_counter()
            answers[name] = jax.block_until_ready(method.answer(key, image.shown, initial))
            seconds[name] = time.perf_counter() - start + seconds.get(method.after or "", 0.0)
        return image, answers, seconds

    def run(self, on_progress: Callable[[int], None] = lambda done: None) -> MeasuredRecognition:
        """Recognise everything.

        Args:
          on_progress: called after every image with the number of images so far.
        """
        *_, first = self.answers(0, self.noises[0])
        rows: list[RecognitionRow] = []
        seconds: dict[str, list[float]] = {name: [] for name in self.methods}
        scene_seconds: dict[str, list[float]] = {name: [] for name in self.methods}
        done = 0
        for noise in self.noises:
            for index, scene in enumerate(self.scenes):
                image, answers, spent = self.answers(index, noise)
                objects = max(int(scene.world.valid[:TARGET].sum()), 1)
                for name, answer in answers.items():
                    rows += _rows(scene, noise, name, image, answer)
                    seconds[name].append(spent[name] / objects)
                    scene_seconds[name].append(spent[name])
                done += 1
                on_progress(done)
        times = {
            name: Time(max(first[name] - statistics.median(scene_seconds[name]), 0.0), tuple(spent))
            for name, spent in seconds.items()
        }
        settings = image_settings(self.scenes, self.noises, self.seed)
        settings |= {"ems_points": EMS_POINTS, "slow_scenes": self.slow_scenes}
        after = {name: method.after for name, method in self.methods.items()}
        return MeasuredRecognition(tuple(rows), after, times, settings, versions())


def shipped_bench(
    scenes: Sequence[Scene],
    methods: Sequence[str],
    noises: Sequence[str],
    seed: int,
    slow_scenes: int | None,
    place: Workcell,
) -> RecognitionBench:
    """The `RecognitionBench` of `shipped_methods` of given names on scenes in a workcell.

    Raises:
      InputError: a name is unknown, a number is impossible, the camera does not see the shelf, or the shipped weights
        are missing or damaged.
    """
    view = thinned_view(place.camera, place.shelf)
    chosen = chosen_methods(shipped_methods(view.camera, place.shelf), methods)
    return RecognitionBench(scenes, chosen, noises, seed, slow_scenes, place.shelf, place.camera)


def joined(parts: Mapping[str, MeasuredRecognition], places: Mapping[str, Workcell]) -> MeasuredRecognition:
    """Comparisons in several workcells as one; the source of a row is the workcell's name.

    Times are kept only for a single workcell, since the size of images differs between workcells.

    Args:
      parts: results by workcell; at least one, all with the same methods, noises and seed.
      places: the workcells.
    """
    first = next(iter(parts.values()))
    views = {
        name: {"camera": dataclasses.asdict(places[name].camera), "shelf": dataclasses.asdict(places[name].shelf)}
        for name in parts
    }
    rows = tuple(row for part in parts.values() for row in part.rows)
    times = first.times if len(parts) == 1 else {}
    return MeasuredRecognition(rows, first.after, times, first.settings | {"places": views}, first.versions)


def _empty_scene() -> Superquadrics:
    ones, zeros = jnp.ones((TARGET, 3)), jnp.zeros((TARGET, 3))
    turns = jnp.broadcast_to(jnp.eye(3), (TARGET, 3, 3))
    return Superquadrics(ones, jnp.ones((TARGET, 2)), zeros, turns, jnp.zeros(TARGET, bool))
