"""`mechsearch bench`: how long the parts take."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from mechsearch_jax.commands.options import (
    DEFAULTS,
    USUAL_POLICY,
    DecidedBy,
    EpisodeOptions,
    JsonFile,
    PushModel,
    WeightsFile,
    at_least_one,
    check_files,
    forget_kept_compilations,
)
from mechsearch_jax.runtime.errors import InputError

if TYPE_CHECKING:
    from mechsearch_jax.benchmarks.parts.bench import Timing


def _print_timing(subject: str, out: Path | None, measure: Callable[[], Timing]) -> None:
    """Measure, print and write a timing.

    Raises:
      InputError: the file cannot be written, or what `measure` raises.
    """
    from rich.console import Console

    from mechsearch_jax.benchmarks.report.console_tables import timing_table
    from mechsearch_jax.runtime.files import save_json

    check_files(out)
    forget_kept_compilations()
    console = Console(highlight=False)
    with console.status(f"timing {subject}"):
        timing = measure()
    console.print(timing_table(timing))
    if out is not None:
        save_json(timing.value(), out)


def _timing_of(subject: Literal["existence", "graspability"], what: str) -> Callable[..., None]:
    """The command that times a part of the planner that no policy matters to."""

    def command(
        *,
        objects: int = 8,
        batch: int = 1,
        repeats: int = 10,
        out: JsonFile = None,
        options: EpisodeOptions = DEFAULTS,
    ) -> None:
        from mechsearch_jax.benchmarks.parts import bench as benches

        at_least_one(f"bench {subject}", repeats=repeats, batch=batch)
        options.without_mismatch(f"bench {subject}")
        settings = options.settings()
        _print_timing(subject, out, lambda: benches.bench_part(subject, objects, settings, batch, repeats=repeats))

    command.__name__ = subject
    command.__doc__ = f"""Time {what}: compilation, median and spread.

    Args:
      objects: number of objects in a scene.
      batch: how many scenes at once.
      repeats: number of timed calls.
      out: JSON file for the result.
      options: how the planner decides.
    """
    return command


def bench_plan(
    *,
    decides: DecidedBy = USUAL_POLICY,
    objects: int = 8,
    batch: int = 1,
    repeats: int = 10,
    out: JsonFile = None,
    options: EpisodeOptions = DEFAULTS,
) -> None:
    """Time a whole decision: compilation, median and spread.

    Args:
      decides: the policy.
      objects: number of objects in a scene.
      batch: how many scenes at once.
      repeats: number of timed calls.
      out: JSON file for the result.
      options: how the planner decides.
    """
    from mechsearch_jax.benchmarks.parts import bench as benches

    at_least_one("bench plan", repeats=repeats, batch=batch)
    options.without_mismatch("bench plan")
    (chosen,) = options.methods(decides.chosen("bench plan"))
    sizes = options.settings().objects
    _print_timing("plan", out, lambda: benches.bench_plan(objects, chosen, batch, repeats=repeats, sizes=sizes))


def bench_perceive(
    *,
    objects: int = 8,
    batch: int = 1,
    repeats: int = 10,
    recognition: Literal["masks", "full"] = "full",
    out: JsonFile = None,
) -> None:
    """Time recognising all objects of a scene from its noisy depth image: compilation, median and spread.

    Args:
      objects: number of objects in a scene.
      batch: how many scenes at once.
      repeats: number of timed calls.
      recognition: "masks" is told which pixels are whose, "full" finds out.
      out: JSON file for the result.
    """
    from mechsearch_jax.benchmarks.parts import bench as benches

    at_least_one("bench perceive", repeats=repeats, batch=batch)
    _print_timing("perceive", out, lambda: benches.bench_perceive(recognition, objects, batch, repeats=repeats))


def bench_predict(
    *,
    push_model: PushModel = "learned",
    weights: WeightsFile = None,
    objects: int = 8,
    batch: int = 30,
    repeats: int = 20,
    out: JsonFile = None,
) -> None:
    """Time predicting random pushes, all at once, each in a scene of its own: compilation, median and spread.

    Args:
      push_model: what predicts them; "physics" simulates every one.
      weights: of the learned model; those that ship if not given.
      objects: number of objects in a scene.
      batch: pushes predicted at once; each step of a decision predicts 30.
      repeats: number of timed calls.
      out: JSON file for the result.
    """
    from mechsearch_jax.benchmarks.parts import bench as benches

    at_least_one("bench predict", repeats=repeats, batch=batch)
    if weights is not None and push_model != "learned":
        raise InputError(f"bench predict: --weights is for --push-model learned, not for {push_model}")
    _print_timing("predict", out, lambda: benches.bench_predict(push_model, objects, batch, repeats, weights))


def bench_simulate(*, worlds: int = 1024, steps: int = 500, repeats: int = 5, out: JsonFile = None) -> None:
    """Time the batch simulator with 8 objects, the arm sweeping through them: steps per second of all worlds together.

    Args:
      worlds: simulated at once.
      steps: time steps in a timed call.
      repeats: number of timed calls.
      out: JSON file for the result.
    """
    from mechsearch_jax.benchmarks.parts.simulation import bench_simulate as timed

    _print_timing("simulate", out, lambda: timed(worlds, steps, repeats))


def bench_report(*, rows: int = 100_000, out: JsonFile = None) -> None:
    """Time reports of rows that are drawn at random, as a sweep of 96 variants would leave them: time and memory.

    Args:
      rows: how many.
      out: JSON file for the result.
    """
    from rich.console import Console

    from mechsearch_jax.benchmarks.report import report_bench
    from mechsearch_jax.runtime.files import save_json

    at_least_one("bench report", rows=rows)
    check_files(out)
    console = Console(highlight=False)
    with console.status("drawing rows") as status:
        value = report_bench.bench_report(rows, status.update)
    console.print(report_bench.timings_table(value))
    if out is not None:
        save_json(value, out)


COMMANDS = {
    "existence": _timing_of("existence", "f"),
    "graspability": _timing_of("graspability", "g where f = 1"),
    "plan": bench_plan,
    "predict": bench_predict,
    "perceive": bench_perceive,
    "simulate": bench_simulate,
    "report": bench_report,
}
