"""How well push models predict what pushes do, on pushes in scenes that no training has seen.

Random pushes are simulated in scenes of a seed that training refuses, and every model is told each of them. Two rows
are there to compare with: "no motion" predicts nothing, and "nudged" is the same simulation once more, from where the
push began but with the bodies a hundredth of a millimetre elsewhere. A model that is told where they are with larger
errors than that can hardly do better, not even by simulating.
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
from mechsearch_jax.benchmarks.parts.agreement import NUDGE
from mechsearch_jax.dynamics.learned import NAME, LearnedPush
from mechsearch_jax.dynamics.push_model import PushModel, PushOutcome
from mechsearch_jax.envs.pushing import pushes as generator
from mechsearch_jax.envs.pushing.push_models import push_models
from mechsearch_jax.envs.pushing.pushes import Generation, Pushes, PushesConfig, push_tables, toppled
from mechsearch_jax.envs.simulators.simulator import Simulator
from mechsearch_jax.envs.world.world import superquadrics
from mechsearch_jax.geometry.transforms import translate
from mechsearch_jax.networks.weights import load_weights
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike, save_json
from mechsearch_jax.runtime.versions import versions
from mechsearch_jax.train.loop import HELD_OUT_SEED
from mechsearch_jax.train.push import no_motion, outcome_scores, predictions, push_scenes, random_pushes
from mechsearch_jax.train.run import commit

RowName = Literal["no motion", "quasi-static", "learned", "physics", "nudged"]
ROWS: tuple[str, ...] = get_args(RowName)
# The row that is no model.
NUDGED: RowName = "nudged"


def named_model(name: str, weights: Path | None = None) -> PushModel:
    """The push model of a name, that which a plan uses for first actions; also the one that predicts nothing.

    Args:
      name: "no motion", "quasi-static", "learned" or "physics".
      weights: of the learned model; the shipped ones if None.

    Raises:
      InputError: there is none of that name, its weights are missing or damaged, or Warp cannot be imported.
    """
    if name == "no motion":
        return no_motion
    if name == "learned" and weights is not None:
        return LearnedPush(weights)
    return push_models(name).first


def weights_of(model: PushModel) -> dict[str, Any] | None:
    """SHA-256 and number of parameters of a learned model's weights; None if it is no learned one."""
    if not isinstance(model, LearnedPush) or model.path is None:
        return None
    parameters = load_weights(model.path, NAME).parameters
    return {"sha256": model.digest, "parameters": sum(a.size for a in jax.tree.leaves(parameters))}


def held_out_generation(pushes: int, worlds: int, seed: int = 0, rounds: int = Generation.rounds) -> Generation:
    """Pushes that are made as for training, but for how many objects there are, of a seed that training refuses.

    Args:
      pushes, worlds, rounds: as in `Generation`.
      seed: which of those seeds.

    Raises:
      InputError: the numbers do not fit.
    """
    for name, value in {"pushes": pushes, "worlds": worlds, "rounds": rounds}.items():
        if value < 1:
            raise InputError(f"bench push: --{name} {value} must be at least 1")
    if not 0 <= seed < 2**31:
        raise InputError(f"bench push: --seed {seed} must be from 0 to {2**31 - 1}")
    return Generation(HELD_OUT_SEED + seed, pushes, worlds, rounds)


@dataclasses.dataclass(frozen=True)
class Measured:
    """What came of it.

    Attributes:
      scores: for each row the groups of `train.push.outcome_scores`.
      weights: as `weights_of` tells of the learned model; None if it was not measured.
      settings: how the pushes were made.
      versions: as `versions` returns them.
    """

    scores: dict[str, dict[str, Any]]
    weights: dict[str, Any] | None
    settings: dict[str, Any]
    versions: dict[str, str]

    @property
    def best(self) -> str:
        """The learned model, or else the one whose pushed objects end nearest to where they should."""
        if "learned" in self.scores:
            return "learned"
        models = [name for name in self.scores if name != NUDGED] or list(self.scores)
        errors = {name: self.scores[name]["all"]["pushed_mm"] for name in models}
        return min(models, key=lambda name: np.inf if errors[name] is None else errors[name])


@dataclasses.dataclass(frozen=True, eq=False)
class Bench:
    """A comparison of push models on simulated pushes.

    Attributes:
      generation: of the pushes; see `held_out_generation`.
      rows: what is compared, of `ROWS`.
      weights: of the learned model; the shipped ones if None.
      make_simulator: simulates the pushes; `envs.pushing.pushes.engine` if left out.
    """

    generation: Generation
    rows: Sequence[str] = ROWS
    weights: Path | None = None
    make_simulator: Callable[[], Simulator] | None = None

    def __post_init__(self):
        unknown = next((name for name in self.rows if name not in ROWS), None)
        if not self.rows:
            raise InputError(f"bench push: give at least one of --models {', '.join(ROWS)}")
        if unknown is not None:
            raise InputError(f'bench push: model "{unknown}" is unknown; use {", ".join(ROWS)}')
        if self.weights is not None and "learned" not in self.rows:
            raise InputError('bench push: --weights is for the model "learned"; add it to --models or leave it out')
        # What cannot be used is to be told of before anything is simulated.
        _ = self.models

    @functools.cached_property
    def models(self) -> dict[str, PushModel]:
        """What predicts: the rows without "nudged"."""
        return {name: named_model(name, self.weights) for name in dict.fromkeys(self.rows) if name != NUDGED}

    @property
    def gpu(self) -> bool:
        """Whether the pushes are simulated on a GPU: where there is one."""
        return jax.default_backend() != "cpu"

    @functools.cached_property
    def simulator(self) -> Simulator:
        """What simulates the pushes."""
        return (self.make_simulator or functools.partial(generator.engine, self.gpu))()

    def pushes(self, folder: Path, told: Callable[[int], None] = lambda pushes: None) -> Pushes:
        """The pushes; those that lie in a folder already are read, the others simulated and put there.

        Args:
          folder: for the pushes.
          told: is told how many there are.

        Raises:
          InputError: what lies in the folder is damaged or was made otherwise, it cannot be written, no push was
            possible, or Warp cannot be imported.
        """
        return random_pushes(self.generation, folder, self.gpu, push_scenes(), told, lambda: self.simulator)

    def run(self, pushes: Pushes, told: Callable[[str, int], None] = lambda row, pushes: None) -> Measured:
        """Compare predictions with what the simulation made of pushes.

        Args:
          pushes: of `pushes`.
          told: is told of each row how many pushes are done.
        """
        pusher = push_tables(PushesConfig()).pusher
        scores = {}
        for name in dict.fromkeys(self.rows):
            seen = functools.partial(told, name)
            if name == NUDGED:
                moved = nudged(pushes, self.generation.seed)
                outcome = repeated(moved, self.simulator, self.generation.worlds, seen)
            else:
                outcome = predictions(self.models[name], pushes, pusher, told=seen)
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
        return Measured(scores, None if learned is None else weights_of(learned), settings, versions())


def nudged(pushes: Pushes, seed: int = 0) -> Pushes:
    """Pushes that begin with the bodies moved along x and y by next to nothing, as in `benchmarks.parts.agreement`."""
    before = pushes.before
    shift = np.random.default_rng(seed).normal(0.0, NUDGE, before.position.shape) * [1.0, 1.0, 0.0]
    moved = np.where(before.valid[..., None], before.position + shift, before.position).astype(np.float32)
    return pushes.replace(before=before.replace(position=moved))


def repeated(
    pushes: Pushes, simulator: Simulator, worlds: int, told: Callable[[int], None] = lambda pushes: None
) -> PushOutcome:
    """What becomes of pushes if each is simulated by itself from where it began.

    Args:
      pushes: on the host; what became of them does not matter.
      simulator: simulates them.
      worlds: so many at once.
      told: is told how many are done.

    Returns:
      Fields with a leading axis for the pushes, on the host. One that fails moves nothing; its residual is infinite.
    """
    count = len(pushes.object)
    parts = []
    for start in range(0, count, worlds):
        # As many worlds in the last batch as in the others, in which nothing is done.
        index = start + np.arange(worlds)
        some: Pushes = jax.tree.map(lambda a, index=index: jnp.asarray(a[np.minimum(index, count - 1)]), pushes)
        simulator.load(some.before)
        outcomes = simulator.execute(_actions(some), jnp.asarray(index < count))
        after = simulator.world
        assert after is not None
        failed = ~outcomes.took_place | (outcomes.overflow != 0)
        over = (toppled(some.before, after) | outcomes.fallen) & some.before.valid & ~failed[:, None]
        before, after = superquadrics(some.before), superquadrics(after)
        scene = before.replace(
            position=jnp.where(failed[:, None, None], before.position, after.position),
            rotation=jnp.where(failed[:, None, None, None], before.rotation, after.rotation),
        )
        outcome = PushOutcome(
            scene=scene,
            moved=some.before.valid & ~failed[:, None],
            residual=jnp.where(failed, jnp.inf, 0.0),
            resolved=~failed,
            topples=over.astype(jnp.float32),
        )
        parts.append(jax.tree.map(lambda a, index=index: np.asarray(a)[index < count], outcome))
        told(min(start + worlds, count))
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


def save_push_scores(measured: Measured, path: PathLike) -> None:
    """Write all groups of all rows as JSON, with how they came about.

    Raises:
      InputError: the file cannot be written.
    """
    value = {
        "settings": measured.settings,
        "commit": commit(),
        "versions": measured.versions,
        "weights": measured.weights,
        "models": measured.scores,
    }
    save_json(value, path)
