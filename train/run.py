"""A training run of the command line: train with a progress line, score on held-out scenes, write weights."""

from __future__ import annotations

import contextlib
import dataclasses
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from mechsearch_jax.problem.cache import keep_compilations
from mechsearch_jax.train.loop import Task, TrainConfig, start_weights, train
from mechsearch_jax.train.recognition import RecognitionTask
from mechsearch_jax.train.segmentation import SegmentationTask

TASKS: dict[str, Callable[..., Task]] = {"segmentation": SegmentationTask, "recognition": RecognitionTask}
# Largest number of printed groups of scores.
SHOWN = 8
# Seconds between lines if the output is no terminal.
_QUIET = 20.0


class ProgressLine:
    """A `Watcher` that shows rate, time left and loss: a bar in a terminal, elsewhere a line every `_QUIET` seconds."""

    def __init__(self, console: Console, name: str):
        self._console = console
        self._bar = Progress(
            TextColumn(name),
            BarColumn(),
            TextColumn("{task.percentage:3.0f}%  {task.fields[status]}"),
            TimeRemainingColumn(),
            console=console,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task(name, total=1.0, status="compiling")
        self._first: tuple[int, float] | None = None
        self._printed = -_QUIET

    def __enter__(self) -> ProgressLine:
        self._bar.start()
        return self

    def __exit__(self, *_: Any) -> None:
        self._bar.stop()

    def __call__(self, progress: float, step: int, seconds: float, scalars: dict[str, float]) -> None:
        # The first dispatch includes compilation and is left out of the rate.
        self._first = self._first or (step, seconds)
        steps, passed = step - self._first[0], seconds - self._first[1]
        rate = f"{steps / passed:.1f} steps/s" if passed > 0 else "compiled"
        status = f"step {step}, {rate}, loss {scalars['loss']:.4f}"
        self._bar.update(self._task, completed=progress, status=status)
        if not self._console.is_terminal and (time.monotonic() - self._printed > _QUIET or progress >= 1.0):
            left = seconds * (1.0 - progress) / max(progress, 1e-6)
            self._console.print(f"{100 * progress:.0f}%, {status}, {left:.0f} s left")
            self._printed = time.monotonic()


@contextlib.contextmanager
def counting(noun: str, wanted: int) -> Iterator[Callable[[int], None]]:
    """A progress display of a count with the time left; yields the function that sets the count.

    Args:
      noun: the plural of what is counted.
      wanted: the final count.
    """
    console = Console(highlight=False)
    start = printed = time.monotonic()
    first: int | None = None
    bar = Progress(
        TextColumn(noun),
        BarColumn(),
        TextColumn("{task.completed} of {task.total}"),
        TimeRemainingColumn(),
        console=console,
        disable=not console.is_terminal,
    )

    def on_progress(count: int) -> None:
        nonlocal printed, start, first
        bar.update(task, completed=count)
        now = time.monotonic()
        if first is None:
            # The time before was spent compiling programs, or reading files.
            first, start = count, now
        elif not console.is_terminal and (now - printed > _QUIET or count >= wanted):
            left = (now - start) / max(count - first, 1) * max(wanted - count, 0)
            console.print(f"{count} of {wanted} {noun}, {left:.0f} s left")
            printed = now

    with bar:
        task = bar.add_task(noun, total=wanted)
        yield on_progress


def commit() -> str | None:
    """The commit of this code; None outside a checkout."""
    folder = Path(__file__).resolve().parent
    try:
        done = subprocess.run(["git", "rev-parse", "HEAD"], cwd=folder, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()


def _origin_of(name: str, start: str | None) -> dict[str, Any] | None:
    """What the card says of the weights that training began with; None if they were random."""
    if start is None:
        return None
    card = start_weights(name, start).card
    return {key: card.get(key) for key in ("sha256", "command", "commit", "steps", "training", "started_from")}


def run(task: Task, config: TrainConfig, out: Path) -> dict[str, Any]:
    """Train a network, score it on held-out scenes, and write its weights and card.

    Args:
      task: the network to train.
      config: of the training.
      out: folder for everything.

    Returns:
      The card.

    Raises:
      InputError: the folder holds another training, or cannot be written.
    """
    keep_compilations()
    # Read before anything long begins, and before `out` may replace it.
    started_from = _origin_of(task.name, config.start)
    # Draws the same random numbers by calls of one kernel: on a GPU, generating scenes compiles three times as fast.
    jax.config.update("jax_threefry_gpu_kernel_lowering", True)
    console = Console(highlight=False)
    name = task.name
    with ProgressLine(console, name) as progress:
        state = train(task, config, out, progress)
    parameters = jax.device_get(state.averaged)
    card = {
        "data": task.origin,
        "training": dataclasses.asdict(config),
        "started_from": started_from,
        "steps": int(state.step),
        "seed": config.seed,
        "commit": commit(),
        "command": " ".join(["mechsearch", *sys.argv[1:]]),
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
        "scores": None,
    }
    # Saved before scoring, which takes a while.
    task.save(out / f"{name}.npz", parameters, card)
    with console.status("scoring on held-out scenes"):
        card = card | {"scores": task.scores(parameters, config.held_out)}
    task.save(out / f"{name}.npz", parameters, card)
    for group, scores in card["scores"].items():
        # If there are many, only the card has them all.
        shown = scores if len(scores) <= SHOWN else {"all": scores["all"]}
        console.print(f"{group}: {shown}", soft_wrap=True)
    console.print(str(out / f"{name}.npz"), soft_wrap=True, markup=False)
    return card
