"""How long f, g and a decision take: compilation apart from steady state, on scenes that the generator made."""

from __future__ import annotations

import dataclasses
import json
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from mechsearch_jax import planner
from mechsearch_jax.envs.episode import Snapshot, objects_on_the_board
from mechsearch_jax.envs.generator import ScenarioGenerator
from mechsearch_jax.envs.world import from_scenario
from mechsearch_jax.existence import existence, object_views
from mechsearch_jax.files import PathLike, replacing
from mechsearch_jax.graspability import grasp_hits, graspability
from mechsearch_jax.planner import Belief, PlannerConfig, Problem
from mechsearch_jax.results import versions
from mechsearch_jax.superquadric import Superquadrics


@dataclasses.dataclass(frozen=True)
class Timing:
    """How long one function takes.

    Attributes:
      subject: "existence", "graspability" or "plan".
      objects: number of objects in the scenes.
      shapes: sizes that the time depends on.
      compile_seconds: of tracing and compiling [s]; honest only if compilations are not kept on disk.
      seconds: of every call afterwards, results awaited [s].
      versions: as `results.versions` returns them.
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


def save_timing(timing: Timing, path: PathLike) -> None:
    """Write a timing as JSON, with its median.

    Raises:
      InputError: the file cannot be written.
    """
    value = {**dataclasses.asdict(timing), "median_seconds": timing.median}
    with replacing(path) as file:
        file.write((json.dumps(value, indent=1, allow_nan=False) + "\n").encode())


def measure(function: Callable[..., Any], calls: Sequence[tuple[Any, ...]], repeats: int) -> tuple[float, list[float]]:
    """Seconds to compile a function for its arguments, and of every call after that.

    Args:
      function: to be compiled.
      calls: arguments of the same shapes, taken in turn.
      repeats: number of timed calls.
    """
    start = time.perf_counter()
    compiled = jax.jit(function).lower(*calls[0]).compile()
    compile_seconds = time.perf_counter() - start
    jax.block_until_ready(compiled(*calls[0]))
    seconds = []
    for i in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(compiled(*calls[i % len(calls)]))
        seconds.append(time.perf_counter() - start)
    return compile_seconds, seconds


def f_of(problem: Problem, scene: Superquadrics) -> Bool[Array, " x"]:
    """f of a single state, for all poses."""
    everywhere = jnp.ones(problem.poses.shape[0], bool)
    views = object_views(problem.existence, problem.camera, scene, everywhere, problem.existence_config)
    return existence(problem.existence, problem.camera, views, everywhere, problem.existence_config)


def g_of(problem: Problem, belief: Belief, scene: Superquadrics) -> Int[Array, " x"]:
    """g of a single state, where f = 1."""
    hits = grasp_hits(problem.grasps, belief.grasps, scene, jnp.append(belief.exists, False))
    return graspability(problem.grasps, belief.grasps, hits)[:-1]


def bench(subject: str, objects: int, config: PlannerConfig, scenes: int = 5, repeats: int = 20) -> Timing:
    """Time f, g or a decision on generated scenes.

    Args:
      subject: "existence", "graspability" or "plan".
      objects: number of objects in a scene.
      config: the planner's options.
      scenes: number of scenes, taken in turn.
      repeats: number of timed calls.

    Raises:
      InputError: the number of objects does not fit.
    """
    generator = ScenarioGenerator()
    problem = planner.build_problem(target=generator.target)
    states = []
    for seed in range(scenes):
        world = from_scenario(generator.generate(seed, objects))
        scene = objects_on_the_board(Snapshot(problem.camera, problem.shelf, world))
        belief = planner.initial_belief(problem)
        belief = planner.observe_belief(problem, belief, scene, jnp.array(False), jnp.zeros(3), config)
        states.append((belief, scene))
    poses = [int(belief.exists.sum()) for belief, _ in states]
    shapes = {"poses": problem.poses.shape[0], "capacity": states[0][1].capacity, "scenes": scenes}
    if subject == "existence":
        timed = measure(f_of, [(problem, scene) for _, scene in states], repeats)
    elif subject == "graspability":
        timed = measure(g_of, [(problem, *state) for state in states], repeats)
        shapes["median_possible_poses"] = int(statistics.median(poses))
    else:

        def decide(key: Array, problem: Problem, belief: Belief, scene: Superquadrics) -> planner.Plan:
            return planner.plan(key, problem, belief, scene, config)

        keys = jax.random.split(jax.random.key(0), scenes)
        timed = measure(decide, [(key, problem, *state) for key, state in zip(keys, states, strict=True)], repeats)
        shapes |= {"sequences": config.sequences, "horizon": config.horizon}
    compile_seconds, seconds = timed
    return Timing(subject, objects, shapes, compile_seconds, tuple(seconds), versions())
