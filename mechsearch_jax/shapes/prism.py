"""Functions that boxes and cylinders share as prisms, with a convex side between two level ends."""

from __future__ import annotations

from typing import Any

from jaxtyping import Float


def slab(
    origin: Float[Any, "..."], direction: Float[Any, "..."], half: Float[Any, ""], library: Any
) -> tuple[Float[Any, "..."], Float[Any, "..."]]:
    """Where rays enter and leave the slab between two planes at `-half` and `half`."""
    safe = library.where(library.abs(direction) < 1e-12, 1e-12, direction)
    a, b = (-half - origin) / safe, (half - origin) / safe
    return library.minimum(a, b), library.maximum(a, b)


def first(near: Float[Any, "*rays"], far: Float[Any, "*rays"], library: Any) -> Float[Any, "*rays"]:
    """Where rays enter a solid in which they are from `near` to `far`; infinite if they miss it or begin inside."""
    return library.where((near <= far) & (near > 0.0), near, library.inf)


def gap(along: Float[Any, "*batch n"], library: Any) -> Float[Any, "*batch"]:
    """Signed distance to the intersection of perpendicular half-spaces, from the signed distances `along` to each."""
    outside = library.maximum(along, 0.0)
    square = library.sum(outside**2, axis=-1)
    beyond = square > 0
    return library.where(beyond, library.sqrt(library.where(beyond, square, 1.0)), library.max(along, axis=-1))


def face(point: Float[Any, "*batch 3"], half_size: Float[Any, "*batch 3"], library: Any) -> Float[Any, "*batch 3"]:
    """Outward normal of the face of a prism's bounding box that a point is nearest to, in half-extents."""
    share = library.abs(point) / half_size
    return library.sign(point) * (share >= library.max(share, axis=-1, keepdims=True))
