"""Jitted functions whose compiled forms may be kept on disk, so that a new process neither traces nor lowers them.

JAX's own cache of compilations spares the compiling alone: to find an entry a function is traced and lowered first, and
for a planner that takes longer than all the rest. Here an entry is found by what a function would be traced from: the
package's source, the versions and the machine, the shapes and types of the arguments, and what is static about them.

Nothing is kept unless a program asks for it (`keep_in`, which `planner.cache.keep_compilations` calls).
"""

from __future__ import annotations

import contextlib
import functools
import inspect
import os
import threading
import uuid
from collections.abc import Callable, Hashable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.core import Tracer
from jax.extend.core import get_opaque_trace_state

from mechsearch_jax.executables import Executables
from mechsearch_jax.identity import Unidentified, identity

# What makes XLA on a CPU compile twice as fast, with the same results at the same speed. One that an XLA does not know
# is done without.
CPU_OPTIONS: dict[str, str | bool] = {"xla_cpu_use_fusion_emitters": False}
# Settings of JAX that decide what a function is compiled to; `XLA_FLAGS` counts, too.
SETTINGS = (
    "jax_enable_x64",
    "jax_default_matmul_precision",
    "jax_default_device",
    "jax_debug_nans",
    "jax_debug_infs",
    "jax_numpy_dtype_promotion",
    "jax_threefry_partitionable",
    "jax_disable_jit",
)


class _Keeping:
    """Where this process keeps executables, and what was the state of tracing when it was told: none."""

    def __init__(self) -> None:
        self.executables: Executables | None = None
        self.untraced: Any = None


_KEEPING = _Keeping()
_TRACING = threading.RLock()


def keep_in(folder: Path | None) -> None:
    """Make this process keep what `kept` functions are compiled to in a folder; None to keep nothing from now on."""
    _KEEPING.executables = None if folder is None else Executables(folder)
    _KEEPING.untraced = get_opaque_trace_state()


class Kept:
    """A jitted function that is looked up on disk before it is traced, where a program keeps what it compiles.

    Anywhere else, inside of other transformations, for arguments on another device than the first, and for arguments
    that cannot be told apart on disk (`identity.identity`), it is what `jax.jit` makes of it.
    """

    def __init__(self, function: Callable[..., Any], static_argnames: Sequence[str]) -> None:
        """Args:
        function: a function of a module.
        static_argnames: as of `jax.jit`.
        """
        functools.update_wrapper(self, function)
        self.jitted = jax.jit(function, static_argnames=tuple(static_argnames))
        self._static = frozenset(static_argnames)
        self._positions = tuple(inspect.signature(function).parameters)
        self._name = f"{function.__module__}.{function.__qualname__}"
        self._loaded: dict[Hashable, Any] = {}
        self._lock = threading.Lock()

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        found = self._executable(args, kwargs)
        if found is None:
            return self.jitted(*args, **kwargs)
        moving, named, _ = self._split(args, kwargs)
        return found(*moving, **named)

    def __getattr__(self, name: str) -> Any:
        """Whatever else a jitted function offers, such as `lower`."""
        return getattr(self.jitted, name)

    def prepare(self, *args: Any, **kwargs: Any) -> None:
        """Load or compile what a call with these arguments needs, without calling it. May run in several threads.

        Without a folder to keep executables in, nothing happens: the first call compiles.
        """
        self._executable(args, kwargs)

    def is_ready(self, *args: Any, **kwargs: Any) -> bool:
        """Whether `prepare` with these arguments has nothing to compile; what was kept may still have to be read."""
        asked = self._asked(args, kwargs)
        if asked is None:
            return True
        executables, key, described = asked
        if key in self._loaded:
            return True
        said = described()
        return said is None or executables.has(self._name, said)

    def _split(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> tuple[tuple[Any, ...], dict[str, Any], Any]:
        """The arguments that are data, by position and by name, and those that are static."""
        places = [name in self._static for name in self._positions[: len(args)]]
        static = [(self._positions[i], args[i]) for i, fixed in enumerate(places) if fixed]
        static += [(name, kwargs[name]) for name in sorted(kwargs) if name in self._static]
        moving = tuple(arg for arg, fixed in zip(args, places, strict=True) if not fixed)
        return moving, {name: value for name, value in kwargs.items() if name not in self._static}, tuple(static)

    def _asked(
        self, args: tuple[Any, ...], kwargs: dict[str, Any]
    ) -> tuple[Executables, Hashable, Callable[[], str | None]] | None:
        """Where to look, what a call is known by in this process, and what on disk; None where nothing is kept."""
        executables = _KEEPING.executables
        if executables is None or get_opaque_trace_state() != _KEEPING.untraced or len(args) > len(self._positions):
            return None
        moving, named, static = self._split(args, kwargs)
        leaves, tree = jax.tree.flatten((moving, named))
        if not all(_plain(leaf) for leaf in leaves):
            return None
        shapes = tuple(_shape(leaf) for leaf in leaves)
        settings = tuple(str(getattr(jax.config, name)) for name in SETTINGS)
        if settings[-1] == "True":
            return None

        def described() -> str | None:
            try:
                return identity((tree, shapes, static, settings))
            except Unidentified:
                return None

        return executables, (executables, tree, shapes, static, settings), described

    def _executable(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """What runs a call; None where it is left to `jax.jit`."""
        asked = self._asked(args, kwargs)
        if asked is None:
            return None
        executables, key, described = asked
        if key not in self._loaded:
            with self._lock:
                mine = self._loaded.setdefault((key, threading.Lock), threading.Lock())
            # Other calls of this function may be compiled at the same time, the same call only once.
            with mine:
                if key not in self._loaded:
                    self._loaded[key] = self._found(executables, described(), args, kwargs)
        return self._loaded[key]

    def _found(self, executables: Executables, said: str | None, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        if said is None:
            return None
        moving, named, _ = self._split(args, kwargs)
        found = executables.load(self._name, said, jax.tree.structure((moving, named)))
        if found is None:
            found = self._compiled(args, kwargs)
            executables.save(self._name, said, found)
        return found

    def _compiled(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """The function, compiled for some arguments, such that it can be kept.

        What JAX reads from its own cache cannot be written a second time, so that it must not be found there: the name
        of a program counts.
        """

        @functools.wraps(self.__wrapped__)
        def fresh(*args, **kwargs):
            return self.__wrapped__(*args, **kwargs)

        fresh.__name__ = f"{fresh.__name__}_{uuid.uuid4().hex[:8]}"
        # One after the other, so that the first is compiled, for which Python is not needed, as the next is traced.
        with _TRACING:
            lowered = jax.jit(fresh, static_argnames=tuple(self._static)).lower(*args, **kwargs)
            _forget_source(lowered)
        # On a CPU with `CPU_OPTIONS`, where XLA knows them and nobody else has a say.
        if jax.devices()[0].platform == "cpu" and not os.environ.get("XLA_FLAGS"):
            try:
                return lowered.compile(compiler_options=CPU_OPTIONS)
            except Exception as error:
                # What an unknown option raises differs between versions.
                if not any(option in str(error) for option in CPU_OPTIONS):
                    raise
        return lowered.compile()


def kept(*, static_argnames: Sequence[str] = ()) -> Callable[[Callable[..., Any]], Kept]:
    """A decorator in the place of `jax.jit` for what takes long to trace; see `Kept`."""
    return lambda function: Kept(function, static_argnames)


def _plain(leaf: Any) -> bool:
    """Whether a leaf is an array on the first device, or a number."""
    if isinstance(leaf, Tracer):
        return False
    if isinstance(leaf, jax.Array):
        return leaf.devices() == {jax.devices()[0]}
    return isinstance(leaf, bool | int | float | np.ndarray | np.generic | jax.ShapeDtypeStruct)


def _shape(leaf: Any) -> tuple[Any, ...]:
    """What a function is traced from instead of a leaf."""
    if isinstance(leaf, bool | int | float):
        return (type(leaf).__name__,)
    return (tuple(leaf.shape), str(leaf.dtype), bool(getattr(leaf, "weak_type", False)))


def _forget_source(lowered: Any) -> None:
    """Take out of a lowered function which line of source everything came from: it is read a third faster."""
    # What JAX promises of its intermediate form is little.
    with contextlib.suppress(Exception):
        from jaxlib.mlir.passmanager import PassManager

        module = lowered.compiler_ir()
        with module.context:
            PassManager.parse("builtin.module(strip-debuginfo)").run(module.operation)
