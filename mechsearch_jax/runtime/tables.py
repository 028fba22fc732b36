"""Frozen dataclasses from tables of a TOML file, checked by their annotations; errors name file, line and key."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import re
import tomllib
import types
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from mechsearch_jax.runtime.errors import InputError, nearest, shown
from mechsearch_jax.runtime.files import PathLike, read_text
from mechsearch_jax.runtime.options import DEGREES, in_radians

# Largest size of a settings file [bytes].
LIMIT = 2**18
T = TypeVar("T")

_BARE = re.compile(r"[A-Za-z0-9_-]{1,60}( \d{1,6})?")
_HEADER = re.compile(r"\s*\[\s*([A-Za-z0-9_-]+)\s*\]\s*(?:#.*)?$")
_ITEM = re.compile(r"\s*\[\[\s*([A-Za-z0-9_-]+)\s*\]\]\s*(?:#.*)?$")
_KEY = re.compile(r"\s*([A-Za-z0-9_-]+)\s*=")
# The prefix of error messages of dataclasses.
_CLASS = re.compile(r"^[A-Z]\w+: ")
_LINE = re.compile(r"\s*\(at line (\d+), column \d+\)")


@dataclasses.dataclass(frozen=True)
class Document:
    """A TOML file of tables that are not nested.

    Attributes:
      path: how messages name the file.
      tables: its tables by name; "" holds the keys before the first table; those of an array by its name and their
        numbers from 1, as "obstacle 2".
      lines: line numbers of tables and keys, by (table, "") and (table, key).
    """

    path: str
    tables: Mapping[str, Mapping[str, Any]]
    lines: Mapping[tuple[str, str], int]

    def where(self, table: str, key: str = "") -> str:
        """The beginning of an error message about a table, or a key in it."""
        line = self.lines.get((table, key), self.lines.get((table, "")))
        place = f"{self.path}:{line}" if line else self.path
        return f"{place}:{table and f' [{_quoted(table)}]'}{key and f' {_quoted(key)}'}"


def _quoted(name: str) -> str:
    return name if _BARE.fullmatch(name) else shown(name)


def read_document(path: PathLike, arrays: Sequence[str] = ()) -> Document:
    """Read a TOML file.

    Args:
      path: of the file.
      arrays: names of which there may be several tables, each with its name in two brackets.

    Raises:
      InputError: it cannot be read, or is not TOML.
    """
    text = read_text(path, LIMIT)
    try:
        value = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        message = " ".join(str(error).split()) or type(error).__name__
        line = _LINE.search(message)
        place = f"{path}:{line[1]}" if line else f"{path}"
        raise InputError(f"{place}: is not TOML ({_LINE.sub('', message)[:200]})") from error
    for name in arrays:
        parts = value.get(name)
        if isinstance(parts, list) and all(isinstance(part, dict) for part in parts):
            value |= {f"{name} {number}": part for number, part in enumerate(value.pop(name), start=1)}
    tables = {name: part for name, part in value.items() if isinstance(part, dict)}
    tables[""] = {name: part for name, part in value.items() if name not in tables}
    return Document(str(path), tables, _lines(text, tables))


def _lines(text: str, tables: Mapping[str, Mapping[str, Any]]) -> dict[tuple[str, str], int]:
    """Line numbers of the tables and keys that are written plainly; others, such as quoted keys, have none."""
    lines: dict[tuple[str, str], int] = {}
    counts: dict[str, int] = {}
    table = ""
    for number, line in enumerate(text.splitlines(), start=1):
        header, key, item = _HEADER.match(line), _KEY.match(line), _ITEM.match(line)
        if item:
            counts[item[1]] = counts.get(item[1], 0) + 1
            table = f"{item[1]} {counts[item[1]]}"
            lines[table, ""] = number
        elif header and header[1] in tables:
            table = header[1]
            lines.setdefault((table, ""), number)
        elif key and key[1] in tables.get(table, ()):
            lines.setdefault((table, key[1]), number)
    return lines


def with_values(text: str, table: str, values: Mapping[str, Any], name: str) -> str:
    """A TOML file's text with other values in a table; all else, comments too, stays as it is.

    Args:
      text: of the file; may be empty.
      table: that the values are of; it is appended if it is missing.
      values: numbers, and lists of them, by their keys.
      name: of the file, in messages.

    Raises:
      InputError: the text is not TOML, or the table is not written on lines of its own.
    """
    try:
        before = tomllib.loads(text)
        lines = text.splitlines()
        places = _lines(text, {key: part for key, part in before.items() if isinstance(part, dict)} | {"": before})
        for place in sorted((at for (of, key), at in places.items() if of == table and key in values), reverse=True):
            del lines[place - 1 : place - 1 + _span(lines[place - 1 :])]
        written = [f"{key} = {json.dumps(value)}" for key, value in values.items()]
        at = places.get((table, ""))
        if at is None:
            lines += [*([""] if lines else []), f"[{table}]"]
            at = len(lines)
        lines[at:at] = written
        after = "\n".join(lines) + "\n"
        wanted = before | {table: {**before.get(table, {}), **json.loads(json.dumps(values))}}
        if tomllib.loads(after) == wanted:
            return after
    except (ValueError, TypeError, AttributeError, RecursionError):
        pass
    raise InputError(f"{name}: cannot be changed; write [{table}] on a line of its own, and its keys below it")


def _span(lines: Sequence[str]) -> int:
    """How many lines the value takes that begins on the first."""
    for count in range(1, len(lines) + 1):
        with contextlib.suppress(ValueError, RecursionError):
            tomllib.loads("\n".join(lines[:count]))
            return count
    return 1


def check_names(document: Document, table: str, valid: Mapping[str, Any]) -> None:
    """Check the keys of a table.

    Raises:
      InputError: a key is not among the valid ones.
    """
    for key in document.tables.get(table, {}):
        if key not in valid:
            raise InputError(f"{document.where(table, key)} is unknown; {nearest(key, valid)}")


def with_table(document: Document, table: str, usual: T) -> T:
    """A dataclass whose fields are replaced by the values in a table of a file.

    Args:
      document: the file.
      table: name of the table; it may be missing.
      usual: the dataclass with its defaults.

    Raises:
      InputError: a key is not a field, or a value is impossible or of the wrong type.
    """
    defaults: Any = usual
    kind: Any = type(usual)
    hints = get_type_hints(kind)
    check_names(document, table, {field.name: field for field in dataclasses.fields(kind)})
    given = {
        key: checked(value, hints[key], document.where(table, key))
        for key, value in document.tables.get(table, {}).items()
    }
    least = {field.name: field.metadata.get(DEGREES) for field in dataclasses.fields(kind)}
    return apply(
        document,
        table,
        given,
        lambda changes: dataclasses.replace(
            defaults, **{key: in_radians(key, value, least[key]) for key, value in changes.items()}
        ),
    )


def apply(document: Document, table: str, given: Mapping[str, Any], make: Callable[[Mapping[str, Any]], T]) -> T:
    """`make(given)`, with the file's place in front of its error messages.

    Raises:
      InputError: as `make`.
    """
    try:
        return make(given)
    except InputError as error:
        message = str(error)
    # Without the value at fault `make` raises nothing, or another error.
    key = next((key for key in given if _error_message(make, given, key) != message), "")
    message = _CLASS.sub("", message)
    place = document.where(table, key)
    raise InputError(f"{place.removesuffix(key) if key and message.startswith(key) else f'{place}: '}{message}")


def _error_message(make: Callable[[Mapping[str, Any]], Any], given: Mapping[str, Any], without: str) -> str | None:
    try:
        make({key: value for key, value in given.items() if key != without})
    except InputError as error:
        return str(error)
    return None


def checked(value: Any, hint: Any, where: str) -> Any:
    """A value of a TOML file, converted to its annotated type: lists become tuples, and integers floats.

    Args:
      value: as the parser returned it.
      hint: `bool`, `int`, `float`, `str`, a `Literal` of texts, or a tuple of these; each may be optional.
      where: the beginning of an error message.

    Raises:
      InputError: it is of another type, or not finite.
    """
    if get_origin(hint) in (Union, types.UnionType):
        (hint,) = [part for part in get_args(hint) if part is not type(None)]
    if get_origin(hint) is tuple:
        return _checked_list(value, get_args(hint), where)
    if get_origin(hint) is Literal:
        choices = get_args(hint)
        if value not in choices:
            raise InputError(f"{where} must be one of {', '.join(map(shown, choices))}, not {shown(value)}")
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
    return tuple(checked(item, part, f"{where}[{i}]") for i, (item, part) in enumerate(zip(value, parts, strict=True)))
