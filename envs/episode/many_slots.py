"""What the planner knows in several slots, which look and decide together."""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from mechsearch_jax.actions import Action, no_action
from mechsearch_jax.belief.belief import without_grasps
from mechsearch_jax.envs.camera.sensing import Sensing, in_base
from mechsearch_jax.envs.camera.snapshot import Recogniser, Sight, Snapshot, Truth, sight_of, truth_of, truth_unseen
from mechsearch_jax.envs.episode.episode_log import Choice, chosen, takes_target
from mechsearch_jax.envs.episode.policy_numbers import as_pytree, compile_key, numbers, with_numbers
from mechsearch_jax.envs.episode.slots import BeliefSummary, is_blind, may_be_blind, sizes_and_truths, summary
from mechsearch_jax.envs.episode.verdicts import Verdict, graspable_many, judge_many, judged_sets
from mechsearch_jax.envs.world.world import World
from mechsearch_jax.planner import Decision, Policy, Problem, initial_belief
from mechsearch_jax.planner.step import SearchState, believe, propose, unsearched
from mechsearch_jax.planner.trials import TrialResult, Trials, TrialScenes, TwoStagePolicy, choose, scenes_of
from mechsearch_jax.runtime.compiled import cached_jit
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.session.preparing import Program, program


@runtime_checkable
class PreparesTrials(Protocol):
    """`Trials` that know the programs which they will call."""

    def programs(self, problem: Problem) -> Sequence[Program]:
        """Those for the scenes of a problem."""
        ...


class Question(NamedTuple):
    """What a policy is called for.

    Attributes:
      method: its name; one of a policy that `TwoStagePolicy`, or "__call__".
      hidden: whether the target is found in none of the slots.
    """

    method: str
    hidden: bool = False


HIDDEN, FOUND, RETRIEVAL = Question("planned", hidden=True), Question("planned"), Question("retrieval")
ANYTHING = Question("__call__")


class SlotState(PyTreeNode):
    """What the planner knows in every slot, and the truth of its looks; fields have a leading axis for the slots."""

    search: SearchState
    truth: Truth


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
        sensing: Sensing | None = None,
    ) -> None:
        """Args:
        problem: of all episodes.
        policy: of all slots that have none of their own.
        recogniser: must be traceable, as the policy.
        world: of all slots, or its shapes, for what recognisers make of it.
        at_once: how many slots are looked at or decided upon in one computation.
        trials: what tries actions out before one is made; nothing if left out.
        sensing: of any slot, for what recognisers make of it.
        """
        self._problem, self._trials = problem, trials
        self._policy, self._compile_key = as_pytree(policy), compile_key(policy)
        self._recogniser, self._sight = recogniser, sight_of(problem.camera, problem.shelf, problem.target)
        self._at_once = at_once
        self._count = len(world.kind)
        self._numbers = [numbers(self._policy)] * self._count
        self._sensings: list[Sensing | None] = [None] * self._count
        # Of all slots, its fields with a leading axis for them.
        self._sensing: Sensing | None = None
        # Policies that were looked at, by what tells objects apart while they are kept.
        self._policies: dict[int, tuple[Policy, tuple[np.ndarray, ...]]] = {}
        shapes = jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape[1:], a.dtype), world)
        seen = jax.eval_shape(
            lambda here, sensed: recogniser(
                jax.random.key(0), Snapshot(problem.camera, problem.shelf, here, self._sight, sensed)
            ),
            shapes,
            sensing,
        )
        empty = SlotState(unsearched(problem, seen), truth_unseen())
        self._state: SlotState = jax.tree.map(
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
        questions = [HIDDEN, FOUND, RETRIEVAL] if isinstance(self._policy, TwoStagePolicy) else [ANYTHING]
        calls = [(self._policy, own, problem, state.search, keys, rows, question) for question in questions]

        def choosing(call: tuple[Any, ...]) -> Callable[[], None] | None:
            decision, _ = _propose.returns(*call)
            results = None
            if self._trials is not None and decision.alternatives is not None:
                results = jax.ShapeDtypeStruct(decision.alternatives.worth.shape, np.int32)
            return _choose.begin(decision, results, active)

        return [
            *(program("plan", _propose, *call) for call in calls),
            *(self._trials.programs(problem) if isinstance(self._trials, PreparesTrials) else ()),
            *(Program("small ones", lambda: False, functools.partial(choosing, call)) for call in calls),
            program("look", _look, problem, state, world, keys, rows, self._recogniser, self._sight, self._sensing),
            program("judge", graspable_many, judged_sets(problem), problem.camera, few, active),
            program("small ones", sizes_and_truths, problem, state.search.belief.exists, world),
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
        if id(policy) not in self._policies:
            if compile_key(policy) != self._compile_key:
                raise InputError("run_episodes: policies of one run that differ in more than numbers need runs each")
            self._policies[id(policy)] = policy, numbers(as_pytree(policy))
        return self._policies[id(policy)][1]

    def sense_by(self, sensings: Mapping[int, Sensing | None]) -> None:
        """See `Slots`."""
        for row, sensing in sensings.items():
            self._sensings[row] = sensing
        if len({jax.tree.structure(sensing) for sensing in self._sensings}) > 1:
            raise InputError("run_episodes: mismatches of one run that differ in more than numbers need runs each")
        self._sensing = jax.tree.map(lambda *leaves: jax.device_put(np.stack(leaves)), *self._sensings)

    def look(self, world: World, keys: Array, rows: Sequence[int]) -> BeliefSummary:
        """See `Slots`."""
        for _, padded in self._chunks(rows):
            self._state = _look(
                self._problem, self._state, world, keys, padded, self._recogniser, self._sight, self._sensing
            )
        now = self._state.search
        return summary(self._problem, now.belief, self._state.truth, in_base(world, self._sensing))

    def decide(self, keys: Array, rows: Sequence[int], last: Collection[int] = ()) -> dict[int, Choice]:
        """See `Slots`.

        Whether to take a target out is decided only where it is found, and a plan made only where it is not taken out.
        What is worth trying out is tried in all slots together.
        """
        if not isinstance(self._policy, TwoStagePolicy):
            return self._ask(ANYTHING, keys, rows, last)
        there = np.asarray(self._state.search.belief.found)
        choices = self._ask(RETRIEVAL, keys, [r for r in rows if there[r]], last)
        choices = {r: choice for r, choice in choices.items() if takes_target(choice)}
        choices |= self._ask(FOUND, keys, [r for r in rows if there[r] and r not in choices], last)
        return choices | self._ask(HIDDEN, keys, [r for r in rows if not there[r]], last)

    def _ask(self, question: Question, keys: Array, rows: Sequence[int], last: Collection[int]) -> dict[int, Choice]:
        """What the policy answers to a question in the slots of a chunk, after trials; see `_propose`."""
        chunks = list(self._chunks(rows))
        proposed = []
        for chunk, padded in chunks:
            # Rows beyond the end decide by anything.
            each = [self._numbers[r] for r in chunk] + [self._numbers[chunk[0]]] * (self._at_once - len(chunk))
            own = tuple(np.stack(values) for values in zip(*each, strict=True))
            proposed.append(_propose(self._policy, own, self._problem, self._state.search, keys, padded, question))
        choices: dict[int, Choice] = {}
        for (chunk, padded), (decision, _), results in zip(
            chunks, proposed, self._tried([chunk for chunk, _ in chunks], proposed), strict=True
        ):
            over = np.array([r in last for r in chunk] + [False] * (self._at_once - len(chunk)))
            decided = _choose(decision, results, jax.device_put(over))
            self._state = _note(self._state, decided.action, padded)
            if may_be_blind(self._state.search.belief):
                decided = decided.replace(blind=_blind(self._problem, self._state.search, padded))
            choice = jax.device_get(decided)
            choices |= {r: jax.tree.map(lambda a, i=i: a[i], choice) for i, r in enumerate(chunk)}
        return choices

    def _tried(
        self, chunks: Sequence[Sequence[int]], proposed: Sequence[tuple[Decision, TrialScenes]]
    ) -> Sequence[Int[np.ndarray, "n k"] | None]:
        """What becomes of the alternatives of decisions in chunks of slots; None where nothing is tried.

        Args:
          chunks: the slots of each chunk; further rows are beyond the end.
          proposed: decisions and scenes of each chunk.
        """
        if self._trials is None or any(decision.alternatives is None for decision, _ in proposed) or not proposed:
            return [None] * len(proposed)
        counts = [len(chunk) for chunk in chunks]
        rows = [
            jax.tree.map(lambda a, count=count: a[:count], jax.device_get((scenes, decision.alternatives)))
            for count, (decision, scenes) in zip(counts, proposed, strict=True)
        ]
        scenes, alternatives = jax.tree.map(lambda *leaves: np.concatenate(leaves), *rows)
        results = self._trials(self._problem, scenes, alternatives.actions, alternatives.worth)
        blank = np.full((self._at_once, results.shape[1]), TrialResult.UNKNOWN, np.int32)
        parts = np.split(results, np.cumsum(counts)[:-1])
        return [np.concatenate([part, blank[len(part) :]]).astype(np.int32) for part in parts]

    def judge(self, world: World, rows: Sequence[int]) -> dict[int, Verdict]:
        """See `Slots`."""
        judged: dict[int, Verdict] = {}
        for chunk, padded in self._chunks(rows):
            active = jax.device_put(np.asarray(padded) < self._count)
            verdicts = judge_many(self._problem, _some_worlds(world, padded), active)
            judged |= dict(zip(chunk, verdicts, strict=False))
        return judged

    def _chunks(self, rows: Sequence[int]) -> Iterator[tuple[Sequence[int], Array]]:
        """Rows, so many at once, and the same padded to a fixed number with rows beyond the end."""
        for i in range(0, len(rows), self._at_once):
            chunk = rows[i : i + self._at_once]
            padded = np.full(self._at_once, self._count, np.int32)
            padded[: len(chunk)] = chunk
            yield chunk, jax.device_put(padded)


def _strong(tree: Any) -> Any:
    """The same, with nothing of a weak type: what takes it is compiled once, whatever a policy returns."""
    return jax.tree.map(lambda a: jax.lax.convert_element_type(a, jnp.result_type(a)), tree)


def _rows_of(tree: Any, rows: Int[Array, " n"]) -> Any:
    """These rows of all leaves; the last one for rows beyond the end."""
    return jax.tree.map(lambda a: a[jnp.minimum(rows, a.shape[0] - 1)], tree)


@cached_jit()
def _some_worlds(world: World, rows: Int[Array, " n"]) -> World:
    """The worlds in the slots `rows`, empty ones for rows beyond the end."""
    here = _rows_of(world, rows)
    return here.replace(valid=here.valid & (rows < len(world.kind))[:, None])


@cached_jit()
def _blind(problem: Problem, state: SearchState, rows: Int[Array, " n"]) -> Bool[Array, " n"]:
    """`is_blind` in the slots `rows`."""
    return jax.vmap(functools.partial(is_blind, problem))(_rows_of(state, rows))


@cached_jit()
def _forget(problem: Problem, state: SlotState, fresh: Bool[Array, " slots"]) -> SlotState:
    """Let the fresh slots know nothing."""
    search = state.search
    belief, action = jax.tree.map(
        lambda new, old: jnp.where(fresh.reshape(-1, *[1] * new.ndim), new[None], old),
        (initial_belief(problem), no_action()),
        (search.belief, search.action),
    )
    return SlotState(
        search.replace(belief=belief, action=action), state.truth.replace(shown=state.truth.shown & ~fresh)
    )


@cached_jit()
def _note(state: SlotState, action: Action, rows: Int[Array, " n"]) -> SlotState:
    """Keep what was decided in the slots `rows` until the next look."""
    action = jax.tree.map(lambda a, b: a.at[rows].set(b, mode="drop"), state.search.action, action)
    return state.replace(search=state.search.replace(action=action))


@cached_jit(static_argnames=("recogniser",))
def _look(
    problem: Problem,
    state: SlotState,
    world: World,
    keys: Array,
    rows: Int[Array, " n"],
    recogniser: Recogniser,
    sight: Sight,
    sensing: Sensing | None,
) -> SlotState:
    """Recognise and update the belief in the slots `rows`, with the sight of the problem's camera."""

    def look(slot, here, key, sensed):
        snapshot = Snapshot(problem.camera, problem.shelf, here, sight, sensed)
        observation = recogniser(key, snapshot)
        truth = truth_of(recogniser, snapshot, observation).since(slot.truth, observation)
        return SlotState(believe(problem, slot.search, observation), truth)

    new = jax.vmap(look)(
        _rows_of(state, rows), _some_worlds(world, rows), _rows_of(keys, rows), _rows_of(sensing, rows)
    )
    return jax.tree.map(lambda a, b: a.at[rows].set(b, mode="drop"), state, new)


@cached_jit(static_argnames=("question",))
def _propose(
    policy: Policy,
    own: tuple[Array, ...],
    problem: Problem,
    state: SearchState,
    keys: Array,
    rows: Int[Array, " n"],
    question: Question,
) -> tuple[Decision, TrialScenes]:
    """What the policy proposes in the slots `rows`, and the scenes to try it in.

    The numbers in `own`, shape (n,) each, are in place of the policy's own. The question is static.
    """

    def ask(values, key, slot):
        decision = propose(with_numbers(policy, values), question.method, key, problem, slot)
        return _strong((decision, scenes_of(slot.belief, slot.observation)))

    here, active = _rows_of(state, rows), rows < keys.shape[0]
    # Where the target is not found and can be nowhere, and nothing stands, a decision costs next to nothing.
    belief, objects = here.belief, here.observation.objects
    belief = belief.replace(exists=belief.exists & active[:, None], found=belief.found & active)
    belief = without_grasps(belief) if question.hidden else belief
    observation = here.observation.replace(objects=objects.replace(valid=objects.valid & active[:, None]))
    return jax.vmap(ask)(own, _rows_of(keys, rows), here.replace(belief=belief, observation=observation))


@cached_jit()
def _choose(decisions: Decision, results: Int[Array, "n k"] | None, last: Bool[Array, " n"]) -> Choice:
    """What decisions come down to after trials, of which there may have been none; `last` as for `choose`."""
    if results is not None:
        decisions = jax.vmap(choose)(decisions, results, last)
    return jax.vmap(chosen)(decisions)
