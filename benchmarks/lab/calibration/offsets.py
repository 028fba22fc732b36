"""How well the shelf in a depth image tells how far the camera's pose is off, and how often it says so wrongly.

Each scene is seen by the camera where it is. The fit takes the camera to be elsewhere, by a random shift and turn that
are the truth to compare with; then to be where it is, where nothing must be said.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from mechsearch_jax.calibration.check import apparent, is_beyond
from mechsearch_jax.calibration.fit import ALL_PIXELS, FEW_PIXELS, ShelfFit, fit_shelf
from mechsearch_jax.calibration.limits import CalibrationLimits
from mechsearch_jax.calibration.report import correction
from mechsearch_jax.envs.camera.sensors import Sensor
from mechsearch_jax.envs.camera.simulated_camera import observe
from mechsearch_jax.envs.world.world import from_scenario
from mechsearch_jax.images.camera_pose import with_pose
from mechsearch_jax.images.noise import NoiseModel, TimeOfFlight, measured_depth
from mechsearch_jax.runtime.versions import versions
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import Scenario
from mechsearch_jax.workspace.shelf import Shelf

NUMBERS = ("x [mm]", "y [mm]", "z [mm]", "about x [degrees]", "about y [degrees]", "about z [degrees]")
# Pixels that are used, by what for.
USES = {"calibrate": ALL_PIXELS, "look": FEW_PIXELS}


@dataclasses.dataclass(frozen=True)
class OffsetRow:
    """One fit.

    Attributes:
      scenario, objects: the scene, and its number of objects.
      noise: name of the sensor.
      use: of the pixels, one of `USES`.
      shift, turn: how far the camera is taken to be from where it is [mm], [degrees].
      errors: of the corrected camera's place and orientation, as `NUMBERS`.
      stated: their standard errors by the fit.
      determined: which of them the image is said to determine.
      appears: how far a corner of the board appears from its place at most [mm], and the shelf's turn [degrees].
      warned, refused: whether the check at a look says so.
      seconds: that the fit took.
    """

    scenario: str
    objects: int
    noise: str
    use: str
    shift: float
    turn: float
    errors: tuple[float, ...]
    stated: tuple[float, ...]
    determined: tuple[bool, ...]
    appears: tuple[float, float]
    warned: bool
    refused: bool
    seconds: float


@dataclasses.dataclass(frozen=True)
class MeasuredOffsets:
    """Results of a run; see `OffsetRow`."""

    rows: tuple[OffsetRow, ...]
    settings: dict[str, Any]
    versions: dict[str, str]

    def summary(self) -> list[dict[str, Any]]:
        """By noise and use: errors with an offset, and what is said without one."""
        return [_summary([row for row in self.rows if (row.noise, row.use) == group]) for group in self.groups()]

    def groups(self) -> list[tuple[str, str]]:
        return list(dict.fromkeys((row.noise, row.use) for row in self.rows))

    def value(self) -> dict[str, Any]:
        """As JSON values, without the rows."""
        return {"settings": self.settings, "versions": self.versions, "summary": self.summary()}


def _summary(rows: Sequence[OffsetRow]) -> dict[str, Any]:
    moved, unmoved = ([row for row in rows if (row.shift > 0) is is_moved] for is_moved in (True, False))
    errors = {}
    for i, name in enumerate(NUMBERS):
        counted = [(abs(row.errors[i]), row.stated[i]) for row in moved if row.determined[i]]
        sizes = [size for size, _ in counted]
        errors[name] = {
            "determined": len(counted),
            "median": float(np.median(sizes)) if sizes else None,
            "95th percentile": float(np.percentile(sizes, 95)) if sizes else None,
            "largest": max(sizes, default=None),
            "median of the stated standard errors": float(np.median([s for _, s in counted])) if counted else None,
        }
    return {
        "noise": rows[0].noise,
        "use": rows[0].use,
        "with an offset": len(moved),
        "errors": errors,
        "without an offset": len(unmoved),
        "false warnings": sum(row.warned for row in unmoved),
        "largest that appears without an offset": [
            max((row.appears[i] for row in unmoved), default=0.0) for i in (0, 1)
        ],
        "median_seconds": statistics.median(row.seconds for row in rows),
    }


@dataclasses.dataclass(frozen=True)
class CalibrationBench:
    """A measurement on scenes.

    Attributes:
      scenes: to look at.
      offsets: random ones for each scene and noise; also how many looks there are without one.
      farthest, steepest: largest shift [m] and turn [degrees]; both are drawn evenly, in an even direction.
      deviation, missing: of the first sensor: standard deviation of the points [m], share of pixels without depth.
      seed: of all that is drawn.
      camera, shelf: of the images.
    """

    scenes: Sequence[Scenario]
    offsets: int = 5
    farthest: float = 0.02
    steepest: float = 3.0
    deviation: float = 0.001
    missing: float = 0.1
    seed: int = 0
    camera: Camera = dataclasses.field(default_factory=Camera)
    shelf: Shelf = dataclasses.field(default_factory=Shelf)

    def noises(self) -> dict[str, NoiseModel]:
        """The sensors by their names."""
        usual = Sensor(scatter=jnp.float32(self.deviation), missing=jnp.float32(self.missing))
        return {
            f"{1000 * self.deviation:g} mm, {100 * self.missing:g}% missing": usual,
            "time-of-flight": TimeOfFlight(),
        }

    def run(self, on_progress: Callable[[int], None] = lambda done: None) -> MeasuredOffsets:
        """Measure.

        Args:
          on_progress: called after every scene with the number of scenes so far.
        """
        sensors = {
            name: jax.jit(
                lambda key, depth, noise=noise: measured_depth(self.camera, depth, noise(key, self.camera, depth))
            )
            for name, noise in self.noises().items()
        }
        rows: list[OffsetRow] = []
        for number, scene in enumerate(self.scenes):
            true = observe(self.camera, from_scenario(scene), self.shelf).depth
            random = np.random.default_rng([self.seed, number])
            for i in range(self.offsets):
                offset = self._offset(random)
                for k, (name, sensor) in enumerate(sensors.items()):
                    key = jax.random.fold_in(jax.random.key(self.seed), len(sensors) * (self.offsets * number + i) + k)
                    depth = np.asarray(sensor(key, true))
                    for use in USES:
                        rows += [self._row(scene, name, use, depth, taken) for taken in (offset, self.camera)]
            on_progress(number + 1)
        settings = {
            name: getattr(self, name) for name in ("offsets", "farthest", "steepest", "deviation", "missing", "seed")
        }
        return MeasuredOffsets(tuple(rows), {"scenes": [scene.name for scene in self.scenes], **settings}, versions())

    def _offset(self, random: np.random.Generator) -> Camera:
        """The camera as it is wrongly taken to be."""
        ways = random.normal(size=(2, 3))
        way, axis = ways / np.linalg.norm(ways, axis=1, keepdims=True)
        T = np.eye(4)
        turn = Rotation.from_rotvec(np.radians(self.steepest * random.uniform()) * axis).as_matrix()
        T[:3, :3] = turn @ np.array(self.camera.rotation)
        T[:3, 3] = np.array(self.camera.position) + self.farthest * random.uniform() * way
        return with_pose(self.camera, T)

    def _row(self, scene: Scenario, noise: str, use: str, depth: np.ndarray, taken: Camera) -> OffsetRow:
        start = time.perf_counter()
        fit = fit_shelf(taken, self.shelf, depth, USES[use])
        seconds = time.perf_counter() - start
        limits = CalibrationLimits()
        _, stated, determined = correction(fit, "camera")
        scale = np.repeat([1000.0, np.degrees(1.0)], 3)
        shift, turn = _between(taken, self.camera)
        return OffsetRow(
            scenario=scene.name,
            objects=len(scene.objects),
            noise=noise,
            use=use,
            shift=float(1000 * np.linalg.norm(shift)),
            turn=float(np.degrees(np.linalg.norm(turn))),
            errors=tuple(np.round(scale * np.concatenate(_between(fit.corrected, self.camera)), 4).tolist()),
            stated=tuple(np.round(scale * stated.ravel(), 4).tolist()),
            determined=tuple(determined.ravel().tolist()),
            appears=_appears(fit, self.shelf),
            warned=is_beyond(fit, self.shelf, limits.warn_shift, limits.warn_turn),
            refused=is_beyond(fit, self.shelf, limits.refuse_shift, limits.refuse_turn),
            seconds=round(seconds, 5),
        )


def _appears(fit: ShelfFit, shelf: Shelf) -> tuple[float, float]:
    off, turned = apparent(fit, shelf)
    return round(1000 * off, 4), round(float(np.degrees(turned)), 5)


def _between(camera: Camera, other: Camera) -> tuple[np.ndarray, np.ndarray]:
    """How far a camera is from another: place [m] and rotation vector [rad] in the world."""
    turn = Rotation.from_matrix(np.array(camera.rotation) @ np.array(other.rotation).T).as_rotvec()
    return np.subtract(camera.position, other.position), turn
