"""How many cores this process may keep busy."""

from __future__ import annotations

import os

# Set for processes that share the cores with others.
VARIABLE = "MECHSEARCH_CORES"


def cores() -> int:
    """`MECHSEARCH_CORES`, or the cores that this process may run on."""
    given = os.environ.get(VARIABLE, "")
    if given.isdecimal() and int(given) > 0:
        return int(given)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def share_of_cores(processes: int) -> dict[str, str]:
    """What the environment of each of several processes must hold, so that together they keep no more cores busy than
    this one may."""
    return {VARIABLE: str(max(cores() // processes, 1))}
