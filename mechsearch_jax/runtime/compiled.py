"""Jitted functions that are compiled beforehand, many at the same time, and kept on disk for the next process.

JAX's own cache of compilations spares the compiling alone: to find an entry a function is traced and lowered first, and
for a planner that takes longer than all the rest. Here an entry is found by what a function would be traced from: the
package's source, the versions and the machine, the shapes and types of the arguments, and what is static about them.

Nothing is kept unless a program asks for it (`keep_in`, which `problem.cache.keep_compilations` calls).
"""

from __future__ import annotations

import contextlib
import functools
import inspect
import os
import threading
import uuid
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.core import Tracer
from jax.extend.core import get_opaque_trace_state

from mechsearch_jax.runtime.cores import on_host
from mechsearch_jax.runtime.executables import Executables
from mechsearch_jax.runtime.identity import Unidentified, identity

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

    def outside(self) -> None:
        """Take note that nothing is being traced."""
        if self.untraced is None:
            self.untraced = get_opaque_trace_state()


_KEEPING = _Keeping()
_TRACING = threading.RLock()


def keep_in(folder: Path | None) -> None:
    """Make this process keep what `kept` functions are compiled to in a folder; None to keep nothing from now on."""
    _KEEPING.executables = None if folder is None else Executables(folder)
    _KEEPING.untraced = get_opaque_trace_state()


def kept_in() -> Path | None:
    """Where this process keeps what `kept` functions are compiled to; None where it does not."""
    return None if _KEEPING.executables is None else _KEEPING.executables.folder


class Kept:
    """A jitted function that can be compiled before it is called, and is looked up on disk before it is traced.

    What was prepared with `begin` or `prepare` is called as it is. Where a program keeps what it compiles, all is
    prepared at the latest when it is called. Anywhere else, inside of other transformations, and for arguments on
    another device than the first, it is what `jax.jit` makes of it. Arguments that cannot be told apart on disk
    (`runtime.identity.identity`) are compiled in every process.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        static_argnames: Sequence[str] = (),
        *,
        on_disk: bool = True,
        donate_argnums: Sequence[int] = (),
    ) -> None:
        """Args:
        function: a function of a module; any where it is not kept on disk.
        static_argnames, donate_argnums: as of `jax.jit`.
        on_disk: whether it may be kept there: it depends on nothing but its arguments.
        """
        functools.update_wrapper(self, function)
        self._options: dict[str, Any] = {
            "static_argnames": tuple(static_argnames),
            "donate_argnums": tuple(donate_argnums),
        }
        self.jitted = jax.jit(function, **self._options)
        self._static = frozenset(static_argnames)
        self._positions = tuple(inspect.signature(function).parameters)
        self._name = f"{function.__module__}.{function.__qualname__}"
        self._on_disk = on_disk
        # What runs a call, or will once it is compiled, by what tells calls apart in this process.
        self._loaded: dict[Hashable, Future[Any]] = {}
        # What was lowered here returns, as shapes.
        self._returned: dict[Hashable, Any] = {}

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        found = self._executable(args, kwargs)
        if found is None:
            return self.jitted(*args, **kwargs)
        moving, named, _ = self._split(args, kwargs)
        return found(*moving, **named)

    def __getattr__(self, name: str) -> Any:
        """Whatever else a jitted function offers, such as `lower`."""
        return getattr(self.jitted, name)

    def begin(self, *args: Any, **kwargs: Any) -> Callable[[], None] | None:
        """Lower what a call with these arguments needs, without calling it.

        Args:
          *args, **kwargs: as of a call; where they are data, `jax.ShapeDtypeStruct` will do.

        Returns:
          What compiles it, or reads it from disk: to be called once, in any thread, since nothing in it needs Python.
          None where nothing is left to do, and for arguments that only `jax.jit` serves.

        Raises:
          Exception: whatever is wrong with the function; then a call says so, too.
        """
        _KEEPING.outside()
        key = self._key(args, kwargs)
        compilation: Future[Any] = Future()
        if key is None or self._loaded.setdefault(key, compilation) is not compilation:
            return None
        try:
            compiling = self._compiling(key, args, kwargs)
        except BaseException as error:
            self._failed(key, error)
            raise

        def finish() -> None:
            try:
                compilation.set_result(compiling())
            except BaseException as error:
                self._failed(key, error)
                raise

        return finish

    def prepare(self, *args: Any, **kwargs: Any) -> None:
        """Load or compile what a call with these arguments needs, without calling it. May run in several threads."""
        finish = self.begin(*args, **kwargs)
        if finish is not None:
            finish()

    def returns(self, *args: Any, **kwargs: Any) -> Any:
        """The shapes of what a call returns for which `begin` was called, so that what takes it can be prepared, too.

        What is read from disk is waited for.

        Raises:
          KeyError: `begin` was not called for such arguments, or did not succeed.
        """
        key = self._key(args, kwargs)
        found = self._returned[key] if key in self._returned else self._loaded[key].result().out_info
        return jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape, a.dtype, weak_type=a.weak_type), found)

    def is_ready(self, *args: Any, **kwargs: Any) -> bool:
        """Whether `prepare` with these arguments has nothing to compile; what was kept may still have to be read."""
        _KEEPING.outside()
        key = self._key(args, kwargs)
        if key is None or key in self._loaded:
            return True
        said = self._said(args, kwargs)
        return said is not None and _KEEPING.executables is not None and _KEEPING.executables.has(self._name, said)

    def _split(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> tuple[tuple[Any, ...], dict[str, Any], Any]:
        """The arguments that are data, by position and by name, and those that are static."""
        places = [name in self._static for name in self._positions[: len(args)]]
        static = [(self._positions[i], args[i]) for i, fixed in enumerate(places) if fixed]
        static += [(name, kwargs[name]) for name in sorted(kwargs) if name in self._static]
        moving = tuple(arg for arg, fixed in zip(args, places, strict=True) if not fixed)
        return moving, {name: value for name, value in kwargs.items() if name not in self._static}, tuple(static)

    def _key(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Hashable | None:
        """What a call is known by in this process; None where it is left to `jax.jit`."""
        if get_opaque_trace_state() != _KEEPING.untraced or len(args) > len(self._positions):
            return None
        call = self._call_key(args, kwargs)
        if call is None or call[-1][-1] == "True":
            return None
        return (_KEEPING.executables, *call)

    def _call_key(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> tuple[Any, ...] | None:
        """What a call is compiled for: structure, shapes, static arguments, settings; None for what is no array."""
        moving, named, static = self._split(args, kwargs)
        leaves, tree = jax.tree.flatten((moving, named))
        if not all(_plain(leaf) for leaf in leaves):
            return None
        settings = tuple(str(getattr(jax.config, name)) for name in SETTINGS)
        return tree, tuple(_shape(leaf) for leaf in leaves), static, settings

    def _said(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> str | None:
        """What a call is known by on disk; None where it cannot be told apart there, or nothing is kept."""
        if _KEEPING.executables is None or not self._on_disk:
            return None
        try:
            return identity(self._call_key(args, kwargs))
        except Unidentified:
            return None

    def _executable(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """What runs a call; None where it is left to `jax.jit`."""
        if not self._loaded and _KEEPING.executables is None:
            return None
        key = self._key(args, kwargs)
        if key is None:
            return None
        if key not in self._loaded and _KEEPING.executables is not None:
            self.prepare(*args, **kwargs)
        found = self._loaded.get(key)
        # Where another thread could not compile it, this one finds out why.
        return None if found is None or found.exception() is not None else found.result()

    def _failed(self, key: Hashable, error: BaseException) -> None:
        self._loaded.pop(key).set_exception(error)

    def _compiling(self, key: Hashable, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Callable[[], Any]:
        """What gives the executable of a call: all that needs Python is done."""
        said, executables = self._said(args, kwargs), _KEEPING.executables
        if said is None or executables is None:
            return functools.partial(_compile, self._lowered(key, args, kwargs))

        def load() -> Any:
            moving, named, _ = self._split(args, kwargs)
            return executables.load(self._name, said, jax.tree.structure((moving, named)))

        def compile_and_save(lowered: Any) -> Any:
            found = _compile(lowered)
            executables.save(self._name, said, found)
            return found

        if executables.has(self._name, said):
            # What is damaged is compiled all the same, where it is found to be.
            return lambda: load() or compile_and_save(self._lowered(key, args, kwargs, alone=True))
        return functools.partial(compile_and_save, self._lowered(key, args, kwargs, alone=True))

    def _lowered(self, key: Hashable, args: tuple[Any, ...], kwargs: dict[str, Any], alone: bool = False) -> Any:
        """The function, lowered for some arguments.

        Args:
          key: of the call.
          args, kwargs: of a call.
          alone: such that it can be kept. What JAX reads from its own cache cannot be written a second time, so that it
            must not be found there: the name of a program counts.
        """
        jitted = self.jitted
        if alone:

            @functools.wraps(self.__wrapped__)
            def fresh(*args, **kwargs):
                return self.__wrapped__(*args, **kwargs)

            fresh.__name__ = f"{fresh.__name__}_{uuid.uuid4().hex[:8]}"
            jitted = jax.jit(fresh, **self._options)
        # One after the other, so that the first is compiled, for which Python is not needed, as the next is traced.
        with _TRACING:
            lowered = jitted.lower(*args, **kwargs)
            self._returned[key] = lowered.out_info
            if alone:
                _forget_source(lowered)
        return lowered


class KeptOnHost(Kept):
    """A `Kept` function that the host computes, beside a GPU too; inside of other transformations, as they have it.

    Beside a GPU JAX's own cache keeps it on disk: executables are of the first device.
    """

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        if jax.default_backend() == "cpu" or any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((args, kwargs))):
            return super().__call__(*args, **kwargs)
        with on_host():
            return super().__call__(*jax.device_get(args), **jax.device_get(kwargs))

    def begin(self, *args: Any, **kwargs: Any) -> Callable[[], None] | None:
        """See `Kept.begin`."""
        with on_host():
            return super().begin(*args, **kwargs)

    def is_ready(self, *args: Any, **kwargs: Any) -> bool:
        """See `Kept.is_ready`."""
        with on_host():
            return super().is_ready(*args, **kwargs)

    def _said(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> str | None:
        return super()._said(args, kwargs) if jax.default_backend() == "cpu" else None


def _compile(lowered: Any) -> Any:
    """Compile, on a CPU with `CPU_OPTIONS`, where XLA knows them and nobody else has a say."""
    if jax.devices()[0].platform == "cpu" and not os.environ.get("XLA_FLAGS"):
        try:
            return lowered.compile(compiler_options=CPU_OPTIONS)
        except Exception as error:
            # What an unknown option raises differs between versions.
            if not any(option in str(error) for option in CPU_OPTIONS):
                raise
    return lowered.compile()


def kept(*, static_argnames: Sequence[str] = (), on_host: bool = False) -> Callable[[Callable[..., Any]], Kept]:
    """A decorator in the place of `jax.jit` for what takes long to trace; see `Kept`, or on the host `KeptOnHost`."""
    return lambda function: (KeptOnHost if on_host else Kept)(function, static_argnames)


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
