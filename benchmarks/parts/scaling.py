"""How many episodes a second so many workers run: worker processes on a CPU, and processes or Ray's workers on GPUs.

Compilations are apart: they are kept before anything is timed, and what a worker does until it is up does not count.
Every worker has the same number of cores and of episodes, however many there are. So a rate that grows as the number of
workers says that they do not stand in each other's way.

- `workers`: `evaluate` with `Processes`. Each worker runs a copy of the same scenes, since few episodes of different
  scenes take too different times, and before them a copy of one scene, by which it has read what was kept.
- `shards`: a process of `mechsearch evaluate --shard K/N` for each GPU, which sees that one alone.
- `ray`: `mechsearch evaluate --cluster ray`, which sees so many GPUs.

All run on the scene set `development`, which nothing is reported on.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

from rich.table import Table

from mechsearch_jax.benchmarks.running.evaluate import Job, evaluate
from mechsearch_jax.benchmarks.running.processes import Processes, run_job
from mechsearch_jax.benchmarks.store.rows import EpisodeRow
from mechsearch_jax.benchmarks.store.shards import Results
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.envs.scenes.scene_sets import SETS, Block
from mechsearch_jax.runtime.cores import VARIABLE, cores
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike, replacing
from mechsearch_jax.workspace.scenario import Scenario

Case = Literal["workers", "shards", "ray"]
SET, SEED = "development", 0
# Which GPUs a process sees.
VISIBLE = "CUDA_VISIBLE_DEVICES"
# How often it is looked which rows there are [s].
LOOK_EVERY = 0.1
Progress = Callable[[str], None]


@dataclasses.dataclass(frozen=True)
class MeasuredScaling:
    """How fast so many workers were.

    Attributes:
      case: see this module.
      workers: how many; on GPUs that is how many GPUs.
      cores: of each.
      episodes: that were timed, of all workers together.
      seconds: they took: from the end of a worker's first episode to the end of its last, the mean of all workers; on
        GPUs from the first row of all to the last [s].
      last_seconds: from the end of the first episode of all to the end of the last: with the time in which some workers
        have nothing left to do [s].
      cpu_seconds: mean CPU time of an episode in its worker, of all threads [s]; None on GPUs.
      steps: mean number of actions of an episode.
      code, device, versions: as in `EpisodeRow`.
      command: that was typed.
    """

    case: Case
    workers: int
    cores: int
    episodes: int
    seconds: float
    last_seconds: float
    cpu_seconds: float | None
    steps: float
    code: str
    device: str
    versions: Mapping[str, str]
    command: str

    @property
    def rate(self) -> float:
        """Episodes per second of all workers together."""
        return self.episodes / self.seconds

    def value(self) -> dict[str, Any]:
        """The measurement as JSON values: the fields and the rate."""
        return {**dataclasses.asdict(self), "episodes_per_second": self.rate}


def _measured(
    case: Case,
    workers: int,
    share: int,
    rows: Sequence[EpisodeRow],
    command: str,
    episodes: int,
    seconds: tuple[float, float, float | None],
) -> MeasuredScaling:
    """A measurement of rows, with what they say of themselves.

    Args:
      case: as in `MeasuredScaling`, and so are `workers`, `command` and `episodes`.
      share: cores of each worker.
      rows: of all episodes.
      seconds: the three times of `MeasuredScaling` [s].

    Raises:
      InputError: an episode could not be run to its end.
    """
    if failed := next((row for row in rows if row.is_error), None):
        raise InputError(f"bench scaling: {failed.scenario}: {failed.failure}")
    return MeasuredScaling(
        case=case,
        workers=workers,
        cores=share,
        episodes=episodes,
        seconds=seconds[0],
        last_seconds=seconds[1],
        cpu_seconds=seconds[2],
        steps=sum(row.steps for row in rows) / len(rows),
        code=rows[0].code,
        device=rows[0].device or "",
        versions=json.loads(rows[0].versions or "{}"),
        command=command,
    )


def scenes(count: int) -> list[tuple[Block, int]]:
    """Scenes of `SET`, as many with each number of objects as with any other, but for one."""
    blocks = SETS[SET].blocks
    return [(blocks[i % len(blocks)], i // len(blocks)) for i in range(count)]


@dataclasses.dataclass(frozen=True)
class _Spell:
    """When a worker ran an episode, by a clock that all processes of a machine share, and the CPU time of it [s]."""

    scenario: str
    begun: float
    ended: float
    cpu: float


def run_timed(folder: str, job: Job) -> EpisodeRow:
    """`run_job` in a worker, which adds when that was to a file of its own in a folder."""
    begun, used = time.monotonic(), time.process_time()
    row = run_job(job)
    spell = _Spell(job.scenario.name, begun, time.monotonic(), time.process_time() - used)
    with open(Path(folder) / f"{os.getpid()}.jsonl", "a") as file:
        file.write(json.dumps(dataclasses.asdict(spell)) + "\n")
    return row


def _spells(folder: Path) -> list[list[_Spell]]:
    """Of each worker, in their order."""
    return [[_Spell(**json.loads(line)) for line in file.read_text().splitlines()] for file in folder.glob("*.jsonl")]


def _copies(scenarios: Sequence[Scenario], workers: int) -> list[Job]:
    """For each worker a copy of the longest scene, and then one of each, so that each begins with another."""

    def copy(scenario: Scenario, name: str, worker: int) -> Job:
        named = dataclasses.replace(scenario, name=f"{scenario.name}-{name}-{worker}")
        return Job(named.name, named, Method(), SEED)

    longest = max(scenarios, key=lambda scenario: len(scenario.objects))
    first = [copy(longest, "first", worker) for worker in range(workers)]
    count = len(scenarios)
    return first + [copy(scenarios[(turn + w) % count], "timed", w) for turn in range(count) for w in range(workers)]


def keep_what_is_compiled(scenarios: Sequence[Scenario], progress: Progress) -> None:
    """Run every scene once in a worker with all cores, so that no later worker compiles anything.

    Raises:
      InputError: an episode could not be run to its end.
    """
    jobs = [Job(scenario.name, scenario, Method(), SEED) for scenario in scenarios]
    progress("compiling")
    with tempfile.TemporaryDirectory() as folder:
        rows = evaluate(
            jobs, folder, Processes(1), lambda row, tally: progress(f"warming up {tally.ended}/{len(jobs)}")
        )
    _measured("workers", 1, cores(), rows, "", len(rows), (1.0, 1.0, None))


def measure_workers(
    scenarios: Sequence[Scenario], workers: int, share: int, command: str, progress: Progress = lambda what: None
) -> MeasuredScaling:
    """How fast worker processes run episodes one after the other, each a copy of these scenes.

    Args:
      scenarios: as many as each worker has episodes.
      workers: how many.
      share: cores of each worker.
      command: that was typed.
      progress: called with what is going on.

    Raises:
      InputError: an episode could not be run to its end, or a worker died.
    """
    jobs = _copies(scenarios, workers)
    with tempfile.TemporaryDirectory() as name:
        folder, spells = Path(name) / "rows", Path(name) / "spells"
        spells.mkdir()
        runner = Processes(workers, run=functools.partial(run_timed, str(spells)), cores=share)
        rows = evaluate(
            jobs, folder, runner, lambda row, tally: progress(f"{workers} workers: {tally.ended}/{len(jobs)} episodes")
        )
        of_workers = _spells(spells)
    if len(of_workers) != workers or any("-first-" not in each[0].scenario for each in of_workers):
        raise InputError("bench scaling: a worker died, and another took its place; run it again")
    firsts, lasts = zip(*((each[0].ended, each[-1].ended) for each in of_workers), strict=True)
    mean = sum(last - first for first, last in zip(firsts, lasts, strict=True)) / workers
    count = len(jobs) - workers
    cpu = sum(spell.cpu for each in of_workers for spell in each[1:]) / count
    return _measured("workers", workers, share, rows, command, count, (mean, max(lasts) - min(firsts), cpu))


def gpus() -> list[str]:
    """The GPUs that this process may use, as `VISIBLE` names them.

    Raises:
      InputError: there is none.
    """
    if (chosen := os.environ.get(VISIBLE)) is not None:
        return [each for each in chosen.split(",") if each]
    try:
        listed = subprocess.run(["nvidia-smi", "--list-gpus"], capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError) as error:
        raise InputError(f"bench scaling: there is no NVIDIA GPU here ({error}); give --workers") from None
    return [str(i) for i in range(len(listed.splitlines()))]


def _commands(case: Case, count: int, seeds: Sequence[int], share: int, out: Path) -> list[tuple[list[str], dict]]:
    """The commands that run side by side, and the variables of each."""
    main = [sys.executable, "-m", "mechsearch_jax.commands.main", "evaluate", SET, "--seed", *map(str, seeds)]
    names = gpus()[:count]
    if case == "ray":
        return [
            ([*main, "--cluster", "ray", "--out", str(out)], {VISIBLE: ",".join(names), VARIABLE: str(share * count)})
        ]
    return [
        (
            [*main, "--shard", f"{number}/{count}", "--out", str(out / str(number))],
            {VISIBLE: name, VARIABLE: str(share)},
        )
        for number, name in enumerate(names, start=1)
    ]


@contextlib.contextmanager
def _running(commands: Sequence[tuple[list[str], dict]], log: Path) -> Iterator[list[subprocess.Popen[bytes]]]:
    """The processes of commands, which are ended with the block."""
    with open(log, "wb") as output, contextlib.ExitStack() as stack:
        processes = []
        for arguments, variables in commands:
            process = subprocess.Popen(arguments, env=os.environ | variables, stdout=output, stderr=output)
            stack.callback(process.wait)
            stack.callback(process.terminate)
            processes.append(process)
        yield processes


def _times_of_rows(
    commands: Sequence[tuple[list[str], dict]], folder: Path, enough: int, progress: Progress
) -> tuple[list[EpisodeRow], list[float]]:
    """The rows of commands, and when each was there by `time.monotonic`, until there are enough of them.

    Raises:
      InputError: a command fails.
    """
    results = [Results(arguments[arguments.index("--out") + 1]) for arguments, _ in commands]
    times: list[float] = []
    with _running(commands, folder / "log") as processes:
        while len(times) < enough:
            time.sleep(LOOK_EVERY)
            over = [process.poll() for process in processes]
            fresh = sum(len(each.refresh()) for each in results)
            times += [time.monotonic()] * fresh
            progress(f"{len(times)} episodes")
            if any(over) or (None not in over and not fresh and len(times) < enough):
                lines = (folder / "log").read_text(errors="replace").strip().splitlines()
                raise InputError(f"bench scaling: {' '.join(commands[0][0][3:])}: {(lines or ['it ended'])[-1][:300]}")
    return [row for each in results for row in each.rows.values()], times


def measure_gpus(
    case: Case,
    count: int,
    episodes: int,
    share: int,
    command: str,
    progress: Progress = lambda what: None,
) -> MeasuredScaling:
    """How fast GPUs run episodes in batches.

    Args:
      case: "shards" or "ray".
      count: of GPUs.
      episodes: of each GPU, rounded up to all scenes of `SET` with some seeds.
      share: cores for each GPU.
      command: that was typed.
      progress: called with what is going on.

    Raises:
      InputError: there are fewer GPUs, or a command fails.
    """
    if len(gpus()) < count:
        raise InputError(f"bench scaling: {count} GPUs are wanted, and {len(gpus())} are here")
    all_scenes = SETS[SET].scenes
    each = math.ceil(episodes / all_scenes)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        # When the first row is there, all is compiled and kept.
        warming = _commands(case, 1, range(each), share, folder / "warm")
        _times_of_rows(warming, folder, 1, lambda what: progress(f"warming up: {what}"))
        commands = _commands(case, count, range(each * count), share, folder / "timed")
        wanted = all_scenes * each * count
        rows, times = _times_of_rows(commands, folder, wanted, lambda what: progress(f"{count} GPUs: {what}"))
    seconds = times[-1] - times[0]
    return _measured(case, count, share, rows, command, len(times) - 1, (seconds, seconds, None))


def read_measured(path: PathLike) -> list[MeasuredScaling]:
    """What a file of `add_measured` holds; nothing where it is not there.

    Raises:
      InputError: it cannot be read, or holds something else.
    """
    names = {field.name for field in dataclasses.fields(MeasuredScaling)}
    measured = []
    try:
        for line in Path(path).read_text(encoding="utf-8").splitlines():
            value = json.loads(line)
            measured.append(MeasuredScaling(**{name: value[name] for name in names}))
    except FileNotFoundError:
        return []
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: holds no measurements of bench scaling ({error}); name another file") from error
    return measured


def add_measured(measured: MeasuredScaling, path: PathLike) -> None:
    """Add a line of JSON to a file, which is made if it is not there.

    Raises:
      InputError: it holds something else, or cannot be written.
    """
    lines = [*read_measured(path), measured]
    with replacing(path) as file:
        file.write("".join(json.dumps(each.value()) + "\n" for each in lines).encode())


def ratio(measured: MeasuredScaling, all_measured: Sequence[MeasuredScaling]) -> float:
    """How many times the rate of the fewest workers of the same case, cores, code and device."""
    alike = [each for each in all_measured if _of(each) == _of(measured)]
    return measured.rate / min(alike, key=lambda each: each.workers).rate


def _of(measured: MeasuredScaling) -> tuple[Any, ...]:
    return measured.case, measured.cores, measured.code, measured.device


def scaling_table(measured: Sequence[MeasuredScaling]) -> Table:
    """How fast so many workers were, and how many times the rate of the fewest: a row for each measurement."""
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0), header_style="bold")
    for name in ("", "workers", "cores", "episodes", "seconds", "episodes/s", "CPU s each", "times"):
        table.add_column(name, justify="right" if name else "left", no_wrap=True)
    for each in measured:
        numbers = (each.workers, each.cores, each.episodes)
        cpu = "-" if each.cpu_seconds is None else f"{each.cpu_seconds:.2f}"
        figures = (f"{each.seconds:.1f}", f"{each.rate:.3f}", cpu, f"{ratio(each, measured):.2f}")
        table.add_row(each.case, *map(str, numbers), *figures)
    return table


CASES: tuple[Case, ...] = get_args(Case)
