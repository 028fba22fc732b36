"""The planner's state in the slots of an episode pool, and how it looks, decides and is judged there.

`OneSlot` calls the functions of a single scene, `many_slots.ManySlots` maps them over a fixed number of slots at a
time. They are separate because `vmap` computes both branches of a condition and requires that policy and recogniser are
traceable.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from mechsearch_jax.belief.belief import sweeps_unmeasured
from mechsearch_jax.belief.moved_target import nearest_candidate
from mechsearch_jax.envs.camera.sensing import Sensing, in_base
from mechsearch_jax.envs.camera.snapshot import Recogniser, Snapshot, Truth, true_target_pose, truth_of
from mechsearch_jax.envs.episode.episode_log import Choice, chosen
from mechsearch_jax.envs.episode.verdicts import Verdict, judge
from mechsearch_jax.envs.world.world import World
from mechsearch_jax.planner import Belief, Policy, Problem
from mechsearch_jax.planner.step import Decided, SearchState, believe, decide, unsearched
from mechsearch_jax.planner.trials import Trials
from mechsearch_jax.runtime.compiled import cached_jit


@dataclasses.dataclass(frozen=True)
class BeliefSummary:
    """The belief about the target in each of S slots after a look.

    Attributes:
      found: whether it is found, shape (S,).
      size: number of candidate poses where it can be.
      truth: whether it can be at the candidate pose nearest to its true pose.
      around: whether it can be at any candidate pose of that one's cell of the grid or of the eight cells around it.
      restarts: how often f was started anew.
      shown: whether what was taken for the target last was the target; see `snapshot.Truth`.
      bodies, there: of the last look, see `snapshot.Truth`; shape (S, 8).
    """

    found: Bool[np.ndarray, " slots"]
    size: Int[np.ndarray, " slots"]
    truth: Bool[np.ndarray, " slots"]
    around: Bool[np.ndarray, " slots"]
    restarts: Int[np.ndarray, " slots"]
    shown: Bool[np.ndarray, " slots"]
    bodies: Int[np.ndarray, "slots 8"]
    there: Bool[np.ndarray, "slots 8"]


class Slots(Protocol):
    """The planner's state in S slots."""

    def forget(self, fresh: Bool[np.ndarray, " slots"]) -> None:
        """Reset the fresh slots to the initial belief."""
        ...

    def decide_by(self, policies: Mapping[int, Policy | None]) -> None:
        """Set the policies of slots; None stands for the pool's policy.

        Raises:
          InputError: a policy cannot decide together with the others: it differs from them in more than numbers.
        """
        ...

    def sense_by(self, sensings: Mapping[int, Sensing | None]) -> None:
        """Set what the camera senses in slots; None for what the problem says.

        Raises:
          InputError: it differs between slots in more than numbers.
        """
        ...

    def look(self, world: World, keys: Array, rows: Sequence[int]) -> BeliefSummary:
        """Recognise and update the belief in the slots `rows`; the beliefs of all slots.

        Args:
          world: the true state, fields (S, ...).
          keys: the environment's, one for each slot.
          rows: the slots.
        """
        ...

    def decide(self, keys: Array, rows: Sequence[int], last: Collection[int] = ()) -> dict[int, Choice]:
        """The policy's choices in the slots `rows`.

        Args:
          keys: the planner's, one for each slot.
          rows: the slots.
          last: those in which no action after this one is allowed.
        """
        ...

    def judge(self, world: World, rows: Sequence[int]) -> dict[int, Verdict]:
        """The verdicts on the true state in the slots `rows`."""
        ...


class OneSlot:
    """A single slot.

    Attributes:
      snapshot: the shelf at the last look.
      state: what the search knows after it, and what was decided since; None before the first.
      decided: by the policy after trials; None between a look and its decision.
      truth: of the last look, and whether the target was detected at any; None before the first.
    """

    def __init__(self, problem: Problem, policy: Policy, recogniser: Recogniser, trials: Trials | None = None) -> None:
        """Args:
        problem: of the episode.
        policy, recogniser: need not be traceable.
        trials: in which actions are tried before one is made; None for no trials.
        """
        self.snapshot: Snapshot | None = None
        self.state: SearchState | None = None
        self.decided: Decided | None = None
        self.truth: Truth | None = None
        self._problem, self._usual, self._recogniser = problem, policy, recogniser
        self._policy, self._trials = policy, trials
        self._sensing: Sensing | None = None

    def forget(self, fresh: Bool[np.ndarray, " 1"]) -> None:
        """See `Slots`."""
        if fresh[0]:
            self.state, self.truth = None, None

    def decide_by(self, policies: Mapping[int, Policy | None]) -> None:
        """See `Slots`; accepts any policy."""
        for policy in policies.values():
            self._policy = self._usual if policy is None else policy

    def sense_by(self, sensings: Mapping[int, Sensing | None]) -> None:
        """See `Slots`."""
        self._sensing = sensings.get(0, self._sensing)

    def look(self, world: World, keys: Array, rows: Sequence[int]) -> BeliefSummary:
        """See `Slots`."""
        snapshot = dataclasses.replace(self._snapshot(world), sensing=self._sensing)
        observation = self._recogniser(keys[0], snapshot)
        before = unsearched(self._problem, observation) if self.state is None else self.state
        self.state = believe(self._problem, before, observation)
        truth = truth_of(self._recogniser, snapshot, observation)
        self.truth = truth if self.truth is None else truth.since(self.truth, observation)
        self.snapshot, self.decided = snapshot, None
        belief, seen = jax.tree.map(lambda a: jax.device_put(np.asarray(a)[None]), (self.state.belief, self.truth))
        return summary(self._problem, belief, seen, in_base(world, self._sensing))

    def decide(self, keys: Array, rows: Sequence[int], last: Collection[int] = ()) -> dict[int, Choice]:
        """See `Slots`."""
        if not rows:
            return {}
        assert self.state is not None
        self.decided = decide(self._policy, self._trials, keys[0], self._problem, self.state, last=0 in last)
        self.state = self.state.replace(action=self.decided.decision.action)
        choice = chosen(self.decided.decision)
        if may_be_blind(self.state.belief):
            choice = choice.replace(blind=is_blind(self._problem, self.state))
        return {0: jax.device_get(choice)}

    def judge(self, world: World, rows: Sequence[int]) -> dict[int, Verdict]:
        """See `Slots`."""
        return {r: judge(self._problem, self._snapshot(world)) for r in rows}

    def _snapshot(self, world: World) -> Snapshot:
        single = jax.tree.map(lambda a: jax.device_put(np.asarray(a)[0]), world)
        return Snapshot(self._problem.camera, self._problem.shelf, single)


def is_blind(problem: Problem, state: SearchState) -> Bool[Array, ""]:
    """Whether a state's action sweeps space that was not measured."""
    return sweeps_unmeasured(problem, state.belief, state.observation.objects, state.action)


def may_be_blind(belief: Belief) -> bool:
    """Whether in any slot a part of the board was not measured."""
    return bool(np.isfinite(np.asarray(belief.unmeasured)).any())


def summary(problem: Problem, belief: Belief, truth: Truth, world: World) -> BeliefSummary:
    """The beliefs of all slots; all fields, of the world in the base's frame, have a leading axis for them."""
    size, possible, around = sizes_and_truths(problem, belief.exists, world)
    fields = belief.found, size, possible, around, belief.restarts, truth.shown, truth.bodies, truth.there
    return BeliefSummary(*jax.device_get(fields))


@cached_jit()
def sizes_and_truths(problem: Problem, exists: Bool[Array, "slots x"], world: World) -> tuple[Array, Array, Array]:
    """Number of candidate poses where the target can be, whether it can be at the one nearest to the truth, and whether
    at any in that one's cell or in the eight around it."""
    poses, turn = problem.poses, problem.target.turn
    nearest = jax.vmap(lambda single: nearest_candidate(poses, true_target_pose(single), turn))(world)
    possible = jnp.take_along_axis(exists, nearest[:, None], axis=1)[:, 0]
    cells = jnp.any(exists.reshape(-1, *problem.target.grid, problem.target.yaws), axis=-1)
    row, column = jnp.divmod(nearest // problem.target.yaws, problem.target.grid[1])
    rows, columns = (jnp.arange(count)[None] for count in problem.target.grid)
    beside = (jnp.abs(rows - row[:, None]) <= 1)[:, :, None] & (jnp.abs(columns - column[:, None]) <= 1)[:, None]
    return jnp.sum(exists, axis=1), possible, jnp.any(cells & beside, axis=(1, 2))
