"""Why what blocks or hides a target was not moved away: candidates, what they promised, trials, and actions."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import numpy as np

from mechsearch_jax.envs.known_target.in_the_way import numbers_in_words
from mechsearch_jax.envs.page.facts import (
    DISPLACED,
    LEAST_GAIN,
    moves,
    number,
    same_action,
    same_motion,
    shifts,
    takes_target,
)
from mechsearch_jax.envs.recording.recording import RecordedStep, Recording
from mechsearch_jax.envs.world.world import TARGET
from mechsearch_jax.planner.noted_trials import nothing_tried
from mechsearch_jax.planner.trials import TrialResult

# How trials end that stand against an action.
_ENDS = {
    TrialResult.FAILED: "failed (held up, out of reach, or out of the hand)",
    TrialResult.HARMFUL: "did harm (something fell off the board, or the found target fell over)",
    TrialResult.UNKNOWN: "had no result",
}


def reasons(recording: Recording, objects: Sequence[int]) -> list[str]:
    """Why objects stayed in the way of the target, or of the view of it: sentences.

    Of a target that was found at the last look the steps count at which it was, of another one all.

    Args:
      recording: of the episode.
      objects: in the way; of the first it is said, too, what moved it.
    """
    last = recording.steps[-1]
    since = [i for i, step in enumerate(recording.steps) if step.found == last.found]
    total = sum(len(_candidates(recording.steps[i])) for i in since)
    if not total:
        return []
    when = " since it was seen" if last.found else ""
    every = f"the {total} candidate actions{when}" if total > 1 else f"the only candidate action{when}"
    sentences, hopeless = [], last.found and _hopeless([recording.steps[i] for i in since])
    if hopeless:
        refused = any(r for i in since for _, r in _candidates(recording.steps[i]))
        left = " that trials left" if refused else ""
        sentences = [f"No candidate action{when}{left} was expected to lower J."]
        every = f"all {total}" if refused else f"these {total}"
    for i in objects:
        sentences += [_considered(recording, since, i, every, not hopeless), _trials(recording, since, i)]
        every = "them"
    sentences += [_carried_out(recording, since, i) for i in objects[:1]]
    if last.found and last.evidence is not None and not len(last.evidence.hits):
        sentences.append(_considered(recording, since, last.scene.capacity, every, False))
    return [sentence for sentence in sentences if sentence]


def _hopeless(steps: Sequence[RecordedStep]) -> bool:
    """Whether no candidate of some steps promised anything; False of a policy that minds no cost."""
    value, cost = (np.concatenate([getattr(step.sampled, name) for step in steps]) for name in ("value", "cost"))
    return bool(len(value)) and bool(cost.any()) and bool(value.min() >= -LEAST_GAIN)


def _considered(recording: Recording, since: Sequence[int], k: int, every: str, promised: bool) -> str:
    """How many candidates were to move an object, what they promised, and when there was none.

    Args:
      recording: of the episode.
      since: the steps that count.
      k: the object; one more than the last stands for the target.
      every: all candidates of these steps, in words.
      promised: whether to say what they promised.
    """
    rows = {i: _candidates(recording.steps[i]) for i in since}
    to = "to push the target itself" if k == recording.steps[-1].scene.capacity else f"to move object {k}"
    of_it = {i: refused for i in since if (refused := [r for moved, r in rows[i] if moved == k])}
    if not of_it:
        return f"None of {every} was {to}."
    count, refused = sum(map(len, of_it.values())), sum(map(sum, of_it.values()))
    remarks = [f"{refused} refused after trials"] if refused else []
    remarks += _when_none([i for i in since if rows[i]], list(of_it))
    remarked = f" ({', '.join(remarks)})" if remarks else ""
    promise = _promised(recording, since, k, "the others" if refused else "which") if promised else ""
    return f"{count} of {every} {'was' if count == 1 else 'were'} {to}{remarked}{promise}."


def _when_none(every: list[int], of_it: list[int]) -> list[str]:
    """Before and after which actions no candidate was to move an object.

    Args:
      every: the steps with candidates.
      of_it: those of them with some for the object.
    """
    words = [f"none before action {of_it[0] + 1}"] if of_it[0] != every[0] else []
    later = [i for i in every if i > of_it[-1]]
    return [*words, f"none from action {later[0] + 1} on"] if later else words


def _promised(recording: Recording, since: Sequence[int], k: int, them: str) -> str:
    """What the best candidates for an object were expected to change J by, beside what was chosen; may be empty.

    Args:
      recording: of the episode.
      since: the steps that count.
      k: the object.
      them: the candidates of which that is recorded, in words.
    """
    best = {}
    for i in since:
        kept = recording.steps[i].sampled
        of_it = kept.value[kept.action.object == k]
        if len(of_it) and kept.cost.any():
            best[i] = float(of_it.min())
    if not best:
        return ""
    i = min(best, key=lambda i: best[i])
    if best[i] > LEAST_GAIN:
        return f", each of {them} was expected to raise J, by at least {number(best[i])}{_unseen(recording, i, k)}"
    promising = [j for j in best if best[j] < -LEAST_GAIN]
    if not promising:
        return f", none of {them} was expected to lower J"
    early, step = promising[0] == next(iter(best)), recording.steps[i]
    chosen = [float(v) for row, v in enumerate(step.sampled.value) if same_action(step, step.sampled.action, row)]
    words = f"; the best was expected to lower J by {number(-best[i])}"
    if not early:
        words = f", and none before action {promising[0] + 1} was expected to lower J; the best, by {number(-best[i])}"
    if _moves_object(step, k) and chosen and chosen[0] <= best[i]:
        return f"{words} (action {i + 1})" if early else f"{words}, was action {i + 1}"
    there = f", where {number(max(-chosen[0], 0.0))} was expected of the chosen action" if chosen else ""
    return f"{words} (at step {i + 1}{there})" if early else f"{words}, came at step {i + 1}{there}"


def _unseen(recording: Recording, i: int, k: int) -> str:
    """That the best candidate for an object at a step was expected to lower J, but for what it may move unseen.

    Empty if it was not, and of sequences of several actions, of which only the first one's J is recorded.
    """
    episode, kept = recording.episode, recording.steps[i].sampled
    if episode is None or episode.config.get("horizon") != 1 or (before := episode.steps[i].cost) is None:
        return ""
    row = int(np.argmin(np.where(kept.action.object == k, kept.value, np.inf)))
    after = float(kept.cost[row])
    if after > before - LEAST_GAIN:
        return ""
    price = float(kept.value[row]) - (after - before)
    return (
        f" (J would fall from {number(before)} to {number(after)}, but that it may touch the hidden target counts as"
        f" {number(price)})"
    )


def _trials(recording: Recording, since: Sequence[int], k: int) -> str:
    """How the trials ended that stood against moving an object; empty if none did."""
    results = []
    for i in since:
        evidence = recording.steps[i].evidence
        tried = nothing_tried() if evidence is None else evidence.tried
        for row, result in enumerate(tried.result.tolist()):
            action = jax.tree.map(lambda a, row=row: a[row], tried.action)
            if moves(action) and int(action.object) == k:
                results.append(TrialResult(result))
    ends = [(results.count(result), end) for result, end in _ENDS.items() if result in results]
    if not ends:
        return ""
    if len(results) == 1:
        return f"The only trial of moving object {k} {ends[0][1]}."
    if ends[0][0] == len(results):
        return f"All {len(results)} trials of moving object {k} {ends[0][1]}."
    counts = " and ".join(f"{count} {end}" for count, end in ends)
    if len(ends) > 1:
        return f"Of {len(results)} trials of moving object {k}, {counts}."
    return f"{ends[0][0]} of the {len(results)} trials of moving object {k} {ends[0][1]}."


def _carried_out(recording: Recording, since: Sequence[int], k: int) -> str:
    """Which actions were to move an object, how far it moved, and which others moved it along."""
    acts = [i for i in since if recording.steps[i].action is not None]
    if not acts:
        return ""
    moved = {i: float(shifts(recording, i)[k]) for i in acts}
    own = [i for i in acts if _moves_object(recording.steps[i], k)]
    along = [i for i in acts if i not in own and moved[i] > DISPLACED]
    aside = ""
    if along:
        length = f"{100 * min(moved[i] for i in along):.1f}", f"{100 * max(moved[i] for i in along):.1f}"
        by = " to ".join(dict.fromkeys(length))
        aside = f"; {_actions(along)} moved it along, by {by} cm"
    if not own:
        none = f"None of the {len(acts)} actions was" if len(acts) > 1 else "The only action was not"
        return f"{none} to move object {k}{aside or ', and it stayed where it was'}."
    were = f"{_actions(own).capitalize()} {'was' if len(own) == 1 else 'were'} to move object {k}"
    far = sum(moved[i] for i in own)
    if max(moved[i] for i in own) <= DISPLACED:
        return f"{were}, and it stayed where it was{aside}."
    return f"{were}, by {100 * far:.0f} cm{' in all' if len(own) > 1 else ''}, and left it in the way{aside}."


def _actions(indices: Sequence[int]) -> str:
    """Actions by their numbers."""
    return f"{'action' if len(indices) == 1 else 'actions'} {numbers_in_words([i + 1 for i in indices])}"


def _moves_object(step: RecordedStep, k: int) -> bool:
    return step.action is not None and moves(step.action) and int(step.action.object) == k


def _candidates(step: RecordedStep) -> list[tuple[int, bool]]:
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


def moved_in_words(recording: Recording, i: int, target: bool = True) -> str:
    """What a step moved, each with how far; empty if nothing.

    Args:
      recording: of the episode.
      i: index of the step.
      target: whether the target counts.
    """
    far = shifts(recording, i)
    moved = [k for k in np.argsort(-far, kind="stable").tolist() if far[k] > DISPLACED and (target or k != TARGET)]
    named = [f"{'the target' if k == TARGET else f'object {k}'} by {100 * far[k]:.0f} cm" for k in moved]
    return " and ".join([", ".join(named[:-1]), named[-1]] if len(named) > 1 else named)
