"""Options that this version has no more, and the values that they are fixed at."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

# By the option's name, as files and rows of results have it.
FIXED: Mapping[str, Any] = {
    "protocol": "strict",
    "imitates": "nothing",
}


def refusal(name: str) -> str | None:
    """What to say to who gives an option that is fixed now, in one line; None if the name is of no such option.

    Args:
      name: with underscores, or as on the command line.
    """
    plain = name.removeprefix("--").partition("=")[0].replace("-", "_")
    if plain not in FIXED:
        return None
    shown = name.partition("=")[0] if name.startswith("--") else plain
    return f"{shown} is no option any more: it is fixed at {_text(FIXED[plain])}; leave it out"


def without_fixed(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options of a row or an episode of an earlier version, as this version has them: without those that had the value
    that they are fixed at."""
    return {name: value for name, value in options.items() if name not in FIXED or value != FIXED[name]}


def _text(value: Any) -> str:
    return " ".join(f"{part:.4g}" for part in value) if isinstance(value, list) else str(value)
