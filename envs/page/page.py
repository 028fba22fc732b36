"""The page that explains a recorded episode: one HTML file that holds everything and loads nothing."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import urllib.parse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2

from mechsearch_jax.actions import kind_of
from mechsearch_jax.envs.episode.records import load_episode
from mechsearch_jax.envs.page import steps as texts
from mechsearch_jax.envs.page.causes import why_none
from mechsearch_jax.envs.page.ending import Ending, ending
from mechsearch_jax.envs.page.facts import action_words, executed_words, idle, takes_target, target_is_out, tipped
from mechsearch_jax.envs.page.pictures import Painter, changed_cells, data_uri, tried_grasp
from mechsearch_jax.envs.page.reasons import did_nothing
from mechsearch_jax.envs.page.replays import trial_stop
from mechsearch_jax.envs.recording.narration import verdict
from mechsearch_jax.envs.recording.pictures import recorded_frame
from mechsearch_jax.envs.recording.recording import NAME, RecordedStep, Recording, load_recording
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike, is_file, replacing
from mechsearch_jax.viz import drawing
from mechsearch_jax.viz.filmstrip import Frame

_TEMPLATE = Path(__file__).with_name("page.html.jinja")
RECORD = "episode.json"
# Options of an episode that its card names.
_FACTS = {"policy": "policy", "recognition": "recognition", "rehearsal": "trials", "seed": "seed"}


def check_page_path(path: Path) -> None:
    """Check before the work begins that a page's file is named as one.

    Raises:
      InputError: it is not.
    """
    if path.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{path}: ends in neither .html nor .htm; name a page that does")


def recording_with_record(folder: Path) -> Recording:
    """The recording in a folder; of an earlier version, with the record of the episode that lies beside it.

    Raises:
      InputError: one of them cannot be read, or they are of different episodes.
    """
    recording = load_recording(folder / NAME)
    if recording.episode is not None or not is_file(folder / RECORD):
        return recording
    episode = load_episode(folder / RECORD)
    if len(episode.steps) != len(recording.steps) or verdict(episode) != recording.heading:
        raise InputError(f"{folder / RECORD}: is of another episode than {NAME} beside it; search once more")
    return dataclasses.replace(recording, episode=episode)


def save_page(recording: Recording, path: PathLike, film: PathLike | None = None) -> None:
    """Write the page of an episode.

    Args:
      recording: of the episode.
      path: of the file.
      film: of the same episode, which the page shows from where it lies; none if left out.

    Raises:
      InputError: the file cannot be written.
    """
    beside = "" if film is None else Path(os.path.relpath(film, Path(path).parent)).as_posix()
    text = page(recording, beside)
    with replacing(path) as file:
        file.write(text.encode())


def page(recording: Recording, film: str = "") -> str:
    """The page of an episode as HTML.

    Args:
      recording: of the episode.
      film: where its film lies, seen from the page; empty without one.
    """
    template = environment().get_template(_TEMPLATE.name)
    painter = Painter(recording)
    end = ending(recording)
    shown = [_step(recording, i, painter, end.obstacles) for i in range(len(recording.steps))]
    return template.render(
        film=urllib.parse.quote(film),
        moves=not film.lower().endswith(".webp"),
        title=recording.heading.partition(":")[0] or "an episode",
        stamp=stamp(),
        card=_card(recording, painter, end),
        steps=shown,
        bands=[(band.colour, band.label) for band in drawing.bands()],
        colours={"target": drawing.TARGET, "possible": drawing.BLOCKED[1], "free": drawing.GRASPABLE},
        left_out=left_out(recording),
    )


def environment() -> jinja2.Environment:
    """The templates of this folder."""
    return jinja2.Environment(
        loader=jinja2.FileSystemLoader(_TEMPLATE.parent),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )


def stamp() -> str:
    """A hash of the program that writes pages, which every page carries: another one, and the page is of other code."""
    sources = [file for kind in ("*.jinja", "*.py") for file in sorted(_TEMPLATE.parent.glob(kind))]
    return hashlib.sha256("\0".join(source.read_text(encoding="utf-8") for source in sources).encode()).hexdigest()[:16]


def _card(recording: Recording, painter: Painter, end: Ending) -> dict[str, Any]:
    # Where no grasp is blocked, what hides the target is marked.
    hides = end.obstacles[:1] if not end.blockers and not recording.steps[-1].found else ()
    last = painter.end(end.blockers or hides)
    return {
        **end._asdict(),
        "decisive": end.decisive or 0,
        "stands": last.stands,
        "lies": last.lies,
        "grasp": last.stands and tried_grasp(recording.steps[-1]) is not None,
        "shows": last.shows,
        "fate": "outside the shelf" if target_is_out(recording) else "which no longer stands",
        "taken": recording.episode is not None and bool(recording.episode.retrieved),
        "facts": _facts(recording, bool(end.good)),
        "seen": data_uri(last.seen),
        "above": data_uri(last.above),
        "blockers": last.blockers,
        "hides": bool(hides),
        "belief": _belief(recording, painter, end),
    }


def _belief(recording: Recording, painter: Painter, end: Ending) -> dict[str, Any] | None:
    """The map of what was believed where it mattered to a loss; None without one."""
    if end.believing is None:
        return None
    step = recording.steps[end.believing]
    frame = recorded_frame(step, recording.camera, recording.shelf)
    return {
        "when": f"at step {end.believing + 1}" if end.believing < len(recording.steps) - 1 else "at the end",
        "acts": step.action is not None,
        "found": step.found,
        "map": data_uri(painter.believed(step, frame, None, texts.blocked(step))),
    }


def _facts(recording: Recording, good: bool) -> list[tuple[str, str]]:
    episode = recording.episode
    if episode is None:
        return []
    facts = [(label, str(episode.config[name])) for name, label in _FACTS.items() if name in episode.config]
    differs = [f"{name.partition('.')[2]} {value}" for name, value in episode.config.items() if "mismatch." in name]
    facts += [("world differs", ", ".join(differs))] if differs else []
    kinds = [step.action.kind for step in episode.steps if step.action is not None]
    takes = kinds.count("retrieve")
    moves = f"{len(kinds) - takes} of at most {episode.config.get('max_steps', 'any number')}"
    also = f" and {takes} to take the target out" if takes else ""
    facts += [("objects", str(episode.objects)), ("actions", moves + also)]
    gains = [
        (step.cost - step.predicted_cost, step.cost - step.observed_cost)
        for step in episode.steps
        if step.cost is not None and step.predicted_cost is not None and step.observed_cost is not None
    ]
    if gains and good:
        promised, came = (round(sum(column)) for column in zip(*gains, strict=True))
        # A policy may mind no cost.
        facts += [("J was to fall by", f"{promised} in all, and fell by {came}")] if promised or came else []
    return facts


def left_out(recording: Recording) -> list[str]:
    """What the recording does not hold, so that the page leaves it out."""
    sentences = []
    if recording.episode is None:
        sentences.append("The record of the episode is missing, so costs and the reason of the end are left out.")
    if all(step.evidence is None for step in recording.steps):
        sentences.append(
            "The recording is of an earlier version: predicted f and g, trials, confidence and the objects that block "
            "grasps are left out. Search once more with --record to have them."
        )
    return sentences


def _step(recording: Recording, i: int, painter: Painter, obstacles: Sequence[int]) -> dict[str, Any]:
    """What the page shows of a step, by the template's names."""
    step, before = recording.steps[i], recording.steps[i - 1] if i else None
    frame = recorded_frame(step, recording.camera, recording.shelf)
    words = step_words(recording, i, frame, obstacles)
    pictures = [data_uri(painter.foreseen(step, candidate.row)) for candidate in words["candidates"]]
    return {
        **words,
        "words": action_words(step),
        "seen": data_uri(painter.seen(frame)),
        "map": data_uri(painter.believed(step, frame, before, texts.blocked(step))),
        "candidates": [
            {**candidate._asdict(), "picture": picture}
            for candidate, picture in zip(words["candidates"], pictures, strict=True)
        ],
        "sampled": len(step.sampled),
        "label": texts.label(step),
        "came": step.found and i > 0 and before is not None and not before.found,
        "idle": idle(recording, i),
        "odd": bool(tipped(recording, i) or (words["costs"] and words["costs"][1])),
        "retrieves": takes_target(step),
        "grasp": tried_grasp(step) is not None,
        **_changes(recording, i),
        "recognised": data_uri(painter.recognised(step, frame, texts.confidence(step))) if words["shapes"] else None,
        **_counts(step),
    }


def step_words(recording: Recording, i: int, frame: Frame, obstacles: Sequence[int] = ()) -> dict[str, Any]:
    """What is said of a step, by the names of the templates.

    Args:
      recording: of the episode.
      i: index of the step.
      frame: its picture.
      obstacles: the objects in the way of a lost target at the end.
    """
    step, before = recording.steps[i], recording.steps[i - 1] if i else None
    record = None if recording.episode is None else recording.episode.steps[i]
    shapes = texts.shapes(recording, step, frame.owner)
    tried = 0 if step.evidence is None else len(step.evidence.tried.result)
    stops = [trial_stop(recording, i, k) for k in range(tried)]
    executed, over = executed_words(recording, i), texts.over(recording, step)
    return {
        "number": i + 1,
        "heading": texts.heading(step),
        "kind": "end" if step.action is None else kind_of(int(step.action.kind)).name,
        "executed": "" if executed == action_words(step) else executed,
        "found": step.found,
        "blocked": bool(texts.blocked(step)),
        "over": bool(over),
        "lies": over.endswith("fell over."),
        "belief": over or texts.poses_in_words(step, before),
        "truth": "" if over else texts.truth(step, record),
        "grasps": "" if over else texts.grasps_words(step),
        "candidates": texts.candidates(step, obstacles),
        "unmoved": texts.unmoved(step, obstacles, why_none(recording, i, obstacles[0]) if obstacles else ""),
        "trials": texts.trials(step, stops),
        "shapes": shapes,
        "doubt": texts.doubt(recording, step, texts.depth_of(recording, step)) if shapes else None,
        "costs": texts.costs(recording, i),
        "troubles": texts.troubles(recording, i),
        "came_of_it": texts.came_of_it(recording, i),
        "did_nothing": did_nothing(recording, i),
    }


def _changes(recording: Recording, i: int) -> Mapping[str, bool]:
    """Whether the map of a step marks poses that were ruled out since the step before, or opened again."""
    step, before = recording.steps[i], recording.steps[i - 1] if i else None
    if before is None or step.found or before.found:
        return {"ruled_out": False, "opened": False}
    gone, opened = changed_cells(recording.target, before.existence, step.existence)
    return {"ruled_out": bool(gone.any()), "opened": bool(opened.any())}


def _counts(step: RecordedStep) -> Mapping[str, int]:
    """Numbers of poses for the time line."""
    size = 1 if step.found else int(step.existence.sum())
    return {"size": size, "good": texts.graspable(step.existence, step.graspability)}
