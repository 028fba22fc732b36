"""Many episodes in lockstep: each is what it would be alone, and what fails belongs to its own row."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_envs_episode import BOX, CONFIG, CYLINDER, HIDDEN, OPEN, reveal, topple

from mechsearch_jax.envs import batch_episode
from mechsearch_jax.envs.batch_episode import Start, run_episodes
from mechsearch_jax.envs.episode import Choice, EpisodeLog, distrust, run_episode
from mechsearch_jax.envs.mjx_simulator import RETRIEVE, Failure, MjxSimulator, Outcomes, Overflow
from mechsearch_jax.envs.native_worlds import NativeWorlds
from mechsearch_jax.envs.simulator import NativeSimulator
from mechsearch_jax.envs.world import BODIES, from_scenario
from mechsearch_jax.errors import InputError
from mechsearch_jax.workspace.scenario import Scenario

TWO = Scenario("two", (BOX, dataclasses.replace(BOX, position=(0.6, -0.15, 0.4845))), CYLINDER)
AT_ONCE = 2


class Troupe:
    """A batch simulator in which actions do what a test says, by the scenario that a world began with."""

    engine = "Troupe"

    def __init__(self, acts, failures=None, overflows=None):
        self.world = None
        self.executed = []
        self.names = []
        self._acts, self._failures, self._overflows = acts, failures or {}, overflows or {}

    def reset(self, scenarios):
        self.names = [None] * len(scenarios)
        self._worlds = [None] * len(scenarios)
        return self.replace(dict(enumerate(scenarios)))

    def replace(self, scenarios):
        for i, scenario in scenarios.items():
            self.names[i], self._worlds[i] = scenario.name, from_scenario(scenario)
        self.world = jax.tree.map(lambda *leaves: jnp.stack(leaves), *self._worlds)
        return self.world

    def execute(self, actions, active):
        count = len(self.names)
        self.executed.append([self.names[i] if active[i] else None for i in range(count)])
        outcomes = Outcomes(
            *(np.zeros(count, np.int32), np.zeros(count, np.int32), np.ones(count, bool)),
            *(np.zeros((count, BODIES), bool), np.zeros(count, bool), np.zeros(count, bool), np.zeros(count, bool)),
            np.zeros(count, np.int32),
        )
        for i, name in enumerate(self.names):
            if not active[i]:
                continue
            outcomes.failure[i] = self._failures.get(name, Failure.NONE)
            outcomes.overflow[i] = self._overflows.get(name, Overflow.NONE)
            if actions.kind[i] == RETRIEVE:
                outcomes.retrieved[i] = outcomes.failure[i] == Failure.NONE
            else:
                self._worlds[i] = self._acts.get(name, lambda world: world)(self._worlds[i])
        self.world = jax.tree.map(lambda *leaves: jnp.stack(leaves), *self._worlds)
        return jax.tree.map(jnp.asarray, outcomes)


def run(problem, scenarios, simulator, slots, config=CONFIG, seeds=None, **options):
    """The episodes in the order of the scenarios, and how many ended together."""
    found, together = {}, []

    def ended(episodes):
        together.append(len(episodes))
        for place, episode in episodes:
            assert place not in found
            found[place] = episode

    starts = [Start(s, seed) for s, seed in zip(scenarios, seeds or [0] * len(scenarios), strict=True)]
    run_episodes(starts, problem, config, simulator, slots, ended, at_once=AT_ONCE, **options)
    return [found[i] for i in range(len(scenarios))], together


def without_times(episode):
    value = dataclasses.asdict(episode)
    for step in value["steps"]:
        step.pop("timings")
    return value


def test_episodes_are_the_same_alone_and_in_a_batch_whatever_their_slot(problem):
    """More episodes than slots; and in the native simulator."""
    scenarios, seeds = [OPEN, HIDDEN, TWO, HIDDEN], [0, 0, 1, 2]
    simulator = NativeWorlds(threads=2)
    episodes, together = run(problem, scenarios, simulator, 2, seeds=seeds)
    assert sum(together) == 4
    alone = [run_episode(seed, s, problem, CONFIG, NativeSimulator()) for s, seed in zip(scenarios, seeds, strict=True)]
    assert [without_times(e) for e in episodes] == [without_times(e) for e in alone]
    assert {e.scenario for e in episodes if e.retrieved} >= {"open"}
    assert all(step.timings["recognise"] > 0 for e in episodes for step in e.steps)


def test_a_slot_is_free_for_the_next_as_soon_as_its_episode_ends(problem):
    stage = Troupe({"hidden": reveal}, failures={"two": Failure.DROPPED})
    names = ["two", "open", "hidden", "open again"]
    starts = [TWO, OPEN, HIDDEN, dataclasses.replace(OPEN, name="open again")]
    stages = []
    episodes, together = run(problem, starts, stage, 2, busy=lambda stage, count: stages.append((stage, count)))
    assert [episode.scenario for episode in episodes] == names
    assert stage.executed[0] == ["two", "open"]
    assert stage.executed[1] == ["two", "hidden"]
    assert [e.failure for e in episodes] == ["not found", None, None, None]
    assert [e.retrieved for e in episodes] == [False, True, True, True]
    assert [step.failure for step in episodes[0].steps] == ["dropped", "dropped", None]
    assert sum(together) == 4
    assert ("recognise", 2) in stages
    assert ("plan", 1) in stages


def test_what_fails_belongs_to_its_own_row(problem):
    stage = Troupe({"hidden": reveal, "tipped": topple}, overflows={"two": Overflow.ROWS | Overflow.CONTACTS})
    tipped = dataclasses.replace(HIDDEN, name="tipped")
    episodes, _ = run(problem, [TWO, HIDDEN, tipped], stage, 2)
    assert [e.failure for e in episodes] == [
        "error: the simulator's buffers were too small (rows, contacts)",
        None,
        "the target fell over",
    ]
    assert [e.retrieved for e in episodes] == [False, True, False]


def test_a_success_that_cannot_be_trusted_is_none():
    log = EpisodeLog(CONFIG)
    log.decide(batch_episode.record(True, 1, True, None, None, CONFIG))
    deed = batch_episode.Deed.of_retrieval(True, None)
    assert log.act(deed, "error: no", {})
    episode = log.episode(OPEN, {})
    assert (episode.retrieved, episode.failure) == (False, "error: no")


def test_decisions_that_cannot_be_trusted_are_named(problem):
    from mechsearch_jax.actions import no_action

    good = Choice(no_action(), jnp.float32(3.0), jnp.float32(2.0), jnp.int32(1), jnp.array(False))
    assert distrust(good) is None
    assert "outgrew" in distrust(good.replace(overflow=jnp.array(True)))
    lost = dataclasses.replace(no_action(), q7=jnp.float32(jnp.nan))
    assert distrust(good.replace(action=lost)) == "error: the decision is not finite"
    assert distrust(good.replace(cost=jnp.float32(jnp.inf))) == "error: the decision is not finite"


def test_a_decision_that_cannot_be_trusted_is_not_executed(problem, monkeypatch):
    """One that is not finite ends its own episode, and the others go on."""

    decide = batch_episode._decide

    def lose(*arguments):
        choice = decide(*arguments)
        return choice.replace(cost=choice.cost * jnp.nan)

    monkeypatch.setattr(batch_episode, "_decide", lose)
    stage = Troupe({})
    episodes, _ = run(problem, [OPEN, HIDDEN], stage, 2)
    assert [e.failure for e in episodes] == [None, "error: the decision is not finite"]
    assert stage.executed == [["open", None]]


def test_worlds_of_the_native_simulator_are_checked():
    worlds = NativeWorlds()
    with pytest.raises(InputError, match="no scenarios"):
        worlds.reset([])
    worlds.reset([OPEN, HIDDEN])
    from mechsearch_jax.actions import no_action

    with pytest.raises(InputError, match="for 2 worlds"):
        worlds.execute(jax.tree.map(lambda a: a[None], no_action()))
    idle = jax.tree.map(lambda a: jnp.stack([a, a]), no_action())
    before = worlds.world
    outcomes = worlds.execute(idle, jnp.array([True, False]))
    assert outcomes.steps.tolist() == [0, 0]
    jax.tree.map(np.testing.assert_array_equal, before, worlds.world)


@pytest.mark.slow
def test_the_batch_simulator_runs_whole_episodes(problem):
    simulator = MjxSimulator()
    episodes, _ = run(problem, [OPEN, HIDDEN, dataclasses.replace(OPEN, name="open again")], simulator, 2)
    assert [e.retrieved for e in episodes] == [True, True, True]
    assert [e.config["simulator"] for e in episodes] == ["MjxSimulator"] * 3
    alone = run_episode(0, HIDDEN, problem, CONFIG, NativeSimulator())
    assert [s.action.kind for s in episodes[1].steps] == [s.action.kind for s in alone.steps]
