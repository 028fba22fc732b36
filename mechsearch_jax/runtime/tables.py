"""Frozen dataclasses from tables of a TOML file: checked by their annotations, with file, line and key in every
complaint."""

from __future__ import annotations

import dataclasses
import math
import re
import tomllib
import types
from collections.abc import Callable, Mapping
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from mechsearch_jax.runtime.errors import InputError, nearest, shown
from mechsearch_jax.runtime.files import PathLike, read_text

# More than this no file of settings has [bytes].
LIMIT = 2**18
T = TypeVar("T")

_BARE = re.compile(r"[A-Za-z0-9_-]{1,60}")
_HEADER = re.compile(r"\s*\[\s*([A-Za-z0-9_-]+)\s*\]\s*(?:#.*)?$")
_KEY = re.compile(r"\s*([A-Za-z0-9_-]+)\s*=")
# What complaints of dataclasses begin with.
_CLASS = re.compile(r"^[A-Z]\w+: ")
_LINE = re.compile(r"\s*\(at line (\d+), column \d+\)")


@dataclasses.dataclass(frozen=True)
class Document:
    """A TOML file of tables without tables inside.

    Attributes:
      path: how the file is named.
      tables: its tables, by their names; "" holds what stands before the first.
      lines: where tables and keys stand, by (table, "") and (table, key).
    """

    path: str
    tables: Mapping[str, Mapping[str, Any]]
    lines: Mapping[tuple[str, str], int]

    def where(self, table: str, key: str = "") -> str:
        """How a complaint about a table, or a key in it, begins."""
        line = self.lines.get((table, key), self.lines.get((table, "")))
        place = f"{self.path}:{line}" if line else self.path
        return f"{place}:{table and f' [{_told(table)}]'}{key and f' {_told(key)}'}"


def _told(name: str) -> str:
    return name if _BARE.fullmatch(name) else shown(name)


def read_document(path: PathLike) -> Document:
    """Read a TOML file.

    Raises:
      InputError: it cannot be read, or is not TOML.
    """
    text = read_text(path, LIMIT)
    try:
        value = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        told = " ".join(str(error).split()) or type(error).__name__
        line = _LINE.search(told)
        place = f"{path}:{line[1]}" if line else f"{path}"
        raise InputError(f"{place}: is not TOML ({_LINE.sub('', told)[:200]})") from error
    tables = {name: part for name, part in value.items() if isinstance(part, dict)}
    tables[""] = {name: part for name, part in value.items() if name not in tables}
    return Document(str(path), tables, _lines(text, tables))


def _lines(text: str, tables: Mapping[str, Mapping[str, Any]]) -> dict[tuple[str, str], int]:
    """Where the tables and keys of a text stand that are written in the usual way; of others nothing is known."""
    lines: dict[tuple[str, str], int] = {}
    table = ""
    for number, line in enumerate(text.splitlines(), start=1):
        header, key = _HEADER.match(line), _KEY.match(line)
        if header and header[1] in tables:
            table = header[1]
            lines.setdefault((table, ""), number)
        elif key and key[1] in tables[table]:
            lines.setdefault((table, key[1]), number)
    return lines


def check_names(document: Document, table: str, known: Mapping[str, Any]) -> None:
    """Refuse keys that a table cannot have.

    Raises:
      InputError: it has one.
    """
    for key in document.tables.get(table, {}):
        if key not in known:
            raise InputError(f"{document.where(table, key)} is unknown; {nearest(key, known)}")


def with_table(document: Document, table: str, usual: T) -> T:
    """A dataclass with what a table of a file gives in place of its fields.

    Args:
      document: the file.
      table: name of the table; it may be missing.
      usual: what the dataclass is without the table.

    Raises:
      InputError: a key is no field, or a value is of another type or impossible.
    """
    known: Any = usual
    kind: Any = type(usual)
    hints = get_type_hints(kind)
    check_names(document, table, {field.name: field for field in dataclasses.fields(kind)})
    given = {
        key: checked(value, hints[key], document.where(table, key))
        for key, value in document.tables.get(table, {}).items()
    }
    return apply(document, table, given, lambda changes: dataclasses.replace(known, **changes))


def apply(document: Document, table: str, given: Mapping[str, Any], make: Callable[[Mapping[str, Any]], T]) -> T:
    """What `make` makes of a table's values; where it refuses them, its complaint with the place of the one at fault.

    Raises:
      InputError: as `make`.
    """
    try:
        return make(given)
    except InputError as error:
        said = str(error)
    # Without the value at fault there is no complaint, or another one.
    key = next((key for key in given if _complaint(make, given, key) != said), "")
    said = _CLASS.sub("", said)
    place = document.where(table, key)
    raise InputError(f"{place.removesuffix(key) if key and said.startswith(key) else f'{place}: '}{said}")


def _complaint(make: Callable[[Mapping[str, Any]], Any], given: Mapping[str, Any], without: str) -> str | None:
    try:
        make({key: value for key, value in given.items() if key != without})
    except InputError as error:
        return str(error)
    return None


def checked(value: Any, hint: Any, where: str) -> Any:
    """A value of a TOML file as an annotation has it: lists become tuples, and whole numbers numbers where any will do.

    Args:
      value: as the parser returned it.
      hint: `bool`, `int`, `float`, `str`, a `Literal` of texts, or a tuple of such; or None beside one of these.
      where: how the complaint begins.

    Raises:
      InputError: it is of another type, or not finite.
    """
    if get_origin(hint) in (Union, types.UnionType):
        (hint,) = [part for part in get_args(hint) if part is not type(None)]
    if get_origin(hint) is tuple:
        return _checked_list(value, get_args(hint), where)
    if get_origin(hint) is Literal:
        known = get_args(hint)
        if value not in known:
            raise InputError(f"{where} must be one of {', '.join(map(shown, known))}, not {shown(value)}")
        return value
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        try:
            value = float(value)
        except OverflowError:
            raise InputError(f"{where} must be a number that is finite, not {shown(value)}") from None
    if type(value) is not hint:
        raise InputError(f"{where} must be {_NAMED[hint]}, not {shown(value)}")
    if hint is float and not math.isfinite(value):
        raise InputError(f"{where} must be a number that is finite, not {shown(value)}")
    if hint is int and abs(value) >= 2**31:
        raise InputError(f"{where} must be a whole number within 32 bits, not {shown(value)}")
    return value


_NAMED = {bool: "true or false", int: "a whole number", float: "a number", str: "a text"}


def _checked_list(value: Any, parts: tuple[Any, ...], where: str) -> tuple[Any, ...]:
    if not isinstance(value, list):
        raise InputError(f"{where} must be a list, not {shown(value)}")
    if parts[-1] is Ellipsis:
        parts = (parts[0],) * len(value)
    if len(parts) != len(value):
        raise InputError(f"{where} must be a list of {len(parts)}, not of {len(value)}: {shown(value)}")
    return tuple(checked(one, part, f"{where}[{i}]") for i, (one, part) in enumerate(zip(value, parts, strict=True)))
