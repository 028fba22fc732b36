"""Fields of configurations that are options of the command line and columns of results."""

from __future__ import annotations

import dataclasses
from typing import Any


def option(default: Any, help: str, choices: tuple[str, ...] | None = None) -> Any:
    """A dataclass field that is an option.

    Args:
      default: its value.
      help: one line for the command line.
      choices: the values it may have; None where any will do.
    """
    return dataclasses.field(default=default, metadata={"help": help, "choices": choices})
