"""Retrieval models that simulate: of the grasps that hit something, many take the target out all the same.

The recognised objects become bodies as in `physics_push`, and the target one of its own shape; they come to rest, and
the arm takes the target out as the environment's does. The environment's own simulator is not involved.

An approximation: what is not recognised is not there.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from mechsearch_jax.actions import Action
from mechsearch_jax.cores import cores
from mechsearch_jax.envs.native import NativeWorld
from mechsearch_jax.envs.physics_push import bodies, sound
from mechsearch_jax.envs.simulator import SimulatorConfig
from mechsearch_jax.envs.world import TARGET, World, bodies_of
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import upright_pose
from mechsearch_jax.planner import Problem
from mechsearch_jax.robot.motion import Reference, retrieve_reference
from mechsearch_jax.shapes import shape_of
from mechsearch_jax.workspace.shelf import Shelf


@dataclasses.dataclass(frozen=True)
class NativeRetrieval:
    """The `RetrievalModel` that takes the target out in C MuJoCo, all that are mapped over at once, on several threads.

    The retrievals are made in the order that they are given in, of each scene until one succeeds. The same retrievals
    always give the same results. One that diverges, or whose scene is no scene, does not succeed. While it is traced,
    `jax.pure_callback` takes them to the host, for which JAX needs two cores.

    Attributes:
      simulation: how it is simulated.
      threads: how many; one for each of `cores.cores` if left out.
    """

    simulation: SimulatorConfig = dataclasses.field(default_factory=SimulatorConfig)
    threads: int | None = None

    def __call__(
        self, problem: Problem, scene: Superquadrics, pose: Float[Array, "3"], actions: Action, asked: Bool[Array, " k"]
    ) -> Bool[Array, " k"]:
        """See `retrieval.RetrievalModel`."""
        world, reference, reachable = _prepared(problem, scene, pose, actions, self.simulation)
        told = world, reference, asked & reachable
        simulate = functools.partial(_first_successes, problem.shelf, self.simulation, self.threads or cores())
        if not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(told)):
            return jax.device_put(simulate(*jax.device_get(told)))
        result = jax.ShapeDtypeStruct(asked.shape, jnp.bool_)
        return jax.pure_callback(simulate, result, *told, vmap_method="broadcast_all")


@functools.partial(jax.jit, static_argnames=("simulation",))
def _prepared(
    problem: Problem, scene: Superquadrics, pose: Float[Array, "3"], actions: Action, simulation: SimulatorConfig
) -> tuple[World, Reference, Bool[Array, " k"]]:
    """The bodies, the motions of the arm, and which of these it can make."""
    target, shape = problem.target, shape_of(problem.target.shape)
    T_world_target = upright_pose(pose, target.height(problem.shelf))
    world = bodies(scene)
    world = World(
        kind=world.kind.at[TARGET].set(shape.code),
        half_size=world.half_size.at[TARGET].set(jnp.asarray(target.half_size)),
        position=world.position.at[TARGET].set(T_world_target[:3, 3]),
        rotation=world.rotation.at[TARGET].set(T_world_target[:3, :3]),
        valid=world.valid.at[TARGET].set(True),
    )
    each = functools.partial(retrieve_reference, config=simulation.motion)
    reference, reachable = jax.vmap(each)(actions.T_world_gripper, actions.q7, actions.opening)
    return world, reference, reachable


def _first_successes(
    shelf: Shelf, config: SimulatorConfig, threads: int, world: World, reference: Reference, asked: Any
) -> Bool[np.ndarray, "*lead k"]:
    """For each scene the first retrieval that succeeds, of those that are asked of; any leading axes.

    It must not compute with JAX, which is waiting for it.
    """
    world, reference, asked = jax.tree.map(np.asarray, (world, reference, asked))
    lead, k = asked.shape[:-1], asked.shape[-1]
    world = jax.tree.map(lambda a: a.reshape(-1, *a.shape[len(lead) :]), world)
    reference = jax.tree.map(lambda a: a.reshape(-1, k, *a.shape[len(lead) + 1 :]), reference)
    asked = asked.reshape(-1, k)
    found = np.zeros(asked.shape, bool)
    left = {row: iter(np.flatnonzero(asked[row])) for row in np.flatnonzero(asked.any(axis=1))}
    with ThreadPoolExecutor(threads) as pool:
        while left:
            # Of few scenes several retrievals are made at the same time.
            some = [(row, i) for row, rest in left.items() for i in itertools.islice(rest, -(-threads // len(left)))]
            told = pool.map(lambda at: _succeeds(shelf, config, _row(world, at[0]), _row(reference, at)), some)
            for (row, i), success in zip(some, told, strict=True):
                found[row, i] = success
            tried = {row for row, _ in some}
            left = {row: rest for row, rest in left.items() if row in tried and not found[row].any()}
    return found.reshape(*lead, k)


def _row(tree: Any, index: Any) -> Any:
    return jax.tree.map(lambda a: a[index], tree)


def _succeeds(shelf: Shelf, config: SimulatorConfig, world: World, reference: Reference) -> bool:
    """Whether a motion takes the target out, and nothing falls."""
    if not sound(*jax.tree.map(lambda a: a[None], (world, reference))):
        return False
    here = NativeWorld(shelf, config=config)
    here.place(bodies_of(world))
    return here.settle_and_retrieve(reference)
