"""What went wrong in an episode and how it ended, in plain words: the same on the screen, in reports and on pages."""

from __future__ import annotations

from mechsearch_jax.envs.episode.records import Episode, Step

# Failures that records have as a single word or as the name of a state.
_WORDS = {
    "missed": "the hand missed the target",
    "inside": "the target did not leave the shelf",
    "fallen": "something fell off the board",
    "unreachable": "the arm cannot follow the motion",
    "dropped": "the object slipped out of the hand",
    "unstable": "the simulation diverged",
    "unknown": "the robot knows no such action",
    "found, but not graspable": "no grasp of it is free",
    "not found": "",
}


def in_words(failure: str) -> str:
    """A failure of a record in plain words; empty where being not found is all there is to say."""
    reason = failure.removeprefix("retrieval: ")
    return _WORDS.get(reason, reason)


def ending_words(found: bool, retrieved: bool, failure: str | None, actions: int) -> str:
    """How an episode ended, in one sentence.

    Args:
      found: whether the target ever was.
      retrieved, failure: as in `Episode`.
      actions: how many there were, attempts to take the target out among them.
    """
    after = f"after {actions} action{'' if actions == 1 else 's'}"
    if retrieved:
        return f"the target is out {after}"
    failure = failure or ""
    if failure.startswith("error: "):
        return f"the program failed {after}: {failure.removeprefix('error: ')}"
    why = in_words(failure)
    return f"the target was {'found, but is not out' if found else 'not found'} {after}{why and f': {why}'}"


def verdict(episode: Episode) -> str:
    """How an episode ended, and what had not come to rest by then, in one sentence after its scenario's name."""
    acts = [step for step in episode.steps if step.action is not None]
    how = ending_words(episode.found_step is not None, episode.retrieved, episode.failure, len(acts))
    return f"{episode.scenario}: {'; '.join([how, *(_restless(acts[-1]) if acts else ())])}"


def events(record: Step) -> list[str]:
    """Unintended events of a step, beside its `failure`."""
    messages = []
    if record.fallen:
        several = len(record.fallen) > 1
        which = " and ".join(map(str, record.fallen))
        messages.append(f"object{'s' if several else ''} {which} fell off the board: nothing can be retrieved any more")
    if record.target_fallen:
        messages.append("the target fell off the board")
    return [*messages, *_restless(record)]


def _restless(record: Step) -> tuple[str, ...]:
    """What did not come to rest after a step's action, as "object 0 leans on the back wall"."""
    return (record.restless or ("something still moves",)) if record.at_rest is False else ()
