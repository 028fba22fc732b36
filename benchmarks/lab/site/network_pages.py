"""Writes the tables of docs/networks anew: `python -m mechsearch_jax.benchmarks.lab.site.network_pages`.

Their figures are those of stored benchmarks. All else on these pages is written by hand.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from mechsearch_jax.benchmarks.lab.site.results_page import table
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike, read_json, replacing

RESULTS, OUT = Path("benchmarks/results"), Path("docs/networks")
CARDS = Path("mechsearch_jax/networks")
# Results are larger than other texts [bytes].
LIMIT = 2**25
NOISES = {"clean": "none", "gaussian": "1 mm", "time-of-flight": "time-of-flight"}
SOURCES = {"held-out": "held-out", "files": "published"}


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


FIGURES: Mapping[str, Callable[[Mapping[str, Any]], str]] = {
    "recognition": _of_recognition,
    "segmentation": _of_segmentation,
    "push": _of_pushes,
}


def page(name: str, written: str, results: PathLike = RESULTS, cards: PathLike = CARDS) -> str:
    """The page of a network with the figures of the stored benchmark.

    Args:
      name: of the network.
      written: the page before, with a table beneath its heading "How good it is".
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
    before, heading, after = written.partition("## How good it is\n")
    figures = FIGURES[name](measured) + "\n"
    return before + heading + re.sub(r"(?:^\|.*\|\n)+", lambda _: figures, after, count=1, flags=re.MULTILINE)


def main(arguments: Sequence[str] | None = None) -> None:
    """Rewrite the tables."""
    parser = argparse.ArgumentParser(description=f"At the root of a checkout: write the tables of {OUT} anew.")
    parser.add_argument("--out", default=OUT, type=Path, help="folder of the pages")
    given = parser.parse_args(arguments)
    try:
        files = {name: given.out / f"{name}.md" for name in FIGURES}
        texts = {name: page(name, file.read_text(encoding="utf-8")) for name, file in files.items()}
    except (InputError, FileNotFoundError) as error:
        raise SystemExit(str(error)) from error
    for name, text in texts.items():
        with replacing(files[name]) as file:
            file.write(text.encode())


if __name__ == "__main__":
    main()
