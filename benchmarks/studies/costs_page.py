"""Writes docs/costs.md, what all experiments cost, in a checkout.

`python -m mechsearch_jax.benchmarks.studies.costs_page` does so. The page is the template `costs_page.md` beside this
file. Episodes are those of the paper's tables and of the declared studies; what one takes is measured, in the files of
`benchmarks/results`.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mechsearch_jax.benchmarks.pages.rewriting import rewrite
from mechsearch_jax.benchmarks.paper.paper_tables import METHODS, TABLES, PaperTable
from mechsearch_jax.benchmarks.parts.scaling import Measured, read_measured
from mechsearch_jax.benchmarks.report.results_page import Stored, table
from mechsearch_jax.benchmarks.running.episode_seconds import H100, Kind, StoredSeconds, nearest, stored_seconds
from mechsearch_jax.benchmarks.studies.declared import GROUPS
from mechsearch_jax.benchmarks.studies.studies import Study
from mechsearch_jax.envs.camera.recognisers import RecognitionName
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.envs.episode.protocols import ProtocolName
from mechsearch_jax.envs.scenes.scene_sets import SETS
from mechsearch_jax.envs.simulators.named import EngineName
from mechsearch_jax.planner import PRESETS
from mechsearch_jax.runtime.files import PathLike

TEMPLATE = Path(__file__).with_name("costs_page.md")
RECOGNITIONS: tuple[RecognitionName, ...] = ("oracle", "masks", "full")
STRICT: tuple[ProtocolName, ...] = ("strict",)
# Of a table that is run by more than the strict protocol.
PROTOCOLS: Mapping[str, tuple[ProtocolName, ...]] = {"table1": ("strict", "published-code")}
# How rates of episodes grow, in the folder of results.
SCALING = "scaling-h200.jsonl"
# When the processes of Table 1 began and ended, in the folder of results.
CLOCK = "table1-clock-h200"
# The seeds of Table 1 beside the first, of one variant.
MORE_SEEDS = 3
# On a GPU; protocol published-code tries one action after the other, which takes no batches.
ENGINES: Mapping[ProtocolName, EngineName] = {"strict": "MjxSimulator", "published-code": "NativeSimulator"}
ENGINE = ENGINES["strict"]
HOUR = 3600.0


@dataclasses.dataclass(frozen=True)
class Experiment:
    """Episodes that are run together.

    Attributes:
      name: in the table.
      episodes: how many each method runs.
    """

    name: str
    episodes: dict[Method, int]

    @property
    def count(self) -> int:
        """Episodes of all methods."""
        return sum(self.episodes.values())

    @property
    def programs(self) -> int:
        """How many planners are compiled for it: methods that differ in continuous settings alone share one."""
        return len({method.mould() for method in self.episodes})


def _of_table(paper: PaperTable) -> Experiment:
    """A table of the paper, all of its cells."""
    cells = itertools.product(
        METHODS, ("paper", "standard"), RECOGNITIONS, paper.actions, PROTOCOLS.get(paper.name, STRICT)
    )
    methods = [
        Method(policy, PRESETS[preset](actions=actions), recognition, engine=ENGINES[protocol], protocol=protocol)
        for policy, preset, recognition, actions, protocol in cells
    ]
    return Experiment(f"Table {paper.name.removeprefix('table')}", dict.fromkeys(methods, _scenes(paper)))


def _scenes(paper: PaperTable) -> int:
    """How many scenes a cell has, over all numbers of objects."""
    return sum(SETS[block].scenes for block in paper.blocks.values())


def _of_studies(name: str, studies: Sequence[Study]) -> Experiment:
    """Studies, of which each episode is run once."""
    scenes: dict[Method, set[tuple[str, int]]] = {}
    for study in studies:
        for variant in study.variants:
            listed = {(block.name, index) for block, index in study.scene_list(variant)}
            scenes.setdefault(variant.method(ENGINE), set()).update(listed)
    return Experiment(name, {method: len(listed) for method, listed in scenes.items()})


def experiments() -> list[Experiment]:
    """All of them."""
    more_seeds = Experiment(
        f"Table 1, `masks`, preset `standard`, {MORE_SEEDS} more seeds",
        {Method(recognition="masks", engine=ENGINE): _scenes(TABLES["table1"]) * MORE_SEEDS},
    )
    studies = [_of_studies(name, group) for name, group in GROUPS.items()]
    return [*map(_of_table, TABLES.values()), more_seeds, *studies]


@dataclasses.dataclass(frozen=True)
class Measures:
    """What was measured.

    Attributes:
      on_gpu: what episodes of the kinds that were measured take on a GPU.
      compiling: a planner and what else its episodes need, where nothing is kept [s].
      cpu: CPU time of an episode where there is no GPU [s].
      row: bytes of a row in a folder of results.
    """

    on_gpu: Sequence[StoredSeconds]
    compiling: float
    cpu: float
    row: float

    @classmethod
    def of(cls, stored: Stored) -> Measures:
        """From the stored results."""
        on_gpu = [each for each in stored_seconds() if each.device == H100]
        scaled = read_measured(stored.folder / "scaling-cpu.jsonl")
        report = stored["report-cpu"]
        return cls(
            on_gpu=on_gpu,
            compiling=max(each.seconds.compile_seconds for each in on_gpu),
            cpu=next(each.cpu_seconds for each in scaled if each.workers == 1 and each.cpu_seconds is not None),
            row=report["bytes"] / report["rows"],
        )

    def running(self, experiment: Experiment) -> float:
        """Hours of one GPU that an experiment runs, once compiled."""
        return sum(count * self.episode(method) for method, count in experiment.episodes.items()) / HOUR

    def episode(self, method: Method) -> float:
        """What an episode of a method takes on a GPU, once compiled, as dry runs count [s]."""
        closest = nearest(H100, Kind.of(method), self.on_gpu)
        assert closest is not None
        return closest.seconds.episode_seconds

    def seconds_table(self) -> str:
        """What was measured on a GPU, with links to the runs."""
        by_kind: dict[tuple[str, str, str], dict[str, str]] = {}
        for each in self.on_gpu:
            preset, recognition, trials, simulator = each.kind.words
            linked = f"[{each.seconds.episode_seconds:.2f}]({_file(each.source)})"
            by_kind.setdefault((preset, trials, simulator), {})[recognition] = linked
        lines = [[*kind, *(cells.get(name, "-") for name in RECOGNITIONS)] for kind, cells in by_kind.items()]
        return table(["preset", "trials", "simulator", *(f"s an episode, `{name}`" for name in RECOGNITIONS)], lines)

    def cells(self, name: str, parts: Sequence[Experiment]) -> list[str]:
        """A line of the table: what experiments cost together."""
        episodes, programs = sum(part.count for part in parts), sum(part.programs for part in parts)
        return [
            name,
            str(sum(len(part.episodes) for part in parts)),
            f"{episodes:,}",
            str(programs),
            f"{sum(map(self.running, parts)):.1f}",
            f"{programs * self.compiling / HOUR:.1f}",
            f"{episodes * self.cpu / HOUR:.0f}",
            f"{episodes * self.row / 1e6:.1f}",
        ]


def _file(source: str) -> str:
    """A file of a run as docs/ sees it; the lines of a table of rows."""
    path = Path(source)
    return f"../{path.with_suffix('.jsonl') if path.suffix == '.parquet' else path}"


def scaling(measured: Sequence[Measured]) -> str:
    """How many episodes a second several GPUs or CPU workers ran, and how many times those of a single one."""
    single = {each.device: each.rate for each in measured if each.workers == 1}
    names = {"shards": "GPUs with a process each", "ray": "GPUs by Ray", "workers": "CPU workers with a core each"}
    several = (
        f"{each.workers} {names[each.case]} {each.rate:.2f}, {each.rate / single[each.device]:.2f} times a single one"
        for each in measured
        if each.workers > 1
    )
    return "; ".join(several)


def gpu_seconds(jobs: Sequence[Mapping[str, Any]], gpus: int) -> float:
    """What processes that shared GPUs evenly took of them, each weighted with its `part` [s].

    Args:
      jobs: with `start` and `end` [s], and `part`, the share of the process's time that counts.
      gpus: how many there were. A process uses one, so fewer processes than GPUs leave some idle, which count for none.
    """
    times = sorted({job[name] for job in jobs for name in ("start", "end")})
    total = 0.0
    for begin, end in itertools.pairwise(times):
        running = [job for job in jobs if job["start"] <= begin and end <= job["end"]]
        total += (end - begin) * sum(job["part"] for job in running) * min(1.0, gpus / max(len(running), 1))
    return total


def clock(stored: Stored) -> dict[str, int | float]:
    """What Table 1 took by the clock: its episodes, and the time of one GPU [s]."""
    sittings = stored[CLOCK]["sittings"]
    return {
        "episodes": sum(job["episodes"] for sitting in sittings for job in sitting["jobs"]),
        "seconds": sum(gpu_seconds(sitting["jobs"], sitting["gpus"]) for sitting in sittings),
    }


def computed(stored: Stored) -> dict[str, Any]:
    """The fields of the template."""
    measures, parts = Measures.of(stored), experiments()
    header = ["experiment", "variants", "episodes", "planners compiled", "GPU hours running", "compiling"]
    lines = [measures.cells(part.name, [part]) for part in parts]
    hours = sum(map(measures.running, parts))
    compiling = sum(part.programs for part in parts) * measures.compiling / HOUR
    reports = {run["what"]: run for run in stored["report-cpu"]["runs"]}
    return {
        "costs": table([*header, "CPU hours instead", "MB of rows"], [*lines, measures.cells("all", parts)]),
        "measures": measures,
        "seconds": measures.seconds_table(),
        "hours": hours + compiling,
        "eight": (hours + compiling) / 8,
        "cold": hours / 8 + compiling,
        "cores": sum(part.count for part in parts) * measures.cpu / HOUR / 64,
        "report": reports["report"],
        "rows": stored["report-cpu"]["rows"],
        "clock": clock(stored),
        "scaling": scaling(read_measured(stored.folder / SCALING)),
    }


def page(folder: PathLike) -> str:
    """The page in Markdown, from the folder of stored results."""
    return TEMPLATE.read_text(encoding="utf-8").format_map(computed(Stored(folder)))


def main(arguments: Sequence[str] | None = None) -> None:
    """Rewrite the page."""
    rewrite(page, "results", "benchmarks/results", "docs/costs.md", arguments)


if __name__ == "__main__":
    main()
