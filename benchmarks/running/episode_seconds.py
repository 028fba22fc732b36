"""How long episodes took in stored runs: `python -m mechsearch_jax.benchmarks.running.episode_seconds` in a checkout
writes `episode_seconds.json` beside this file, which travels with the package.

Every entry names the run that it is of. Of several runs of a device the one counts whose episodes took the least time:
what ran beside the others made them slower.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from mechsearch_jax.benchmarks.statistics.preset_names import settings_of
from mechsearch_jax.benchmarks.store.rows import EpisodeRow
from mechsearch_jax.benchmarks.store.runs import RUNS, StoredRun, stored_runs
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.envs.simulators.named import EngineName
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import replacing

FILE = Path(__file__).with_name("episode_seconds.json")


class Kind(NamedTuple):
    """What decides most about how long an episode takes.

    Attributes:
      preset: that its settings are nearest to.
      recognition: what the planner sees the objects through.
      trials: whether actions are tried before one is executed.
      simulator: that judges the episodes.
    """

    preset: str
    recognition: str
    trials: bool
    simulator: EngineName

    @classmethod
    def of(cls, method: Method) -> Kind:
        """The kind of the episodes of a method."""
        return kind_of({**method.options(), "simulator": method.engine})

    @property
    def words(self) -> tuple[str, str, str, str]:
        """The kind in words."""
        trials = "with trials" if self.trials else "no trials"
        simulator = "native simulator" if self.simulator == "NativeSimulator" else "batch simulator"
        return self.preset, self.recognition, trials, simulator

    def distance(self, other: Kind) -> tuple[bool, ...]:
        """How far another kind is from telling how long this one takes: the simulator decides most, then trials."""
        return (
            self.simulator != other.simulator,
            self.trials != other.trials,
            # All others look at images.
            (self.recognition == "oracle") != (other.recognition == "oracle"),
            self.recognition != other.recognition,
            self.preset != other.preset,
        )


class MeasuredSeconds(NamedTuple):
    """Mean wall times.

    Attributes:
      episode_seconds: of an episode in a process or, in a batch, its share of the batch's time [s].
      compile_seconds: of compiling what its episodes need [s].
      episodes: how many were measured.
    """

    episode_seconds: float
    compile_seconds: float
    episodes: int


@dataclasses.dataclass(frozen=True)
class StoredSeconds:
    """What episodes of a kind took on a device, by a stored run.

    Attributes:
      device: as `runtime.versions.versions` says it.
      kind: of the episodes.
      seconds: what they took.
      source: the file of the run.
    """

    device: str
    kind: Kind
    seconds: MeasuredSeconds
    source: str


def kind_of(options: Mapping[str, Any] | str) -> Kind:
    """The kind of the episodes of a method's options with its simulator, or of a `EpisodeRow.configuration`."""
    return _kind_of(options if isinstance(options, str) else json.dumps(options, sort_keys=True))


@functools.lru_cache(maxsize=4096)
def _kind_of(configuration: str) -> Kind:
    options = json.loads(configuration)
    trials = options.get("trials", "none") != "none"
    simulator = options.get("simulator", "NativeSimulator")
    return Kind(settings_of(options).preset, options.get("recognition", "oracle"), trials, simulator)


def measured(rows: Sequence[EpisodeRow], compilations: int, at_once: int = 1) -> MeasuredSeconds:
    """Mean seconds of an episode, and of a compilation if as many processes waited for each at once."""
    running = sum(row.planning_seconds + row.simulation_seconds for row in rows) / len(rows)
    return MeasuredSeconds(running, sum(row.compile_seconds or 0.0 for row in rows) / compilations / at_once, len(rows))


@functools.cache
def stored_seconds() -> Sequence[StoredSeconds]:
    """The entries of `FILE`."""
    return [
        StoredSeconds(
            entry["device"],
            Kind(*(entry[name] for name in Kind._fields)),
            MeasuredSeconds(entry["episode_seconds"], entry["compile_seconds"], entry["episodes"]),
            entry["source"],
        )
        for entry in json.loads(FILE.read_text(encoding="utf-8"))
    ]


def nearest(device: str, kind: Kind, stored: Sequence[StoredSeconds]) -> StoredSeconds | None:
    """What tells most of how long episodes take: what dry runs count with.

    Args:
      device: as `runtime.versions.versions` says it.
      kind: of the episodes.
      stored: what was measured.

    Returns:
      Of the device, or else of others of its platform, what was measured of the nearest kind; None where there is none.
    """
    platform = device.partition(":")[0]
    alike = [each for each in stored if each.device == device] or [
        each for each in stored if each.device.partition(":")[0] == platform
    ]
    return min(alike, key=lambda each: kind.distance(each.kind), default=None)


def seconds_of(run: StoredRun) -> list[StoredSeconds]:
    """What the episodes of a run took, by device and kind."""
    groups: dict[tuple[str, Kind], list[EpisodeRow]] = {}
    for row in run.rows:
        if row.device and not row.is_error:
            groups.setdefault((row.device, kind_of(row.configuration)), []).append(row)
    return [
        StoredSeconds(
            device,
            kind,
            measured(rows, len({(row.configuration, row.target) for row in rows})),
            f"{RUNS}/{run.name}.parquet",
        )
        for (device, kind), rows in groups.items()
    ]


def _with_compilation(entry: StoredSeconds, each: Sequence[StoredSeconds]) -> StoredSeconds:
    """An entry with the longest compilation of its device: of a batch, rows do not tell what is compiled beforehand."""
    longest = max(other.seconds.compile_seconds for other in each if other.device == entry.device)
    return dataclasses.replace(entry, seconds=entry.seconds._replace(compile_seconds=longest))


def entries(runs: Sequence[StoredRun]) -> list[dict[str, Any]]:
    """What `FILE` holds, of stored runs."""
    each = [entry for run in runs for entry in seconds_of(run)]
    slowest_first = sorted(each, key=lambda entry: -entry.seconds.episode_seconds)
    fastest = {(entry.device, entry.kind): _with_compilation(entry, each) for entry in slowest_first}
    return [
        {
            "device": entry.device,
            **entry.kind._asdict(),
            **{name: round(value, 3) for name, value in entry.seconds._asdict().items()},
            "source": entry.source,
        }
        for _, entry in sorted(fastest.items())
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the file."""
    parser = argparse.ArgumentParser(description="Write how long episodes took, from the stored runs.")
    parser.add_argument("--results", default=str(RUNS.parent), help="folder of the stored results")
    folder = Path(parser.parse_args(arguments).results) / RUNS.name
    if not folder.is_dir():
        parser.error(f"{folder}: is not there; give the folder of the stored results as --results")
    try:
        lines = ",\n".join(f" {json.dumps(entry)}" for entry in entries(stored_runs(folder)))
        with replacing(FILE) as file:
            file.write(f"[\n{lines}\n]\n".encode())
    except InputError as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
