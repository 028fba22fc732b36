"""Many episodes in lockstep: each is what it would be alone, and what fails belongs to its own row."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from stage import HIDDEN, OPEN, TWO, Grab, Shuffled, Stage, grab, grab_nearest, idle, push_off, reveal, topple

from mechsearch_jax.actions import no_action
from mechsearch_jax.envs.camera.snapshot import oracle
from mechsearch_jax.envs.episode.closed_loop import Listeners, RunSettings, Start
from mechsearch_jax.envs.episode.episode_log import Choice, EpisodeLog, Result, distrust, record
from mechsearch_jax.envs.episode.episodes import run_episode, run_episodes
from mechsearch_jax.envs.episode.policy_numbers import compile_key
from mechsearch_jax.envs.episode.verdicts import Verdict
from mechsearch_jax.envs.simulators.mjx_simulator import MjxSimulator
from mechsearch_jax.envs.simulators.native import NativeSimulator
from mechsearch_jax.envs.simulators.simulator import Flowing, Simulator
from mechsearch_jax.envs.world.outcome import Failure, Overflow
from mechsearch_jax.envs.world.world import TARGET
from mechsearch_jax.planner import search_for_grasp
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.pytree import static

AT_ONCE = 2
WON = Result(
    failure=None,
    takes_target=True,
    retrieved=True,
    final=True,
    off_board=frozenset(),
    held_up=False,
    at_rest=True,
    restless=(),
    tracking_error=0.001,
)


def run(problem, scenarios, simulator, slots, policy=grab, seeds=None, **listening):
    """The episodes in the order of the scenarios, and how many ended together."""
    by_place, together = {}, []

    def ended(episodes):
        together.append(len(episodes))
        for place, episode in episodes:
            assert place not in by_place
            by_place[place] = episode

    starts = [Start(s, seed) for s, seed in zip(scenarios, seeds or [0] * len(scenarios), strict=True)]
    settings = RunSettings(max_steps=2, at_once=AT_ONCE)
    run_episodes(starts, problem, policy, simulator, slots, Listeners(ended, **listening), settings)
    return [by_place[i] for i in range(len(scenarios))], together


def without_times(episode):
    value = dataclasses.asdict(episode)
    for step in value["steps"]:
        step.pop("timings")
    return value


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["grab", "search-for-grasp"], ids=["grab", "search"])
def test_episodes_are_the_same_alone_and_in_a_batch_whatever_their_slot(problem, policy):
    """More episodes than slots; and in the native simulator."""
    decides = grab if policy == "grab" else search_for_grasp()
    scenarios, seeds = [OPEN, HIDDEN, TWO, HIDDEN], [0, 0, 1, 2]
    simulator = NativeSimulator(threads=2)
    episodes, together = run(problem, scenarios, simulator, 2, decides, seeds)
    assert sum(together) == 4
    alone = [
        run_episode(Start(s, seed, max_steps=2), problem, decides, NativeSimulator())
        for s, seed in zip(scenarios, seeds, strict=True)
    ]
    assert [without_times(e) for e in episodes] == [without_times(e) for e in alone]
    assert {e.scenario for e in episodes if e.retrieved} >= {"open"}
    assert all(step.timings["recognise"] > 0 for e in episodes for step in e.steps)


@pytest.mark.slow
def test_objects_in_any_order_give_the_same_episodes_in_a_batch(problem):
    """In every slot the simulator and the records name the bodies that the recognised objects stand for."""
    scenarios, by_order = [TWO, HIDDEN, TWO], []
    for recogniser in (oracle, Shuffled((1, 7, 0, 2, 3, 4, 5, 6))):
        episodes, stage = {}, Stage({"hidden": reveal})
        settings = RunSettings(recogniser, max_steps=2, at_once=AT_ONCE)
        starts = [Start(s, seed) for seed, s in enumerate(scenarios)]
        run_episodes(starts, problem, grab_nearest, stage, 2, Listeners(episodes.update), settings)
        by_order.append([without_times(episodes[i]) for i in range(3)])
        assert {int(action.object) for action in stage.actions} == {0}
    assert by_order[0] == by_order[1]
    assert by_order[1][1]["retrieved"]


class Counting(Grab):
    """The same, and counts how often it is traced; `tilt` is an array, `far` is static."""

    tilt: jax.Array | None = None
    far: bool = static(default=False)
    traced = 0

    def __call__(self, *args):
        type(self).traced += 1
        return super().__call__(*args)


def test_policies_that_differ_in_numbers_share_a_batch_and_what_is_compiled(problem):
    """Several episodes a slot; every episode is what its policy makes of it alone."""
    Counting.traced, count = 0, 4
    policies = [Counting(charge=float(charge)) for charge in range(count)]
    starts = [Start(HIDDEN, 0, policy, 1 + i % 2, {"charge": policy.charge}) for i, policy in enumerate(policies)]
    episodes = {}
    settings = RunSettings(max_steps=9, at_once=AT_ONCE)
    run_episodes(starts, problem, policies[0], Stage(), 2, Listeners(episodes.update), settings)
    assert Counting.traced == 1
    sizes = {episodes[i].steps[0].belief_size for i in range(count)}
    assert len(sizes) == 1
    assert [episodes[i].steps[0].cost for i in range(count)] == [sizes.copy().pop() + charge for charge in range(count)]
    assert [len(episodes[i].steps) for i in range(count)] == [2 + i % 2 for i in range(count)]
    assert [episodes[i].config["charge"] for i in range(count)] == list(range(count))
    for i in (0, count - 1):
        alone = run_episode(starts[i], problem, policies[i], Stage())
        assert without_times(alone) == without_times(episodes[i])


def test_policies_that_differ_in_more_than_numbers_do_not_share_a_batch(problem):
    first = Counting(tilt=jnp.zeros(3))
    assert compile_key(first) == compile_key(first.replace(charge=0.5, tilt=jnp.zeros(3)))
    assert compile_key(grab) != compile_key(first) != compile_key(Counting())
    for other in (first.replace(far=True), first.replace(tilt=jnp.ones(3)), grab):
        starts = [Start(OPEN, 0, first), Start(OPEN, 0, other)]
        with pytest.raises(InputError, match="differ in more than numbers"):
            run_episodes(starts, problem, first, Stage(), 2, Listeners(print))
    # One after the other they may be anything.
    episodes = {}
    starts = [Start(OPEN, 0), Start(OPEN, 0, idle)]
    run_episodes(starts, problem, grab, Stage(), 1, Listeners(episodes.update), RunSettings(max_steps=2))
    assert [episodes[i].retrieved for i in (0, 1)] == [True, False]


def test_a_slot_is_free_for_the_next_as_soon_as_its_episode_ends(problem):
    stage = Stage({"hidden": reveal}, failures={"two": Failure.DROPPED})
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


class FlowingStage(Stage, Flowing):
    """The same, in which actions take their time: that of the last slot is over first, one after the other."""

    def __init__(self, *settings):
        super().__init__(*settings)
        self.under_way = {}
        self.calls = []

    def begin(self, actions, active):
        rows = np.flatnonzero(active).tolist()
        assert not self.under_way.keys() & set(rows)
        self.under_way |= {row: jax.tree.map(lambda a, row=row: a[row], actions) for row in rows}

    def advance(self, least):
        self.calls.append((least, len(self.under_way)))
        done = sorted(self.under_way, reverse=True)[:least]
        actions = jax.tree.map(lambda a: np.stack([a] * len(self.names)), jax.device_get(no_action()))
        for row in done:
            for all_of_it, one in zip(jax.tree.leaves(actions), jax.tree.leaves(self.under_way.pop(row)), strict=True):
                all_of_it[row] = one
        mask = np.isin(np.arange(len(self.names)), done)
        return mask, jax.device_get(self.execute(actions, mask))


def test_a_slot_that_has_acted_goes_on_while_others_still_act(problem):
    settings = ({"hidden": reveal}, {"two": Failure.DROPPED})
    starts = [TWO, OPEN, HIDDEN, dataclasses.replace(OPEN, name="open again")]
    flowing = FlowingStage(*settings)
    episodes, together = run(problem, starts, flowing, 2)
    assert [without_times(e) for e in episodes] == [
        without_times(e) | {"config": e.config | {"simulator": "Stage"}}
        for e in run(problem, starts, Stage(*settings), 2)[0]
    ]
    # The other slot has run three episodes when the first action of the first is over.
    assert [next(filter(None, names)) for names in flowing.executed] == [
        "open",
        "hidden",
        "hidden",
        "open again",
        "two",
        "two",
    ]
    assert flowing.calls == [(1, 2)] * 4 + [(1, 1)] * 2
    assert together == [1, 1, 1, 1]
    assert all(step.timings["simulate"] > 0 for e in episodes for step in e.steps if step.action)


def test_nothing_is_compiled_in_the_rounds(problem):
    """All that is traced, lowered or compiled is, before the first episode begins; whatever becomes of them."""
    rounds, compiled = [], []

    def note(event, seconds, **about):
        if rounds and event.startswith("/jax/core/compile/"):
            compiled.append((rounds[-1], event.rpartition("/")[2], about.get("fun_name")))

    jax.monitoring.register_event_duration_secs_listener(note)
    stages = {"busy": lambda stage, count: rounds.append(stage), "compiling": lambda text: None}
    try:
        run(problem, [TWO, OPEN, HIDDEN], FlowingStage({"hidden": reveal}), 2, **stages)
    finally:
        jax.monitoring.unregister_event_duration_listener(note)
    assert {"recognise", "plan", "judge", "simulate"} <= set(rounds)
    assert compiled == []


def test_what_fails_belongs_to_its_own_row(problem):
    stage = Stage({"hidden": reveal, "tipped": topple}, overflows={"two": Overflow.ROWS | Overflow.CONTACTS})
    tipped = dataclasses.replace(HIDDEN, name="tipped")
    episodes, _ = run(problem, [TWO, HIDDEN, tipped], stage, 2)
    assert [e.failure for e in episodes] == [
        "error: the simulator's buffers were too small (rows, contacts)",
        None,
        "the target fell over",
    ]
    assert [e.retrieved for e in episodes] == [False, True, False]


def test_what_falls_belongs_to_its_own_row(problem):
    stage = Stage({"hidden": push_off, "two": reveal}, restless={"two": True})
    episodes, _ = run(problem, [TWO, HIDDEN, dataclasses.replace(OPEN, name="open again")], stage, 2)
    assert [e.failure for e in episodes] == [None, "an object fell off the board at action 1", None]
    assert [[step.fallen for step in e.steps] for e in episodes] == [[(), ()], [(0,), None], [()]]
    assert [[step.at_rest for step in e.steps] for e in episodes] == [[False, False], [True, None], [True]]
    assert all(step.restarts == 0 for e in episodes for step in e.steps)


def test_a_success_that_cannot_be_trusted_is_none():
    log = EpisodeLog(2)
    log.decide(record(True, 1, Verdict(True, False), None))
    assert log.act(WON, "error: no", {})
    episode = log.episode(OPEN, {})
    assert (episode.retrieved, episode.failure) == (False, "error: no")


def test_a_retrieval_does_not_make_a_target_graspable():
    """The hand took it out with a grasp that touches something; no other was there."""
    log = EpisodeLog(3)
    log.decide(record(True, 1, Verdict(), None))
    assert not log.act(None, None, {})
    log.decide(record(True, 1, Verdict(), None))
    assert log.act(WON, None, {})
    episode = log.episode(OPEN, {})
    assert (episode.retrieved, episode.graspable_step, episode.paper_graspable_step) == (True, None, None)


def test_a_retrieval_does_not_count_once_an_object_has_left_the_board():
    log = EpisodeLog(2)
    fell = dataclasses.replace(WON, takes_target=False, retrieved=False, final=False, off_board=frozenset({1, TARGET}))
    log.decide(record(False, 9, Verdict(), None))
    assert not log.act(fell, None, {})
    assert log.irretrievable == "an object fell off the board at action 1"
    log.decide(record(True, 1, Verdict(), None))
    assert log.act(dataclasses.replace(WON, off_board=frozenset({1, 2})), None, {})
    episode = log.episode(OPEN, {})
    assert (episode.retrieved, episode.failure) == (False, "an object fell off the board at action 1")
    assert [(step.fallen, step.target_fallen) for step in episode.steps] == [((1,), True), ((2,), False)]


def test_decisions_that_cannot_be_trusted_are_named():
    good = Choice(no_action(), jnp.float32(3.0), jnp.float32(2.0), jnp.int32(1))
    assert distrust(good) is None
    lost = dataclasses.replace(no_action(), q7=jnp.float32(jnp.nan))
    assert distrust(good.replace(action=lost)) == "error: the decision is not finite"
    assert distrust(good.replace(cost=jnp.float32(jnp.inf))) == "error: the decision is not finite"


def test_a_decision_that_cannot_be_trusted_is_not_executed(problem):
    """One that is not finite ends its own episode, and the others go on."""
    stage = Stage()
    episodes, _ = run(problem, [OPEN, HIDDEN], stage, 2, Grab(charge=float("nan")))
    assert [e.failure for e in episodes] == [None, "error: the decision is not finite"]
    assert stage.executed == [["open", None]]


def test_worlds_of_the_native_simulator_are_checked():
    worlds = NativeSimulator()
    assert isinstance(worlds, Simulator)
    with pytest.raises(InputError, match="no scenarios"):
        worlds.reset([])
    worlds.reset([OPEN, HIDDEN])
    with pytest.raises(InputError, match="for 2 worlds"):
        worlds.execute(jax.tree.map(lambda a: a[None], no_action()))
    idle = jax.tree.map(lambda a: jnp.stack([a, a]), no_action())
    with pytest.raises(InputError, match="kind 5 is unknown"):
        worlds.execute(idle.replace(kind=jnp.int32([0, 5])))
    before = worlds.world
    outcomes = worlds.execute(idle, jnp.array([True, False]))
    assert outcomes.steps.tolist() == [0, 0]
    jax.tree.map(np.testing.assert_array_equal, before, worlds.world)
    settled = worlds.settle(jnp.array([False, True]))
    assert settled.settled.all()
    assert settled.steps[0] == 0
    assert settled.steps[1] > 0
    assert len(worlds.traces[0].time) == 0


@pytest.mark.slow
def test_the_batch_simulator_runs_whole_episodes(problem):
    simulator = MjxSimulator()
    scenarios, policy = [OPEN, HIDDEN, dataclasses.replace(OPEN, name="open again")], search_for_grasp()
    episodes, _ = run(problem, scenarios, simulator, 2, policy)
    assert [e.retrieved for e in episodes] == [True, True, True]
    assert [e.config["simulator"] for e in episodes] == ["MjxSimulator"] * 3
    alone = run_episode(Start(HIDDEN, 0, max_steps=2), problem, policy, NativeSimulator())
    assert [s.action.kind for s in episodes[1].steps] == [s.action.kind for s in alone.steps]
