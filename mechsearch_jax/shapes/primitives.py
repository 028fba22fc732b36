"""The solids that bodies are made of: boxes, cylinders, ellipsoids and capsules, and their registries; without JAX.

`Primitive` says what a piece of a compound offers, and `Shape` what a whole body or a target of that kind does beside.
A new one is a class and an entry in the registries here.
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int

from mechsearch_jax.runtime.errors import InputError, shown

if TYPE_CHECKING:
    import trimesh

# Codes of the primitives.
BOX, CYLINDER, ELLIPSOID, CAPSULE = range(4)
# Corners of the circumscribed polygon of a cylinder, and of the inscribed polygon of its mesh.
RIM, SECTIONS = 24, 32
# MuJoCo has no capsules without a length [m].
SHORTEST = 1e-6


class Surface(abc.ABC):
    """The surface of a convex solid, as pictures show it.

    Methods with a `library`, NumPy or `jax.numpy`, take and return its arrays; this folder does not import JAX, so that
    the command line starts fast. Leading axes broadcast; directions and points are in the solid's frame.
    """

    @abc.abstractmethod
    def cut(
        self,
        origin: Sequence[Float[Any, "*#rays"]],
        direction: Sequence[Float[Any, "*#rays"]],
        half_size: Float[Any, "3 *#rays"],
        library: Any,
    ) -> Float[Any, "*rays"]:
        """Where rays from outside enter it; infinite for misses, also if it is behind them.

        Args:
          origin: of the rays, by component [m].
          direction: of any length, by component.
          half_size: [m]; the same for all rays, or one for each.
          library: of the arrays.

        Returns:
          Distance from `origin` in lengths of `direction`.
        """

    @abc.abstractmethod
    def normal(
        self, point: Float[Any, "*batch 3"], half_size: Float[Any, "*batch 3"], library: Any
    ) -> Float[Any, "*batch 3"]:
        """Outward normals, of any length, at points on its surface, or at surface points near others [m]."""

    @abc.abstractmethod
    def mesh(self, half_size: Sequence[float]) -> trimesh.Trimesh:
        """Its surface as a triangle mesh [m]."""


class Primitive(Surface):
    """A family of convex solids with three half-extents, symmetric about the planes between their axes.

    Attributes:
      code: its value among the kinds of pieces, and of a shape in `World.kind`; counted from 0.
      name: in files and on the command line.
      geometry: type of its geometry in MuJoCo.
    """

    code: int
    name: str
    geometry: str

    def fault(self, half_size: Sequence[float]) -> str | None:
        """Why it cannot have three positive half-extents; None if it can."""
        return None

    @abc.abstractmethod
    def volume(self, half_size: Float[Any, "*batch 3"], library: Any) -> Float[Any, "*batch"]:
        """[m3]."""

    @abc.abstractmethod
    def moments(self, half_size: Float[Any, "*batch 3"], library: Any) -> Float[Any, "*batch 3"]:
        """Principal moments of inertia of a homogeneous solid of 1 kg [m2]."""

    def geometry_size(self, half_size: Float[Any, "*batch 3"], library: Any) -> Float[Any, "*batch 3"]:
        """Size of its geometry in MuJoCo [m]."""
        return half_size

    @abc.abstractmethod
    def bounding_radius(self, half_size: Float[Any, "*batch 3"], library: Any) -> Float[Any, "*batch"]:
        """Radius of the smallest sphere about the centre that contains it [m]."""

    @abc.abstractmethod
    def inside(self, point: Float[Any, "*batch 3"], half_size: Float[Any, " 3"], library: Any) -> Bool[Any, "*batch"]:
        """Whether points are in the solid [m]."""

    @abc.abstractmethod
    def reach(
        self, direction: Float[Any, "*batch 3"], half_size: Float[Any, "*other 3"], library: Any
    ) -> Float[Any, "..."]:
        """Its support function, from its centre along unit vectors [m]; differentiable also along its axes."""

    @abc.abstractmethod
    def distance(
        self, level: Float[Any, "*batch 2"], height: Float[Any, "*batch"], half_size: Sequence[float], library: Any
    ) -> Float[Any, "*batch"]:
        """Signed distance of points to its surface [m], negative inside; its derivatives are finite everywhere.

        Args:
          level: first two components of the points [m].
          height: third component [m].
          half_size: [m].
          library: of the arrays.
        """


class Shape(Primitive):
    """A primitive of which whole bodies and targets may be.

    Attributes:
      exponents: (e1, e2) of the superquadric that represents it in plans.
      density: [kg/m3].
      friction: coefficient of sliding friction against anything that is not rougher.
      round: whether it is a solid of revolution about its third axis; the first two half-extents are then its radius.
      yaws: number of candidate yaw angles of a target, over half a turn.
      target_half_size: half-extents of the usual target [m].
    """

    exponents: tuple[float, float]
    density: float
    friction: float
    round: bool
    yaws: int
    target_half_size: tuple[float, float, float]

    def nearest(self, size: Float[Any, "*batch 3"], library: Any) -> Float[Any, "*batch 3"]:
        """Half-extents of the solid of this shape nearest to a superquadric's half-extents [m]."""
        return size

    @abc.abstractmethod
    def fall(self, before: Float[Any, "*batch 3"], after: Float[Any, "*batch 3"], library: Any) -> Float[Any, "*batch"]:
        """Cosine of the angle by which it has fallen over; rolling does not count.

        Args:
          before, after: the world's vertical, as unit vectors.
          library: of the arrays.
        """

    # Points spread evenly over its surface, from the same random numbers for all shapes.

    @abc.abstractmethod
    def areas(self, half_size: Float[Any, " 3"], library: Any) -> Float[Any, " 3"]:
        """Areas of three parts of its surface, relative to each other."""

    @abc.abstractmethod
    def spread(
        self, part: Int[Any, " n"], even: Float[Any, "n 3"], sign: Float[Any, " n"], library: Any
    ) -> Float[Any, "n 3"]:
        """Uniform points on parts of its surface, in half-extents.

        Args:
          part: index of the part of each point.
          even: uniform numbers from -1 to 1.
          sign: 1 or -1 with equal probability.
          library: of the arrays.
        """

    # On the host, for single bodies.

    @abc.abstractmethod
    def rim(self, half_size: Sequence[float]) -> Float[np.ndarray, "corners 2"]:
        """A convex polygon around its level cross-section, counter-clockwise [m]."""

    @abc.abstractmethod
    def grasps(
        self, half_size: Sequence[float], count: int, max_yaw: float
    ) -> tuple[Float[np.ndarray, " g"], Float[np.ndarray, " g"]]:
        """Grasps from the side: yaw angles of the approach [rad], and its widths there [m].

        Args:
          half_size: [m].
          count: number of approach directions of a round solid.
          max_yaw: their largest angle to its first axis [rad].
        """


def slab(
    origin: Float[Any, "..."], direction: Float[Any, "..."], half: Float[Any, "..."], library: Any
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


@dataclasses.dataclass(frozen=True)
class Box(Shape):
    """A box."""

    code: int = BOX
    name: str = "box"
    exponents: tuple[float, float] = (0.2, 0.2)
    density: float = 737.0
    friction: float = 0.4
    geometry: str = "box"
    round: bool = False
    yaws: int = 6
    target_half_size: tuple[float, float, float] = (0.015, 0.02, 0.05)

    def volume(self, half_size, library):
        return 8 * library.prod(half_size, axis=-1)

    def moments(self, half_size, library):
        square = half_size**2
        return (square.sum(axis=-1, keepdims=True) - square) / 3

    def bounding_radius(self, half_size, library):
        x, y, z = (half_size[..., i] for i in range(3))
        return library.sqrt(x**2 + y**2 + z**2)

    def inside(self, point, half_size, library):
        return library.all(library.abs(point) <= half_size, axis=-1)

    def reach(self, direction, half_size, library):
        return library.sum(library.abs(direction) * half_size, axis=-1)

    def cut(self, origin, direction, half_size, library):
        cuts = [slab(o, d, half_size[i], library) for i, (o, d) in enumerate(zip(origin, direction, strict=True))]
        (near, far), *rest = cuts
        for a, b in rest:
            near, far = library.maximum(near, a), library.minimum(far, b)
        return first(near, far, library)

    def normal(self, point, half_size, library):
        return face(point, half_size, library)

    def distance(self, level, height, half_size, library):
        half = library.asarray(half_size[:2], level.dtype).reshape((1,) * (level.ndim - 1) + (2,))
        side = gap(library.abs(level) - half, library)
        return gap(library.stack([side, library.abs(height) - half_size[2]], axis=-1), library)

    def fall(self, before, after, library):
        return library.sum(before * after, axis=-1)

    def areas(self, half_size, library):
        """Areas of the faces across each axis."""
        a, b, c = half_size
        return library.stack([b * c, a * c, a * b])

    def spread(self, part, even, sign, library):
        return library.where(part[:, None] == library.arange(3)[None], sign[:, None], even)

    def rim(self, half_size: Sequence[float]) -> Float[np.ndarray, "4 2"]:
        a, b, _ = half_size
        return np.array([(a, b), (-a, b), (-a, -b), (a, -b)])

    def mesh(self, half_size: Sequence[float]) -> trimesh.Trimesh:
        import trimesh

        a, b, c = half_size
        return trimesh.creation.box(extents=(2 * a, 2 * b, 2 * c))

    def grasps(self, half_size, count, max_yaw):
        """Perpendicular to each side."""
        return np.arange(4) * np.pi / 2, 2 * np.array(half_size)[[1, 0, 1, 0]]


@dataclasses.dataclass(frozen=True)
class Cylinder(Shape):
    """A cylinder about its third axis, with half-extents (radius, radius, half its height)."""

    code: int = CYLINDER
    name: str = "cylinder"
    exponents: tuple[float, float] = (0.2, 1.0)
    density: float = 585.0
    friction: float = 0.6
    geometry: str = "cylinder"
    round: bool = True
    yaws: int = 1
    target_half_size: tuple[float, float, float] = (0.02, 0.02, 0.05)

    def fault(self, half_size: Sequence[float]) -> str | None:
        return None if half_size[0] == half_size[1] else "a cylinder's first two are its radius and must be equal"

    def nearest(self, size, library):
        """The cylinder of the same cross-section and height."""
        radius = library.sqrt(size[..., :1] * size[..., 1:2])
        return library.concatenate([radius, radius, size[..., 2:]], axis=-1)

    def volume(self, half_size, library):
        return 8 * library.prod(half_size, axis=-1) * (np.pi / 4)

    def moments(self, half_size, library):
        square = half_size**2
        across = square[..., 0] / 4 + square[..., 2] / 3
        return library.stack([across, across, square[..., 0] / 2], axis=-1)

    def geometry_size(self, half_size, library):
        return library.stack([half_size[..., 0], half_size[..., 2], library.zeros_like(half_size[..., 0])], axis=-1)

    def bounding_radius(self, half_size, library):
        return library.sqrt(half_size[..., 0] ** 2 + half_size[..., 2] ** 2)

    def inside(self, point, half_size, library):
        across = point[..., 0] ** 2 + point[..., 1] ** 2 <= half_size[0] ** 2
        return across & (library.abs(point[..., 2]) <= half_size[2])

    def reach(self, direction, half_size, library):
        square = 1.0 - direction[..., 2] ** 2
        tilted = square > 1e-12
        across = library.where(tilted, library.sqrt(library.where(tilted, square, 1.0)), 0.0)
        return library.abs(direction[..., 2]) * half_size[..., 2] + across * half_size[..., 0]

    def cut(self, origin, direction, half_size, library):
        """The ray crosses the side half a chord before and after its point nearest to the axis."""
        (x, y, z), (u, v, w) = origin, direction
        square = library.maximum(u * u + v * v, 1e-20)
        middle = -(x * u + y * v) / square
        miss = x * v - y * u
        chord = half_size[0] * half_size[0] - miss * miss / square
        reach = library.sqrt(library.maximum(chord, 0.0) / square)
        bottom, top = slab(z, w, half_size[2], library)
        near, far = library.maximum(middle - reach, bottom), library.minimum(middle + reach, top)
        return library.where(chord >= 0.0, first(near, far, library), library.inf)

    def normal(self, point, half_size, library):
        share = library.abs(point) / half_size
        on_side = library.sqrt(point[..., 0] ** 2 + point[..., 1] ** 2) / half_size[..., 0] >= share[..., 2]
        level = library.asarray([1.0, 1.0, 0.0], point.dtype).reshape((1,) * (point.ndim - 1) + (3,))
        return library.where(on_side[..., None], point * level, face(point, half_size, library) * (1.0 - level))

    def distance(self, level, height, half_size, library):
        square = library.sum(level**2, axis=-1)
        off_axis = square > 0
        side = library.where(off_axis, library.sqrt(library.where(off_axis, square, 1.0)), 0.0) - half_size[0]
        return gap(library.stack([side, library.abs(height) - half_size[2]], axis=-1), library)

    def fall(self, before, after, library):
        """The cosine of the difference between the inclinations of its axis."""
        a, b = (library.clip(library.abs(up[..., 2]), 0.0, 1.0) for up in (before, after))
        return a * b + library.sqrt((1.0 - a**2) * (1.0 - b**2))

    def areas(self, half_size, library):
        """Areas of the side, of nothing, and of the ends."""
        a, _, c = half_size
        return library.stack([2.0 * a * c, 0.0 * a, a * a])

    def spread(self, part, even, sign, library):
        angle = np.pi * even[:, 0]
        radius = library.where(part == 2, library.sqrt(library.abs(even[:, 1])), 1.0)
        height = library.where(part == 2, sign, even[:, 2])
        return library.stack([radius * library.cos(angle), radius * library.sin(angle), height], axis=-1)

    def rim(self, half_size: Sequence[float]) -> Float[np.ndarray, "corners 2"]:
        angle = np.arange(RIM) * (2 * np.pi / RIM)
        return np.stack([np.cos(angle), np.sin(angle)], axis=1) * half_size[0] / np.cos(np.pi / RIM)

    def mesh(self, half_size: Sequence[float]) -> trimesh.Trimesh:
        import trimesh

        return trimesh.creation.cylinder(radius=half_size[0], height=2 * half_size[2], sections=SECTIONS)

    def grasps(self, half_size, count, max_yaw):
        """From all directions of approach."""
        yaws = np.linspace(-max_yaw, max_yaw, count) if count > 1 else np.zeros(1)
        return yaws, np.full(len(yaws), 2 * half_size[0])


@dataclasses.dataclass(frozen=True)
class Ellipsoid(Primitive):
    """An ellipsoid; its half-extents are its semi-axes."""

    code: int = ELLIPSOID
    name: str = "ellipsoid"
    geometry: str = "ellipsoid"

    def volume(self, half_size, library):
        return library.prod(half_size, axis=-1) * (4 * np.pi / 3)

    def moments(self, half_size, library):
        square = half_size**2
        return (square.sum(axis=-1, keepdims=True) - square) / 5

    def bounding_radius(self, half_size, library):
        return library.max(half_size, axis=-1)

    def inside(self, point, half_size, library):
        return library.sum((point / half_size) ** 2, axis=-1) <= 1.0

    def cut(self, origin, direction, half_size, library):
        """The first crossing of the unit sphere by the ray in semi-axes."""
        o = [component / half_size[i] for i, component in enumerate(origin)]
        d = [component / half_size[i] for i, component in enumerate(direction)]
        square = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
        middle = -(o[0] * d[0] + o[1] * d[1] + o[2] * d[2]) / square
        # From the point nearest to the centre: the difference of large squares would lose digits.
        miss = sum((o[i] + middle * d[i]) ** 2 for i in range(3))
        reach = library.sqrt(library.maximum(1.0 - miss, 0.0) / square)
        return library.where((miss <= 1.0) & (middle - reach > 0.0), middle - reach, library.inf)

    def reach(self, direction, half_size, library):
        return library.sqrt(library.sum((direction * half_size) ** 2, axis=-1))

    def distance(self, level, height, half_size, library):
        """Right to first order at the surface; in the middle minus the least semi-axis."""
        point = [level[..., 0], level[..., 1], height]
        share = sum((p / a) ** 2 for p, a in zip(point, half_size, strict=True))
        slope = sum((p / a**2) ** 2 for p, a in zip(point, half_size, strict=True))
        off = slope > 1e-12
        gauge, steep = (library.sqrt(library.where(off, value, 1.0)) for value in (share, slope))
        return library.where(off, gauge * (gauge - 1.0) / steep, -min(half_size))

    def normal(self, point, half_size, library):
        return point / half_size**2

    def mesh(self, half_size: Sequence[float]) -> trimesh.Trimesh:
        import trimesh

        return trimesh.creation.icosphere(subdivisions=3).apply_scale(np.asarray(half_size, float))


@dataclasses.dataclass(frozen=True)
class Capsule(Primitive):
    """A cylinder about its third axis with round ends; half-extents (r, r, half its length with the ends)."""

    code: int = CAPSULE
    name: str = "capsule"
    geometry: str = "capsule"

    def fault(self, half_size: Sequence[float]) -> str | None:
        if half_size[0] != half_size[1]:
            return "a capsule's first two are its radius and must be equal"
        return None if half_size[2] >= half_size[0] else "a capsule's third is half its length, at least its radius"

    def volume(self, half_size, library):
        radius, half = half_size[..., 0], half_size[..., 2] - half_size[..., 0]
        return np.pi * radius**2 * (2 * half + 4 / 3 * radius)

    def moments(self, half_size, library):
        """Those of the cylinder and of the two half-balls, whose centres of mass are 3/8 r beyond its ends."""
        radius, half = half_size[..., 0], half_size[..., 2] - half_size[..., 0]
        square = radius**2
        middle = 2 * half / (2 * half + 4 / 3 * radius)
        ends = 1.0 - middle
        beyond = half**2 + 0.75 * half * radius
        across = middle * (square / 4 + half**2 / 3) + ends * (0.4 * square + beyond)
        along = middle * square / 2 + ends * 0.4 * square
        return library.stack([across, across, along], axis=-1)

    def geometry_size(self, half_size, library):
        radius, half = half_size[..., 0], half_size[..., 2] - half_size[..., 0]
        return library.stack([radius, library.maximum(half, SHORTEST), library.zeros_like(radius)], axis=-1)

    def bounding_radius(self, half_size, library):
        return half_size[..., 2]

    def inside(self, point, half_size, library):
        half = half_size[2] - half_size[0]
        beyond = library.maximum(library.abs(point[..., 2]) - half, 0.0)
        return point[..., 0] ** 2 + point[..., 1] ** 2 + beyond**2 <= half_size[0] ** 2

    def cut(self, origin, direction, half_size, library):
        """The nearest crossing of the side, between the centres of the ends, or of the spheres at the ends."""
        (x, y, z), (u, v, w) = origin, direction
        radius, half = half_size[0], half_size[2] - half_size[0]
        square = library.maximum(u * u + v * v, 1e-12)
        along = u * x + v * y
        chord = along * along - square * (x * x + y * y - radius * radius)
        side = (-along - library.sqrt(library.maximum(chord, 0.0))) / square
        on_side = (chord >= 0.0) & (library.abs(z + side * w) <= half) & (side > 0.0)
        nearest = library.where(on_side, side, library.inf)
        length = square + w * w
        for end in (-half, half):
            along = u * x + v * y + w * (z - end)
            chord = along * along - length * (x * x + y * y + (z - end) ** 2 - radius * radius)
            first = (-along - library.sqrt(library.maximum(chord, 0.0))) / length
            hit = (chord >= 0.0) & (first > 0.0)
            nearest = library.where(hit & (first < nearest), first, nearest)
        return nearest

    def reach(self, direction, half_size, library):
        radius, half = half_size[..., 0], half_size[..., 2] - half_size[..., 0]
        return radius + half * library.abs(direction[..., 2])

    def distance(self, level, height, half_size, library):
        half = half_size[2] - half_size[0]
        beyond = library.maximum(library.abs(height) - half, 0.0)
        square = level[..., 0] ** 2 + level[..., 1] ** 2 + beyond**2
        off_axis = square > 0
        return library.where(off_axis, library.sqrt(library.where(off_axis, square, 1.0)), 0.0) - half_size[0]

    def normal(self, point, half_size, library):
        half = half_size[..., 2:] - half_size[..., :1]
        height = point[..., 2:] - library.clip(point[..., 2:], -half, half)
        return library.concatenate([point[..., :2], height], axis=-1)

    def mesh(self, half_size: Sequence[float]) -> trimesh.Trimesh:
        import trimesh

        radius, _, half = half_size
        mesh = trimesh.creation.capsule(height=2 * (half - radius), radius=radius, count=(16, 12))
        return mesh.apply_translation(-mesh.bounds.mean(axis=0))


SHAPES: Mapping[str, Shape] = {shape.name: shape for shape in (Box(), Cylinder())}
# In the order of their codes.
PRIMITIVES: Mapping[str, Primitive] = {
    primitive.name: primitive for primitive in (Box(), Cylinder(), Ellipsoid(), Capsule())
}


def shape_of(name: Any, where: str = "shape") -> Shape:
    """The shape with a name; error messages begin with `where`.

    Raises:
      InputError: there is none.
    """
    for shape in SHAPES.values():
        if shape.name == name:
            return shape
    *names, last = (f'"{valid}"' for valid in SHAPES)
    raise InputError(f"{where}: {shown(name)} is unknown; use {', '.join(names)} or {last}")


def in_order() -> tuple[Shape, ...]:
    """All shapes in the order of their codes."""
    return tuple(sorted(SHAPES.values(), key=lambda shape: shape.code))


def by_shape(kind: Any, value: Callable[[Shape], Any], library: Any) -> Any:
    """For each body the `value` of its shape.

    Args:
      kind: codes of the bodies' shapes; not checked, since they may be traced.
      value: called for every shape; its results broadcast against `kind`.
      library: of the arrays, NumPy or `jax.numpy`.
    """
    first, *rest = in_order()
    chosen = value(first)
    for shape in rest:
        chosen = library.where(kind == shape.code, value(shape), chosen)
    return chosen
