"""The registries of shapes, of which whole bodies and targets may be, and of primitives, which pieces of compounds are.

A new one is a new file in this folder and an entry here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from mechsearch_jax.runtime.errors import InputError, shown
from mechsearch_jax.shapes.box import Box
from mechsearch_jax.shapes.capsule import Capsule
from mechsearch_jax.shapes.cylinder import Cylinder
from mechsearch_jax.shapes.ellipsoid import Ellipsoid
from mechsearch_jax.shapes.primitive import Primitive
from mechsearch_jax.shapes.shape import Shape

SHAPES: Mapping[str, Shape] = {shape.name: shape for shape in (Box(), Cylinder())}
# In the order of their codes.
PRIMITIVES: Mapping[str, Primitive] = {
    primitive.name: primitive for primitive in (Box(), Cylinder(), Ellipsoid(), Capsule())
}


def shape_of(name: Any, where: str = "shape") -> Shape:
    """The shape with a name; error messages begin with `where`.

    Raises:
      InputError: there is none.
    """
    for shape in SHAPES.values():
        if shape.name == name:
            return shape
    *names, last = (f'"{valid}"' for valid in SHAPES)
    raise InputError(f"{where}: {shown(name)} is unknown; use {', '.join(names)} or {last}")


def in_order() -> tuple[Shape, ...]:
    """All shapes in the order of their codes."""
    return tuple(sorted(SHAPES.values(), key=lambda shape: shape.code))


def by_shape(kind: Any, value: Callable[[Shape], Any], library: Any) -> Any:
    """For each body the `value` of its shape.

    Args:
      kind: codes of the bodies' shapes; not checked, since they may be traced.
      value: called for every shape; its results broadcast against `kind`.
      library: of the arrays, NumPy or `jax.numpy`.
    """
    first, *rest = in_order()
    chosen = value(first)
    for shape in rest:
        chosen = library.where(kind == shape.code, value(shape), chosen)
    return chosen
