"""What a device can do at most, measured: special functions, multiply-adds, and bytes to and from its memory.

Each is a function that does nothing else, with the number of operations in one call. On an NVIDIA GPU the arithmetic
runs in registers, in chains that do not wait for each other. Elsewhere XLA's own functions run over an array in a
cache: a processor has no special-function units, so that this tells how fast XLA's polynomials are.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from mechsearch_jax.benchmarks.parts.dense import kernel_available

# Operations in a row in the body of a kernel's loop: enough that the loop itself does not count.
CHAIN = 32


class Ceiling(NamedTuple):
    """Something that only one resource bounds.

    Attributes:
      function: of one array.
      argument: that array.
      amount: operations, or bytes, in one call.
    """

    function: Callable[[jax.Array], jax.Array]
    argument: jax.Array
    amount: int


def has_kernels() -> bool:
    """Whether kernels can be timed here: an NVIDIA GPU, and a version of JAX with Pallas for Triton."""
    device = jax.devices()[0]
    return device.platform == "gpu" and "NVIDIA" in device.device_kind.upper() and kernel_available()


def _in_registers(link: Callable[[jax.Array], jax.Array], links: int, loops: int, programs: int) -> Ceiling:
    """A chain in a kernel; each `link` does `links` operations. `programs` blocks of 128 threads, 4 chains each."""
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    block = 512

    def kernel(in_ref, out_ref):
        def body(_, x):
            for _ in range(CHAIN // links):
                x = link(x)
            return x

        out_ref[...] = jax.lax.fori_loop(0, loops, body, in_ref[...])

    spec = pl.BlockSpec((block,), lambda i: (i,))
    x = jnp.linspace(1.0, 2.0, programs * block, dtype=jnp.float32)
    function = pl.pallas_call(
        kernel,
        out_shape=jax.ShapeDtypeStruct(x.shape, x.dtype),
        grid=(programs,),
        in_specs=[spec],
        out_specs=spec,
        compiler_params=triton.CompilerParams(num_warps=4, num_stages=1),
    )
    return Ceiling(function, x, x.size * loops * CHAIN)


def _assembly(text: str, constraints: str) -> Callable[[jax.Array], jax.Array]:
    def link(x):
        from jax.experimental.pallas import triton

        shape = jax.ShapeDtypeStruct(x.shape, x.dtype)
        return triton.elementwise_inline_asm(
            text, args=[x], constraints=constraints, pack=1, result_shape_dtypes=[shape]
        )[0]

    return link


def _in_cache(link: Callable[[jax.Array], jax.Array], links: int, loops: int) -> Ceiling:
    """XLA's own code for one `link`, time and again over an array that stays in a core's cache.

    A longer chain would wait for itself: there are not enough registers for many at once.
    """
    x = jnp.linspace(1.0, 2.0, 1 << 13, dtype=jnp.float32)
    return Ceiling(lambda x: jax.lax.fori_loop(0, loops, lambda _, x: link(x), x), x, x.size * loops * links)


def special_functions() -> Ceiling:
    """Logarithms and powers of 2 in turn."""
    if has_kernels():
        # Opaque to the compiler, which must not see that one undoes the other.
        both = "{ .reg .f32 t; lg2.approx.ftz.f32 t, $1; ex2.approx.ftz.f32 $0, t; }"
        return _in_registers(_assembly(both, "=f,f"), 2, 512, 1 << 13)
    # Neither undoes the other, and neither runs away.
    return _in_cache(lambda x: jnp.exp(0.5 * jnp.log(x + 1.0)), 2, 2048)


def multiply_adds() -> Ceiling:
    """Fused multiply-adds."""
    if has_kernels():
        return _in_registers(_assembly("fma.rn.f32 $0, $1, 0f3F7FFFFF, 0f33800000;", "=f,f"), 1, 2048, 1 << 13)

    def several(x):
        for _ in range(8):
            x = x * 0.999 + 0.001
        return x

    return _in_cache(several, 8, 8192)


def memory() -> Ceiling:
    """Bytes read and written, of an array that no cache holds."""
    x = jnp.zeros(1 << 27 if jax.default_backend() == "gpu" else 1 << 25, jnp.float32)
    return Ceiling(lambda x: x + 1.0, x, 2 * x.nbytes)


CEILINGS: dict[str, tuple[str, Callable[[], Ceiling]]] = {
    "special functions": ("operations", special_functions),
    "multiply-adds": ("operations", multiply_adds),
    "memory": ("bytes", memory),
}
