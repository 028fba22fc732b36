"""How episodes are run and judged: strictly, or as the authors' published code does (docs/method.md, "Protocols")."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from mechsearch_jax.actions import Action, ActionKind, no_action
from mechsearch_jax.envs.camera.snapshot import Recogniser, Snapshot, detects, is_the_target
from mechsearch_jax.envs.episode.episode_log import Choice, takes_target
from mechsearch_jax.envs.episode.slots import Slots
from mechsearch_jax.envs.episode.verdicts import Verdict
from mechsearch_jax.envs.simulators.simulator import Simulator
from mechsearch_jax.envs.world.outcome import Failure, Outcome
from mechsearch_jax.envs.world.world import World
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner import PlannerConfig, ProblemConfig
from mechsearch_jax.workspace.shelf import Shelf

ProtocolName = Literal["strict", "published-code"]

# Reasons for which an episode under `PublishedCode` ends, beside those of `EpisodeLog`.
REACHED = "graspable: nothing is taken out by this protocol"
HIDDEN_AGAIN = "the target is hidden again"
OUTSIDE = "something is outside the shelf"
ALL_FAILED = "every action that was tried failed"


class Execution(NamedTuple):
    """The execution of a round's decisions.

    Attributes:
      outcome: in all worlds, on the host; of the last action that was tried.
      choices: the executed choice of each slot.
      stuck: the slots in which every action failed; their worlds are as before.
    """

    outcome: Outcome
    choices: dict[int, Choice]
    stuck: frozenset[int] = frozenset()


class EpisodeProtocol(Protocol):
    """How episodes are run and judged; hashable."""

    @property
    def name(self) -> ProtocolName: ...

    def problem(self, config: ProblemConfig) -> ProblemConfig:
        """The settings of the episodes' problem, from the method's."""
        ...

    def planner(self, config: PlannerConfig) -> PlannerConfig:
        """The settings of the episodes' policy, from the method's."""
        ...

    def recogniser(self, inner: Recogniser) -> Recogniser:
        """The policy's recogniser, from the method's."""
        ...

    def judge(self, slots: Slots, world: World, rows: Sequence[int]) -> dict[int, Verdict]:
        """The verdicts in slots where the target has been found."""
        ...

    def ends(
        self,
        shelf: Shelf,
        world: World,
        rows: Sequence[int],
        verdicts: Mapping[int, Verdict],
        choices: Mapping[int, Choice],
    ) -> dict[int, str]:
        """The slots whose episode ends before anything is executed, with the reasons."""
        ...

    @property
    def once(self) -> bool:
        """Whether a decision is executed only once, even if it fails."""
        ...

    def execute(self, simulator: Simulator, choices: Mapping[int, Choice]) -> Execution:
        """Execute the choices of at least one slot."""
        ...


@dataclasses.dataclass(frozen=True)
class Strict:
    """Every action counts, even if it fails, and the target has to be taken out."""

    name: ProtocolName = "strict"
    once: bool = True

    def problem(self, config: ProblemConfig) -> ProblemConfig:
        return config

    def planner(self, config: PlannerConfig) -> PlannerConfig:
        return config

    def recogniser(self, inner: Recogniser) -> Recogniser:
        return inner

    def judge(self, slots: Slots, world: World, rows: Sequence[int]) -> dict[int, Verdict]:
        """On the true state."""
        return slots.judge(world, rows)

    def ends(self, shelf, world, rows, verdicts, choices) -> dict[int, str]:
        return {}

    def execute(self, simulator: Simulator, choices: Mapping[int, Choice]) -> Execution:
        return Execution(_executed(simulator, choices), dict(choices))


@dataclasses.dataclass(frozen=True)
class PublishedCode:
    """The protocol of the authors' code.

    The sampled first actions are tried best first; if one fails, or something leaves the board, the world is set back
    and the next is tried, all within one step. An episode fails if all have failed, or if something is outside the
    shelf at the beginning of a step. It succeeds if the target is in sight, and the sweep of gripper and target at some
    candidate grasp hits neither the recognised objects nor the shelf; nothing is taken out. A found target's true pose
    is observed.
    """

    name: ProtocolName = "published-code"
    once: bool = False

    def problem(self, config: ProblemConfig) -> ProblemConfig:
        """A found target is grasped with the candidates' grasps only."""
        return dataclasses.replace(config, retrieval=config.grasps)

    def planner(self, config: PlannerConfig) -> PlannerConfig:
        """The target is not to be taken out with a grasp that hits something: that would end the search in vain."""
        return dataclasses.replace(config, retrieval_contact=False)

    def recogniser(self, inner: Recogniser) -> Recogniser:
        return WithTruePose(inner)

    def judge(self, slots: Slots, world: World, rows: Sequence[int]) -> dict[int, Verdict]:
        """`graspable` as defined by this protocol; `paper_graspable` on the true state."""
        free, strict = slots.swept_free(rows), slots.judge(world, rows)
        return {r: Verdict(free[r], strict[r].paper_graspable) for r in rows}

    def ends(
        self,
        shelf: Shelf,
        world: World,
        rows: Sequence[int],
        verdicts: Mapping[int, Verdict],
        choices: Mapping[int, Choice],
    ) -> dict[int, str]:
        position, valid = jax.device_get((world.position, world.valid))
        outside = np.any(valid & ((position[..., 0] < shelf.front) | (position[..., 2] < shelf.board)), axis=1)
        taking = {r: HIDDEN_AGAIN for r in rows if r in choices and takes_target(choices[r])}
        reached = {r: REACHED for r in rows if r in verdicts and verdicts[r].graspable}
        return taking | reached | {r: OUTSIDE for r in rows if outside[r]}

    def execute(self, simulator: Simulator, choices: Mapping[int, Choice]) -> Execution:
        before, left, taken = simulator.world, dict(choices), dict(choices)
        assert before is not None
        count, rank = len(before.kind), 0
        outcome = _executed(simulator, left)
        while left:
            bad = {r for r in left if _is_bad(left[r], outcome, r)}
            if bad:
                simulator.load(before, np.isin(np.arange(count), list(bad)))
            rank += 1
            left = {r: _next(choices[r], rank) for r in bad if _has(choices[r], rank)}
            stuck = {r for r in bad if r not in left}
            taken = {r: choice for r, choice in (taken | left).items() if r not in stuck}
            if left:
                latest = _executed(simulator, left)
                outcome = _where(np.isin(np.arange(count), list(left)), latest, outcome)
        return Execution(outcome, taken, frozenset(choices.keys() - taken.keys()))


PROTOCOLS: Mapping[str, EpisodeProtocol] = {"strict": Strict(), "published-code": PublishedCode()}


@dataclasses.dataclass(frozen=True)
class WithTruePose:
    """A `Recogniser` that replaces the pose of a seen target by the true one, as the oracle sees it.

    What is not the target, though a recogniser of images takes it for that, keeps the pose that was recognised.
    """

    inner: Recogniser

    @property
    def detects_target(self) -> bool:
        """As of the inner recogniser."""
        return detects(self.inner)

    def __call__(self, key: Array, snapshot: Snapshot) -> Observation:
        seen, true = self.inner(key, snapshot), snapshot.target_pose
        if not self.detects_target:
            return seen.replace(target_pose=true)
        return seen.replace(target_pose=jnp.where(is_the_target(snapshot, seen), true, seen.target_pose))


def _executed(simulator: Simulator, choices: Mapping[int, Choice]) -> Outcome:
    """The outcomes of choices; worlds without a choice do nothing."""
    assert simulator.world is not None
    return jax.device_get(simulator.execute(*chosen_actions(choices, len(simulator.world.kind))))


def chosen_actions(choices: Mapping[int, Choice], count: int) -> tuple[Action, Array]:
    """The actions of `count` worlds, by bodies' numbers, NONE without a choice, and which worlds have a choice."""
    actions: Action = jax.tree.map(
        lambda a: np.broadcast_to(a, (count, *np.shape(a))).copy(), jax.device_get(no_action())
    )
    for row, choice in choices.items():
        for name in Action.__dataclass_fields__:
            getattr(actions, name)[row] = getattr(choice.executed, name)
    return jax.device_put((actions, np.isin(np.arange(count), list(choices))))


def _is_bad(choice: Choice, outcome: Outcome, row: int) -> bool:
    """Whether an action is undone; never if the simulator's buffers overflowed."""
    failed = int(outcome.failure[row]) != Failure.NONE or int(choice.action.kind) == ActionKind.NONE
    return (failed or bool(np.any(outcome.fallen[row]))) and not int(outcome.overflow[row])


def _has(choice: Choice, rank: int) -> bool:
    """Whether there is an action of this rank, from 0 for the best; none follows a choice to do nothing."""
    kinds = np.zeros(0) if choice.others is None else np.asarray(choice.others.kind)
    nothing = int(choice.action.kind) == ActionKind.NONE
    return not nothing and rank < len(kinds) and int(kinds[rank]) != ActionKind.NONE


def _next(choice: Choice, rank: int) -> Choice:
    """The choice with the action of a rank instead of the best one; its predicted cost is not known."""
    return choice.replace(
        action=jax.tree.map(lambda a: a[rank], choice.others), predicted_cost=np.float32(np.nan), others=None
    )


def _where(rows: np.ndarray, new: Outcome, old: Outcome) -> Outcome:
    """The new outcome in the worlds `rows`, the old one in the others."""
    return jax.tree.map(lambda a, b: np.where(rows.reshape(-1, *[1] * (np.ndim(a) - 1)), a, b), new, old)
