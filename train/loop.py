"""The training loop of every network: seeded, resumable, and never waiting for data.

One dispatch runs several steps in a scan, each of which makes its own scenes: only a key and the learning rates cross
from the host. Checkpoints are written atomically, so that a kill at any moment leaves the last one whole. Training with
the same settings resumes from it, and reaches the same weights if its length is given in steps.
"""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import serialization
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Key

from mechsearch_jax.networks.weights import Weights, load_weights, shipped_weights
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import replacing

HELD_OUT_SEED = 2**31 - 1
CHECKPOINT = "checkpoint.msgpack"
SCALARS = "scalars.jsonl"
# `TrainConfig.start` of the package's own weights.
SHIPPED = "shipped"

Scalars = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """How a network is trained.

    Attributes:
      seed: of the weights and the scenes; the same seed, settings and machine give the same weights.
      steps: length in steps; exclusive with `minutes`.
      minutes: length in minutes of training, with compilation and without held-out scoring.
      batch: scenes in a step.
      rate: the highest learning rate.
      warm_up: share of the length in which the rate rises; it then falls to zero along a cosine.
      decay: weight decay (AdamW).
      clip: largest norm of a gradient.
      average: saved weights are an exponential average over the last 1 / (1 - average) steps.
      chunk: steps in one dispatch; the last dispatch may exceed the length.
      save_every: seconds between checkpoints.
      held_out: scenes for the scores at the end.
      start: the archive of weights to begin with, or "shipped" for the package's; random weights if None.
    """

    seed: int = 0
    steps: int | None = None
    minutes: float | None = None
    batch: int = 64
    rate: float = 1e-3
    warm_up: float = 0.03
    decay: float = 0.01
    clip: float = 1.0
    average: float = 0.999
    chunk: int = 20
    save_every: float = 45.0
    held_out: int = 512
    start: str | None = None

    def __post_init__(self):
        if (self.steps is None) == (self.minutes is None):
            raise InputError("train: give either --steps or --minutes, not both")
        if not 0 <= self.seed < HELD_OUT_SEED:
            raise InputError(f"train: --seed {self.seed} must be from 0 to {HELD_OUT_SEED - 1}; the next is held out")
        for name in ("batch", "chunk", "held_out"):
            if getattr(self, name) < 1:
                raise InputError(f"train: --{name.replace('_', '-')} {getattr(self, name)} must be at least 1")
        for name in ("rate", "clip", "save_every"):
            if not getattr(self, name) > 0:
                raise InputError(f"train: {name} {getattr(self, name)} must be positive")
        if (self.steps is not None and self.steps < 1) or (self.minutes is not None and not self.minutes > 0):
            raise InputError("train: --steps must be at least 1, --minutes positive")
        if not (0 <= self.warm_up < 1 and 0 <= self.average < 1 and self.decay >= 0):
            raise InputError("train: warm_up and average must be from 0 to below 1, decay at least 0")


class Task(Protocol):
    """A network with its examples, loss and scores."""

    @property
    def name(self) -> str:
        """The network's name."""
        ...

    @property
    def origin(self) -> dict[str, Any]:
        """The source of the examples, for the card of the weights."""
        ...

    def init(self, key: Key[Array, ""]) -> Any:
        """Fresh parameters of the network."""
        ...

    def sample(self, key: Key[Array, ""], batch: int) -> Any:
        """A batch of examples from `batch` random scenes; pure, called under jit."""
        ...

    def loss(self, parameters: Any, examples: Any) -> tuple[Float[Array, ""], Scalars]:
        """The loss, and scalars worth plotting; pure, called under jit."""
        ...

    def scores(self, parameters: Any, scenes: int) -> Scalars:
        """Scores on held-out scenes."""
        ...

    def save(self, path: Path, parameters: Any, card: dict[str, Any]) -> None:
        """Write the network's weights and their card."""
        ...


class TrainState(flax.struct.PyTreeNode):
    """The state from which training resumes.

    Attributes:
      parameters: as trained.
      averaged: their exponential average, which is saved in the end.
      optimiser: its state.
      step: number of steps so far, int32.
    """

    parameters: Any
    averaged: Any
    optimiser: Any
    step: jax.Array


def learning_rate(progress: float, config: TrainConfig) -> float:
    """The rate at a share of the length: a linear warm-up, then a cosine down to zero."""
    if progress < config.warm_up:
        return config.rate * max(progress / config.warm_up, 1e-3)
    share = min((progress - config.warm_up) / (1.0 - config.warm_up), 1.0)
    return config.rate * 0.5 * (1.0 + math.cos(math.pi * share))


def _optimiser(config: TrainConfig) -> optax.GradientTransformation:
    """AdamW without the learning rate; only matrices decay.

    All parameters are one vector here: separate kernel launches for many small parameters would take long.
    """
    return optax.chain(
        optax.flatten(optax.chain(optax.clip_by_global_norm(config.clip), optax.scale_by_adam(b1=0.9, b2=0.99))),
        optax.add_decayed_weights(config.decay, mask=lambda tree: jax.tree.map(lambda a: a.ndim > 1, tree)),
    )


def start_weights(name: str, start: str) -> Weights:
    """The weights that `TrainConfig.start` stands for.

    Args:
      name: of the architecture.
      start: an archive, or "shipped".

    Raises:
      InputError: a file is missing, damaged, or of another network.
    """
    return shipped_weights(name) if start == SHIPPED else load_weights(start, name)


def _first_parameters(task: Task, config: TrainConfig) -> Any:
    """Random parameters, or those of `TrainConfig.start`."""
    parameters = task.init(jax.random.fold_in(jax.random.key(config.seed), 2**32 - 1))
    if config.start is None:
        return parameters
    weights = start_weights(task.name, config.start)
    if jax.tree.map(jnp.shape, weights.parameters) != jax.tree.map(jnp.shape, parameters):
        raise InputError(f"train: --start {config.start} holds a {task.name} network of other sizes; leave it out")
    return jax.tree.map(jnp.asarray, weights.parameters)


def initial_state(task: Task, config: TrainConfig) -> TrainState:
    """The state before the first step.

    Raises:
      InputError: the weights to begin with are missing, damaged, or of another network.
    """
    parameters = _first_parameters(task, config)
    averaged = jax.tree.map(jnp.copy, parameters)
    return TrainState(parameters, averaged, _optimiser(config).init(parameters), jnp.zeros((), jnp.int32))


def make_steps(task: Task, config: TrainConfig) -> Callable[[TrainState, Float[Array, " chunk"]], Any]:
    """A jitted function that makes one step for each learning rate.

    It takes the state, whose memory it reuses, and the rates; it returns the state and the mean of every scalar.
    """
    optimiser = _optimiser(config)

    def step(state: TrainState, rate: jax.Array):
        key = jax.random.fold_in(jax.random.key(config.seed), state.step)
        examples = task.sample(key, config.batch)
        (loss, scalars), gradient = jax.value_and_grad(task.loss, has_aux=True)(state.parameters, examples)
        # Steps with a gradient that is not finite are skipped.
        norm = jnp.linalg.norm(ravel_pytree(gradient)[0])
        sound = jnp.isfinite(norm) & jnp.isfinite(loss)
        gradient = jax.tree.map(lambda g: jnp.where(sound, g, 0.0), gradient)
        updates, moments = optimiser.update(gradient, state.optimiser, state.parameters)
        parameters = jax.tree.map(lambda p, u: p - rate * u, state.parameters, updates)
        # Early on, the average is over the steps so far.
        weight = jnp.minimum(config.average, (1.0 + state.step) / (10.0 + state.step))
        averaged = jax.tree.map(lambda a, p: weight * a + (1.0 - weight) * p, state.averaged, parameters)
        after = TrainState(parameters, averaged, moments, state.step)
        kept = jax.tree.map(lambda new, old: jnp.where(sound, new, old), after, state)
        scalars = scalars | {"loss": loss, "gradient": norm, "skipped": 1.0 - sound}
        return kept.replace(step=state.step + 1), scalars

    def steps(state, rates):
        state, scalars = jax.lax.scan(step, state, rates)
        return state, jax.tree.map(lambda a: jnp.mean(a.astype(jnp.float32)), scalars)

    return jax.jit(steps, donate_argnums=0)


def _identity(task: Task, config: TrainConfig) -> dict[str, Any]:
    """The settings that must be the same for training to resume."""
    settings = dataclasses.asdict(config)
    return {"task": task.name, **{k: v for k, v in settings.items() if k not in ("save_every", "held_out")}}


def save_checkpoint(folder: Path, state: TrainState, identity: dict[str, Any], seconds: float) -> None:
    """Write a checkpoint.

    Raises:
      InputError: it cannot be written.
    """
    content = {
        "settings": json.dumps(identity, sort_keys=True),
        "seconds": seconds,
        "state": serialization.to_state_dict(jax.device_get(state)),
    }
    with replacing(folder / CHECKPOINT) as file:
        file.write(serialization.msgpack_serialize(content))


def load_checkpoint(folder: Path, state: TrainState, identity: dict[str, Any]) -> tuple[TrainState, float] | None:
    """The state of a folder's checkpoint and the seconds of training that it took; None without a checkpoint.

    Args:
      folder: where training writes.
      state: of the same structure.
      identity: the required settings.

    Raises:
      InputError: the checkpoint is damaged, or of other settings.
    """
    path = folder / CHECKPOINT
    if not path.exists():
        return None
    try:
        content: dict[str, Any] = serialization.msgpack_restore(path.read_bytes())  # pyright: ignore[reportAssignmentType]
        settings, seconds = json.loads(content["settings"]), float(content["seconds"])
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); choose another --out") from None
    except Exception:
        raise InputError(f"{path}: is no checkpoint of this program; remove it or choose another --out") from None
    wanted = json.loads(json.dumps(identity))
    different = sorted(k for k in settings.keys() | wanted.keys() if settings.get(k) != wanted.get(k))
    if different:
        raise InputError(f"{path}: is of other settings ({', '.join(different)}); repeat them or choose another --out")
    try:
        restored = serialization.from_state_dict(state, content["state"])
    except (ValueError, KeyError) as error:
        raise InputError(
            f"{path}: does not fit the network ({str(error).splitlines()[0]}); choose another --out"
        ) from None
    return jax.tree.map(jnp.asarray, restored), seconds


class Curves:
    """Scalars in a file of JSON lines, one for each dispatch: `{"step": ..., "seconds": ..., "loss": ..., ...}`."""

    def __init__(self, path: Path, steps: int):
        """Args:
        path: of the file; lines beyond `steps` are dropped, because training repeats these steps.
        steps: number of steps so far.

        Raises:
          InputError: the file cannot be written.
        """
        self._path = path
        kept = [line for line in self._lines() if json.loads(line)["step"] <= steps]
        with replacing(path) as file:
            file.write("".join(line + "\n" for line in kept).encode())

    def _lines(self) -> list[str]:
        lines = self._path.read_text().splitlines() if self._path.exists() else []
        # A kill may have cut the last line short.
        return [line for line in lines if line.startswith("{") and line.endswith("}")]

    def add(self, scalars: dict[str, float | int]) -> None:
        """Append one line."""
        with open(self._path, "a") as file:
            file.write(json.dumps(scalars) + "\n")


class Watcher(Protocol):
    """Reports the progress of training."""

    def __call__(self, progress: float, step: int, seconds: float, scalars: dict[str, float]) -> None:
        """Called after each dispatch with the completed share of the length."""
        ...


def silent(progress: float, step: int, seconds: float, scalars: dict[str, float]) -> None:
    """The `Watcher` that reports nothing."""


def train(task: Task, config: TrainConfig, folder: Path, watcher: Watcher = silent) -> TrainState:
    """Train to the end, from the folder's checkpoint if it holds one.

    Args:
      task: the network to train.
      config: of the training.
      folder: for the checkpoint and the curves.
      watcher: called after each dispatch.

    Raises:
      InputError: the folder holds a checkpoint of other settings, or cannot be written.
    """
    identity = _identity(task, config)
    state = initial_state(task, config)
    state, before = load_checkpoint(folder, state, identity) or (state, 0.0)
    step = int(state.step)
    curves = Curves(folder / SCALARS, step)
    steps = make_steps(task, config)
    start = saved = time.monotonic()
    seconds, pace, chunks = before, 0.0, 0

    def progress(ahead: int) -> float:
        if config.steps is not None:
            return (step + ahead) / config.steps
        return (seconds + pace * ahead) / (60.0 * (config.minutes or 1.0))

    while progress(0) < 1.0:
        rates = np.array([learning_rate(progress(i), config) for i in range(config.chunk)], np.float32)
        if config.steps is not None:
            rates = rates[: config.steps - step]
        began = time.monotonic()
        state, scalars = steps(state, jnp.asarray(rates))
        scalars = {name: float(value) for name, value in jax.device_get(scalars).items()}
        step += len(rates)
        seconds = before + time.monotonic() - start
        # The first dispatch includes compilation: its pace is not representative.
        chunks += 1
        pace = (time.monotonic() - began) / len(rates) if chunks > 1 else 0.0
        curves.add({"step": step, "seconds": round(seconds, 2), "rate": float(rates[-1]), **scalars})
        watcher(min(progress(0), 1.0), step, seconds, scalars)
        if time.monotonic() - saved > config.save_every or progress(0) >= 1.0:
            save_checkpoint(folder, state, identity, seconds)
            saved = time.monotonic()
    return state
