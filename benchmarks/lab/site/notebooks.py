"""Executes the notebooks of docs/notebooks and stores them with their outputs.

`python -m mechsearch_jax.benchmarks.lab.site.notebooks [NAME ...]` in a checkout, with the extra `notebooks`. A
notebook is executed in a fresh kernel and is written only if all of its cells ran. Its pictures are stored with few
colours, and nothing that changes from run to run is kept beside outputs.
"""

from __future__ import annotations

import argparse
import base64
import io
import json
import re
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from PIL import Image

from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike, read_json, replacing

FOLDER = Path("docs/notebooks")
ENDING = ".ipynb"
# Largest notebook [bytes], and colours of a stored picture.
LARGEST, COLOURS = 600_000, 256
# What is kept of a notebook's metadata, which is the same wherever it is executed.
METADATA: dict[str, Any] = {
    "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
    "language_info": {"file_extension": ".py", "name": "python"},
}
_ESCAPES = re.compile(r"\x1b\[[0-9;]*m")


def names(folder: PathLike = FOLDER) -> list[str]:
    """The notebooks of a folder, without their ending."""
    return sorted(file.stem for file in Path(folder).glob(f"*{ENDING}"))


def code_cells(notebook: dict[str, Any]) -> list[str]:
    """The source of each cell of code of a notebook, read as JSON."""
    return ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]


def executed(notebook: dict[str, Any]) -> dict[str, Any]:
    """A notebook with the outputs of its cells, executed in a new kernel in an empty folder.

    Raises:
      InputError: Jupyter's packages are not installed, or a cell raises an exception.
    """
    try:
        import nbformat  # pyright: ignore[reportMissingImports]
        from nbclient import NotebookClient  # pyright: ignore[reportMissingImports]
        from nbclient.exceptions import CellExecutionError  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise InputError(f"notebooks: {error.name} is missing; install mechsearch-jax[notebooks]") from error
    # The kernel of this Python, whatever others are registered.
    node = nbformat.reads(json.dumps({**notebook, "metadata": METADATA}), as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        resources = {"metadata": {"path": folder}}
        client = NotebookClient(node, timeout=None, kernel_name="python3", resources=resources, coalesce_streams=True)
        try:
            client.execute()
        except CellExecutionError as error:
            raise InputError(f"notebooks: a cell failed\n{error}") from error
    return json.loads(nbformat.writes(node))


def tidied(notebook: dict[str, Any]) -> dict[str, Any]:
    """A notebook without what differs between two runs, and with small pictures."""
    cells = []
    for number, cell in enumerate(notebook["cells"]):
        tidy = {**cell, "id": f"cell-{number:02d}", "metadata": {}}
        if cell["cell_type"] == "code":
            tidy["outputs"] = [_tidied_output(output) for output in cell["outputs"]]
        cells.append(tidy)
    return {**notebook, "cells": cells, "metadata": METADATA}


def _tidied_output(output: dict[str, Any]) -> dict[str, Any]:
    if output["output_type"] == "stream":
        # Bold and colours are for terminals.
        return {**output, "text": [_ESCAPES.sub("", line) for line in output["text"]]}
    data = output.get("data", {})
    if "image/png" not in data:
        return output
    # The text beside a picture says no more than that it is a figure.
    return {**output, "data": {"image/png": smaller(data["image/png"])}, "metadata": {}}


def smaller(picture: str | Sequence[str]) -> str:
    """A PNG in base64 with at most `COLOURS` colours; the same if it is one of a palette already."""
    text = "".join(picture)
    with Image.open(io.BytesIO(base64.b64decode(text))) as image:
        if image.mode == "P":
            return text
        # Of all methods the one that keeps colours that are rare in the picture, such as those of a legend.
        few = image.convert("RGB").quantize(COLOURS, Image.Quantize.MAXCOVERAGE, kmeans=2, dither=Image.Dither.NONE)
    file = io.BytesIO()
    few.save(file, format="PNG", optimize=True)
    return base64.b64encode(file.getvalue()).decode()


def write(name: str, folder: PathLike = FOLDER) -> Path:
    """Execute a notebook of a folder and store it.

    Raises:
      InputError: it cannot be read, a cell fails, or it becomes too large.
    """
    path = Path(folder) / f"{name}{ENDING}"
    content = json.dumps(tidied(executed(read_json(path))), indent=1, ensure_ascii=False, sort_keys=True) + "\n"
    if len(content.encode()) > LARGEST:
        raise InputError(f"{path}: has {len(content.encode())} bytes, more than {LARGEST}; draw smaller pictures")
    with replacing(path) as file:
        file.write(content.encode())
    return path


def main(arguments: Sequence[str] | None = None) -> None:
    """Execute some notebooks, or all of them."""
    parser = argparse.ArgumentParser(description=f"Execute notebooks of {FOLDER} and store them with their outputs.")
    parser.add_argument("names", nargs="*", metavar="NAME", help="notebooks, without .ipynb; all of them without")
    parser.add_argument("--folder", default=FOLDER, type=Path, help="where they are")
    given = parser.parse_args(arguments)
    there = names(given.folder)
    if unknown := [name for name in given.names if name not in there]:
        parser.error(f"{unknown[0]}: is no notebook of {given.folder}; there are {', '.join(there) or 'none'}")
    try:
        for name in given.names or there:
            print(write(name, given.folder), flush=True)
    except InputError as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
