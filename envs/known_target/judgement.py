"""A target whose pose is known, seen or not: its distance from graspable, sampled actions, and retrievals."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mechsearch_jax.config.config import PlannerConfig, Weights
from mechsearch_jax.envs.camera.snapshot import Snapshot, objects_on_the_board, true_target_pose
from mechsearch_jax.envs.world.world import World
from mechsearch_jax.grasping.graspability import no_hits, pairs
from mechsearch_jax.grasping.retrieval import GraspChoice, best_grasps, found_grasps, found_hits
from mechsearch_jax.planner import Belief, PlanningPolicy, Problem, Sequences, initial_belief
from mechsearch_jax.planner.objective import Objective, SearchForGrasp
from mechsearch_jax.planner.rollout import plan, present_state
from mechsearch_jax.runtime.pytree import PyTreeNode


@dataclasses.dataclass(frozen=True)
class InFullView(SearchForGrasp):
    """The cost of `SearchForGrasp` for a target at a known pose, which may be hidden."""

    def cost(self, problem, belief, state, weights) -> Float[Array, ""]:
        nowhere_hidden = jnp.zeros_like(state.exists)
        return super().cost(problem, belief, state.replace(exists=nowhere_hidden), weights)


class Judgement(PyTreeNode):
    """How far the target of a world is from graspable, by the dense grasps of a found target.

    Attributes:
      cost: J of the planner, of this target alone.
      feasible: which grasps arm and shelf allow, shape (F,).
      hits: which objects each feasible grasp hits on its whole way, shape (F, N).
    """

    cost: Float[Array, "*batch"]
    feasible: Bool[Array, "*batch f"]
    hits: Bool[Array, "*batch f n"]

    @property
    def least(self) -> int | None:
        """Number of objects that the best grasp hits; None if none is feasible. For a single world."""
        return int(self.hits.sum(axis=1)[self.feasible].min()) if self.feasible.any() else None


@functools.partial(jax.jit, static_argnames=("objective",))
def judge(problem: Problem, objective: Objective, weights: Weights, world: World, active: Bool[Array, ""]) -> Judgement:
    """How far the target of a world is from graspable.

    Args:
      problem: built for the target.
      objective: defines the cost; static.
      weights: of what is in the way of the grasp.
      world: the true state, fields without leading axes.
      active: if False, little is computed and the result means nothing.
    """
    snapshot = Snapshot(problem.camera, problem.shelf, world)
    belief, objects = _certain_belief(problem, world, active), objects_on_the_board(snapshot)
    hits = found_hits(problem.target_grasps, belief.grasps, objects, active)
    rows = jnp.concatenate([no_hits(pairs(problem.grasps), hits.shape[1]), hits])
    state = present_state(problem, belief, objects, PlannerConfig())
    state = state.replace(exists=jnp.zeros_like(belief.exists), hits=rows)
    cost = objective.cost(problem, belief, state, weights)
    return Judgement(cost, belief.grasps.feasible, hits & belief.grasps.feasible[:, None])


def _certain_belief(problem: Problem, world: World, active: Bool[Array, ""] | bool = True) -> Belief:
    """The belief that holds the target's true pose as found."""
    pose = true_target_pose(world)
    grasps = found_grasps(problem.target_grasps, problem.target_grasps.standing(pose), active)
    return initial_belief(problem).replace(found=jnp.array(True), found_pose=pose, grasps=grasps)


@jax.jit
def sample(policy: PlanningPolicy, key: Array, problem: Problem, world: World) -> Sequences:
    """Sequences of actions from a world, best first, as the planner samples them."""
    objects = objects_on_the_board(Snapshot(problem.camera, problem.shelf, world))
    return plan(policy.rollout(problem, _certain_belief(problem, world)), key, objects).sequences


def retrievals_of(problem: Problem, world: World, count: int) -> GraspChoice:
    """The best grasps of the target of a world, as `best_grasps` ranks them, as NumPy arrays."""
    objects = objects_on_the_board(Snapshot(problem.camera, problem.shelf, world))
    pose = true_target_pose(jax.tree.map(jnp.asarray, world))
    return jax.device_get(best_grasps(problem.target_grasps, objects, pose, count))
