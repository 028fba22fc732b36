"""A whole training as the command line runs it: train with a progress line, score on held-out scenes, write weights."""

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
from mechsearch_jax.train.loop import Task, TrainConfig, train
from mechsearch_jax.train.recognition import RecognitionTask
from mechsearch_jax.train.segmentation import SegmentationTask

TASKS: dict[str, Callable[[], Task]] = {"segmentation": SegmentationTask, "recognition": RecognitionTask}
# Groups of scores that are printed.
SHOWN = 8
# Seconds between lines where the output is no terminal.
_QUIET = 20.0


class ProgressLine:
    """A `Watcher` that shows rate, time left and the loss: as a bar in a terminal, elsewhere as a line now and then."""

    def __init__(self, console: Console, name: str):
        self._console = console
        self._bar = Progress(
            TextColumn(name),
            BarColumn(),
            TextColumn("{task.percentage:3.0f}%  {task.fields[said]}"),
            TimeRemainingColumn(),
            console=console,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task(name, total=1.0, said="compiling")
        self._first: tuple[int, float] | None = None
        self._said = -_QUIET

    def __enter__(self) -> ProgressLine:
        self._bar.start()
        return self

    def __exit__(self, *_: Any) -> None:
        self._bar.stop()

    def __call__(self, progress: float, step: int, seconds: float, scalars: dict[str, float]) -> None:
        # The first dispatch compiles and is left out of the rate.
        self._first = self._first or (step, seconds)
        steps, passed = step - self._first[0], seconds - self._first[1]
        rate = f"{steps / passed:.1f} steps/s" if passed > 0 else "compiled"
        said = f"step {step}, {rate}, loss {scalars['loss']:.4f}"
        self._bar.update(self._task, completed=progress, said=said)
        if not self._console.is_terminal and (time.monotonic() - self._said > _QUIET or progress >= 1.0):
            left = seconds * (1.0 - progress) / max(progress, 1e-6)
            self._console.print(f"{100 * progress:.0f}%, {said}, {left:.0f} s left")
            self._said = time.monotonic()


@contextlib.contextmanager
def counting(what: str, wanted: int) -> Iterator[Callable[[int], None]]:
    """Shows how many of something there are, and the time left, to whoever calls what this gives with the number."""
    console = Console(highlight=False)
    start = said = time.monotonic()
    first: int | None = None
    bar = Progress(
        TextColumn(what),
        BarColumn(),
        TextColumn("{task.completed} of {task.total}"),
        TimeRemainingColumn(),
        console=console,
        disable=not console.is_terminal,
    )

    def told(count: int) -> None:
        nonlocal said, start, first
        bar.update(task, completed=count)
        now = time.monotonic()
        if first is None:
            # Until then programs were compiled, or files read.
            first, start = count, now
        elif not console.is_terminal and (now - said > _QUIET or count >= wanted):
            left = (now - start) / max(count - first, 1) * max(wanted - count, 0)
            console.print(f"{count} of {wanted} {what}, {left:.0f} s left")
            said = now

    with bar:
        task = bar.add_task(what, total=wanted)
        yield told


def commit() -> str | None:
    """The commit that this code is at, None where it is in no checkout."""
    here = Path(__file__).resolve().parent
    try:
        found = subprocess.run(["git", "rev-parse", "HEAD"], cwd=here, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return found.stdout.strip()


def run(task: Task, config: TrainConfig, out: Path) -> dict[str, Any]:
    """Train a network, score it on held-out scenes, and write its weights and card.

    Args:
      task: what is trained.
      config: how.
      out: folder for everything.

    Returns:
      The card.

    Raises:
      InputError: the folder holds another training, or cannot be written.
    """
    keep_compilations()
    # Random numbers by calls of one kernel, the same numbers: on a GPU, what makes scenes compiles three times as fast.
    jax.config.update("jax_threefry_gpu_kernel_lowering", True)
    console = Console(highlight=False)
    name = task.name
    with ProgressLine(console, name) as progress:
        state = train(task, config, out, progress)
    parameters = jax.device_get(state.averaged)
    card = {
        "data": task.origin,
        "training": dataclasses.asdict(config),
        "steps": int(state.step),
        "seed": config.seed,
        "commit": commit(),
        "command": " ".join(["mechsearch", *sys.argv[1:]]),
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
        "scores": None,
    }
    # The weights are on disk before they are scored: scoring takes a while.
    task.save(out / f"{name}.npz", parameters, card)
    with console.status("scoring on held-out scenes"):
        card = card | {"scores": task.scores(parameters, config.held_out)}
    task.save(out / f"{name}.npz", parameters, card)
    for what, scores in card["scores"].items():
        # Where there are many groups, the card has them.
        shown = scores if len(scores) <= SHOWN else {"all": scores["all"]}
        console.print(f"{what}: {shown}", soft_wrap=True)
    console.print(str(out / f"{name}.npz"), soft_wrap=True)
    return card
