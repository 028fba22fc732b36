"""The one error that a user's input can cause."""

from __future__ import annotations

import difflib
import json
from collections.abc import Iterable
from typing import Any

# Longer values are cut in messages.
SHOWN = 60


class InputError(ValueError):
    """Bad input from a user: one line that names what is wrong, where, and how to mend it.

    The command line prints the message without a traceback and exits with status 2.
    """


def shown(value: Any) -> str:
    """A value that came from outside, for a message: as JSON has it, on one line, cut where it is long."""
    try:
        text = json.dumps(value, default=str)
    except (ValueError, TypeError, RecursionError):
        text = f"a {type(value).__name__}"
    return text if len(text) <= SHOWN else f"{text[: SHOWN - 3]}..."


def nearest(name: str, known: Iterable[str]) -> str:
    """How to mend a name that is unknown: the end of a message, which names the known one that it resembles, or all."""
    names = list(known)
    alike = difflib.get_close_matches(name[:SHOWN], names, n=1)
    return f"did you mean {alike[0]}?" if alike else f"known are {', '.join(names)}"


def check_range(name: str, value: float | int, low: float | int, high: float | int, unit: str = "") -> None:
    """Refuse a number that is not from `low` to `high`; NaN is not.

    Raises:
      InputError: it is not.
    """
    if not low <= value <= high:
        raise InputError(f"{name} ({value}) must be from {low:g} to {high:g}{unit and ' '}{unit}")
