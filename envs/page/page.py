"""The page of a recorded episode: what was seen, believed and measured, in one HTML file that loads nothing."""

from __future__ import annotations

import base64
import hashlib
import io
import os
import urllib.parse
from pathlib import Path
from typing import Any

from PIL import Image

from mechsearch_jax.envs.episode import endings
from mechsearch_jax.envs.recording import step_pictures, step_values
from mechsearch_jax.envs.recording.pictures import recorded_frame
from mechsearch_jax.envs.recording.recording import Recording
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike, replacing
from mechsearch_jax.viz import drawing

_TEMPLATE = Path(__file__).with_name("page.html.jinja")
_VALUES, _PICTURES = Path(step_values.__file__), Path(step_pictures.__file__)
# What decides how a page reads and looks.
_VALUES_TEMPLATE, _WORDS = _VALUES.with_name("step_values.html.jinja"), Path(endings.__file__)
_SOURCES = (Path(__file__), _TEMPLATE, _VALUES, _VALUES_TEMPLATE, _WORDS, _PICTURES)
# Of WebP.
QUALITY = 75
# Options of an episode that its card names.
_OPTIONS = {"policy": "policy", "recognition": "recognition", "trials": "trials", "seed": "seed"}


def check_page_path(path: Path) -> None:
    """Check before the work begins that a page's file is named as one.

    Raises:
      InputError: it is not.
    """
    if path.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{path}: ends in neither .html nor .htm; name a page that does")


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
    template = step_values.environment(_TEMPLATE.parent).get_template(_TEMPLATE.name)
    painter = step_pictures.Painter(recording)
    return template.render(
        title=recording.heading.partition(":")[0] or "an episode",
        end=step_values.ending(recording),
        picture=_data_uri(painter.end()),
        facts=_facts(recording),
        steps=[_step(recording, i, painter) for i in range(len(recording.steps))],
        recorded=recording.episode is not None,
        film=urllib.parse.quote(film),
        moves=not film.lower().endswith(".webp"),
        stamp=stamp(),
        bands=drawing.bands(),
        target=drawing.TARGET,
    )


def stamp() -> str:
    """A hash of the program that writes pages, which every page carries: another one, and the page is of other code.

    Lines of imports do not count: where a module lies changes no page.
    """
    lines = [line for source in _SOURCES for line in source.read_text(encoding="utf-8").splitlines()]
    counted = "\n".join(line for line in lines if not line.startswith(("import ", "from ")))
    return hashlib.sha256(counted.encode()).hexdigest()[:16]


def _facts(recording: Recording) -> list[tuple[str, str]]:
    """What the card says of an episode's options and length, by labels."""
    episode = recording.episode
    if episode is None:
        return []
    facts = [(label, str(episode.config[name])) for name, label in _OPTIONS.items() if name in episode.config]
    differs = [f"{name.partition('.')[2]} {value}" for name, value in episode.config.items() if "mismatch." in name]
    facts += [("world differs", ", ".join(differs))] if differs else []
    acts = sum(step.action is not None for step in episode.steps)
    takes = sum(step.action is not None and step.action.kind == "retrieve" for step in episode.steps)
    moves = f"{acts - takes} of at most {episode.config.get('max_steps', 'any number')}"
    moves += f", and {takes} to take it out" if takes else ""
    return [*facts, ("objects", str(episode.objects)), ("actions", moves)]


def _step(recording: Recording, i: int, painter: step_pictures.Painter) -> dict[str, Any]:
    """What the page shows of a step: its values and pictures."""
    step, values = recording.steps[i], step_values.step_values(recording, i)
    frame = recorded_frame(step, recording.camera, recording.shelf)
    sure = step_values.confidence(step)
    return {
        "data": values,
        "acts": step.action is not None,
        "seen": _data_uri(painter.seen(step, frame)),
        "believed": _data_uri(painter.believed(step, frame, values.blocked)),
        "recognised": _data_uri(painter.recognised(step, frame, sure)) if values.shapes else None,
    }


def _data_uri(picture: step_pictures.Picture) -> str:
    """A picture as WebP in a data URI."""
    file = io.BytesIO()
    Image.fromarray(picture).save(file, format="WEBP", quality=QUALITY, method=6)
    return f"data:image/webp;base64,{base64.b64encode(file.getvalue()).decode()}"
