"""The policy and the trials of a searcher: given ones, or those that its configuration names."""

from __future__ import annotations

from mechsearch_jax.config.config import Config
from mechsearch_jax.dynamics.push_model import PushModel
from mechsearch_jax.planner.policies import PlanningPolicy, Policy, search_for_grasp
from mechsearch_jax.planner.trials import Trials
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.session import simulated
from mechsearch_jax.workspace.shelf import Shelf

# The notice where no action is tried in physics.
UNTRIED = (
    "trials: no action is tried out before it is made, so that less is found and retrieved than the results say; "
    'leave out trials="none", or make the policy with tries=True'
)


def tries_nothing(policy: Policy, trials: Trials | None) -> bool:
    """Whether no action of a search-for-grasp policy is tried in physics; False for other policies, which may try."""
    return isinstance(policy, PlanningPolicy) and (trials is None or not policy.tries)


def policy_and_trials(
    config: Config,
    shelf: Shelf,
    policy: Policy | None,
    trials: Trials | None,
    push_model: PushModel | None,
    later_push_model: PushModel | None,
) -> tuple[Policy, Trials | None]:
    """The given policy, or search-for-grasp, with the given models and trials, or those that the configuration names.

    A policy that proposes nothing to be tried has no trials, nor has a user's, unless they are given.

    Raises:
      InputError: a push model is given together with a policy, or beside another that the configuration names; trials
        are given with a policy that proposes none; or the configuration names trials that learn, and others are given.
    """
    models = {"push_model": push_model, "later_push_model": later_push_model}
    given = [name for name, model in models.items() if model is not None]
    if policy is not None:
        if given:
            raise InputError(
                f"Searcher: {' and '.join(given)} would have no effect beside a policy, which has its own; give it the "
                f"{given[0]} when it is made, and leave the keyword out"
            )
        if trials is not None and isinstance(policy, PlanningPolicy) and not policy.tries:
            raise InputError(
                "Searcher: trials would have no effect, for the policy proposes nothing to be tried; make it with "
                "tries=True"
            )
        proposes = isinstance(policy, PlanningPolicy) and policy.tries
        return policy, simulated.trials(config.trials) if trials is None and proposes else trials
    if trials is None:
        trials = simulated.trials(config.trials)
    if push_model is None:
        push_model, later = simulated.push_models(config.push_model, shelf)
        later_push_model = later if later_push_model is None else later_push_model
    elif config.push_model == "quasi-static":
        raise InputError(
            'Searcher: config names the push model "quasi-static", and another is given; leave out one of them'
        )
    return search_for_grasp(
        config.planner, tries=trials is not None, push_model=push_model, later_push_model=later_push_model
    ), trials
