"""Write files atomically, and read files of unknown origin: size is bounded, and bad content raises `InputError`."""

from __future__ import annotations

import contextlib
import json
import os
import tempfile
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from mechsearch_jax.runtime.errors import InputError

PathLike = str | os.PathLike[str]
# Larger text files are not ours [bytes]: the largest scenario has 10 kB.
TEXT_LIMIT = 4 * 2**20


@contextlib.contextmanager
def replacing(path: PathLike) -> Iterator[IO[bytes]]:
    """A binary file to write to; it replaces `path` at the end, unless an exception leaves the block.

    Raises:
      InputError: the file cannot be written.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
        try:
            with open(temporary, "xb") as file:
                yield file
            os.replace(temporary, path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error})") from error


def save_json(value: dict[str, Any], path: PathLike) -> None:
    """Write a dictionary as JSON; it may hold no NaN.

    Raises:
      InputError: the file cannot be written.
    """
    with replacing(path) as file:
        file.write((json.dumps(value, indent=1, allow_nan=False) + "\n").encode())


def check_writable(folder: PathLike) -> None:
    """Check before the work begins that files can be written into a folder, which is created if it is missing.

    Raises:
      InputError: they cannot.
    """
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(f"{folder}: cannot be written to ({error.strerror or error})") from error


def is_file(path: PathLike) -> bool:
    """Whether there is a readable path to a file; False instead of an error for an impossible path."""
    try:
        return Path(path).is_file()
    except OSError:
        return False


def is_folder(path: PathLike) -> bool:
    """`is_file` for a folder."""
    try:
        return Path(path).is_dir()
    except OSError:
        return False


def read_bytes(path: PathLike, limit: int) -> bytes:
    """The content of a file.

    Raises:
      InputError: the file cannot be read, or has more than `limit` bytes.
    """
    try:
        with open(path, "rb") as file:
            data = file.read(limit + 1)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})") from error
    if len(data) > limit:
        raise InputError(f"{path}: is too large; at most {limit} bytes are read")
    return data


def read_text(path: PathLike, limit: int = TEXT_LIMIT) -> str:
    """The content of a text file.

    Raises:
      InputError: the file cannot be read, is too large, or is not UTF-8.
    """
    try:
        return read_bytes(path, limit).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not a text file in UTF-8") from error


def read_json(path: PathLike, limit: int = TEXT_LIMIT) -> Any:
    """The content of a JSON file, as `json.loads` returns it.

    Raises:
      InputError: as `read_text`, or it is not JSON.
    """
    text = read_text(path, limit)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is not JSON ({' '.join(str(error).split())})") from error
