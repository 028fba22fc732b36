"""What the measurements of the lab say, on the screen."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any


def as_text(lines: Iterable[Mapping[str, Any]]) -> str:
    """A line for each, of what it says by name: `source held-out, objects 8, iou_mean 0.947`."""
    return "\n".join(", ".join(f"{name} {_said(value)}" for name, value in line.items()) for line in lines)


def _said(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return " to ".join(map(_said, value)) if isinstance(value, list | tuple) else "-" if value is None else str(value)
