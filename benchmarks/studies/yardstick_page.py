"""What docs/yardstick.md says: tables of restricted means, and the curves that they are areas above."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from matplotlib.figure import Figure

from mechsearch_jax.benchmarks.pages.pages import Block, Heading, Paragraph, Picture, Table, as_markdown
from mechsearch_jax.benchmarks.statistics.actions_until import horizon_of
from mechsearch_jax.benchmarks.statistics.intervals import with_interval
from mechsearch_jax.benchmarks.statistics.rates import GOALS
from mechsearch_jax.benchmarks.studies.comparison import listed, verdict
from mechsearch_jax.benchmarks.studies.curves import curves_figure
from mechsearch_jax.benchmarks.studies.shown import source
from mechsearch_jax.benchmarks.studies.yardstick import YARDSTICK, ActionsUntil, Measured

PAGE = "yardstick.md"
# What has a picture, and places each variant between the worse and the better one.
PLACED = ("found", "retrieved")


def page(measured: Measured) -> str:
    """The page in Markdown."""
    parts: list[Block] = [Heading("Yardstick for search: actions until found and retrieved", 1)]
    parts += map(Paragraph, introduction(measured))
    for goal in (*PLACED, *(goal for goal in GOALS if goal not in PLACED)):
        parts += _goal(measured, goal)
    return as_markdown(parts)


def pictures(measured: Measured) -> dict[str, Figure]:
    """The pictures of the page, by the names of their files."""
    drawn = [label for label in YARDSTICK.drawn if label in measured.rows]
    return {
        goal: curves_figure(
            {label: measured.curve(goal, label) for label in drawn},
            YARDSTICK.drawn,
            f"share {GOALS[goal]}",
        )
        for goal in PLACED
    }


def introduction(measured: Measured) -> list[str]:
    """How the page is to be read."""
    base, worse, better = measured.shown.study.baseline.label, YARDSTICK.worse, YARDSTICK.better
    budget, retrieval = measured.budget, horizon_of("retrieved", measured.budget)
    lacking = [label for label in (worse, better) if label not in measured.rows]
    unknown = f" There are no rows of {listed(lacking)} yet, so it is not known." if lacking else ""
    name = measured.shown.study.name
    return [
        "How many actions does a search take, and how far is that from the fewest possible? The variants of "
        f"[{name}](studies.md#{name}), on the same scenes and seeds, with the same simulator. "
        "`python -m mechsearch_jax.benchmarks.studies.page` writes this page and its pictures; "
        "[`mechsearch report`](commands.md#reports) has the same curves and means for any results.",
        "**Actions** are restricted means: the mean number of actions until then over all episodes, where one that "
        f"never gets there counts as {budget}, the budget, and until *retrieved* as {retrieval}, because after "
        f"{budget} actions the target may still be taken out. This is the area above the curve. (Restricted mean "
        "survival time; PAR1 where solvers are compared.) An episode that fails, because something falls off the "
        "board, the target tips, the arm is held up or the program stops, never gets there, however early it ends. "
        "That is a competing event, not censoring: a Kaplan-Meier curve would assume that such an episode succeeds "
        "later as often as the others, and so reward failing where it is hard. Only the budget censors, every episode "
        "at the same number of actions, so a curve is the share of all episodes that got there within k actions: the "
        "cumulative incidence, as Aalen and Johansen estimate it.",
        f"**Change** is how many more actions than {base}, paired by scene and seed.",
        f"**Closed gap** is ({worse} - variant) / ({worse} - {better}), in restricted means: the share of what the "
        f"{better} planner saves, which knows where the target is, that a variant saves too. Below 0 a variant takes "
        f"more actions than {worse}. The {better} planner has found the target before the first action by definition, "
        "which no search can, so for *found* the gap cannot be closed. For *retrieved* it is an estimate of the fewest "
        f"actions, not a proven bound: but for the target's pose it knows no more than {base}, and plans as that does."
        f"{unknown}",
        "In brackets stand 95% intervals from drawing scenes again (percentile bootstrap; of shares Wilson's). Each is "
        "for itself. Words are in the [glossary](glossary.md).",
        source(measured.shown),
    ]


REMARK = (
    "With contact allowed, a target may be retrieved that was never graspable (no grasp touched nothing); the episode "
    "ends there, and counts as never graspable. So these means compare variants that retrieve with the same grasps."
)


def _goal(measured: Measured, goal: str) -> list[Block]:
    pooled = {
        label: each for (name, label, objects), each in measured.actions.items() if (name, objects) == (goal, None)
    }
    placed = goal in PLACED and any(each.gap for each in pooled.values())
    columns = {"actions": _mean, "change": _change, **({"closed gap": _gap} if placed else {})}
    lines = [
        [
            label,
            each.episodes,
            with_interval(each.share, each.share_interval, "{:.2f}"),
            *(cell(each) for cell in columns.values()),
        ]
        for label, each in pooled.items()
    ]
    return [
        Heading(f"Until {goal}"),
        Paragraph(sentence(measured, goal)),
        *(
            [Picture(f"{PAGE.removesuffix('.md')}/{goal}.png", f"Share {GOALS[goal]} within so many actions")]
            if goal in PLACED
            else [Paragraph(REMARK)]
        ),
        Table.of(("variant", "episodes", GOALS[goal], *columns), lines),
        Paragraph("By number of objects:"),
        *(_by_objects(measured, goal, list(pooled), name, cell) for name, cell in columns.items()),
    ]


def _by_objects(
    measured: Measured, goal: str, labels: Sequence[str], name: str, cell: Callable[[ActionsUntil], str]
) -> Table:
    lines = []
    for label in labels:
        each = [measured.actions.get((goal, label, count)) for count in measured.objects]
        texts = ["-" if actions is None else cell(actions) for actions in each]
        lines += [[label, *texts]] if any(texts) else []
    return Table.of((name, *(f"{count} objects" for count in measured.objects)), lines)


def _mean(actions: ActionsUntil) -> str:
    return with_interval(actions.mean, actions.interval, "{:.2f}")


def _change(actions: ActionsUntil) -> str:
    return "" if actions.change is None else with_interval(actions.change.mean, actions.change.interval, "{:+.2f}")


def _gap(actions: ActionsUntil) -> str:
    return "" if actions.gap is None else with_interval(actions.gap.share, actions.gap.interval, "{:.2f}")


def sentence(measured: Measured, goal: str) -> str:
    """Which variants certainly take fewer or more actions than the first one."""
    base = measured.shown.study.baseline.label
    by_verdict: dict[int, list[str]] = {-1: [], 1: [], 0: []}
    for (name, label, objects), each in measured.actions.items():
        if (name, objects) == (goal, None) and each.change is not None:
            certain = verdict(each.change)
            by_verdict[certain].append(f"{label} {_change(each)}" if certain else label)
    words = {-1: "fewer actions with", 1: "more actions with", 0: "no difference is certain with"}
    parts = [f"{words[each]} {listed(labels)}" for each, labels in by_verdict.items() if labels]
    return f"Against {base}: {'; '.join(parts)}." if parts else f"There are no rows beside those of {base}."
