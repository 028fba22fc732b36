"""How well recognised bodies describe the true ones: the volume in common, and whether the gripper would hit them.

Images are those of recognition `masks`: depth with noise and the true segmentation. Each object is described by one
superquadric, by up to four (`perception.parts`), and by the parts that its true shape is known by, which is as well as
superquadrics can do.
"""

from __future__ import annotations

import dataclasses
import functools
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.stats import qmc

from mechsearch_jax.benchmarks.statistics.intervals import mean_interval
from mechsearch_jax.envs.camera.recognisers import recogniser
from mechsearch_jax.envs.camera.simulated_camera import observe
from mechsearch_jax.envs.camera.snapshot import Snapshot
from mechsearch_jax.envs.scenes.household import household
from mechsearch_jax.envs.world.world import TARGET, from_scenario
from mechsearch_jax.geometry import superquadric
from mechsearch_jax.geometry.bodies import world_parts
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.images.cloud import View
from mechsearch_jax.perception.explanation import Fitter, as_segmented
from mechsearch_jax.perception.parts.in_parts import InParts
from mechsearch_jax.perception.recogniser import labelled
from mechsearch_jax.perception.recognition import LabelledImage, ShapeNetwork
from mechsearch_jax.perception.refinement import RefinementConfig
from mechsearch_jax.problem.workcell import Workcell
from mechsearch_jax.robot.grasp_frames import gripper_rotation
from mechsearch_jax.robot.gripper import Gripper, gripper_cloud
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.versions import versions
from mechsearch_jax.shapes.compound import inside, solids, surface_points
from mechsearch_jax.workspace.scenario import Body, Scenario, pieces_of, rotation_matrix, superquadrics

Description = Literal["one", "parts", "true parts"]
# What fits objects, by the description; true parts are not fitted.
FITTERS: Mapping[str, Fitter] = {"one": as_segmented, "parts": InParts()}
# Objects that show fewer pixels of the view are left out, and those that show less of themselves are scored apart.
LEAST_PIXELS, MOSTLY = 20, 0.6
# Points by which volumes are measured, as a power of 2, within a box that is larger than the object on each side [m].
VOLUME_POINTS, MARGIN = 14, 0.03
# Poses of the gripper that are tried at each object, points of its cloud, how far the tips are from the object's box at
# most along each axis [m], and the largest angles from +x and from level [rad].
POSES, CLOUD_POINTS, AROUND, YAW, TILT = 200, 1024, 0.05, np.pi / 2, np.pi / 4


@dataclasses.dataclass(frozen=True)
class BodyRow:
    """What a description of one object is worth.

    Attributes:
      scene: name of the scene.
      object: its slot.
      thing: its name, if it is a household thing, else its shape.
      description: of `Description`.
      pixels: number of its pixels in the view.
      shown: share of the pixels that it would show alone.
      iou: intersection over union of the volumes.
      right: share of the gripper's poses at which what is said of collisions is true.
      false_hits, missed_hits: shares of the poses at which it would wrongly be said to hit, and not to hit.
      parts: number of superquadrics of the description.
    """

    scene: str
    object: int
    thing: str
    description: str
    pixels: int
    shown: float
    iou: float
    right: float
    false_hits: float
    missed_hits: float
    parts: int


@dataclasses.dataclass(frozen=True)
class MeasuredBodies:
    """Results of a run.

    Attributes:
      rows: one for every visible object and description.
      seconds: of each look, from labelled image to objects, by the description [s].
      settings: scenes, descriptions and seed.
      versions: as `versions` returns them.
    """

    rows: tuple[BodyRow, ...]
    seconds: dict[str, tuple[float, ...]]
    settings: dict[str, Any]
    versions: dict[str, str]

    def summary(self) -> list[dict[str, Any]]:
        """Means with intervals that resample scenes, by description: of objects that are mostly seen, and of all."""
        lines = []
        for description in dict.fromkeys(row.description for row in self.rows):
            rows = [row for row in self.rows if row.description == description]
            for group, chosen in (
                ("mostly seen", [row for row in rows if row.shown >= MOSTLY]),
                ("all", rows),
            ):
                if chosen:
                    lines.append({"description": description, "group": group} | figures(chosen))
        return lines

    def things(self) -> list[dict[str, Any]]:
        """The same by thing, of objects that are mostly seen; the worst things by parts first."""
        rows = [row for row in self.rows if row.shown >= MOSTLY]
        groups: dict[tuple[str, str], list[BodyRow]] = {}
        for row in rows:
            groups.setdefault((row.thing, row.description), []).append(row)
        lines = [
            {"thing": thing, "description": description} | figures(chosen)
            for (thing, description), chosen in groups.items()
        ]
        worst = {
            line["thing"]: line["iou"] for line in lines if line["description"] == self.settings["descriptions"][-1]
        }
        worst |= {line["thing"]: line["iou"] for line in lines if line["description"] == "parts"}
        return sorted(lines, key=lambda line: (worst.get(line["thing"], 0.0), line["thing"]))

    def value(self) -> dict[str, Any]:
        """As JSON values."""
        return {
            "settings": self.settings,
            "versions": self.versions,
            "seconds": {name: round(statistics.median(times), 4) for name, times in self.seconds.items() if times},
            "summary": self.summary(),
            "things": self.things(),
            "rows": [dataclasses.asdict(row) for row in self.rows],
        }


def figures(rows: Sequence[BodyRow]) -> dict[str, Any]:
    """Means of rows, and intervals of two of them; at least one row."""
    names = [row.scene for row in rows]

    def mean(name: str) -> float:
        return round(statistics.fmean(getattr(row, name) for row in rows), 4)

    def interval(name: str) -> list[float] | None:
        found = mean_interval([getattr(row, name) for row in rows], names)
        return None if found is None else [round(bound, 4) for bound in found]

    means = {name: mean(name) for name in ("iou", "right", "false_hits", "missed_hits", "parts")}
    return {"objects": len(rows), **means, "iou_interval": interval("iou"), "right_interval": interval("right")}


class Truth:
    """A true body: points around it and which are in it, and poses of the gripper and which hit it."""

    def __init__(self, body: Body, seed: int):
        self._solids = solids(pieces_of(body).pieces)
        self._rotation, self._position = rotation_matrix(body.quaternion), np.array(body.position)
        corners = surface_points(pieces_of(body)) @ self._rotation.T + self._position
        low, high = corners.min(axis=0) - MARGIN, corners.max(axis=0) + MARGIN
        self._points = low + (high - low) * qmc.Sobol(3, scramble=False).random_base2(VOLUME_POINTS)
        self._inside = self._holds(self._points)
        random = np.random.default_rng(seed)
        grown = AROUND - MARGIN
        tips = low - grown + (high - low + 2 * grown) * random.random((POSES, 3))
        yaw, tilt = random.uniform(-YAW, YAW, POSES), random.uniform(0.0, TILT, POSES)
        turn = np.asarray(gripper_rotation(jnp.asarray(yaw), jnp.asarray(tilt)))
        self._cloud = (np.einsum("nij,pj->npi", turn, _open_gripper()) + tips[:, None]).reshape(-1, 3)
        self._hits = self._holds(self._cloud).reshape(POSES, -1).any(axis=1)

    def _holds(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        local = (points - self._position) @ self._rotation
        return np.any([inside(solid, local) for solid in self._solids], axis=0)

    def score(self, parts: Superquadrics) -> dict[str, Any]:
        """The figures of `BodyRow` for the union of parts in the world, fields (P, ...)."""
        found = _union_holds(parts, self._points)
        hits = _union_holds(parts, self._cloud).reshape(POSES, -1).any(axis=1)
        return {
            "iou": float((found & self._inside).sum() / max((found | self._inside).sum(), 1)),
            "right": float((hits == self._hits).mean()),
            "false_hits": float((hits & ~self._hits).mean()),
            "missed_hits": float((~hits & self._hits).mean()),
            "parts": int(np.sum(parts.valid)),
        }


@functools.cache
def _open_gripper() -> Float[np.ndarray, "n 3"]:
    gripper = Gripper()
    return gripper_cloud(gripper, gripper.max_opening, np.pi / 4, CLOUD_POINTS)


def _union_holds(parts: Superquadrics, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Which points are in any of the parts."""
    held = np.zeros(len(points), bool)
    for i in np.flatnonzero(np.asarray(parts.valid)):
        position, rotation = np.asarray(parts.position[i], float), np.asarray(parts.rotation[i], float)
        local = jnp.asarray((points - position) @ rotation, jnp.float32)
        held |= np.asarray(superquadric.gauge(parts.size[i], parts.exponents[i], local) <= 1.0)
    return held


@dataclasses.dataclass(frozen=True, eq=False)
class BodiesBench:
    """A measurement of recognised bodies.

    Attributes:
      scenarios: by name; their objects may be compounds.
      descriptions: one or more of `Description`.
      seed: of noise, recognition and poses of the gripper.
      workcell: camera, shelf and target.
    """

    scenarios: Mapping[str, Scenario]
    descriptions: Sequence[str] = get_args(Description)
    seed: int = 0
    workcell: Workcell = dataclasses.field(default_factory=Workcell)

    def __post_init__(self):
        if not self.scenarios or not self.descriptions:
            raise InputError("lab bodies: there is nothing to look at; give scenes and at least one description")

    def run(self, on_progress: Callable[[int], None] = lambda done: None) -> MeasuredBodies:
        """Look at every scene and score all descriptions of its objects.

        Args:
          on_progress: called after every scene with the number of scenes so far.
        """
        rows: list[BodyRow] = []
        seconds: dict[str, list[float]] = {name: [] for name in self.descriptions if name in FITTERS}
        for index, (name, scenario) in enumerate(self.scenarios.items()):
            key = jax.random.fold_in(jax.random.key(self.seed), index)
            image, view, alone = self._seen(key, scenario)
            described = {}
            for description in self.descriptions:
                if description in FITTERS:
                    described[description], spent = self._described(key, image, view, FITTERS[description])
                    seconds[description].append(spent)
                else:
                    described[description] = superquadrics(scenario.objects)
            rows += _scored(name, scenario, np.asarray(image.labels), alone, described, self.seed)
            on_progress(index + 1)
        settings = {
            "scenes": list(self.scenarios),
            "descriptions": list(self.descriptions),
            "seed": self.seed,
            "least_pixels": LEAST_PIXELS,
            "mostly": MOSTLY,
        }
        # The first look compiles.
        times = {name: tuple(values[1:] or values) for name, values in seconds.items()}
        return MeasuredBodies(tuple(rows), times, settings, versions())

    def _seen(self, key: jax.Array, scenario: Scenario) -> tuple[LabelledImage, View, Int[np.ndarray, " n"]]:
        """The labelled image of a scene, its view, and how many pixels each object would show alone."""
        camera, shelf = self.workcell.camera, self.workcell.shelf
        world = from_scenario(scenario)
        snapshot = Snapshot(camera, shelf, world)
        seeing: Any = recogniser("masks", self.workcell.target)
        image, _ = labelled(seeing.core, key, camera, snapshot.view, shelf, seeing.images(key, snapshot))
        alone = [
            int((observe(snapshot.view.camera, _only(world, slot), shelf).segmentation == slot).sum())
            for slot in range(len(scenario.objects))
        ]
        return image, snapshot.view, np.array(alone, int)

    def _described(
        self, key: jax.Array, image: LabelledImage, view: View, fitter: Fitter
    ) -> tuple[Superquadrics, float]:
        """The objects that a fitter finds, and how long it takes [s]."""
        settings = (ShapeNetwork.of(), view.camera, self.workcell.shelf, self.workcell.target, RefinementConfig())
        start = time.perf_counter()
        fitted = jax.block_until_ready(fitter(jax.random.split(key), image, *settings))
        return fitted.objects, time.perf_counter() - start


def _only(world: Any, slot: int) -> Any:
    return world.replace(valid=world.valid & (jnp.arange(TARGET + 1) == slot))


@functools.cache
def _names() -> dict[Any, str]:
    """The household things by their colours, which scenes keep."""
    return {thing.compound.colour: name for name, thing in household().items()}


def _scored(
    name: str,
    scenario: Scenario,
    labels: Int[np.ndarray, "h w"],
    alone: Int[np.ndarray, " n"],
    described: Mapping[str, Superquadrics],
    seed: int,
) -> list[BodyRow]:
    """The rows of a scene."""
    rows = []
    for slot, body in enumerate(scenario.objects):
        pixels = int((labels == slot).sum())
        if pixels < LEAST_PIXELS:
            continue
        truth = Truth(body, seed * 1009 + slot)
        thing = body.shape if body.compound is None else _names().get(body.compound.colour, body.shape)
        for description, objects in described.items():
            one = jax.tree.map(lambda a, slot=slot: a[slot : slot + 1], objects)
            figures_of = truth.score(world_parts(one))
            shown = round(pixels / max(int(alone[slot]), 1), 4)
            rows.append(BodyRow(name, slot, thing, description, pixels, shown, **figures_of))
    return rows
