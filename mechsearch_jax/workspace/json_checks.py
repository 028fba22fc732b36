"""Checks of parsed JSON that scenario files share."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from mechsearch_jax.runtime.errors import InputError, shown

# How far the length of a unit quaternion may be from 1.
UNIT = 1e-3


def numbers(value: Any, count: int, where: str) -> tuple[float, ...]:
    """A list of finite numbers.

    Raises:
      InputError: it is none, or has another length.
    """
    number = isinstance(value, list) and all(isinstance(v, int | float) and not isinstance(v, bool) for v in value)
    if not number or len(value) != count:
        raise InputError(f"{where}: must be a list of {count} numbers")
    try:
        floats = tuple(float(v) for v in value)
    except OverflowError:
        raise InputError(f"{where}: holds a number that is too large; every number must be finite") from None
    if not all(math.isfinite(v) for v in floats):
        raise InputError(f"{where}: holds NaN or an infinite number; every number must be finite")
    return floats


def number(value: Any, low: float, high: float, unit: str, where: str) -> float:
    """A number in a range.

    Raises:
      InputError: it is none, or out of the range.
    """
    if not isinstance(value, int | float) or isinstance(value, bool) or not low <= value <= high:
        raise InputError(f"{where}: {shown(value)} must be a number from {low:g} to {high:g}{unit and ' '}{unit}")
    return float(value)


def check_norm(quaternion: Sequence[float], where: str) -> None:
    """Check that a quaternion (w, x, y, z) has length 1.

    Raises:
      InputError: it has not.
    """
    if abs(math.hypot(*quaternion) - 1.0) > UNIT:
        raise InputError(f"{where}: its norm is {math.hypot(*quaternion):.4g}; it must be 1 (w, x, y, z)")


def check_keys(value: Any, keys: Sequence[str], where: str, optional: Sequence[str] = ()) -> None:
    """Check that a value is a JSON object with these keys.

    Raises:
      InputError: it is none, or a key is unknown or missing.
    """
    known = (*keys, *optional)
    if not isinstance(value, dict):
        raise InputError(f"{where}: must be a JSON object with the keys {', '.join(known)}")
    for unknown in [k for k in value if k not in known]:
        raise InputError(f"{where}: unknown key {shown(unknown)}; known are {', '.join(known)}")
    for missing in [k for k in keys if k not in value]:
        raise InputError(f'{where}: key "{missing}" is missing')
