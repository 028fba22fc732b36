"""What is found out about one thing that a search needs."""

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
    """What was found out about one thing.

    Attributes:
      subject: what it is.
      state: how usable it is.
      says: one line.
      remedy: what to do about it; empty where nothing is to be done.
    """

    subject: str
    state: State
    says: str
    remedy: str = ""
