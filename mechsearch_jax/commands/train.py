"""`mechsearch train`: train the networks."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from mechsearch_jax.train.loop import TrainConfig


Number = Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")]


@dataclasses.dataclass(frozen=True)
class Training:
    """How a network is trained.

    Attributes:
      seed: of the weights and of what they are trained on.
      steps: length in steps; with the same steps, seed and machine the weights are the same.
      minutes: length in minutes instead, without the scoring at the end; 10, or for pushes 5, if neither is given.
      batch: examples in a step: scenes, or pushes.
      rate: highest learning rate.
      chunk: steps that the device makes before it reports.
      held_out: examples, at most, for each of the scores at the end.
      start: archive of the weights to begin with, or "shipped" for those of the package; random ones if left out.
    """

    seed: int = 0
    steps: Number = None
    minutes: Annotated[float | None, tyro.conf.arg(metavar="FLOAT", help_behavior_hint="")] = None
    batch: int = 32
    rate: float = 1e-3
    chunk: int = 20
    held_out: int = 512
    start: Annotated[str | None, tyro.conf.arg(metavar="FILE|shipped", help_behavior_hint="")] = None

    def config(self, minutes: float) -> TrainConfig:
        """What the training loop takes.

        Args:
          minutes: the length where none is given.

        Raises:
          InputError: a setting is impossible.
        """
        from mechsearch_jax.train.loop import TrainConfig

        settings = dataclasses.asdict(self)
        if self.steps is None and self.minutes is None:
            settings["minutes"] = minutes
        return TrainConfig(**settings)


def _training_of(name: Literal["segmentation", "recognition"], usual: Training) -> Callable[..., None]:
    """The command that trains one network of perception."""

    def command(
        *,
        out: Path,
        scenes: Literal["usual", "real"] = "usual",
        touching: float = 0.2,
        training: Annotated[Training, tyro.conf.arg(name="")] = usual,
    ) -> None:
        from mechsearch_jax.runtime.files import check_writable
        from mechsearch_jax.train.run import TASKS, run
        from mechsearch_jax.train.scenes import SceneConfig

        config = training.config(minutes=10.0)
        drawn = SceneConfig(touching=touching) if scenes == "usual" else SceneConfig.real(touching)
        check_writable(out)
        run(TASKS[name](scenes=drawn), config, out)

    command.__name__ = name
    command.__doc__ = f"""Train the network of {name} on scenes made as they are needed; goes on where it was stopped.

    Args:
      out: folder for the checkpoint, the curves (scalars.jsonl), and in the end {name}.npz and its card {name}.json.
      scenes: "usual" are on the default shelf before its camera; of "real" ones half are of tables and other shelves,
        with stacks, open vessels and the sensors of `--sensor`.
      touching: share of objects that are pushed against another.
      training: how it is trained.
    """
    return command


@dataclasses.dataclass(frozen=True)
class PushTraining(Training):
    """How the push model is trained.

    Attributes:
      decay: of the weights, times the learning rate, in every step.
    """

    batch: int = 1024
    rate: float = 2e-3
    chunk: int = 50
    held_out: int = 20_000
    decay: float = 0.1


@dataclasses.dataclass(frozen=True)
class PushNetwork:
    """What the push model looks like.

    Attributes:
      frame: "push" sees objects along the push; "world" is the baseline without symmetry.
      width: of what the network knows of an object.
      layers: of messages between objects.
    """

    frame: Literal["push", "world"] = "push"
    width: int = 64
    layers: int = 3


def train_push(
    *,
    out: Path,
    data: Path | None = None,
    pushes: Annotated[int, tyro.conf.arg(metavar="N")] = 900_000,
    worlds: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    rounds: int = 8,
    network: Annotated[PushNetwork, tyro.conf.arg(name="")] = PushNetwork(),
    training: Annotated[PushTraining, tyro.conf.arg(name="")] = PushTraining(),
) -> None:
    """Simulate random pushes and train the push model on them; goes on where it was stopped.

    Args:
      out: folder for the checkpoint, the curves (scalars.jsonl), and in the end push.npz and its card push.json.
      data: folder for the pushes, a kilobyte each; OUT/pushes if left out. What lies there is not simulated again.
      pushes: at least so many are simulated; one in 32 of the scenes is held out.
      worlds: simulated at once; 16,384 on a GPU and 64 on a CPU if left out.
      rounds: pushes that follow each other in a world before all are begun anew.
      network: what the network looks like.
      training: how it is trained.
    """
    import jax

    from mechsearch_jax.envs.pushing.pushes import Generation
    from mechsearch_jax.networks.push import PushConfig
    from mechsearch_jax.runtime.files import check_writable
    from mechsearch_jax.train.push import push_task
    from mechsearch_jax.train.run import counting, run

    config = training.config(minutes=5.0)
    worlds = (64 if jax.default_backend() == "cpu" else 16_384) if worlds is None else worlds
    generation = Generation(training.seed, pushes, worlds, rounds)
    check_writable(out)
    folder = data or out / "pushes"
    check_writable(folder)
    with counting("pushes", pushes) as on_progress:
        task = push_task(generation, folder, PushConfig(**dataclasses.asdict(network)), on_progress)
    run(task, config, out)


COMMANDS = {
    "segmentation": _training_of("segmentation", Training()),
    "recognition": _training_of("recognition", Training(batch=64)),
    "push": train_push,
}
