"""The protocol of a primitive, a solid that pieces of compounds are made of; implementations are in `registry`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol

from jaxtyping import Bool, Float

if TYPE_CHECKING:
    import trimesh


class Primitive(Protocol):
    """A family of convex solids with three half-extents, symmetric about the planes between their axes.

    Methods with a `library`, NumPy or `jax.numpy`, are as of `shape.Shape`, which boxes and cylinders are, too.

    Attributes:
      code: its value among the kinds of pieces, counted from 0.
      name: in scenario files.
      geometry: type of its geometry in MuJoCo.
    """

    @property
    def code(self) -> int: ...
    @property
    def name(self) -> str: ...
    @property
    def geometry(self) -> str: ...

    def fault(self, half_size: Sequence[float]) -> str | None:
        """Why this primitive cannot have three positive half-extents; None if it can."""
        ...

    def volume(self, half_size: Float[Any, "*batch 3"], library: Any) -> Float[Any, "*batch"]:
        """[m3]."""
        ...

    def moments(self, half_size: Float[Any, "*batch 3"], library: Any) -> Float[Any, "*batch 3"]:
        """Principal moments of inertia of a homogeneous solid of 1 kg [m2]."""
        ...

    def geometry_size(self, half_size: Float[Any, "*batch 3"], library: Any) -> Float[Any, "*batch 3"]:
        """Size of its geometry in MuJoCo [m]."""
        ...

    def bounding_radius(self, half_size: Float[Any, "*batch 3"], library: Any) -> Float[Any, "*batch"]:
        """Radius of the smallest sphere about the centre that contains it [m]."""
        ...

    def inside(self, point: Float[Any, "*batch 3"], half_size: Float[Any, " 3"], library: Any) -> Bool[Any, "*batch"]:
        """Whether points are in the solid [m]."""
        ...

    def cut(
        self,
        origin: Sequence[Float[Any, "*#rays"]],
        direction: Sequence[Float[Any, "*#rays"]],
        half_size: Float[Any, " 3"],
        library: Any,
    ) -> Float[Any, "*rays"]:
        """Where rays from outside enter it; see `shape.Shape.cut`."""
        ...

    def reach(
        self, direction: Float[Any, "*batch 3"], half_size: Float[Any, "*other 3"], library: Any
    ) -> Float[Any, "..."]:
        """Its support function, from its centre along unit vectors [m]."""
        ...

    def distance(
        self, level: Float[Any, "*batch 2"], height: Float[Any, "*batch"], half_size: Sequence[float], library: Any
    ) -> Float[Any, "*batch"]:
        """Signed distance of points to its surface [m], negative inside; see `shape.Shape.distance`."""
        ...

    def normal(
        self, point: Float[Any, "*batch 3"], half_size: Float[Any, "*batch 3"], library: Any
    ) -> Float[Any, "*batch 3"]:
        """Outward normals, of any length, at points on its surface [m]."""
        ...

    def mesh(self, half_size: Sequence[float]) -> trimesh.Trimesh:
        """Its surface as a triangle mesh [m]."""
        ...
