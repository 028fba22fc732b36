"""Results as JSON files with a line for every row."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from typing import Any

from mechsearch_jax.runtime.files import PathLike, replacing


def save_rows(value: dict[str, Any], rows: Sequence[Any], path: PathLike) -> None:
    """Write results as JSON, with one line for every row.

    Args:
      value: everything but the rows.
      rows: dataclasses of one kind; at least one.
      path: of the file.

    Raises:
      InputError: the file cannot be written.
    """
    columns = [field.name for field in dataclasses.fields(rows[0])]
    head = json.dumps(value | {"columns": columns}, indent=1, allow_nan=False)
    lines = (json.dumps([getattr(row, name) for name in columns], allow_nan=False) for row in rows)
    text = head.removesuffix("\n}") + ',\n "rows": [\n  ' + ",\n  ".join(lines) + "\n ]\n}\n"
    with replacing(path) as file:
        file.write(text.encode())
