"""Why what blocks or hides a target was not moved away: candidates, what they promised, trials, and actions."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import numpy as np

from mechsearch_jax.envs.page import causes
from mechsearch_jax.envs.page.choices import begun, ways
from mechsearch_jax.envs.page.facts import (
    DISPLACED,
    LEAST_GAIN,
    actions_in_words,
    believed_elsewhere,
    blockers,
    candidates_of,
    counted,
    idle,
    moves,
    moves_body,
    number,
    promises_nothing,
    same_action,
    shifts,
    since_found,
    takes_target,
)
from mechsearch_jax.envs.page.places import groups, possible
from mechsearch_jax.envs.page.replays import trial_stop
from mechsearch_jax.envs.recording.recording import RecordedStep, Recording
from mechsearch_jax.envs.world.world import TARGET
from mechsearch_jax.planner.noted_trials import nothing_tried
from mechsearch_jax.planner.trials import TrialResult

# How trials end that stand against an action; of one that failed, where simulating it once more does not say why.
_ENDS = {
    TrialResult.FAILED: "failed (why is not known)",
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
    last, since = recording.steps[-1], since_found(recording)
    total = sum(len(candidates_of(recording.steps[i])) for i in since)
    if not total:
        return []
    when = " since it was seen" if last.found else ""
    every = f"the {total} candidate actions{when}" if total > 1 else f"the only candidate action{when}"
    sentences, hopeless = [], last.found and _hopeless([recording.steps[i] for i in since])
    if hopeless:
        refused = any(r for i in since for _, r in candidates_of(recording.steps[i]))
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
    rows = {i: candidates_of(recording.steps[i]) for i in since}
    to = "to push the target itself" if k == recording.steps[-1].scene.capacity else f"to move object {k}"
    of_it = {i: refused for i in since if (refused := [r for moved, r in rows[i] if moved == k])}
    if not of_it:
        return f"None of {every} was {to}{_why_none(recording, k)}."
    count, refused = sum(map(len, of_it.values())), sum(map(sum, of_it.values()))
    remarks = [f"{refused} refused after simulation"] if refused else []
    remarks += _when_none([i for i in since if rows[i]], list(of_it))
    remarked = f" ({', '.join(remarks)})" if remarks else ""
    promise = _promised(recording, since, k, "the others" if refused else "which") if promised else ""
    return f"{count} of {every} {'was' if count == 1 else 'were'} {to}{remarked}{promise}."


def _why_none(recording: Recording, k: int) -> str:
    """Why no candidate was to move an object, or that it is not known; of the target, which is not pushed, nothing."""
    if k >= recording.steps[-1].scene.capacity or not (steps := causes.impossible(recording, k)):
        return ""
    i = steps[-1]
    if why := causes.why_none(recording, i, k):
        return f" (at step {i + 1} {why})"
    could = begun(ways(recording, i, k) or ())
    some = f"{counted(could, 'motion')} of it could be begun at step {i + 1}, and " if could else ""
    return f" ({some}why none was a candidate is not known)"


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
    if moves_body(step, k) and chosen and chosen[0] <= best[i]:
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
    ends = []
    for i in since:
        evidence = recording.steps[i].evidence
        tried = nothing_tried() if evidence is None else evidence.tried
        for row, result in enumerate(tried.result.tolist()):
            action = jax.tree.map(lambda a, row=row: a[row], tried.action)
            if moves(action) and int(action.object) == k:
                stop = trial_stop(recording, i, row)
                ends.append(_ENDS.get(TrialResult(result), "") if stop is None else f"failed ({stop.words})")
    counts = [(ends.count(end), end) for end in dict.fromkeys(ends) if end]
    if not counts:
        return ""
    if len(ends) == 1:
        return f"The only trial of moving object {k} {counts[0][1]}."
    if counts[0][0] == len(ends):
        return f"All {len(ends)} trials of moving object {k} {counts[0][1]}."
    if len(counts) > 1:
        listed = " and ".join(f"{count} {end}" for count, end in counts)
        return f"Of {len(ends)} trials of moving object {k}, {listed}."
    return f"{counts[0][0]} of the {len(ends)} trials of moving object {k} {counts[0][1]}."


def _carried_out(recording: Recording, since: Sequence[int], k: int) -> str:
    """Which actions were to move an object, how far it moved, and which others moved it along."""
    acts = [i for i in since if recording.steps[i].action is not None]
    if not acts:
        return ""
    moved = {i: float(shifts(recording, i)[k]) for i in acts}
    own = [i for i in acts if moves_body(recording.steps[i], k)]
    along = [i for i in acts if i not in own and moved[i] > DISPLACED]
    aside = ""
    if along:
        length = f"{100 * min(moved[i] for i in along):.1f}", f"{100 * max(moved[i] for i in along):.1f}"
        by = " to ".join(dict.fromkeys(length))
        aside = f"; {actions_in_words(along)} moved it along, by {by} cm"
    if not own:
        none = f"None of the {len(acts)} actions was" if len(acts) > 1 else "The only action was not"
        return f"{none} to move object {k}{aside or ', and it stayed where it was'}."
    were = f"{actions_in_words(own).capitalize()} {'was' if len(own) == 1 else 'were'} to move object {k}"
    far = sum(moved[i] for i in own)
    if max(moved[i] for i in own) <= DISPLACED:
        return f"{were}, and it stayed where it was{aside}."
    return f"{were}, by {100 * far:.0f} cm{' in all' if len(own) > 1 else ''}, and left it in the way{aside}."


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


def did_nothing(recording: Recording, i: int) -> str:
    """Why a step's action did nothing for the search, and why it was chosen all the same; empty if it did something."""
    step = recording.steps[i]
    if not idle(recording, i) or step.action is None or takes_target(step):
        return ""
    record = None if recording.episode is None else recording.episode.steps[i]
    fell = record is not None and record.observed_cost is not None and record.observed_cost < (record.cost or 0.0)
    why = _in_vain(recording, i)
    chosen = [k for k in range(len(step.sampled)) if same_action(step, step.sampled.action, k)][:1]
    promised = [float(step.sampled.value[k]) for k in chosen]
    all_the_same = ""
    if promises_nothing(step):
        all_the_same = " It was made all the same, as no candidate was expected to lower J."
    elif promised and promised[0] < -LEAST_GAIN:
        all_the_same = f" J was expected to fall by {number(-promised[0])}."
    return (
        f"It did {'next to ' if fell else ''}nothing for the search{f', because {why}' if why else ''}.{all_the_same}"
    )


def _in_vain(recording: Recording, i: int) -> str:
    """Why J did not fall by an action, without an end; empty if that is not known."""
    step, action = recording.steps[i], recording.steps[i].action
    k = -1 if action is None else int(action.object)
    if not 0 <= k < step.scene.capacity:
        return ""
    if step.found and step.evidence is not None and not len(step.evidence.hits):
        return "the arm can reach no grasp of the target, whatever stands around it"
    if shifts(recording, i)[k] <= DISPLACED:
        return f"object {k} stayed where it was"
    after = recording.steps[i + 1] if i + 1 < len(recording.steps) else None
    if step.found:
        before, now = blockers(step), () if after is None else blockers(after)
        if before and k not in before:
            return f"object {k} is not in the way of the target’s best grasps"
        return f"object {k} is still in the way of the target’s best grasps" if k in now else ""
    if believed_elsewhere(step):
        return ""
    behind = {group.hider: group.count for group in groups(recording, step)}
    if k not in behind:
        return f"none of the places where the target can be is behind object {k}"
    if after is None or after.found or possible(recording, after).sum() < possible(recording, step).sum():
        return ""
    return "the target can be at as many places after it as before"
