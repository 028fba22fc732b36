"""A search with full knowledge: it tells whether a scene can be solved at all by the planner's actions.

It plans with the true poses of all objects and of the target, executes actions in copies of the simulated world, and
backtracks. All worlds that were reached are kept. Each round samples sequences, as the planner does, from the few
worlds in which the target is nearest to being graspable, and executes the best sequences in copies of their worlds.
Every round in which a world is expanded lowers its priority. A world in which an object has left the board, or the
target has fallen, is discarded.
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

from mechsearch_jax.actions import Action, no_action
from mechsearch_jax.envs.episode.episode_log import target_trouble
from mechsearch_jax.envs.episode.records import ActionRecord, record_action
from mechsearch_jax.envs.known_target.judgement import Judgement, judge, retrievals_of, sample
from mechsearch_jax.envs.simulators.simulator import Simulator
from mechsearch_jax.envs.world.outcome import Outcome
from mechsearch_jax.envs.world.world import TARGET, World
from mechsearch_jax.planner import PlanningPolicy, Problem
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.scenario import Scenario

# Two worlds count as the same if no body differs in position by more than this [m].
ALIKE = 0.01
# Added to a world's cost J for every round in which it was expanded; an object in the way costs 1.
TRIED = 0.25
# First actions count as the same if they agree to this, in metres and entries of a rotation.
STEP = 0.002


@dataclasses.dataclass(frozen=True)
class KnownSearchConfig:
    """Budget of the search.

    Attributes:
      simulated: number of sequences that are executed in a round.
      worlds: number of worlds from which sequences are sampled in a round.
      rounds: largest number of rounds.
      grasps: number of grasps that are tried in a world where a grasp hits nothing.
      retrievals: largest number of worlds of a round in which that is tried.
      max_steps: largest number of actions, the retrieval included.
      seed: of the sampling.
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
    """A world that was reached by actions.

    Attributes:
      world: its true state, as NumPy arrays without leading axes.
      actions: that lead there from the start.
      judgement: of the world, as NumPy arrays.
    """

    world: World
    actions: tuple[ActionRecord, ...]
    judgement: Judgement

    @property
    def cost(self) -> float:
        """J of the world."""
        return float(self.judgement.cost)

    @property
    def graspable(self) -> bool:
        """Whether there is a grasp that hits nothing."""
        return self.judgement.least == 0


@dataclasses.dataclass(frozen=True)
class KnownSearchResult:
    """Result of a search.

    Attributes:
      actions: that take the target out; None if the search did not succeed.
      best: the world in which the target is nearest to being graspable; may be the start.
      start: the world at the start.
      rounds: number of rounds.
      simulated: number of actions that were executed, retrievals included.
      retrievals: number of attempted retrievals by failure reason, "" for success.
    """

    actions: tuple[ActionRecord, ...] | None
    best: Node
    start: Node
    rounds: int
    simulated: int
    retrievals: Counter[str]


def known_search(
    scenario: Scenario,
    problem: Problem,
    policy: PlanningPolicy,
    simulator: Simulator,
    config: KnownSearchConfig | None = None,
    on_round: Callable[[int, Node], None] = lambda round, best: None,
) -> KnownSearchResult:
    """Search for actions that take the target out.

    Args:
      scenario: the scene at the start.
      problem: built for the scenario's target.
      policy: samples and predicts sequences; its objective should be `InFullView`.
      simulator: executes actions in any number of worlds.
      config: the budget.
      on_round: called after every round with its number and the best world so far.
    """
    running = _Running(scenario, problem, policy, simulator, config or KnownSearchConfig())
    while running.goes_on:
        running.round()
        on_round(running.rounds, running.best)
    return running.result()


class _Proposal(NamedTuple):
    """A sequence that may be executed: its start, its expected cost, and its actions with a leading axis M."""

    node: Node
    expected: float
    actions: Action
    length: int

    @property
    def group(self) -> tuple[int, int, int]:
        """The start, and kind and object of the first action."""
        return id(self.node), int(self.actions.kind[0]), int(self.actions.object[0])


class Frontier:
    """Worlds that can be expanded.

    Attributes:
      nodes: all of them.
    """

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self._tried: list[int] = []
        self._places: list[Float[np.ndarray, "9 3"]] = []

    def add(self, node: Node) -> None:
        """Keep a world unless one that counts as the same is kept already."""
        place = np.where(node.world.valid[:, None], node.world.position, 0.0)
        if not self._places or np.abs(np.stack(self._places) - place).max(axis=(1, 2)).min() > ALIKE:
            self.nodes.append(node)
            self._tried.append(0)
            self._places.append(place)

    def next(self, count: int) -> list[Node]:
        """The worlds to expand now: those of least cost including `TRIED`, ties by fewest actions."""
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
        self._retrievals: Counter[str] = Counter()
        self._solution: tuple[ActionRecord, ...] | None = None
        (judgement,) = self._judged([world])
        self._start = self.best = Node(world, (), judgement)
        self._open = Frontier()
        self._keep([self._start])
        self._take_out([self._start])

    @property
    def goes_on(self) -> bool:
        """Whether the search is neither solved nor at the end of its budget."""
        return self._solution is None and self.rounds < self._config.rounds and bool(self._open.nodes)

    def result(self) -> KnownSearchResult:
        """The result so far."""
        return KnownSearchResult(
            actions=self._solution,
            best=self.best,
            start=self._start,
            rounds=self.rounds,
            simulated=self._simulated,
            retrievals=self._retrievals,
        )

    def round(self) -> None:
        """Sample from the most promising worlds, execute the best sequences, and keep the worlds that result."""
        nodes = self._open.next(self._config.worlds)
        keys = jax.random.split(jax.random.fold_in(jax.random.key(self._config.seed), self.rounds), len(nodes))
        proposals = [p for node, key in zip(nodes, keys, strict=True) for p in self._proposals(node, key)]
        self.rounds += 1
        nodes = self._execute(in_turn(proposals, self._config.simulated))
        nodes.sort(key=lambda node: (node.cost, len(node.actions)))
        if nodes and nodes[0].cost < self.best.cost:
            self.best = nodes[0]
        self._take_out(nodes)
        self._keep(nodes)

    def _keep(self, nodes: Sequence[Node]) -> None:
        """Keep worlds with room for two more actions: one, and the retrieval."""
        for node in nodes:
            if len(node.actions) < self._config.max_steps - 1:
                self._open.add(node)

    def _judge_one(self, world: World, active: Bool[Array, ""]) -> Judgement:
        policy = self._policy
        return judge(self._problem, policy.objective, policy.config.weights, world, active)

    def _judged(self, worlds: Sequence[World]) -> list[Judgement]:
        """Judge worlds in chunks of constant size, so that the judge is compiled once."""
        judged: list[Judgement] = []
        for i in range(0, len(worlds), self._config.simulated):
            chunk = worlds[i : i + self._config.simulated]
            padded = [*chunk, *[chunk[0]] * (self._config.simulated - len(chunk))]
            active = np.arange(len(padded)) < len(chunk)
            judgements = jax.device_get(self._judges(_stacked(padded), jnp.asarray(active)))
            judged += [jax.tree.map(lambda a, j=j: a[j], judgements) for j in range(len(chunk))]
        return judged

    def _proposals(self, node: Node, key: Array) -> list[_Proposal]:
        """The sampled sequences whose first actions differ, best first."""
        sequences = jax.device_get(sample(self._policy, key, self._problem, node.world))
        room = self._config.max_steps - 1 - len(node.actions)
        proposals: dict[tuple[int, ...], _Proposal] = {}
        for i in np.flatnonzero(np.isfinite(sequences.value)):
            actions = jax.tree.map(lambda a, i=i: a[i], sequences.actions)
            expected = node.cost + float(sequences.value[i])
            proposal = _Proposal(node, expected, actions, min(int(sequences.length[i]), room))
            proposals.setdefault(_first_step(actions), proposal)
        return list(proposals.values())

    def _execute(self, proposals: Sequence[_Proposal]) -> list[Node]:
        """The worlds that proposals lead to, one after each action, without those that are discarded."""
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
                paths[i] = (*paths[i], record_action(chosen[i]))
            alive = [i for i in active if self._is_whole(outcome, worlds, i)]
            worlds_alive = [jax.tree.map(lambda a, i=i: a[i], worlds) for i in alive]
            reached += [
                Node(w, paths[i], j) for i, w, j in zip(alive, worlds_alive, self._judged(worlds_alive), strict=True)
            ]
            paths = {i: paths[i] for i in alive}
        return reached

    def _acted(self, actions: Sequence[Action], active: Sequence[int]) -> Outcome:
        """Execute actions, one per world, in the worlds `active`; nothing happens in the others."""
        self._simulated += len(active)
        mask = np.isin(np.arange(len(actions)), active)
        none = jax.device_get(no_action())
        executed = [action if mask[i] else none for i, action in enumerate(actions)]
        return jax.device_get(self._simulator.execute(_stacked(executed), jnp.asarray(mask)))

    def _is_whole(self, outcome: Outcome, worlds: World, i: int) -> bool:
        """Whether world `i` can be expanded after an action."""
        position, rotation = np.asarray(worlds.position[i, TARGET]), np.asarray(worlds.rotation[i, TARGET])
        trouble = target_trouble(self._problem.shelf, position, rotation)
        return trouble is None and not outcome.fallen[i].any() and bool(outcome.took_place[i])

    def _take_out(self, nodes: Sequence[Node]) -> None:
        """Try retrievals in worlds where a grasp hits nothing, until one succeeds."""
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
    """The best `count` proposals, taken from each group in turn, so that a push model's optimism favours no group.

    A group is a world with a kind of action and an object; groups are ordered by their best proposal.
    """
    groups: dict[tuple[int, int, int], list[_Proposal]] = {}
    for proposal in sorted(proposals, key=lambda proposal: proposal.expected):
        groups.setdefault(proposal.group, []).append(proposal)
    ranked = [(place, member.expected, member) for group in groups.values() for place, member in enumerate(group)]
    return [proposal for *_, proposal in sorted(ranked, key=lambda entry: entry[:2])[:count]]


def different(nodes: Sequence[Node], count: int) -> list[Node]:
    """The first `count` nodes whose worlds differ by more than `ALIKE`."""
    kept: list[Node] = []
    for node in nodes:
        if len(kept) < count and all(_apart(node, other) > ALIKE for other in kept):
            kept.append(node)
    return kept


def _apart(a: Node, b: Node) -> float:
    """Largest difference of a body's coordinates between two worlds [m]."""
    return float(np.abs(a.world.position - b.world.position)[a.world.valid].max())


def _first_step(actions: Action) -> tuple[int, ...]:
    """A key that is equal for first actions that count as the same."""
    parts = [actions.T_world_gripper[0], actions.displacement[0], actions.T_world_place[0], actions.q7[0]]
    numbers = np.concatenate([np.ravel(part) for part in parts])
    return (int(actions.kind[0]), int(actions.object[0]), *np.round(numbers / STEP).astype(int).tolist())


def _stacked(trees: Sequence[Any]) -> Any:
    """Pytrees as one with a leading axis."""
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *trees)
