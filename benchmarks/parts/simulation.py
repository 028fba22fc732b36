"""Times the batch simulator: an arm that sweeps through 8 objects in every world."""

from __future__ import annotations

import statistics
import time

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mechsearch_jax.benchmarks.parts.bench import Timing
from mechsearch_jax.envs.scenes.generator import ScenarioGenerator
from mechsearch_jax.envs.simulators.mjx_model import MjxConfig
from mechsearch_jax.envs.simulators.mjx_simulator import MjxSimulator
from mechsearch_jax.envs.simulators.mjx_step import commands
from mechsearch_jax.envs.world.world import World, from_scenario
from mechsearch_jax.geometry.transforms import make
from mechsearch_jax.robot import motion
from mechsearch_jax.robot.grasp_frames import WRIST_ORIGIN, gripper_rotation
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.versions import versions
from mechsearch_jax.workspace.scenario import MAX_OBJECTS


def crowded_worlds(worlds: int, scenes: int = 8, seed: int = 0) -> World:
    """Many worlds with 8 objects each: generated scenes in turn, with sizes that differ in every world.

    Args:
      worlds: number of worlds.
      scenes: number of generated scenes.
      seed: of the scenes and of the sizes.
    """
    generator = ScenarioGenerator()
    generated = [from_scenario(generator.generate(seed + i, MAX_OBJECTS)) for i in range(min(scenes, worlds))]
    batch: World = jax.tree.map(lambda *leaves: np.stack(leaves)[np.arange(worlds) % len(leaves)], *generated)
    scale = np.random.default_rng(seed).uniform(0.96, 1.0, (worlds, batch.kind.shape[1], 1)).astype(np.float32)
    half = np.asarray(batch.half_size)
    # A smaller body stands lower, if it stands.
    lower = (1 - scale[..., 0]) * half[..., 2]
    position = np.asarray(batch.position) - lower[..., None] * np.array([0.0, 0.0, 1.0], np.float32)
    return batch.replace(half_size=half * scale, position=position)


def plough(worlds: int, steps: int) -> tuple[Float[Array, "steps worlds 9"], Float[Array, "worlds 9"]]:
    """Controls with which the arm reaches in, sweeps 0.15 m through the objects, and leaves, to and fro.

    Args:
      worlds: number of worlds; depth and side of the sweep vary between them.
      steps: number of time steps.

    Returns:
      The controls, and the robot's configurations at the start.
    """
    u = jnp.asarray((np.arange(worlds) % 16) / 16.0 + 1 / 32, jnp.float32)
    position = jnp.stack([0.53 + 0.07 * u, -0.08 + 0.3 * ((5 * u) % 1), jnp.full(worlds, 0.48)], axis=-1)
    tilt = jnp.full(worlds, np.radians(30), jnp.float32)
    T = make(gripper_rotation(jnp.zeros(worlds), tilt), position.astype(jnp.float32))
    shift = jnp.tile(jnp.float32([[0.0, 0.15, 0.0]]), (worlds, 1))
    build = jax.vmap(lambda T, shift, q7: motion.push_reference(T, shift, q7, motion.MotionConfig()))
    reference, reachable = build(T, shift, jnp.full(worlds, WRIST_ORIGIN + np.radians(30), jnp.float32))
    if not reachable.all():
        raise InputError("bench simulate: the arm cannot make its sweep")
    forth = jnp.swapaxes(commands(reference), 0, 1)[: int(reference.length.max())]
    # The arm returns along the same way, so that the controls are continuous.
    last = len(forth) - 1
    index = np.arange(steps) % (2 * last)
    row = np.minimum(index, 2 * last - index)
    start = jnp.concatenate([reference.start, reference.start[:, -1:]], axis=1)
    return forth[row], start


def bench_simulate(
    worlds: int, steps: int, repeats: int = 5, scenes: int = 8, config: MjxConfig | None = None
) -> Timing:
    """Time the batch simulator: 8 objects of varied sizes in every world, the arm sweeping through them.

    Args:
      worlds: number of worlds at once.
      steps: time steps of a timed call; `Timing.rate` is worlds times steps by the median of the calls.
      repeats: number of timed calls; each begins with the generated scenes.
      scenes: number of generated scenes, which the worlds take in turn.
      config: of the simulator.

    Raises:
      InputError: a number is not positive, or Warp is missing.
    """
    for name, value in {"worlds": worlds, "steps": steps, "repeats": repeats, "scenes": scenes}.items():
        if value < 1:
            raise InputError(f"bench simulate: {name} {value} must be at least 1")
    simulator = MjxSimulator(config=config)
    start = crowded_worlds(worlds, scenes)
    controls, begin = plough(worlds, steps)
    seconds = []
    for _ in range(repeats + 1):
        jax.block_until_ready((simulator.load(start), controls))
        before = time.perf_counter()
        outcomes = jax.block_until_ready(simulator.follow(controls, begin))
        seconds.append(time.perf_counter() - before)
    first, *rest = seconds
    shapes = {
        "worlds": worlds,
        "steps": steps,
        "scenes": scenes,
        "overflowed_worlds": int((outcomes.overflow != 0).sum()),
        "diverged_worlds": int((outcomes.failure != 0).sum()),
    }
    # Warp compiles kernels at their first launch: the excess time of the first call.
    compile_seconds = max(first - statistics.median(rest), 0.0)
    return Timing("simulate", MAX_OBJECTS, shapes, compile_seconds, tuple(rest), versions())
