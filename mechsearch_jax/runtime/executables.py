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
# The oldest entries are deleted beyond this size [bytes]; the rest serves users who switch between versions.
MOST_BYTES = 1 << 30
LAPACK = b"lapack"
# Executables with calls back into Python only work in the process that compiled them.
UNKEEPABLE = (b"python_cpu_callback", b"python_gpu_callback")


class Executables:
    """A folder of executables.

    The key of an entry is made of the package's source, the versions of the compilers, the device, the processor, the
    flags of XLA, the function and the signature of its arguments. Entries that are damaged, have another key or cannot
    be loaded are ignored.

    Loading an entry can run code from its file. Therefore the folder must belong to the user, and nobody else may have
    write access. Never use it with files of others.
    """

    def __init__(self, folder: Path) -> None:
        """Args:
        folder: created on demand, with access for the user alone.
        """
        self.folder = folder
        self._warned = False

    def has(self, name: str, signature: str) -> bool:
        """Whether there is an entry, damaged or not."""
        return self._trusted() and self._file(name, signature).exists()

    def load(self, name: str, signature: str, structure: Any) -> Any:
        """The executable of a function; None if there is none that can be used.

        Args:
          name: of the function.
          signature: identifies its arguments, see `runtime.identity.identity`.
          structure: of its arguments, as a pytree `(args, kwargs)`.
        """
        file = self._file(name, signature)
        if not self._trusted():
            return None
        try:
            head, key, digest, data = file.read_bytes().split(b"\n", 3)
            if head + b"\n" != FORMAT or key.decode() != self._key(name, signature):
                return None
            if hashlib.sha256(data).hexdigest() != digest.decode():
                return None
            blob, results = pickle.loads(data)
            if LAPACK in blob:
                _set_up_lapack()
            executable = serialize_executable.deserialize_and_load(
                blob, structure, results, execution_devices=jax.devices()[:1]
            )
            os.utime(file)
        # Whatever is wrong with it, the caller compiles it again.
        except Exception:
            return None
        return executable

    def save(self, name: str, signature: str, compiled: Any) -> None:
        """Keep an executable if it can be serialised and the folder can be written to."""
        try:
            blob, _, results = serialize_executable.serialize(compiled)
            data = pickle.dumps((blob, results))
        # The exception for an executable that cannot be serialised depends on JAX's version.
        except Exception:
            return
        if any(word in blob for word in UNKEEPABLE):
            return
        with contextlib.suppress(InputError, OSError):
            self.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            if not self._trusted():
                return
            digest = hashlib.sha256(data).hexdigest()
            with replacing(self._file(name, signature)) as file:
                file.write(FORMAT + f"{self._key(name, signature)}\n{digest}\n".encode() + data)
            self._forget_old()

    def _file(self, name: str, signature: str) -> Path:
        return self.folder / f"{name.rpartition('.')[2].strip('_')}-{self._key(name, signature)[:32]}.exe"

    def _key(self, name: str, signature: str) -> str:
        return hashlib.sha256(f"{_source()} {_machine()} {name} {signature}".encode()).hexdigest()

    def _trusted(self) -> bool:
        """Whether the folder belongs to the user and nobody else may write to it, or it does not exist."""
        if not hasattr(os, "getuid"):
            return True
        try:
            status = self.folder.stat()
        except OSError:
            return True
        trusted = status.st_uid == os.getuid() and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
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
        for status, file in files:
            total += status.st_size
            if total > MOST_BYTES:
                file.unlink(missing_ok=True)


@functools.cache
def _set_up_lapack() -> None:
    """Register LAPACK's functions with XLA. JAX does so when it first lowers a call; without them the process dies."""
    square, row = jax.ShapeDtypeStruct((1, 1), jnp.float32), jax.ShapeDtypeStruct((1,), jnp.float32)
    jax.jit(jnp.linalg.solve).lower(square, row)


@functools.cache
def _source() -> str:
    """SHA-256 of all source that may be traced."""
    return source_digest((".py",), ("mechsearch_jax", "mechsearch_jax.envs"))


@functools.cache
def _machine() -> str:
    """Versions, device, processor and flags of this process, on which an executable depends."""
    device = jax.devices()[0]
    versions = [importlib.metadata.version(name) for name in ("jax", "jaxlib", "numpy", "flax")]
    flags = [os.environ.get(name, "") for name in ("XLA_FLAGS", "LIBTPU_INIT_ARGS")]
    parts = (versions, device.platform, device.device_kind, device.client.platform_version, len(jax.devices()), flags)
    return repr((platform.python_version(), parts, processor()))


def processor() -> str:
    """The processor's model and instruction sets, without which machine code may not run.

    If the system does not list them, the machine's name.
    """
    try:
        lines = Path("/proc/cpuinfo").read_text().partition("\n\n")[0].splitlines()
    except OSError:
        return f"{platform.machine()} {platform.processor()} {platform.platform()} {platform.node()}"
    wanted = ("vendor_id", "cpu family", "model", "model name", "flags", "Features", "CPU implementer", "CPU part")
    pairs = (line.partition(":") for line in lines)
    return "; ".join(f"{name.strip()}={value.strip()}" for name, _, value in pairs if name.strip() in wanted)
