"""Superquadrics: the shape class that the planner sees objects as (paper section 4.1).

A superquadric is written here as two nested p-norms. With `p = 2/e2` in the plane and `r = 2/e1` along the axis,

    gauge(x) = ( ||(x1/a1, x2/a2)||_p ^ r  +  |x3/a3| ^ r ) ^ (1/r),

so that the paper's `S` of equation 5 is `gauge ** (2/e1)`. The gauge is homogeneous of degree one and, for exponents up
to 2, convex; neither overflows in float32 however far away the point is, and both gradients are finite everywhere.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mechsearch_jax.geometry.masked import on_cpu
from mechsearch_jax.geometry.transforms import align, inverse, make, transform
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.own_settings import in_own_settings
from mechsearch_jax.runtime.pytree import PyTreeNode

# Exponent of the sharpest edges that the paper plans with.
EDGE_EXPONENT = 0.2
# An exponent e2 above it counts as round.
ROUND_EXPONENT = 0.6
# Largest ratio of the half-extents of a rhombus that counts as a square.
SQUARE = 1.2


class Superquadrics(PyTreeNode):
    """N superquadrics, of which any may be absent; every field has the leading axes `(..., N)`.

    With `parts` they are N rigid bodies, each the union of its parts; `bodies` has the functions for both cases.

    Attributes:
      size: half-extents along the object's axes [m], shape (..., N, 3).
      exponents: (e1, e2), shape (..., N, 2); (0.2, 0.2) is a box, (0.2, 1.0) a cylinder.
      position: `t_world_object` [m], shape (..., N, 3).
      rotation: `R_world_object`, shape (..., N, 3, 3).
      valid: whether the slot holds an object, shape (..., N).
      parts: the parts of each body, in its frame, fields (..., N, P, ...); its other fields are then those of the
        superquadric that bounds them. None if every body is a single superquadric.
    """

    size: jax.Array
    exponents: jax.Array
    position: jax.Array
    rotation: jax.Array
    valid: jax.Array
    parts: Superquadrics | None = None

    @property
    def capacity(self) -> int:
        return self.size.shape[-2]


def empty(capacity: int, parts: int | None = None) -> Superquadrics:
    """`capacity` absent superquadrics: millimetre spheres at the origin, masked out; with room for `parts` each."""
    absent = Superquadrics(
        size=jnp.full((capacity, 3), 1e-3, jnp.float32),
        exponents=jnp.ones((capacity, 2)),
        position=jnp.zeros((capacity, 3)),
        rotation=jnp.broadcast_to(jnp.eye(3), (capacity, 3, 3)),
        valid=jnp.zeros(capacity, bool),
    )
    if parts is None:
        return absent
    return absent.replace(parts=jax.tree.map(lambda a: jnp.stack([a] * parts, axis=1), absent))


@in_own_settings
def pad(superquadrics: Superquadrics, capacity: int) -> Superquadrics:
    """The same superquadrics in `capacity` slots.

    Raises:
      InputError: there are more objects than slots.
    """
    missing = capacity - superquadrics.capacity
    if missing < 0:
        raise InputError(f"{superquadrics.capacity} objects do not fit a capacity of {capacity}; raise the capacity")
    parts = None if superquadrics.parts is None else superquadrics.parts.capacity
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b[:missing]]), superquadrics, empty(capacity, parts))


def standard_edges(superquadrics: Superquadrics) -> Superquadrics:
    """The same superquadrics with edges no sharper than `EDGE_EXPONENT`.

    The best fit to an image has nearly the sharp edges of a real box. It hides more and is hit more than the rounded
    box of the same size in plans, so that f and g would depend on how an object was recognised.
    """
    parts = None if superquadrics.parts is None else standard_edges(superquadrics.parts)
    return superquadrics.replace(exponents=jnp.maximum(superquadrics.exponents, EDGE_EXPONENT), parts=parts)


def as_boxes(superquadrics: Superquadrics) -> Superquadrics:
    """The same superquadrics, with boxes that are described as turned by an eighth described as boxes.

    An exponent e2 near 2 makes a square whose corners are on the axes: a box of exponent 2 - e2 that is turned by 45
    degrees about its third axis. Fits return either, as in W. Liu et al., "Robust and accurate superquadric recovery: a
    probabilistic approach", CVPR 2022. The radii along the axes and between them stay the same. All others, and rhombi
    that are no squares, are returned to the bit. Of bodies of several parts, these are described anew.
    """
    if superquadrics.parts is not None:
        return superquadrics.replace(parts=as_boxes(superquadrics.parts))
    size, exponents, R = superquadrics.size, superquadrics.exponents, superquadrics.rotation
    x, y, e2 = size[..., 0], size[..., 1], exponents[..., 1]
    turned = (e2 > 2.0 - ROUND_EXPONENT) & (jnp.maximum(x, y) <= SQUARE * jnp.minimum(x, y))
    half = 0.5 * (x + y) * jnp.exp2(0.5 * (1.0 - e2))
    box = jnp.stack([half, half, size[..., 2]], axis=-1)
    first, second, third = R[..., 0], R[..., 1], R[..., 2]
    columns = jnp.stack([(first + second) * 0.5**0.5, (second - first) * 0.5**0.5, third], axis=-1)
    # No sharper than what has such an exponent by itself.
    mirrored = jnp.stack([exponents[..., 0], jnp.maximum(2.0 - e2, EDGE_EXPONENT)], axis=-1)
    return superquadrics.replace(
        size=jnp.where(turned[..., None], box, size),
        exponents=jnp.where(turned[..., None], mirrored, exponents),
        rotation=jnp.where(turned[..., None, None], columns, R),
    )


def _power(base: Array, exponent: Array) -> Array:
    """`base ** exponent` for `base >= 0`, with a zero gradient instead of NaN where `base` is 0."""
    positive = base > 0
    return jnp.where(positive, jnp.exp(exponent * jnp.log(jnp.where(positive, base, 1.0))), 0.0)


def _norm2(a: Array, b: Array, p: Array) -> Array:
    """`(a**p + b**p) ** (1/p)` for `a, b >= 0`, without overflow and with finite gradients, also at the origin."""
    big, small = jnp.maximum(a, b), jnp.minimum(a, b)
    ratio = small / jnp.where(big > 0, big, 1.0)
    ratio, p = _backwards(ratio), _backwards(p)
    return big * _backwards(jnp.exp(jnp.log1p(_power(ratio, p)) / p))


def _backwards(a: Array) -> Array:
    """On a CPU the array with the order of its last axis turned round, elsewhere the same.

    XLA lets the result of an elementwise function take the place of an argument, and on a CPU it does not vectorise
    that (findings/xla-cpu-elementwise-in-place.sh); what is turned round and back is no elementwise function.
    """
    return jnp.flip(a, -1) if a.ndim and on_cpu() else a


def gauge(
    size: Float[Array, "... 3"], exponents: Float[Array, "... 2"], points: Float[Array, "... 3"]
) -> Float[Array, "..."]:
    """The factor by which a superquadric must be scaled about its centre for its surface to pass through a point.

    Args:
      size: half-extents [m].
      exponents: (e1, e2), each in (0, 2].
      points: in the object's own frame [m].

    Returns:
      0 at the centre, 1 on the surface, more outside; broadcast over the leading axes.
    """
    size, exponents, points = align((size, 1), (exponents, 1), (points, 1))
    return unit_gauge(jnp.moveaxis(jnp.abs(points / size), -1, 0), jnp.moveaxis(exponents, -1, 0))


def unit_gauge(
    scaled: Float[Array, "3 ..."] | Sequence[Array], exponents: Float[Array, "2 ..."]
) -> Float[Array, "..."]:
    """`gauge` of points given as magnitudes in half-extents; coordinates, and (e1, e2), are along the first axis."""
    x, y, z = scaled
    e1, e2 = exponents
    return _norm2(_norm2(x, y, 2.0 / e2), z, 2.0 / e1)


def radial_distance(
    size: Float[Array, "... 3"], exponents: Float[Array, "... 2"], points: Float[Array, "... 3"]
) -> Float[Array, "..."]:
    """Distance from a point to the surface along the ray from the centre (equation 6) [m]. Arguments as in `gauge`.

    At the centre it is the smallest half-extent.
    """
    size, exponents, points = align((size, 1), (exponents, 1), (points, 1))
    scale = gauge(size, exponents, points)
    square = jnp.sum(points**2, axis=-1)
    centre = (square <= 0) | (scale <= 0)
    norm = jnp.sqrt(jnp.where(centre, 1.0, square))
    distance = norm * jnp.abs(1.0 - 1.0 / jnp.where(centre, 1.0, scale))
    return jnp.where(centre, jnp.broadcast_to(jnp.min(size, axis=-1), distance.shape), distance)


def to_object_frame(superquadrics: Superquadrics, points: Float[Array, "... 3"]) -> Float[Array, "... n 3"]:
    """World points in the frame of every superquadric [m]."""
    return transform(inverse(make(superquadrics.rotation, superquadrics.position)), points[..., None, :])


def bounding_radius(size: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
    """Radius of a sphere about the centre that contains a superquadric of any exponents up to 2 [m]."""
    return jnp.sqrt(jnp.sum(size**2, axis=-1))


def support(
    size: Float[Array, "... 3"], exponents: Float[Array, "... 2"], directions: Float[Array, "... 3"]
) -> Float[Array, "..."]:
    """How far a superquadric reaches from its centre along vectors in its own frame, in their lengths [m].

    The support function of the gauge's unit ball is the dual norm: nested norms with the conjugate powers.
    """
    size, exponents, directions = align((size, 1), (exponents, 1), (directions, 1))
    x, y, z = jnp.moveaxis(jnp.abs(size * directions), -1, 0)
    # Of octahedra, whose conjugate power is infinite, up to a fraction of a per cent.
    r, p = jnp.moveaxis(1.0 / (1.0 - jnp.minimum(exponents, 1.99) / 2.0), -1, 0)
    return _norm2(_norm2(x, y, p), z, r)


def surface_directions(count: int) -> Float[np.ndarray, "count 3"]:
    """`count` unit vectors spread evenly over the sphere (Fibonacci lattice)."""
    k = np.arange(count) + 0.5
    z = 1.0 - 2.0 * k / count
    azimuth = np.pi * (1.0 + 5.0**0.5) * k
    radius = np.sqrt(1.0 - z**2)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=-1).astype(np.float32)


def sample_surface(
    size: Float[Array, "*batch 3"], exponents: Float[Array, "*batch 2"], count: int
) -> Float[Array, "*batch count 3"]:
    """Points on the surface of a superquadric, in its own frame [m].

    Directions spread evenly over the sphere are warped towards the box's faces by the half-extents and projected
    radially: deterministic, on the surface to rounding, dense enough for collision tests but not uniform in area.
    """
    direction = jnp.asarray(surface_directions(count))
    cube = direction / jnp.max(jnp.abs(direction), axis=-1, keepdims=True)
    cube = cube.reshape(*[1] * (size.ndim - 1), count, 3)
    points = cube * size[..., None, :]
    return points / gauge(size[..., None, :], exponents[..., None, :], points)[..., None]


def towards(
    size: Float[Array, "*batch 3"], exponents: Float[Array, "*batch 2"], directions: Float[Array, "*batch 3"]
) -> Float[Array, "*batch 3"]:
    """The point of `sample_surface` on each superquadric for one direction of its own, in its frame [m]."""
    points = directions / jnp.max(jnp.abs(directions), axis=-1, keepdims=True) * size
    return points / gauge(size, exponents, points)[..., None]
