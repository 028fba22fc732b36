"""The one error that a user's input can cause."""

from __future__ import annotations

import difflib
import json
from collections.abc import Iterable
from typing import Any

# Messages show at most so many characters of a value.
SHOWN = 60


class InputError(ValueError):
    """Bad input from a user: one line that names what is wrong, where, and how to mend it.

    The command line prints the message without a traceback and exits with status 2.
    """


class Note(UserWarning):
    """One line about a user's input that is used, perhaps not as it was meant; the command line prints it alone."""


def shown(value: Any) -> str:
    """A user's value for a message: as JSON, on one line, cut if it is long."""
    try:
        text = json.dumps(value, default=str)
    except (ValueError, TypeError, RecursionError):
        text = f"a {type(value).__name__}"
    return text if len(text) <= SHOWN else f"{text[: SHOWN - 3]}..."


def nearest(name: str, valid: Iterable[str]) -> str:
    """The end of a message about an unknown name: the valid name that resembles it, or all valid names."""
    names = list(valid)
    alike = difflib.get_close_matches(name[:SHOWN], names, n=1)
    return f"did you mean {alike[0]}?" if alike else f"known are {', '.join(names)}"


def check_once(what: str, names: Iterable[str]) -> None:
    """Check that no name is given twice, as the results of both could not be told apart.

    Args:
      what: is named, as "lab scenes: two sources".
      names: of all.

    Raises:
      InputError: a name is there twice.
    """
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise InputError(f"{what} are called {name}; rename one")
        seen.add(name)


def check_range(name: str, value: float | int, low: float | int, high: float | int, unit: str = "") -> None:
    """Check that a number is from `low` to `high`.

    Raises:
      InputError: it is not, or it is NaN.
    """
    if not low <= value <= high:
        raise InputError(f"{name} ({value}) must be from {low:g} to {high:g}{unit and ' '}{unit}")
