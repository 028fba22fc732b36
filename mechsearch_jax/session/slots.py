"""The policy of a searcher: a given one, or search-for-grasp with given models."""

from __future__ import annotations

from typing import Any

from mechsearch_jax.config.config import Config
from mechsearch_jax.dynamics.named import own_push_model
from mechsearch_jax.planner.learning import LearnsFriction
from mechsearch_jax.planner.policies import PlanningPolicy, Policy, search_for_grasp
from mechsearch_jax.planner.trials import Trials
from mechsearch_jax.runtime.errors import InputError

# The notice where no action is tried in physics.
UNTRIED = (
    "rehearsal: no action is tried out before it is made, so that less is found and retrieved than the results say; "
    "envs.cell.loading.load_searcher, or rehearsal=NativeTrials(), tries them in simulation"
)


def tries_nothing(policy: Policy, trials: Trials | None) -> bool:
    """Whether no action of a search-for-grasp policy is tried in physics; False for other policies, which may try."""
    return isinstance(policy, PlanningPolicy) and (trials is None or not policy.tries)


def filled(policy: Policy | None, config: Config, trials: Trials | None, slots: dict[str, Any]) -> Policy:
    """The given policy, or search-for-grasp with the given models.

    Raises:
      InputError: a push model is given together with a policy, a rehearsal is given with a policy that proposes no
        trials, the configuration names a model or rehearsal that is not given, or one that learns is named and another
        given.
    """
    given = [name for name, value in slots.items() if value is not None]
    if config.rehearsal == "learning" and trials is not None and not isinstance(trials, LearnsFriction):
        raise InputError(
            'Searcher: config names the rehearsal "learning", and one that learns nothing is given; give '
            'rehearsal=LearningTrials() (envs.trials.learning), or a config with rehearsal="physics"'
        )
    if policy is not None:
        if given:
            raise InputError(
                f"Searcher: {' and '.join(given)} would have no effect beside a policy, which has its own; give it the "
                f"{given[0]} when it is made, and leave the keyword out"
            )
        if trials is not None and isinstance(policy, PlanningPolicy) and not policy.tries:
            raise InputError(
                "Searcher: rehearsal would have no effect, for the policy proposes nothing to be tried; make it with "
                "tries=True"
            )
        return policy
    if config.rehearsal != "none" and trials is None:
        kind, module = ("LearningTrials", "learning") if config.rehearsal == "learning" else ("NativeTrials", "native")
        raise InputError(
            f'Searcher: config names the rehearsal "{config.rehearsal}", and none is given; use '
            f"mechsearch_jax.envs.cell.loading.load_searcher, give rehearsal={kind}() (envs.trials.{module}), or a "
            'config with rehearsal="none"'
        )
    if slots["push_model"] is None:
        if config.push_model == "physics":
            raise InputError(
                'Searcher: config names the push model "physics", and none is given; use '
                'mechsearch_jax.envs.cell.loading.load_searcher, give push_model, or a config with push_model="learned"'
            )
        slots = {**slots, "push_model": own_push_model(config.push_model)}
    elif config.push_model == "quasi-static":
        raise InputError(
            'Searcher: config names the push model "quasi-static", and another is given; leave out one of them'
        )
    return search_for_grasp(config.planner, tries=trials is not None, **slots)
