"""NumPy archives from outside: bounded in size; whatever they hold, an `InputError` is the worst that happens."""

from __future__ import annotations

import io
import warnings
import zipfile

import numpy as np

from mechsearch_jax.runtime.errors import InputError, shown
from mechsearch_jax.runtime.files import PathLike

# What is larger, packed or not, is none of ours [bytes]: the largest has 20 MB.
ARRAYS_LIMIT = 512 * 2**20


def read_arrays(data: bytes, where: PathLike, limit: int = ARRAYS_LIMIT) -> dict[str, np.ndarray]:
    """The arrays in a NumPy archive, by name; no code can run from it.

    Args:
      data: what the archive's file holds.
      where: how to name it in messages.
      limit: an archive that unpacks to more bytes is refused.

    Raises:
      InputError: it is damaged or none, or unpacks to too much.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > limit:
            raise InputError(f"{where}: unpacks to {size} bytes; at most {limit} are read")
        with warnings.catch_warnings(), np.load(io.BytesIO(data), allow_pickle=False) as archive:
            warnings.simplefilter("ignore")
            arrays = {name: archive[name] for name in archive.files}
        strange = [name for name, array in arrays.items() if not isinstance(array, np.ndarray)]
        if strange:
            raise InputError(f"{where}: holds {shown(strange[0])}, which is no array")
        return arrays
    except InputError:
        raise
    # To damage the parsers beneath answer with a dozen kinds of exception, and document none.
    except Exception as error:
        raise InputError(f"{where}: is no whole archive of arrays, .npz ({type(error).__name__})") from error
