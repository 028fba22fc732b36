"""How well objects are recognised from true masks: the network, refinement and the classical method on the same images.

Every method is shown the same points and masks and answers with superquadrics, which are compared with the true bodies
by volumetric intersection over union and by their centres. Generated scenes come from a seed that no training can have.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, cast

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from mechsearch_jax.benchmarks.parts import ems
from mechsearch_jax.benchmarks.parts.images import NOISES, Look, Scene, Shown, image_of, named, save_rows
from mechsearch_jax.envs.world.world import TARGET, World, true_superquadrics
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.images.cloud import View, thinned_view
from mechsearch_jax.networks.recognition import RecognitionNetwork
from mechsearch_jax.networks.weights import Weights, shipped_weights
from mechsearch_jax.perception.recognition import recognise
from mechsearch_jax.perception.refinement import RefinementConfig, refine, select
from mechsearch_jax.perception.scores import EDGE, centre_error, intersection_over_union, sharpened
from mechsearch_jax.problem.workcell import Workcell
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike
from mechsearch_jax.runtime.versions import versions
from mechsearch_jax.shapes import by_shape, in_order
from mechsearch_jax.train.scenes import PIXELS
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf

MethodName = Literal["network", "network-refined", "ems", "ems-refined"]
# Visible shares by which figures are broken down: name, from, to below.
SHARES = (("below 30%", 0.0, 0.3), ("30 to 60%", 0.3, 0.6), ("60% and more", 0.6, np.inf))
# A change of the intersection over union that is called better or worse.
NOTABLE = 0.02
# Points of a segment that the classical method is given; it is slow, and more do not make it better.
EMS_POINTS = 250


@dataclasses.dataclass(frozen=True, eq=False)
class Method:
    """A way to recognise objects.

    Attributes:
      answer: from a PRNG key, what is shown, and the answer of the method that it begins with, to superquadrics in the
        slots of the labels. If it begins with none, that answer is an empty scene.
      after: name of the method that it begins with; None if with none.
      slow: whether it takes so long that it may be measured on fewer scenes.
    """

    answer: Callable[[Key[Array, ""], Shown, Superquadrics], Superquadrics]
    after: str | None = None
    slow: bool = False


@dataclasses.dataclass(frozen=True)
class Row:
    """One method's answer for one object.

    Attributes:
      source, scene, object: which object of which scene.
      shape: name of its shape.
      noise, method: their names.
      pixels, visible: as in `Look`.
      outcome: "answered"; "nothing" where the method had no answer; "not finite" where it had one with NaN or infinity.
      iou: intersection over union with the true body; 0 where nothing finite was answered.
      centre: distance of the centres [m]; None there.
      right: whether what is round was called round, and nothing else; None there.
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
        """What it is the answer for."""
        return self.source, self.scene, self.object, self.noise


@dataclasses.dataclass(frozen=True)
class Time:
    """How long a method takes for one object of a scene, all objects of which are recognised at once.

    Attributes:
      compile_seconds: of the first call, less the median of the others [s].
      seconds: for every image, its time over the number of its objects [s]; with that of the method it begins with.
    """

    compile_seconds: float
    seconds: tuple[float, ...]

    def value(self) -> dict[str, float]:
        """What is written to a file, of an object: the median, the spread [s] and the number of timed images."""
        low, high = np.quantile(self.seconds, (0.1, 0.9)).tolist()
        return {
            "compile_seconds": self.compile_seconds,
            "median_seconds": statistics.median(self.seconds),
            "p10_seconds": low,
            "p90_seconds": high,
            "calls": len(self.seconds),
        }


@dataclasses.dataclass(frozen=True)
class Measured:
    """What came of it.

    Attributes:
      rows: one for every method and every object that counts in every image.
      after: of each method, the one that it begins with.
      times: of each method.
      settings: what scenes, noises and seed they come from.
      versions: as `versions` returns them.
    """

    rows: tuple[Row, ...]
    after: dict[str, str | None]
    times: dict[str, Time]
    settings: dict[str, Any]
    versions: dict[str, str]

    def summary(self) -> list[dict[str, Any]]:
        """Figures by source, noise, method and visible share: see `figures`."""
        by_key = {(row.method, *row.key): row for row in self.rows}
        groups: dict[tuple[str, str, str], list[Row]] = {}
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
        """What is written to a file, without the rows."""
        times = {name: timing.value() for name, timing in self.times.items()}
        return {
            "settings": self.settings,
            "versions": self.versions,
            "after": self.after,
            "seconds_per_object": times,
            "summary": self.summary(),
        }


def figures(rows: Sequence[Row], before: Sequence[Row] | None = None) -> dict[str, Any]:
    """Figures of some answers; with `before`, those for the same objects by the method they begin with, also the gain.

    What was not answered, or is not finite, counts as an intersection over union of 0 and an infinite distance.
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


def shipped_methods(camera: Camera, shelf: Shelf, weights: Weights | None = None) -> dict[str, Method]:
    """The methods that are compared.

    Args:
      camera: of the images.
      shelf: what stands on it is recognised.
      weights: of the recognition network; the shipped ones if None.

    Raises:
      InputError: the shipped weights are missing or damaged.
    """
    weights = weights or shipped_weights("recognition")
    network = cast(RecognitionNetwork, weights.network)

    def told(key: Array, shown: Shown, _: Superquadrics) -> Superquadrics:
        return recognise(key, network, weights.parameters, camera, shown.points, shown.labels, shelf)

    def recovered(key: Array, shown: Shown, _: Superquadrics) -> Superquadrics:
        points, labels = (np.asarray(a) for a in some_points(shown))
        return ems.recover_scene(points, labels, TARGET)

    def refiner(config: RefinementConfig) -> Callable[[Array, Shown, Superquadrics], Superquadrics]:
        def refined(key: Array, shown: Shown, begin: Superquadrics) -> Superquadrics:
            points, labels = shown.points.reshape(-1, 3), shown.labels.reshape(-1)
            return refine(camera, shelf, begin, points, labels, shown.depth, config).scene

        return refined

    methods: dict[MethodName, Method] = {
        "network": Method(told),
        "network-refined": Method(refiner(RefinementConfig()), after="network"),
        "ems": Method(recovered, slow=True),
        "ems-refined": Method(refiner(RefinementConfig.rough()), after="ems", slow=True),
    }
    return cast(dict[str, Method], methods)


@jax.jit
def some_points(shown: Shown) -> tuple[Float[Array, "p 3"], Int[Array, " p"]]:
    """`EMS_POINTS` points of every segment, spread evenly over it, and their labels; -1 where there are fewer."""
    labels = shown.labels.reshape(-1).astype(jnp.int32)
    slots = jnp.arange(TARGET)
    index, weight = jax.vmap(lambda slot: select(labels, slot, EMS_POINTS))(slots)
    own = jnp.where(weight > 0, slots[:, None], -1)
    return shown.points.reshape(-1, 3)[index.reshape(-1)], own.reshape(-1)


def chosen_methods(methods: Mapping[str, Method], names: Sequence[str]) -> dict[str, Method]:
    """Some of the methods, with those that they begin with before them.

    Raises:
      InputError: there is none of a name.
    """
    chosen: dict[str, Method] = {}
    for name in names:
        if name not in methods:
            raise InputError(f'bench recognition: method "{name}" is unknown; use {", ".join(methods)}')
        start = methods[name].after
        if start is not None:
            chosen.setdefault(start, methods[start])
        chosen.setdefault(name, methods[name])
    return chosen


class _Judged(flax.struct.PyTreeNode):
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


def _rows(scene: Scene, noise: str, method: str, image: Look, answer: Superquadrics) -> list[Row]:
    judged, image, valid, answered = jax.device_get(
        (_judge(scene.world, answer), image, scene.world.valid, answer.valid)
    )
    kind = np.asarray(scene.world.kind)
    rows = []
    for i in np.flatnonzero(valid[:TARGET] & (image.pixels >= PIXELS)):
        outcome = "nothing" if not answered[i] else "answered" if judged.finite[i] else "not finite"
        good = outcome == "answered"
        rows.append(
            Row(
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
class Bench:
    """A comparison of methods on scenes; everything that is needed to repeat any part of it.

    Attributes:
      scenes: what is recognised.
      methods: by name, each after the one that it begins with.
      noises: names of `NOISES`.
      seed: of the noise and of the methods.
      slow_scenes: on so many scenes, spread evenly over all, slow methods are measured too; None for all.
      shelf: what the scenes stand on.
      camera: what looks at them.
    """

    scenes: Sequence[Scene]
    methods: Mapping[str, Method]
    noises: Sequence[str] = ("clean", "gaussian")
    seed: int = 0
    slow_scenes: int | None = None
    shelf: Shelf = dataclasses.field(default_factory=Shelf)
    camera: Camera = dataclasses.field(default_factory=Camera)

    def __post_init__(self):
        if not self.scenes:
            raise InputError("bench recognition: there are no scenes; give --scenes, or scenario files")
        if not self.noises or not self.methods:
            raise InputError("bench recognition: give at least one noise and one method")
        unknown = next((name for name in self.noises if name not in NOISES), None)
        if unknown is not None:
            raise InputError(f'bench recognition: noise "{unknown}" is unknown; use {", ".join(NOISES)}')

        if self.slow_scenes is not None and self.slow_scenes < 1:
            raise InputError(f"bench recognition: scenes for slow methods ({self.slow_scenes}) must be at least 1")

    @property
    def view(self) -> View:
        """Which rays of the camera are cast."""
        return thinned_view(self.camera, self.shelf)

    def methods_for(self, index: int) -> dict[str, Method]:
        """The methods that are measured on a scene."""
        total = len(self.scenes)
        count = min(self.slow_scenes or total, total)
        # The first scene is always among them.
        everything = (index * count) % total < count
        return {name: method for name, method in self.methods.items() if everything or not method.slow}

    def image(self, index: int, noise: str) -> tuple[Key[Array, ""], Look]:
        """A key for the methods, and the image of a scene; the same on every call."""
        return image_of(self.scenes, index, noise, self.seed, self.view, self.shelf)

    def answers(self, index: int, noise: str) -> tuple[Look, dict[str, Superquadrics], dict[str, float]]:
        """The image of a scene, every method's answer, and how long it took with the one that it begins with [s]."""
        key, image = self.image(index, noise)
        jax.block_until_ready(image)
        found: dict[str, Superquadrics] = {}
        seconds: dict[str, float] = {}
        for name, method in self.methods_for(index).items():
            begin = found[method.after] if method.after is not None else _nothing()
            start = time.perf_counter()
            found[name] = jax.block_until_ready(method.answer(key, image.shown, begin))
            seconds[name] = time.perf_counter() - start + seconds.get(method.after or "", 0.0)
        return image, found, seconds

    def run(self, watcher: Callable[[int], None] = lambda done: None) -> Measured:
        """Recognise everything.

        Args:
          watcher: told after every image how many are done.
        """
        *_, first = self.answers(0, self.noises[0])
        rows: list[Row] = []
        seconds: dict[str, list[float]] = {name: [] for name in self.methods}
        scene_seconds: dict[str, list[float]] = {name: [] for name in self.methods}
        done = 0
        for noise in self.noises:
            for index, scene in enumerate(self.scenes):
                image, found, spent = self.answers(index, noise)
                objects = max(int(scene.world.valid[:TARGET].sum()), 1)
                for name, answer in found.items():
                    rows += _rows(scene, noise, name, image, answer)
                    seconds[name].append(spent[name] / objects)
                    scene_seconds[name].append(spent[name])
                done += 1
                watcher(done)
        times = {
            name: Time(max(first[name] - statistics.median(scene_seconds[name]), 0.0), tuple(spent))
            for name, spent in seconds.items()
        }
        sources = [scene.source for scene in self.scenes]
        settings = {
            "held_out_scenes": len(sources) - sources.count("files"),
            "scenario_files": sources.count("files"),
            "noises": {name: named(NOISES[name]) for name in self.noises},
            "seed": self.seed,
            "least_pixels": PIXELS,
            "ems_points": EMS_POINTS,
            "slow_scenes": self.slow_scenes,
        }
        after = {name: method.after for name, method in self.methods.items()}
        return Measured(tuple(rows), after, times, settings, versions())


def shipped_bench(
    scenes: Sequence[Scene],
    methods: Sequence[str],
    noises: Sequence[str],
    seed: int,
    slow_scenes: int | None,
    place: Workcell,
) -> Bench:
    """A comparison of some of `shipped_methods` on scenes in a place; see `Bench`.

    Raises:
      InputError: a name is unknown, a number is impossible, the camera does not see the shelf, or the shipped weights
        are missing or damaged.
    """
    view = thinned_view(place.camera, place.shelf)
    chosen = chosen_methods(shipped_methods(view.camera, place.shelf), methods)
    return Bench(scenes, chosen, noises, seed, slow_scenes, place.shelf, place.camera)


def joined(parts: Mapping[str, Measured], places: Mapping[str, Workcell]) -> Measured:
    """Comparisons in several places as one; the rows tell the place as their source.

    Images of different places differ in size: how long they take is told of one place alone.

    Args:
      parts: what was measured, by place; at least one, all with the same methods, noises and seed.
      places: whose camera and shelf each is.
    """
    some = next(iter(parts.values()))
    views = {
        name: {"camera": dataclasses.asdict(places[name].camera), "shelf": dataclasses.asdict(places[name].shelf)}
        for name in parts
    }
    rows = tuple(row for part in parts.values() for row in part.rows)
    times = some.times if len(parts) == 1 else {}
    return Measured(rows, some.after, times, some.settings | {"places": views}, some.versions)


def _nothing() -> Superquadrics:
    ones, zeros = jnp.ones((TARGET, 3)), jnp.zeros((TARGET, 3))
    turns = jnp.broadcast_to(jnp.eye(3), (TARGET, 3, 3))
    return Superquadrics(ones, jnp.ones((TARGET, 2)), zeros, turns, jnp.zeros(TARGET, bool))


def save_recognition(measured: Measured, path: PathLike) -> None:
    """Write a comparison as JSON.

    Raises:
      InputError: the file cannot be written.
    """
    save_rows(measured.value(), measured.rows, path)
