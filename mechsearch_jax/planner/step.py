"""One step of a search: look, believe, propose, try, choose.

`believe`, `propose` and `trials.choose` are pure functions around trials, which run on the host. `decide` goes through
them in a single scene, for a `Searcher` and for an episode that runs alone; `envs.episode.many_slots` maps the same
functions over scenes, and tries what is proposed in all of them together.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from mechsearch_jax.actions.kinds.nothing import no_action
from mechsearch_jax.actions.registry import kind_of
from mechsearch_jax.actions.types import Action
from mechsearch_jax.belief.belief import Belief, initial_belief, update_belief
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner.state import Decision
from mechsearch_jax.planner.trials import (
    TrialResult,
    Trials,
    TriedActions,
    TwoStagePolicy,
    choose,
    nothing_tried,
    scenes_of,
    tried,
)
from mechsearch_jax.problem.problem import Problem
from mechsearch_jax.runtime.pytree import PyTreeNode

# Decisions that are drawn in one step, until one can be executed.
DRAWS = 4


class SearchState(PyTreeNode):
    """What a search knows between two looks.

    Attributes:
      belief: after the last look.
      observation: of the last look.
      action: what was done since, or attempted; of kind NONE if nothing.
    """

    belief: Belief
    observation: Observation
    action: Action


def unsearched(problem: Problem, observation: Observation) -> SearchState:
    """The state before the first look, at which `observation` is made."""
    return SearchState(initial_belief(problem), observation, no_action())


def believe(problem: Problem, state: SearchState, observation: Observation) -> SearchState:
    """The state after a look (equation 4), before anything is done."""
    belief = update_belief(problem, state.belief, observation, state.observation, state.action)
    return SearchState(belief, observation, no_action())


def propose(policy: Any, question: str, key: Array, problem: Problem, state: SearchState) -> Decision:
    """What a policy proposes.

    Args:
      policy: see `policies.Policy`.
      question: "__call__", or one of the questions of a `TwoStagePolicy`, "retrieval" and "planned".
      key: PRNG key.
      problem, state: of the search.
    """
    return getattr(policy, question)(key, problem, state.belief, state.observation)


class Decided(NamedTuple):
    """What a step comes to.

    Attributes:
      decision: after trials.
      tried: the actions that were tried out before it.
    """

    decision: Decision
    tried: TriedActions


def decide(
    policy: Any,
    trials: Trials | None,
    key: Array,
    problem: Problem,
    state: SearchState,
    *,
    last: bool = False,
    refusals: int = 0,
    executable: Callable[[Decision], bool] = lambda decision: True,
) -> Decided:
    """Decide for a single scene: the policy proposes, trials try, `choose` chooses. On the host.

    Of a `TwoStagePolicy` actions are planned, and planned actions tried, only if the target is not taken out. Where one
    cannot be executed, the next that succeeds in its trial is chosen; where none is left, others are drawn, `DRAWS`
    times in all. A retrieval is made in any case: its grasp does not depend on the key.

    Args:
      policy: see `policies.Policy`.
      trials: tries the alternatives; None for no trials.
      key: PRNG key.
      problem, state: of the search.
      last: whether no further action is allowed; see `choose`.
      refusals: number of calls with this key that led to no action: others are drawn.
      executable: whether a decision can be executed, such as by the arm.
    """

    def settled(decision: Decision) -> bool:
        return executable(decision) or kind_of(int(decision.action.kind)).takes_target

    for draw in range(DRAWS * refusals, DRAWS * (refusals + 1)):
        draw_key = jax.random.fold_in(key, draw) if draw else key
        decided, done = _decided(policy, trials, draw_key, problem, state, last, settled)
        if done:
            break
    return decided


def _decided(
    policy: Any,
    trials: Trials | None,
    key: Array,
    problem: Problem,
    state: SearchState,
    last: bool,
    settled: Callable[[Decision], bool],
) -> tuple[Decided, bool]:
    """What one draw comes to, and whether that is settled."""
    everything = nothing_tried()
    if trials is not None and isinstance(policy, TwoStagePolicy) and state.belief.found:
        decision = propose(policy, "retrieval", key, problem, state)
        decision, everything, _ = _tried_out(decision, trials, problem, state, last, lambda _: True)
        if kind_of(int(decision.action.kind)).takes_target:
            return Decided(decision, everything), settled(decision)
    question = "planned" if trials is not None and isinstance(policy, TwoStagePolicy) else "__call__"
    decision = propose(policy, question, key, problem, state)
    if trials is None:
        return Decided(decision, everything), settled(decision)
    decision, more, done = _tried_out(decision, trials, problem, state, last, settled)
    return Decided(decision, jax.tree.map(lambda *a: np.concatenate(a), everything, more)), done


def _tried_out(
    proposed: Decision,
    trials: Trials,
    problem: Problem,
    state: SearchState,
    last: bool,
    settled: Callable[[Decision], bool],
) -> tuple[Decision, TriedActions, bool]:
    """The first of the alternatives that succeeds in its trial and is settled, or else what `choose` makes of them."""
    if proposed.alternatives is None:
        return proposed, nothing_tried(), settled(proposed)
    scene = scenes_of(state.belief, state.observation), proposed.alternatives
    scenes, rows = jax.tree.map(lambda a: np.asarray(a)[None], jax.device_get(scene))
    wanted, results = rows.worth, np.zeros(rows.worth.shape, np.int32)
    while True:
        results = np.where(wanted, trials(problem, scenes, rows.actions, wanted), results)
        decision = choose(proposed, jnp.asarray(results[0], jnp.int32), jnp.array(last))
        won, done = np.flatnonzero(results[0] == TrialResult.SUCCEEDED), settled(decision)
        if done or not len(won) or decision.value >= 0.0:
            return decision, tried(rows, results), done
        # As if it had failed in its trial; those after it were not tried yet.
        results[0, won[0]] = TrialResult.FAILED
        wanted = rows.worth & (np.arange(results.shape[1]) > won[0])[None]
