"""Every point of a cloud against every superquadric: the inner reduction, without looking for what can be left out.

`geometry.collision` is what the planner uses: it looks at boxes first, and only says whether a cloud collides. This is
for where the gauge itself is wanted, and for measuring how fast its formula can be. There are two versions of it behind
one function: one that XLA compiles, for every device, and a Pallas kernel for NVIDIA GPUs. `benchmarks/roofline.md`
shows how fast they are.

The formula is `geometry.collision_kernel.log_gauge`, which works with logarithms. An evaluation takes 5 of them and 2
powers, 7 operations of a GPU's special-function units, which do 16 per clock and multiprocessor.

What is exact and what is not: gauges below `collision_kernel.TINY` read as about that. Otherwise the formula is the
gauge's, and both versions are within a relative 1e-5 of it in float64, beside the rounding of a point's coordinates in
an object's frame (1e-6 for a cloud within 10 half-extents of it, more in proportion to the distance). The kernel takes
logarithms and powers from the special-function units as they are, the other version has them rounded like every other
function of JAX. Values only: the kernel has no gradient.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.geometry.collision_kernel import kernel_available, log_gauge, special
from mechsearch_jax.geometry.masked import block_size
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import compose, inverse, make
from mechsearch_jax.runtime.errors import InputError

Method = Literal["auto", "xla", "kernel"]

# Logarithms, or powers of 2, that one point and one superquadric take.
OPERATIONS = 7
# Evaluations that XLA is given at once on a CPU, in case that it keeps them all.
BLOCK = 1 << 21


class Tiling(NamedTuple):
    """How the kernel divides its work.

    Attributes:
      points: of a cloud in one step; a power of 2.
      objects: that share what was read of a cloud.
      warps: that share a step, of 32 threads.
    """

    points: int = 256
    objects: int = 4
    warps: int = 2


TILING = Tiling()


def _numbers(scene: Superquadrics, T_world_cloud: Array) -> Array:
    """What the formula needs of a placed cloud and an object, shape (M, N, 16).

    Three rows that take a point to half-extents of the object, and p, r, 1/p, 1/r.
    """
    T = compose(inverse(make(scene.rotation, scene.position))[None], T_world_cloud[:, None])
    rows = T[..., :3, :] / scene.size[None, :, :, None]
    powers = jnp.stack([2.0 / scene.exponents[:, 1], 2.0 / scene.exponents[:, 0]], axis=-1)
    powers = jnp.broadcast_to(jnp.concatenate([powers, 1.0 / powers], axis=-1), (*rows.shape[:2], 4))
    return jnp.concatenate([rows.reshape(*rows.shape[:2], 12), powers], axis=-1)


def _place(numbers: Any, x: Array, y: Array, z: Array) -> list[Array]:
    """Points in half-extents of an object; see `_numbers`."""
    return [numbers[k] * x + (numbers[k + 1] * y + (numbers[k + 2] * z + numbers[k + 3])) for k in (0, 4, 8)]


def _least_xla(clouds: Array, cloud: Array, numbers: Array) -> Array:
    """Least gauges, shape (M, N), in natural logarithms: XLA makes those of base 2 from them."""

    def one(index, numbers):
        x, y, z = clouds[index]
        evaluate = lambda n: jnp.min(log_gauge(_place(n, x, y, z), n[12:], jnp.log, jnp.exp))  # noqa: E731
        return jax.vmap(evaluate)(numbers)

    at_once = max(block_size(BLOCK) // (clouds.shape[2] * numbers.shape[1]), 1)
    return jnp.exp(jax.lax.map(lambda args: one(*args), (cloud, numbers), batch_size=min(at_once, cloud.shape[0])))


def least_kernel(
    clouds: Float[Array, "c 3 p"],
    cloud: Int[Array, " m"],
    numbers: Float[Array, "m n 16"],
    tiling: Tiling = TILING,
    interpret: bool = False,
    formula: Callable[..., Array] = log_gauge,
) -> Float[Array, "m n"]:
    """Least gauges by the kernel; nothing may be empty.

    Args:
      clouds, cloud: as in `least_gauges`.
      numbers: of each placed cloud and object; see `_numbers`.
      tiling: changes the speed, never a result.
      interpret: run it as JAX operations on any device, slowly: for tests.
      formula: with the arguments of `log_gauge`.
    """
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    placed, n = numbers.shape[:2]
    points = min(tiling.points, pl.next_power_of_2(clouds.shape[2]))
    objects = min(tiling.objects, n)
    # A point, or an object, that is there twice changes no minimum.
    clouds = jnp.pad(clouds, ((0, 0), (0, 0), (0, -clouds.shape[2] % points)), mode="edge")
    numbers = jnp.pad(numbers, ((0, 0), (0, -n % objects), (0, 0)), mode="edge")
    steps, groups = clouds.shape[2] // points, numbers.shape[1] // objects
    log2, exp2 = (jnp.log2, jnp.exp2) if interpret else (special("lg2"), special("ex2"))

    def kernel(clouds_ref, cloud_ref, numbers_ref, out_ref):
        m, first = pl.program_id(1), pl.program_id(0) * objects
        index = cloud_ref[m]
        ours = [[numbers_ref[m, first + k, j] for j in range(16)] for k in range(objects)]

        def step(i, least):
            x, y, z = (clouds_ref[index, k, pl.ds(i * points, points)] for k in range(3))
            values = (formula(_place(n, x, y, z), n[12:], log2, exp2) for n in ours)
            return tuple(jnp.minimum(a, b) for a, b in zip(least, values, strict=True))

        # The minimum over the threads is taken once, after all points.
        least = jax.lax.fori_loop(0, steps, step, (jnp.full(points, jnp.inf, jnp.float32),) * objects)
        for k in range(objects):
            out_ref[m, first + k] = jnp.min(least[k])

    out = pl.pallas_call(
        kernel,
        out_shape=jax.ShapeDtypeStruct((placed, groups * objects), jnp.float32),
        # The groups of a placed cloud run side by side, so that they find its points in the cache.
        grid=(groups, placed),
        compiler_params=triton.CompilerParams(num_warps=tiling.warps, num_stages=1),
        interpret=interpret,
    )(clouds, cloud.astype(jnp.int32), numbers)
    return jnp.exp2(out[:, :n])


@functools.partial(jax.jit, static_argnames="method")
def least_gauges(
    scene: Superquadrics,
    clouds: Float[Array, "c 3 p"],
    cloud: Int[Array, " m"],
    T_world_cloud: Float[Array, "m 4 4"],
    method: Method = "auto",
) -> Float[Array, "m n"]:
    """The least gauge of all points of placed clouds, for each of the scene's objects.

    Args:
      scene: the objects, fields (N, ...).
      clouds: as rows of coordinates in their own frames, shape (C, 3, P) [m].
      cloud: which of them each placed cloud is, shape (M,).
      T_world_cloud: where it is, shape (M, 4, 4).
      method: "xla" and "kernel" (NVIDIA GPUs only) differ in speed and rounding; "auto" takes the kernel where there
        is one.

    Returns:
      Below 1 where a point is inside, shape (M, N); infinity for an absent object, or a cloud without points.

    Raises:
      InputError: the kernel is asked for, but this version of JAX cannot have it.
    """
    m, n = cloud.shape[0], scene.capacity
    if method == "kernel" and not kernel_available():
        raise InputError("least_gauges: this version of JAX has no Pallas for Triton; use the method 'xla'")
    if 0 in (m, n, clouds.shape[0], clouds.shape[2]):
        return jnp.full((m, n), jnp.inf, jnp.float32)
    numbers = _numbers(scene, T_world_cloud)
    if method == "kernel":
        least = least_kernel(clouds, cloud, numbers)
    elif method == "xla" or not kernel_available():
        least = _least_xla(clouds, cloud, numbers)
    else:
        least = jax.lax.platform_dependent(clouds, cloud, numbers, cuda=least_kernel, default=_least_xla)
    return jnp.where(scene.valid[None], least, jnp.inf)


def any_inside(
    scene: Superquadrics,
    clouds: Float[Array, "c 3 p"],
    cloud: Int[Array, " m"],
    T_world_cloud: Float[Array, "m 4 4"],
    method: Method = "auto",
) -> Bool[Array, "m n"]:
    """Whether any point of a placed cloud is inside an object; never inside an absent one. See `least_gauges`."""
    return least_gauges(scene, clouds, cloud, T_world_cloud, method) < 1.0
