"""The shipped default from the first look to the retrieval: actions are tried in physics before one is made."""

import jax
import numpy as np
import pytest

from mechsearch_jax.actions.registry import ActionKind
from mechsearch_jax.envs.episode.closed_loop import Listeners, RunSettings, Start
from mechsearch_jax.envs.episode.episodes import run_episode, run_episodes, target_of
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.envs.simulators.mjx_simulator import MjxSimulator
from mechsearch_jax.envs.simulators.native import NativeSimulator
from mechsearch_jax.planner import search_for_grasp
from mechsearch_jax.planner.trials import TrialResult
from mechsearch_jax.workspace.scenario import example_scenarios, load_scenario

SCENARIO = load_scenario(example_scenarios()["first-light"])


class Recorded:
    """Trials of other trials, with what was tried and what became of it, for each row."""

    def __init__(self, trials):
        self.trials, self.tried = trials, []

    def __call__(self, problem, scenes, actions, wanted):
        results = np.where(wanted, self.trials(problem, scenes, actions, wanted), TrialResult.UNKNOWN)
        self.tried += [(jax.tree.map(lambda a, r=r: a[r], actions), results[r]) for r in np.flatnonzero(wanted.any(1))]
        return results

    def programs(self, problem):
        return self.trials.programs(problem)


class Decisions:
    """Watches an episode: its decisions."""

    def __init__(self):
        self.actions = []

    def busy(self, stage): ...

    def decided(self, moment):
        self.actions.append(moment.decision.action)

    def acted(self, moment): ...


def check(episode, engine):
    assert (episode.retrieved, episode.failure) == (True, None)
    assert not episode.steps[0].found
    assert [step.failure for step in episode.steps] == [None] * len(episode.steps)
    assert len(episode.steps) <= 4
    assert (episode.config["trials"], episode.config["simulator"]) == ("physics", engine)


@pytest.mark.slow
def test_what_succeeds_in_physics_is_made_until_the_target_is_out(problem):
    method, decisions = Method(), Decisions()
    assert (target_of(SCENARIO), method.config.problem) == (problem.target, problem.config)
    # Compiled once, with what other tests plan.
    assert method.policy() == search_for_grasp(tries=True)
    trials = Recorded(method.trials())
    settings = RunSettings(options=method.options(), trials=trials)
    episode = run_episode(Start(SCENARIO, 0), problem, method.policy(), NativeSimulator(), settings, decisions)
    check(episode, "NativeSimulator")
    # Where every grasp of the target fails, other actions are tried next.
    won = [(actions, results) for actions, results in trials.tried if np.any(results == TrialResult.SUCCEEDED)]
    lost = [actions for actions, results in trials.tried if not np.any(results == TrialResult.SUCCEEDED)]
    assert all(np.all(np.isin(actions.kind, (ActionKind.NONE, ActionKind.RETRIEVE))) for actions in lost)
    assert len(won) == len(decisions.actions) == len(episode.steps)
    for (actions, results), made in zip(won, decisions.actions, strict=True):
        first = int(np.argmax(results == TrialResult.SUCCEEDED))
        np.testing.assert_array_equal(made.kind, actions.kind[first])
        np.testing.assert_array_equal(made.T_world_gripper, actions.T_world_gripper[first])


@pytest.mark.slow
@pytest.mark.release
def test_the_batch_simulator_takes_the_target_out_by_the_default(problem):
    method, episodes = Method(engine="MjxSimulator"), {}
    trials = Recorded(method.trials())
    run_episodes(
        [Start(SCENARIO, seed) for seed in (0, 1)],
        problem,
        method.policy(),
        MjxSimulator(),
        2,
        Listeners(episodes.update),
        RunSettings(options=method.options(), trials=trials),
    )
    assert sorted(episodes) == [0, 1]
    for episode in episodes.values():
        check(episode, "MjxSimulator")
    assert len(trials.tried) == sum(len(episode.steps) for episode in episodes.values())
    assert all((results == TrialResult.SUCCEEDED).any() for _, results in trials.tried)
