"""`mechsearch train`: train the networks."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import tyro


def _training_of(name: Literal["segmentation", "recognition"], batch: int, rate: float) -> Callable[..., None]:
    """The command that trains one network of perception."""
    default_batch, default_rate = batch, rate

    def command(
        *,
        out: Path,
        seed: int = 0,
        steps: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
        minutes: Annotated[float | None, tyro.conf.arg(metavar="FLOAT")] = None,
        batch: int = default_batch,
        rate: float = default_rate,
        chunk: int = 20,
        held_out: int = 512,
    ) -> None:
        from mechsearch_jax.runtime.files import check_writable
        from mechsearch_jax.train.loop import TrainConfig
        from mechsearch_jax.train.run import TASKS, run

        if steps is None and minutes is None:
            minutes = 10.0
        config = TrainConfig(
            seed=seed,
            steps=steps,
            minutes=minutes,
            batch=batch,
            rate=rate,
            chunk=chunk,
            held_out=held_out,
        )
        check_writable(out)
        run(TASKS[name](), config, out)

    command.__name__ = name
    command.__doc__ = f"""Train the network of {name} on scenes made as they are needed; goes on where it was stopped.

    Args:
      out: folder for the checkpoint, the curves (scalars.jsonl), and in the end {name}.npz and its card {name}.json.
      seed: of the weights and the scenes.
      steps: length in steps; with the same steps, seed and machine the weights are the same.
      minutes: length in minutes instead, without the scoring at the end; 10 if neither is given.
      batch: scenes in a step.
      rate: highest learning rate.
      chunk: steps that the device makes before it reports.
      held_out: scenes for each of the scores at the end.
    """
    return command


def train_push(
    *,
    out: Path,
    data: Path | None = None,
    pushes: Annotated[int, tyro.conf.arg(metavar="N")] = 900_000,
    worlds: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    rounds: int = 8,
    frame: Literal["push", "world"] = "push",
    width: int = 64,
    layers: int = 3,
    seed: int = 0,
    steps: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    minutes: Annotated[float | None, tyro.conf.arg(metavar="FLOAT")] = None,
    batch: int = 1024,
    rate: float = 2e-3,
    decay: float = 0.1,
    chunk: int = 50,
    held_out: int = 20_000,
) -> None:
    """Simulate random pushes and train the push model on them; goes on where it was stopped.

    Args:
      out: folder for the checkpoint, the curves (scalars.jsonl), and in the end push.npz and its card push.json.
      data: folder for the pushes, a kilobyte each; OUT/pushes if left out. What lies there is not simulated again.
      pushes: at least so many are simulated; one in 32 of the scenes is held out.
      worlds: simulated at once; 16,384 on a GPU and 64 on a CPU if left out.
      rounds: pushes that follow each other in a world before all are begun anew.
      frame: "push" sees objects along the push; "world" is the baseline without symmetry.
      width: of what the network knows of an object.
      layers: of messages between objects.
      seed: of the weights, the scenes and the pushes.
      steps: length in steps.
      minutes: length in minutes instead, without simulation and scoring; 5 if neither is given.
      batch: pushes in a step.
      rate: highest learning rate.
      decay: of the weights, times the learning rate, in every step.
      chunk: steps that the device makes before it reports.
      held_out: pushes, at most, for the scores at the end.
    """
    import jax

    from mechsearch_jax.envs.pushing.pushes import Generation
    from mechsearch_jax.networks.push import PushConfig
    from mechsearch_jax.runtime.files import check_writable
    from mechsearch_jax.train.loop import TrainConfig
    from mechsearch_jax.train.push import push_task
    from mechsearch_jax.train.run import counting, run

    if steps is None and minutes is None:
        minutes = 5.0
    config = TrainConfig(
        seed=seed,
        steps=steps,
        minutes=minutes,
        batch=batch,
        rate=rate,
        decay=decay,
        chunk=chunk,
        held_out=held_out,
    )
    network = PushConfig(width=width, layers=layers, frame=frame)
    worlds = (64 if jax.default_backend() == "cpu" else 16_384) if worlds is None else worlds
    generation = Generation(seed, pushes, worlds, rounds)
    check_writable(out)
    folder = data or out / "pushes"
    check_writable(folder)
    with counting("pushes", pushes) as told:
        task = push_task(generation, folder, network, told)
    run(task, config, out)


COMMANDS = {
    "segmentation": _training_of("segmentation", batch=32, rate=1e-3),
    "recognition": _training_of("recognition", batch=64, rate=1e-3),
    "push": train_push,
}
