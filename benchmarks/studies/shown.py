"""Which stored runs a page shows of a study."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

from mechsearch_jax.benchmarks.store.rows import Row, options_of
from mechsearch_jax.benchmarks.store.runs import StoredRun
from mechsearch_jax.benchmarks.studies.comparison import Comparison, compare
from mechsearch_jax.benchmarks.studies.declared import STUDIES
from mechsearch_jax.benchmarks.studies.studies import Study
from mechsearch_jax.envs.scenes.scene_sets import find_set, is_chosen_on


@dataclasses.dataclass(frozen=True)
class ShownStudy:
    """A study that there is something to compare of.

    Attributes:
      study: the question.
      labels: of the variants that each run gives, by the run's name; the run with most of them is the first.
      rows: of all these variants.
      comparisons: of them, in the order of the study.
    """

    study: Study
    labels: Mapping[str, Sequence[str]]
    rows: Sequence[Row]
    comparisons: Sequence[Comparison]


def ranked_runs(study: Study, runs: Sequence[StoredRun]) -> list[tuple[StoredRun, Mapping[str, Sequence[Row]]]]:
    """The runs that have variants of a study, each with their rows by label, the one to show first.

    Those with the study's first variant go before the others; among either the one with most variants comes first, and
    the newest of several with as many.
    """
    groups = [study.rows_of(run.rows) for run in runs]

    def rank(i: int) -> tuple[bool, int, str, int]:
        return study.baseline.label in groups[i], len(groups[i]), str(runs[i].lines[0].get("started") or ""), i

    places = sorted((i for i, each in enumerate(groups) if each), key=rank, reverse=True)
    return [(runs[i], groups[i]) for i in places]


def shown_study(study: Study, runs: Sequence[StoredRun]) -> ShownStudy | None:
    """A study from the run that has most of its variants, the first among them; None if that is in no run.

    Variants that this run lacks come from the other runs, where the same simulator judged them.
    """
    ranked = ranked_runs(study, runs)
    if not ranked or study.baseline.label not in ranked[0][1]:
        return None
    simulator = _simulator(ranked[0][1][study.baseline.label])
    engines = {variant.label: variant.engine or simulator for variant in study.variants}
    rows: dict[str, Sequence[Row]] = {}
    labels: dict[str, Sequence[str]] = {}
    for run, groups in ranked:
        lacking = {
            label: members
            for label, members in groups.items()
            if label not in rows and _simulator(members) == engines[label]
        }
        if lacking:
            rows |= lacking
            labels[run.name] = list(lacking)
    everything = [row for members in rows.values() for row in members]
    return ShownStudy(study, labels, everything, compare(study, everything))


def _simulator(rows: Sequence[Row]) -> str:
    return str(options_of(rows[0])["simulator"])


def shown(runs: Sequence[StoredRun]) -> Mapping[str, ShownStudy]:
    """The studies that there is something to compare of, by name."""
    picked = {name: shown_study(study, runs) for name, study in STUDIES.items()}
    return {name: each for name, each in picked.items() if each is not None and len(each.comparisons) > 1}


def source(shown_study: ShownStudy) -> str:
    """What the rows of a study are of: command, seeds, scenes, devices, code, runs, and what is not run."""
    study, rows = shown_study.study, shown_study.rows
    seeds = sorted({row.seed for row in rows})
    first = find_set(study.scenes).blocks[0].scene_name(0)
    ran, declared = len({row.scenario for row in rows}), find_set(study.scenes).scenes
    part = f"{ran:,} of the {declared:,} scenes of " if ran < declared else ""
    which = "settings were chosen on" if study.chooses or is_chosen_on(first) else "nothing was chosen on"
    missing = [v.label for v in study.variants if v.label not in {c.variant.label for c in shown_study.comparisons}]
    lacks = f" Not run: {', '.join(missing)}." if missing else ""
    devices = ", ".join(sorted({row.device or "unknown" for row in rows}))
    with_seeds = f"seed{'s' if seeds[1:] else ''} {', '.join(map(str, seeds))}"
    main, *others = (f"[{name}](../benchmarks/results/runs/{name}.jsonl)" for name in shown_study.labels)
    labels = list(shown_study.labels.values())[1:]
    more = "".join(f"; from {run}: {', '.join(each)}" for run, each in zip(others, labels, strict=True))
    around = f" around `{study.around}`" if study.around else ""
    return (
        f"`mechsearch study {study.name}` with {with_seeds}{around}; {part}`{study.scenes}`, scenes that "
        f"{which}; {devices}; {', '.join(sorted({row.code for row in rows}))}; its command stands in "
        f"{main}{more}.{lacks}"
    )
