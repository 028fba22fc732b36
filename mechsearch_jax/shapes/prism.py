"""What boxes and cylinders share: they are upright prisms, with a convex side between two level ends."""

from __future__ import annotations

from typing import Any

from jaxtyping import Float


def slab(
    origin: Float[Any, "..."], direction: Float[Any, "..."], half: Float[Any, ""], library: Any
) -> tuple[Float[Any, "..."], Float[Any, "..."]]:
    """Where rays enter and leave the space between two planes at `-half` and `half`; never, where they run outside."""
    safe = library.where(library.abs(direction) < 1e-12, 1e-12, direction)
    a, b = (-half - origin) / safe, (half - origin) / safe
    return library.minimum(a, b), library.maximum(a, b)


def first(near: Float[Any, "*rays"], far: Float[Any, "*rays"], library: Any) -> Float[Any, "*rays"]:
    """Where rays that are inside from `near` to `far` enter; infinite where they never are, or already begin there."""
    return library.where((near <= far) & (near > 0.0), near, library.inf)


def gap(along: Float[Any, "*batch n"], library: Any) -> Float[Any, "*batch"]:
    """Signed distance to where all of `along`, signed distances at right angles to each other, are negative."""
    outside = library.maximum(along, 0.0)
    square = library.sum(outside**2, axis=-1)
    beyond = square > 0
    return library.where(beyond, library.sqrt(library.where(beyond, square, 1.0)), library.max(along, axis=-1))


def face(point: Float[Any, "*batch 3"], half_size: Float[Any, "*batch 3"], library: Any) -> Float[Any, "*batch 3"]:
    """Outward normal of the face that a point is on, or nearest to in half-extents, of the box around a prism."""
    share = library.abs(point) / half_size
    return library.sign(point) * (share >= library.max(share, axis=-1, keepdims=True))
