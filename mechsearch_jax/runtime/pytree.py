"""Dataclasses that are pytrees."""

from __future__ import annotations

import dataclasses
from typing import Any, TypeVar, dataclass_transform

import jax

T = TypeVar("T", bound="PyTreeNode")


def static(**arguments: Any) -> Any:
    """A field of a `PyTreeNode` that is no child: part of the tree's structure, hashable.

    Args:
      **arguments: as of `dataclasses.field`, such as `default`.
    """
    return dataclasses.field(metadata={"static": True}, **arguments)


@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field, static))
class PyTreeNode:
    """Subclasses are frozen dataclasses, and pytrees whose children are the fields that are not `static`.

    As `flax.struct.PyTreeNode`, without the import of all of Flax.
    """

    def __init_subclass__(cls, **arguments: Any) -> None:
        super().__init_subclass__(**arguments)
        dataclasses.dataclass(frozen=True)(cls)
        names: dict[bool, list[str]] = {True: [], False: []}
        for field in dataclasses.fields(cls):  # pyright: ignore[reportArgumentType]
            names["static" in field.metadata].append(field.name)
        jax.tree_util.register_dataclass(cls, names[False], names[True])

    def replace(self: T, **changes: Any) -> T:
        """The same with other values of some fields."""
        return dataclasses.replace(self, **changes)  # pyright: ignore[reportArgumentType, reportCallIssue]
