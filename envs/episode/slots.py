"""What the planner knows in the slots of an episode pool, and how it looks, decides and is judged there.

`OneSlot` calls the functions of a single scene, `ManySlots` maps them over so many slots at a time. They cannot be the
same: mapped over, both branches of a condition are computed, and what is outside of any transformation need not be
traceable.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from mechsearch_jax.actions import Action, no_action
from mechsearch_jax.belief.belief import without_grasps
from mechsearch_jax.belief.moved_target import nearest_candidate
from mechsearch_jax.envs.camera.snapshot import Recogniser, Sight, Snapshot, sight_of, true_target_pose
from mechsearch_jax.envs.episode.episode_log import Choice, chosen, takes_target
from mechsearch_jax.envs.episode.policy_numbers import as_pytree, mould, numbers, with_numbers
from mechsearch_jax.envs.episode.verdicts import Verdict, graspable_many, judge, judge_many, judged_sets, swept_free
from mechsearch_jax.envs.world.world import World
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner import Belief, Decision, Policy, Problem, initial_belief, update_belief
from mechsearch_jax.planner.trials import AsksTwice, TrialResult, Trials, TrialScenes, choose, decide, scenes_of
from mechsearch_jax.runtime.compiled import kept
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.session.preparing import Program, program


@dataclasses.dataclass(frozen=True)
class Known:
    """What is known of the target in every slot after a look; S of them.

    Attributes:
      found: whether it is found, shape (S,).
      size: at how many candidate poses it can be.
      truth: whether it can be at the one that is nearest to its true pose.
      restarts: how often f was started anew.
    """

    found: Bool[np.ndarray, " slots"]
    size: Int[np.ndarray, " slots"]
    truth: Bool[np.ndarray, " slots"]
    restarts: Int[np.ndarray, " slots"]


class Slots(Protocol):
    """What the planner knows in every slot; S of them."""

    def forget(self, fresh: Bool[np.ndarray, " slots"]) -> None:
        """Let the fresh slots know nothing."""
        ...

    def decide_by(self, policies: Mapping[int, Policy | None]) -> None:
        """Let slots decide by policies of their own from now on; None stands for the policy of all.

        Raises:
          InputError: a policy cannot decide together with the others: it differs from them in more than numbers.
        """
        ...

    def look(self, world: World, keys: Array, rows: Sequence[int]) -> Known:
        """Recognise and update the belief in some slots; what is known then in all of them.

        Args:
          world: the true state, fields (S, ...).
          keys: the environment's, one for each slot.
          rows: the slots.
        """
        ...

    def decide(self, keys: Array, rows: Sequence[int]) -> dict[int, Choice]:
        """What the policy decides in some slots; `keys` are the planner's, one for each slot."""
        ...

    def took(self, actions: Mapping[int, Action]) -> None:
        """Let some slots know that something else is done than they decided."""
        ...

    def swept_free(self, rows: Sequence[int]) -> dict[int, bool]:
        """Whether in some slots the target is in sight, and what is swept at some grasp meets nothing; see
        `verdicts.swept_free`."""
        ...

    def judge(self, world: World, rows: Sequence[int]) -> dict[int, Verdict]:
        """Whether in some slots a collision-free grasp of the target exists, whatever anybody believes."""
        ...


@runtime_checkable
class PreparesTrials(Protocol):
    """`Trials` that know the programs which they will call."""

    def programs(self, problem: Problem) -> Sequence[Program]:
        """Those for the scenes of a problem."""
        ...


class OneSlot:
    """A single slot.

    Attributes:
      snapshot: what was there to be seen.
      observation: what was recognised.
      belief: what is known of the target.
      decision: of the policy; None since the last look.
      action: what was decided at the last look, to be executed before the next; of kind NONE before the first.
    """

    def __init__(self, problem: Problem, policy: Policy, recogniser: Recogniser, trials: Trials | None = None) -> None:
        """Args:
        problem: of the episode.
        policy, recogniser: need not be traceable.
        trials: what tries actions out before one is made; nothing if left out.
        """
        self.snapshot: Snapshot | None = None
        self.observation: Observation | None = None
        self.belief = initial_belief(problem)
        self.decision: Decision | None = None
        self.action: Action = no_action()
        self._problem, self._usual, self._recogniser = problem, policy, recogniser
        self._policy, self._trials = policy, trials

    def forget(self, fresh: Bool[np.ndarray, " 1"]) -> None:
        """See `Slots`."""
        if fresh[0]:
            self.belief = initial_belief(self._problem)
            self.action, self.observation = no_action(), None

    def decide_by(self, policies: Mapping[int, Policy | None]) -> None:
        """See `Slots`; any policy will do."""
        for policy in policies.values():
            self._policy = self._usual if policy is None else policy

    def look(self, world: World, keys: Array, rows: Sequence[int]) -> Known:
        """See `Slots`."""
        snapshot = self._snapshot(world)
        observation = self._recogniser(keys[0], snapshot)
        # Called the same at the first look, when nothing was done yet, so that nothing is compiled twice.
        before = observation if self.observation is None else self.observation
        self.belief = update_belief(self._problem, self.belief, observation, before, self.action)
        self.action = no_action()
        self.snapshot, self.observation, self.decision = snapshot, observation, None
        return _known(self._problem, jax.tree.map(lambda a: jax.device_put(np.asarray(a)[None]), self.belief), world)

    def decide(self, keys: Array, rows: Sequence[int]) -> dict[int, Choice]:
        """See `Slots`."""
        if not rows:
            return {}
        assert self.observation is not None
        self.decision = decide(self._policy, self._trials, keys[0], self._problem, self.belief, self.observation)
        self.action = self.decision.action
        return {0: jax.device_get(chosen(self.decision))}

    def took(self, actions: Mapping[int, Action]) -> None:
        """See `Slots`."""
        self.action = actions.get(0, self.action)

    def swept_free(self, rows: Sequence[int]) -> dict[int, bool]:
        """See `Slots`."""
        if not rows or self.observation is None:
            return {}
        return {0: bool(_swept_free(self._problem, self.observation, jnp.array(True)))}

    def judge(self, world: World, rows: Sequence[int]) -> dict[int, Verdict]:
        """See `Slots`."""
        return {r: judge(self._problem, self._snapshot(world)) for r in rows}

    def _snapshot(self, world: World) -> Snapshot:
        here = jax.tree.map(lambda a: jax.device_put(np.asarray(a)[0]), world)
        return Snapshot(self._problem.camera, self._problem.shelf, here)


class PlannerState(flax.struct.PyTreeNode):
    """What the planner knows in every slot; fields have a leading axis for the slots."""

    belief: Belief
    observation: Observation
    action: Action


class ManySlots:
    """Several slots, looked at and decided upon a fixed number at a time, those that need it only.

    Memory does not grow with the number of slots then. Where there are fewer slots to look at than that number, empty
    scenes take their places, which cost next to nothing.
    """

    def __init__(
        self,
        problem: Problem,
        policy: Policy,
        recogniser: Recogniser,
        world: World,
        at_once: int,
        trials: Trials | None = None,
    ) -> None:
        """Args:
        problem: of all episodes.
        policy: of all slots that have none of their own.
        recogniser: must be traceable, as the policy.
        world: of all slots, or its shapes, for what recognisers make of it.
        at_once: how many slots are looked at or decided upon in one computation.
        trials: what tries actions out before one is made; nothing if left out.
        """
        self._problem, self._trials = problem, trials
        self._policy, self._mould = as_pytree(policy), mould(policy)
        self._recogniser, self._sight = recogniser, sight_of(problem.camera, problem.shelf)
        self._at_once = at_once
        self._count = len(world.kind)
        self._numbers = [numbers(self._policy)] * self._count
        # Policies that were looked at, by what tells objects apart while they are kept.
        self._known: dict[int, tuple[Policy, tuple[np.ndarray, ...]]] = {}
        one = jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape[1:], a.dtype), world)
        seen = jax.eval_shape(
            lambda here: recogniser(jax.random.key(0), Snapshot(problem.camera, problem.shelf, here)), one
        )
        empty = PlannerState(initial_belief(problem), seen, no_action())
        self._state: PlannerState = jax.tree.map(
            lambda a: jax.device_put(np.zeros((self._count, *a.shape), a.dtype)), empty
        )

    def programs(self, world: World) -> list[Program]:
        """All that is compiled for these slots, the longest first.

        Args:
          world: of all slots, or its shapes.
        """
        rows = jax.ShapeDtypeStruct((self._at_once,), jnp.int32)
        keys = jax.eval_shape(lambda: jax.random.split(jax.random.key(0), self._count))
        own = tuple(jax.ShapeDtypeStruct((self._at_once, *a.shape), a.dtype) for a in numbers(self._policy))
        few = jax.tree.map(lambda a: jax.ShapeDtypeStruct((self._at_once, *a.shape[1:]), a.dtype), world)
        active = jax.ShapeDtypeStruct((self._at_once,), bool)
        done = jax.tree.map(lambda a: jax.ShapeDtypeStruct((self._at_once, *a.shape), a.dtype), no_action())
        fresh = jax.ShapeDtypeStruct((self._count,), bool)
        problem, state = self._problem, self._state
        twice = [("planned", True), ("planned", False), ("retrieval", False)]
        questions = twice if isinstance(self._policy, AsksTwice) else [("__call__", False)]
        calls = [(self._policy, own, problem, state, keys, rows, *how) for how in questions]

        def choosing(question: tuple[Any, ...]) -> Callable[[], None] | None:
            decision, _ = _propose.returns(*question)
            results = None
            if self._trials is not None and decision.alternatives is not None:
                results = jax.ShapeDtypeStruct(decision.alternatives.worth.shape, np.int32)
            return _choose.begin(decision, results)

        return [
            *(program("plan", _propose, *question) for question in calls),
            *(self._trials.programs(problem) if isinstance(self._trials, PreparesTrials) else ()),
            *(Program("small ones", lambda: False, functools.partial(choosing, question)) for question in calls),
            program("look", _look, problem, state, world, keys, rows, self._recogniser, self._sight),
            program("judge", graspable_many, judged_sets(problem), problem.camera, few, active),
            program("small ones", _told, problem.poses, state.belief.exists, world),
            program("small ones", _forget, problem, state, fresh),
            program("small ones", _note, state, done, rows),
            program("small ones", _some_worlds, world, rows),
        ]

    def forget(self, fresh: Bool[np.ndarray, " slots"]) -> None:
        """See `Slots`."""
        self._state = _forget(self._problem, self._state, jax.device_put(np.asarray(fresh)))

    def decide_by(self, policies: Mapping[int, Policy | None]) -> None:
        """See `Slots`."""
        for row, policy in policies.items():
            self._numbers[row] = numbers(self._policy) if policy is None else self._numbers_of(policy)

    def _numbers_of(self, policy: Policy) -> tuple[np.ndarray, ...]:
        if id(policy) not in self._known:
            if mould(policy) != self._mould:
                raise InputError("run_episodes: policies of one run that differ in more than numbers need runs each")
            self._known[id(policy)] = policy, numbers(as_pytree(policy))
        return self._known[id(policy)][1]

    def look(self, world: World, keys: Array, rows: Sequence[int]) -> Known:
        """See `Slots`."""
        for _, padded in self._chunks(rows):
            self._state = _look(self._problem, self._state, world, keys, padded, self._recogniser, self._sight)
        return _known(self._problem, self._state.belief, world)

    def decide(self, keys: Array, rows: Sequence[int]) -> dict[int, Choice]:
        """See `Slots`.

        Whether to take a target out is decided only where it is found, and a plan made only where it is not taken out.
        What is worth trying out is tried in all slots together.
        """
        if not isinstance(self._policy, AsksTwice):
            return self._ask("__call__", keys, rows)
        there = np.asarray(self._state.belief.found)
        choices = self._ask("retrieval", keys, [r for r in rows if there[r]])
        choices = {r: choice for r, choice in choices.items() if takes_target(choice)}
        choices |= self._ask("planned", keys, [r for r in rows if there[r] and r not in choices])
        return choices | self._ask("planned", keys, [r for r in rows if not there[r]], hidden=True)

    def _ask(self, question: str, keys: Array, rows: Sequence[int], hidden: bool = False) -> dict[int, Choice]:
        """What the policy answers to a question in some slots, after trials; see `_propose`."""
        chunks = list(self._chunks(rows))
        proposed = []
        for some, padded in chunks:
            # Rows beyond the end decide by anything.
            told = [self._numbers[r] for r in some] + [self._numbers[some[0]]] * (self._at_once - len(some))
            own = tuple(np.stack(values) for values in zip(*told, strict=True))
            proposed.append(_propose(self._policy, own, self._problem, self._state, keys, padded, question, hidden))
        found: dict[int, Choice] = {}
        for (some, padded), (decision, _), results in zip(
            chunks, proposed, self._tried([len(some) for some, _ in chunks], proposed), strict=True
        ):
            decided = _choose(decision, results)
            self._state = _note(self._state, decided.action, padded)
            choice = jax.device_get(decided)
            found |= {r: jax.tree.map(lambda a, i=i: a[i], choice) for i, r in enumerate(some)}
        return found

    def _tried(
        self, counts: Sequence[int], proposed: Sequence[tuple[Decision, TrialScenes]]
    ) -> Sequence[Int[np.ndarray, "n k"] | None]:
        """What becomes of the alternatives of decisions in chunks of slots; None where nothing is tried.

        Args:
          counts: how many rows of each chunk there are; the others are beyond the end.
          proposed: decisions and scenes of each chunk.
        """
        if self._trials is None or any(decision.alternatives is None for decision, _ in proposed) or not proposed:
            return [None] * len(proposed)
        rows = [
            jax.tree.map(lambda a, count=count: a[:count], jax.device_get((scenes, decision.alternatives)))
            for count, (decision, scenes) in zip(counts, proposed, strict=True)
        ]
        scenes, alternatives = jax.tree.map(lambda *leaves: np.concatenate(leaves), *rows)
        results = self._trials(self._problem, scenes, alternatives.actions, alternatives.worth)
        blank = np.full((self._at_once, results.shape[1]), TrialResult.UNKNOWN, np.int32)
        parts = np.split(results, np.cumsum(counts)[:-1])
        return [np.concatenate([part, blank[len(part) :]]).astype(np.int32) for part in parts]

    def took(self, actions: Mapping[int, Action]) -> None:
        """See `Slots`."""
        if actions:
            done = jax.tree.map(lambda *leaves: jnp.stack(leaves), *actions.values())
            self._state = _note(self._state, done, jnp.array(list(actions), jnp.int32))

    def swept_free(self, rows: Sequence[int]) -> dict[int, bool]:
        """See `Slots`."""
        found: dict[int, bool] = {}
        for some, padded in self._chunks(rows):
            free = jax.device_get(_swept_free_many(self._problem, self._state, padded))
            found |= dict(zip(some, map(bool, free), strict=False))
        return found

    def judge(self, world: World, rows: Sequence[int]) -> dict[int, Verdict]:
        """See `Slots`."""
        found: dict[int, Verdict] = {}
        for some, padded in self._chunks(rows):
            active = jax.device_put(np.asarray(padded) < self._count)
            verdicts = judge_many(self._problem, _some_worlds(world, padded), active)
            found |= dict(zip(some, verdicts, strict=False))
        return found

    def _chunks(self, rows: Sequence[int]) -> Iterator[tuple[Sequence[int], Array]]:
        """Rows, so many at once, and the same padded to a fixed number with rows beyond the end."""
        for i in range(0, len(rows), self._at_once):
            some = rows[i : i + self._at_once]
            padded = np.full(self._at_once, self._count, np.int32)
            padded[: len(some)] = some
            yield some, jax.device_put(padded)


def _strong(tree: Any) -> Any:
    """The same, with nothing of a weak type: what takes it is compiled once, whatever a policy returns."""
    return jax.tree.map(lambda a: jax.lax.convert_element_type(a, jnp.result_type(a)), tree)


def _some(tree: Any, rows: Int[Array, " n"]) -> Any:
    """These rows of all leaves; the last one for rows beyond the end."""
    return jax.tree.map(lambda a: a[jnp.minimum(rows, a.shape[0] - 1)], tree)


@kept()
def _some_worlds(world: World, rows: Int[Array, " n"]) -> World:
    """The worlds in the slots `rows`, empty ones for rows beyond the end."""
    here = _some(world, rows)
    return here.replace(valid=here.valid & (rows < len(world.kind))[:, None])


def _known(problem: Problem, belief: Belief, world: World) -> Known:
    """What is known in all slots; fields of belief and world have a leading axis for them."""
    size, truth = _told(problem.poses, belief.exists, world)
    return Known(*jax.device_get((belief.found, size, truth, belief.restarts)))


@kept()
def _told(poses: Array, exists: Bool[Array, "slots x"], world: World) -> tuple[Array, Array]:
    """At how many candidate poses the target can be, and whether at the one nearest to the truth."""
    nearest = jax.vmap(lambda here: nearest_candidate(poses, true_target_pose(here)))(world)
    return jnp.sum(exists, axis=1), jnp.take_along_axis(exists, nearest[:, None], axis=1)[:, 0]


@kept()
def _forget(problem: Problem, state: PlannerState, fresh: Bool[Array, " slots"]) -> PlannerState:
    """Let the fresh slots know nothing."""
    belief, action = jax.tree.map(
        lambda new, old: jnp.where(fresh.reshape(-1, *[1] * new.ndim), new[None], old),
        (initial_belief(problem), no_action()),
        (state.belief, state.action),
    )
    return state.replace(belief=belief, action=action)


@kept()
def _note(state: PlannerState, action: Action, rows: Int[Array, " n"]) -> PlannerState:
    """Keep what was decided in the slots `rows` until the next look."""
    return state.replace(action=jax.tree.map(lambda a, b: a.at[rows].set(b, mode="drop"), state.action, action))


@kept(static_argnames=("recogniser",))
def _look(
    problem: Problem,
    state: PlannerState,
    world: World,
    keys: Array,
    rows: Int[Array, " n"],
    recogniser: Recogniser,
    sight: Sight,
) -> PlannerState:
    """Recognise and update the belief in the slots `rows`, with the sight of the problem's camera."""

    def one(mine, here, key):
        observation = recogniser(key, Snapshot(problem.camera, problem.shelf, here, sight))
        belief = update_belief(problem, mine.belief, observation, mine.observation, mine.action)
        return PlannerState(belief, observation, no_action())

    new = jax.vmap(one)(_some(state, rows), _some_worlds(world, rows), _some(keys, rows))
    return jax.tree.map(lambda a, b: a.at[rows].set(b, mode="drop"), state, new)


@kept(static_argnames=("question", "hidden"))
def _propose(
    policy: Policy,
    own: tuple[Array, ...],
    problem: Problem,
    state: PlannerState,
    keys: Array,
    rows: Int[Array, " n"],
    question: str,
    hidden: bool,
) -> tuple[Decision, TrialScenes]:
    """What the policy decides in the slots `rows` before trials, and the scenes to try it in.

    The numbers in `own`, shape (n,) each, are in place of the policy's own. The question is "__call__", or one of those
    of a policy that `AsksTwice`, and `hidden` whether the target is found in none of the slots; both static.
    """

    def one(values, key, mine):
        ask = getattr(with_numbers(policy, values), question)
        return _strong((ask(key, problem, mine.belief, mine.observation), scenes_of(mine.belief, mine.observation)))

    mine, active = _some(state, rows), rows < keys.shape[0]
    # Where the target is not found and can be nowhere, and nothing stands, a decision costs next to nothing.
    belief = mine.belief.replace(exists=mine.belief.exists & active[:, None], found=mine.belief.found & active)
    belief = without_grasps(belief) if hidden else belief
    objects = mine.observation.objects
    objects = objects.replace(valid=objects.valid & active[:, None])
    seen = mine.observation.replace(objects=objects)
    return jax.vmap(one)(own, _some(keys, rows), mine.replace(belief=belief, observation=seen))


@kept()
def _choose(decisions: Decision, results: Int[Array, "n k"] | None) -> Choice:
    """What decisions come down to after trials, of which there may have been none."""
    if results is not None:
        decisions = jax.vmap(choose)(decisions, results)
    return jax.vmap(chosen)(decisions)


@kept()
def _swept_free(problem: Problem, seen: Observation, active: Bool[Array, ""]) -> Bool[Array, ""]:
    """See `Slots.swept_free`; False, and little is computed, where `active` is."""
    return swept_free(problem.target_grasps, seen.objects, seen.target_pose, active & seen.target_visible)


@kept()
def _swept_free_many(problem: Problem, state: PlannerState, rows: Int[Array, " n"]) -> Bool[Array, " n"]:
    """The same in the slots `rows`; False for rows beyond the end."""
    active = rows < state.belief.found.shape[0]
    return jax.vmap(lambda mine, active: _swept_free(problem, mine.observation, active))(_some(state, rows), active)
