"""Compiled functions on disk."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib.metadata
import os
import pickle
import platform
import stat
import warnings
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import serialize_executable

from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import replacing
from mechsearch_jax.runtime.versions import source_digest

FORMAT = b"mechsearch-executable 1\n"
# Those of older versions of the package are of no use; what is left serves who switches between versions and settings.
MOST_BYTES = 1 << 30
# What an executable holds that only works in the process that compiled it: calls back into Python.
LAPACK = b"lapack"
UNKEEPABLE = (b"python_cpu_callback", b"python_gpu_callback")


class Executables:
    """A folder of executables.

    An entry is told apart by the package's source, the versions of what compiled it, the device, the processor, the
    flags of XLA, the function and what is said of its arguments. What is damaged, of something else, or cannot be
    loaded, is as if it were not there.

    Loading runs what the file says: only files of a folder are read that belong to the user and that nobody else may
    write to. Never point it at files of others.
    """

    def __init__(self, folder: Path) -> None:
        """Args:
        folder: made when it is first needed, for the user alone.
        """
        self.folder = folder
        self._warned = False

    def has(self, name: str, said: str) -> bool:
        """Whether there is an entry, whole or not."""
        return self._trusted() and self._file(name, said).exists()

    def load(self, name: str, said: str, structure: Any) -> Any:
        """The executable of a function; None if there is none that can be used.

        Args:
          name: of the function.
          said: all that is to be known of its arguments.
          structure: of its arguments, as a pytree `(args, kwargs)`.
        """
        file = self._file(name, said)
        if not self._trusted():
            return None
        try:
            head, key, digest, data = file.read_bytes().split(b"\n", 3)
            if head + b"\n" != FORMAT or key.decode() != self._key(name, said):
                return None
            if hashlib.sha256(data).hexdigest() != digest.decode():
                return None
            blob, results = pickle.loads(data)
            if LAPACK in blob:
                _set_up_lapack()
            found = serialize_executable.deserialize_and_load(
                blob, structure, results, execution_devices=jax.devices()[:1]
            )
            os.utime(file)
        # Whatever is wrong with it, it is compiled anew.
        except Exception:
            return None
        return found

    def save(self, name: str, said: str, compiled: Any) -> None:
        """Keep an executable, if it can be kept; a folder that cannot be written to is done without."""
        try:
            blob, _, results = serialize_executable.serialize(compiled)
            data = pickle.dumps((blob, results))
        # Not all can be, and what is raised then depends on JAX.
        except Exception:
            return
        if any(word in blob for word in UNKEEPABLE):
            return
        with contextlib.suppress(InputError, OSError):
            self.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            if not self._trusted():
                return
            digest = hashlib.sha256(data).hexdigest()
            with replacing(self._file(name, said)) as file:
                file.write(FORMAT + f"{self._key(name, said)}\n{digest}\n".encode() + data)
            self._forget_old()

    def _file(self, name: str, said: str) -> Path:
        return self.folder / f"{name.rpartition('.')[2].strip('_')}-{self._key(name, said)[:32]}.exe"

    def _key(self, name: str, said: str) -> str:
        return hashlib.sha256(f"{_source()} {_machine()} {name} {said}".encode()).hexdigest()

    def _trusted(self) -> bool:
        """Whether the folder is the user's own, and nobody else may write to it; one that is not there is."""
        if not hasattr(os, "getuid"):
            return True
        try:
            told = self.folder.stat()
        except OSError:
            return True
        trusted = told.st_uid == os.getuid() and not told.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
        if not trusted and not self._warned:
            self._warned = True
            warnings.warn(
                f"{self.folder}: others may write to it, so that no compiled function is read from it; "
                "make it your own and mode 700, or name another folder with MECHSEARCH_CACHE_DIR",
                stacklevel=2,
            )
        return trusted

    def _forget_old(self) -> None:
        files = sorted(((f.stat(), f) for f in self.folder.glob("*.exe")), key=lambda pair: -pair[0].st_mtime)
        total = 0
        for told, file in files:
            total += told.st_size
            if total > MOST_BYTES:
                file.unlink(missing_ok=True)


@functools.cache
def _set_up_lapack() -> None:
    """Make LAPACK known to XLA, which JAX does when it first lowers something that uses it; without, a process dies."""
    square, row = jax.ShapeDtypeStruct((1, 1), jnp.float32), jax.ShapeDtypeStruct((1,), jnp.float32)
    jax.jit(jnp.linalg.solve).lower(square, row)


@functools.cache
def _source() -> str:
    """A digest of all source that may be traced."""
    return source_digest((".py",), ("mechsearch_jax", "mechsearch_jax.envs"))


@functools.cache
def _machine() -> str:
    """Versions, device, processor and flags: what else an executable depends on, of this process."""
    device = jax.devices()[0]
    versions = [importlib.metadata.version(name) for name in ("jax", "jaxlib", "numpy", "flax")]
    flags = [os.environ.get(name, "") for name in ("XLA_FLAGS", "LIBTPU_INIT_ARGS")]
    said = (versions, device.platform, device.device_kind, device.client.platform_version, len(jax.devices()), flags)
    return repr((platform.python_version(), said, processor()))


def processor() -> str:
    """What tells this processor from others that the same code need not run on: its model and what it can do.

    Where the system does not say what it can do, the machine's name.
    """
    try:
        told = Path("/proc/cpuinfo").read_text().partition("\n\n")[0].splitlines()
    except OSError:
        return f"{platform.machine()} {platform.processor()} {platform.platform()} {platform.node()}"
    wanted = ("vendor_id", "cpu family", "model", "model name", "flags", "Features", "CPU implementer", "CPU part")
    pairs = (line.partition(":") for line in told)
    return "; ".join(f"{name.strip()}={value.strip()}" for name, _, value in pairs if name.strip() in wanted)
