"""How long a report takes: drawn rows, as a sweep leaves them in its folder, reported by the command itself."""

from __future__ import annotations

import dataclasses
import itertools
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from mechsearch_jax.benchmarks.report.console_tables import plain_table
from mechsearch_jax.benchmarks.running.evaluate import present_code
from mechsearch_jax.benchmarks.store.rows import EpisodeRow
from mechsearch_jax.benchmarks.store.shards import ROWS_PER_SHARD, ShardWriter
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.planner import PRESETS
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.versions import versions
from mechsearch_jax.workspace.scenario import example_scenarios, load_scenario

# What the variants differ in: 6 x 4 x 4 = 96 of them.
SWEPT: Mapping[str, tuple[Any, ...]] = {
    "gamma": (0.5, 0.6, 0.7, 0.8, 0.9, 1.0),
    "horizon": (1, 2, 3, 5),
    "sequences": (10, 30, 100, 300),
}
SEEDS, OBJECTS, MOST_STEPS = 4, (2, 4, 6, 8), 10
# Why a drawn episode fails: it did not find, not grasp, or not retrieve.
FAILURES = ("not found", "found, but not graspable", "an object fell off the board at action {steps}")
# The options that the command is timed with.
REPORTS: Mapping[str, tuple[str, ...]] = {
    "report": (),
    "with paired differences": ("--baseline", "gamma=0.9,horizon=3,sequences=30", "--curve", "gamma", "sequences"),
}
MEBIBYTE = 2**20


def drawn_rows(count: int, seed: int = 0) -> list[EpisodeRow]:
    """Rows as `sweep` leaves them, of episodes that are drawn at random and never run.

    Each scene has a difficulty of its own and each variant a skill, so that the episodes of a scene are alike.

    Args:
      count: how many: all variants of as many scenes as that takes.
      seed: of the draws.
    """
    draws = np.random.default_rng(seed)
    plain = _plain_rows()
    scenes = math.ceil(count / (len(plain) * SEEDS))
    difficulty, skill = draws.normal(0.0, 1.0, scenes), draws.normal(1.5, 0.3, len(plain))
    episodes = itertools.product(range(scenes), range(len(plain)), range(SEEDS))
    return [
        _drawn_row(draws, plain[variant], scene, number, 1.0 / (1.0 + math.exp(difficulty[scene] - skill[variant])))
        for scene, variant, number in itertools.islice(episodes, count)
    ]


def _plain_rows() -> list[EpisodeRow]:
    """A row of each variant, whose episode and scene are to be filled in."""
    scenario = load_scenario(next(iter(example_scenarios().values())))
    device = versions()["device"]
    rows = []
    for values in itertools.product(*SWEPT.values()):
        method = Method(config=PRESETS["standard"](**dict(zip(SWEPT, values, strict=True))))
        options = {**method.options(), "target": "cylinder", "simulator": method.engine, "seed": 0}
        row = EpisodeRow.failed(scenario, options, "", present_code())
        rows.append(dataclasses.replace(row, device=device, versions="{}", compile_seconds=0.0))
    return rows


def _drawn_row(draws: np.random.Generator, plain: EpisodeRow, scene: int, seed: int, chance: float) -> EpisodeRow:
    """The row of an episode that reaches each goal after the one before with a chance, some actions later."""
    reached = int(np.argmin([*(draws.random(len(FAILURES)) < chance ** (1 / len(FAILURES))), False]))
    after = np.minimum(np.cumsum(draws.integers(1, 4, len(FAILURES))), MOST_STEPS).tolist()
    steps = after[-1] if reached == len(FAILURES) else MOST_STEPS
    objects = OBJECTS[scene % len(OBJECTS)]
    lost, fallen = (draws.random(2) < 0.05).astype(int).tolist()
    return dataclasses.replace(
        plain,
        scenario=f"drawn-{objects}-{scene:04d}",
        content_hash=f"{scene:064x}",
        objects=objects,
        seed=seed,
        found_step=after[0] if reached > 0 else None,
        graspable_step=after[1] if reached > 1 else None,
        paper_graspable=reached > 1,
        paper_graspable_step=after[1] if reached > 1 else None,
        retrieved=reached == len(FAILURES),
        steps=steps,
        failure=None if reached == len(FAILURES) else FAILURES[reached].format(steps=steps),
        planning_seconds=0.1 * steps * float(draws.lognormal(0.0, 0.2)),
        simulation_seconds=0.2 * steps * float(draws.lognormal(0.0, 0.2)),
        **{"looks": after[0], "truth_lost": lost, "truth_lost_step": 1 if lost else None, "restarts": lost},
        **{"objects_fallen": fallen, "fallen_step": steps if fallen else None, "held_up": 0, "unsettled": 0},
    )


@dataclasses.dataclass(frozen=True)
class ReportTiming:
    """What one report took.

    Attributes:
      what: one of `REPORTS`.
      seconds: wall time of the command, from its start to its end [s].
      cpu_seconds: of all its threads [s].
      memory: the most that it held at once [MiB].
      bytes: that its files have.
    """

    what: str
    seconds: float
    cpu_seconds: float
    memory: float
    bytes: int


def time_report(what: str, rows: Path, out: Path) -> ReportTiming:
    """Run `mechsearch report` in a process of its own.

    Args:
      what: one of `REPORTS`.
      rows: folder of the results.
      out: folder for the report.

    Raises:
      InputError: the command failed.
    """
    main = (sys.executable, "-m", "mechsearch_jax.commands.main")
    start = time.perf_counter()
    process = subprocess.Popen(
        [*main, "report", str(rows), "--out", str(out), *REPORTS[what]], stdout=subprocess.DEVNULL
    )
    # Tells of this process alone what it used, unlike `resource.getrusage`.
    _, status, usage = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - start
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise InputError(f"bench report: the report of {rows} ended with status {process.returncode}")
    size = sum(file.stat().st_size for file in out.rglob("*") if file.is_file())
    # Linux counts in KiB, macOS in bytes.
    unit = 1 if sys.platform == "darwin" else 1024
    return ReportTiming(what, seconds, usage.ru_utime + usage.ru_stime, usage.ru_maxrss * unit / MEBIBYTE, size)


def bench_report(count: int, progress: Callable[[str], None] = lambda what: None) -> dict[str, Any]:
    """Draw rows, store them as `sweep` does, and time the reports of them.

    Args:
      count: of rows.
      progress: called with what is begun.

    Returns:
      JSON values: the numbers of rows, variants, scenes and bytes, and the timings.

    Raises:
      InputError: a report failed.
    """
    progress("drawing rows")
    rows = drawn_rows(count)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with ShardWriter(folder / "rows", "drawn") as writer:
            for first in range(0, count, ROWS_PER_SHARD):
                writer.append(rows[first : first + ROWS_PER_SHARD])
        timings = []
        for what in REPORTS:
            progress(what)
            timings.append(dataclasses.asdict(time_report(what, folder / "rows", folder / what)))
        size = sum(file.stat().st_size for file in (folder / "rows").iterdir() if file.is_file())
    return {
        "subject": "report",
        "rows": count,
        "variants": len({row.configuration for row in rows}),
        "scenes": len({row.scenario for row in rows}),
        "bytes": size,
        "runs": timings,
        "cores": os.cpu_count(),
        "versions": versions(),
    }


def timings_table(value: Mapping[str, Any]) -> Table:
    """What `bench_report` gives, a row for each report."""
    table = plain_table(f"{value['rows']:,} rows of {value['variants']} variants on {value['scenes']} scenes")
    for name in ("", "wall [s]", "CPU [s]", "memory [MiB]", "files [MB]"):
        table.add_column(name, justify="right" if name else "left", no_wrap=True)
    for run in value["runs"]:
        cells = (
            f"{run['seconds']:.1f}",
            f"{run['cpu_seconds']:.1f}",
            f"{run['memory']:.0f}",
            f"{run['bytes'] / 1e6:.1f}",
        )
        table.add_row(run["what"], *cells)
    return table
