"""Values told apart across processes: equal texts for what a function would be traced to the same program from."""

from __future__ import annotations

import dataclasses
import hashlib
import inspect
import io
import pickle
from typing import Any

# Packages whose functions and classes are told by their names: this one, whose source counts, and those whose versions
# do, in what tells one executable from another.
KNOWN = ("builtins", "mechsearch_jax", "jax", "jaxlib", "numpy", "flax", "functools", "enum", "pathlib", "copyreg")


class Unidentified(Exception):
    """A value that another process could not be told to be the same."""


class _Teller(pickle.Pickler):
    """Writes values, and refuses what is not of a known package."""

    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file, protocol=5)
        # Without notes of what was written before: whether equal parts are one object does not count.
        self.fast = True

    def reducer_override(self, obj: Any) -> Any:
        # Functions that are wrapped, as by `jax.jit`, are told by the name that they stand under. Pickle itself looks
        # whether it is what is found there.
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
    """A text that is the same in every process for equal values, and another for others.

    Args:
      value: what can be pickled and is made of the packages in `KNOWN`: numbers, texts, arrays, enumerations, functions
        and classes, partial applications and dataclasses of these, containers, and structures of pytrees whose static
        parts are such. Of a dataclass those fields count that its comparison looks at; all of them where it has none.
        The order of a dictionary counts.

    Raises:
      Unidentified: it is something else, such as a function of a user's own, whose source is not known.
    """
    written = io.BytesIO()
    try:
        _Teller(written).dump(value)
    except (pickle.PicklingError, AttributeError, TypeError, ValueError, RecursionError) as error:
        raise Unidentified(str(error)) from error
    return hashlib.sha256(written.getvalue()).hexdigest()
