"""Values told apart across processes: equal texts for what a function would be traced to the same program from."""

from __future__ import annotations

import dataclasses
import enum
import functools
import hashlib
import importlib
import inspect
import os
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

# Packages whose functions and classes are told by their names: this one, whose source counts, and those whose versions
# do, in what tells one executable from another.
KNOWN = ("builtins", "mechsearch_jax", "jax", "jaxlib", "numpy", "flax", "functools", "enum", "pathlib")


class Unidentified(Exception):
    """A value that another process could not be told to be the same."""


def identity(value: Any) -> str:
    """A text that is the same in every process for equal values, and another for others.

    Args:
      value: numbers, texts, arrays, enumerations, functions and classes of the packages in `KNOWN`, partial
        applications and dataclasses of these, containers, and structures of pytrees whose static parts are such. Of a
        dataclass those fields count that its comparison looks at; all of them where it has none.

    Raises:
      Unidentified: it is something else, such as a function of a user's own, whose source is not known.
    """
    if value is None or (isinstance(value, bool | int | str | bytes) and type(value).__module__ == "builtins"):
        return repr(value)
    if isinstance(value, float) and type(value) is float:
        return value.hex()
    if isinstance(value, jax.tree_util.PyTreeDef):
        return _structure(value)
    if isinstance(value, enum.Enum):
        return f"{_name(type(value))}.{value.name}"
    if isinstance(value, tuple | list) and type(value) in (tuple, list):
        return f"{type(value).__name__}({','.join(identity(part) for part in value)})"
    if isinstance(value, Mapping):
        parts = sorted((identity(key), identity(part)) for key, part in value.items())
        return f"{_name(type(value))}{{{','.join(f'{key}:{part}' for key, part in parts)}}}"
    if isinstance(value, frozenset | set):
        return f"{type(value).__name__}({','.join(sorted(identity(part) for part in value))})"
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        array = np.asarray(value)
        if array.dtype.hasobject:
            raise Unidentified("an array of objects")
        return f"array({array.dtype.str},{array.shape},{hashlib.sha256(array.tobytes()).hexdigest()})"
    if isinstance(value, np.dtype):
        return f"dtype({value.str})"
    if isinstance(value, os.PathLike):
        return f"path({os.fspath(value)!r})"
    if isinstance(value, functools.partial):
        return f"partial({identity(value.func)},{identity(value.args)},{identity(value.keywords)})"
    if isinstance(value, type) or inspect.isroutine(value):
        return _name(value)
    if dataclasses.is_dataclass(value):
        return _fields(value)
    # Functions that are wrapped, as by `jax.jit`, are told by the name that they stand under.
    if callable(value) and hasattr(value, "__wrapped__"):
        return _name(value)
    raise Unidentified(f"a {type(value).__name__}")


def _name(value: Any) -> str:
    """The place of a function or a class in a known package, where it is what is found there."""
    module, place = getattr(value, "__module__", None) or "", getattr(value, "__qualname__", "")
    if module.partition(".")[0] not in KNOWN:
        raise Unidentified(f"{module}.{place}")
    try:
        found = functools.reduce(getattr, place.split("."), importlib.import_module(module))
    except (ImportError, AttributeError):
        found = None
    if found is not value:
        raise Unidentified(f"{module}.{place}")
    return f"{module}.{place}"


def _fields(value: Any) -> str:
    compared = type(value).__eq__ is not object.__eq__
    told = [
        f"{field.name}={identity(getattr(value, field.name))}"
        for field in dataclasses.fields(value)
        if field.compare or not compared
    ]
    return f"{_name(type(value))}({','.join(told)})"


def _structure(tree: Any) -> str:
    node = tree.node_data()
    if node is None:
        return "*" if tree.num_leaves else "None"
    kind, static = node
    inside = ",".join(_structure(child) for child in tree.children())
    return f"{_name(kind)}[{identity(static)}]({inside})"
