"""The plane with most points, by random sample consensus, such as the shelf's floor in a real image."""

from __future__ import annotations

import functools
import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mechsearch_jax.runtime.pytree import PyTreeNode

UP = (0.0, 0.0, 1.0)
# Number of tried planes through three random points, and how often the best is then fitted to the points on it.
HYPOTHESES, FITS = 256, 3
# Largest distance from a plane of a point on it [m].
TOLERANCE = 0.004
# Largest angle between the plane's normal and the expected one [rad].
WITHIN = math.radians(10.0)


class Plane(PyTreeNode):
    """All x with `normal @ x = offset`.

    Attributes:
      normal: unit vector, on the side of the expected one, shape (3,).
      offset: of the plane from the origin along the normal [m].
      support: number of points on it, int32; 0 if there is none: then it has the expected normal and offset 0.
    """

    normal: jax.Array
    offset: jax.Array
    support: jax.Array

    def height(self, points: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Signed distance of points from the plane, positive on the side of the normal [m]."""
        return sum(points[..., k] * self.normal[k] for k in range(3)) - self.offset


def _fitted(plane: Plane, points: Array, valid: Array) -> Plane:
    """The least-squares plane of the points on a plane; its normal is the direction of their least spread."""
    on = (valid & (jnp.abs(plane.height(points)) <= TOLERANCE)).astype(points.dtype)
    count = jnp.sum(on)
    centre = jnp.sum(points * on[:, None], axis=0) / jnp.maximum(count, 1.0)
    offset = (points - centre[None]) * on[:, None]
    spread = jnp.matmul(offset.T, offset, precision=jax.lax.Precision.HIGHEST)
    _, axes = jnp.linalg.eigh(spread)
    normal = axes[:, 0] * jnp.where(jnp.sum(axes[:, 0] * plane.normal) < 0.0, -1.0, 1.0)
    better = Plane(normal, jnp.sum(normal * centre), jnp.int32(count))
    return jax.tree.map(lambda a, b: jnp.where(count >= 3.0, a, b), better, plane)


@functools.partial(jax.jit, static_argnames="expected")
def find_plane(
    key: Array,
    points: Float[Array, "p 3"],
    valid: Bool[Array, " p"],
    expected: tuple[float, float, float] = UP,
) -> Plane:
    """The plane with most points on it, of those with a normal near a direction.

    A fixed number of planes through three valid points each are compared by their support, and the best is fitted to
    the points that lie on it (M. Fischler and R. Bolles, "Random sample consensus", 1981).

    Args:
      key: PRNG key.
      points: in the world [m].
      valid: which points count.
      expected: unit vector near the normal; static.
    """
    points = jnp.where(valid[:, None], points, 0.0)
    direction = jnp.array(expected)
    rank = jnp.cumsum(valid)
    draws = jax.random.uniform(key, (HYPOTHESES, 3)) * rank[-1]
    triples = points[jnp.minimum(jnp.searchsorted(rank, jnp.floor(draws).astype(rank.dtype) + 1), len(points) - 1)]
    cross = jnp.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    square = jnp.sum(cross**2, axis=-1)
    flat = square > 1e-14
    normals = cross / jnp.sqrt(jnp.where(flat, square, 1.0))[:, None]
    along = jnp.sum(normals * direction[None], axis=-1)
    normals = normals * jnp.where(along < 0.0, -1.0, 1.0)[:, None]
    plausible = flat & (jnp.abs(along) >= math.cos(WITHIN))

    def hypothesis(normal, point):
        plane = Plane(normal, jnp.sum(normal * point), jnp.int32(0))
        return plane.replace(support=jnp.sum(valid & (jnp.abs(plane.height(points)) <= TOLERANCE)))

    planes = jax.lax.map(lambda pair: hypothesis(*pair), (normals, triples[:, 0]), batch_size=16)
    best = jnp.argmax(jnp.where(plausible, planes.support, -1))
    has_plane = plausible[best] & (planes.support[best] >= 3)
    nothing = Plane(direction, jnp.float32(0.0), jnp.int32(0))
    plane = jax.tree.map(lambda a, b: jnp.where(has_plane, a[best].astype(b.dtype), b), planes, nothing)
    for _ in range(FITS):
        fitted = _fitted(plane, points, valid)
        plane = jax.tree.map(lambda a, b: jnp.where(has_plane, a, b), fitted, plane)
    return plane
