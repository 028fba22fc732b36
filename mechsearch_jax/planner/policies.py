"""Policies decide on the next action. Each is the same engine with different slots.

A policy is a callable `(key, problem, belief, observation) -> Decision`. The policies of this file are also pytrees:
continuous settings are data, so that a jitted function takes a policy as an argument.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
from collections.abc import Mapping
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from mechsearch_jax.actions.kinds.nothing import no_action
from mechsearch_jax.actions.registry import ActionKind
from mechsearch_jax.actions.unseen_space import PossibleSpace
from mechsearch_jax.belief.belief import Belief, possible_space, without_candidates, without_grasps
from mechsearch_jax.config.config import PlannerConfig
from mechsearch_jax.dynamics.named import own_push_model
from mechsearch_jax.dynamics.push_model import PushModel
from mechsearch_jax.geometry.masked import on_cpu
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.grasping.retrieval import GraspChoice, best_grasp, top_grasps
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner.objective import Indifferent, Objective, SearchAndGrasp, SearchForGrasp
from mechsearch_jax.planner.prediction import Predict, PredictByKind
from mechsearch_jax.planner.proposal import ObjectWeights, Propose, farther_weights, sampling_weights, weighted_draw
from mechsearch_jax.planner.rollout import (
    Begun,
    Drawn,
    Rollout,
    begin,
    candidates_of,
    decide,
    first_draws,
    no_sequences,
    plan,
    shapes_of_parts,
    without_poses,
)
from mechsearch_jax.planner.state import Decision, State
from mechsearch_jax.planner.trials import concatenate, grasps_to_try, sequences_to_try
from mechsearch_jax.problem.problem import Problem
from mechsearch_jax.runtime.compiled import CachedJit, cached_jit
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.own_settings import in_own_settings
from mechsearch_jax.runtime.pytree import PyTreeNode, static


class Policy(Protocol):
    """Decides on the next action."""

    def __call__(self, key: Array, problem: Problem, belief: Belief, observation: Observation) -> Decision:
        """Decide on the next action.

        Args:
          key: PRNG key of the planner.
          problem: constants of the search.
          belief: belief about the target after the observation.
          observation: the present observation.
        """
        ...


class PolicyFactory(Protocol):
    """Makes a policy."""

    def __call__(
        self,
        config: PlannerConfig | None = None,
        *,
        push_model: PushModel | None = None,
        later_push_model: PushModel | None = None,
        tries: bool = False,
    ) -> Policy:
        """Make a policy; it may ignore arguments that it does not need.

        Args:
          config: settings of the planner.
          push_model: predicts pushes; default: the learned model.
          later_push_model: predicts pushes after the first action of a sequence; default: `push_model`.
          tries: whether decisions hold alternatives for trials; see `trials`.
        """
        ...


class Plan(Protocol):
    """Plans with the engine's slots; static under jit."""

    def __call__(self, rollout: Rollout, key: Array, objects: Superquadrics) -> Decision:
        """Decide on the next action; see `rollout.plan`."""
        ...


class PlanningPolicy(PyTreeNode):
    """The engine as a `Policy`: takes a found target out as soon as a grasp hits nothing, and otherwise plans.

    After trials a grasp that fails there is not made; see `trials.choose`.

    It also implements `trials.TwoStagePolicy`.

    Attributes:
      config: settings of the planner.
      weigh, predict, objective, propose: the slots; static.
      plan: plans with the slots; static.
      tries: whether decisions hold alternatives for trials; static. The action does not depend on it: a grasp must hit
        nothing. But `cost` and `sequences` are then those of the plan, for where no grasp succeeds in its trial.
        `config.retrieval_contact` says whether grasps that hit something are among the alternatives.
    """

    config: PlannerConfig
    weigh: ObjectWeights = static()
    predict: Predict = static()
    objective: Objective = static()
    propose: Propose = static(default=weighted_draw)
    plan: Plan = static(default=plan)
    tries: bool = static(default=False)

    def rollout(self, problem: Problem, belief: Belief) -> Rollout:
        """The engine with this policy's slots."""
        return Rollout(problem, belief, self.config, self.weigh, self.predict, self.objective, self.propose)

    @property
    def grasps(self) -> CachedJit:
        """Ranks the grasps of a found target: `retrieval.top_grasps` where grasps are tried, else `best_grasp`."""
        return top_grasps if self.tries else best_grasp

    @property
    def farther(self) -> PlanningPolicy:
        """The policy for where no action gains anything: it looks one action farther ahead, and draws guided by what
        is in the way of any action on an object, though others are possible. A program of its own."""
        weigh = farther_weights if self.weigh is sampling_weights else self.weigh
        return self.replace(config=dataclasses.replace(self.config, horizon=self.config.horizon + 1), weigh=weigh)

    @property
    def _planning(self) -> PlanningPolicy:
        """The policy with the usual `tries` and `retrieval_contact`, on which a plan does not depend: compiled once."""
        return self.replace(tries=False, config=dataclasses.replace(self.config, retrieval_contact=True))

    def _planned_with(self, problem: Problem, belief: Belief) -> tuple[Problem, Belief]:
        """The problem and the belief that a plan is compiled for: outside of transformations separate, smaller programs
        for a target that is hidden, and for one that is found and that actions leave where it is."""
        if isinstance(belief.found, Tracer) or jnp.ndim(belief.found) > 0:
            return problem, belief
        if not belief.found:
            return problem, without_grasps(belief)
        return (problem, belief) if self.config.move_target else without_candidates(problem, belief)

    @property
    def _in_parts(self) -> bool:
        """Whether a plan is several programs, of which those that take longest to compile are the same for a hidden and
        for a found target. On a GPU, where starting programs costs more, it is one."""
        return self.plan is plan and on_cpu()

    @in_own_settings
    def programs(
        self, key: Array, problem: Problem, belief: Belief, observation: Observation
    ) -> list[tuple[CachedJit, tuple[Any, ...]]]:
        """The programs of a plan and their arguments, of which some are shapes, the longest first."""
        policy, (problem, belief) = self._planning, self._planned_with(problem, belief)
        objects = observation.with_boxes().objects
        if not self._in_parts:
            return [(_plan, (policy, key, problem, belief, objects))]
        rollout = policy.rollout(problem, belief)
        begun, weights, drawn = shapes_of_parts(rollout, key, objects)
        root = begun.state
        return [
            (first_draws, rollout.drawing(root, begun, weights)),
            (candidates_of, (*without_poses(problem, root), begun.possible)),
            (_begun, (policy, key, problem, belief, objects)),
            (_decided, (policy, problem, belief, root, begun.later, drawn)),
            (_weights, (policy, problem, belief, root)),
        ]

    @in_own_settings
    def __call__(self, key: Array, problem: Problem, belief: Belief, observation: Observation) -> Decision:
        """See `Policy`."""
        if not isinstance(belief.found, Tracer) and not belief.found:
            # Outside of transformations, grasps of a target that is not found are neither computed nor compiled.
            return self.planned(key, problem, belief, observation)
        grasp = self.retrieval(key, problem, belief, observation)
        able = grasp.action.kind == ActionKind.RETRIEVE
        # The belief may be concrete while the observation is traced.
        seen = observation
        if not self.tries:
            # The belief may be concrete while the observation is traced.
            if not isinstance(able, Tracer):
                return grasp if able else self.planned(key, problem, belief, observation)
            # Both are computed, but the one that does not count has next to nothing to do. Under `vmap`, a `cond` would
            # give every scene of a batch its own problem, and what they share could no longer be computed together.
            objects = observation.objects
            seen = observation.replace(objects=objects.replace(valid=objects.valid & ~able))
            belief = belief.replace(exists=belief.exists & ~able, found=belief.found & ~able)
        planned = _grasps_first(grasp, self.planned(key, problem, belief, seen))
        if self.tries:
            # Where no grasp succeeds in its trial, the plan counts.
            grasp = grasp.replace(alternatives=planned.alternatives, sequences=planned.sequences, cost=planned.cost)
        return jax.tree.map(lambda a, b: jnp.where(able, a, b), grasp, planned)

    @in_own_settings
    def retrieval(self, key: Array, problem: Problem, belief: Belief, observation: Observation) -> Decision:
        """Decide whether to take out a found target: an action of kind RETRIEVE, or else of kind NONE.

        Args:
          key, problem, belief, observation: as of a `Policy`; the key is not used.
        """
        observation = observation.with_boxes()
        # Without a traced `found` the call is the same as elsewhere, so that nothing is compiled twice.
        active = (belief.found,) if isinstance(belief.found, Tracer) else ()
        unmeasured = {} if observation.measured is None else {"space": _space(problem, belief)}
        grasp = self.grasps(problem.target_grasps, observation.objects, belief.found_pose, *active, **unmeasured)
        return _retrieval(self, belief, observation.objects, grasp)

    @in_own_settings
    def planned(self, key: Array, problem: Problem, belief: Belief, observation: Observation) -> Decision:
        """Plan as if no grasp could take the target out.

        Args:
          key, problem, belief, observation: as of a `Policy`.
        """
        observation = observation.with_boxes()
        run = _plan_in_parts if self._in_parts else _plan
        decision = run(self._planning, key, *self._planned_with(problem, belief), observation.objects)
        if not self.tries:
            return decision
        reached = np.float32(self.objective.reached)
        return decision.replace(alternatives=sequences_to_try(decision.sequences, observation.objects, reached))


def _grasps_first(grasp: Decision, planned: Decision) -> Decision:
    """The planned decision, with grasps of the target before its own alternatives."""
    if grasp.alternatives is None or planned.alternatives is None:
        return planned
    return planned.replace(alternatives=concatenate(grasp.alternatives, planned.alternatives))


@cached_jit()
def _space(problem: Problem, belief: Belief) -> PossibleSpace:
    return possible_space(problem, belief, belief.exists)


@cached_jit()
def _plan(policy: PlanningPolicy, key: Array, problem: Problem, belief: Belief, objects: Superquadrics) -> Decision:
    # Of the objects alone: how sure they are, and what was measured, would make programs of their own.
    return policy.plan(policy.rollout(problem, belief), key, objects)


def _plan_in_parts(
    policy: PlanningPolicy, key: Array, problem: Problem, belief: Belief, objects: Superquadrics
) -> Decision:
    """`rollout.plan`, of several programs."""
    begun = _begun(policy, key, problem, belief, objects)
    root = begun.state.replace(candidates=candidates_of(*without_poses(problem, begun.state), begun.possible))
    weights = _weights(policy, problem, belief, root)
    drawn = first_draws(*policy.rollout(problem, belief).drawing(root, begun, weights))
    return _decided(policy, problem, belief, root, begun.later, drawn)


@cached_jit()
def _begun(policy: PlanningPolicy, key: Array, problem: Problem, belief: Belief, objects: Superquadrics) -> Begun:
    return begin(policy.rollout(problem, belief), key, objects)


@cached_jit()
def _weights(policy: PlanningPolicy, problem: Problem, belief: Belief, root: State) -> Float[Array, " n"]:
    return policy.rollout(problem, belief).weights(root)


@cached_jit()
def _decided(
    policy: PlanningPolicy, problem: Problem, belief: Belief, root: State, later: Array, drawn: Drawn
) -> Decision:
    return decide(policy.rollout(problem, belief), root, later, drawn)


@cached_jit()
def _retrieval(policy: PlanningPolicy, belief: Belief, objects: Superquadrics, grasp: GraspChoice) -> Decision:
    """The decision to take a found target out with a grasp (the first if there are several) if it hits nothing."""
    reached, alternatives = policy.objective.reached, None
    if policy.tries:
        allowed = grasp.feasible if policy.config.retrieval_contact else grasp.success
        alternatives = grasps_to_try(grasp.action, allowed & belief.found, objects, reached)
        grasp = jax.tree.map(lambda a: a[0], grasp)
    able = belief.found & grasp.success
    return Decision(
        action=jax.tree.map(lambda a, b: jnp.where(able, a, b), grasp.action, no_action()),
        value=jnp.where(able, 0.0, jnp.inf),
        cost=jnp.float32(reached),
        predicted_cost=jnp.float32(jnp.nan),
        predicted=objects,
        sequences=no_sequences(policy.config, objects),
        refused=jnp.int32(0),
        alternatives=alternatives,
    )


def _planner_config(config: PlannerConfig | None) -> PlannerConfig:
    """The configuration, or the default.

    Raises:
      InputError: it is of another type, such as a whole preset.
    """
    if config is not None and not isinstance(config, PlannerConfig):
        raise InputError(f"config: is a {type(config).__name__}; give a PlannerConfig, such as paper().planner")
    return config or PlannerConfig()


def planning_policy(
    config: PlannerConfig | None = None,
    *,
    push_model: PushModel | None = None,
    later_push_model: PushModel | None = None,
    tries: bool = False,
    objective: Objective,
    weigh: ObjectWeights = sampling_weights,
    **changes: Any,
) -> PlanningPolicy:
    """The engine with slots; see `PolicyFactory` for the first arguments.

    Args:
      config: settings of the planner; default: `PlannerConfig()`.
      push_model, later_push_model: predict pushes.
      tries: whether decisions hold alternatives for trials.
      objective: the cost that plans minimise.
      weigh: weighs the objects of a state for the draws of actions.
      **changes: fields of `config` to replace.

    Raises:
      InputError: a setting is impossible, or weights are missing or damaged.
    """
    push_model = push_model or own_push_model("learned")
    config = dataclasses.replace(_planner_config(config), **changes)
    predict = PredictByKind(push_model, later_push_model or push_model)
    return PlanningPolicy(config, weigh, predict, objective, tries=tries)


# Minimises f and g together while it searches (equation 2).
search_for_grasp = functools.partial(planning_policy, objective=SearchForGrasp())
# Minimises f until the target is found, and then g.
search_and_grasp = functools.partial(planning_policy, objective=SearchAndGrasp())


def random_action(config: PlannerConfig | None = None, **slots: Any) -> PlanningPolicy:
    """A baseline: a random possible action, by an even draw, until the target can be taken out.

    It does not plan ahead and does not move a found target: of `config`, the horizon, `move_target`, the guided
    fraction and all penalties are ignored.
    """
    even = dataclasses.replace(
        _planner_config(config),
        horizon=1,
        move_target=False,
        guided_fraction=0.0,
        unseen_contact_penalty=0.0,
    )
    return planning_policy(even, objective=Indifferent(), **slots)


def greedy(config: PlannerConfig | None = None, **slots: Any) -> PlanningPolicy:
    """A baseline: the action that reduces f most, as lateral-access X-RAY reduces the area where the target can be.

    Once the target is found: the action that brings it nearest to a free grasp.

    One step on the first term of J, and on the second at a found target: X-RAY's suction cup needs no free grasp. Draws
    are even, and only J counts: of `config`, the horizon, the guided fraction, the crowding weight and all penalties
    are ignored.
    """
    plain = dataclasses.replace(
        _planner_config(config),
        horizon=1,
        guided_fraction=0.0,
        crowding_weight=0.0,
        unseen_contact_penalty=0.0,
    )
    return search_and_grasp(plain, **slots)


POLICIES: Mapping[str, PolicyFactory] = {
    "search-for-grasp": search_for_grasp,
    "search-and-grasp": search_and_grasp,
    "random": random_action,
    "greedy": greedy,
}


def policy_factory(name: str) -> PolicyFactory:
    """The factory of a policy, by a name in `POLICIES` or an import path such as "my_lab.policies:Mine".

    Raises:
      InputError: the name is unknown, or the path cannot be imported.
    """
    if name in POLICIES:
        return POLICIES[name]
    module, colon, attribute = name.partition(":")
    if not (colon and module and attribute):
        raise InputError(
            f'policy "{name}" is unknown; use {", ".join(POLICIES)}, or an import path such as my_lab.policies:Mine'
        )
    try:
        factory = functools.reduce(getattr, attribute.split("."), importlib.import_module(module))
    except Exception as error:
        reason = " ".join(str(error).split())
        raise InputError(f'policy "{name}" cannot be imported ({type(error).__name__}: {reason})') from error
    if not callable(factory):
        raise InputError(f'policy "{name}" is not callable; name a function or a class that makes a policy')
    return factory
