"""Jitted functions that are compiled ahead of the first call, many in parallel, and kept on disk for later processes.

JAX's compilation cache must trace and lower a function before it can look it up, which for a planner takes longer than
everything else. Here the key of an entry is what the function would be traced from: the package's source, versions and
machine, shapes and types of the arguments, and the static arguments.

Nothing is written to disk unless a program calls `keep_in` (`problem.cache.keep_compilations` does).
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
from mechsearch_jax.runtime.own_settings import in_own_settings

# Options with which XLA compiles twice as fast for a CPU, with the same results at the same speed; without them LLVM
# ends the process for some of our programs on some processors. Options unknown to the installed XLA are left out.
CPU_OPTIONS: dict[str, str | bool] = {"xla_cpu_use_fusion_emitters": False}
# Settings of JAX that change what a function is compiled to, as `XLA_FLAGS` does.
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
    """Where this process keeps executables, and JAX's trace state outside of any trace.

    Where this module is first imported inside a trace, calls go to `jax.jit` until `keep_in` is called.
    """

    def __init__(self) -> None:
        self.executables: Executables | None = None
        self.untraced: Any = get_opaque_trace_state()


_KEEPING = _Keeping()
_TRACING = threading.RLock()


def keep_in(folder: Path | None) -> None:
    """Keep the executables of `cached_jit` functions in a folder from now on; with None keep nothing.

    Those that this process has loaded from the folder stay loaded: each takes hundreds of the memory maps of which an
    operating system allows a process some ten thousand.
    """
    if folder != kept_in():
        _KEEPING.executables = None if folder is None else Executables(folder)
    _KEEPING.untraced = get_opaque_trace_state()


def kept_in() -> Path | None:
    """The folder set with `keep_in`, if any."""
    return None if _KEEPING.executables is None else _KEEPING.executables.folder


class CachedJit:
    """A jitted function that can be compiled before it is called, and is looked up on disk before it is traced.

    A call uses the executable that `begin` or `prepare` made; where executables are kept on disk, the first call makes
    it. Otherwise, inside other transformations, and for arguments on another device than the first, the call goes to
    `jax.jit`. Arguments without an identity (`runtime.identity.identity`) are compiled anew in every process.
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
        function: a module's function, or any function if `on_disk` is False.
        static_argnames, donate_argnums: as in `jax.jit`.
        on_disk: whether it may be kept on disk; its result must depend on nothing but its arguments.
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
        # Executables, finished or in the making, by `_key`.
        self._loaded: dict[Hashable, Future[Any]] = {}
        # Shapes of the results of what was lowered in this process.
        self._returned: dict[Hashable, Any] = {}

    @in_own_settings
    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        executable = self._executable(args, kwargs)
        if executable is None:
            return self._jit()(*args, **kwargs)
        dynamic, named, _ = self._split(args, kwargs)
        return executable(*dynamic, **named)

    def _jit(self) -> Any:
        """The jitted function; outside of any trace on a CPU with `CPU_OPTIONS`, as `_compile` has it."""
        outside = get_opaque_trace_state() == _KEEPING.untraced
        if not outside or os.environ.get("XLA_FLAGS") or jax.default_backend() != "cpu" or not _knows_options():
            return self.jitted
        return self._with_options

    @functools.cached_property
    def _with_options(self) -> Any:
        return jax.jit(self.__wrapped__, **self._options, compiler_options=CPU_OPTIONS)

    def __getattr__(self, name: str) -> Any:
        """Other attributes of the jitted function, such as `lower`."""
        return getattr(self.jitted, name)

    @in_own_settings
    def begin(self, *args: Any, **kwargs: Any) -> Callable[[], None] | None:
        """Lower the function for these arguments, without calling it.

        Args:
          *args, **kwargs: of the call; arrays may be given as `jax.ShapeDtypeStruct`.

        Returns:
          A function that compiles the executable or reads it from disk. Call it once, in any thread. None if the
          executable exists already, or if such calls go to `jax.jit`.

        Raises:
          Exception: whatever tracing the function raises; a call raises it, too.
        """
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

    @in_own_settings
    def prepare(self, *args: Any, **kwargs: Any) -> None:
        """Load or compile the executable for these arguments, without calling it. May run in several threads."""
        finish = self.begin(*args, **kwargs)
        if finish is not None:
            finish()

    def returns(self, *args: Any, **kwargs: Any) -> Any:
        """The shapes of a call's result, so that a function that takes it can be prepared, too.

        If the executable is being read from disk, this waits for it.

        Raises:
          KeyError: `begin` was not called for such arguments, or failed.
        """
        key = self._key(args, kwargs)
        shapes = self._returned[key] if key in self._returned else self._loaded[key].result().out_info
        return jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape, a.dtype, weak_type=a.weak_type), shapes)

    @in_own_settings
    def is_ready(self, *args: Any, **kwargs: Any) -> bool:
        """Whether `prepare` with these arguments has nothing to compile; it may still have to read a file."""
        key = self._key(args, kwargs)
        if key is None or key in self._loaded:
            return True
        signature = self._signature(args, kwargs)
        executables = _KEEPING.executables
        return signature is not None and executables is not None and executables.has(self._name, signature)

    def _split(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> tuple[tuple[Any, ...], dict[str, Any], Any]:
        """The dynamic arguments, by position and by name, and the static ones."""
        is_static = [name in self._static for name in self._positions[: len(args)]]
        static = [(self._positions[i], args[i]) for i, fixed in enumerate(is_static) if fixed]
        static += [(name, kwargs[name]) for name in sorted(kwargs) if name in self._static]
        dynamic = tuple(arg for arg, fixed in zip(args, is_static, strict=True) if not fixed)
        return dynamic, {name: value for name, value in kwargs.items() if name not in self._static}, tuple(static)

    def _key(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Hashable | None:
        """What identifies a call in this process; None if it goes to `jax.jit`."""
        if get_opaque_trace_state() != _KEEPING.untraced or len(args) > len(self._positions):
            return None
        call = self._call_key(args, kwargs)
        if call is None or call[-1][-1] == "True":
            return None
        return (_KEEPING.executables, *call)

    def _call_key(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> tuple[Any, ...] | None:
        """What a call is compiled for: structure, shapes, static arguments, settings; None if a leaf is no array."""
        dynamic, named, static = self._split(args, kwargs)
        leaves, tree = jax.tree.flatten((dynamic, named))
        if not all(_plain(leaf) for leaf in leaves):
            return None
        settings = tuple(str(getattr(jax.config, name)) for name in SETTINGS)
        return tree, tuple(_shape(leaf) for leaf in leaves), static, settings

    def _signature(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> str | None:
        """What identifies a call on disk; None if its arguments have no identity, or nothing is kept."""
        if _KEEPING.executables is None or not self._on_disk:
            return None
        try:
            return identity(self._call_key(args, kwargs))
        except Unidentified:
            return None

    def _executable(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """The executable of a call; None if it goes to `jax.jit`."""
        if not self._loaded and _KEEPING.executables is None:
            return None
        key = self._key(args, kwargs)
        if key is None:
            return None
        if key not in self._loaded and _KEEPING.executables is not None:
            self.prepare(*args, **kwargs)
        compilation = self._loaded.get(key)
        # If compiling failed in another thread, `jax.jit` raises the error in this one.
        return None if compilation is None or compilation.exception() is not None else compilation.result()

    def _failed(self, key: Hashable, error: BaseException) -> None:
        self._loaded.pop(key).set_exception(error)

    def _compiling(self, key: Hashable, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Callable[[], Any]:
        """A function that returns the executable of a call; tracing and lowering are done before it is called."""
        signature, executables = self._signature(args, kwargs), _KEEPING.executables
        if signature is None or executables is None:
            return functools.partial(_compile, self._lowered(key, args, kwargs))

        def load() -> Any:
            dynamic, named, _ = self._split(args, kwargs)
            return executables.load(self._name, signature, jax.tree.structure((dynamic, named)))

        def compile_and_save(lowered: Any) -> Any:
            executable = _compile(lowered)
            executables.save(self._name, signature, executable)
            return executable

        if executables.has(self._name, signature):
            # A damaged entry is compiled again.
            return lambda: load() or compile_and_save(self._lowered(key, args, kwargs, alone=True))
        return functools.partial(compile_and_save, self._lowered(key, args, kwargs, alone=True))

    def _lowered(self, key: Hashable, args: tuple[Any, ...], kwargs: dict[str, Any], alone: bool = False) -> Any:
        """The function, lowered for the arguments of a call with this key.

        Args:
          alone: lower it under a new name. An executable that JAX read from its own cache cannot be serialised; with a
            new name it is not in that cache.
        """
        jitted = self.jitted
        if alone:

            @functools.wraps(self.__wrapped__)
            def fresh(*args, **kwargs):
                return self.__wrapped__(*args, **kwargs)

            fresh.__name__ = f"{fresh.__name__}_{uuid.uuid4().hex[:8]}"
            jitted = jax.jit(fresh, **self._options)
        # One at a time, so that the first one is compiled, outside of Python's lock, while the next one is traced.
        with _TRACING:
            lowered = jitted.lower(*args, **kwargs)
            self._returned[key] = lowered.out_info
            if alone:
                _forget_source(lowered)
        return lowered


class CachedJitOnHost(CachedJit):
    """A `CachedJit` function that runs on the host even if there is a GPU, except inside other transformations.

    If there is a GPU, JAX's own cache keeps it on disk, for `Executables` are of the first device.
    """

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        if jax.default_backend() == "cpu" or any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((args, kwargs))):
            return super().__call__(*args, **kwargs)
        with on_host():
            return super().__call__(*jax.device_get(args), **jax.device_get(kwargs))

    def begin(self, *args: Any, **kwargs: Any) -> Callable[[], None] | None:
        """See `CachedJit.begin`."""
        with on_host():
            return super().begin(*args, **kwargs)

    def is_ready(self, *args: Any, **kwargs: Any) -> bool:
        """See `CachedJit.is_ready`."""
        with on_host():
            return super().is_ready(*args, **kwargs)

    def _signature(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> str | None:
        return super()._signature(args, kwargs) if jax.default_backend() == "cpu" else None


@functools.cache
def _knows_options() -> bool:
    """Whether the installed XLA knows `CPU_OPTIONS`."""
    try:
        jax.jit(lambda: 0).lower().compile(compiler_options=CPU_OPTIONS)
    except Exception:
        return False
    return True


def _compile(lowered: Any) -> Any:
    """Compile; on a CPU with `CPU_OPTIONS` if XLA knows them and `XLA_FLAGS` is not set."""
    if jax.devices()[0].platform == "cpu" and not os.environ.get("XLA_FLAGS"):
        try:
            return lowered.compile(compiler_options=CPU_OPTIONS)
        except Exception as error:
            # The exception for an unknown option differs between versions.
            if not any(option in str(error) for option in CPU_OPTIONS):
                raise
    return lowered.compile()


def cached_jit(
    *, static_argnames: Sequence[str] = (), on_host: bool = False
) -> Callable[[Callable[..., Any]], CachedJit]:
    """A decorator in place of `jax.jit` for functions that take long to trace: `CachedJit`, or `CachedJitOnHost`."""
    return lambda function: (CachedJitOnHost if on_host else CachedJit)(function, static_argnames)


def _plain(leaf: Any) -> bool:
    """Whether a leaf is an array on the first device or a number."""
    if isinstance(leaf, Tracer):
        return False
    if isinstance(leaf, jax.Array):
        return leaf.devices() == {jax.devices()[0]}
    return isinstance(leaf, bool | int | float | np.ndarray | np.generic | jax.ShapeDtypeStruct)


def _shape(leaf: Any) -> tuple[Any, ...]:
    """What tracing uses of a leaf."""
    if isinstance(leaf, bool | int | float):
        return (type(leaf).__name__,)
    return (tuple(leaf.shape), str(leaf.dtype), bool(getattr(leaf, "weak_type", False)))


def _forget_source(lowered: Any) -> None:
    """Strip source locations from a lowered function, which makes its executable a third faster to read."""
    # JAX guarantees little about its intermediate representation.
    with contextlib.suppress(Exception):
        from jaxlib.mlir.passmanager import PassManager

        module = lowered.compiler_ir()
        with module.context:
            PassManager.parse("builtin.module(strip-debuginfo)").run(module.operation)
