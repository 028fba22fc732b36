"""All shapes. A new shape is a file of its own, beside the others, and its entry here."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from mechsearch_jax.runtime.errors import InputError, shown
from mechsearch_jax.shapes.box import Box
from mechsearch_jax.shapes.cylinder import Cylinder
from mechsearch_jax.shapes.shape import Shape

SHAPES: Mapping[str, Shape] = {shape.name: shape for shape in (Box(), Cylinder())}


def shape_of(name: Any, where: str = "shape") -> Shape:
    """The shape with a name.

    Args:
      name: of the shape.
      where: what to call it in the message.

    Raises:
      InputError: there is none.
    """
    for shape in SHAPES.values():
        if shape.name == name:
            return shape
    *others, last = (f'"{known}"' for known in SHAPES)
    raise InputError(f"{where}: {shown(name)} is unknown; use {', '.join(others)} or {last}")


def in_order() -> tuple[Shape, ...]:
    """All shapes, each at the place of its code."""
    return tuple(sorted(SHAPES.values(), key=lambda shape: shape.code))


def by_shape(kind: Any, value: Callable[[Shape], Any], library: Any) -> Any:
    """For each body what `value` gives for its shape.

    Args:
      kind: codes of the bodies' shapes. They have to be known ones: where they are traced, none can be refused.
      value: called for every shape; its results broadcast against `kind`.
      library: NumPy or `jax.numpy`, whichever the arrays are of.
    """
    first, *others = in_order()
    chosen = value(first)
    for shape in others:
        chosen = library.where(kind == shape.code, value(shape), chosen)
    return chosen
