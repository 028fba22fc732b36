"""Arrays that take long to compute, kept on disk between runs."""

from __future__ import annotations

import contextlib
import hashlib
import os
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import replacing

VARIABLE = "MECHSEARCH_CACHE_DIR"
# So many files of a kind are kept, the last used.
MOST_FILES = 256


def cache_folder() -> Path | None:
    """`MECHSEARCH_CACHE_DIR`, or a folder in the user's cache; None if that variable is set to nothing."""
    chosen = os.environ.get(VARIABLE)
    if chosen is not None:
        return Path(chosen) if chosen else None
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "mechsearch-jax"


def kept_arrays(kind: str, key: str, make: Callable[[], Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """What `make` returns, read from disk if it was made before with the same key.

    A damaged file is made again; where the folder cannot be written to, nothing is kept.

    Args:
      kind: begins the names of the files.
      key: all that the arrays depend on.
      make: makes them; no name is "digest".
    """
    folder = cache_folder()
    if folder is None:
        return dict(make())
    file = folder / f"{kind}-{hashlib.sha256(key.encode()).hexdigest()[:32]}.npz"
    arrays = load_arrays(file, key)
    if arrays is None:
        arrays = dict(make())
        with contextlib.suppress(InputError, OSError):
            save_arrays(arrays, file, key)
            forget_old(folder, kind, MOST_FILES)
    return arrays


def save_arrays(arrays: Mapping[str, np.ndarray], file: Path, key: str) -> None:
    """Write arrays so that `load_arrays` with the same key finds them.

    Raises:
      InputError: the file cannot be written.
    """
    with replacing(file) as target:
        np.savez(target, allow_pickle=False, **arrays, digest=np.array(_digest(arrays, key)))


def load_arrays(file: Path, key: str) -> dict[str, np.ndarray] | None:
    """The arrays in a file; None if it is missing, damaged or has another key."""
    try:
        with np.load(file, allow_pickle=False) as saved:
            arrays = {name: saved[name] for name in saved.files}
        same = str(arrays.pop("digest")) == _digest(arrays, key)
        with contextlib.suppress(OSError):
            os.utime(file)
        return arrays if same else None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, EOFError, zipfile.BadZipFile):
        return None


def forget_old(folder: Path, kind: str, most: int) -> None:
    """Delete files of a kind beyond a number, those that were not used for the longest time."""
    by_use: list[tuple[float, Path]] = []
    for file in folder.glob(f"{kind}-*.npz"):
        # Another process may delete it meanwhile.
        with contextlib.suppress(OSError):
            by_use.append((file.stat().st_mtime, file))
    for _, file in sorted(by_use, reverse=True)[most:]:
        file.unlink(missing_ok=True)


def _digest(arrays: Mapping[str, np.ndarray], key: str) -> str:
    digest = hashlib.sha256(key.encode())
    for name, array in sorted(arrays.items()):
        digest.update(f"{name} {array.dtype.str} {array.shape} ".encode() + np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
