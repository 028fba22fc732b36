"""Round bodies that training alone shows: tapered ones and vessels that are open at the top, ray-cast exactly."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mechsearch_jax.runtime.pytree import PyTreeNode


class Form(PyTreeNode):
    """How bodies differ from their shapes, which they fill up to the largest radius; boxes do not differ.

    Attributes:
      lower, upper: radius at either end of a round body's axis, as a share of its radius.
      wall: thickness of the wall and the floor of a vessel that is open at its upper end [m]; 0 for a solid body.
    """

    lower: jax.Array
    upper: jax.Array
    wall: jax.Array


def cut_round(
    origin: list[Float[Array, "*#rays"]],
    direction: list[Float[Array, "*#rays"]],
    half_size: Float[Array, "3"],
    form: Form,
) -> Float[Array, "*rays"]:
    """Where rays from outside enter a round body, in its frame; infinite for misses. As `Primitive.cut`.

    Args:
      origin, direction: of the rays, by component.
      half_size: radius, radius and half the height [m].
      form: of the body, without leading axes.
    """
    square = sum((d * d for d in direction), jnp.zeros(()))
    # From the point nearest to the centre: the difference of large squares would lose digits.
    start = -sum((o * d for o, d in zip(origin, direction, strict=True)), jnp.zeros(())) / square
    x, y, z = (o + start * d for o, d in zip(origin, direction, strict=True))
    u, v, w = direction
    radius, half = half_size[0], half_size[2]
    middle, slope = radius * (form.upper + form.lower) / 2, radius * (form.upper - form.lower) / (2 * half)
    floor, hollow = form.wall - half, form.wall > 0

    def level(height):
        """Where rays cross a plane, and how far from the axis."""
        along = (height - z) / jnp.where(jnp.abs(w) < 1e-9, 1e-9, w)
        return along, jnp.sqrt((x + along * u) ** 2 + (y + along * v) ** 2)

    def side(thickness, bottom):
        """Both crossings of the cone so far within the outer one, above a height."""
        at, steep = middle - thickness + slope * z, slope * w
        a, b, c = u * u + v * v - steep * steep, x * u + y * v - at * steep, x * x + y * y - at * at
        a = jnp.where(jnp.abs(a) < 1e-9, 1e-9, a)
        root = jnp.sqrt(jnp.maximum(b * b - a * c, 0.0))
        for along in ((-b - root) / a, (-b + root) / a):
            height = z + along * w
            on_it = (b * b >= a * c) & (height >= bottom) & (height <= half) & (at + along * steep >= 0.0)
            yield along, on_it

    (below, from_axis), (above, off_axis) = level(-half), level(half)
    ground, inside = level(floor)
    crossings = [
        *side(0.0, -half),
        (below, from_axis <= radius * form.lower),
        (above, (off_axis <= radius * form.upper) & (~hollow | (off_axis >= radius * form.upper - form.wall))),
        *((along, hollow & on_it) for along, on_it in side(form.wall, floor)),
        (ground, hollow & (inside <= middle - form.wall + slope * floor)),
    ]
    nearest = jnp.full(square.shape, jnp.inf)
    for along, on_it in crossings:
        nearest = jnp.where(on_it & (start + along > 0.0), jnp.minimum(nearest, start + along), nearest)
    return nearest
