"""What came of searches, as a table of counts with Wilson intervals."""

import math
import re

from . import execution, search


def wilson(hits, of, z=1.96):
    """Bounds of the 95% interval of a share."""
    if of == 0:
        return 0.0, 1.0
    share, spread = hits / of, z * z / of
    middle = (share + spread / 2) / (1 + spread)
    half = z / (1 + spread) * math.sqrt(share * (1 - share) / of + spread / (4 * of))
    return max(middle - half, 0.0), min(middle + half, 1.0)


def counts(rows):
    """What is counted of searches, looks and motions: name, how many, of how many, and what is wanted."""
    steps = [step for row in rows for step in row["steps"]]
    motions = [step for step in steps if "executed" in step]
    searches_with = lambda test: sum(any(test(step) for step in row["steps"]) for row in rows)  # noqa: E731
    dropped = lambda step: "target" in step.get("executed", {}).get("dropped", {})  # noqa: E731
    refused = [step for step in steps if "executed" not in step]
    return [
        ("retrieved", sum(row["retrieved"] for row in rows), len(rows), "at least 36 of 40"),
        ("searches in which the held target was dropped", searches_with(dropped), len(rows), "0"),
        ("motions without expected gain", sum(step["without_gain"] for step in motions), len(motions), "0"),
        (
            "motions with an unannounced contact above 5 N",
            sum(bool(s["unannounced"]) for s in motions),
            len(motions),
            "0",
        ),
        ("the same, and none pressed on what is below it, either", sum(map(_pressed, motions)), len(motions), ""),
        ("motions that warn of a contact", sum(map(_warns, motions)), len(motions), ""),
        ("files that a controller would refuse", sum(bool(step["limits"]) for step in motions), len(motions), "0"),
        ("looks refused", len(refused), len(steps), ""),
        ("grasps failed with a thing between the fingers", sum(_wrong(step) for step in motions), len(motions), ""),
        ("motions stopped by the controller", sum(_stopped(step) for step in motions), len(motions), ""),
    ]


def table(rows):
    """The counts, and the reason of each search that was lost, as Markdown."""
    lines = ["| | count | of | 95% interval | wanted |", "|---|---|---|---|---|"]
    for name, hits, of, wanted in counts(rows):
        low, high = wilson(hits, of)
        lines.append(f"| {name} | {hits} | {of} | {100 * low:.0f} to {100 * high:.0f}% | {wanted} |")
    touched = sorted(
        (
            (size, pair, row)
            for row in rows
            for step in row["steps"]
            for pair, size in step.get("unannounced", {}).items()
        ),
        key=lambda t: -t[0],
    )
    if touched:
        size, pair, row = touched[0]
        lines.append(f"\nLargest unannounced contact: {size} N, {pair}, layout {row['layout']}, seed {row['seed']}.")
    lines += ["", "| layout | seed | actions | looks | s | what came of it |", "|---|---|---|---|---|---|"]
    for row in sorted(rows, key=lambda r: (r["layout"], r["seed"])):
        lines.append(
            f"| {row['layout']} | {row['seed']} | {row.get('actions', '')} | {len(row['steps'])} | "
            f"{row.get('seconds', '')} | {'' if row['retrieved'] else '**lost** '}{row['why'][:300]} |"
        )
    return "\n".join(lines)


def stored(rows):
    """The searches of one target and arm for a stored file: their counts, and a line for each."""
    layouts = sorted({row["layout"] for row in rows})
    return {
        "target": rows[0]["target"],
        "arm": rows[0]["arm"],
        "layouts": [layouts[0], layouts[-1]],
        "seeds": sorted({row["seed"] for row in rows}),
        "counts": {name: {"count": int(hits), "of": of} for name, hits, of, _ in counts(rows)},
        "columns": ["layout", "seed", "retrieved", "actions", "looks", "why"],
        "rows": [
            [row["layout"], row["seed"], row["retrieved"], row.get("actions"), len(row["steps"]), row["why"]]
            for row in sorted(rows, key=lambda row: (row["layout"], row["seed"]))
        ],
    }


def _wrong(step):
    return any(
        g["between"] and not g["expected"] - g["inner"] <= g["measured"] <= g["expected"] + g["outer"]
        for g in step["executed"]["grasps"]
    )


def _pressed(step):
    below = [size for pair, size in step["executed"]["forces"].items() if pair.split("|")[1] in execution.SUPPORTS]
    return bool(step["unannounced"]) or max(below, default=0.0) > search.TOUCH


def _warns(step):
    return any(re.search(r"may touch|will brush", text) for text in [step["reason"], *step["warnings"]])


def _stopped(step):
    return any("stopped the arm" in note for note in step["executed"]["notes"])
