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

from mechsearch_jax.compiled import kept
from mechsearch_jax.dynamics.named import own_push_model
from mechsearch_jax.dynamics.push_model import PushModel
from mechsearch_jax.errors import InputError
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner.belief import Belief
from mechsearch_jax.planner.config import PlannerConfig
from mechsearch_jax.planner.imitation import IMITATIONS, Slots
from mechsearch_jax.planner.objective import Indifferent, Objective, SearchAndGrasp, SearchForGrasp
from mechsearch_jax.planner.prediction import Predict, PredictByKind
from mechsearch_jax.planner.problem import Problem
from mechsearch_jax.planner.proposal import Propose, guided_draw
from mechsearch_jax.planner.rehearsal import Rehearsal, rehearsed
from mechsearch_jax.planner.retrieval import GraspChoice, take_out
from mechsearch_jax.planner.rollout import Rollout, no_sequences, plan
from mechsearch_jax.planner.state import Decision


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
        rehearsal: Rehearsal | None = None,
    ) -> Policy:
        """A policy with a configuration and models, of which it may take what it likes.

        Args:
          config: how it decides.
          push_model: predicts pushes; the learned one if left out.
          later_push_model: predicts those that are not the first action of a sequence; `push_model` if left out.
          rehearsal: tries actions out before one is made; if left out, nothing does.
        """
        ...


class Plan(Protocol):
    """Plans with the engine's slots; static under jit."""

    def __call__(self, rollout: Rollout, key: Array, objects: Superquadrics) -> Decision:
        """The next action, as `rollout.plan` tells it."""
        ...


class Search(flax.struct.PyTreeNode):
    """The engine as a `Policy`: takes a found target out as soon as a grasp will do, and else plans.

    Attributes:
      config: how it decides.
      propose, predict, objective: the slots; static.
      plan: how it plans with them; static.
      rehearsal: tries actions out before one is made; static. None where nothing does: a grasp then has to hit nothing.
    """

    config: PlannerConfig
    propose: Propose = flax.struct.field(pytree_node=False)
    predict: Predict = flax.struct.field(pytree_node=False)
    objective: Objective = flax.struct.field(pytree_node=False)
    plan: Plan = flax.struct.field(pytree_node=False, default=plan)
    rehearsal: Rehearsal | None = flax.struct.field(pytree_node=False, default=None)

    @property
    def _planning(self) -> Search:
        """What a plan depends on: it is the same, and compiled once, whatever tries it out."""
        return self.replace(rehearsal=None)

    def begin(
        self, key: Array, problem: Problem, belief: Belief, observation: Observation
    ) -> Callable[[], None] | None:
        """Lower what a plan with such arguments needs, without planning; see `compiled.Kept.begin`."""
        return _plan.begin(self._planning, key, problem, belief, observation)

    def is_ready(self, key: Array, problem: Problem, belief: Belief, observation: Observation) -> bool:
        """Whether nothing has to be compiled for a plan with such arguments; see `compiled.Kept.is_ready`."""
        return _plan.is_ready(self._planning, key, problem, belief, observation)

    def __call__(self, key: Array, problem: Problem, belief: Belief, observation: Observation) -> Decision:
        """See `Policy`."""
        if not isinstance(belief.found, Tracer):
            # Outside of any transformation, what is not needed is neither computed nor compiled.
            if not belief.found:
                return self._searched(key, problem, belief, observation)
            grasp = take_out(self.rehearsal, problem, observation.objects, belief.found_pose)
            # The belief may be known where the observation is traced.
            if not isinstance(grasp.success, Tracer):
                if not grasp.success:
                    return self._searched(key, problem, belief, observation)
                return _take_out(self._planning, observation, grasp)
        # Both are computed, each with next to nothing to do where it does not count. A `cond` would under `vmap` give
        # every scene of a batch a problem of its own, and what they share could no longer be computed together.
        grasp = take_out(self.rehearsal, problem, observation.objects, belief.found_pose, belief.found)
        able = belief.found & grasp.success
        rest = observation.objects.replace(valid=observation.objects.valid & ~able)
        planned = self._searched(
            key,
            problem,
            belief.replace(exists=belief.exists & ~able, found=belief.found & ~able),
            observation.replace(objects=rest),
        )
        return jax.tree.map(lambda a, b: jnp.where(able, a, b), _take_out(self._planning, observation, grasp), planned)

    def _searched(self, key: Array, problem: Problem, belief: Belief, observation: Observation) -> Decision:
        """What is planned, tried out if anything does."""
        decision = _plan(self._planning, key, problem, belief, observation)
        if self.rehearsal is None:
            return decision
        return rehearsed(self.rehearsal, problem, observation.objects, belief.found_pose, belief.found, decision)


@kept()
def _plan(search: Search, key: Array, problem: Problem, belief: Belief, observation: Observation) -> Decision:
    rollout = Rollout(problem, belief, search.config, search.propose, search.predict, search.objective)
    return search.plan(rollout, key, observation.objects)


@kept()
def _take_out(search: Search, observation: Observation, grasp: GraspChoice) -> Decision:
    return Decision(
        action=grasp.action,
        value=jnp.float32(0.0),
        cost=jnp.float32(search.objective.reached),
        predicted_cost=jnp.float32(jnp.nan),
        predicted=observation.objects,
        sequences=no_sequences(search.config, observation.objects),
        refused=jnp.int32(0),
    )


def _planner_config(config: PlannerConfig | None) -> PlannerConfig:
    """The configuration, or the default.

    Raises:
      InputError: it is something else, such as a whole preset.
    """
    if config is not None and not isinstance(config, PlannerConfig):
        raise InputError(f"config: is a {type(config).__name__}; give a PlannerConfig, such as paper().planner")
    return config or PlannerConfig()


def search(
    config: PlannerConfig | None = None,
    *,
    push_model: PushModel | None = None,
    later_push_model: PushModel | None = None,
    rehearsal: Rehearsal | None = None,
    objective: Objective,
    propose: Propose = guided_draw,
    **changes: Any,
) -> Search:
    """The engine with slots; see `PolicyFactory` for the first arguments.

    Args:
      config: how it decides; the defaults if left out.
      push_model, later_push_model: predict pushes.
      rehearsal: tries actions out before one is made.
      objective: what it makes small.
      propose: samples an action in a state.
      **changes: fields of `config` that are to be different.

    Raises:
      InputError: a setting is impossible, or weights are missing or damaged.
    """
    push_model = push_model or own_push_model("learned")
    config = dataclasses.replace(_planner_config(config), **changes)
    slots = Slots(propose, PredictByKind(push_model, later_push_model or push_model), objective)
    return Search(config=config, rehearsal=rehearsal, **IMITATIONS[config.imitates](slots)._asdict())


# Minds the grasp while it searches: f and g together (equation 2).
search_for_grasp = functools.partial(search, objective=SearchForGrasp())
# First finds the target, and then clears the way to it.
search_and_grasp = functools.partial(search, objective=SearchAndGrasp())


def random_action(config: PlannerConfig | None = None, **options: Any) -> Search:
    """A baseline: a random possible action, by the sampler's even draw, until the target can be taken out.

    It plans no further, and leaves a found target where it is: of `config`, the horizon, `move_target`, the guided
    fraction and all charges are not used.
    """
    even = dataclasses.replace(
        _planner_config(config),
        horizon=1,
        move_target=False,
        guided_fraction=0.0,
        unseen_contact_penalty=0.0,
    )
    return search(even, objective=Indifferent(), **options)


def greedy(config: PlannerConfig | None = None, **options: Any) -> Search:
    """A baseline: the one action that leaves the least of f, as lateral-access X-RAY reduces the area where the target
    can be; once the target is found, the one that brings it nearest to a free grasp.

    One step of the first term of J, and of the second at a found target: X-RAY's suction cup needs no free grasp. Draws
    are even, and nothing but J counts: of `config`, the horizon, the guided fraction, the crowding weight and all
    charges are not used.
    """
    plain = dataclasses.replace(
        _planner_config(config),
        horizon=1,
        guided_fraction=0.0,
        crowding_weight=0.0,
        unseen_contact_penalty=0.0,
    )
    return search_and_grasp(plain, **options)


def mctx(config: PlannerConfig | None = None, **options: Any) -> Search:
    """A baseline: Monte-Carlo tree search with the library `mctx` on the cost of `search_for_grasp`; see `tree_search`.

    Raises:
      InputError: `mctx` is not installed.
    """
    # Not everybody has it, and it takes time to import.
    from mechsearch_jax.planner.tree_search import import_mctx, tree_plan

    import_mctx()
    return search_for_grasp(config, **options).replace(plan=tree_plan)


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
