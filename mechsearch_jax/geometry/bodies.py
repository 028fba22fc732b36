"""Rigid bodies of several superquadrics.

Bodies are `Superquadrics` with `parts`, which lie in the body's frame: a body that moves changes its own pose and
nothing else. It is hit and seen where any of its parts is. Its own superquadric bounds all parts and stands for it
where only its place and its extent count.

Whatever reads shapes does so through these functions. For scenes without parts, where every body is one superquadric,
they return what they are given.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped

from mechsearch_jax.geometry import superquadric
from mechsearch_jax.geometry.superquadric import EDGE_EXPONENT, Superquadrics
from mechsearch_jax.geometry.transforms import matmul, rotate

# Largest number of parts of a body.
PARTS = 4
# Points on a body that decide how round the superquadric is that bounds a body, and the largest gauge of a point
# that counts as bounded. A rim is rounded in proportion to a cylinder's height: shorter ones' stick out a little.
BOUNDED_POINTS, BOUNDED, RIM = 512, 1.01, 1.08
# Largest ratio of the first two half-extents of a body of several parts that counts as round.
ROUND = 1.05


def placed_parts(scene: Superquadrics) -> Superquadrics:
    """The parts of bodies in the world, fields (..., P, ...); the bodies must have parts. Parts of absent bodies are
    absent."""
    parts = scene.parts
    assert parts is not None
    turn = scene.rotation[..., None, :, :]
    return parts.replace(
        position=rotate(turn, parts.position) + scene.position[..., None, :],
        rotation=matmul(turn, parts.rotation),
        valid=parts.valid & scene.valid[..., None],
    )


def world_parts(scene: Superquadrics) -> Superquadrics:
    """All parts of a scene's bodies in the world, one after the other, fields (N P, ...)."""
    if scene.parts is None:
        return scene
    return jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), placed_parts(scene))


def per_part(scene: Superquadrics, values: Shaped[Array, "*batch n"]) -> Shaped[Array, "*batch parts"]:
    """The value of its body for each of `world_parts`, along the last axis."""
    if scene.parts is None:
        return values
    return jnp.repeat(values, scene.parts.capacity, axis=-1)


def any_part(scene: Superquadrics, values: Bool[Array, "*batch parts"]) -> Bool[Array, "*batch n"]:
    """For which bodies a statement holds that holds for any of their `world_parts`, along the last axis."""
    if scene.parts is None:
        return values
    return jnp.any(values.reshape(*values.shape[:-1], scene.capacity, scene.parts.capacity), axis=-1)


def boxed(scene: Superquadrics) -> Superquadrics:
    """Bodies, which must have parts, without these, and with the half-extents of boxes about their origins that contain
    them: larger than their own, if the bodies are `enlarged` and their parts grow along other axes."""
    parts = scene.parts
    assert parts is not None
    reach = jnp.abs(parts.position) + superquadric.support(
        parts.size[..., None, :], parts.exponents[..., None, :], parts.rotation
    )
    return scene.replace(size=jnp.max(jnp.where(parts.valid[..., None], reach, 0.0), axis=-2), parts=None)


def enlarged(scene: Superquadrics, by: Array | float) -> Superquadrics:
    """The bodies with all half-extents larger [m]."""
    parts = None if scene.parts is None else enlarged(scene.parts, by)
    return scene.replace(size=scene.size + by, parts=parts)


def slimmed(scene: Superquadrics, by: Array | float, least: float) -> Superquadrics:
    """The bodies with all half-extents smaller, by a length [m], but to no less than a share `least` of them."""
    parts = None if scene.parts is None else slimmed(scene.parts, by, least)
    return scene.replace(size=jnp.maximum(scene.size - by, least * scene.size), parts=parts)


def surfaces(scene: Superquadrics, count: int) -> Float[Array, "n count 3"]:
    """`count` points on the surface of every body in its own frame [m], which its parts share."""
    if scene.parts is None:
        return superquadric.sample_surface(scene.size, scene.exponents, count)
    return _parts_surface(scene.parts, count)


def surface_of(scene: Superquadrics, index: Int[Array, ""], count: int) -> Float[Array, "count 3"]:
    """The points of `surfaces` on one body."""
    if scene.parts is None:
        return superquadric.sample_surface(scene.size[index], scene.exponents[index], count)
    return _parts_surface(jax.tree.map(lambda a: a[index], scene.parts), count)


def _parts_surface(parts: Superquadrics, count: int) -> Float[Array, "*batch count 3"]:
    """Points on parts in their body's frame [m]: directions spread over the sphere, which the parts that there are take
    in turns, the largest first. So equal parts have the points of one."""
    lead = parts.valid.ndim - 1
    volume = jnp.where(parts.valid, jnp.prod(parts.size, axis=-1), -1.0)
    largest_first = jnp.argsort(-volume, axis=-1, stable=True)
    number = jnp.maximum(jnp.sum(parts.valid, axis=-1, keepdims=True), 1)
    turn = jnp.arange(count).reshape(*[1] * lead, count) % number
    owner = jnp.take_along_axis(largest_first, turn, axis=-1)
    own = jax.tree.map(lambda a: _along(a, owner), parts)
    directions = jnp.asarray(superquadric.surface_directions(count)).reshape(*[1] * lead, count, 3)
    points = superquadric.towards(own.size, own.exponents, jnp.broadcast_to(directions, own.size.shape))
    return rotate(own.rotation, points) + own.position


def _along(array: Shaped[Array, "..."], index: Int[Array, "*batch k"]) -> Shaped[Array, "..."]:
    """Entries of an array (*batch, P, ...) along the axis of the parts."""
    wide = index.reshape(*index.shape, *[1] * (array.ndim - index.ndim))
    return jnp.take_along_axis(array, wide, axis=index.ndim - 1)


def part_at(scene: Superquadrics, index: Int[Array, ""], point: Float[Array, "3"]) -> Int[Array, ""]:
    """The part of a body, which must have parts, that a point in the world [m] is in, or is nearest to in its size."""
    parts = placed_parts(jax.tree.map(lambda a: a[index], scene))
    gauge = superquadric.gauge(parts.size, parts.exponents, superquadric.to_object_frame(parts, point))
    return jnp.argmin(jnp.where(parts.valid, gauge, jnp.inf))


def grasped_shape(scene: Superquadrics, index: Int[Array, ""], point: Float[Array, "3"]) -> Superquadrics:
    """What of a body is between finger tips around a point in the world [m]: the `part_at` the point, in the world,
    without the axis of the objects. The body must have parts."""
    parts = placed_parts(jax.tree.map(lambda a: a[index], scene))
    return jax.tree.map(lambda a: a[part_at(scene, index, point)], parts)


def with_parts(scene: Superquadrics, parts: int = PARTS) -> Superquadrics:
    """The same bodies with room for `parts` parts each; a body that is one superquadric becomes its only part."""
    if scene.parts is not None:
        return scene
    own = scene.replace(
        position=jnp.zeros_like(scene.position),
        rotation=jnp.broadcast_to(jnp.eye(3, dtype=scene.rotation.dtype), scene.rotation.shape),
    )
    axis = scene.valid.ndim
    stacked = jax.tree.map(lambda a: jnp.stack([a] * parts, axis=axis), own)
    only = jnp.arange(parts).reshape(*[1] * axis, parts) == 0
    return scene.replace(parts=stacked.replace(valid=stacked.valid & only))


def bodies_of(
    parts: Superquadrics, position: Float[Array, "*batch 3"], rotation: Float[Array, "*batch 3 3"]
) -> Superquadrics:
    """Bodies of parts that are given in any frame of theirs.

    A body's own frame is turned like the given one, with its origin in the middle of the parts' bounding box; that box
    gives the half-extents of its bounding superquadric. The exponents are the first that bound all parts: the largest
    of the parts; a cylinder's with the largest e2, if the body is as broad as long; a box's.

    Args:
      parts: fields (..., P, ...), posed in the given frames.
      position, rotation: of these frames in the world; any leading axes.

    Returns:
      The bodies, which are present where any part is.
    """
    there = parts.valid[..., None]
    # The rows of the rotation are the frame's axes in the part's frame.
    reach = superquadric.support(parts.size[..., None, :], parts.exponents[..., None, :], parts.rotation)
    valid = jnp.any(parts.valid, axis=-1)
    low, high = (
        jnp.where(valid[..., None], sign * jnp.min(jnp.where(there, side, jnp.inf), axis=-2), sign * -1e-3)
        for sign, side in ((1.0, parts.position - reach), (-1.0, -parts.position - reach))
    )
    size, centre = 0.5 * (high - low), 0.5 * (high + low)
    centred = parts.replace(position=parts.position - centre[..., None, :])
    return Superquadrics(
        size=size,
        exponents=_bounding_exponents(centred, size),
        position=rotate(rotation, centre) + position,
        rotation=jnp.broadcast_to(rotation, (*valid.shape, 3, 3)),
        valid=valid,
        parts=centred,
    )


def _bounding_exponents(parts: Superquadrics, size: Float[Array, "*batch 3"]) -> Float[Array, "*batch 2"]:
    """The roundest exponents with which superquadrics of these half-extents bound parts; see `bodies_of`."""
    roundest = jnp.max(jnp.where(parts.valid[..., None], parts.exponents, 0.0), axis=-2)
    roundest = jnp.where(jnp.any(parts.valid, axis=-1, keepdims=True), roundest, 1.0)
    cylinder = roundest.at[..., 0].set(EDGE_EXPONENT)
    points = _parts_surface(parts, BOUNDED_POINTS)

    def outermost(exponents):
        return jnp.max(superquadric.gauge(size[..., None, :], exponents[..., None, :], points), axis=-1)

    is_round = jnp.max(size[..., :2], axis=-1) <= ROUND * jnp.min(size[..., :2], axis=-1)
    is_cylinder = is_round & (outermost(cylinder) <= RIM)
    box = jnp.where(is_cylinder[..., None], cylinder, jnp.full_like(roundest, EDGE_EXPONENT))
    return jnp.where((outermost(roundest) <= BOUNDED)[..., None], roundest, box)
