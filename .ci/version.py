"""The version, in the three files that name it: `python3 .ci/version.py` checks them, with a version it is set.

The newest entry of the change log is of the version that is to be released, and "unreleased" until it is set.
"""

from __future__ import annotations

import argparse
import datetime
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
VERSION = re.compile(r"\d+\.\d+\.\d+")
PYPROJECT = re.compile(r'(?<=^version = ")[^"]+(?="$)', re.MULTILINE)
CITATION = re.compile(r"(?<=^version: )\S+$", re.MULTILINE)
# What a citation of a released version has, too.
RELEASED = re.compile(r"^date-released: .*\n", re.MULTILINE)
HEADING = re.compile(r"^## (\d+\.\d+\.\d+) \((unreleased|\d{4}-\d\d-\d\d)\)$", re.MULTILINE)


def named(root: Path) -> tuple[str, str, str, str]:
    """The versions of package and citation, and the version and the date of the newest entry of the change log.

    Raises:
      ValueError: a file does not name one.
    """
    texts = [(root / file).read_text(encoding="utf-8") for file in ("pyproject.toml", "CITATION.cff", "CHANGELOG.md")]
    found = [pattern.search(text) for pattern, text in zip((PYPROJECT, CITATION, HEADING), texts, strict=True)]
    for file, match in zip(("pyproject.toml", "CITATION.cff", "CHANGELOG.md"), found, strict=True):
        if match is None:
            raise ValueError(f"{file}: names no version")
    package, citation, entry = found
    return package[0], citation[0], entry[1], entry[2]


def check(root: Path) -> None:
    """Check that the files agree.

    Raises:
      ValueError: they do not.
    """
    package, citation, entry, date = named(root)
    if package != citation:
        raise ValueError(f"pyproject.toml is {package}, CITATION.cff {citation}")
    if date != "unreleased" and entry != package:
        raise ValueError(f"pyproject.toml is {package}, and the newest entry of CHANGELOG.md is of {entry}, released")


def set_version(root: Path, version: str, date: str) -> bool:
    """Write a version and the date of its release; whether that changes anything.

    Raises:
      ValueError: it is no version, or the newest entry of the change log is of another one.
    """
    if not VERSION.fullmatch(version):
        raise ValueError(f"{version}: is no version such as 0.2.0")
    package, citation, entry, released = named(root)
    if entry != version:
        raise ValueError(f"CHANGELOG.md: its newest entry is of {entry}, not of {version}")
    if (package, citation) == (version, version) and released != "unreleased":
        return False
    edits = {
        "pyproject.toml": lambda text: PYPROJECT.sub(version, text, count=1),
        "CITATION.cff": lambda text: CITATION.sub(f"{version}\ndate-released: {date}", RELEASED.sub("", text), count=1),
        "CHANGELOG.md": lambda text: HEADING.sub(f"## {version} ({date})", text, count=1),
    }
    for file, edit in edits.items():
        (root / file).write_text(edit((root / file).read_text(encoding="utf-8")), encoding="utf-8")
    return True


def main() -> None:
    """Check or set the version."""
    parser = argparse.ArgumentParser(description="Check the version that the files of this checkout name, or set it.")
    parser.add_argument("version", nargs="?", help="to set, with today's date")
    version = parser.parse_args().version
    try:
        if version is not None:
            changed = set_version(ROOT, version, datetime.date.today().isoformat())
            print(f"{version}: {'set' if changed else 'was set before'}")
        check(ROOT)
    except ValueError as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
