"""Single episodes of a report: which ones to show, their filmstrips and pages, drawn by running them again."""

from __future__ import annotations

import collections
import dataclasses
import statistics
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from mechsearch_jax.benchmarks.running.evaluate import present_code
from mechsearch_jax.benchmarks.statistics.variants import label_variants
from mechsearch_jax.benchmarks.store.rows import EpisodeRow, episode_key, options_of
from mechsearch_jax.envs.episode.endings import ending_words, verdict
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike
from mechsearch_jax.workspace.scenario import Scenario

# Of each kind.
EACH = 3
TYPICAL, LOST, SLOWEST = "Typical: retrieved in the usual number of actions", "Lost", "Slowest"
# The folder of the pictures in that of a report.
FOLDER = "films"
# What has to be the same for an episode to have ended the same.
_END = ("found_step", "graspable_step", "retrieved", "steps", "failure")


@dataclasses.dataclass(frozen=True)
class Film:
    """An episode that a report shows.

    Attributes:
      row: of the episode.
      method: the label of its variant.
      why: it is shown.
      caption: what is to be known of it.
      drawn: whether there is a picture of it.
      has_page: whether there is a page of it.
    """

    row: EpisodeRow
    method: str
    why: str
    caption: str
    drawn: bool
    has_page: bool = False

    @property
    def seed(self) -> int:
        """Of the episode."""
        return self.row.seed

    @property
    def file(self) -> str:
        """The picture, in the folder of the report."""
        return f"{FOLDER}/{episode_key(self.row)}.png"

    @property
    def page(self) -> str:
        """Its page, in the folder of the report."""
        return f"{FOLDER}/{episode_key(self.row)}.html"


def chosen(rows: Sequence[EpisodeRow]) -> list[tuple[str, EpisodeRow]]:
    """Episodes worth a look, and why: typical ones, lost ones for different reasons, and the slowest.

    The same ones for the same rows, in whatever order.
    """
    ended = [row for row in rows if not row.is_error]
    won = [row for row in ended if row.retrieved]
    episodes: list[tuple[str, EpisodeRow]] = []
    if won:
        usual = statistics.median_low(row.steps for row in won)
        episodes += [(TYPICAL, row) for row in sorted((r for r in won if r.steps == usual), key=episode_key)[:EACH]]
    reasons: dict[str, list[EpisodeRow]] = {}
    for row in ended:
        if not row.retrieved:
            reasons.setdefault(_reason(row), []).append(row)
    ranked = sorted(reasons.values(), key=lambda group: (-len(group), _reason(group[0])))
    # One of each reason, then a second one of each, and so on.
    turns = collections.deque(sorted(group, key=episode_key)[:EACH] for group in ranked)
    lost: list[EpisodeRow] = []
    while turns and len(lost) < EACH:
        group = turns.popleft()
        lost.append(group[0])
        if group[1:]:
            turns.append(group[1:])
    episodes += [(LOST, row) for row in lost]
    slow = sorted(ended, key=lambda row: (-_seconds(row), episode_key(row)))
    return [*episodes, *((SLOWEST, row) for row in slow[:EACH])]


def _reason(row: EpisodeRow) -> str:
    return (row.failure or "unknown").partition(" at action ")[0]


def _seconds(row: EpisodeRow) -> float:
    return row.planning_seconds + row.simulation_seconds


def _caption(row: EpisodeRow) -> str:
    how = ending_words(row.found_step is not None, row.retrieved, row.failure, row.steps)
    return f"{row.scenario}: {how} ({_seconds(row):.1f} s)"


Draw = Callable[[EpisodeRow, Path], str]


def films(rows: Sequence[EpisodeRow], out: PathLike, draw: Draw | None = None) -> list[Film]:
    """The episodes that a report shows, with the pictures that are there or can be drawn.

    Args:
      rows: of the report.
      out: its folder; pictures are in the folder `FOLDER` in it.
      draw: draws the picture of an episode that is not there into a file, with its page beside it, and says what is to
        be known of it; an `InputError` says why it cannot. If None, nothing is drawn.
    """
    labels = dict(zip(map(id, rows), label_variants(rows), strict=True))
    notes: dict[str, str] = {}
    shown: list[Film] = []
    for why, row in chosen(rows):
        key, file = episode_key(row), Path(out) / FOLDER / f"{episode_key(row)}.png"
        complete = file.is_file() and file.with_suffix(".html").is_file()
        if draw is not None and key not in notes and not complete:
            try:
                notes[key] = draw(row, file)
            except InputError as error:
                notes[key] = f"no picture: {error}"
        drawn = file.is_file()
        note = notes.get(key, "" if drawn else "no picture; report --films draws it")
        caption = f"{_caption(row)}{note and f' ({note})'}"
        shown.append(Film(row, labels[id(row)], why, caption, drawn, file.with_suffix(".html").is_file()))
    return shown


class Frames:
    """A `Watcher` that keeps a frame of every step."""

    def __init__(self, problem: Any, note: Callable[[Any, Any], None]) -> None:
        """Args:
        problem: of the episode.
        note: called after every step with its moment and its frame.
        """
        self.frames: list[Any] = []
        self._problem, self._note = problem, note

    def busy(self, stage: str) -> None:
        """Nothing is said."""

    def decided(self, moment: Any) -> None:
        """Nothing has come of it yet."""

    def acted(self, moment: Any) -> None:
        """Keep the step."""
        from mechsearch_jax.envs.recording import pictures

        self.frames.append(pictures.frame(moment, self._problem))
        self._note(moment, self.frames[-1])


def replay(row: EpisodeRow, scenario: Scenario, file: PathLike) -> str:
    """Run an episode again in the native simulator, draw its filmstrip, and write its page beside that.

    Returns:
      What is to be known of the picture: empty where the episode ended as its row says.

    Raises:
      InputError: its options cannot be used today, the scenario holds something else, or the file cannot be written.
    """
    from mechsearch_jax.benchmarks.running.sequential import run_settings
    from mechsearch_jax.envs.episode.closed_loop import Start
    from mechsearch_jax.envs.episode.episodes import run_episode, target_of
    from mechsearch_jax.envs.episode.method import Method
    from mechsearch_jax.envs.page.page import save_page
    from mechsearch_jax.envs.recording.recording import TRACE_EVERY, Recorder
    from mechsearch_jax.envs.simulators.native import NativeSimulator
    from mechsearch_jax.envs.simulators.simulator import SimulatorConfig
    from mechsearch_jax.viz.drawing import save_figure
    from mechsearch_jax.viz.filmstrip import filmstrip

    if row.content_hash not in (None, scenario.content_hash):
        raise InputError(f"{row.scenario}: its scenario holds something else today; name the file it was run from")
    method = Method.of_options(options_of(row))
    method.check()
    workcell = method.workcell
    target = target_of(scenario, workcell.target)
    problem = workcell.problem(target, method.config.problem)
    simulation = SimulatorConfig(trace_every=TRACE_EVERY)
    simulator = NativeSimulator(config=simulation, shelf=workcell.shelf, camera=workcell.camera)
    recorder = Recorder(simulator, problem)
    watcher = Frames(problem, recorder.note)
    episode = run_episode(
        Start(scenario, row.seed, mismatch=method.mismatch),
        problem,
        method.policy(),
        simulator,
        run_settings(method, target),
        watcher,
    )
    save_figure(filmstrip(watcher.frames, problem.camera, problem.shelf, problem.target, verdict(episode)), file)
    save_page(recorder.recording(problem, verdict(episode), episode), Path(file).with_suffix(".html"))
    again = EpisodeRow.of_episode(episode)
    if all(getattr(row, name) == getattr(again, name) for name in _END):
        return ""
    simulator = options_of(row).get("simulator")
    why = "in another simulator" if simulator != "NativeSimulator" else ""
    why = why or ("by other code" if row.code != present_code() else "on another machine, perhaps")
    return f"run again {why}, it ended otherwise: {_caption(again).partition(': ')[2]}"
