"""Result of a check of one thing that a search needs."""

from __future__ import annotations

import dataclasses
import enum


class State(enum.Enum):
    """How usable something is."""

    FINE = "fine"
    MISSING = "missing"  # The main job, one search on a CPU, does without.
    DOUBTFUL = "doubtful"  # It works, but less well than it should.
    BROKEN = "BROKEN"


@dataclasses.dataclass(frozen=True)
class Finding:
    """Result of a check.

    Attributes:
      subject: what was checked.
      state: how usable it is.
      says: one line of text.
      remedy: how to mend it; empty if nothing is wrong.
    """

    subject: str
    state: State
    says: str
    remedy: str = ""
