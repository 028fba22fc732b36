"""Prints an episode step by step: what the robot sees, what it chose and why, and how long each stage took."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.status import Status

from mechsearch_jax.actions import ActionKind, kind_of
from mechsearch_jax.envs.episode.endings import events, in_words, verdict
from mechsearch_jax.envs.episode.moments import Moment
from mechsearch_jax.envs.episode.records import Episode
from mechsearch_jax.envs.recording import pictures
from mechsearch_jax.planner import Problem
from mechsearch_jax.viz.filmstrip import Frame

STAGES = {
    "recognise": "looking, and working out where the target can be",
    "plan": "planning",
    "judge": "judging whether the target can be grasped",
    "simulate": "acting",
}
NOTHING = "no action is possible"


class Narrator:
    """A `Watcher` that prints a few lines for every step and keeps a frame of it for the filmstrip.

    Attributes:
      frames: of the steps so far.
    """

    def __init__(
        self,
        console: Console,
        status: Status,
        problem: Problem,
        on_frame: Callable[[Moment, Frame], None] = lambda moment, frame: None,
    ):
        """Args:
        console, status: where to print.
        problem: of the episode.
        on_frame: called after every step with its frame.
        """
        self._on_frame = on_frame
        self.frames: list[Frame] = []
        self._restarts = 0
        self._console = console
        self._status = status
        self._problem = problem

    def busy(self, stage: str) -> None:
        patience = " (compiling first, once)" if stage == "plan" and not self.frames else ""
        self._status.update(f"{STAGES[stage]}{patience}")

    def decided(self, moment: Moment) -> None:
        record = moment.record
        self._sees(moment)
        if moment.decision is None:
            return
        kind, refused = kind_of(int(moment.decision.action.kind)), int(moment.decision.refused)
        self._line("does", kind.describe(moment.decision.action, moment.observation.objects.capacity))
        if kind.takes_target:
            self._line("why", "a grasp that takes it out is known")
        elif kind.code == ActionKind.NONE:
            self._line("why", f"each of the {refused} best does harm as it is tried out" if refused else NOTHING)
        elif record.sequences and record.predicted_cost is not None:
            length = int(moment.decision.sequences.length[0])
            why = (
                f"cost {record.cost:.0f} now, {record.predicted_cost:.0f} expected after it; the best of "
                f"{record.sequences} sequences, {length} action{'s' if length > 1 else ''} long"
            )
            if not record.compares_costs:
                why = f"one of {record.sequences} that are possible; the policy compares no costs"
            self._line("why", why + (f", after {refused} that do harm as they are tried out" if refused else ""))

    def acted(self, moment: Moment) -> None:
        record = moment.record
        if record.action is None:
            self._sees(moment)
        if record.failure:
            self._line("failed", in_words(record.failure), "red")
        for event in events(record):
            self._line("but", event, "red")
        stages = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in record.timings.items())
        self._line("time", stages, "dim")
        self._status.update("drawing")
        self.frames.append(pictures.frame(moment, self._problem))
        self._on_frame(moment, self.frames[-1])

    def ended(self, episode: Episode) -> None:
        """Print how it ended."""
        self._console.print(f"\n[bold]{escape(verdict(episode))}[/bold]", soft_wrap=True)

    def _sees(self, moment: Moment) -> None:
        shown = np.unique(np.asarray(moment.snapshot.image.segmentation))
        objects = np.flatnonzero(np.asarray(moment.observation.objects.valid))
        seen = int(np.isin(objects, shown).sum())
        if moment.record.found:
            x, y, _ = np.asarray(moment.belief.found_pose)
            target = f"the target at x {x:.3f}, y {y:.3f} m"
        elif bool(moment.belief.found):
            x, y, _ = np.asarray(moment.belief.found_pose)
            target = f"something else at x {x:.3f}, y {y:.3f} m that it takes for the target"
        else:
            target = f"no target; it can be at {moment.record.belief_size} of {len(moment.belief.exists)} poses"
            if (moment.record.restarts or 0) > self._restarts:
                target += ", after there were none left"
            if moment.record.truth_possible is False:
                target += ", and none of them is where it is"
        self._restarts = moment.record.restarts or 0
        self._console.print(f"\n[bold]step {moment.index + 1}[/bold]")
        self._line("sees", f"{seen} of {len(objects)} objects, {target}")

    def _line(self, label: str, text: str, style: str = "") -> None:
        self._console.print(f"  [cyan]{label:>6}[/cyan]  [{style or 'default'}]{escape(text)}[/]", soft_wrap=True)
