"""The commands that write a page of the docs anew from a folder of stored results."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import replacing


def rewrite(
    page: Callable[[str], str], option: str, folder: str, out: str, arguments: Sequence[str] | None = None
) -> None:
    """Write a page, as the command line says; a mistake ends the program with one line.

    Args:
      page: makes its text of the folder's path.
      option: name of the option that gives the folder, as "results".
      folder: where a checkout has it.
      out: the page, from the root of a checkout.
      arguments: of the command line; the program's if None.
    """
    parser = argparse.ArgumentParser(description=f"Write {out} from what is stored in {folder}.")
    parser.add_argument(f"--{option}", default=folder, dest="folder", help="folder of what is stored")
    parser.add_argument("--out", default=out, help="the page")
    given = parser.parse_args(arguments)
    if not Path(given.folder).is_dir():
        parser.error(f"{given.folder}: is no folder; start it at the root of a checkout, or give --{option}")
    try:
        text = page(given.folder)
        with replacing(given.out) as file:
            file.write(text.encode())
    except FileNotFoundError as error:
        parser.error(f"{error.filename}: is not there; give the folder of what is stored as --{option}")
    except InputError as error:
        parser.error(str(error))
