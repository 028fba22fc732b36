"""Writes docs/studies.md and its pictures from the stored runs: `python -m mechsearch_jax.benchmarks.studies.page`.

Start it in a checkout. A study is shown from the stored run that has most of its variants.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

from mechsearch_jax.benchmarks.pages.pages import Block, Heading, Paragraph, Picture, Table, as_markdown
from mechsearch_jax.benchmarks.store.runs import RUNS, StoredRun, stored_runs
from mechsearch_jax.benchmarks.studies.comparison import HEADER, Comparison, cells, compare, sentence
from mechsearch_jax.benchmarks.studies.declared import GROUPS, STUDIES
from mechsearch_jax.benchmarks.studies.pictures import picture
from mechsearch_jax.benchmarks.studies.studies import Study
from mechsearch_jax.envs.scenes.scene_sets import find_set, is_chosen_on
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
    "is the one that judges them, but for the studies under Robustness.",
)


def shown_run(study: Study, runs: Sequence[StoredRun]) -> StoredRun | None:
    """The run that has most of a study's variants, the first among them; the newest of several; None without one."""
    counts = [
        (len(groups), str(run.lines[0].get("started") or ""), i)
        for i, run in enumerate(runs)
        if study.baseline.label in (groups := study.rows_of(run.rows))
    ]
    return runs[max(counts)[-1]] if counts else None


def blocks(study: Study, run: StoredRun, comparisons: Sequence[Comparison]) -> list[Block]:
    """What the page says of a study of which a run has rows."""
    return [
        Heading(study.name, 3),
        Paragraph(f"**{study.question}**"),
        Paragraph(sentence(study, comparisons)),
        Picture(f"studies/{study.name}.png", study.question),
        Table.of(HEADER, list(map(cells, comparisons))),
        Paragraph(_source(study, run, comparisons)),
    ]


def not_run(studies: Sequence[Study]) -> list[Block]:
    """What the page says of studies of which there are no rows."""
    if not studies:
        return []
    questions = [[f"`mechsearch study {study.name}`", study.question, f"`{study.scenes}`"] for study in studies]
    return [Paragraph("Declared, and not run yet:"), Table.of(("study", "question", "scene set"), questions, texts=3)]


def _source(study: Study, run: StoredRun, comparisons: Sequence[Comparison]) -> str:
    rows = [row for group in study.rows_of(run.rows).values() for row in group]
    seeds = sorted({row.seed for row in rows})
    first = find_set(study.scenes).blocks[0].scene_name(0)
    ran, declared = len({row.scenario for row in rows}), find_set(study.scenes).scenes
    part = f"{ran:,} of the {declared:,} scenes of " if ran < declared else ""
    which = "settings were chosen on" if is_chosen_on(first) else "nothing was chosen on"
    missing = [v.label for v in study.variants if v.label not in {c.variant.label for c in comparisons}]
    lacks = f" Not run: {', '.join(missing)}." if missing else ""
    devices = ", ".join(sorted({row.device or "unknown" for row in rows}))
    with_seeds = f"seed{'s' if seeds[1:] else ''} {', '.join(map(str, seeds))}"
    return (
        f"`mechsearch study {study.name}` with {with_seeds}; {part}`{study.scenes}`, scenes that "
        f"{which}; {devices}; {', '.join(sorted({row.code for row in rows}))}; its command stands in "
        f"[{run.name}](../benchmarks/results/runs/{run.name}.jsonl).{lacks}"
    )


def shown(runs: Sequence[StoredRun]) -> Mapping[str, tuple[StoredRun, Sequence[Comparison]]]:
    """The studies that there is something to compare of, by name: the run, and what comes of its variants."""
    picked = {name: shown_run(study, runs) for name, study in STUDIES.items()}
    compared = {name: (run, compare(STUDIES[name], run.rows)) for name, run in picked.items() if run is not None}
    return {name: (run, comparisons) for name, (run, comparisons) in compared.items() if len(comparisons) > 1}


def page(compared: Mapping[str, tuple[StoredRun, Sequence[Comparison]]]) -> str:
    """The page in Markdown, of what `shown` found."""
    parts: list[Block] = [Heading("Studies: ablations, baselines, robustness", 1), *map(Paragraph, INTRODUCTION)]
    for group, studies in GROUPS.items():
        parts.append(Heading(group))
        for study in studies:
            parts += blocks(study, *compared[study.name]) if study.name in compared else []
        parts += not_run([study for study in studies if study.name not in compared])
    return as_markdown(parts)


def main() -> None:
    """Rewrite the page and its pictures."""
    parser = argparse.ArgumentParser(description="Write docs/studies.md and its pictures from the stored runs.")
    parser.add_argument("--runs", default=RUNS, type=Path, help="folder of the stored runs")
    parser.add_argument("--out", default="docs/studies.md", type=Path, help="the page; its pictures come beside it")
    arguments = parser.parse_args()
    try:
        if not arguments.runs.is_dir():
            raise InputError(f"{arguments.runs}: is no folder; start it at the root of a checkout, or give --runs")
        runs = stored_runs(arguments.runs)
    except InputError as error:
        parser.error(str(error))
    folder = arguments.out.with_suffix("")
    folder.mkdir(parents=True, exist_ok=True)
    compared = shown(runs)
    for name, (_, comparisons) in compared.items():
        with replacing(folder / f"{name}.png") as file:
            picture(STUDIES[name], comparisons).savefig(file, format="png", dpi=110)
    with replacing(arguments.out) as file:
        file.write(page(compared).encode())


if __name__ == "__main__":
    main()
