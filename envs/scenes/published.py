"""Reads the scenes that the authors of the paper published (docs/method.md, "The published scenes").

Each is a pickle of a list of bodies, the target last: `type`, `size` (of a box its extents, of a cylinder radius,
radius and height), `position` [m], `orientation` (x, y, z, w) and a colour. Unpickling may run any code: so nothing is
allowed in a file but what these hold, containers, numbers and arrays.
"""

from __future__ import annotations

import io
import pickle
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike
from mechsearch_jax.workspace.scenario import Body, Scenario

# The names of their files, in folders `objects_N`.
FILE = re.compile(r"initial_scenario_(\d+)\.pkl")
FOLDER = re.compile(r"objects_(\d+)")
PATTERN = "objects_N/initial_scenario_K.pkl"
# What numbers are rounded to [m]: 1 micrometre.
DIGITS = 6
_LARGEST = 1 << 20
_ALLOWED = {
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
    # Versions of NumPy pickle arrays and numbers by functions that lie in different places.
    **{
        (module, name): value.__reduce__()[0]
        for module in ("numpy.core.multiarray", "numpy._core.multiarray")
        for name, value in (("_reconstruct", np.zeros(1)), ("scalar", np.float64(0.0)))
    },
}


class _Unpickler(pickle.Unpickler):
    """Refuses everything but arrays of numbers."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ALLOWED:
            raise pickle.UnpicklingError(f"holds {module}.{name}, which is neither a number nor an array")
        return _ALLOWED[module, name]


def read_published(path: PathLike) -> Scenario:
    """The scenario of a published file, named "published-N-KK" after its folder `objects_N` and its own number.

    Raises:
      InputError: the file has another name or place, cannot be read, or holds something else.
    """
    path = Path(path)
    number, count = FILE.fullmatch(path.name), FOLDER.fullmatch(path.parent.name)
    if number is None or count is None:
        raise InputError(
            f"{path}: is not named objects_N/initial_scenario_K.pkl; give the authors' folders as they are"
        )
    try:
        with path.open("rb") as file:
            data = file.read(_LARGEST + 1)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    if len(data) > _LARGEST:
        raise InputError(f"{path}: is larger than a scene is")
    try:
        bodies = [_body(body) for body in _Unpickler(io.BytesIO(data)).load()]
    # What a damaged pickle raises is not limited.
    except Exception as error:
        raise InputError(f"{path}: is none of the published scenes ({' '.join(str(error).split())})") from error
    if len(bodies) != int(count[1]) + 1:
        raise InputError(f"{path}: holds {len(bodies)} bodies, not {count[1]} objects and a target")
    return Scenario(f"published-{count[1]}-{int(number[1]):02d}", tuple(bodies[:-1]), bodies[-1])


def _body(body: Mapping[str, Any]) -> Body:
    shape = body["type"]
    if shape not in ("box", "cylinder"):
        raise ValueError(f"a body is a {shape!r}, neither box nor cylinder")
    size = np.asarray(body["size"], float).reshape(3)
    half_size = size / 2 if shape == "box" else size * [1.0, 1.0, 0.5]
    x, y, z, w = np.asarray(body["orientation"], float).reshape(4)
    return Body(
        shape,
        _rounded(half_size),
        _rounded(np.asarray(body["position"], float).reshape(3)),
        _rounded(np.array([w, x, y, z])),
    )


def _rounded(values: np.ndarray) -> Any:
    return tuple(round(float(value), DIGITS) for value in values)


def published_files(folder: PathLike) -> list[Path]:
    """The published files in a folder and those in it, in their order.

    Raises:
      InputError: there are none.
    """
    files = {
        (int(count[1]), int(number[1])): file
        for file in Path(folder).rglob("*.pkl")
        if (count := FOLDER.fullmatch(file.parent.name)) and (number := FILE.fullmatch(file.name))
    }
    if not files:
        raise InputError(f"{folder}: holds no {PATTERN}; give the folder exp_configs of the authors' repository")
    return [files[key] for key in sorted(files)]
