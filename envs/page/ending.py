"""How a recorded episode ended, and if the target was lost, why: what the card at the top of its page says."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mechsearch_jax.envs.episode.records import Episode
from mechsearch_jax.envs.known_target.in_the_way import grasps_in_words, objects_in_words
from mechsearch_jax.envs.page.causes import cause
from mechsearch_jax.envs.page.facts import (
    DISPLACED,
    blockers,
    counted,
    executed_words,
    free,
    hiding,
    moves,
    plain,
    stalled,
    takes_target,
    tipped,
)
from mechsearch_jax.envs.page.pictures import target_pixels
from mechsearch_jax.envs.page.story import Paragraph, at_wall, belief_in_words, came_into_view, story
from mechsearch_jax.envs.recording.recording import RecordedStep, Recording
from mechsearch_jax.envs.world.world import TARGET
from mechsearch_jax.workspace.detector import found_pixels

_TRIAL = re.compile(r"\btrials?\b")


class Ending(NamedTuple):
    """How an episode ended.

    Attributes:
      good: whether the target was taken out; None if nothing says so.
      title: in a few words.
      sentences: what happened.
      blockers: the objects that the best grasps of the target hit; empty if none does or nothing is known.
      cause: of a lost target the physical cause; empty if nothing shows one.
      story: of a lost target what was believed, what was done, and why it failed.
      remarks: what happened beside that.
      obstacles: the objects that block or hide a lost target at the last look, the most important first.
      decisive: index of the step that decided a loss; None without one.
      believing: index of the step whose belief the story is of; None without one.
    """

    good: bool | None
    title: str
    sentences: list[str]
    blockers: tuple[int, ...]
    cause: str = ""
    story: Sequence[Paragraph] = ()
    remarks: Sequence[str] = ()
    obstacles: tuple[int, ...] = ()
    decisive: int | None = None
    believing: int | None = None

    @property
    def words(self) -> str:
        """All that is said of the end."""
        cause = [self.cause] if self.cause else []
        return " ".join([*cause, *self.sentences, *(paragraph.text for paragraph in self.story), *self.remarks])


def ending(recording: Recording) -> Ending:
    """How a recording's episode ended."""
    episode, last = recording.episode, recording.steps[-1]
    if episode is None:
        heading = recording.heading.partition(": ")[2] or recording.heading
        return Ending(None, heading, _at_last(recording, last), blockers(last))
    tips = _tipped(recording)
    if episode.retrieved:
        fell = "off the board" if tips else "over or off the board"
        taken = f"{_seen(episode)} and taken out of the shelf by action {len(episode.steps)}; no object fell {fell}."
        return Ending(True, "Retrieved", [taken, *tips], ())
    return _lost(recording, episode, tips)


def _lost(recording: Recording, episode: Episode, tips: list[str]) -> Ending:
    """How an episode ended whose target was lost."""
    last, failure = recording.steps[-1], plain(episode.failure or "not retrieved")
    acts = [i for i, step in enumerate(recording.steps) if step.action is not None]
    still = not any(word in failure for word in ("fell", "error"))
    fatal = None if still and failure.startswith(("found", "not found")) else _fatal(episode, acts)
    obstacles = () if fatal is not None else _obstacles(recording, last)
    why = cause(recording, fatal, obstacles)
    came = came_into_view(recording)
    if fatal is None:
        decisive = came if came is not None else stalled(recording)
        decisive = decisive if decisive is not None else acts[-1] if acts else 0
        believing = came if last.found and came is not None else len(recording.steps) - 1
    else:
        decisive = believing = fatal
    happened = [*why.evidence, _what_happened(recording, episode, acts, obstacles, bool(why.words))]
    words, happened, paragraphs = _explained(why.words, happened, story(recording, fatal, obstacles, bool(why.words)))
    return Ending(
        False,
        f"Lost: {failure}",
        happened,
        blockers(last) if still else (),
        words,
        paragraphs,
        _tipped(recording, fatal),
        obstacles,
        decisive,
        believing,
    )


def _explained(
    why: str, happened: Sequence[str], paragraphs: Sequence[Paragraph]
) -> tuple[str, list[str], list[Paragraph]]:
    """The texts of an end, in which it is said what a trial is where it is spoken of first."""
    known = False

    def explain(text: str) -> str:
        nonlocal known
        if known or not (word := _TRIAL.search(text)):
            return text
        known = True
        return f"{text[: word.end()]} (simulated before acting){text[word.end() :]}"

    first = explain(why), [explain(sentence) for sentence in happened]
    return *first, [each._replace(sentences=[explain(sentence) for sentence in each.sentences]) for each in paragraphs]


def _obstacles(recording: Recording, last: RecordedStep) -> tuple[int, ...]:
    """The objects in the way of a target at the last look, or of the view of it."""
    if not last.found:
        return tuple(i for i, _ in hiding(recording, last))
    return () if last.evidence is None or free(last.evidence.hits) else blockers(last)


def _seen(episode: Episode) -> str:
    """When the target was seen first; a sentence without its end."""
    first = "at the first look" if not episode.found_step else f"after {counted(episode.found_step, 'action')}"
    return f"The target was seen {first}"


def _what_happened(
    recording: Recording, episode: Episode, acts: list[int], obstacles: tuple[int, ...], explained: bool
) -> str:
    """The event that ended an episode without a retrieval, and its direct cause, unless that is explained."""
    failure, last = episode.failure or "", recording.steps[-1]
    every, were = ("The only action", "was") if len(acts) == 1 else (f"All {len(acts)} actions", "were")
    used = f"{every} that an episode may have {were} used up"
    if failure == "not found":
        hidden = f": {objects_in_words(obstacles)} still hid it from the camera" if obstacles and not explained else ""
        seen = _undetected(recording)
        return (
            f"{used}, and {'the target was never found' if seen else 'the camera never saw the target'}{hidden}.{seen}"
        )
    if failure == "found, but not graspable":
        hits = None if last.evidence is None else last.evidence.hits
        met = "" if explained or hits is None or free(hits) else f": at the last look {grasps_in_words(hits)}"
        return f"{used} before any grasp of the target was free{met}."
    fatal = _fatal(episode, acts)
    if fatal is None:
        return f"The episode ended: {failure or 'nothing says why'}."
    words, record = f"action {fatal + 1}, “{executed_words(recording, fatal)}”", episode.steps[fatal]
    fallen, more = record.fallen or (), _moved_meanwhile(recording, fatal)
    acted, cause = recording.steps[fatal].action, ""
    if record.failure and acted is not None and moves(acted):
        # The target may be pushed, too.
        k = int(acted.object)
        thing = f"object {k}" if k < TARGET else "the object"
        cause = f": {plain(record.failure).replace('the object', thing)}"
    if failure.startswith("retrieval: ") and not fallen:
        return f"The target was to be taken out by action {fatal + 1}, but {plain(failure)}.{more}"
    if fallen:
        return f"{objects_in_words(fallen).capitalize()} fell off the board at {words}{cause}.{more}"
    if "the target fell" in failure:
        unseen = "" if any(step.found for step in recording.steps[: fatal + 1]) else ", before it was seen"
        return f"{failure.capitalize()} at {words}{unseen}{cause}.{more}"
    return f"The episode ended after {words}{cause or f': {plain(failure)}'}."


def _undetected(recording: Recording) -> str:
    """That the camera showed enough of a target that was not detected at the last look; empty if it did not."""
    shown = target_pixels(recording.steps[-1], recording.camera, recording.shelf)
    if shown <= found_pixels(recording.camera):
        return ""
    return f" It showed {shown} pixels at the last look and was not detected."


def _fatal(episode: Episode, acts: list[int]) -> int | None:
    """The step at whose action what counts as the end happened: something fell, or else the last action."""
    fell = [i for i in acts if episode.steps[i].fallen or episode.steps[i].target_fallen]
    return fell[0] if fell else acts[-1] if acts else None


def _moved_meanwhile(recording: Recording, i: int) -> str:
    """Which objects moved while the target was to be taken out; empty at other actions, or where none did."""
    step = recording.steps[i]
    if not takes_target(step) or not len(step.trace.time):
        return ""
    shifts = np.linalg.norm(np.asarray(step.trace.position)[:, :TARGET] - step.world.position[:TARGET], axis=-1)
    moved = np.flatnonzero((shifts.max(axis=0) > DISPLACED) & step.world.valid[:TARGET]).tolist()
    return f" {objects_in_words(moved).capitalize()} moved meanwhile." if moved else ""


def _tipped(recording: Recording, but: int | None = None) -> list[str]:
    """Which actions tipped which objects that stay on the board; empty if none did, but for one that is known."""
    tips = [(i, tipped(recording, i)) for i in range(len(recording.steps)) if i != but]
    words = [f"action {i + 1} tipped {objects_in_words(objects)}" for i, objects in tips if objects]
    return [f"In the run, {', '.join(words)}."] if words else []


def _at_last(recording: Recording, step: RecordedStep) -> list[str]:
    """What was believed of the target at the last look, what hides it, and what its grasps meet."""
    sentences = [] if step.found else belief_in_words(recording, step)
    hits = None if step.evidence is None else step.evidence.hits
    if hits is None:
        return [*sentences, "Which objects its grasps meet was not recorded."]
    if free(hits):
        return [*sentences, "At the last look a grasp of it would have hit nothing."]
    where = f"; {at_wall(recording.shelf, step)}" if step.found else ""
    return [*sentences, f"At the last look {grasps_in_words(hits)}{where}."]
