"""What comes of a depth and a colour image alone: every visible object, end to end, from another renderer's images.

MuJoCo casts the rays, and the sensors' noise is added. The recogniser gets the whole images, as recognition `full` does
in an episode, knows the target's shape and colour, and nothing else. Its objects are compared with the true bodies.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import statistics
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mechsearch_jax.benchmarks.lab.looks.confidences import ANGLE, CENTRE
from mechsearch_jax.benchmarks.lab.looks.pictures import Picture, noisy_colour, noisy_depth
from mechsearch_jax.benchmarks.lab.looks.scoring import (
    OFF,
    PIXELS,
    TOUCHING,
    TURNED,
    Phantom,
    SeenRow,
    Sighting,
    bordering,
    detection_counts,
    failure_kind,
    gaps,
    matched,
    phantom_kind,
    thing_of,
    turned_by,
)
from mechsearch_jax.envs.world.world import TARGET
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.images.labels import FREE
from mechsearch_jax.perception.doubt import Thing
from mechsearch_jax.perception.explanation import Explaining, ExplanationConfig, Fitted, Fitter, as_segmented
from mechsearch_jax.perception.recogniser import Recogniser
from mechsearch_jax.perception.scores import EDGE, intersection_over_union, sharpened
from mechsearch_jax.problem.workcell import Workcell
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.versions import versions
from mechsearch_jax.workspace.detector import found_pixels
from mechsearch_jax.workspace.scenario import Body, Scenario, superquadrics

NoiseName = Literal["clean", "gaussian", "time-of-flight"]
Segments = Literal["network", "explained", "joined", "true"]
# What fits objects, by the segments.
FITTERS: Mapping[Segments, Fitter] = {
    "network": as_segmented,
    "explained": Explaining(),
    "joined": Explaining(ExplanationConfig(splits=0)),
    "true": as_segmented,
}
# Ranges of pixels by which objects are counted: name, from, to below.
SIZES = (("100 to 1000", 100, 1000), ("1000 to 5000", 1000, 5000), ("5000 and more", 5000, np.inf))

# Ranges of stated confidences by which recognised objects are counted.
CONFIDENCES = (0.0, 0.5, 0.8, 0.9, 0.95, 0.98, 0.99, 1.01)
TIMES: Mapping[str, Callable[[Any], Any]] = {
    "median": np.median,
    "95th percentile": functools.partial(np.percentile, q=95),
    "largest": np.max,
}


@jax.jit
def _volumes(truth: Superquadrics, answers: Superquadrics) -> Float[jax.Array, "n m"]:
    """Intersection over union of every body with every recognised object."""
    n, m = truth.capacity, answers.capacity
    rows = jax.tree.map(lambda a: jnp.broadcast_to(a[:, None], (n, m, *a.shape[1:])), sharpened(truth))
    columns = jax.tree.map(lambda a: jnp.broadcast_to(a[None], (n, m, *a.shape[1:])), answers)
    return intersection_over_union(rows, columns)


@dataclasses.dataclass(frozen=True)
class MeasuredLooks:
    """Results of a run.

    Attributes:
      rows: one for every visible object of every look.
      phantoms: of all looks.
      sightings: of the target, one for every look.
      seconds: of each look, from image to observation, by the segments [s].
      compile_seconds: of the first look, minus the median of the others, by the segments [s].
      settings: scenes, noises, segments and seed.
      versions: as `versions` returns them.
    """

    rows: tuple[SeenRow, ...]
    phantoms: tuple[Phantom, ...]
    sightings: tuple[Sighting, ...]
    seconds: dict[str, tuple[float, ...]]
    compile_seconds: dict[str, float]
    settings: dict[str, Any]
    versions: dict[str, str]

    def summary(self) -> list[dict[str, Any]]:
        """Counts by segments and noise: of all objects and targets, by pixels, by contact and by number of objects."""
        lines = []
        for segments, noise in dict.fromkeys((row.segments, row.noise) for row in self.rows):
            rows = [row for row in self.rows if (row.segments, row.noise) == (segments, noise)]
            phantoms = [p for p in self.phantoms if (p.segments, p.noise) == (segments, noise)]
            sightings = [s for s in self.sightings if (s.segments, s.noise) == (segments, noise)]
            groups: dict[str, Sequence[SeenRow]] = {"all": rows}
            groups |= {f"{name} pixels": [r for r in rows if low <= r.pixels < high] for name, low, high in SIZES}
            groups["touching"] = [row for row in rows if row.gap < TOUCHING]
            groups["bordering in the image"] = [row for row in rows if row.gap >= TOUCHING and row.beside]
            groups["apart"] = [row for row in rows if row.gap >= TOUCHING and not row.beside]
            counts = sorted({row.objects for row in rows})
            groups |= {f"{count} objects": [row for row in rows if row.objects == count] for count in counts}
            kind = {"segments": segments, "noise": noise}
            everything = {
                "looks": len({row.scene for row in rows}),
                "phantoms": len(phantoms),
                "phantom_kinds": dict(Counter(phantom.kind for phantom in phantoms)),
                **detection_counts(sightings),
            }
            lines += [kind | {"group": name} | figures(chosen) for name, chosen in groups.items() if chosen]
            lines[-sum(map(bool, groups.values()))] |= everything
        return lines

    def reliability(self) -> list[dict[str, Any]]:
        """How often recognised objects, phantoms included, are not what their confidence is of (`confidences`), by
        segments, noise and stated confidence."""
        lines = []
        for segments, noise in dict.fromkeys((row.segments, row.noise) for row in self.rows):
            kind = (segments, noise)
            stated = [
                (
                    row.confidence,
                    row.centre is None or row.angle is None or max(row.centre / CENTRE, row.angle / ANGLE) >= 1,
                )
                for row in self.rows
                if (row.segments, row.noise) == kind and row.confidence is not None
            ]
            stated += [(p.confidence, True) for p in self.phantoms if (p.segments, p.noise) == kind]
            for low, high in itertools.pairwise(CONFIDENCES):
                wrong = [is_wrong for confidence, is_wrong in stated if low <= confidence < high]
                mean = [confidence for confidence, _ in stated if low <= confidence < high]
                if wrong:
                    line = {"from": low, "to": min(high, 1.0), "objects": len(wrong), "wrong": sum(wrong)}
                    expected = round(float(np.sum(1.0 - np.array(mean))), 2)
                    lines.append({"segments": segments, "noise": noise, **line, "expected_wrong": expected})
        return lines

    def value(self) -> dict[str, Any]:
        """As JSON values, without the rows of objects that are right."""
        return {
            "settings": self.settings,
            "versions": self.versions,
            "seconds": {
                segments: {name: round(float(of(times)), 4) for name, of in TIMES.items()}
                for segments, times in self.seconds.items()
            },
            "compile_seconds": self.compile_seconds,
            "summary": self.summary(),
            "reliability": self.reliability(),
            "wrong": [dataclasses.asdict(row) for row in self.rows if row.outcome != "right"],
            "phantoms": [dataclasses.asdict(phantom) for phantom in self.phantoms],
        }


def figures(rows: Sequence[SeenRow]) -> dict[str, Any]:
    """Counts of outcomes and of kinds of failures, and the mean intersection over union; at least one row."""
    wrong = [row for row in rows if row.outcome != "right"]
    outcomes = Counter(row.outcome for row in rows)
    return {
        "objects": len(rows),
        "wrong": len(wrong),
        "wrong_share": round(len(wrong) / len(rows), 4),
        **{name: outcomes[name] for name in ("missing", "off", "turned")},
        "kinds": dict(Counter(row.kind for row in wrong)),
        "iou_mean": round(float(np.mean([row.iou for row in rows])), 4),
    }


@dataclasses.dataclass(frozen=True, eq=False)
class LooksBench:
    """A measurement of looks.

    Attributes:
      pictures: images of scenes by name, each with its scenario.
      noises: of `NoiseName`.
      segments: one or more of `Segments`: "explained" or "network" for what the images show alone, with and without
        `perception.explanation`, "joined" where it divides no segment; "true" for the true masks beside them.
      seed: of the noise and of the recogniser.
      workcell: camera and shelf; its target is what the recogniser knows, and that it is `images.colour.RED`.
    """

    pictures: Mapping[str, tuple[Scenario, Picture]]
    noises: Sequence[str] = ("gaussian",)
    segments: Sequence[Segments] = ("explained",)
    seed: int = 0
    workcell: Workcell = dataclasses.field(default_factory=Workcell)

    def __post_init__(self):
        if not self.pictures or not self.noises or not self.segments:
            raise InputError("lab looks: there is nothing to look at; give scenes and at least one noise")

    @property
    def looks(self) -> int:
        """Number of looks."""
        return len(self.pictures) * len(self.noises) * len(self.segments)

    def run(self, on_progress: Callable[[int], None] = lambda done: None) -> MeasuredLooks:
        """Look at everything, in turn with all segments, so that their times are of the same load of the machine.

        Args:
          on_progress: called after every look with the number of looks so far.
        """
        recognisers: dict[Segments, Recogniser] = {
            kind: Recogniser(self.workcell, fitter=FITTERS[kind]) for kind in self.segments
        }
        start = next(iter(self.pictures)), self.noises[0]
        first = {kind: self.look(recogniser, kind, *start)[-1] for kind, recogniser in recognisers.items()}
        rows: list[SeenRow] = []
        phantoms: list[Phantom] = []
        sightings: list[Sighting] = []
        seconds: dict[Segments, list[float]] = {kind: [] for kind in recognisers}
        for done, (noise, name, kind) in enumerate(itertools.product(self.noises, self.pictures, recognisers)):
            fitted, visible, spent = self.look(recognisers[kind], kind, name, noise)
            scenario, picture = self.pictures[name]
            scored, extra = judged(scenario, picture, (kind, noise), fitted, visible, recognisers[kind].view.of)
            rows += scored
            phantoms += extra
            shown = int((picture.owner == TARGET).sum())
            in_sight = shown > found_pixels(self.workcell.camera)
            sightings.append(Sighting(scenario.name, kind, noise, shown, in_sight, visible))
            seconds[kind].append(spent)
            on_progress(done + 1)
        settings = {
            "scenes": len(self.pictures),
            "names": [min(self.pictures), max(self.pictures)],
            "noises": list(self.noises),
            "segments": list(self.segments),
            "seed": self.seed,
            "least_pixels": PIXELS,
        }
        compiling: dict[str, float] = {
            kind: round(max(first[kind] - statistics.median(seconds[kind]), 0.0), 2) for kind in seconds
        }
        times: dict[str, tuple[float, ...]] = {kind: tuple(values) for kind, values in seconds.items()}
        return MeasuredLooks(tuple(rows), tuple(phantoms), tuple(sightings), times, compiling, settings, versions())

    def look(self, recogniser: Recogniser, kind: Segments, name: str, noise: str) -> tuple[Fitted, bool, float]:
        """One look: what the recogniser made of the images, whether it sees the target, and its time [s]."""
        index = list(self.pictures).index(name)
        picture = self.pictures[name][1]
        seed = self.seed * 100_003 + index
        images: dict[str, Any] = {"depth": noisy_depth(self.workcell, picture, noise, seed)}
        if kind == "true":
            shown = (picture.owner >= 0) & (picture.owner <= TARGET)
            images |= {"mask": np.where(shown, picture.owner, FREE).astype(np.int8), "target_id": TARGET}
        else:
            images["colour"] = noisy_colour(picture, seed)
        key = jax.random.fold_in(jax.random.key(self.seed), index)
        start = time.perf_counter()
        fitted, visible = jax.block_until_ready(recogniser.fitted(key, **images))
        return fitted, bool(visible), time.perf_counter() - start


def _outcome(centre: float | None, angle: float | None) -> str:
    """What becomes of an object whose answer is so far off [m] and turned by so much [degrees]; None without one."""
    if centre is None or angle is None:
        return "missing"
    if centre > OFF:
        return "off"
    return "turned" if angle > TURNED else "right"


def judged(
    scenario: Scenario,
    picture: Picture,
    kind: tuple[str, str],
    fitted: Fitted,
    visible: bool,
    view: Callable[[Any], Any],
) -> tuple[list[SeenRow], list[Phantom]]:
    """The outcomes of a look.

    Args:
      scenario, picture: the truth.
      kind: names of the segments and of the noise.
      fitted: what was made of it, without batch axes.
      visible: whether the target was detected; if so, no object may stand for it.
      view: cuts the recogniser's view out of an image.
    """
    bodies: list[Body] = [*scenario.objects, scenario.target]
    objects, segments, confidence = fitted.objects, np.asarray(fitted.labels), np.asarray(fitted.confidence)
    answers = np.flatnonzero(np.asarray(objects.valid))
    iou = np.asarray(_volumes(superquadrics(bodies, TARGET + 1), objects))[: len(bodies), answers]
    places = np.array([body.position for body in bodies])
    distance = np.linalg.norm(places[:, None] - np.asarray(objects.position, float)[None, answers], axis=-1)
    count = len(scenario.objects) if visible else len(bodies)
    chosen, stands_for_one = matched(iou[:count], distance[:count])
    owner = np.asarray(view(jnp.asarray(picture.owner)))
    apart = gaps(bodies)
    rows = []
    for i, body in enumerate(scenario.objects):
        pixels = int((picture.owner == i).sum())
        if pixels < PIXELS:
            continue
        answer = None if chosen[i] < 0 else int(answers[chosen[i]])
        centre = None if answer is None else float(distance[i, chosen[i]])
        angle = None if answer is None else turned_by(thing_of("", body), _answer(objects, answer))
        outcome = _outcome(centre, angle)
        rows.append(
            SeenRow(
                scene=scenario.name,
                object=i,
                objects=len(scenario.objects),
                segments=kind[0],
                noise=kind[1],
                shape=body.shape,
                pixels=pixels,
                gap=round(float(apart[i]), 4),
                beside=bordering(owner, i),
                outcome=outcome,
                kind="" if outcome == "right" else failure_kind(i, owner, segments),
                centre=None if centre is None else round(centre, 4),
                angle=None if angle is None else round(angle, 1),
                iou=0.0 if answer is None else round(float(iou[i, chosen[i]]), 4),
                confidence=None if answer is None else round(float(confidence[answer]), 4),
            )
        )
    phantoms = [
        Phantom(scenario.name, *kind, int(a), phantom_kind(int(a), owner, segments), round(float(confidence[a]), 4))
        for a in answers[~stands_for_one]
    ]
    return rows, phantoms


def _answer(objects: Superquadrics, slot: int) -> Thing:
    size, exponents, position, rotation = (
        np.asarray(a[slot], float) for a in (objects.size, objects.exponents, objects.position, objects.rotation)
    )
    return Thing("", size, bool(exponents[1] > EDGE), rotation, position)
