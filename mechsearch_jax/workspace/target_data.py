"""The geometry of a target of pieces as arrays: programs take it as data, so that all such targets share them."""

from __future__ import annotations

import functools
import math
import zlib
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Float

from mechsearch_jax.runtime.pytree import PyTreeNode, static
from mechsearch_jax.shapes import union
from mechsearch_jax.shapes.compound import CONVEX, Compound, Piece, half_extents, solids
from mechsearch_jax.shapes.parts import part_rows
from mechsearch_jax.shapes.solid import Union

# The number of planes of all polyhedra is rounded up to a multiple of this, and is at least so large: that of eight
# polyhedra of 48 vertices.
PLANES = 768


class TargetData(PyTreeNode):
    """The geometry of a target of pieces, in the frame of its centre of mass.

    Attributes:
      planes: of the faces of its polyhedra, one polyhedron after the other, rows (n, d) of n . x <= d, shape (F, 4)
        [m]; rows beyond `count` mean nothing.
      last: whether a plane is the last of its polyhedron, shape (F,).
      count: number of planes.
      half_size: half-extents of the smallest box about the origin, shape (3,) [m].
      middle, half: of the smallest box around it, shape (3,) [m].
      bottom, top, radius: of a `solid.Solid` [m].
      parts: of `parts.part_rows`.
      number: that identifies the compound.
      turn, round: of a `solid.Solid`; static.
      primitives: its pieces that are no polyhedra; static, for they are few.
    """

    planes: Any
    last: Any
    count: Any
    half_size: Any
    middle: Any
    half: Any
    bottom: Any
    top: Any
    radius: Any
    parts: tuple[Any, ...]
    number: Any
    turn: float = static()
    round: bool = static()
    primitives: tuple[Piece, ...] = static()

    def is_of(self, compound: Compound | None) -> bool:
        """Whether these are the arrays of a compound; False inside of a program."""
        number = self.number
        if not isinstance(number, np.ndarray | np.generic | jax.Array) or isinstance(number, Tracer):
            return False
        return np.ndim(number) == 0 and compound is not None and int(number) == _number(compound)

    def cut(self, origin: Sequence[Any], direction: Sequence[Any]) -> Float[jax.Array, "*rays"]:
        """Where rays from outside enter it, as `union.cut` of the compound."""
        shape = np.broadcast_shapes(origin[0].shape, direction[0].shape)
        first = jnp.full(shape, jnp.inf)
        if self.primitives:
            static = Compound(self.primitives, 1.0, 1.0)
            first = jnp.minimum(first, union.cut(static, origin, direction, 0.0, jnp))
        if self.planes.shape[-2] == 0:
            return first

        planes, last = jnp.asarray(self.planes), jnp.asarray(self.last)

        def of_plane(i, state):
            near, far, first = state
            near, far = union.crossed(planes[i, :3], planes[i, 3], origin, direction, (near, far), jnp)
            ends = last[i]
            first = jnp.where(ends, jnp.minimum(first, union.entry(near, far, jnp)), first)
            return jnp.where(ends, jnp.inf, near), jnp.where(ends, 0.0, far), first

        start = jnp.full(shape, jnp.inf), jnp.zeros(shape), first
        return jax.lax.fori_loop(0, self.count, of_plane, start)[2]


@functools.lru_cache(maxsize=64)
def target_data(compound: Compound) -> TargetData:
    """The arrays of a compound, which is centred; they must not be changed."""
    whole = Union(compound)
    rows = union.polyhedra(compound)
    planes, last = np.zeros((0, 4)), np.zeros(0, bool)
    if rows is not None:
        there = rows.offset < union.FAR
        planes = np.column_stack([rows.normal[there], rows.offset[there]])
        last = np.concatenate([np.arange(n) == n - 1 for n in there.sum(axis=1)])
    room = max(math.ceil(len(planes) / PLANES), 1) * PLANES if len(planes) else 0
    count = len(planes)
    planes = np.pad(planes, ((0, room - count), (0, 0)))
    against, along = whole.extent(np.eye(3), np)
    return TargetData(
        planes=planes.astype(np.float32),
        last=np.pad(last, (0, room - count)),
        count=np.int32(count),
        half_size=np.array(half_extents(compound), np.float32),
        middle=((along - against) / 2).astype(np.float32),
        half=((along + against) / 2).astype(np.float32),
        bottom=np.float32(whole.bottom),
        top=np.float32(whole.top),
        radius=np.float32(whole.radius),
        parts=part_rows(compound),
        number=np.int32(_number(compound)),
        turn=whole.turn,
        round=whole.round,
        primitives=tuple(solid for solid in solids(compound.pieces) if solid.shape != CONVEX),
    )


@functools.lru_cache(maxsize=64)
def _number(compound: Compound) -> int:
    """A number that differs between compounds."""
    return zlib.crc32(repr(compound).encode()) >> 1
