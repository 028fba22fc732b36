"""Planning: from an observation and a belief to the next action."""

from mechsearch_jax.belief.belief import Belief, graspability_map, initial_belief, update_belief
from mechsearch_jax.config.config import OPTIONS, Config, Option, PlannerConfig, ProblemConfig
from mechsearch_jax.config.presets import (
    DEFAULT_PRESET,
    PRESETS,
    action_set,
    expanded,
    paper,
    standard,
)
from mechsearch_jax.planner.policies import (
    POLICIES,
    PlanningPolicy,
    Policy,
    PolicyFactory,
    greedy,
    planning_policy,
    policy_factory,
    random_action,
    search_and_grasp,
    search_for_grasp,
)
from mechsearch_jax.planner.state import Decision, Sequences
from mechsearch_jax.problem.problem import Problem, build_problem

__all__ = [
    "DEFAULT_PRESET",
    "OPTIONS",
    "POLICIES",
    "PRESETS",
    "Belief",
    "Config",
    "Decision",
    "Option",
    "PlannerConfig",
    "PlanningPolicy",
    "Policy",
    "PolicyFactory",
    "Problem",
    "ProblemConfig",
    "Sequences",
    "action_set",
    "build_problem",
    "expanded",
    "graspability_map",
    "greedy",
    "initial_belief",
    "paper",
    "planning_policy",
    "policy_factory",
    "random_action",
    "search_and_grasp",
    "search_for_grasp",
    "standard",
    "update_belief",
]
