"""A search with everything known: whatever can be tried is tried in copies of the simulated world.

It tells whether a scene can be solved at all by the actions that there are. Nothing is hidden from it: it plans with
the true poses of all objects and of the target from the start, and it may take back what went wrong. All worlds that
were reached are kept. In a round sequences are sampled, as the planner does, from the few in which the target is
nearest to being graspable, and the best sequences are executed in copies of their worlds. A world that was tried in
vain makes way for others by and by. One in which an object has left the board, or the target has fallen, is given up.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mechsearch_jax.actions import Action, kind_of, no_action
from mechsearch_jax.envs.episode.episode_log import target_trouble
from mechsearch_jax.envs.episode.records import ActionRecord, record_action
from mechsearch_jax.envs.known_target.judgement import Judgement, judge, retrievals_of, sample
from mechsearch_jax.envs.simulators.simulator import Simulator
from mechsearch_jax.envs.world.outcome import Outcome
from mechsearch_jax.envs.world.world import TARGET, World
from mechsearch_jax.planner import PlanningPolicy, Problem
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.scenario import Scenario

# Worlds in which no body is farther than this from where it is in another are taken for the same [m].
ALIKE = 0.01
# What a world is set back by for every round in which it was tried, in units of J: an object in the way counts 1.
TRIED = 0.25
# First actions that agree to this are the same, in metres and entries of a rotation.
STEP = 0.002


@dataclasses.dataclass(frozen=True)
class KnownSearchConfig:
    """How much is tried.

    Attributes:
      simulated: how many sequences are executed in a round.
      worlds: from how many sequences are sampled in a round.
      rounds: how many there are at most.
      grasps: with how many grasps it is tried to take the target out of a world where one hits nothing.
      retrievals: from how many worlds of a round that is tried, at most.
      max_steps: number of actions, taking the target out among them.
      seed: of what is sampled.
    """

    simulated: int = 32
    worlds: int = 4
    rounds: int = 40
    grasps: int = 8
    retrievals: int = 4
    max_steps: int = 30
    seed: int = 0

    def __post_init__(self):
        for name in ("simulated", "worlds", "rounds", "grasps", "retrievals", "max_steps"):
            if getattr(self, name) < 1:
                raise InputError(f"KnownSearchConfig: {name} {getattr(self, name)} must be at least 1")


@dataclasses.dataclass(frozen=True)
class Node:
    """A world that actions lead to.

    Attributes:
      world: its true state, as NumPy arrays without leading axes.
      actions: that lead there.
      judgement: of it, as NumPy arrays.
    """

    world: World
    actions: tuple[ActionRecord, ...]
    judgement: Judgement

    @property
    def cost(self) -> float:
        """J of it."""
        return float(self.judgement.cost)

    @property
    def graspable(self) -> bool:
        """Whether a grasp hits nothing."""
        return self.judgement.least == 0


@dataclasses.dataclass(frozen=True)
class Found:
    """What a search came to.

    Attributes:
      actions: that take the target out; None where none were found.
      best: the world in which the target is nearest to being graspable, the start among them.
      start: the world at the start.
      rounds: how many rounds there were.
      simulated: number of actions that were executed, retrievals among them.
      sampled: how often a first action of each kind and object was sampled: ("push", 2).
      executed: how often one of a sequence was carried out.
      failed: how often one was not, by its kind, object and reason.
      retrievals: how often it was tried to take the target out, by what came of it ("" for success).
    """

    actions: tuple[ActionRecord, ...] | None
    best: Node
    start: Node
    rounds: int
    simulated: int
    sampled: Counter[tuple[str, int]]
    executed: Counter[tuple[str, int]]
    failed: Counter[tuple[str, int, str]]
    retrievals: Counter[str]


def known_search(
    scenario: Scenario,
    problem: Problem,
    policy: PlanningPolicy,
    simulator: Simulator,
    config: KnownSearchConfig | None = None,
    told: Callable[[int, Node], None] = lambda round, best: None,
) -> Found:
    """Look for actions that take the target out.

    Args:
      scenario: where everything stands at the start.
      problem: built for its target.
      policy: samples sequences and predicts them; its objective should be `InFullView`.
      simulator: executes actions in as many worlds as are asked for.
      config: how much is tried.
      told: after every round, of its number and of the best world so far.
    """
    running = _Running(scenario, problem, policy, simulator, config or KnownSearchConfig())
    while running.goes_on:
        running.round()
        told(running.rounds, running.best)
    return running.found()


class _Proposal(NamedTuple):
    """A sequence that may be executed: from where, with what expected cost, and its actions with their axis M."""

    node: Node
    expected: float
    actions: Action
    length: int

    @property
    def group(self) -> tuple[int, int, int]:
        """Proposals that begin alike: the world, and kind and object of the first action."""
        return id(self.node), int(self.actions.kind[0]), int(self.actions.object[0])


class Frontier:
    """Worlds to go on from.

    Attributes:
      nodes: all of them.
    """

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self._tried: list[int] = []
        self._places: list[Float[np.ndarray, "9 3"]] = []

    def add(self, node: Node) -> None:
        """Keep a world, unless one that is alike is kept."""
        place = np.where(node.world.valid[:, None], node.world.position, 0.0)
        if not self._places or np.abs(np.stack(self._places) - place).max(axis=(1, 2)).min() > ALIKE:
            self.nodes.append(node)
            self._tried.append(0)
            self._places.append(place)

    def next(self, count: int) -> list[Node]:
        """The worlds to be tried now: those of least cost, what `TRIED` adds included, and then of fewest actions."""
        promise = [
            (node.cost + TRIED * tried, len(node.actions)) for node, tried in zip(self.nodes, self._tried, strict=True)
        ]
        chosen = sorted(range(len(promise)), key=promise.__getitem__)[:count]
        for i in chosen:
            self._tried[i] += 1
        return [self.nodes[i] for i in chosen]


class _Running:
    """A search under way."""

    def __init__(
        self,
        scenario: Scenario,
        problem: Problem,
        policy: PlanningPolicy,
        simulator: Simulator,
        config: KnownSearchConfig,
    ) -> None:
        self._problem, self._policy, self._simulator, self._config = problem, policy, simulator, config
        self._judges = jax.jit(jax.vmap(self._judge_one))
        world = jax.device_get(jax.tree.map(lambda a: a[0], simulator.reset([scenario])))
        self.rounds = self._simulated = 0
        self._sampled: Counter[tuple[str, int]] = Counter()
        self._executed: Counter[tuple[str, int]] = Counter()
        self._failed: Counter[tuple[str, int, str]] = Counter()
        self._retrievals: Counter[str] = Counter()
        self._solution: tuple[ActionRecord, ...] | None = None
        (judgement,) = self._judged([world])
        self._start = self.best = Node(world, (), judgement)
        self._open = Frontier()
        self._keep([self._start])
        self._take_out([self._start])

    @property
    def goes_on(self) -> bool:
        """Whether there is anything left to be tried."""
        return self._solution is None and self.rounds < self._config.rounds and bool(self._open.nodes)

    def found(self) -> Found:
        """What it came to so far."""
        return Found(
            actions=self._solution,
            best=self.best,
            start=self._start,
            rounds=self.rounds,
            simulated=self._simulated,
            sampled=self._sampled,
            executed=self._executed,
            failed=self._failed,
            retrievals=self._retrievals,
        )

    def round(self) -> None:
        """Sample from the most promising worlds, execute the best sequences, and keep the worlds that come of it."""
        nodes = self._open.next(self._config.worlds)
        keys = jax.random.split(jax.random.fold_in(jax.random.key(self._config.seed), self.rounds), len(nodes))
        proposals = [one for node, k in zip(nodes, keys, strict=True) for one in self._proposals(node, k)]
        self.rounds += 1
        nodes = self._execute(in_turn(proposals, self._config.simulated))
        nodes.sort(key=lambda node: (node.cost, len(node.actions)))
        if nodes and nodes[0].cost < self.best.cost:
            self.best = nodes[0]
        self._take_out(nodes)
        self._keep(nodes)

    def _keep(self, nodes: Sequence[Node]) -> None:
        """Keep worlds to go on from, if there is room for two more actions: one, and taking the target out."""
        for node in nodes:
            if len(node.actions) < self._config.max_steps - 1:
                self._open.add(node)

    def _judge_one(self, world: World, active: Bool[Array, ""]) -> Judgement:
        policy = self._policy
        return judge(self._problem, policy.objective, policy.config.weights, world, active)

    def _judged(self, worlds: Sequence[World]) -> list[Judgement]:
        """Judge worlds, so many at once as are simulated at once."""
        judged: list[Judgement] = []
        for i in range(0, len(worlds), self._config.simulated):
            some = worlds[i : i + self._config.simulated]
            padded = [*some, *[some[0]] * (self._config.simulated - len(some))]
            active = np.arange(len(padded)) < len(some)
            every = jax.device_get(self._judges(_stacked(padded), jnp.asarray(active)))
            judged += [jax.tree.map(lambda a, j=j: a[j], every) for j in range(len(some))]
        return judged

    def _proposals(self, node: Node, key: Array) -> list[_Proposal]:
        """The sampled sequences whose first actions differ, best first."""
        sequences = jax.device_get(sample(self._policy, key, self._problem, node.world))
        room = self._config.max_steps - 1 - len(node.actions)
        found: dict[tuple[str | int, ...], _Proposal] = {}
        for i in np.flatnonzero(np.isfinite(sequences.value)):
            actions = jax.tree.map(lambda a, i=i: a[i], sequences.actions)
            expected = node.cost + float(sequences.value[i])
            proposal = _Proposal(node, expected, actions, min(int(sequences.length[i]), room))
            self._sampled[_named(actions, 0)] += 1
            found.setdefault(_first_step(actions), proposal)
        return list(found.values())

    def _execute(self, proposals: Sequence[_Proposal]) -> list[Node]:
        """The worlds that proposals lead to, one after each action, without those that are lost."""
        reached: list[Node] = []
        if not proposals:
            return reached
        self._simulator.load(_stacked([proposal.node.world for proposal in proposals]))
        paths = {i: proposal.node.actions for i, proposal in enumerate(proposals)}
        for step in range(max(proposal.length for proposal in proposals)):
            active = [i for i in paths if step < proposals[i].length]
            chosen = [jax.tree.map(lambda a: a[step], proposal.actions) for proposal in proposals]  # noqa: B023
            outcome = self._acted(chosen, active)
            worlds = jax.device_get(self._simulator.world)
            for i in active:
                self._note(chosen[i], outcome, i)
                paths[i] = (*paths[i], record_action(chosen[i]))
            alive = [i for i in active if self._is_whole(outcome, worlds, i)]
            here = [jax.tree.map(lambda a, i=i: a[i], worlds) for i in alive]
            reached += [Node(w, paths[i], j) for i, w, j in zip(alive, here, self._judged(here), strict=True)]
            paths = {i: paths[i] for i in alive}
        return reached

    def _acted(self, actions: Sequence[Action], active: Sequence[int]) -> Outcome:
        """Execute actions in some of as many worlds."""
        self._simulated += len(active)
        mask = np.isin(np.arange(len(actions)), active)
        none = jax.device_get(no_action())
        told = [action if mask[i] else none for i, action in enumerate(actions)]
        return jax.device_get(self._simulator.execute(_stacked(told), jnp.asarray(mask)))

    def _note(self, action: Action, outcome: Outcome, i: int) -> None:
        """Count an action that was executed in world `i`."""
        reason = outcome.reason(i)
        if reason is None:
            self._executed[_named(action)] += 1
        else:
            self._failed[(*_named(action), reason)] += 1

    def _is_whole(self, outcome: Outcome, worlds: World, i: int) -> bool:
        """Whether world `i` is one to go on with after an action."""
        position, rotation = np.asarray(worlds.position[i, TARGET]), np.asarray(worlds.rotation[i, TARGET])
        trouble = target_trouble(self._problem.shelf, position, rotation)
        return trouble is None and not outcome.fallen[i].any() and bool(outcome.took_place[i])

    def _take_out(self, nodes: Sequence[Node]) -> None:
        """Try to take the target out of worlds in which a grasp hits nothing, until it is out."""
        for node in different([node for node in nodes if node.graspable], self._config.retrievals):
            grasps = retrievals_of(self._problem, node.world, self._config.grasps)
            actions = [jax.tree.map(lambda a, i=i: a[i], grasps.action) for i in np.flatnonzero(grasps.success)]
            if not actions:
                continue
            self._simulator.load(_stacked([node.world] * len(actions)))
            outcome = self._acted(actions, range(len(actions)))
            self._retrievals.update(outcome.reason(i) or "" for i in range(len(actions)))
            if outcome.retrieved.any():
                best = actions[int(np.argmax(outcome.retrieved))]
                self._solution, self.best = (*node.actions, record_action(best)), node
                return


def in_turn(proposals: Sequence[_Proposal], count: int) -> list[_Proposal]:
    """The best so many proposals, of each group in turn: what a push model takes too easy must not crowd out the rest.

    A group is a world with a kind of action and an object; groups go by their best.
    """
    groups: dict[tuple[int, int, int], list[_Proposal]] = {}
    for proposal in sorted(proposals, key=lambda one: one.expected):
        groups.setdefault(proposal.group, []).append(proposal)
    ranked = [(place, one.expected, one) for group in groups.values() for place, one in enumerate(group)]
    return [one for *_, one in sorted(ranked, key=lambda each: each[:2])[:count]]


def different(nodes: Sequence[Node], count: int) -> list[Node]:
    """The first so many nodes whose worlds differ by more than `ALIKE`."""
    kept: list[Node] = []
    for node in nodes:
        if len(kept) < count and all(_apart(node, other) > ALIKE for other in kept):
            kept.append(node)
    return kept


def _apart(a: Node, b: Node) -> float:
    """How far the body that differs most stands apart in two worlds [m]."""
    return float(np.abs(a.world.position - b.world.position)[a.world.valid].max())


def _named(action: Action, step: int | None = None) -> tuple[str, int]:
    """Kind and object of an action, or of one in a sequence."""
    kind, index = (action.kind, action.object) if step is None else (action.kind[step], action.object[step])
    return kind_of(int(kind)).name, int(index)


def _first_step(actions: Action) -> tuple[str | int, ...]:
    """What tells the first action of a sequence from others."""
    told = [actions.T_world_gripper[0], actions.displacement[0], actions.T_world_place[0], actions.q7[0]]
    numbers = np.concatenate([np.ravel(part) for part in told])
    return (*_named(actions, 0), *np.round(numbers / STEP).astype(int).tolist())


def _stacked(trees: Sequence[Any]) -> Any:
    """Pytrees as one with a leading axis."""
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *trees)
