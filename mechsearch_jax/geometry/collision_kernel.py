"""Collision tests of point clouds with superquadrics on an NVIDIA GPU: one kernel for all pairs.

A program of the kernel has a few placed clouds. For each it tests the masked objects one after the other: first the
bounding boxes; if these overlap, points that cover the cloud evenly; and only if these are neither inside nor so far
outside that no other can be inside, those groups of its points whose boxes overlap the object's. The masked objects
and the colliding ones are the bits of a word for each placed cloud: few of the millions of clouds of a batch have a
masked pair, and skipping the others must cost little.

The gauge is computed with logarithms, where a power is a product and a p-norm of two numbers is

    log ||(a, b)||_p = max(log a, log b) + log(1 + exp(-p |log a - log b|)) / p,

so that nothing overflows, whatever the exponents and however far away a point. The base is 2, that of a GPU's
special-function units (`lg2.approx`, `ex2.approx`: 22 bits). The gauge is within a relative 1e-5 of the exact one,
without the rounding of a point's coordinates in an object's frame.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.extend
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int32

from mechsearch_jax.geometry.masked import on_cpu

Function = Callable[[Array], Array]

TINY = 1e-30
# Tolerance for rounding in comparisons of the gauge.
ROUNDING = 1e-4
# Points of a cloud in one step, a power of 2, and warps of 32 threads that share it: one, since every warp repeats what
# concerns the whole cloud.
POINTS, WARPS = 256, 1
# Largest number of placed clouds of a program, a power of 2, and the number of programs below which it is smaller. A
# GPU begins a program in about a nanosecond, and one with fewer placed clouds is done sooner.
PLACED, PROGRAMS = 64, 2**17
# Objects whose bits share a word.
BITS = 32


def log_gauge(point: Sequence[Array], powers: Sequence[Array] | Array, log: Function, exp: Function) -> Array:
    """Logarithm of the gauge.

    Args:
      point: x, y, z in half-extents.
      powers: p = 2/e2, r = 2/e1, 1/p and 1/r.
      log, exp: of any base.
    """
    a, b, c = (log(jnp.maximum(jnp.abs(q), TINY)) for q in point)
    p, r, over_p, over_r = powers
    plane = jnp.maximum(a, b) + log(1.0 + exp(-p * jnp.abs(a - b))) * over_p
    return jnp.maximum(plane, c) + log(1.0 + exp(-r * jnp.abs(plane - c))) * over_r


def special(name: str) -> Function:
    """The plain result of a special-function unit, without the corrections that XLA and Triton add."""
    from jax.experimental.pallas import triton

    def function(x: Array) -> Array:
        asm, shape = f"{name}.approx.ftz.f32 $0, $1;", jax.ShapeDtypeStruct(x.shape, x.dtype)
        return triton.elementwise_inline_asm(asm, args=[x], constraints="=f,f", pack=1, result_shape_dtypes=[shape])[0]

    return function


def kernel_available() -> bool:
    """Whether this version of JAX has Pallas's Triton backend, which JAX 0.11 announces to remove."""
    try:
        from jax.experimental.pallas import triton
    except ImportError:
        return False
    return hasattr(triton, "CompilerParams") and hasattr(triton, "elementwise_inline_asm")


def uses_kernel() -> bool:
    """Whether JAX is tracing for an NVIDIA GPU and the kernel is available."""
    if on_cpu() or jax.default_backend() != "gpu" or not kernel_available():
        return False
    return "rocm" not in jax.extend.backend.get_backend().platform_version.lower()


def _relative(o: Sequence[Array], T: Sequence[Sequence[Array]]) -> list[list[Array]]:
    """A cloud's pose in an object's frame, 3 x 4 numbers, from `T_object_world` and `T_world_cloud`."""
    rotated = [[jnp.asarray(sum(o[4 * row + k] * T[k][j] for k in range(3))) for j in range(4)] for row in range(3)]
    return [[*numbers[:3], numbers[3] + o[4 * row + 3]] for row, numbers in enumerate(rotated)]


def _boxes_overlap(relative: Sequence[Sequence[Array]], size: Sequence[Array], box: Sequence[Array]) -> Array:
    """Whether the bounding boxes of a cloud and an object overlap, along the axes of the cloud."""
    overlap = jnp.bool_(True)
    for k in range(3):
        reach = sum(jnp.abs(relative[row][k]) * size[row] for row in range(3))
        centre = -sum(relative[row][k] * relative[row][3] for row in range(3))
        overlap &= (centre - reach < box[3 + k]) & (centre + reach > box[k])
    return overlap


def collide(
    mask: Bool[Array, "*batch m n"],
    points: Array,
    boxes: Array,
    dense: Any,
    cloud: Array,
    T_world_cloud: Array,
    objects: Array,
    interpret: bool = False,
) -> Bool[Array, "*batch m n"]:
    """Which of the masked pairs collide.

    Args:
      mask: pairs of a placed cloud and an object.
      points: clouds as rows of coordinates in their own frames, shape (*batch, C, 3, P) [m].
      boxes: their least and largest coordinates, shape (*batch, C, 2, 3) [m].
      dense: `collision.Dense` of clouds of many points, or None.
      cloud: index of each placed cloud, shape (*batch, M).
      T_world_cloud: pose of each placed cloud, shape (*batch, M, 4, 4).
      objects: `T_object_world` (12 numbers), half-extents and exponents, shape (*batch, N, 17).
      interpret: run it as JAX operations on any device, slowly: for tests.

    An array that does not vary along a batch axis has a length of 1 there.
    """
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    batch, (m, n) = mask.shape[:-2], mask.shape[-2:]
    if 0 in mask.shape:
        return mask
    lead, count = len(batch), math.prod(batch)
    size = min(POINTS, pl.next_power_of_2(points.shape[-1]))
    placed = min(PLACED, pl.next_power_of_2(max(count * m // PROGRAMS, 1)))
    # Repeated points change no minimum.
    filled = lambda a: jnp.pad(a, [(0, 0)] * (a.ndim - 1) + [(0, -a.shape[-1] % size)], mode="edge")  # noqa: E731
    points = filled(points)
    wanted = _packed(mask.reshape(count, m, n), m + -m % placed)
    boxes = boxes.reshape(*boxes.shape[:-2], 6)
    extra = []
    if dense is not None:
        steps = dense.groups.reshape(*dense.groups.shape[:-3], points.shape[-1] // size, -1, 2, 3)
        steps = jnp.concatenate([jnp.min(steps[..., 0, :], axis=-2), jnp.max(steps[..., 1, :], axis=-2)], axis=-1)
        extra = [filled(dense.coarse), dense.gap, steps]
    T = T_world_cloud.reshape(*T_world_cloud.shape[:-2], 16)
    arrays = [points, boxes, cloud, T, objects, *extra]
    settings = _Settings(
        batch=batch,
        shapes=tuple(a.shape[:lead] for a in arrays),
        placed=placed,
        size=size,
        log2=jnp.log2 if interpret else special("lg2"),
        exp2=jnp.exp2 if interpret else special("ex2"),
        sqrt=jnp.sqrt if interpret else special("sqrt"),
    )
    hits = pl.pallas_call(
        functools.partial(_kernel, settings),
        out_shape=jax.ShapeDtypeStruct(wanted.shape, jnp.int32),
        grid=(wanted.shape[-1] // placed, count, wanted.shape[1]),
        compiler_params=triton.CompilerParams(num_warps=WARPS, num_stages=1),
        interpret=interpret,
    )(wanted, *(a.reshape(-1, *a.shape[lead:]) for a in arrays))
    return _unpacked(hits, m, n).reshape(mask.shape)


def _packed(mask: Bool[Array, "b m n"], rows: int) -> Int32[Array, "b words {rows}"]:
    """Rows of bits as words of at most `BITS` each, padded with zeros to `rows` rows."""
    parts = jnp.split(mask, list(range(BITS, mask.shape[-1], BITS)), axis=-1)
    words = [jnp.sum(jnp.where(bits, _bit_values(bits), 0), axis=-1, dtype=jnp.int32) for bits in parts]
    return jnp.pad(jnp.stack(words, axis=1), ((0, 0), (0, 0), (0, rows - mask.shape[1])))


def _unpacked(words: Int32[Array, "b words rows"], m: int, n: int) -> Bool[Array, "b {m} {n}"]:
    """The inverse of `_packed`."""
    parts = np.split(np.arange(n), list(range(BITS, n, BITS)))
    bits = [words[:, k, :m, None] & _bit_values(part[None, None]) != 0 for k, part in enumerate(parts)]
    return jnp.concatenate(bits, axis=-1)


def _bit_values(bits: Array | np.ndarray) -> Int32[np.ndarray, "1 1 n"]:
    """The values of a word's bits."""
    return (np.uint32(1) << np.arange(bits.shape[-1], dtype=np.uint32)).view(np.int32)[None, None]


class _Settings(NamedTuple):
    """The static settings of the kernel.

    Attributes:
      batch: sizes of the batch axes.
      shapes: the same of each array, 1 where it does not vary along an axis.
      placed: number of placed clouds of a program.
      size: points in one step.
      log2, exp2, sqrt: the last two bits of their results may be wrong.
    """

    batch: tuple[int, ...]
    shapes: tuple[tuple[int, ...], ...]
    placed: int
    size: int
    log2: Function
    exp2: Function
    sqrt: Function

    def rows(self, element: Array) -> list[Any]:
        """The row of each array that belongs to an element of the batch."""
        rows = []
        for shape in self.shapes:
            row: Any = 0
            for k, length in enumerate(shape):
                if length > 1:
                    row = row + element // math.prod(self.batch[k + 1 :]) % length * math.prod(shape[k + 1 :])
            rows.append(row)
        return rows


def _kernel(settings: _Settings, wanted, points, boxes, cloud, T_world_cloud, objects, *refs) -> None:
    """One program: tests a few placed clouds of an element of the batch with the objects of a word. Arrays are refs."""
    from jax.experimental import pallas as pl

    *dense, out = refs
    b, w, first = pl.program_id(1), pl.program_id(2), pl.program_id(0) * settings.placed
    in_points, in_boxes, in_cloud, in_T, in_objects, *in_dense = settings.rows(b)
    rows = pl.ds(first, settings.placed)
    out[b, w, rows] = jnp.zeros(settings.placed, jnp.int32)

    def at_cloud(k, _):
        i = first + k
        word = wanted[b, w, i]

        @pl.when(word != 0)
        def _():
            c = cloud[in_cloud, i]
            T = [[T_world_cloud[in_T, i, 4 * row + column] for column in range(4)] for row in range(3)]
            box = [boxes[in_boxes, c, k] for k in range(6)]
            of_cloud = _Cloud(points, in_points, c, *zip(dense, in_dense, strict=True))

            def at_object(rest):
                rest, hits = rest
                lowest = rest & -rest
                # The number of the only bit that is set, from the exponent of its float.
                value = jnp.abs(lowest.astype(jnp.float32))
                bit = jax.lax.shift_right_logical(jax.lax.bitcast_convert_type(value, jnp.int32), 23) - 127
                return rest ^ lowest, at_boxes(bit, hits)

            def at_boxes(bit, hits):
                numbers = [objects[in_objects, w * BITS + bit, k] for k in range(17)]
                relative = _relative(numbers, T)

                def at_points(hits):
                    hit = _inside(settings, of_cloud, relative, numbers[12:])
                    return hits | jax.lax.shift_left(hit.astype(jnp.int32), bit)

                return jax.lax.cond(_boxes_overlap(relative, numbers[12:15], box), at_points, lambda hits: hits, hits)

            out[b, w, i] = jax.lax.while_loop(lambda rest: rest[0] != 0, at_object, (word, jnp.int32(0)))[1]

        return 0

    @pl.when(jnp.max(jnp.abs(wanted[b, w, rows])) > 0)
    def _():
        jax.lax.fori_loop(0, settings.placed, at_cloud, 0)


class _Cloud(NamedTuple):
    """A cloud of the kernel's arrays, which are refs.

    Attributes:
      points, row, number: its points are `points[row, number]`.
      coarse, gap, steps: of `Dense`, each with its row: points that cover the cloud, their gap, and boxes around its
        points of each step; None for a cloud of few points.
    """

    points: Any
    row: Any
    number: Any
    coarse: tuple[Any, Any] | None = None
    gap: tuple[Any, Any] | None = None
    steps: tuple[Any, Any] | None = None


def _inside(settings: _Settings, cloud: _Cloud, relative: Sequence[Sequence[Array]], shape: Sequence[Array]) -> Array:
    """Whether a point of a cloud is inside an object, given by half-extents and exponents."""
    from jax.experimental import pallas as pl

    rows = [[number / shape[k] for number in relative[k]] for k in range(3)]
    powers = [2.0 / shape[4], 2.0 / shape[3], 0.5 * shape[4], 0.5 * shape[3]]
    roots = [jnp.exp2(0.5 * shape[4]), jnp.exp2(0.5 * shape[3])]
    size, c = settings.size, cloud.number

    def scaled(points, row, k):
        x, y, z = (points[row, c, axis, pl.ds(k * size, size)] for axis in range(3))
        return [jnp.abs(r[0] * x + (r[1] * y + (r[2] * z + r[3]))) for r in rows]

    def bounds(point):
        """Bounds on the least gauge without logarithms; see `collision._bounds`."""
        x, y, z = point
        p = jnp.broadcast_to(powers[0], x.shape)
        most, two = jnp.maximum(x, y), settings.sqrt(x * x + y * y)
        below = jnp.where(p > 2.0, most, two)
        above = jnp.where(p >= 2.0, jnp.minimum(two, roots[0] * most), x + y)
        return jnp.min(jnp.maximum(below, z)), jnp.min(jnp.maximum(above, z)) * roots[1]

    def hit_by(point):
        return (jnp.min(log_gauge(point, powers, settings.log2, settings.exp2)) < 0.0).astype(jnp.int32)

    def in_step(k):
        point = scaled(cloud.points, cloud.row, k)
        least, most = bounds(point)
        surely = (most < 1.0).astype(jnp.int32)
        return jax.lax.cond((least < 1.0) & (surely == 0), lambda _: hit_by(point), lambda hit: hit, surely)

    def in_steps(_):
        def step(k, hit):
            near = hit == 0
            if cloud.steps is not None:
                boxes, row = cloud.steps
                near &= _boxes_overlap(relative, shape[:3], [boxes[row, c, k, i] for i in range(6)])
            return jax.lax.cond(near, lambda _: in_step(k), lambda hit: hit, hit)

        return jax.lax.fori_loop(0, cloud.points.shape[-1] // size, step, jnp.int32(0))

    if cloud.coarse is None or cloud.gap is None:
        return in_steps(0) > 0
    (coarse, row), (gaps, gap_row) = cloud.coarse, cloud.gap
    least, most = bounds(scaled(coarse, row, 0))
    for k in range(1, coarse.shape[-1] // size):
        more = bounds(scaled(coarse, row, k))
        least, most = jnp.minimum(least, more[0]), jnp.minimum(most, more[1])
    gap = gaps[gap_row, c]
    # The gauge is a norm, at most the length over the least half-extent, or twice that below 2-norms.
    reach = jnp.where(jnp.maximum(shape[3], shape[4]) > 1.0, 2.0 * gap, gap)
    beyond = reach / jnp.minimum(jnp.minimum(shape[0], shape[1]), shape[2])
    inside = most < 1.0
    settled = inside | (least > 1.0 + ROUNDING + beyond)
    return jax.lax.cond(settled, lambda hit: hit, in_steps, inside.astype(jnp.int32)) > 0
