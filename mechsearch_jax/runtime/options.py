"""Fields of configurations that are options of the command line and columns of results."""

from __future__ import annotations

import dataclasses
from typing import Any


def option(default: Any, help: str, choices: tuple[str, ...] | None = None) -> Any:
    """A dataclass field that is an option, with one line of help and the values it may have (any if None)."""
    return dataclasses.field(default=default, metadata={"help": help, "choices": choices})
