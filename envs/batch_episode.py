"""The closed loop of `episode.run_episode` for many episodes: one batched look, decision and action per round.

Each episode has a slot. All slots look, decide and act together; an episode that ends leaves its slot to the next one,
so that short episodes do not wait for long ones. Looking and deciding happen a fixed number of slots at a time, those
that need it only: memory does not grow with the number of slots, and where the target is found nothing is planned.

The random numbers of an episode are its own. What it decides depends neither on its slot nor on its neighbours.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Protocol, runtime_checkable

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int, UInt

from mechsearch_jax import planner
from mechsearch_jax.actions import Action, no_action
from mechsearch_jax.envs.episode import (
    Choice,
    Deed,
    EpisodeLog,
    Recogniser,
    Snapshot,
    chosen,
    describe,
    distrust,
    objects_on_the_board,
    oracle,
    record,
    target_trouble,
    true_target_pose,
)
from mechsearch_jax.envs.mjx_simulator import RETRIEVE, Outcomes, Overflow
from mechsearch_jax.envs.push_models import push_models
from mechsearch_jax.envs.records import Episode
from mechsearch_jax.envs.world import TARGET, World
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.planner import Belief, GraspChoice, PlannerConfig, Problem
from mechsearch_jax.workspace.scenario import Scenario


@runtime_checkable
class BatchSimulator(Protocol):
    """Many worlds at once; `MjxSimulator` and `NativeWorlds` are such.

    Attributes:
      engine: what records call it.
      world: the present state of all worlds.
    """

    engine: str
    world: World | None

    def reset(self, scenarios: Sequence[Scenario]) -> World:
        """Begin with one world for each scenario."""
        ...

    def replace(self, scenarios: Mapping[int, Scenario]) -> World:
        """Begin anew in some of the worlds; the others stay exactly as they are."""
        ...

    def execute(self, actions: Action, active: Bool[Array, " worlds"] | None = None) -> Outcomes:
        """Execute an action in every active world; its kind may be `RETRIEVE` too."""
        ...


@dataclasses.dataclass(frozen=True)
class Start:
    """An episode to be run.

    Attributes:
      scenario: where everything stands at the start.
      seed: as of `run_episode`.
    """

    scenario: Scenario
    seed: int


class _Minds(flax.struct.PyTreeNode):
    """What the planner knows in every slot."""

    belief: Belief
    scene: Superquadrics


def _some(tree: Any, rows: Int[Array, " n"]) -> Any:
    """These rows of all leaves; the last one for rows beyond the end."""
    return jax.tree.map(lambda a: a[jnp.minimum(rows, a.shape[0] - 1)], tree)


@functools.partial(jax.jit, static_argnames=("config", "recogniser"))
def _look(
    problem: Problem,
    minds: _Minds,
    world: World,
    keys: Array,
    rows: Int[Array, " n"],
    config: PlannerConfig,
    recogniser: Recogniser,
) -> _Minds:
    """Recognise and believe in the slots `rows`."""

    def one(belief, here, key):
        seen = recogniser(key, Snapshot(problem.camera, problem.shelf, here))
        found, objects = jnp.asarray(seen.target_visible), seen.objects
        return _Minds(planner.observe_belief(problem, belief, objects, found, seen.target_pose, config), objects)

    here = _some(world, rows)
    # An empty shelf costs next to nothing.
    here = here.replace(valid=here.valid & (rows < len(world.kind))[:, None])
    new = jax.vmap(one)(_some(minds.belief, rows), here, _some(keys, rows))
    return jax.tree.map(lambda a, b: a.at[rows].set(b, mode="drop"), minds, new)


@jax.jit
def _grasp(
    problem: Problem, minds: _Minds, world: World, rows: Int[Array, " n"]
) -> tuple[GraspChoice, Bool[Array, " n"]]:
    """How to take out the target in the slots `rows`, as it is believed to be; and whether that is truly possible."""

    def one(scene, pose, here):
        truth = objects_on_the_board(Snapshot(problem.camera, problem.shelf, here))
        believed = planner.graspable_at(problem, scene, pose)
        return believed, planner.graspable_at(problem, truth, true_target_pose(here)).success

    return jax.vmap(one)(*_some((minds.scene, minds.belief.found_pose, world), rows))


@functools.partial(jax.jit, static_argnames=("config",))
def _decide(problem: Problem, minds: _Minds, keys: Array, rows: Int[Array, " n"], config: PlannerConfig) -> Choice:
    """Plan in the slots `rows`."""

    models = push_models(config.push_model)

    def one(key, mind):
        return chosen(planner.plan(key, problem, mind.belief, mind.scene, config, *models))

    mind = _some(minds, rows)
    active = (rows < keys.shape[0])[:, None]
    # Where the target can be nowhere and nothing stands, a plan costs next to nothing.
    belief = mind.belief.replace(exists=mind.belief.exists & active)
    scene = mind.scene.replace(valid=mind.scene.valid & active)
    return jax.vmap(one)(_some(keys, rows), _Minds(belief, scene))


@jax.jit
def _forget(problem: Problem, minds: _Minds, fresh: Bool[Array, " slots"]) -> _Minds:
    """Let the fresh slots know nothing."""
    nothing = planner.initial_belief(problem)
    belief = jax.tree.map(
        lambda new, old: jnp.where(fresh.reshape(-1, *[1] * new.ndim), new[None], old), nothing, minds.belief
    )
    return minds.replace(belief=belief)


@jax.jit
def _keys_at(data: UInt[Array, "slots 2 *words"], steps: Int[Array, " slots"]) -> tuple[Array, Array]:
    """The planner's and the environment's key of every slot at its present step."""
    keys, fold = jax.random.wrap_key_data(data), jax.vmap(jax.random.fold_in)
    return fold(keys[:, 0], steps), fold(keys[:, 1], steps)


class _Clock:
    """Wall time of the stages of a round, shared equally by the slots that took part."""

    def __init__(self, slots: int, busy: Callable[[str, int], None]) -> None:
        self._timings: list[dict[str, float]] = [{} for _ in range(slots)]
        self._busy = busy

    @contextmanager
    def __call__(self, stage: str, rows: Sequence[int]) -> Iterator[None]:
        if rows:
            self._busy(stage, len(rows))
        start = time.perf_counter()
        yield
        share = (time.perf_counter() - start) / max(len(rows), 1)
        for row in rows:
            self._timings[row][stage] = round(share, 6)

    def timings(self, row: int) -> dict[str, float]:
        return self._timings[row]


def run_episodes(
    starts: Iterable[Start],
    problem: Problem,
    config: PlannerConfig,
    simulator: BatchSimulator,
    slots: int,
    ended: Callable[[Sequence[tuple[int, Episode]]], None],
    recogniser: Recogniser = oracle,
    recognition: str = "oracle",
    at_once: int = 64,
    busy: Callable[[str, int], None] = lambda stage, episodes: None,
) -> None:
    """Run episodes to their ends, many at a time.

    Args:
      starts: the episodes.
      problem: built for the target of all their scenarios.
      config: the planner's options.
      simulator: executes the actions; reset first.
      slots: how many episodes run at the same time, at most.
      ended: told after every round of the episodes that ended in it, if any, with their places in `starts`.
      recogniser: what the planner sees the world through; must be traceable.
      recognition: what the records call it.
      at_once: how many slots look or decide in one computation.
      busy: told of every stage, with the number of slots in it.

    Raises:
      InputError: the push model that `config` names cannot be used.
    """
    queue = enumerate(starts)
    first = [pair for _, pair in zip(range(slots), queue, strict=False)]
    if not first:
        return
    count = len(first)
    crew = _Crew(problem, config, simulator, recogniser, recognition, min(at_once, count), busy)
    crew.begin(dict(enumerate(first)))
    while crew.running:
        done = crew.round()
        if done:
            ended([pair for _, pair in done])
            crew.begin({slot: pair for (slot, _), pair in zip(done, queue, strict=False)})


@dataclasses.dataclass
class _Slot:
    """An episode that is running: its place among all, and what is known of it."""

    place: int
    start: Start
    log: EpisodeLog


class _Crew:
    """All slots, and what happens in a round."""

    def __init__(self, problem, config, simulator, recogniser, recognition, at_once, busy):
        self._problem: Problem = problem
        self._config: PlannerConfig = config
        self._simulator: BatchSimulator = simulator
        self._recogniser: Recogniser = recogniser
        self._recognition: str = recognition
        self._at_once: int = at_once
        self._busy: Callable[[str, int], None] = busy
        self._slots: list[_Slot | None] = []
        self._keys: UInt[np.ndarray, "slots 2 *words"] = np.zeros((0, 2, 2), np.uint32)
        self._minds: _Minds | None = None

    @property
    def running(self) -> bool:
        """Whether any episode has not ended."""
        return any(self._slots)

    def begin(self, starts: Mapping[int, tuple[int, Start]]) -> None:
        """Begin episodes in slots that are free."""
        if not starts:
            return
        scenarios = {slot: start.scenario for slot, (_, start) in starts.items()}
        if self._minds is None:
            world = self._simulator.reset(list(scenarios.values()))
            self._slots = [None] * len(starts)
            key = jax.random.key_data(jax.random.key(0))
            self._keys = np.zeros((len(starts), 2, *key.shape), key.dtype)
            look = jax.eval_shape(
                lambda here: self._recogniser(
                    jax.random.key(0), Snapshot(self._problem.camera, self._problem.shelf, here)
                ),
                jax.tree.map(lambda a: a[0], world),
            )
            one = (planner.initial_belief(self._problem), look.objects)
            self._minds = _Minds(*jax.tree.map(lambda a: jnp.zeros((len(starts), *a.shape), a.dtype), one))
        else:
            self._simulator.replace(scenarios)
        fresh = np.zeros(len(self._slots), bool)
        for slot, (place, start) in starts.items():
            self._slots[slot] = _Slot(place, start, EpisodeLog(self._config))
            self._keys[slot] = jax.random.key_data(jax.random.split(jax.random.key(start.seed)))
            fresh[slot] = True
        self._minds = _forget(self._problem, self._minds, jnp.asarray(fresh))

    def _chunks(self, rows: Sequence[int]) -> Iterator[tuple[Sequence[int], Array]]:
        """Rows, so many at once, with the same padded to a fixed number."""
        for i in range(0, len(rows), self._at_once):
            some = rows[i : i + self._at_once]
            padded = np.full(self._at_once, len(self._slots), np.int32)
            padded[: len(some)] = some
            yield some, jnp.asarray(padded)

    def round(self) -> list[tuple[int, tuple[int, Episode]]]:
        """Look, decide and act once in all slots; the slots whose episodes ended, with their places and records."""
        problem, config, simulator = self._problem, self._config, self._simulator
        world, minds = simulator.world, self._minds
        assert world is not None
        assert minds is not None
        slots, count = self._slots, len(self._slots)
        logs = {row: slot.log for row, slot in enumerate(slots) if slot is not None}
        running = sorted(logs)
        clock = _Clock(count, self._busy)
        steps = jnp.array([slot.log.index if slot else 0 for slot in slots], jnp.int32)
        planner_keys, environment_keys = _keys_at(jnp.asarray(self._keys), steps)

        with clock("recognise", running):
            for _, rows in self._chunks(running):
                minds = _look(problem, minds, world, environment_keys, rows, config, self._recogniser)
            known = jax.device_get((minds.belief.found, jnp.sum(minds.belief.exists, axis=1)))
        self._minds = minds
        found, possible = known
        here = jax.device_get((world.position[:, TARGET], world.rotation[:, TARGET]))
        trouble = {r: target_trouble(problem.shelf, here[0][r], here[1][r]) if found[r] else None for r in running}

        grasps: dict[int, GraspChoice] = {}
        truly = np.zeros(count, bool)
        sought = [r for r in running if found[r] and trouble[r] is None]
        with clock("grasp", sought):
            for some, rows in self._chunks(sought):
                choice, possible_in_truth = jax.device_get(_grasp(problem, minds, world, rows))
                truly[some] = possible_in_truth[: len(some)]
                grasps |= {r: jax.tree.map(lambda a, i=i: a[i], choice) for i, r in enumerate(some)}
        grasps = {r: choice for r, choice in grasps.items() if choice.success}

        choices: dict[int, Choice] = {}
        undecided = [r for r in running if r not in grasps and trouble[r] is None and not logs[r].last]
        with clock("plan", undecided):
            for some, rows in self._chunks(undecided):
                choice = jax.device_get(_decide(problem, minds, planner_keys, rows, config))
                choices |= {r: jax.tree.map(lambda a, i=i: a[i], choice) for i, r in enumerate(some)}

        errors = {r: distrust(choice) for r, choice in choices.items()}
        for r in running:
            size = 1 if found[r] else int(possible[r])
            choice = None if errors.get(r) else choices.get(r)
            logs[r].decide(record(bool(found[r]), size, bool(truly[r]), grasps.get(r), choice, config))

        acting = [r for r in running if logs[r].acts]
        outcomes = None
        with clock("simulate", acting):
            if acting:
                actions = _actions(count, grasps, choices)
                active = np.isin(np.arange(count), acting)
                outcomes = jax.device_get(simulator.execute(actions, jnp.asarray(active)))

        done: list[tuple[int, tuple[int, Episode]]] = []
        for r in running:
            deed = None
            if outcomes is not None and r in acting:
                deed = _deed(outcomes, r, choices.get(r))
                errors[r] = errors.get(r) or _overflow(outcomes, r)
            if logs[r].act(deed, errors.get(r) or trouble[r], clock.timings(r)):
                slot = slots[r]
                assert slot is not None
                options = describe(slot.start.seed, problem, config, self._recognition, simulator.engine)
                done.append((r, (slot.place, slot.log.episode(slot.start.scenario, options))))
                slots[r] = None
        return done


def _actions(count: int, grasps: Mapping[int, GraspChoice], choices: Mapping[int, Choice]) -> Action:
    """What every slot does; nothing where nothing was decided."""
    idle = jax.device_get(no_action())
    all_actions = jax.tree.map(lambda a: np.broadcast_to(a, (count, *np.shape(a))).copy(), idle)
    for row, choice in choices.items():
        for name in Action.__dataclass_fields__:
            getattr(all_actions, name)[row] = getattr(choice.action, name)
    for row, grasp in grasps.items():
        all_actions.kind[row] = RETRIEVE
        all_actions.object[row] = TARGET
        for name in ("T_world_gripper", "q7", "opening"):
            getattr(all_actions, name)[row] = getattr(grasp, name)
        all_actions.T_world_place[row] = grasp.T_world_gripper
    return jax.tree.map(jnp.asarray, all_actions)


def _deed(outcomes: Outcomes, row: int, choice: Choice | None) -> Deed:
    """What came of a slot's action, or of its retrieval where nothing was chosen."""
    reason = outcomes.reason(row)
    if choice is None:
        return Deed.of_retrieval(bool(outcomes.retrieved[row]), reason)
    return Deed.of_action(int(choice.action.kind), reason)


def _overflow(outcomes: Outcomes, row: int) -> str | None:
    """What was too small for a world's contacts; None if nothing was."""
    flags = Overflow(int(outcomes.overflow[row]))
    if flags is Overflow.NONE:
        return None
    names = ", ".join(str(flag.name).lower() for flag in Overflow if flag and flag in flags)
    return f"error: the simulator's buffers were too small ({names})"
