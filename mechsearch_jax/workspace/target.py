"""The target, whose shape is known, the finite set of its candidate poses (paper section 3), and its files."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import os
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from mechsearch_jax.runtime.errors import InputError, check_range
from mechsearch_jax.runtime.files import PathLike, read_json
from mechsearch_jax.runtime.identity import Uncompared
from mechsearch_jax.runtime.pytree import PyTreeNode, static
from mechsearch_jax.shapes import shape_of, union
from mechsearch_jax.shapes.compound import COMPOUND, CONVEX, Compound, Piece, centred, half_extents, solids
from mechsearch_jax.shapes.meshes import LEAST_THICKNESS, thickness
from mechsearch_jax.shapes.parts import part_rows
from mechsearch_jax.shapes.solid import Solid, solid_of
from mechsearch_jax.workspace.scenario import Body, check_norm, format_compound, is_compound, numbers, parse_compound
from mechsearch_jax.workspace.shelf import Shelf

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

# The number of planes of all polyhedra is rounded up to a multiple of this, and is at least so large: that of eight
# polyhedra of 48 vertices.
PLANES = 768
# Largest half-extent and inset [m], and largest number of candidate poses.
LARGEST = 1.0
MOST_POSES = 100_000
# Cosine of the largest angle by which a scenario may tip a target of pieces.
UPRIGHT = math.cos(math.radians(5))
# What a target of pieces or of a mesh is made of, if nothing is said: density [kg/m3] and friction.
DENSITY, FRICTION = 600.0, 0.5
# The key that says how the body has to be turned to stand upright.
TURN = "quaternion"


class TargetData(PyTreeNode):
    """The geometry of a target of pieces, in the frame of its centre of mass.

    Attributes:
      planes: of the faces of its polyhedra, one polyhedron after the other, rows (n, d) of n . x <= d, shape (F, 4)
        [m]; rows beyond `count` mean nothing.
      last: whether a plane is the last of its polyhedron, shape (F,).
      count: number of planes.
      half_size: half-extents of the smallest box about the origin, shape (3,) [m].
      middle, half: of the smallest box around it, shape (3,) [m].
      bottom, top, radius: of the `Solid` [m].
      parts: of `parts.part_rows`.
      number: that identifies the compound.
      turn, round: of the `Solid`; static.
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
    half_size = half_extents(compound)
    whole = solid_of(compound, half_size)
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
        half_size=np.array(half_size, np.float32),
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


@dataclasses.dataclass(frozen=True)
class Target:
    """An upright target of known shape; a pytree.

    Of a box or a cylinder all is static: each has its own programs. A target of several pieces has its geometry as
    arrays, so that all such targets with as many candidate poses share theirs. Inside of a program it has neither
    `compound` nor `solid`, but `data` and all other properties.

    Attributes:
      shape: name of its shape; "compound" of a target of several pieces.
      half_size: half-extents [m]; of a compound those of the smallest box about its centre of mass.
      grid: number of candidate positions in x and y.
      inset: distance between the outermost candidate positions and the board's edges [m]; see `margin`.
      yaws: number of candidate yaw angles over a `turn`; 1 for a round target.
      compound: what a target of several pieces is made of, in the frame of its centre of mass; None for any other.
    """

    shape: str = "cylinder"
    half_size: tuple[float, float, float] = (0.02, 0.02, 0.05)
    grid: tuple[int, int] = (18, 44)
    inset: float = 0.05
    yaws: int = 1
    compound: Compound | None = None
    # The geometry of a target of pieces inside of a program; None elsewhere.
    traced: ClassVar[TargetData | None] = None

    def __repr__(self) -> str:
        # Without a compound as before there were any: the text identifies saved problems and searches.
        fields = [field.name for field in dataclasses.fields(self) if field.name != "compound" or self.compound]
        return f"Target({', '.join(f'{name}={getattr(self, name)!r}' for name in fields)})"

    def __post_init__(self):
        if len(self.half_size) != 3 or not all(0 < s <= LARGEST for s in self.half_size):
            raise InputError(
                f"Target: half_size {self.half_size} must be three positive lengths in metres, at most {LARGEST}"
            )
        if (self.compound is None) == (self.shape == COMPOUND):
            raise InputError("Target: a compound is made by Target.from_parts, Target.from_mesh or Target.of_body")
        if self.compound is None and (fault := shape_of(self.shape, "Target: shape").fault(self.half_size)):
            raise InputError(f"Target: half_size {self.half_size}: {fault}")
        if min(self.grid) < 2 or self.yaws < 1:
            raise InputError(
                f"Target: grid {self.grid} needs at least 2 positions an axis and yaws {self.yaws} at least 1"
            )
        if self.grid[0] * self.grid[1] * self.yaws > MOST_POSES:
            raise InputError(f"Target: grid {self.grid} and yaws {self.yaws} make more than {MOST_POSES} poses")
        check_range("Target: inset", self.inset, 0.0, LARGEST, "m")

    @classmethod
    def of(cls, shape: str, half_size: tuple[float, float, float] | None = None) -> Target:
        """The target of a shape, with the shape's number of yaw angles.

        Args:
          shape: its name.
          half_size: half-extents [m]; the shape's usual ones if left out.

        Raises:
          InputError: there is no such shape, or it cannot have these half-extents.
        """
        kind = shape_of(shape)
        return cls(kind.name, half_size or kind.target_half_size, yaws=kind.yaws)

    @classmethod
    def from_parts(
        cls,
        pieces: Sequence[Piece],
        density: float = DENSITY,
        friction: float = FRICTION,
    ) -> Target:
        """A target of several convex pieces, which stands upright in their frame, z up.

        Args:
          pieces: at least one; they may overlap.
          density: [kg/m3].
          friction: coefficient of sliding friction against anything that is not rougher.

        Raises:
          InputError: there are no pieces or too many, one is no solid of a sensible size, a number is out of range, or
            the target is too large.
        """
        given = json.loads(json.dumps(format_compound(Compound(tuple(pieces), density, friction))))
        return cls.of_compound(parse_compound(given, (), "Target", Path()))

    @classmethod
    def from_mesh(
        cls,
        path: str | os.PathLike[str],
        scale: float = 1.0,
        density: float = DENSITY,
        friction: float = FRICTION,
    ) -> Target:
        """A target of the shape of a mesh file (OBJ, STL or PLY), which stands upright in its frame, z up.

        Args:
          path: of the file; see `shapes.meshes.convex_pieces`.
          scale: metres per unit of the file.
          density, friction: as of `from_parts`.

        Raises:
          InputError: the file cannot be read, is no solid mesh, or a number is out of range, or the target is too small
            or too large, as where `scale` is that of another unit.
        """
        given = {"mesh": os.fspath(path), "scale": scale, "density": density, "friction": friction}
        return cls.of_compound(parse_compound(given, (), f"{path}: target", Path()))

    @classmethod
    def of_body(cls, body: Body) -> Target:
        """The target that a scenario's body is, with the usual candidate poses.

        Raises:
          InputError: as `of`, or a compound is tipped by its quaternion.
        """
        if body.compound is None:
            return cls.of(body.shape, body.half_size)
        _, x, y, _ = body.quaternion
        if 1 - 2 * (x * x + y * y) < UPRIGHT:
            raise InputError(
                f"Target: quaternion {body.quaternion} tips it, but it stands upright; turn its pieces instead, z up"
            )
        return cls.of_compound(body.compound)

    @classmethod
    def of_compound(cls, compound: Compound) -> Target:
        """The target that a compound is, which stands upright in its frame, z up.

        Raises:
          InputError: it is too large, or a polyhedron is too thin.
        """
        thin = min((thickness(piece)[0] for piece in compound.pieces if piece.shape == CONVEX), default=1.0)
        if thin < 0.99 * LEAST_THICKNESS:
            raise InputError(
                f"Target: a piece is {1e3 * thin:.2g} mm thick; make it at least {1e3 * LEAST_THICKNESS:g} mm thick, or"
                " give a mesh, whose pieces are made so"
            )
        # Its colour is the detector's, whatever the compound's own.
        compound = dataclasses.replace(centred(compound)[0], colour=None)
        half_size = half_extents(compound)
        return cls(COMPOUND, half_size, yaws=solid_of(compound, half_size).yaws, compound=compound)

    def like(self, other: Target) -> Target:
        """Another target with this one's grid and inset.

        It has this target's yaw angles if it is of the same shape and of the same turn, else its own.
        """
        same = self.shape == other.shape and self.solid.round == other.solid.round and self.turn == other.turn
        return dataclasses.replace(other, grid=self.grid, inset=self.inset, yaws=self.yaws if same else other.yaws)

    @classmethod
    def cylinder(cls) -> Target:
        return cls.of("cylinder")

    @classmethod
    def box(cls) -> Target:
        return cls.of("box")

    @property
    def exponents(self) -> tuple[float, float]:
        """Of the superquadric that represents it in plans; of a compound, whose parts do, of a box around it."""
        return shape_of("box" if self.is_compound else self.shape).exponents

    @property
    def solid(self) -> Solid:
        """Its geometry."""
        assert self.traced is None, "inside of a program a target of pieces is data"
        return solid_of(self.compound or shape_of(self.shape), self.half_size)

    @property
    def is_compound(self) -> bool:
        """Whether it is of several pieces."""
        return self.shape == COMPOUND

    @property
    def data(self) -> TargetData:
        """The geometry of a target of several pieces, as arrays."""
        if self.traced is not None:
            return self.traced
        assert self.compound is not None
        return target_data(self.compound)

    @property
    def _extents(self) -> Solid | TargetData:
        return self.solid if self.traced is None else self.traced

    @property
    def turn(self) -> float:
        """The yaw after which it looks the same [rad]: half a turn, or a full one."""
        return self._extents.turn

    @property
    def round(self) -> bool:
        """Whether it is a solid of revolution about its vertical axis."""
        return self._extents.round

    @property
    def bottom(self) -> float | Array:
        """How far its lowest point is below its centre [m]."""
        return self._extents.bottom

    @property
    def top(self) -> float | Array:
        """How far its highest point is above its centre [m]."""
        return self._extents.top

    @property
    def radius(self) -> float | Array:
        """Largest distance of a point from the vertical axis through its centre [m]."""
        return self._extents.radius

    @property
    def tall(self) -> float | Array:
        """Its height [m]."""
        return self.bottom + self.top

    @property
    def margin(self) -> float:
        """Distance between the outermost candidate positions and the board's edges [m]: the inset, or the radius of a
        target that would be in a wall there at some yaw."""
        return max(self.inset, math.ceil(1e3 * self.solid.radius - 1e-6) / 1e3)

    def height(self, shelf: Shelf) -> float | Array:
        """z of the centre of a target that stands on the board [m]; the shelf may be traced."""
        return shelf.board + self.bottom

    def check_fits(self, shelf: Shelf) -> None:
        """Check that it is lower than the shelf, and narrower than its board.

        Raises:
          InputError: it is not.
        """
        deep, wide = float(shelf.back - shelf.front), float(shelf.left - shelf.right)
        if not 2 * self.margin < min(deep, wide):
            raise InputError(
                f"Target: it reaches {self.solid.radius:.3f} m from its middle, too far for a board of {deep:g} m x"
                f" {wide:g} m; use a smaller one, or write its scale, if it is in another unit"
            )
        room = float(shelf.walls.ceiling - shelf.board)
        if self.tall > room:
            raise InputError(
                f"Target: {self.tall:.3f} m tall, but the shelf is {room:.3f} m high inside; use a lower one"
            )

    def candidate_poses(self, shelf: Shelf) -> Float[np.ndarray, "x 3"]:
        """The candidate poses X as rows of x, y [m] and yaw [rad], yaw varying fastest and x slowest.

        The outermost positions are `margin` from the board's edges; the default spacing is 15 to 16 mm.
        """
        x = np.linspace(shelf.front + self.margin, shelf.back - self.margin, self.grid[0])
        y = np.linspace(shelf.right + self.margin, shelf.left - self.margin, self.grid[1])
        yaw = np.arange(self.yaws) * self.turn / self.yaws
        return np.stack(np.meshgrid(x, y, yaw, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)

    def places(self, shelf: Shelf, shares: Float[np.ndarray, "s 3"]) -> Float[np.ndarray, "x s 3"]:
        """Places in the grid cell of each candidate pose: x, y [m] and yaw [rad].

        The outermost cells reach to where a target touches the back or a side wall, for pushes take it there, and no
        other pose represents it. They are not extended at the front, where little hides the target.

        Args:
          shelf: as in `candidate_poses`.
          shares: positions in a cell, relative to half of its size; 1 is at a corner.
        """
        poses = self.candidate_poses(shelf)
        offsets = np.tile(shares * np.array(self.cell(shelf), np.float32) / 2, (len(poses), 1, 1))
        outward = max(self.margin - self.solid.breadth, 0.0)
        for axis, side in ((0, 1.0), (1, 1.0), (1, -1.0)):
            outermost = poses[:, axis] * side == np.max(poses[:, axis] * side)
            offsets[np.ix_(outermost, shares[:, axis] == side, [axis])] = side * outward
        return poses[:, None] + offsets

    def cell(self, shelf: Shelf) -> tuple[float, float, float]:
        """Spacing of the candidate poses in x, y [m] and yaw [rad]."""
        return (
            (shelf.back - shelf.front - 2 * self.margin) / (self.grid[0] - 1),
            (shelf.left - shelf.right - 2 * self.margin) / (self.grid[1] - 1),
            self.turn / self.yaws if self.yaws > 1 else 0.0,
        )


def _flattened(target: Target) -> tuple[tuple[TargetData, ...], Any]:
    if not target.is_compound:
        return (), target
    # A program does not depend on the target that the arrays were made of.
    made_of = Uncompared(target if target.traced is None else None)
    return (target.data,), (target.grid, target.yaws, made_of)


def _unflattened(static: Any, children: tuple[TargetData, ...]) -> Target:
    if isinstance(static, Target):
        return static
    (data,), (grid, yaws, made_of) = children, static
    if made_of.value is not None and isinstance(data, TargetData) and data.is_of(made_of.value.compound):
        return made_of.value
    target = object.__new__(Target)
    values = {"shape": COMPOUND, "grid": grid, "yaws": yaws, "inset": math.nan, "compound": None, "traced": data}
    for name, value in values.items():
        object.__setattr__(target, name, value)
    object.__setattr__(target, "half_size", getattr(data, "half_size", None))
    return target


jax.tree_util.register_pytree_node(Target, _flattened, _unflattened)


def load_target(path: PathLike, scale: float = 1.0) -> Target:
    """The target that a file describes, with the usual candidate poses.

    A JSON file holds a body of a scenario file: `pieces` or `mesh` with `density` and `friction`, perhaps `color` and
    `scale`, and no place; `quaternion` turns it upright, z up, if it is not already. Any other file is a mesh, z up.

    Args:
      path: of the file. For meshes see `meshes.convex_pieces`.
      scale: metres per unit of a mesh; in a JSON file that is a key.

    Raises:
      InputError: the file cannot be read, holds something else, or no target can be made of it.
    """
    from scipy.spatial.transform import Rotation

    file = Path(path)
    if file.suffix.lower() != ".json":
        return Target.from_mesh(file, scale)
    value = read_json(file)
    if not is_compound(value):
        raise InputError(f"{file}: must be a JSON object with pieces or mesh, density and friction")
    if scale != 1.0:
        raise InputError(f"{file}: a scale is for a mesh file; write it into this file, beside mesh")
    turn = Rotation.identity()
    if TURN in value:
        quaternion = numbers(value[TURN], 4, f"{file}: {TURN}")
        check_norm(quaternion, f"{file}: {TURN}")
        turn = Rotation.from_quat(quaternion, scalar_first=True)
    body = {key: entry for key, entry in value.items() if key != TURN}
    compound = parse_compound(body, (), str(file), file.parent)
    pieces = [_turned(piece, turn) for piece in compound.pieces]
    return Target.from_parts(pieces, compound.density, compound.friction)


def _turned(piece: Piece, turn: Rotation) -> Piece:
    """A piece in a frame that is turned about the body's origin; a polyhedron has no rotation of its own."""
    from scipy.spatial.transform import Rotation

    if turn.magnitude() == 0.0:
        return piece
    moved = dataclasses.replace(piece, position=_rounded(turn.apply(piece.position)))
    if piece.shape == CONVEX:
        return dataclasses.replace(moved, vertices=tuple(map(_rounded, turn.apply(piece.vertices))))
    own = Rotation.from_quat(piece.quaternion, scalar_first=True)
    return dataclasses.replace(moved, quaternion=_rounded((turn * own).as_quat(scalar_first=True)))


def _rounded(values: np.ndarray) -> Any:
    return tuple(round(float(v), 9) + 0.0 for v in values)
