"""How near the device's limits the two inner loops come: points against superquadrics, and simulation.

`bench_inside` measures, and `write_page` makes a page from stored measurements. Every number on the page comes from
them, from a device's data sheet (`MACHINES`), or from counting what one evaluation or one time step has to do.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mechsearch_jax.benchmarks.parts import dense
from mechsearch_jax.benchmarks.parts.bench import Timing, measure
from mechsearch_jax.benchmarks.parts.ceilings import CEILINGS, has_kernels
from mechsearch_jax.geometry import superquadric
from mechsearch_jax.geometry.masked import block_size
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import compose, inverse, make, transform
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike, replacing
from mechsearch_jax.runtime.versions import versions

# Grasps that the planner has of a cylinder, each with a cloud of its own.
CLOUDS = 63
# Beside its special functions, an evaluation takes that many multiply-adds, or additions and products alone: 9 to bring
# a point into the object's frame, 4 for each of two norms.
MULTIPLY_ADDS = 17
# Of one world in the batch simulator: its state, and the contacts and constraint rows that it has room for.
WORLD_BYTES = 96_390

VERSIONS = {
    "inside: gauge": "`superquadric.gauge`, by XLA",
    "inside: xla": "`dense.least_gauges`, by XLA",
    "inside: kernel": "`dense.least_gauges`, the kernel",
}


INSIDE = f"""\
# How near the limits

Made by `mechsearch bench roofline benchmarks/results --out benchmarks/roofline.md` from the files there, which
`mechsearch bench inside` and `mechsearch bench simulate` wrote.

## Points against superquadrics

An evaluation is the gauge of one superquadric of any exponents at one point, from coordinates in the cloud's own frame
to the least over the cloud; no pair is left out. The formula of `mechsearch_jax/dense.py` takes {dense.OPERATIONS}
special functions (5 logarithms, 2 powers) and {MULTIPLY_ADDS} multiply-adds, additions or products. An NVIDIA GPU does
16 special functions and 128 multiply-adds per clock and multiprocessor, so the special-function units are what a good
kernel has to wait for. Their limit is given twice: measured, with a kernel that does nothing but `lg2` and `ex2` in
registers, in the same run; and from the data sheet, at the highest clock. From memory come only the poses: the clouds
stay in the caches.

The versions that XLA compiles are compared with the same limit, that of the formula, although XLA's own logarithms are
polynomials, on the multiply-add units. A CPU has no special-function units; the limit there is what XLA's logarithms
and powers take over an array in a core's cache, and does not allow for a second core.
"""

SIMULATION = f"""\
## Simulation

A step of one world is 4 ms of the Panda, the target and 8 objects, the arm ploughing through them. The arrays of one
world (state, contacts and constraint rows, as `MjxSimulator` makes room for them) hold {WORLD_BYTES:,} bytes. The limit
assumes that a step reads and writes each of them once and that arithmetic is free: memory allows no more. Nothing that
is made of many kernels, one after the other, comes near it: each of them reads and writes its part anew, and the solver
goes over the constraint rows again at every iteration.
"""


@dataclasses.dataclass(frozen=True)
class Machine:
    """A GPU as its maker describes it.

    Attributes:
      multiprocessors: how many.
      clock: highest [Hz].
      bandwidth: of its memory [bytes/s].
    """

    multiprocessors: int
    clock: float
    bandwidth: float

    @property
    def limits(self) -> dict[str, float]:
        """By the names of `CEILINGS` [1/s]; arithmetic as CUDA's guide has it for compute capability 9.0."""
        each = self.multiprocessors * self.clock
        return {"special functions": 16 * each, "multiply-adds": 128 * each, "memory": self.bandwidth}


MACHINES = {
    "gpu: NVIDIA H200": Machine(132, 1.98e9, 4.8e12),
    "gpu: NVIDIA H100 80GB HBM3": Machine(132, 1.98e9, 3.35e12),
}


def placed_clouds(placed: int, objects: int, points: int, seed: int = 0) -> tuple[Superquadrics, Any, Any, Any]:
    """Arguments of `dense.least_gauges`, random; only their shapes matter to the time that it takes."""
    rng = np.random.default_rng(seed)
    R = np.linalg.qr(rng.normal(size=(objects + placed, 3, 3)))[0]
    R *= np.sign(np.linalg.det(R))[:, None, None]
    T = np.tile(np.eye(4), (placed, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R[objects:], rng.uniform(-0.3, 0.3, (placed, 3))
    scene = Superquadrics(
        size=jnp.float32(rng.uniform(0.02, 0.1, (objects, 3))),
        exponents=jnp.float32(rng.uniform(0.2, 1.0, (objects, 2))),
        position=jnp.float32(rng.uniform(-0.3, 0.3, (objects, 3))),
        rotation=jnp.float32(R[:objects]),
        valid=jnp.ones(objects, bool),
    )
    clouds = rng.uniform(-0.2, 0.2, (CLOUDS, 3, points))
    return scene, jnp.float32(clouds), jnp.int32(rng.integers(0, CLOUDS, placed)), jnp.float32(T)


def plain_gauges(scene: Superquadrics, clouds: jax.Array, cloud: jax.Array, T_world_cloud: jax.Array) -> jax.Array:
    """What `dense.least_gauges` gives, written down without a thought for speed."""
    T = compose(inverse(make(scene.rotation, scene.position))[None], T_world_cloud[:, None])

    def one(args):
        index, T = args
        points = transform(T[:, None], clouds[index].T[None])
        return jnp.min(superquadric.gauge(scene.size[:, None], scene.exponents[:, None], points), axis=-1)

    at_once = max(block_size(dense.BLOCK) // (clouds.shape[2] * scene.capacity), 1)
    return jax.lax.map(one, (cloud, T), batch_size=min(at_once, cloud.shape[0]))


def bench_inside(placed: int, objects: int = 8, points: int = 2560, repeats: int = 10) -> list[Timing]:
    """Time dense evaluation in all its versions, and the ceilings of the device.

    Args:
      placed: number of placed clouds.
      objects: that each is tested against.
      points: of a cloud.
      repeats: number of timed calls.

    Raises:
      InputError: a number is not positive.
    """
    for name, value in {"placed": placed, "objects": objects, "points": points, "repeats": repeats}.items():
        if value < 1:
            raise InputError(f"bench inside: {name} {value} must be at least 1")
    functions: dict[str, Callable[..., Any]] = {
        "inside: gauge": plain_gauges,
        "inside: xla": lambda *args: dense.least_gauges(*args, method="xla"),
    }
    if has_kernels():
        functions["inside: kernel"] = lambda *args: dense.least_gauges(*args, method="kernel")
    arguments, about = placed_clouds(placed, objects, points), versions()
    shapes = {"placed": placed, "points": points, "evaluations": placed * objects * points}
    timings = []
    for subject, function in functions.items():
        compile_seconds, seconds = measure(function, [arguments], repeats)
        timings.append(Timing(subject, objects, shapes, compile_seconds, tuple(seconds), about))
    for name, (unit, ceiling) in CEILINGS.items():
        function, argument, amount = ceiling()
        compile_seconds, seconds = measure(function, [(argument,)], repeats)
        timings.append(Timing(f"ceiling: {name}", 0, {unit: amount}, compile_seconds, tuple(seconds), about))
    return timings


def read_timings(folder: PathLike) -> list[Timing]:
    """The timings in a folder's JSON files that the page is about, in the order of the files' names.

    Raises:
      InputError: a file cannot be read, or there are no such timings.
    """
    timings = []
    for path in sorted(Path(folder).glob("*.json")):
        try:
            value = json.loads(path.read_bytes())
            several = value.get("timings", [value]) if isinstance(value, dict) else []
            for one in several:
                if str(one.get("subject")).split(":")[0] in ("inside", "ceiling", "simulate"):
                    fields = {field.name: one[field.name] for field in dataclasses.fields(Timing)}
                    timings.append(Timing(**{**fields, "seconds": tuple(fields["seconds"])}))
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise InputError(f"{path}: is no result of bench: {error}") from None
    if not timings:
        raise InputError(f"{folder}: there are no results of bench inside or bench simulate (*.json) in this folder")
    return timings


def _row(*cells: str) -> str:
    return "| " + " | ".join(cells) + " |"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return [_row(*head), "|---|" + "---:|" * (len(head) - 1), *(_row(*row) for row in rows), ""]


def _number(value: float | None) -> str:
    """A rate with three digits and its prefix, or a dash."""
    if value is None:
        return "–"
    scale, prefix = next(((s, p) for s, p in ((1e12, " T"), (1e9, " G"), (1e6, " M")) if value >= s), (1.0, ""))
    value /= scale
    return f"{value:,.{max(0, 3 - len(str(int(value))))}f}{prefix}"


def _share(part: float | None, whole: float | None) -> str:
    return "–" if not part or not whole else f"{100 * part / whole:.3g}%"


def _rate(timings: dict[str, Timing], subject: str) -> float | None:
    return timings[subject].rate if subject in timings else None


def _inside(device: str, timings: dict[str, Timing]) -> list[str]:
    """The part on points against superquadrics on one device; `timings` by subject."""
    found = {subject: timing for subject, timing in timings.items() if subject in VERSIONS}
    published = MACHINES[device].limits if device in MACHINES else {}
    measured = {name: _rate(timings, f"ceiling: {name}") for name in CEILINGS}
    first = next(iter(found.values()))
    # What places a cloud in an object's frame are 16 numbers, written once and read once.
    traffic = 2 * 16 * 4 / first.shapes["points"]
    need = {"special functions": dense.OPERATIONS, "multiply-adds": MULTIPLY_ADDS, "memory": traffic}

    def at_most(limits: dict[str, Any], name: str) -> float | None:
        return limits[name] / need[name] if limits.get(name) else None

    whole = [at_most(limits, "special functions") for limits in (measured, published)]
    shapes = f"{first.shapes['placed']:,} clouds of {first.shapes['points']:,} points, {first.objects} objects"
    text = [f"### {device}", "", f"{shapes}; median of {len(first.seconds)} calls, jax {first.versions['jax']}.", ""]
    text += _table(
        ["version", "evaluations/s", "fastest and slowest call", "of the measured limit", "of the data sheet's"],
        [
            [
                VERSIONS[subject],
                _number(timing.rate),
                " to ".join(f"{1e3 * s:.4g}" for s in timing.spread) + " ms",
                *(_share(timing.rate, limit) for limit in whole),
            ]
            for subject, timing in sorted(found.items(), key=lambda item: list(VERSIONS).index(item[0]))
        ],
    )
    best = max(found.values(), key=lambda timing: timing.rate or 0.0)
    text += _table(
        ["resource", "measured", "data sheet", "one evaluation takes", "evaluations/s at most", "used by the fastest"],
        [
            [
                name,
                f"{_number(measured[name])}{'' if unit == 'operations' else 'B'}/s",
                f"{_number(published[name])}{'' if unit == 'operations' else 'B'}/s" if name in published else "–",
                f"{need[name]:.3g}" + ("" if unit == "operations" else " B"),
                _number(at_most(measured, name)),
                _share(best.rate, at_most(measured, name)),
            ]
            for name, (unit, _) in CEILINGS.items()
        ],
    )
    return text


def _simulation(timings: Sequence[Timing], bandwidths: dict[str, float]) -> list[str]:
    """The table of steps per second; `bandwidths` as measured, by device."""
    rows = []
    for timing in timings:
        device = timing.versions["device"]
        published = MACHINES[device].bandwidth if device in MACHINES else None
        bandwidth, source = (bandwidths[device], "measured") if device in bandwidths else (published, "data sheet")
        limit = bandwidth / (2 * WORLD_BYTES) if bandwidth else None
        rows.append(
            [
                device,
                f"{timing.shapes['worlds']:,}",
                f"{timing.rate:,.0f}",
                f"{_number(bandwidth)}B/s ({source})" if bandwidth else "–",
                _number(limit),
                _share(timing.rate, limit),
            ]
        )
    head = ["device", "worlds", "steps/s", "memory", "steps/s that it allows", "share"]
    return _table(head, rows)


def page(timings: Sequence[Timing]) -> str:
    """The page as Markdown."""
    by_device: dict[str, dict[str, Timing]] = {}
    for timing in timings:
        by_device.setdefault(timing.versions["device"], {}).setdefault(timing.subject, timing)
    text = [INSIDE]
    for device, mine in sorted(by_device.items(), reverse=True):
        if any(subject in VERSIONS for subject in mine):
            text += _inside(device, mine)
    text.append(SIMULATION)
    simulated = [timing for timing in timings if timing.subject == "simulate"]
    measured = {device: _rate(mine, "ceiling: memory") for device, mine in by_device.items()}
    text += _simulation(simulated, {device: rate for device, rate in measured.items() if rate})
    return "\n".join(text).rstrip("\n") + "\n"


def write_page(folder: PathLike, path: PathLike) -> None:
    """Write the page from the results in a folder.

    Raises:
      InputError: a result cannot be read, there are none, or the page cannot be written.
    """
    text = page(read_timings(folder))
    with replacing(path) as file:
        file.write(text.encode())
