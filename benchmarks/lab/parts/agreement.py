"""Agreement of the batch simulator with the native one on random actions, all executed in one batch.

Agreement is measured for each action (final poses of all bodies) and for the distribution of displacements. Some pushes
are chaotic: an object tips, or is squeezed against a wall. The upper bound is the native simulator's agreement with
itself when the objects are nudged by a hundredth of a millimetre.
"""

from __future__ import annotations

import dataclasses
import importlib.metadata
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mechsearch_jax.actions import SAMPLED_KINDS, Action, all_candidates, kind_of, sample_action
from mechsearch_jax.belief.belief import possible_space
from mechsearch_jax.envs.scenes.generator import ScenarioGenerator
from mechsearch_jax.envs.simulators.mjx_model import MjxConfig
from mechsearch_jax.envs.simulators.mjx_simulator import MjxSimulator
from mechsearch_jax.envs.simulators.native import NativeWorld
from mechsearch_jax.envs.world.outcome import Outcome
from mechsearch_jax.envs.world.world import World, from_scenario, true_superquadrics
from mechsearch_jax.planner import Problem, build_problem, initial_belief
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.versions import versions
from mechsearch_jax.shapes import by_shape
from mechsearch_jax.workspace.scenario import MAX_OBJECTS, Scenario

# Final poses within these tolerances count as equal [m, degrees].
NEAR, ALIGNED = 5e-3, 3.0
# Standard deviation of the nudge, along x and y [m].
NUDGE = 1e-5
KINDS = tuple(sorted(SAMPLED_KINDS, key=lambda kind: kind.code))

Measures = dict[str, int | float]


@dataclasses.dataclass(frozen=True)
class Case:
    """One action in one scene, executed by both simulators.

    Attributes:
      scenario, objects: name of the scene, and number of objects in it.
      kind: name of the kind of action.
      object: index of the action's object.
      native_failure, batch_failure: why it was not executed as commanded, or None.
      native_moved, batch_moved: displacement of the object [m].
      native_steps, batch_steps: simulated time steps.
      position_difference: largest difference of a body's final position [m].
      rotation_difference: largest difference of a body's final rotation [degrees], without the spin of round bodies
        about their axes.
      spin_difference: the same with the spin.
      overflow: flags of `outcome.Overflow`.
      nudged_position_difference, nudged_rotation_difference: between the native simulator and itself with the objects
        nudged, the largest of several nudges.
    """

    scenario: str
    objects: int
    kind: str
    object: int
    native_failure: str | None
    batch_failure: str | None
    native_moved: float
    batch_moved: float
    native_steps: int
    batch_steps: int
    position_difference: float
    rotation_difference: float
    spin_difference: float
    overflow: int
    nudged_position_difference: float
    nudged_rotation_difference: float

    @property
    def agrees(self) -> bool:
        """Whether all final poses are equal within 5 mm and 3 degrees."""
        return self.position_difference <= NEAR and self.rotation_difference <= ALIGNED

    @property
    def native_agrees(self) -> bool:
        """The same for the native simulator and itself, nudged."""
        return self.nudged_position_difference <= NEAR and self.nudged_rotation_difference <= ALIGNED


@dataclasses.dataclass(frozen=True)
class Agreement:
    """Results of all actions.

    Attributes:
      cases: one for each action.
      native_seconds: of all actions in sequence, with compilation [s].
      batch_seconds: of all actions at once, with compilation [s].
      versions: as `versions` returns them, with those of MJX and Warp.
    """

    cases: tuple[Case, ...]
    native_seconds: float
    batch_seconds: float
    versions: dict[str, str]

    def summary(self) -> dict[str, Measures]:
        """By kind of action and for all: shares, quantiles of the differences [m, degrees] and displacements [m]."""
        rows = {kind.name: [c for c in self.cases if c.kind == kind.name] for kind in KINDS}
        return {name: _summary(cases) for name, cases in {**rows, "all": list(self.cases)}.items() if cases}

    def value(self) -> dict[str, Any]:
        """As JSON values, with the summary."""
        return {"summary": self.summary(), **dataclasses.asdict(self)}


def _summary(cases: Sequence[Case]) -> Measures:
    from scipy.stats import ks_2samp

    names = ("position_difference", "rotation_difference", "spin_difference", "nudged_position_difference")
    position, rotation, spin, nudged = (np.array([getattr(c, name) for c in cases]) for name in names)
    native, batch = np.array([c.native_moved for c in cases]), np.array([c.batch_moved for c in cases])
    value: Measures = {
        "actions": len(cases),
        "agreeing": float(np.mean([c.agrees for c in cases])),
        "agreeing_with_spin": float(np.mean((position <= NEAR) & (spin <= ALIGNED))),
        "native_agreeing_with_itself": float(np.mean([c.native_agrees for c in cases])),
        "same_failure": float(np.mean([c.native_failure == c.batch_failure for c in cases])),
        "overflowed": sum(c.overflow != 0 for c in cases),
    }
    for name, sample in (
        ("position_difference", position),
        ("rotation_difference", rotation),
        ("nudged_position_difference", nudged),
        ("native_moved", native),
        ("batch_moved", batch),
    ):
        value |= {f"{name}_median": float(np.median(sample)), f"{name}_p90": float(np.quantile(sample, 0.9))}
    # p-value of the hypothesis that both displacements are of the same distribution.
    with np.errstate(divide="ignore", invalid="ignore"):
        test: Any = ks_2samp(native, batch, method="asymp")
    # The test means nothing for a single action.
    probability = float(test.pvalue) if len(cases) > 1 else 1.0
    return value | {"displacement_ks": float(test.statistic), "displacement_p_value": probability}


def generated_scenes(count: int, seed: int = 0) -> list[Scenario]:
    """Generated scenes with 1 to 8 objects in turn."""
    generator = ScenarioGenerator()
    return [generator.generate(seed + i // MAX_OBJECTS, 1 + i % MAX_OBJECTS) for i in range(count)]


def _sampler(problem: Problem) -> Callable[[Array, World], Action]:
    """A compiled function that draws one valid action for every key, wherever the target may be."""
    belief = initial_belief(problem)
    everything_seen = belief.replace(unmeasured=jnp.full_like(belief.unmeasured, -jnp.inf))
    nowhere = possible_space(problem, everything_seen, jnp.zeros_like(belief.exists))

    def draw(keys: Array, world: World, problem: Problem) -> Action:
        scene = true_superquadrics(world)
        candidates = all_candidates(problem.space, scene, nowhere)

        def draw_single(key: Array) -> Action:
            return sample_action(key, problem.space, scene, nowhere, candidates, scene.valid).action

        return jax.vmap(draw_single)(keys)

    compiled = jax.jit(draw)
    return lambda keys, world: compiled(keys, world, problem)


def draw_actions(
    scenes: Sequence[Scenario], count: int, seed: int = 0, tries: int = 16
) -> list[tuple[Scenario, Action]]:
    """Random valid actions in scenes, with scenes and kinds of action taken in turn.

    Args:
      scenes: the scenes.
      count: number of actions.
      seed: of the random numbers.
      tries: number of actions drawn in a scene, of which the distinct ones are used.

    Raises:
      InputError: the scenes do not have so many actions.
    """
    sample = _sampler(build_problem())
    drawn: list[dict[int, list[Action]]] = []
    for i, scene in enumerate(scenes):
        keys = jax.random.split(jax.random.fold_in(jax.random.key(seed), i), tries)
        actions = jax.device_get(sample(keys, from_scenario(scene)))
        split = [jax.tree.map(lambda leaf, j=j: leaf[j], actions) for j in range(tries)]
        # If little is possible, the same push is drawn repeatedly.
        different = list({b"".join(leaf.tobytes() for leaf in jax.tree.leaves(a)): a for a in split}.values())
        drawn.append({kind.code: [action for action in different if action.kind == kind.code] for kind in KINDS})
    cases: list[tuple[Scenario, Action]] = []
    for round_ in range(len(KINDS) * tries):
        for i, (scene, by_kind) in enumerate(zip(scenes, drawn, strict=True)):
            in_turn = [KINDS[(round_ + i + k) % len(KINDS)].code for k in range(len(KINDS))]
            usable = next((by_kind[code] for code in in_turn if by_kind[code]), [])
            if usable and len(cases) < count:
                cases.append((scene, usable.pop(0)))
    if len(cases) < count:
        raise InputError(f"agreement: {len(scenes)} scenes have only {len(cases)} of {count} actions; take more scenes")
    return cases


def _angle(cosine: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def pose_differences(a: World, b: World) -> tuple[Float[np.ndarray, " worlds"], ...]:
    """The largest differences between the bodies' poses of two states in every world.

    Args:
      a, b: the same bodies; fields with a leading axis for the worlds.

    Returns:
      Distances [m]; angles [degrees], for round bodies between their axes; angles between rotations [degrees].
    """
    a, b = jax.tree.map(np.asarray, (a, b))
    distance = np.linalg.norm(a.position - b.position, axis=-1)
    turn = _angle((np.einsum("wnij,wnij->wn", a.rotation, b.rotation) - 1) / 2)
    tilt = _angle(np.einsum("wni,wni->wn", a.rotation[..., 2], b.rotation[..., 2]))
    valid = a.valid
    angle = np.where(by_shape(a.kind, lambda shape: shape.round, np), tilt, turn)
    return tuple(np.where(valid, value, 0.0).max(axis=1) for value in (distance, angle, turn))


def _displacement(before: World, after: World, objects: np.ndarray) -> np.ndarray:
    moved = np.linalg.norm(np.asarray(after.position) - np.asarray(before.position), axis=-1)
    return moved[np.arange(len(objects)), objects]


def _stack(trees: Sequence[Any]) -> Any:
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *trees)


def _native(simulator: NativeWorld, cases: Sequence[tuple[Scenario, Action]]) -> tuple[list[Outcome], World]:
    """The native simulator's outcomes of actions, and the worlds after them with a leading axis for the actions."""
    outcomes, worlds = [], []
    for scene, action in cases:
        simulator.reset(scene)
        outcomes.append(simulator.execute(action))
        worlds.append(simulator.world)
    return outcomes, _stack(worlds)


def _nudged(scene: Scenario, rng: np.random.Generator) -> Scenario:
    """The scene with its objects displaced by noise of `NUDGE`."""
    objects = []
    for body in scene.objects:
        x, y = rng.normal(body.position[:2], NUDGE).tolist()
        objects.append(dataclasses.replace(body, position=(x, y, body.position[2])))
    return dataclasses.replace(scene, objects=tuple(objects))


def agreement(cases: Sequence[tuple[Scenario, Action]], config: MjxConfig | None = None, nudges: int = 1) -> Agreement:
    """Execute actions with both simulators; the batch simulator executes them all at once.

    Args:
      cases: scenes and actions.
      config: of the batch simulator; the native one uses its `simulator`.
      nudges: number of repetitions of every action by the native simulator with nudged objects. One suffices for the
        mean agreement; to identify chaotic actions takes several.

    Raises:
      InputError: Warp is missing.
    """
    config = config or MjxConfig()
    simulator = MjxSimulator(config=config)
    scenes = [scene for scene, _ in cases]
    actions = jax.tree.map(jnp.asarray, _stack([action for _, action in cases]))
    before = jax.device_get(simulator.reset(scenes))
    start = time.perf_counter()
    outcomes = simulator.execute(actions)
    outcomes, after = jax.device_get((outcomes, simulator.world))
    batch_seconds = time.perf_counter() - start

    native = NativeWorld(config=config.simulator)
    start = time.perf_counter()
    records, expected = _native(native, cases)
    native_seconds = time.perf_counter() - start
    rng = np.random.default_rng(0)
    nudged_distance, nudged_angle = np.zeros((2, len(cases)))
    for _ in range(nudges):
        _, again = _native(native, [(_nudged(scene, rng), action) for scene, action in cases])
        distance, angle, _ = pose_differences(expected, again)
        nudged_distance, nudged_angle = np.maximum(nudged_distance, distance), np.maximum(nudged_angle, angle)
    objects = np.asarray(actions.object)
    distance, angle, spin = pose_differences(expected, after)
    native_moved = _displacement(before, expected, objects)
    batch_moved = _displacement(before, after, objects)
    results = tuple(
        Case(
            scenario=scene.name,
            objects=len(scene.objects),
            kind=kind_of(int(action.kind)).name,
            object=int(action.object),
            native_failure=records[i].reason(),
            batch_failure=outcomes.reason(i),
            native_moved=float(native_moved[i]),
            batch_moved=float(batch_moved[i]),
            native_steps=int(records[i].steps),
            batch_steps=int(outcomes.steps[i]),
            position_difference=float(distance[i]),
            rotation_difference=float(angle[i]),
            spin_difference=float(spin[i]),
            overflow=int(outcomes.overflow[i]),
            nudged_position_difference=float(nudged_distance[i]),
            nudged_rotation_difference=float(nudged_angle[i]),
        )
        for i, (scene, action) in enumerate(cases)
    )
    engines = {name: importlib.metadata.version(name) for name in ("mujoco-mjx", "warp-lang")}
    return Agreement(results, native_seconds, batch_seconds, {**versions(), **engines})
