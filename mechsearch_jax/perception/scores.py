"""Scores of recognised superquadrics: volumetric intersection over union with the true ones, and centre error."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mechsearch_jax.geometry import superquadric
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import rotate

# A superquadric with these exponents differs from a box or a cylinder by less than 1e-4 of its volume.
SHARP = 0.01
# Exponents up to this represent an edge, larger ones a round.
EDGE = 0.5
SAMPLES = 4096


def sharpened(superquadrics: Superquadrics) -> Superquadrics:
    """The boxes and cylinders that superquadrics with rounded edges represent.

    A perfect fit with the paper's exponents of 0.2 has an intersection over union of only 0.96 with the true box and
    0.97 with the true cylinder. Exponents up to 0.5 are replaced by 0.01, practically a sharp edge.
    """
    exponents = superquadrics.exponents
    return superquadrics.replace(exponents=jnp.where(exponents <= EDGE, SHARP, exponents))


def volume(size: Float[Array, "*batch 3"], exponents: Float[Array, "*batch 2"]) -> Float[Array, "*batch"]:
    """Volume of a superquadric [m3], in closed form: its box's times the shares of a p-ball in the plane and upright.

    Args:
      size: half-extents [m].
      exponents: (e1, e2), each in (0, 2].
    """

    def log_gamma(x):
        return jax.scipy.special.gammaln(1.0 + x)

    e1, e2 = exponents[..., 0], exponents[..., 1]
    plane = 2.0 * log_gamma(e2 / 2.0) - log_gamma(e2)
    upright = log_gamma(e1 / 2.0) + log_gamma(e1) - log_gamma(1.5 * e1)
    return 8.0 * jnp.prod(size, axis=-1) * jnp.exp(plane + upright)


@functools.cache
def _cube_points(count: int) -> np.ndarray:
    """Points spread evenly over the cube [-1, 1]^3: an additive recurrence with the powers of the root of x^4 = x + 1,
    which has a lower discrepancy than random points or a grid of the same size."""
    root = np.roots([1.0, 0.0, 0.0, -1.0, -1.0])
    ratio = float(np.max(root[np.isreal(root)].real))
    steps = np.arange(1, count + 1)[:, None] * ratio ** -np.arange(1.0, 4.0)
    return (2.0 * ((0.5 + steps) % 1.0) - 1.0).astype(np.float32)


def _intersection(a: Superquadrics, b: Superquadrics, count: int) -> Array:
    """Volume of a's box times the share of its points that are in both [m3]; fields have the same leading axes."""
    cube = jnp.asarray(_cube_points(count)).reshape(*[1] * (a.size.ndim - 1), count, 3)
    local = cube * a.size[..., None, :]
    in_a = superquadric.gauge(a.size[..., None, :], a.exponents[..., None, :], local) <= 1.0
    world = rotate(a.rotation[..., None, :, :], local) + a.position[..., None, :]
    other = rotate(jnp.swapaxes(b.rotation, -1, -2)[..., None, :, :], world - b.position[..., None, :])
    in_b = superquadric.gauge(b.size[..., None, :], b.exponents[..., None, :], other) <= 1.0
    return 8.0 * jnp.prod(a.size, axis=-1) * jnp.mean(in_a & in_b, axis=-1)


@functools.partial(jax.jit, static_argnames="count")
def intersection_over_union(a: Superquadrics, b: Superquadrics, count: int = SAMPLES) -> Float[Array, "*batch"]:
    """Volumetric intersection over union of every superquadric of `a` with the one in the same slot of `b`.

    The volumes are exact; the intersection is the mean of two quasi-Monte-Carlo integrals, over either one's box. With
    4096 points the error is at most 0.01 and 0.003 in the mean, for boxes as for cylinders (tested).

    Args:
      a, b: with the same leading axes (..., N); `sharpened` makes the true boxes and cylinders of them.
      count: number of points in either integral; static.

    Returns:
      between 0 and 1; 0 where either slot is empty.
    """
    shared = (_intersection(a, b, count) + _intersection(b, a, count)) / 2.0
    volumes = [volume(s.size, s.exponents) for s in (a, b)]
    shared = jnp.minimum(shared, jnp.minimum(*volumes))
    return jnp.where(a.valid & b.valid, shared / (sum(volumes) - shared), 0.0)


def centre_error(a: Superquadrics, b: Superquadrics) -> Float[Array, "*batch"]:
    """Distance between the centres of the superquadrics in the same slots of `a` and `b` [m]; infinite where either
    slot is empty."""
    error = jnp.linalg.norm(a.position - b.position, axis=-1)
    return jnp.where(a.valid & b.valid, error, jnp.inf)
