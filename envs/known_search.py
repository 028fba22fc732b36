"""A search with everything known: whatever can be tried is tried in copies of the simulated world.

It tells whether a scene can be solved at all by the actions that there are. Nothing is hidden from it: it plans with
the true poses of all objects and of the target from the start, and it may take back what went wrong. A beam of worlds
is kept. From each, sequences are sampled as the planner does; the best of them are executed in copies of their worlds,
and of the worlds that come of it those are kept in which the target is nearest to being graspable. A world in which an
object has left the board, or the target has fallen, is given up.
"""

from __future__ import annotations

import dataclasses
import functools
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mechsearch_jax.actions import Action, kind_of, no_action
from mechsearch_jax.envs.episode_log import target_trouble
from mechsearch_jax.envs.outcome import Outcome
from mechsearch_jax.envs.records import ActionRecord, record_action
from mechsearch_jax.envs.simulator import Simulator
from mechsearch_jax.envs.snapshot import Snapshot, objects_on_the_board, true_target_pose
from mechsearch_jax.envs.world import TARGET, World
from mechsearch_jax.errors import InputError
from mechsearch_jax.geometry.transforms import upright_pose
from mechsearch_jax.graspability import no_hits, pairs
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner import Belief, Problem, Search, Sequences, initial_belief
from mechsearch_jax.planner.found_target import found_grasps, found_hits
from mechsearch_jax.planner.objective import SearchForGrasp
from mechsearch_jax.planner.retrieval import GraspChoice, best_grasps
from mechsearch_jax.planner.rollout import Rollout, plan
from mechsearch_jax.workspace.scenario import Scenario

# Worlds in which no body is farther than this from where it is in another are the same to a beam [m].
ALIKE = 0.005
# First actions that agree to this are the same, in metres and entries of a rotation.
STEP = 0.002


@dataclasses.dataclass(frozen=True)
class KnownSearchConfig:
    """How much is tried.

    Attributes:
      simulated: how many sequences are executed in a round.
      beam: how many worlds are kept from one round to the next.
      grasps: with how many grasps it is tried to take the target out of a world where one hits nothing.
      retrievals: from how many worlds of a round that is tried, at most.
      max_steps: number of actions, taking the target out among them.
      seed: of what is sampled.
    """

    simulated: int = 32
    beam: int = 4
    grasps: int = 8
    retrievals: int = 4
    max_steps: int = 30
    seed: int = 0

    def __post_init__(self):
        for name in ("simulated", "beam", "grasps", "retrievals", "max_steps"):
            if getattr(self, name) < 1:
                raise InputError(f"KnownSearchConfig: {name} {getattr(self, name)} must be at least 1")


@dataclasses.dataclass(frozen=True)
class InFullView(SearchForGrasp):
    """How far the target is from graspable where it is known to be: it may stand hidden."""

    def cost(self, problem, belief, exists, target_at, hits, crowding_weight) -> Float[Array, ""]:
        nowhere_hidden = jnp.zeros_like(exists)
        return super().cost(problem, belief, nowhere_hidden, target_at, hits, crowding_weight)


class Judgement(flax.struct.PyTreeNode):
    """How far the target of a world is from graspable, by the dense grasps of a found target.

    Attributes:
      cost: J of the planner, of this target alone.
      feasible: which grasps arm and shelf allow, shape (F,).
      hits: which objects each of these hits on its whole way, shape (F, N).
    """

    cost: Float[Array, "*batch"]
    feasible: Bool[Array, "*batch f"]
    hits: Bool[Array, "*batch f n"]

    @property
    def least(self) -> int | None:
        """How many objects the best grasp hits; None where none is feasible. Of a single world."""
        return int(self.hits.sum(axis=1)[self.feasible].min()) if self.feasible.any() else None


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
    search: Search,
    simulator: Simulator,
    config: KnownSearchConfig | None = None,
    told: Callable[[int, Node], None] = lambda round, best: None,
) -> Found:
    """Look for actions that take the target out.

    Args:
      scenario: where everything stands at the start.
      problem: built for its target.
      search: samples sequences and predicts them; its objective should be `InFullView`.
      simulator: executes actions in as many worlds as are asked for.
      config: how much is tried.
      told: after every round, of its number and of the best world so far.
    """
    running = _Running(scenario, problem, search, simulator, config or KnownSearchConfig())
    while running.goes_on:
        running.round()
        told(running.rounds, running.best)
    return running.found()


@functools.partial(jax.jit, static_argnames=("objective",))
def _judge(problem: Problem, objective: Any, weight: Array | float, world: World, active: Bool[Array, ""]) -> Judgement:
    """See `Judgement`; little is computed where `active` is false."""
    here = Snapshot(problem.camera, problem.shelf, world)
    belief = _known(problem, world, active)
    hits = found_hits(problem, belief.grasps, objects_on_the_board(here), active)
    nowhere = jnp.zeros_like(belief.exists)
    rows = jnp.concatenate([no_hits(pairs(problem.grasps), hits.shape[1]), hits])
    cost = objective.cost(problem, belief, nowhere, nowhere, rows, weight)
    return Judgement(cost, belief.grasps.feasible, hits & belief.grasps.feasible[:, None])


def _known(problem: Problem, world: World, active: Bool[Array, ""] | bool = True) -> Belief:
    """The belief of who knows where the target is."""
    pose = true_target_pose(world)
    grasps = found_grasps(problem, upright_pose(pose, problem.target.height(problem.shelf)), active)
    return initial_belief(problem).replace(found=jnp.array(True), found_pose=pose, grasps=grasps)


@jax.jit
def _sample(search: Search, key: Array, problem: Problem, world: World) -> Sequences:
    """Sequences of actions from a world, best first, as the planner samples them."""
    here = Snapshot(problem.camera, problem.shelf, world)
    seen = Observation(objects_on_the_board(here), jnp.array(True), true_target_pose(world))
    rollout = Rollout(problem, _known(problem, world), search.config, search.propose, search.predict, search.objective)
    return plan(rollout, key, seen.objects).sequences


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


class _Running:
    """A search under way."""

    def __init__(
        self, scenario: Scenario, problem: Problem, search: Search, simulator: Simulator, config: KnownSearchConfig
    ) -> None:
        self._problem, self._search, self._simulator, self._config = problem, search, simulator, config
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
        self._beam: list[Node] = [self._start]
        self._take_out(self._beam)

    @property
    def goes_on(self) -> bool:
        """Whether there is anything left to be tried."""
        return self._solution is None and bool(self._beam)

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
        """Sample from all worlds of the beam, execute the best, and keep the best worlds that come of it."""
        key = jax.random.fold_in(jax.random.key(self._config.seed), self.rounds)
        keys = jax.random.split(key, len(self._beam))
        proposals = [one for node, k in zip(self._beam, keys, strict=True) for one in self._proposals(node, k)]
        self.rounds += 1
        nodes = self._execute(in_turn(proposals, self._config.simulated))
        nodes.sort(key=lambda node: (float(node.judgement.cost), len(node.actions)))
        if nodes and nodes[0].judgement.cost < self.best.judgement.cost:
            self.best = nodes[0]
        self._take_out([node for node in nodes if node.graspable])
        # One more action has to be left: to take the target out.
        last = self._config.max_steps - 1
        self._beam = different([node for node in nodes if len(node.actions) < last], self._config.beam)

    def _judge_one(self, world: World, active: Bool[Array, ""]) -> Judgement:
        search = self._search
        return _judge(self._problem, search.objective, search.config.crowding_weight, world, active)

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
        sequences = jax.device_get(_sample(self._search, key, self._problem, node.world))
        # One more action has to be left.
        room = self._config.max_steps - 1 - len(node.actions)
        found: dict[tuple[str | int, ...], _Proposal] = {}
        for i in np.flatnonzero(np.isfinite(sequences.value)):
            actions = jax.tree.map(lambda a, i=i: a[i], sequences.actions)
            expected = float(node.judgement.cost + sequences.value[i])
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
        trouble = target_trouble(self._problem.shelf, worlds.position[i, TARGET], worlds.rotation[i, TARGET])
        return trouble is None and not outcome.fallen[i].any() and bool(outcome.took_place[i])

    def _take_out(self, nodes: Sequence[Node]) -> None:
        """Try to take the target out of worlds in which a grasp hits nothing, until it is out."""
        for node in different(nodes, self._config.retrievals):
            if node.graspable and self._solution is None:
                grasps = retrievals_of(self._problem, node.world, self._config.grasps)
                actions = [jax.tree.map(lambda a, i=i: a[i], grasps.action) for i in np.flatnonzero(grasps.success)]
                self._simulator.load(_stacked([node.world] * len(actions)))
                outcome = self._acted(actions, range(len(actions)))
                self._retrievals.update(outcome.reason(i) or "" for i in range(len(actions)))
                if outcome.retrieved.any():
                    best = actions[int(np.argmax(outcome.retrieved))]
                    self._solution, self.best = (*node.actions, record_action(best)), node


def retrievals_of(problem: Problem, world: World, count: int) -> GraspChoice:
    """The best grasps of the target of a world, as `best_grasps` ranks them, as NumPy arrays."""
    objects = objects_on_the_board(Snapshot(problem.camera, problem.shelf, world))
    return jax.device_get(best_grasps(problem, objects, true_target_pose(jax.tree.map(jnp.asarray, world)), count))


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
