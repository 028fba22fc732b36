"""Read NumPy archives of unknown origin: their size is bounded, and damage of any kind raises an `InputError`."""

from __future__ import annotations

import io
import warnings
import zipfile

import numpy as np

from mechsearch_jax.runtime.errors import InputError, shown
from mechsearch_jax.runtime.files import PathLike

# Larger archives, packed or not, are not ours [bytes]: the largest of ours has 20 MB.
ARRAYS_LIMIT = 512 * 2**20


def read_arrays(data: bytes, where: PathLike, limit: int = ARRAYS_LIMIT) -> dict[str, np.ndarray]:
    """The arrays in a NumPy archive, by name. Nothing in it is executed.

    Args:
      data: the bytes of the archive.
      where: how messages name it.
      limit: largest size after unpacking [bytes].

    Raises:
      InputError: it is damaged, not an archive of arrays, or too large.
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
    # The parsers raise a dozen undocumented kinds of exception on damaged files.
    except Exception as error:
        raise InputError(f"{where}: is no whole archive of arrays, .npz ({type(error).__name__})") from error
