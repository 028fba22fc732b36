"""Accuracy of push models on simulated pushes in held-out scenes.

Random pushes are simulated in scenes of a seed that training refuses, and every model predicts them. Two baselines
bound the scores: "no motion" predicts no motion, and "nudged" repeats the simulation with the bodies displaced by a
hundredth of a millimetre. No model whose input has larger errors than that can be expected to do better.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np

from mechsearch_jax.actions import Action, ActionKind
from mechsearch_jax.benchmarks.lab.parts.agreement import NUDGE
from mechsearch_jax.benchmarks.parts.bench import named_model, weights_of
from mechsearch_jax.dynamics.push_model import PushModel, PushOutcome
from mechsearch_jax.envs.pushing import pushes as generator
from mechsearch_jax.envs.pushing.pushes import Generation, Pushes, PushesConfig, push_tables, toppled
from mechsearch_jax.envs.simulators.simulator import Simulator
from mechsearch_jax.envs.world.world import superquadrics
from mechsearch_jax.geometry.transforms import translate
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.versions import versions
from mechsearch_jax.train.loop import HELD_OUT_SEED
from mechsearch_jax.train.push import push_scenes, random_pushes
from mechsearch_jax.train.push_scores import outcome_scores, predictions
from mechsearch_jax.train.run import commit

RowName = Literal["no motion", "quasi-static", "learned", "physics", "nudged"]
ROWS: tuple[str, ...] = get_args(RowName)
# The row that is not a model.
NUDGED: RowName = "nudged"


def held_out_generation(pushes: int, worlds: int, seed: int = 0, rounds: int = Generation.rounds) -> Generation:
    """Settings of pushes as in training, except for the number of objects, with a seed that training refuses.

    Args:
      pushes, worlds, rounds: as in `Generation`.
      seed: added to the first such seed.

    Raises:
      InputError: the numbers do not fit.
    """
    for name, value in {"pushes": pushes, "worlds": worlds, "rounds": rounds}.items():
        if value < 1:
            raise InputError(f"lab push: --{name} {value} must be at least 1")
    if not 0 <= seed < 2**31:
        raise InputError(f"lab push: --seed {seed} must be from 0 to {2**31 - 1}")
    return Generation(HELD_OUT_SEED + seed, pushes, worlds, rounds)


@dataclasses.dataclass(frozen=True)
class MeasuredPushes:
    """Results of a comparison.

    Attributes:
      scores: for each row the groups of `train.push.outcome_scores`.
      weights: `weights_of` the learned model; None if it was not measured.
      settings: of the pushes.
      versions: as `versions` returns them.
    """

    scores: dict[str, dict[str, Any]]
    weights: dict[str, Any] | None
    settings: dict[str, Any]
    versions: dict[str, str]

    def value(self) -> dict[str, Any]:
        """All groups of all rows as JSON values, with settings and versions."""
        return {
            "settings": self.settings,
            "commit": commit(),
            "versions": self.versions,
            "weights": self.weights,
            "models": self.scores,
        }


@dataclasses.dataclass(frozen=True, eq=False)
class PushBench:
    """A comparison of push models on simulated pushes.

    Attributes:
      generation: of the pushes; see `held_out_generation`.
      rows: to compare, of `ROWS`.
      weights: of the learned model; the shipped ones if None.
      make_simulator: makes the simulator of the pushes; `envs.pushing.pushes.engine` if None.
    """

    generation: Generation
    rows: Sequence[str] = ROWS
    weights: Path | None = None
    make_simulator: Callable[[], Simulator] | None = None

    def __post_init__(self):
        unknown = next((name for name in self.rows if name not in ROWS), None)
        if not self.rows:
            raise InputError(f"lab push: give at least one of --models {', '.join(ROWS)}")
        if unknown is not None:
            raise InputError(f'lab push: model "{unknown}" is unknown; use {", ".join(ROWS)}')
        if self.weights is not None and "learned" not in self.rows:
            raise InputError('lab push: --weights is for the model "learned"; add it to --models or leave it out')
        # Unusable models raise before anything is simulated.
        _ = self.models

    @functools.cached_property
    def models(self) -> dict[str, PushModel]:
        """The push models: all rows except "nudged"."""
        return {name: named_model(name, self.weights) for name in dict.fromkeys(self.rows) if name != NUDGED}

    @property
    def gpu(self) -> bool:
        """Whether the pushes are simulated on a GPU: if there is one."""
        return jax.default_backend() != "cpu"

    @functools.cached_property
    def simulator(self) -> Simulator:
        """The simulator of the pushes."""
        return (self.make_simulator or functools.partial(generator.engine, self.gpu))()

    def pushes(self, folder: Path, on_progress: Callable[[int], None] = lambda pushes: None) -> Pushes:
        """The pushes; read from a folder if they exist there, else simulated and written to it.

        Args:
          folder: for the pushes.
          on_progress: called with the number of pushes so far.

        Raises:
          InputError: a file in the folder is damaged or was generated otherwise, the folder cannot be written, no push
            was possible, or Warp cannot be imported.
        """
        return random_pushes(self.generation, folder, self.gpu, push_scenes(), on_progress, lambda: self.simulator)

    def run(self, pushes: Pushes, on_progress: Callable[[str, int], None] = lambda row, pushes: None) -> MeasuredPushes:
        """Compare predictions with the simulated outcomes of pushes.

        Args:
          pushes: of `pushes`.
          on_progress: called with the name of a row and its number of completed pushes.
        """
        pusher = push_tables(PushesConfig()).pusher
        scores = {}
        for name in dict.fromkeys(self.rows):
            progress = functools.partial(on_progress, name)
            if name == NUDGED:
                moved = nudged(pushes, self.generation.seed)
                outcome = repeated(moved, self.simulator, self.generation.worlds, progress)
            else:
                outcome = predictions(self.models[name], pushes, pusher, on_progress=progress)
            scores[name] = outcome_scores(outcome, pushes)
        config, scenes = PushesConfig(), push_scenes()
        settings = {
            "pushes": len(pushes.object),
            "generation": dataclasses.asdict(self.generation),
            "simulator": type(self.simulator).__name__ if self.make_simulator else generator.engine_name(self.gpu),
            "objects": scenes.objects,
            "lengths": config.lengths,
            "sideways": config.sideways,
            "nudge": NUDGE,
        }
        learned = self.models.get("learned")
        return MeasuredPushes(scores, None if learned is None else weights_of(learned), settings, versions())


def nudged(pushes: Pushes, seed: int = 0) -> Pushes:
    """The pushes with bodies displaced along x and y by noise of `NUDGE`."""
    before = pushes.before
    shift = np.random.default_rng(seed).normal(0.0, NUDGE, before.position.shape) * [1.0, 1.0, 0.0]
    moved = np.where(before.valid[..., None], before.position + shift, before.position).astype(np.float32)
    return pushes.replace(before=before.replace(position=moved))


def repeated(
    pushes: Pushes, simulator: Simulator, worlds: int, on_progress: Callable[[int], None] = lambda pushes: None
) -> PushOutcome:
    """The simulated outcomes of pushes, each from its recorded start.

    Args:
      pushes: on the host; their recorded outcomes are ignored.
      simulator: simulates them.
      worlds: number of worlds at once.
      on_progress: called with the number of completed pushes.

    Returns:
      Fields with a leading axis for the pushes, on the host. A push that fails moves nothing; its residual is infinite.
    """
    count = len(pushes.object)
    parts = []
    for start in range(0, count, worlds):
        # The last batch is padded with worlds in which nothing is done.
        index = start + np.arange(worlds)
        batch: Pushes = jax.tree.map(lambda a, index=index: jnp.asarray(a[np.minimum(index, count - 1)]), pushes)
        simulator.load(batch.before)
        outcomes = simulator.execute(_actions(batch), jnp.asarray(index < count))
        after = simulator.world
        assert after is not None
        failed = ~outcomes.took_place | (outcomes.overflow != 0)
        over = (toppled(batch.before, after) | outcomes.fallen) & batch.before.valid & ~failed[:, None]
        before, after = superquadrics(batch.before), superquadrics(after)
        scene = before.replace(
            position=jnp.where(failed[:, None, None], before.position, after.position),
            rotation=jnp.where(failed[:, None, None, None], before.rotation, after.rotation),
        )
        outcome = PushOutcome(
            scene=scene,
            moved=batch.before.valid & ~failed[:, None],
            residual=jnp.where(failed, jnp.inf, 0.0),
            resolved=~failed,
            topples=over.astype(jnp.float32),
        )
        parts.append(jax.tree.map(lambda a, index=index: np.asarray(a)[index < count], outcome))
        on_progress(min(start + worlds, count))
    return jax.tree.map(lambda *a: np.concatenate(a), *parts)


def _actions(pushes: Pushes) -> Action:
    return Action(
        kind=jnp.full(len(pushes.object), ActionKind.PUSH, jnp.int32),
        object=pushes.object,
        T_world_gripper=pushes.T_world_gripper,
        displacement=pushes.displacement,
        T_world_place=translate(pushes.T_world_gripper, pushes.displacement),
        q7=pushes.q7,
        opening=jnp.zeros(len(pushes.object)),
    )
