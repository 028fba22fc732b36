"""What a recorded step holds, for those who explain it: its action in words, its trial, what it moved, what blocked."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float

from mechsearch_jax.actions import KINDS, Action, kind_of
from mechsearch_jax.envs.episode.episode_log import target_trouble
from mechsearch_jax.envs.episode.records import ActionRecord
from mechsearch_jax.envs.known_target.in_the_way import blocking, numbers_in_words
from mechsearch_jax.envs.page.pictures import hidden_behind, last_world
from mechsearch_jax.envs.pushing.pushes import toppled
from mechsearch_jax.envs.recording.recording import RecordedStep, Recording
from mechsearch_jax.envs.world.world import TARGET, World
from mechsearch_jax.planner.noted_trials import nothing_tried
from mechsearch_jax.planner.trials import TrialResult

# Failures of retrievals in the words of a page, and of other actions.
_RETRIEVAL = {
    "missed": "the hand missed the target",
    "inside": "the target did not leave the shelf",
    "unreachable": "the arm cannot follow the grasp",
    "unstable": "the simulation diverged",
}
_ACTION = {
    "unreachable": "the arm cannot follow the action",
    "dropped": "the object slipped out of the hand",
    "unstable": "the simulation diverged",
}
# Objects that hide a smaller share of the target are not named.
LEAST_SHARE = 0.05
# What moved less at an action counts as where it was [m].
DISPLACED = 0.01
# What lowers J by less promises nothing.
LEAST_GAIN = 0.05

# J that falls by no more than this share over the rest of an episode hardly falls; of fewer looks nothing is said.
HARDLY, FEWEST_LOOKS = 0.05, 3


def plain(failure: str) -> str:
    """A failure in plain words."""
    reason = failure.removeprefix("retrieval: ")
    return (_ACTION if reason == failure else _RETRIEVAL).get(reason, reason)


def counted(count: int, noun: str) -> str:
    """A number of things."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def number(cost: float) -> str:
    """A cost with as many digits as matter."""
    return f"{cost:.0f}" if abs(cost) >= 20 else f"{cost + 0.0:.1f}"


def moves(action: Action) -> bool:
    """Whether an action is to move an object, or to push the target."""
    return kind_of(int(action.kind)).moves_object


def takes_target(step: RecordedStep) -> bool:
    """Whether a step's action is to take the target out."""
    return step.action is not None and kind_of(int(step.action.kind)).takes_target


def moves_body(step: RecordedStep, k: int | str) -> bool:
    """Whether the action of a step is to move a body, by its number."""
    return step.action is not None and moves(step.action) and int(step.action.object) == k


def actions_in_words(indices: Sequence[int]) -> str:
    """Actions by their numbers."""
    return f"{'action' if len(indices) == 1 else 'actions'} {numbers_in_words([i + 1 for i in indices])}"


def candidates_of(step: RecordedStep) -> list[tuple[int, bool]]:
    """Of every candidate of a step, refused ones included, the object that it was to move, and if it was refused."""
    tried = nothing_tried() if step.evidence is None else step.evidence.tried
    singles = [jax.tree.map(lambda a, k=k: a[k], tried.action) for k in range(len(tried.result))]
    refused = [
        action
        for action, result in zip(singles, tried.result.tolist(), strict=True)
        if result <= TrialResult.HARMFUL and moves(action)
    ]
    left = [step.sampled.single(k) for k in range(len(step.sampled))]
    if takes_target(step):
        # A retrieval leaves the sequences as they are, refused ones among them.
        return [(int(action.object), any(same_motion(action, other) for other in refused)) for action in left]
    return [(int(action.object), False) for action in left] + [(int(action.object), True) for action in refused]


def since_found(recording: Recording) -> list[int]:
    """The steps that count for what is in the way at the end: those at which the target was found, or else all."""
    found = recording.steps[-1].found
    return [i for i, step in enumerate(recording.steps) if step.found == found]


def action_words(step: RecordedStep) -> str:
    """The action that a step decided on, in words."""
    return "nothing" if step.action is None else _in_words(step.action, step.scene.capacity)


def executed_words(recording: Recording, i: int) -> str:
    """The action that a step executed, in words; the protocol of the published code may replace the decided one."""
    step = recording.steps[i]
    record = None if recording.episode is None else recording.episode.steps[i].action
    if record is None or step.action is None or same_motion(record, step.action):
        return action_words(step)
    kinds = {kind.name: kind for kind in KINDS.values()}
    fields: dict[str, Any] = {f.name: np.asarray(getattr(record, f.name)) for f in dataclasses.fields(ActionRecord)[2:]}
    fields |= {"kind": kinds[record.kind].code, "object": -1 if record.object is None else record.object}
    return _in_words(Action(**fields), step.scene.capacity)


def _in_words(action: Action, capacity: int) -> str:
    return kind_of(int(action.kind)).describe(action, capacity)


def trial_of(step: RecordedStep, action: Action | None) -> TrialResult | None:
    """What the trial of an action came to at a step; None if it had none."""
    if step.evidence is None or action is None:
        return None
    tried = step.evidence.tried
    for k in range(len(tried.result)):
        if same_motion(action, jax.tree.map(lambda a, k=k: a[k], tried.action)):
            return TrialResult(int(tried.result[k]))
    return None


def same_action(step: RecordedStep, actions: Action, k: int) -> bool:
    """Whether the k-th of many actions is the one that the step decided on."""
    return step.action is not None and same_motion(step.action, jax.tree.map(lambda a: a[k], actions))


def same_motion(action: Action | ActionRecord, other: Action) -> bool:
    """Whether two actions are the same motion."""
    kind = action.kind if isinstance(action.kind, str) else kind_of(int(action.kind)).name
    names = ("T_world_gripper", "T_world_place", "displacement", "q7")
    return kind == kind_of(int(other.kind)).name and all(
        np.allclose(getattr(action, name), getattr(other, name), atol=1e-6) for name in names
    )


def world_after(recording: Recording, i: int) -> World:
    """The true state after a step."""
    return recording.steps[i + 1].world if i + 1 < len(recording.steps) else last_world(recording.steps[i])


def shifts(recording: Recording, i: int) -> Float[np.ndarray, " bodies"]:
    """How far each body moved at a step [m], the target last; 0 for those that are not there."""
    before, after = recording.steps[i].world, world_after(recording, i)
    moved = np.linalg.norm(np.asarray(after.position) - np.asarray(before.position), axis=-1)
    return np.where(np.asarray(before.valid), moved, 0.0)


def tipped(recording: Recording, i: int) -> list[int]:
    """The objects that a step tipped and that never left the board."""
    records = () if recording.episode is None else recording.episode.steps
    off = [k for record in records for k in record.fallen or ()]
    over = np.asarray(toppled(recording.steps[i].world, world_after(recording, i)))[:TARGET]
    return [k for k in np.flatnonzero(over).tolist() if k not in off]


def trouble(recording: Recording, step: RecordedStep) -> str | None:
    """Why the target could no longer be retrieved when the robot looked: it lay, or had left the board; else None."""
    place, rotation = (np.asarray(a)[TARGET] for a in (step.world.position, step.world.rotation))
    return target_trouble(recording.shelf, place, rotation, recording.target.solid.ends_alike)


def hiding(recording: Recording, step: RecordedStep) -> list[tuple[int, float]]:
    """The objects that hide much of the target from the camera, with its share."""
    hidden = hidden_behind(step, recording.camera, recording.shelf)
    return [(i, share) for i, share in hidden if share > LEAST_SHARE]


def believed_elsewhere(step: RecordedStep) -> bool:
    """Whether the robot takes something else for the target."""
    return not step.found and step.evidence is not None and bool(np.isfinite(step.evidence.believed_pose).all())


def free(hits: Bool[np.ndarray, "grasps n"]) -> bool:
    """Whether a grasp hits nothing."""
    return bool(len(hits)) and not hits.any(axis=1).all()


def blockers(step: RecordedStep) -> tuple[int, ...]:
    """The objects that the best grasps of the target hit at its true pose; empty if that is not recorded."""
    hits = None if step.evidence is None else step.evidence.hits
    return () if hits is None or not len(hits) else blocking(hits)


def target_is_out(recording: Recording) -> bool:
    """Whether the target is in front of the shelf at the end."""
    return bool(np.asarray(last_world(recording.steps[-1]).position)[TARGET, 0] < recording.shelf.front)


def stalled(recording: Recording) -> int | None:
    """The step from which on J fell no more, or hardly; None if it fell up to the end, or if no J is recorded."""
    costs = costs_of(recording)
    for i in range(len(costs) - FEWEST_LOOKS + 1):
        if costs[i] - min(costs[i:]) <= max(LEAST_GAIN, HARDLY * costs[i]):
            return i
    return None


def promises_nothing(step: RecordedStep) -> bool:
    """Whether no candidate action of a step that trials left was expected to lower J; False where there was none."""
    return len(step.sampled) > 0 and float(step.sampled.value.min()) >= -LEAST_GAIN


def idle(recording: Recording, i: int) -> bool:
    """Whether a step's action lowered J not, or hardly, or, where J after it was not observed, was not expected to.

    False where that is not recorded, and of a policy that minds no J.
    """
    record = None if recording.episode is None else recording.episode.steps[i]
    if record is None or record.action is None or record.cost is None or not record.compares_costs:
        return False
    since = stalled(recording)
    if record.observed_cost is not None and since is not None and i >= since:
        return True
    after = record.predicted_cost if record.observed_cost is None else record.observed_cost
    return after is not None and after >= record.cost - LEAST_GAIN


def costs_of(recording: Recording) -> list[float]:
    """J at every step before whose action it is recorded, from the first on; empty of a policy that minds none."""
    costs = []
    for record in () if recording.episode is None else recording.episode.steps:
        if record.cost is None or record.action is None or not record.compares_costs:
            break
        costs.append(record.cost)
    return costs
