"""Times perception, f, g, predicted pushes, decisions and simulation on generated scenes.

Compilation is timed separately from the steady state.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from mechsearch_jax import planner
from mechsearch_jax.actions import Action, no_action
from mechsearch_jax.dynamics.learned import NAME, LearnedPush
from mechsearch_jax.dynamics.named import PushModelName
from mechsearch_jax.dynamics.push_model import PushModel, PushOutcome
from mechsearch_jax.envs.camera.recognisers import RecognitionName, recogniser
from mechsearch_jax.envs.camera.snapshot import Snapshot, objects_on_the_board
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.envs.pushing.push_models import push_models
from mechsearch_jax.envs.pushing.pushes import PushesConfig, draw_push, push_tables
from mechsearch_jax.envs.scenes.generator import ScenarioGenerator, draws_from
from mechsearch_jax.envs.world.world import TARGET, World, from_scenario, true_superquadrics
from mechsearch_jax.existence import existence, object_views
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.grasping.graspability import grasp_hits, graspability, pairs
from mechsearch_jax.networks.weights import load_weights
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner import Belief, Config, Decision, Problem, step
from mechsearch_jax.planner import trials as trying
from mechsearch_jax.planner.step import SearchState
from mechsearch_jax.planner.trials import Trials
from mechsearch_jax.problem.settings import Settings
from mechsearch_jax.problem.workcell import Workcell
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.versions import versions
from mechsearch_jax.train.push import push_scenes
from mechsearch_jax.train.push_scores import no_motion
from mechsearch_jax.train.scenes import random_world
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.object_sizes import ObjectSizes
from mechsearch_jax.workspace.scenario import MAX_OBJECTS
from mechsearch_jax.workspace.shelf import Shelf

# Units that a call counts; the number is in `Timing.shapes`.
COUNTED = ("recognitions", "predictions")


@dataclasses.dataclass(frozen=True)
class Timing:
    """The timing of one function.

    Attributes:
      subject: "existence", "graspability", "plan", "perceive: ..." and "predict: ..." with what does it, or "simulate".
      objects: number of objects in the scenes.
      shapes: sizes that the time depends on; for "simulate" also the numbers of overflowed and diverged worlds.
      compile_seconds: of tracing and compiling [s]; meaningful only if compilations are not kept on disk.
      seconds: of every call afterwards, including the wait for results [s].
      versions: as `versions` returns them; for "plan" also the "push model", for "predict: learned" also
        "weights", their SHA-256.
    """

    subject: str
    objects: int
    shapes: dict[str, int]
    compile_seconds: float
    seconds: tuple[float, ...]
    versions: dict[str, str]

    @property
    def median(self) -> float:
        return statistics.median(self.seconds)

    @property
    def spread(self) -> tuple[float, float]:
        """The fastest and the slowest call [s]."""
        return min(self.seconds), max(self.seconds)

    @property
    def unit(self) -> str | None:
        """The unit that a call counts: "steps" (of all worlds together), or one of `COUNTED`; None without a unit."""
        return "steps" if self.subject == "simulate" else next((unit for unit in COUNTED if unit in self.shapes), None)

    @property
    def rate(self) -> float | None:
        """Units per second; None without a unit."""
        if self.unit is None:
            return None
        return self.shapes[self.unit] * self.shapes.get("worlds", 1) / self.median

    def value(self) -> dict[str, Any]:
        """The timing as JSON values: the fields, the median and the rate."""
        value = {**dataclasses.asdict(self), "median_seconds": self.median}
        return value if self.rate is None else {**value, f"{self.unit}_per_second": self.rate}


def measure(function: Callable[..., Any], calls: Sequence[tuple[Any, ...]], repeats: int) -> tuple[float, list[float]]:
    """The time to compile a function for its arguments, and of every call after that [s].

    Args:
      function: to be compiled.
      calls: arguments of the same shapes, taken in turn.
      repeats: number of timed calls.
    """
    start = time.perf_counter()
    compiled = jax.jit(function).lower(*calls[0]).compile()
    compile_seconds = time.perf_counter() - start
    jax.block_until_ready(compiled(*calls[0]))
    return compile_seconds, _timed(compiled, calls, repeats)


def measure_first(
    function: Callable[..., Any], calls: Sequence[tuple[Any, ...]], repeats: int
) -> tuple[float, list[float]]:
    """As `measure`, of a function that compiles by itself: compilation is the excess time of its first call."""
    first = _timed(function, calls, 1)[0]
    seconds = _timed(function, calls, repeats)
    return max(first - statistics.median(seconds), 0.0), seconds


def _timed(function: Callable[..., Any], calls: Sequence[tuple[Any, ...]], repeats: int) -> list[float]:
    seconds = []
    for i in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(function(*calls[i % len(calls)]))
        seconds.append(time.perf_counter() - start)
    return seconds


def f_of(problem: Problem, scene: Superquadrics) -> Bool[Array, " x"]:
    """f of a single state, for all poses."""
    everywhere = jnp.ones(problem.poses.shape[0], bool)
    views = object_views(problem.existence, problem.camera, scene, everywhere, problem.config.existence)
    config = problem.config.existence
    allowed = jnp.full(problem.existence.corner.shape[:2], config.allowed(problem.camera), jnp.int32)
    return existence(problem.existence, problem.camera, views, everywhere, allowed, config)


def g_of(problem: Problem, belief: Belief, scene: Superquadrics) -> Int[Array, " x"]:
    """g of a single state, where f = 1."""
    return graspability(pairs(problem.grasps), grasp_hits(problem.grasps, scene, belief.exists))


def bench_part(
    subject: Literal["existence", "graspability"],
    objects: int,
    settings: Settings,
    batch: int = 1,
    scenes: int = 5,
    repeats: int = 20,
) -> Timing:
    """Time f or g on generated scenes.

    Args:
      subject: the timed function.
      objects: number of objects in a scene.
      settings: of the workcell, its objects, and the problem.
      batch: number of scenes in one call; 1 times the function itself, without a batch axis.
      scenes: number of different scenes, taken in turn.
      repeats: number of timed calls.

    Raises:
      InputError: the number of objects does not fit.
    """
    problem, states, shapes = _states(objects, settings.config, settings.workcell, settings.objects, batch, scenes)
    functions: dict[str, Callable[..., Any]] = {
        "existence": lambda problem, key, belief, seen: f_of(problem, seen.objects),
        "graspability": lambda problem, key, belief, seen: g_of(problem, belief, seen.objects),
    }
    if subject == "graspability":
        shapes["median_possible_poses"] = int(statistics.median(int(belief.exists.sum()) for _, belief, _ in states))
    function, calls = functions[subject], [(problem, *state) for state in states]
    if batch > 1:
        function, calls = jax.vmap(function, in_axes=(None, 0, 0, 0)), [(problem, *_batch_of(states, batch))]
    compile_seconds, seconds = measure(function, calls, repeats)
    return Timing(subject, objects, shapes, compile_seconds, tuple(seconds), versions())


def bench_plan(
    objects: int, method: Method, batch: int = 1, scenes: int = 5, repeats: int = 20, sizes: ObjectSizes | None = None
) -> Timing:
    """Time a decision on generated scenes, whose targets are not found yet.

    Args:
      objects: number of objects in a scene.
      method: policy and settings.
      batch, scenes, repeats: as in `bench_part`.
      sizes: of the objects; the paper's if None.

    Raises:
      InputError: the number of objects does not fit, or the method cannot be used.
    """
    policy, trials = method.policy(), method.trials()
    problem, states, shapes = _states(objects, method.config, method.workcell, sizes, batch, scenes)
    shapes |= {"sequences": method.config.planner.sequences, "horizon": method.config.planner.horizon}

    def propose(problem: Problem, key: Array, belief: Belief, seen: Observation) -> Decision:
        return policy(key, problem, belief, seen)

    def decide(problem: Problem, key: Array, state: SearchState) -> Decision:
        return step.decide(policy, trials, key, problem, state).decision

    if batch > 1:
        calls = [(problem, *_batch_of(states, batch))]
        propose_many = jax.vmap(propose, in_axes=(None, 0, 0, 0))
        if trials is None:
            compile_seconds, seconds = measure(propose_many, calls, repeats)
        else:
            compile_seconds, seconds = measure_first(_with_trials(jax.jit(propose_many), trials), calls, repeats)
    else:
        # As in a single episode: the policy compiles by itself, and computes only the branch that the belief selects.
        known = [(problem, key, SearchState(belief, seen, no_action())) for key, belief, seen in states]
        compile_seconds, seconds = measure_first(decide, known, repeats)
    about = versions() | {"push model": method.config.push_model}
    return Timing("plan", objects, shapes, compile_seconds, tuple(seconds), about)


def _with_trials(propose_many: Callable[..., Decision], trials: Trials) -> Callable[..., Decision]:
    """A function that decides on many scenes after trials of the proposals."""
    choose = jax.jit(jax.vmap(trying.choose))

    def decide(problem: Problem, keys: Array, beliefs: Belief, seen: Observation) -> Decision:
        decisions = propose_many(problem, keys, beliefs, seen)
        alternatives = decisions.alternatives
        if alternatives is None:
            return decisions
        scenes = trying.scenes_of(beliefs, seen)
        results = trials(problem, scenes, *jax.device_get((alternatives.actions, alternatives.worth)))
        return choose(decisions, jnp.asarray(results))

    return decide


def _states(
    objects: int, config: Config, workcell: Workcell, sizes: ObjectSizes | None, batch: int, scenes: int
) -> tuple[Problem, list[tuple[Array, Belief, Observation]], dict[str, int]]:
    """The problem, key, belief and observation at the start of generated scenes, and the sizes."""
    around = {"shelf": workcell.shelf, "camera": workcell.camera, "gripper": workcell.gripper}
    draw = draws_from(sizes or ObjectSizes())
    generator = ScenarioGenerator(workcell.target, **around, draw=draw)
    problem = planner.build_problem(target=generator.target, **around, config=config.problem)
    states = []
    for seed in range(scenes):
        world = from_scenario(generator.generate(seed, objects))
        scene = objects_on_the_board(Snapshot(problem.camera, problem.shelf, world))
        observation = Observation(scene, jnp.array(False), jnp.zeros(3))
        belief = planner.update_belief(problem, planner.initial_belief(problem), observation)
        states.append((jax.random.key(seed), belief, observation))
    capacity = states[0][2].objects.capacity
    return problem, states, {"poses": len(problem.poses), "capacity": capacity, "scenes": scenes, "batch": batch}


def _batch_of(states: Sequence[Any], batch: int) -> Any:
    """`batch` states, taken in turn, with a leading axis."""
    return jax.tree.map(lambda *leaves: jnp.stack([leaves[i % len(states)] for i in range(batch)]), *states)


def bench_perceive(
    recognition: RecognitionName, objects: int, batch: int = 1, scenes: int = 5, repeats: int = 20
) -> Timing:
    """Time recognition from noisy depth images: cloud, segments, network and refinement.

    Ray-casting the images is included, as in the planner's simulated camera.

    Args:
      recognition: "masks" or "full".
      objects: number of objects in a scene, all of which are recognised at once.
      batch, scenes, repeats: as in `bench_part`.

    Raises:
      InputError: a recogniser without an image, the number of objects does not fit, or the weights are damaged.
    """
    if recognition not in ("masks", "full"):
        raise InputError(f"bench perceive: {recognition} recognises nothing; give --recognition masks or full")
    generator = ScenarioGenerator()
    see = recogniser(recognition, generator.target)
    camera, shelf = Camera(), Shelf()
    worlds = [from_scenario(generator.generate(seed, objects)) for seed in range(scenes)]
    states = [(jax.random.key(seed), world) for seed, world in enumerate(worlds)]

    def perceive(key: Array, world: World) -> Superquadrics:
        return see(key, Snapshot(camera, shelf, world)).objects

    function, calls = perceive, states
    if batch > 1:
        function = jax.vmap(perceive)
        calls = [_batch_of(states, batch)]
    compile_seconds, seconds = measure(function, calls, repeats)
    shapes = {"scenes": scenes, "batch": batch, "recognitions": batch * objects}
    return Timing(f"perceive: {recognition}", objects, shapes, compile_seconds, tuple(seconds), versions())


def drawn_pushes(count: int, objects: int, seed: int = 0, tries: int = 100) -> tuple[World, Action]:
    """Random possible pushes as in the training of the push model, each in a separate random scene.

    Args:
      count: number of pushes.
      objects: in each scene. A scene with room for fewer, or without a possible push, is drawn anew.
      seed: of the scenes and the pushes.
      tries: at most this many times `count` scenes are drawn.

    Returns:
      The scenes and the pushes, with a leading axis.

    Raises:
      InputError: the number of objects does not fit, or too few pushes are possible.
    """
    if not 1 <= objects <= MAX_OBJECTS:
        raise InputError(f"bench predict: --objects {objects} is not between 1 and {MAX_OBJECTS}")
    scenes, config, shelf = dataclasses.replace(push_scenes(), objects=(objects, objects)), PushesConfig(), Shelf()
    tables = push_tables(config)

    def draw(key: Array) -> tuple[World, Action, Array]:
        scene_key, push_key = jax.random.split(key)
        world = random_world(scene_key, scenes, shelf)
        action, possible = draw_push(push_key, world, tables, config, shelf)
        return world, action, possible & (jnp.sum(world.valid[:TARGET]) == objects)

    draw_many = jax.jit(lambda keys: jax.lax.map(draw, keys, batch_size=min(count, 64)))
    parts, total = [], 0
    for i in range(tries):
        keys = jax.random.split(jax.random.fold_in(jax.random.key(seed), i), count)
        world, action, usable = jax.device_get(draw_many(keys))
        parts.append(jax.tree.map(lambda a, usable=usable: a[usable], (world, action)))
        total += int(usable.sum())
        if total >= count:
            return jax.tree.map(lambda *a: jnp.asarray(np.concatenate(a)[:count]), *parts)
    raise InputError(f"bench predict: only {total} of {count} pushes were possible with {objects} objects; take fewer")


def named_model(name: str, weights: Path | None = None) -> PushModel:
    """The push model of a name, as a plan uses it for first actions, or `no_motion`.

    Args:
      name: "no motion", "quasi-static", "learned" or "physics".
      weights: of the learned model; the shipped ones if None.

    Raises:
      InputError: there is no model of that name, its weights are missing or damaged, or Warp cannot be imported.
    """
    if name == "no motion":
        return no_motion
    if name == "learned" and weights is not None:
        return LearnedPush(weights)
    return push_models(name).first


def weights_of(model: PushModel) -> dict[str, Any] | None:
    """SHA-256 and number of parameters of a learned model's weights; None for other models."""
    if not isinstance(model, LearnedPush) or model.path is None:
        return None
    parameters = load_weights(model.path, NAME).parameters
    return {"sha256": model.digest, "parameters": sum(a.size for a in jax.tree.leaves(parameters))}


def bench_predict(
    push_model: PushModelName, objects: int, batch: int = 30, repeats: int = 20, weights: Path | None = None
) -> Timing:
    """Time a push model on random pushes, each in a separate scene, all in one call.

    Args:
      push_model: its name.
      objects: number of objects in a scene.
      batch: pushes in a call; a step of a decision predicts one for each sampled sequence.
      repeats: number of timed calls.
      weights: of the learned model; the shipped ones if None.

    Raises:
      InputError: the number of objects does not fit, or the model cannot be used.
    """
    model = named_model(push_model, weights)
    world, action = drawn_pushes(batch, objects)
    shelf, pusher = Shelf(), push_tables(PushesConfig()).pusher

    def predict(pusher: Array, scene: Superquadrics, action: Action) -> PushOutcome:
        return model(shelf, scene, pusher, action.T_world_gripper, action.displacement, action.q7)

    # As in a decision, the target is not among the objects.
    scene = true_superquadrics(world)
    compile_seconds, seconds = measure(jax.vmap(predict, in_axes=(None, 0, 0)), [(pusher, scene, action)], repeats)
    learned, about = weights_of(model), versions()
    shapes = {"predictions": batch, "capacity": TARGET}
    if learned is not None:
        shapes["parameters"], about["weights"] = learned["parameters"], learned["sha256"]
    return Timing(f"predict: {push_model}", objects, shapes, compile_seconds, tuple(seconds), about)
