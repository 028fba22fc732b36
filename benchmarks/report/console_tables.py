"""Results on the screen: timings, scene sets, and the progress of many episodes."""

from __future__ import annotations

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from mechsearch_jax.benchmarks.parts.bench import Timing
from mechsearch_jax.benchmarks.running.evaluate import Tally
from mechsearch_jax.benchmarks.store.rows import EpisodeRow
from mechsearch_jax.envs.episode.endings import ending_words
from mechsearch_jax.envs.scenes import scene_sets


def plain_table(title: str | None = None) -> Table:
    """A table without lines, beneath its title."""
    return Table(box=None, pad_edge=False, padding=(0, 1, 0, 0), header_style="bold", title=title, title_justify="left")


def timing_table(timing: Timing) -> Table:
    """One timing, and what it was measured on."""
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_column(style="cyan", justify="right")
    table.add_column()
    fastest, slowest = timing.spread
    table.add_row("subject", timing.subject)
    table.add_row("objects", str(timing.objects))
    for name, size in timing.shapes.items():
        table.add_row(name.replace("_", " "), str(size))
    table.add_row("compile", f"{timing.compile_seconds:.2f} s")
    table.add_row("median", f"{1e3 * timing.median:.1f} ms")
    table.add_row("spread", f"{1e3 * fastest:.1f} to {1e3 * slowest:.1f} ms in {len(timing.seconds)} calls")
    if timing.rate is not None:
        table.add_row("rate", f"{timing.rate:,.0f} {timing.unit}/s")
        table.add_row("for each", f"{1e3 / timing.rate:,.3g} ms")
    table.add_row("device", timing.versions["device"])
    table.add_row("versions", ", ".join(f"{k} {v}" for k, v in timing.versions.items() if k != "device"))
    return table


def scene_sets_table() -> Table:
    """The named sets of scenes, with a digest of what each holds."""
    table = plain_table()
    table.add_column("set", no_wrap=True)
    table.add_column("scenes", justify="right", no_wrap=True)
    for name in ("objects", "target", "digest"):
        table.add_column(name, no_wrap=True)
    table.add_column("what")
    for scene_set in scene_sets.SETS.values():
        objects = ", ".join(str(block.objects) for block in scene_set.blocks)
        first, digest = scene_set.blocks[0], scene_sets.digest(scene_set)
        table.add_row(scene_set.name, str(scene_set.scenes), objects, first.target, digest, scene_set.about)
    return table


class EpisodeProgress:
    """A progress bar over episodes with the time left and the rates so far; one line per episode where no bar fits."""

    def __init__(self, console: Console, total: int):
        self._console = console
        self._waited = False
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[stage]}"),
            console=console,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task("episodes", total=total, stage="")

    def __enter__(self) -> EpisodeProgress:
        self._bar.start()
        return self

    def __exit__(self, *details: object) -> None:
        self._bar.stop()

    def busy(self, stage: str, episodes: int) -> None:
        """Say what a batch is at."""
        self._bar.update(self._task, stage=f"{stage} ({episodes})")

    def compiling(self, text: str) -> None:
        """Say what is being compiled before a batch begins."""
        if not self._console.is_terminal:
            self._console.print(text, soft_wrap=True, markup=False)
        self._bar.update(self._task, stage=text)

    def again(self, text: str) -> None:
        """Say what failed, and that episodes are run again."""
        self._console.print(text, soft_wrap=True, markup=False)

    def waiting(self, episodes: int) -> None:
        """Say that other processes run what is left."""
        if not self._console.is_terminal and not self._waited:
            self._console.print(f"waiting for {episodes} episodes that other processes run", soft_wrap=True)
        self._waited = True
        self._bar.update(self._task, stage=f"other processes run the rest ({episodes})")

    def ended(self, row: EpisodeRow, tally: Tally) -> None:
        """Take note of one more episode, of this process or another, and of what is known of all that are wanted."""
        counts = {"found": tally.found, "graspable": tally.graspable, "retrieved": tally.retrieved}
        rates = "  ".join(f"{name} {count / tally.ended:.2f}" for name, count in counts.items())
        errors = f"  errors {tally.errors}" if tally.errors else ""
        self._bar.update(self._task, completed=tally.ended, total=tally.wanted, description=rates + errors)
        if not self._console.is_terminal:
            how = ending_words(row.found_step is not None, row.retrieved, row.failure, row.steps)
            self._console.print(
                f"{tally.ended}/{tally.wanted} {row.scenario}: {how}  ({rates}{errors})",
                soft_wrap=True,
                markup=False,
            )
