"""Identify values across processes: arguments with equal identities make JAX trace the same program."""

from __future__ import annotations

import dataclasses
import hashlib
import inspect
import io
import pickle
from typing import Any, Generic, TypeVar

# Packages whose functions and classes are identified by their names. The key of an executable holds a digest of this
# package's source and the versions of the others.
KNOWN = ("builtins", "mechsearch_jax", "jax", "jaxlib", "numpy", "flax", "functools", "enum", "pathlib", "copyreg")


T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class Uncompared(Generic[T]):
    """A static value on which no program depends: it equals any other, and has the same identity."""

    value: T = dataclasses.field(compare=False)


class Unidentified(Exception):
    """A value that cannot be identified in another process."""


class _IdentityPickler(pickle.Pickler):
    """Writes values, and refuses those that are not of a package in `KNOWN`."""

    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file, protocol=5)
        # No memo: whether equal parts are the same object does not count.
        self.fast = True

    def reducer_override(self, obj: Any) -> Any:
        # Wrapped functions, as by `jax.jit`, are identified by their names; pickle checks that these lead to them.
        if isinstance(obj, type) or inspect.isroutine(obj) or hasattr(obj, "__wrapped__"):
            module = getattr(obj, "__module__", None) or ""
            if module.partition(".")[0] not in KNOWN:
                raise Unidentified(f"{module}.{getattr(obj, '__qualname__', obj)}")
            return obj.__qualname__
        if dataclasses.is_dataclass(obj):
            compared = type(obj).__eq__ is not object.__eq__
            fields = [field.name for field in dataclasses.fields(obj) if field.compare or not compared]
            return type(obj), tuple((name, getattr(obj, name)) for name in fields)
        if type(obj) is object:
            raise Unidentified("an object")
        return NotImplemented


def identity(value: Any) -> str:
    """A SHA-256 in hexadecimal that is equal for equal values in every process, and differs between other values.

    Args:
      value: anything that can be pickled and is made of the packages in `KNOWN`: numbers, texts, arrays, enumerations,
        functions, classes, partial applications, dataclasses, containers, and pytree structures. Of a dataclass the
        compared fields count, or all fields if it has no comparison. The order of a dictionary counts.

    Raises:
      Unidentified: it is something else, such as a user's function, whose source is not part of any key.
    """
    written = io.BytesIO()
    try:
        _IdentityPickler(written).dump(value)
    except (pickle.PicklingError, AttributeError, TypeError, ValueError, RecursionError) as error:
        raise Unidentified(str(error)) from error
    return hashlib.sha256(written.getvalue()).hexdigest()
