"""Sampling-based model predictive control of mechanical search (paper sections 3 and 4.4, appendix B.4).

`build_problem` gathers what an episode never changes, `observe_belief` folds an observation into what is known of the
target, `plan` decides on the next action, and `graspable_at` says how to take out a target that has been found.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any, Literal

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.actions import (
    CLOSE_WAYPOINTS,
    Action,
    ActionConfig,
    ActionKind,
    ActionSpace,
    ActionTables,
    Candidates,
    PossibleSpace,
    Sample,
    action_tables,
    candidates,
    followable,
    no_action,
    no_candidates,
    push_hits_others,
    sample_action,
    widen,
)
from mechsearch_jax.dynamics.named import PushModelName, check_name, own_push_model
from mechsearch_jax.dynamics.push_model import PushModel
from mechsearch_jax.dynamics.rigid import changed, pick_and_place
from mechsearch_jax.errors import InputError
from mechsearch_jax.existence import (
    ExistenceConfig,
    ExistenceTables,
    ObjectViews,
    existence,
    existence_tables,
    no_views,
    object_views,
    occluders,
)
from mechsearch_jax.geometry.superquadric import Superquadrics, gauge, to_object_frame
from mechsearch_jax.geometry.transforms import compose, upright_pose
from mechsearch_jax.graspability import (
    FoundGrasps,
    GraspConfig,
    GraspTables,
    crowding,
    find_grasps,
    grasp_hits,
    grasp_tables,
    graspability,
    no_hits,
    pairs,
)
from mechsearch_jax.robot.gripper import Gripper, arm_points
from mechsearch_jax.robot.kinematics import line_kinematics, line_poses, path_kinematics
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

CLEARANCES = (0.0, 0.004, 0.008, 0.012, 0.02)
# Small enough that, at a pose, no number of hits outweighs one object of the cost proper.
TIE_BREAK = 0.02
# How much more an object matters that is in the way alone than one of two that are, one of two than one of three, ...
ALONE = 4.0
# On the approach to a found target: poses of the arm, and points on each of its capsules, that are tested.
ARM_WAYPOINTS, ARM_POINTS = 6, 7
# An object is not to be pushed to where its centre is nearer than this to the front edge [m].
EDGE = 0.01
# How far in front of the shelf the gripper has to get with the target [m].
OUTSIDE = 0.04


@dataclasses.dataclass(frozen=True)
class PlannerConfig:
    """How the planner decides; hashable, passed as a static argument.

    Attributes:
      method: "search-for-grasp" minimises where the target can be and how far it is from graspable, together;
        "search-and-grasp" first the one, and the other once the target is found.
      gamma: discount of equation 2, in (0, 1].
      horizon: M, actions in a sequence.
      sequences: how many sequences are sampled for a decision.
      actions: "both", "push" or "pick-and-place".
      criterion: how f decides what is visible; see `existence.ExistenceConfig`.
      push_distances: how far pushes go [m].
      caution: what touching the target unseen would cost, in units of J: a sampled action is charged with J times the
        share of the possible poses at which it would do so.
      topple_charge: what an object that falls over would cost, in units of J: a sampled push is charged with J times
        the number of objects that are expected to. `ActionConfig.topple` says which pushes are ruled out altogether;
        to charge what is left with 0.5 gained nothing.
      push_model: what predicts pushes, by default the network; see `push_models.own_push_model`, and `envs.push_models`
        for "physics", which needs a simulator.
      focus: share of the draws that go to objects by how much they hide or are in the way; the others are even, as the
        paper's all are. 0 to below 1.
      max_steps: T, actions in an episode.
    """

    method: Literal["search-for-grasp", "search-and-grasp"] = "search-for-grasp"
    gamma: float = 0.9
    horizon: int = 3
    sequences: int = 30
    actions: Literal["both", "push", "pick-and-place"] = "both"
    criterion: Literal["detector", "depth-mse", "depth-norm"] = "detector"
    push_distances: tuple[float, ...] = (0.05, 0.10, 0.15)
    caution: float = 1.0
    topple_charge: float = 0.0
    push_model: PushModelName = "learned"
    focus: float = 0.7
    max_steps: int = 10

    def __post_init__(self):
        if self.method not in ("search-for-grasp", "search-and-grasp"):
            raise InputError(f'method "{self.method}" is unknown; use "search-for-grasp" or "search-and-grasp"')
        if not 0.0 < self.gamma <= 1.0:
            raise InputError(f"gamma {self.gamma} is outside (0, 1]; the paper uses 0.9")
        if not 0.0 <= self.caution < math.inf:
            raise InputError(f"caution {self.caution} must be a number that is not negative; the default is 1")
        if not 0.0 <= self.topple_charge < math.inf:
            raise InputError(
                f"topple_charge {self.topple_charge} must be a number that is not negative; 0 is the paper's"
            )
        if not 0.0 <= self.focus < 1.0:
            raise InputError(f"focus {self.focus} is outside [0, 1); the default is 0.7, and 0 draws evenly")
        for name in ("horizon", "sequences", "max_steps"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} {getattr(self, name)} must be at least 1")
        # All three check what they are given.
        check_name(self.push_model)
        ActionConfig(kinds=self.actions, push_distances=self.push_distances)
        ExistenceConfig(criterion=self.criterion)

    @classmethod
    def paper(cls, **changes) -> PlannerConfig:
        """The paper's settings (appendix B.4 and B.5), with changes; it has no `caution`, `focus`, `topple_charge`."""
        return cls(**changes)


class Problem(flax.struct.PyTreeNode):
    """What does not change in an episode: the world around the objects, and all that follows from it.

    Attributes:
      existence, grasps, actions: constants of f, of g and of the actions.
      retrieval: a denser set of grasps, for the target once it is found; it has no candidate poses.
      poses: the candidate poses X as x, y [m], yaw [rad], shape (X, 3).
      camera, shelf, gripper, target, existence_config, grasp_config, retrieval_config, action_config: static.
    """

    existence: ExistenceTables
    grasps: GraspTables
    actions: ActionTables
    retrieval: GraspTables
    poses: jax.Array
    camera: Camera = flax.struct.field(pytree_node=False)
    shelf: Shelf = flax.struct.field(pytree_node=False)
    gripper: Gripper = flax.struct.field(pytree_node=False)
    target: Target = flax.struct.field(pytree_node=False)
    existence_config: ExistenceConfig = flax.struct.field(pytree_node=False)
    grasp_config: GraspConfig = flax.struct.field(pytree_node=False)
    retrieval_config: GraspConfig = flax.struct.field(pytree_node=False)
    action_config: ActionConfig = flax.struct.field(pytree_node=False)


class Belief(flax.struct.PyTreeNode):
    """What is known of the target.

    Attributes:
      exists: f_t, shape (X,). It only ever shrinks, unless it contradicts every pose: see `observe_belief`.
      found: c_t, whether the target has been seen.
      found_pose: where, as x, y [m], yaw [rad].
      grasps: the grasps that arm and shelf allow there.
      restarts: how often f became empty and was started anew.
    """

    exists: jax.Array
    found: jax.Array
    found_pose: jax.Array
    grasps: FoundGrasps
    restarts: jax.Array


class Sequences(flax.struct.PyTreeNode):
    """Sampled sequences of actions, best first; leading axis S, and M within.

    Attributes:
      actions: shape (S, M), of kind NONE from where a sequence found nothing more to do.
      cost: J after each action, shape (S, M).
      value: equation 2 of the best prefix, shape (S,); infinite if there was no first action.
      length: number of actions in that prefix, shape (S,).
    """

    actions: Action
    cost: jax.Array
    value: jax.Array
    length: jax.Array


class Plan(flax.struct.PyTreeNode):
    """A decision.

    Attributes:
      action: what to do next; of kind NONE if nothing is possible.
      value: equation 2 of the sequence it begins: the change of the cost, negative is good.
      cost: J now.
      predicted_cost: J that is expected after the action.
      sequences: all sampled sequences, best first.
      overflow: whether an object's image outgrew its window (see `existence.ObjectViews`): f may be too small.
    """

    action: Action
    value: jax.Array
    cost: jax.Array
    predicted_cost: jax.Array
    sequences: Sequences
    overflow: jax.Array


class GraspChoice(flax.struct.PyTreeNode):
    """How to take out a found target.

    Attributes:
      success: whether there is a grasp that hits nothing.
      hits: number of objects that the best grasp hits; one more than there can be if no grasp is feasible.
      T_world_gripper: the best grasp: of those that hit fewest one with which the arm can leave the shelf, of those
        one with which links 2 to 5 touch fewest objects, and of those the one that keeps furthest from the objects.
      q7: angle of joint 7 [rad].
      opening: distance between the fingers on the way in [m].
    """

    success: jax.Array
    hits: jax.Array
    T_world_gripper: jax.Array
    q7: jax.Array
    opening: jax.Array


def build_problem(
    camera: Camera | None = None,
    shelf: Shelf | None = None,
    gripper: Gripper | None = None,
    target: Target | None = None,
    existence_config: ExistenceConfig | None = None,
    grasp_config: GraspConfig | None = None,
    retrieval_config: GraspConfig | None = None,
    action_config: ActionConfig | None = None,
) -> Problem:
    """Precompute everything about a camera, a shelf, a gripper and a target that no object changes.

    Takes seconds; what is left out takes its default. Not to be called inside `jit`.

    Raises:
      InputError: the target cannot be grasped by the gripper.
    """
    camera, shelf = camera or Camera(), shelf or Shelf()
    gripper, target = gripper or Gripper(), target or Target()
    existence_config, grasp_config = existence_config or ExistenceConfig(), grasp_config or GraspConfig()
    retrieval_config = retrieval_config or GraspConfig.dense()
    action_config = action_config or ActionConfig()
    grasps = grasp_tables(shelf, gripper, target, grasp_config)
    return Problem(
        existence=existence_tables(camera, shelf, target, existence_config),
        grasps=grasps,
        actions=action_tables(gripper, grasp_config.wrists, action_config),
        retrieval=grasp_tables(shelf, gripper, target, retrieval_config, candidates=False),
        poses=jnp.asarray(target.candidate_poses(shelf)),
        camera=camera,
        shelf=shelf,
        gripper=gripper,
        target=target,
        existence_config=existence_config,
        grasp_config=grasp_config,
        retrieval_config=retrieval_config,
        action_config=action_config,
    )


def _existence_config(problem: Problem, config: PlannerConfig) -> ExistenceConfig:
    return dataclasses.replace(problem.existence_config, criterion=config.criterion)


def initial_belief(problem: Problem) -> Belief:
    """Nothing is known: the target can be at every candidate pose."""
    g = problem.grasps.q7.shape[0]
    return Belief(
        exists=jnp.ones(problem.poses.shape[0], bool),
        found=jnp.array(False),
        found_pose=jnp.zeros(3),
        grasps=FoundGrasps(jnp.eye(4), jnp.zeros(g, bool)),
        restarts=jnp.int32(0),
    )


@functools.partial(jax.jit, static_argnames=("config",))
def observe_belief(
    problem: Problem,
    belief: Belief,
    scene: Superquadrics,
    found: Bool[Array, ""],
    found_pose: Float[Array, "3"],
    config: PlannerConfig,
) -> Belief:
    """Fold an observation into the belief: `f_t = f_{t-1} * f_hat(s_t)` (equation 4), or the target's pose once it is
    seen.

    A target that was pushed without having been seen may leave f empty, which is a contradiction; f then starts anew
    from what the objects allow now, and `restarts` counts it.

    Args:
      problem: what does not change.
      belief: before the observation.
      scene: the objects as recognised, without the target.
      found: whether the target is seen now.
      found_pose: where, as x, y [m], yaw [rad]; ignored if it is not.
      config: static.
    """
    everywhere = jnp.ones_like(belief.exists)
    settings = _existence_config(problem, config)
    views = object_views(problem.existence, problem.camera, scene, everywhere, settings)
    now = existence(problem.existence, problem.camera, views, everywhere, settings)
    both = belief.exists & now
    seen = belief.found | found
    contradiction = ~jnp.any(both) & ~seen
    exists = jnp.where(contradiction, jnp.where(jnp.any(now), now, belief.exists), both)
    pose = jnp.where(found, found_pose, belief.found_pose)
    T_world_target = upright_pose(pose, problem.target.height(problem.shelf))
    grasps = find_grasps(problem.grasps, problem.shelf, problem.gripper, problem.grasp_config, T_world_target)
    return Belief(
        exists=jnp.where(seen, belief.exists, exists),
        found=seen,
        found_pose=pose,
        grasps=grasps.replace(feasible=grasps.feasible & seen),
        restarts=belief.restarts + contradiction,
    )


def _everywhere_it_can_be(belief: Belief, exists: Array) -> Bool[Array, " y"]:
    """f at the candidate poses and at the found pose: one or the other."""
    return jnp.concatenate([exists & ~belief.found, belief.found[None]])


def _possible_space(problem: Problem, belief: Belief, exists: Bool[Array, " x"]) -> PossibleSpace:
    """Raster of the space that an unseen target may take; empty once it is found, and an obstacle like any other."""
    grid = jnp.sum(exists.reshape(*problem.target.grid, -1), axis=-1) * ~belief.found
    return PossibleSpace(
        occupied=widen(grid > 0),
        chance=grid / jnp.maximum(jnp.sum(grid), 1),
        origin=problem.poses[0, :2],
        cell=jnp.float32(problem.target.cell(problem.shelf)[:2]),
        top=jnp.float32(problem.shelf.board + 2 * problem.target.half_size[2]),
    )


def _with_target(problem: Problem, belief: Belief, scene: Superquadrics) -> Superquadrics:
    """The scene with the target in one more slot, absent until it is found."""
    T = belief.grasps.T_world_target
    target = Superquadrics(
        size=jnp.float32(problem.target.half_size),
        exponents=jnp.float32(problem.target.exponents),
        position=T[:3, 3],
        rotation=T[:3, :3],
        valid=belief.found,
    )
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), scene, target)


def _without_target(scene: Superquadrics) -> Superquadrics:
    """The same slots with the target's empty: it neither hides itself nor is in the way of its own grasp."""
    return scene.replace(valid=scene.valid.at[-1].set(False))


def _cost(problem: Problem, belief: Belief, exists: Array, hits: Array, method: str) -> Float[Array, ""]:
    """J of equation 2 with g extended below zero (B.4), and a slight preference for fewer grasps in collision.

    g only sees the best grasp of a pose; while nothing changes that one, clearing the way for others is progress too.
    """
    f = _everywhere_it_can_be(belief, exists).astype(jnp.float32)
    g = graspability(problem.grasps, belief.grasps, hits).astype(jnp.float32)
    crowded = TIE_BREAK * crowding(problem.grasps, belief.grasps, hits)
    both = jnp.sum(f * (1.0 + (1.0 - g) + crowded))
    if method == "search-for-grasp":
        return both
    return jnp.where(belief.found, 1.0 - g[-1] + crowded[-1], jnp.sum(f))


def _where_g_counts(belief: Belief, exists: Array, method: str) -> Bool[Array, " y"]:
    """Poses whose graspability enters the cost: search-and-grasp needs none until the target is found."""
    f = _everywhere_it_can_be(belief, exists)
    return f if method == "search-for-grasp" else f.at[:-1].set(False)


class _Node(flax.struct.PyTreeNode):
    """A predicted state on the way through a sequence, with what was computed of the one before it.

    `moved` says which objects differ between the two; `alive`, whether the sequence has found something to do so far.
    """

    scene: Superquadrics
    exists: jax.Array
    views: ObjectViews
    hits: jax.Array
    options: Candidates
    moved: jax.Array
    available: jax.Array
    alive: jax.Array


def action_space(problem: Problem, config: PlannerConfig) -> ActionSpace:
    """The static part of the actions of a problem under a configuration."""
    changes = {"kinds": config.actions, "push_distances": config.push_distances}
    return ActionSpace(
        shelf=problem.shelf,
        gripper=problem.gripper,
        config=dataclasses.replace(problem.action_config, **changes),
        max_yaw=problem.grasp_config.max_yaw,
        waypoints=problem.grasp_config.waypoints,
    )


def _predict(problem: Problem, space: ActionSpace, push_model: PushModel, scene: Superquadrics, sample: Sample):
    """S of equation 4, whether the action can be executed as predicted, and how many objects are expected to topple."""
    action = sample.action
    is_push = action.kind == ActionKind.PUSH
    # A model that simulates has less to do where nothing is pushed.
    way = jnp.where(is_push, action.displacement, 0.0)
    pushed = push_model(problem.shelf, scene, problem.actions.pusher, action.T_world_gripper, way, action.q7)
    placed = pick_and_place(scene, action.object, action.T_world_gripper, action.T_world_place)
    moved = changed(scene, pushed.scene)
    still = scene.valid & ~moved & is_push
    # So that what is not a number spoils a push, too.
    holds = (pushed.residual <= space.config.jam) & jnp.all(pushed.topples <= space.config.topple)
    spoiled = ~holds | moved[-1]
    spoiled |= jnp.any(moved & (pushed.scene.position[:, 0] < problem.shelf.front + EDGE))
    spoiled |= push_hits_others(space, problem.actions, scene, action, sample.wrist, still)
    possible = (action.kind != ActionKind.NONE) & ~(is_push & spoiled) & followable(space, action)
    after = jax.tree.map(lambda a, b: jnp.where(is_push, a, b), pushed.scene, placed)
    after = jax.tree.map(lambda new, old: jnp.where(possible, new, old), after, scene)
    return after, possible, jnp.where(is_push, jnp.sum(pushed.topples), 0.0)


def _root(problem: Problem, belief: Belief, scene: Superquadrics, space: ActionSpace) -> _Node:
    """The present state, of which nothing is computed yet: as if every object had just moved."""
    return _Node(
        scene=scene,
        exists=belief.exists,
        views=no_views(scene.capacity, problem.existence_config),
        hits=no_hits(problem.grasps, scene.capacity),
        options=no_candidates(space, problem.actions, scene.capacity),
        moved=scene.valid,
        available=_without_target(scene).valid,
        alive=jnp.array(True),
    )


def _update(problem, belief, config, node: _Node, moved: Array) -> _Node:
    """Bring f and g of a state up to date after some objects moved."""
    objects = _without_target(node.scene)
    settings = _existence_config(problem, config)
    # What an action covers is not ruled out: a target there would be pushed along, not found to be elsewhere. So only
    # what it uncovers counts, and collisions do not.
    views = object_views(problem.existence, problem.camera, objects, None, settings, node.views, moved)
    exists = existence(problem.existence, problem.camera, views, node.exists, settings)
    counts = _where_g_counts(belief, exists, config.method)
    hits = grasp_hits(problem.grasps, belief.grasps, objects, counts, node.hits, moved)
    return node.replace(exists=exists, views=views, hits=hits)


def _options(problem, belief, space, node: _Node, moved: Array) -> Candidates:
    """What can be done in a state after some objects moved."""
    possible = _possible_space(problem, belief, node.exists)
    return candidates(space, problem.actions, node.scene, possible, node.options, moved)


def _blame(in_the_way: Bool[Array, "k n"], counts: Bool[Array, " k"]) -> Float[Array, " n"]:
    """Each object's share of what is in the way in those rows that count; the fewer share a row, the more it weighs."""
    others = jnp.sum(in_the_way, axis=1, keepdims=True) - 1.0
    weight = jnp.where(in_the_way & counts[:, None], ALONE**-others, 0.0)
    total = jnp.sum(weight, axis=0)
    return total / jnp.maximum(jnp.sum(total), 1e-12)


def _object_weights(problem: Problem, belief: Belief, config: PlannerConfig, node: _Node) -> Float[Array, " n"]:
    """How often each object is to be drawn: in part evenly, in part by what it hides and which grasps it blocks."""
    pose, _, allowed, _ = pairs(problem.grasps, belief.grasps)
    blocks = _blame(node.hits, allowed & _where_g_counts(belief, node.exists, config.method)[pose])
    hides = _blame(occluders(problem.existence, node.views), node.exists & ~belief.found)
    both = blocks + hides
    share = both / jnp.maximum(jnp.sum(both), 1e-12)
    return (1.0 - config.focus) / node.scene.capacity + config.focus * share


def _act(problem, belief, config, space, push_model, node: _Node, key: Array) -> tuple[dict[str, Any], Action, Array]:
    """Sample an action and predict what it changes in a state; also what it may cost beside, as a share of J."""
    possible = _possible_space(problem, belief, node.exists)
    available = node.available & node.alive
    weights = _object_weights(problem, belief, config, node)
    sample = sample_action(key, space, problem.actions, node.scene, possible, node.options, available, weights)
    scene, acted, topples = _predict(problem, space, push_model, node.scene, sample)
    acted &= node.alive
    action = sample.action.replace(kind=jnp.where(acted, sample.action.kind, ActionKind.NONE).astype(jnp.int32))
    changes = {
        "scene": scene,
        "moved": changed(node.scene, scene) & acted,
        "available": node.available & (jnp.arange(scene.capacity) != action.object),
        "alive": acted,
    }
    return changes, action, config.caution * sample.risk + config.topple_charge * topples


def _either(first: Bool[Array, ""], model: PushModel, later: PushModel) -> PushModel:
    """The first model where `first` is set, else the other; the other is not run, as long as `first` is not batched."""
    if model == later:
        return model

    def chosen(shelf, scene, pusher, T_world_gripper, displacement, q7):
        branches = (functools.partial(model, shelf), functools.partial(later, shelf))
        return jax.lax.cond(first, *branches, scene, pusher, T_world_gripper, displacement, q7)

    return chosen


def _prefix_values(
    cost: Float[Array, " n"], charge: Float[Array, " m"], acted: Bool[Array, " m"], gamma: float
) -> tuple[Float[Array, ""], Int[Array, ""]]:
    """Equation 2 for every prefix of a sequence, with what its actions are charged: the best value, and its length.

    `cost` is J before each action and after the last.
    """
    discount = gamma ** jnp.arange(charge.shape[0], dtype=jnp.float32)
    values = jnp.where(acted, jnp.cumsum(discount * (jnp.diff(cost) + charge)), jnp.inf)
    return jnp.min(values), jnp.argmin(values) + 1


@functools.partial(jax.jit, static_argnames=("config", "push_model", "later_push_model"))
def plan(
    key: Array,
    problem: Problem,
    belief: Belief,
    scene: Superquadrics,
    config: PlannerConfig,
    push_model: PushModel | None = None,
    later_push_model: PushModel | None = None,
) -> Plan:
    """Decide on the next action by sampling sequences and keeping the first action of the best (B.4).

    Args:
      key: PRNG key of the planner.
      problem: what does not change.
      belief: what is known of the target, after the latest observation.
      scene: the objects as recognised, fields (N, ...).
      config: static.
      push_model: predicts pushes; static; the one that `config` names if left out.
      later_push_model: predicts those that are not the first action of a sequence; static; `push_model` if left out.

    Returns:
      The decision and everything that was considered. The same arguments give the same decision, also under `vmap`.

    Raises:
      InputError: the push model is left out, and the one that `config` names needs a simulator or has no weights.
    """
    push_model = push_model or own_push_model(config.push_model)
    later_push_model = later_push_model or push_model
    space = action_space(problem, config)
    scene = _with_target(problem, belief, scene)
    count, horizon = config.sequences, config.horizon
    repeated = lambda tree: jax.tree.map(lambda a: jnp.broadcast_to(a, (count, *a.shape)), tree)  # noqa: E731
    nodes = repeated(_root(problem, belief, scene, space))
    update = jax.vmap(functools.partial(_update, problem, belief, config))
    options_of = jax.vmap(functools.partial(_options, problem, belief, space))
    cost_of = jax.vmap(lambda node: _cost(problem, belief, node.exists, node.hits, config.method))

    def step(nodes, keys_and_time):
        keys, time = keys_and_time
        # All sequences begin in the same state, so only the first computes it.
        first = time == 0
        computes = (~first | (jnp.arange(count) == 0))[:, None]
        moved = nodes.moved & computes
        shared = lambda tree: jax.tree.map(lambda a: jnp.where(first, a[:1], a), tree)  # noqa: E731
        nodes = shared(update(nodes.replace(exists=nodes.exists & computes), moved))

        def go_on():
            options = shared(options_of(nodes, moved))
            predicts = _either(first, push_model, later_push_model)
            act = functools.partial(_act, problem, belief, config, space, predicts)
            changes, actions, price = jax.vmap(act)(nodes.replace(options=options), keys)
            return changes | {"options": options}, actions, price

        def stay():
            changes = {name: getattr(nodes, name) for name in ("scene", "moved", "available", "alive", "options")}
            return changes, repeated(no_action()), jnp.zeros(count)

        # After the last action only the cost counts. What the actions do not change does not pass through the branches.
        changes, actions, price = jax.lax.cond(time < horizon, go_on, stay)
        return nodes.replace(**changes), (actions, cost_of(nodes), price, jnp.any(nodes.views.overflow))

    keys = jnp.swapaxes(jax.vmap(lambda k: jax.random.split(k, horizon + 1))(jax.random.split(key, count)), 0, 1)
    _, (actions, cost, price, overflow) = jax.lax.scan(step, nodes, (keys, jnp.arange(horizon + 1)))
    actions, price = jax.tree.map(lambda a: jnp.swapaxes(a[:-1], 0, 1), (actions, price))
    cost, now = jnp.swapaxes(cost, 0, 1), cost[0, 0]
    charge = price * cost[:, :-1]
    value, length = jax.vmap(lambda c, h, k: _prefix_values(c, h, k != ActionKind.NONE, config.gamma))(
        cost, charge, actions.kind
    )
    sequences = Sequences(actions, cost[:, 1:], value, length)
    order = jnp.argsort(sequences.value, stable=True)
    sequences = jax.tree.map(lambda a: a[order], sequences)
    first = jax.tree.map(lambda a: a[0, 0], sequences.actions)
    return Plan(
        action=first,
        value=sequences.value[0],
        cost=now,
        predicted_cost=sequences.cost[0, 0],
        sequences=sequences,
        overflow=overflow[0],
    )


@functools.partial(jax.jit, static_argnames=("config",))
def graspability_map(problem: Problem, belief: Belief, scene: Superquadrics, config: PlannerConfig) -> Int[Array, " x"]:
    """g at every candidate pose, whether the target can be there or not: 1, 0, -1, ... (section B.4), shape (X,)."""
    everywhere = jnp.ones(problem.poses.shape[0] + 1, bool)
    hits = grasp_hits(problem.grasps, belief.grasps, scene, everywhere)
    return graspability(problem.grasps, belief.grasps, hits)[:-1]


def _leaves_shelf(
    problem: Problem, T_world_gripper: Float[Array, "g 4 4"], q7: Float[Array, " g"]
) -> Bool[Array, " g"]:
    """Whether the arm can go on from the end of a retreat, along -x, until what it holds is outside the shelf."""
    n = CLOSE_WAYPOINTS
    back = line_poses(T_world_gripper, jnp.full(q7.shape, problem.gripper.approach), n)
    step = jnp.minimum(problem.shelf.front - OUTSIDE - back[:, 0, 0, 3], 0.0)
    out = jnp.broadcast_to(back[:, :1], (q7.shape[0], n - 1, 4, 4))
    out = out.at[..., 0, 3].add(step[:, None] * jnp.linspace(1.0, 0.0, n)[None, :-1])
    return path_kinematics(jnp.concatenate([out, back], axis=1), q7)[1]


def _arm_touches(
    problem: Problem, scene: Superquadrics, T_world_gripper: Float[Array, "g 4 4"], q7: Float[Array, " g"]
) -> Int[Array, " g"]:
    """How many objects links 2 to 5 run into on the approach to each grasp."""
    approach = jnp.full(q7.shape, problem.gripper.approach)
    q, _ = line_kinematics(T_world_gripper, approach, q7, ARM_WAYPOINTS)
    points, radius = arm_points(q, ARM_POINTS)
    size = scene.size[None] + radius[:, None, None]
    # A superquadric that is larger by the radius on every side holds all that is nearer than that to the object.
    near = gauge(size, scene.exponents[None], to_object_frame(scene, points)) < 1.0
    return jnp.sum(jnp.any(near, axis=(1, 2)) & scene.valid[None], axis=1)


@jax.jit
def graspable_at(problem: Problem, scene: Superquadrics, pose: Float[Array, "3"]) -> GraspChoice:
    """Whether and how a target at a pose can be grasped without hitting anything.

    Args:
      problem: what does not change.
      scene: the objects, without the target.
      pose: of the target as x, y [m], yaw [rad]; need not be a candidate.
    """
    T_world_target = upright_pose(pose, problem.target.height(problem.shelf))
    tables = problem.retrieval
    found = find_grasps(tables, problem.shelf, problem.gripper, problem.retrieval_config, T_world_target)
    here = jnp.ones(1, bool)

    def count(clearance):
        hits = grasp_hits(tables, found, scene.replace(size=scene.size + clearance), here)
        return jnp.where(found.feasible, jnp.sum(hits, axis=1), scene.capacity + 1)

    counts = jax.lax.map(count, jnp.float32(CLEARANCES))
    T = compose(T_world_target[None], tables.T_target_gripper)
    leaves = _leaves_shelf(problem, T, tables.q7)
    touches = _arm_touches(problem, scene, T, tables.q7)
    order = ((counts[0] * 2 + ~leaves) * 10 + touches) * 100 + jnp.sum(counts[1:], axis=0)
    best = jnp.argmin(order)
    return GraspChoice(
        success=counts[0, best] == 0,
        hits=counts[0, best].astype(jnp.int32),
        T_world_gripper=T[best],
        q7=tables.q7[best],
        opening=jnp.float32(problem.gripper.max_opening),
    )
