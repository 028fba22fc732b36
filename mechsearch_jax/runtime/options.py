"""Fields of configurations that are options of the command line and columns of results, and angles of files."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from mechsearch_jax.runtime.errors import InputError

# In a field's metadata: see `least_degrees` of `option`.
DEGREES = "degrees"


def option(
    default: Any, help: str, choices: tuple[str, ...] | None = None, *, least_degrees: float | None = None
) -> Any:
    """A dataclass field that is an option.

    Args:
      default: its value.
      help: one line.
      choices: the values it may have; any if None.
      least_degrees: given for angles, which fields hold in radians, and files and the command line in degrees: the
        smallest that makes sense beside 0. What is smaller was meant in radians.
    """
    return dataclasses.field(default=default, metadata={"help": help, "choices": choices, DEGREES: least_degrees})


def angle(default: float, *, least_degrees: float) -> Any:
    """A dataclass field of an angle [rad] that files give in degrees; see `option`."""
    return dataclasses.field(default=default, metadata={DEGREES: least_degrees})


def in_radians(name: str, degrees: Any, least: float | None) -> Any:
    """A value as it is given in a file or on the command line, as its field holds it.

    Args:
      name: of the field.
      degrees: an angle or a tuple of angles; any other value if `least` is None.
      least: the field's `least_degrees`.

    Raises:
      InputError: an angle is so small that it was meant in radians.
    """
    if least is None:
        return degrees
    if isinstance(degrees, tuple):
        return tuple(in_radians(name, part, least) for part in degrees)
    if 0.0 < abs(degrees) < least:
        raise InputError(f"{name} {degrees:g} is in degrees, of which {least:g} is the least; is it meant in radians?")
    return math.radians(degrees)


def in_degrees(radians: Any) -> Any:
    """An angle or several [rad] as files and the command line have them, without the digits that conversion adds."""
    if isinstance(radians, list | tuple):
        return tuple(map(in_degrees, radians))
    return round(math.degrees(radians), 6)
