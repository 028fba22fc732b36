"""Writes docs/networks, a card for each network: `python -m mechsearch_jax.benchmarks.lab.site.network_pages`.

Data, training and hashes come from the cards beside the weights, figures from stored benchmarks; the words are here.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2

from mechsearch_jax.benchmarks.lab.site.results_page import table
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike, read_json, replacing

RESULTS, OUT = Path("benchmarks/results"), Path("docs/networks")
CARDS = Path("mechsearch_jax/networks")
# Results are larger than other texts [bytes].
LIMIT = 2**25
NOISES = {"clean": "none", "gaussian": "1 mm", "time-of-flight": "time-of-flight"}
SOURCES = {"held-out": "held-out", "files": "published"}


@dataclasses.dataclass(frozen=True)
class Card:
    """The words of a card.

    Attributes:
      title: of the page.
      what: what the network is for, and where it is used.
      inputs, outputs: of the network.
      data, training: what is to be said of them beside the numbers.
      measured: what the table of figures shows.
      also: where more figures are.
      limits: what it cannot do, a sentence each.
      figures: makes the table of figures of the stored benchmark.
    """

    title: str
    what: str
    inputs: str
    outputs: str
    data: str
    training: str
    measured: str
    also: str
    limits: tuple[str, ...]
    figures: Callable[[Mapping[str, Any]], str]


def _of_recognition(stored: Mapping[str, Any]) -> str:
    lines = []
    for source, scenes in SOURCES.items():
        for noise, label in NOISES.items():
            for visible in ("all", "below 30%"):
                cells = {
                    each["method"]: each
                    for each in stored["summary"]
                    if (each["source"], each["noise"], each["visible"]) == (source, noise, visible)
                }
                raw, refined = cells["network"], cells["network-refined"]
                figures = [f"{each['iou_mean']:.3f}" for each in (raw, refined)]
                centre, wrong = f"{refined['centre_median_mm']:.1f} mm", f"{100 * refined['wrong_class']:.1f}%"
                lines.append([scenes, label, visible, raw["objects"], *figures, centre, wrong])
    header = ["scenes", "noise", "of an object in sight", "objects", "mean IoU", "refined"]
    return table([*header, "centre, median", "box for cylinder or the reverse"], lines)


def _of_segmentation(stored: Mapping[str, Any]) -> str:
    lines = []
    for source, scenes in SOURCES.items():
        for noise, label in NOISES.items():
            for each in stored["summary"]:
                if (each["source"], each["noise"]) == (source, noise) and each["objects"] in (None, 8):
                    count = "all" if each["objects"] is None else each["objects"]
                    missed = f"{each['missed']} of {each['counted']}"
                    lines.append([scenes, label, count, each["scenes"], f"{each['iou_mean']:.3f}", missed])
    return table(["scenes", "noise", "objects in a scene", "scenes", "mean IoU of pixels", "objects missed"], lines)


def _of_pushes(stored: Mapping[str, Any]) -> str:
    lines = []
    for label in (
        "all",
        "sideways",
        "forward and diagonal",
        "5 cm",
        "10 cm",
        "15 cm",
        "2 objects",
        "4 objects",
        "7 objects",
    ):
        each = stored["models"]["learned"][label]
        errors = f"{each['pushed_mm']:.1f} mm, {each['pushed_deg']:.1f}°", f"{each['other_mm']:.1f} mm"
        lines.append([label, f"{each['pushes']:,}", *errors, f"{each['still']:.3f}", f"{each['topple_ap']:.2f}"])
    header = ["pushes", "number", "pushed object", "others that moved", "stays, and is predicted to"]
    return table([*header, "falls over, average precision"], lines)


_SCENES = (
    "Scenes are made at random while it trains, and ray-cast. Half of them are tables and shelves as people have them, "
    "with stacks, tins and open vessels, from other places; the others are seen by the default camera into the default "
    "shelf. Both are seen through the same sensors. Nothing of it is a real image. Scenes that anything is measured on "
    "come from seeds that training refuses."
)
_LATER = (
    "Each command goes on from the weights of the one before: the second with more objects that touch each other, the "
    "third and fourth with the scenes above; the first two saw only the default shelf."
)
_REAL = (
    "It has seen no real image in training. [What it makes of some](../results.md#real-images): tables before one "
    "camera, and one shelf."
)
_SHAPES = "It knows boxes and cylinders; [another shape](../extend.md#a-new-object-shape) has to be trained."
_VIEWS = (
    "[How far other cameras and shelves may differ](../method.md#other-cameras-and-shelves), and what is warned of, is "
    "a table."
)

CARD_OF: dict[str, Card] = {
    "recognition": Card(
        title="The recognition network",
        what=(
            "From the visible points of one object to a superquadric: size, exponents and pose, the hidden part "
            "included. Every `Recogniser` uses it, with and without masks; [refinement](../method.md#recognition) fits "
            "its answer to the image afterwards."
        ),
        inputs="the points of a segment and of what surrounds it, with a mark each, and where the camera is",
        outputs="several hypotheses of half-extents, exponents and pose, and how far each is expected to be off",
        data=_SCENES,
        training=_LATER,
        measured=(
            "`python -m mechsearch_jax.benchmarks.lab recognition`, from true masks: "
            "intersection over union of the recognised and the true "
            "volume, before and after refinement, and the rest after it."
        ),
        also="What becomes of it in whole searches: [results](../results.md#the-default).",
        limits=(
            _REAL,
            f"{_SHAPES} One superquadric an object: a mug or a chair comes out as one box or cylinder.",
            _VIEWS,
            "Of an object that is mostly hidden it guesses: below 30% in sight the table says how badly. "
            "`Observation.confidence` says so of each object.",
        ),
        figures=_of_recognition,
    ),
    "segmentation": Card(
        title="The segmentation network",
        what=(
            "From the points of a depth image to segments, one for each object. It is used where a `Recogniser` is "
            "given no mask (`--recognition full`); what it proposes is then [split, joined and "
            "dropped](../method.md#recognition) where that explains the image better."
        ),
        inputs="the points of the shelf's space in a depth image, in the world; no colour",
        outputs="for each point the probabilities of nine instances and of being no object",
        data=_SCENES,
        training=_LATER,
        measured=(
            "`python -m mechsearch_jax.benchmarks.lab segmentation`: "
            "intersection over union of the pixels of each object that shows at least "
            "100, with the segment that is matched to it; below 0.5 it is missed."
        ),
        also=(
            "[The six worst images](../segmentation-failures.png), and what becomes of it in whole searches: "
            "[results](../results.md#the-default)."
        ),
        limits=(
            _REAL,
            "Where objects touch or are seen past each other it takes two for one, and one for two where something "
            "hides the middle of an object.",
            f"At most eight objects and the target. {_SHAPES}",
            f"{_VIEWS} Of this network alone it is not measured.",
        ),
        figures=_of_segmentation,
    ),
    "push": Card(
        title="The push network",
        what=(
            "Predicts what a push does: how far every object moves and turns, whether it moves at all, and whether it "
            "falls over. It is the push model `learned`, the default of every policy; [the "
            "others](../method.md#pushes)."
        ),
        inputs="the objects as superquadrics, the hand and the walls in a planar frame along the push, and its length",
        outputs="for each object a motion in the plane, whether it moves, and whether it falls over",
        data="Random pushes of the robot in random scenes, simulated by MuJoCo with the simulator's frictions.",
        training="It first simulates its pushes, and then trains on them.",
        measured=(
            "`python -m mechsearch_jax.benchmarks.lab push`, simulated pushes in scenes that no training has seen: "
            "mean errors of the pushed "
            "object and of others that were moved, and how well it knows what stays and what falls over."
        ),
        also=("Beside other push models, and what it means for episodes: [results](../results.md#predicting-pushes)."),
        limits=(
            "It knows the frictions and the masses of the simulated world, and takes neither as an input: on another "
            "board, or with other objects, it is wrong without saying so.",
            "Pushes of 2 to 20 cm by the robot's closed hand, among 8 objects at most.",
            "The longer a push, the worse it is predicted, as the table says.",
            _SHAPES,
        ),
        figures=_of_pushes,
    ),
}


def _lineage(stored: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """What the weights were trained by, oldest first: the card, and the cards that it started from."""
    earlier = stored.get("started_from")
    return [*(_lineage(earlier) if earlier else ()), stored]


def _told(stored: Mapping[str, Any]) -> str:
    """How long and on what a training ran, each on a line."""
    lines = []
    for number, each in enumerate(_lineage(stored), 1):
        training = each["training"]
        commit = f"at commit {each['commit']}" if each.get("commit") else "of a checkout that had no commit"
        facts = [f"{training['minutes']:g} minutes", f"{each['steps']:,} steps of {training['batch']:,}", commit]
        lines.append(f"{number}. {', '.join(facts)}; rate {training['rate']:g}, seed {training['seed']}")
    return f"On one {stored['device']}, with jax {stored['jax']}:\n\n" + "\n".join(lines)


def page(name: str, results: PathLike = RESULTS, cards: PathLike = CARDS) -> str:
    """The card of a network.

    Args:
      name: of the network.
      results: folder of stored benchmarks.
      cards: folder of the weights' cards.

    Raises:
      InputError: a file is missing or damaged, or the stored figures are of other weights.
    """
    stored = read_json(Path(cards) / f"{name}.json")
    file = Path(results) / f"{name}-cpu.json"
    measured = read_json(file, LIMIT)
    sha = measured.get("weights", stored)["sha256"]
    if sha != stored["sha256"]:
        raise InputError(f"{file}: is of other weights ({sha[:12]}) than {name}.npz ({stored['sha256'][:12]})")
    text = _template().render(
        name=name,
        card=CARD_OF[name],
        stored=stored,
        size=f"{stored['bytes'] / 1e6:.1f} MB",
        shape=", ".join(f"{key} {value}" for key, value in stored["config"].items()),
        lineage=_told(stored),
        commands=[each["command"] for each in _lineage(stored)],
        figures=CARD_OF[name].figures(measured),
    )
    return text.rstrip() + "\n"


@functools.cache
def _template() -> jinja2.Template:
    environment = jinja2.Environment(trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined)
    return environment.from_string(Path(__file__).with_name("network_page.md.jinja").read_text(encoding="utf-8"))


def main(arguments: Sequence[str] | None = None) -> None:
    """Rewrite the cards."""
    parser = argparse.ArgumentParser(description=f"At the root of a checkout: write {OUT} from the stored files.")
    parser.add_argument("--out", default=OUT, type=Path, help="folder of the pages")
    given = parser.parse_args(arguments)
    try:
        texts = {name: page(name) for name in CARD_OF}
    except InputError as error:
        raise SystemExit(str(error)) from error
    given.out.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        with replacing(given.out / f"{name}.md") as file:
            file.write(text.encode())


if __name__ == "__main__":
    main()
