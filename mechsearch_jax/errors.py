"""The one error that a user's input can cause."""

from __future__ import annotations

import json
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
