"""Files that are written beside their place and then moved there, so that each is either whole or not there at all."""

from __future__ import annotations

import contextlib
import json
import os
import tempfile
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from mechsearch_jax.errors import InputError

PathLike = str | os.PathLike[str]


@contextlib.contextmanager
def replacing(path: PathLike) -> Iterator[IO[bytes]]:
    """A binary file to write to; it takes the place of `path` at the end, unless an exception leaves the block.

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
    """Write numbers, texts, lists and dictionaries as JSON; there may be no NaN among them.

    Raises:
      InputError: the file cannot be written.
    """
    with replacing(path) as file:
        file.write((json.dumps(value, indent=1, allow_nan=False) + "\n").encode())


def check_writable(folder: PathLike) -> None:
    """Fail before the work begins rather than after it, if files cannot be written into a folder.

    Raises:
      InputError: the folder does not exist and cannot be made, or nothing can be written into it.
    """
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(f"{folder}: cannot be written to ({error.strerror or error})") from error
