"""Policies: what decides on the next action. Each is a partial application of one engine to slots of its own.

A policy is a callable `(key, problem, belief, observation) -> Decision`. Those that are made here are pytrees, too:
what is continuous in their configuration is data, so that a jitted function takes them as arguments.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import flax.struct
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array

from mechsearch_jax.actions.kinds.nothing import no_action
from mechsearch_jax.actions.registry import ActionKind
from mechsearch_jax.belief.belief import Belief, without_grasps
from mechsearch_jax.config.config import PlannerConfig
from mechsearch_jax.dynamics.named import own_push_model
from mechsearch_jax.dynamics.push_model import PushModel
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner.imitation import IMITATIONS, Slots
from mechsearch_jax.planner.objective import Indifferent, Objective, SearchAndGrasp, SearchForGrasp
from mechsearch_jax.planner.prediction import Predict, PredictByKind
from mechsearch_jax.planner.proposal import DrawnIn, Propose, as_predicted, guided_draw
from mechsearch_jax.planner.rollout import Rollout, no_sequences, plan
from mechsearch_jax.planner.state import Decision
from mechsearch_jax.planner.trials import grasps_to_try, in_turn, sequences_to_try
from mechsearch_jax.problem.problem import Problem
from mechsearch_jax.retrieval import GraspChoice, best_grasp, worth_trying
from mechsearch_jax.runtime.compiled import kept
from mechsearch_jax.runtime.errors import InputError


class Policy(Protocol):
    """Decides on the next action."""

    def __call__(self, key: Array, problem: Problem, belief: Belief, observation: Observation) -> Decision:
        """The next action, and why.

        Args:
          key: PRNG key of the planner.
          problem: what does not change.
          belief: what is known of the target, after the observation.
          observation: what is seen now.
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
        """A policy with a configuration and models, of which it may take what it likes.

        Args:
          config: how it decides.
          push_model: predicts pushes; the learned one if left out.
          later_push_model: predicts those that are not the first action of a sequence; `push_model` if left out.
          tries: whether its decisions are to hold what is worth trying out; see `trials`.
        """
        ...


class Plan(Protocol):
    """Plans with the engine's slots; static under jit."""

    def __call__(self, rollout: Rollout, key: Array, objects: Superquadrics) -> Decision:
        """The next action, as `rollout.plan` tells it."""
        ...


class PlanningPolicy(flax.struct.PyTreeNode):
    """The engine as a `Policy`: takes a found target out as soon as a grasp will do, and else plans.

    It also is a policy that `trials.AsksTwice`.

    Attributes:
      config: how it decides.
      propose, predict, objective, drawn_in: the slots; static.
      plan: how it plans with them; static.
      tries: whether its decisions hold what is worth trying out; static. What it decides does not depend on that: a
        grasp has to hit nothing, unless `trials.choose` finds one that succeeds.
    """

    config: PlannerConfig
    propose: Propose = flax.struct.field(pytree_node=False)
    predict: Predict = flax.struct.field(pytree_node=False)
    objective: Objective = flax.struct.field(pytree_node=False)
    drawn_in: DrawnIn = flax.struct.field(pytree_node=False, default=as_predicted)
    plan: Plan = flax.struct.field(pytree_node=False, default=plan)
    tries: bool = flax.struct.field(pytree_node=False, default=False)

    def rollout(self, problem: Problem, belief: Belief) -> Rollout:
        """The engine with this policy's slots, for what is known."""
        return Rollout(problem, belief, self.config, self.propose, self.predict, self.objective, self.drawn_in)

    @property
    def _planning(self) -> PlanningPolicy:
        """What a plan depends on: it is the same, and compiled once, whether or not anything is tried out."""
        return self.replace(tries=False)

    def begin(
        self, key: Array, problem: Problem, belief: Belief, observation: Observation
    ) -> Callable[[], None] | None:
        """Lower what a plan with such arguments needs, without planning; see `runtime.compiled.Kept.begin`."""
        return _plan.begin(self._planning, key, problem, _as_known(belief), observation)

    def is_ready(self, key: Array, problem: Problem, belief: Belief, observation: Observation) -> bool:
        """Whether nothing has to be compiled for a plan with such arguments; see `runtime.compiled.Kept.is_ready`."""
        return _plan.is_ready(self._planning, key, problem, _as_known(belief), observation)

    def __call__(self, key: Array, problem: Problem, belief: Belief, observation: Observation) -> Decision:
        """See `Policy`."""
        if not isinstance(belief.found, Tracer) and not belief.found:
            # Outside of any transformation, what is not needed is neither computed nor compiled.
            return self.planned(key, problem, belief, observation)
        grasp = self.retrieval(key, problem, belief, observation)
        able = grasp.action.kind == ActionKind.RETRIEVE
        # The belief may be known where the observation is traced.
        if not isinstance(able, Tracer):
            if able:
                return grasp
            return _grasps_first(grasp, self.planned(key, problem, belief, observation))
        # Both are computed, each with next to nothing to do where it does not count. A `cond` would under `vmap` give
        # every scene of a batch a problem of its own, and what they share could no longer be computed together.
        rest = observation.objects.replace(valid=observation.objects.valid & ~able)
        planned = self.planned(
            key,
            problem,
            belief.replace(exists=belief.exists & ~able, found=belief.found & ~able),
            observation.replace(objects=rest),
        )
        if planned.alternatives is not None:
            # What is planned for a target that is taken out has no objects.
            planned = planned.replace(alternatives=planned.alternatives.replace(now=observation.objects))
        both = _grasps_first(grasp, planned)
        grasp = grasp.replace(alternatives=both.alternatives)
        return jax.tree.map(lambda a, b: jnp.where(able, a, b), grasp, both)

    def retrieval(self, key: Array, problem: Problem, belief: Belief, observation: Observation) -> Decision:
        """Whether to take the target out where it is found: an action of kind RETRIEVE, or else of kind NONE.

        Args:
          key, problem, belief, observation: as of a `Policy`; the key is not used.
        """
        # Called the same as elsewhere where the target is known to be found, so that nothing is compiled twice.
        active = (belief.found,) if isinstance(belief.found, Tracer) else ()
        look = worth_trying if self.tries else best_grasp
        grasp = look(problem.target_grasps, observation.objects, belief.found_pose, *active)
        return _retrieval(self, belief, observation, grasp)

    def planned(self, key: Array, problem: Problem, belief: Belief, observation: Observation) -> Decision:
        """What is planned, as if no grasp would do.

        Args:
          key, problem, belief, observation: as of a `Policy`.
        """
        decision = _plan(self._planning, key, problem, _as_known(belief), observation)
        if not self.tries:
            return decision
        reached = jnp.float32(self.objective.reached)
        return decision.replace(alternatives=sequences_to_try(decision.sequences, observation.objects, reached))


def _as_known(belief: Belief) -> Belief:
    """The belief as a plan takes it: for a target that is known not to be found there is a program of its own."""
    hidden = not isinstance(belief.found, Tracer) and jnp.ndim(belief.found) == 0 and not belief.found
    return without_grasps(belief) if hidden else belief


def _grasps_first(grasp: Decision, planned: Decision) -> Decision:
    """What is planned, where grasps of the target may be tried before."""
    if grasp.alternatives is None or planned.alternatives is None:
        return planned
    return planned.replace(alternatives=in_turn(grasp.alternatives, planned.alternatives))


@kept()
def _plan(policy: PlanningPolicy, key: Array, problem: Problem, belief: Belief, observation: Observation) -> Decision:
    return policy.plan(policy.rollout(problem, belief), key, observation.objects)


@kept()
def _retrieval(policy: PlanningPolicy, belief: Belief, observation: Observation, grasp: GraspChoice) -> Decision:
    """The decision to take a found target out with a grasp, or the first of several, that hits nothing."""
    reached, objects = policy.objective.reached, observation.objects
    alternatives = None
    if policy.tries:
        alternatives = grasps_to_try(grasp.action, grasp.feasible & belief.found, objects, reached)
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
      InputError: it is something else, such as a whole preset.
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
    propose: Propose = guided_draw,
    **changes: Any,
) -> PlanningPolicy:
    """The engine with slots; see `PolicyFactory` for the first arguments.

    Args:
      config: how it decides; the defaults if left out.
      push_model, later_push_model: predict pushes.
      tries: whether decisions hold what is worth trying out.
      objective: what it makes small.
      propose: samples an action in a state.
      **changes: fields of `config` that are to be different.

    Raises:
      InputError: a setting is impossible, or weights are missing or damaged.
    """
    push_model = push_model or own_push_model("learned")
    config = dataclasses.replace(_planner_config(config), **changes)
    slots = Slots(propose, PredictByKind(push_model, later_push_model or push_model), objective)
    return PlanningPolicy(config=config, tries=tries, **IMITATIONS[config.imitates](slots)._asdict())


# Minds the grasp while it searches: f and g together (equation 2).
search_for_grasp = functools.partial(planning_policy, objective=SearchForGrasp())
# First finds the target, and then clears the way to it.
search_and_grasp = functools.partial(planning_policy, objective=SearchAndGrasp())


def random_action(config: PlannerConfig | None = None, **slots: Any) -> PlanningPolicy:
    """A baseline: a random possible action, by the sampler's even draw, until the target can be taken out.

    It plans no further, and leaves a found target where it is: of `config`, the horizon, `move_target`, the guided
    fraction and all penalties are not used.
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
    """A baseline: the one action that leaves the least of f, as lateral-access X-RAY reduces the area where the target
    can be; once the target is found, the one that brings it nearest to a free grasp.

    One step of the first term of J, and of the second at a found target: X-RAY's suction cup needs no free grasp. Draws
    are even, and nothing but J counts: of `config`, the horizon, the guided fraction, the crowding weight and all
    penalties are not used.
    """
    plain = dataclasses.replace(
        _planner_config(config),
        horizon=1,
        guided_fraction=0.0,
        crowding_weight=0.0,
        unseen_contact_penalty=0.0,
    )
    return search_and_grasp(plain, **slots)


def mctx(config: PlannerConfig | None = None, **slots: Any) -> PlanningPolicy:
    """A baseline: Monte-Carlo tree search with the library `mctx` on the cost of `search_for_grasp`; see `tree_search`.

    Raises:
      InputError: `mctx` is not installed.
    """
    # Not everybody has it, and it takes time to import.
    from mechsearch_jax.planner.tree_search import import_mctx, tree_plan

    import_mctx()
    return search_for_grasp(config, **slots).replace(plan=tree_plan)


POLICIES: Mapping[str, PolicyFactory] = {
    "search-for-grasp": search_for_grasp,
    "search-and-grasp": search_and_grasp,
    "random": random_action,
    "greedy": greedy,
    "mctx": mctx,
}


def policy_factory(name: str) -> PolicyFactory:
    """What makes the policy of a name, one of `POLICIES` or an import path such as "my_lab.policies:Mine".

    Raises:
      InputError: there is none of that name, or it cannot be imported.
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
