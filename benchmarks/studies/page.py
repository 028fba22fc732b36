"""Writes docs/studies.md, docs/yardstick.md and their pictures: `python -m mechsearch_jax.benchmarks.studies.page`.

Start it in a checkout. A study is shown from the stored run that has most of its variants, and what that run lacks from
the others.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from mechsearch_jax.benchmarks.pages.pages import Block, Heading, Paragraph, Picture, Table, as_markdown
from mechsearch_jax.benchmarks.store.runs import RUNS, stored_runs
from mechsearch_jax.benchmarks.studies import yardstick_page
from mechsearch_jax.benchmarks.studies.comparison import HEADER, cells, sentence
from mechsearch_jax.benchmarks.studies.declared import GROUPS
from mechsearch_jax.benchmarks.studies.pictures import picture
from mechsearch_jax.benchmarks.studies.shown import ShownStudy, shown, source
from mechsearch_jax.benchmarks.studies.studies import Study
from mechsearch_jax.benchmarks.studies.yardstick import YARDSTICK, measure
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import replacing

INTRODUCTION = (
    "Each study asks one question and compares variants of one method on the same scenes and seeds. "
    "`python -m mechsearch_jax.benchmarks.studies.page` makes this page and its pictures from the rows in "
    "[benchmarks/results/runs](../benchmarks/results/runs); `mechsearch study NAME --out FOLDER` runs a study, "
    "`--dry-run` says what it would take, and `python -m mechsearch_jax.benchmarks.report.store_run` stores its rows.",
    "Unless a variant says otherwise: search-for-grasp, preset `standard`, true shapes, protocol `strict`, at most 10 "
    "actions. Words are in the [glossary](glossary.md), verdicts in [method.md](method.md#verdicts). In brackets stand "
    "95% intervals, which know that the seeds of a scene are alike; each is for itself: where there is no difference "
    "at all, one in twenty shows one. A change is a paired difference from the first variant, over the scenes and "
    "seeds that both have: of shares in percentage points, of actions in actions. The simulator that tries actions out "
    "is the one that judges them, but for the studies under Robustness and `friction-learned`.",
)


def blocks(shown_study: ShownStudy) -> list[Block]:
    """What the page says of a study of which there are rows."""
    study, comparisons = shown_study.study, shown_study.comparisons
    link = f"How many actions each takes, and how far that is from the fewest: [yardstick]({yardstick_page.PAGE})."
    return [
        Heading(study.name, 3),
        Paragraph(f"**{study.question}**"),
        Paragraph(sentence(study, comparisons)),
        Picture(f"studies/{study.name}.png", study.question),
        Table.of(HEADER, list(map(cells, comparisons))),
        Paragraph(source(shown_study)),
        *([Paragraph(link)] if study.name == YARDSTICK.study else []),
    ]


def not_run(studies: Sequence[Study]) -> list[Block]:
    """What the page says of studies of which there are no rows."""
    if not studies:
        return []
    questions = [[f"`mechsearch study {study.name}`", study.question, f"`{study.scenes}`"] for study in studies]
    return [Paragraph("Declared, and not run yet:"), Table.of(("study", "question", "scene set"), questions, texts=3)]


def page(compared: Mapping[str, ShownStudy]) -> str:
    """The page in Markdown, of what `shown` found."""
    parts: list[Block] = [Heading("Studies: ablations, baselines, robustness", 1), *map(Paragraph, INTRODUCTION)]
    for group, studies in GROUPS.items():
        parts.append(Heading(group))
        for study in studies:
            parts += blocks(compared[study.name]) if study.name in compared else []
        parts += not_run([study for study in studies if study.name not in compared])
    return as_markdown(parts)


def main(arguments: Sequence[str] | None = None) -> None:
    """Rewrite the pages and their pictures."""
    parser = argparse.ArgumentParser(
        description="Write docs/studies.md, docs/yardstick.md and their pictures from the stored runs."
    )
    parser.add_argument("--runs", default=RUNS, type=Path, help="folder of the stored runs")
    parser.add_argument(
        "--out", default="docs/studies.md", type=Path, help="the page; the other one and all pictures come beside it"
    )
    given = parser.parse_args(arguments)
    try:
        if not given.runs.is_dir():
            raise InputError(f"{given.runs}: is no folder; start it at the root of a checkout, or give --runs")
        runs = stored_runs(given.runs)
    except InputError as error:
        parser.error(str(error))
    compared = shown(runs)
    figures = {name: picture(each.study, each.comparisons) for name, each in compared.items()}
    _write(given.out, page(compared), figures)
    if YARDSTICK.study in compared:
        measured = measure(compared[YARDSTICK.study])
        out = given.out.with_name(yardstick_page.PAGE)
        _write(out, yardstick_page.page(measured), yardstick_page.pictures(measured))


def _write(out: Path, text: str, figures: Mapping[str, Figure]) -> None:
    """Write a page, and its pictures into the folder of its name."""
    folder = out.with_suffix("")
    folder.mkdir(parents=True, exist_ok=True)
    for name, figure in figures.items():
        with replacing(folder / f"{name}.png") as file:
            figure.savefig(file, format="png", dpi=110)
    with replacing(out) as file:
        file.write(text.encode())


if __name__ == "__main__":
    main()
