"""What a shape of bodies has to offer: one file for each shape, named in `registry`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from jaxtyping import Float, Int

if TYPE_CHECKING:
    import trimesh


class Shape(Protocol):
    """A shape: solids that are told apart by three half-extents along their own axes, about which they are symmetric.

    Of what takes a `library`, arrays are of that one: NumPy or `jax.numpy`. Nothing here imports JAX, so that the names
    of the shapes are known at once. Leading axes broadcast; directions and points are in the solid's own frame.

    Attributes:
      code: its value in `World.kind`; all shapes are numbered from 0.
      name: what files and the command line call it.
      exponents: (e1, e2) of the superquadric that the planner takes it for.
      density: [kg/m3].
      friction: of sliding, against anything that is not rougher.
      geometry: type of its geometry in MuJoCo.
      round: whether it is a solid of revolution about its third axis, its first two half-extents being the radius.
      yaws: number of candidate yaw angles of a target, over half a turn.
      target_half_size: half-extents of the usual target [m].
    """

    @property
    def code(self) -> int: ...
    @property
    def name(self) -> str: ...
    @property
    def exponents(self) -> tuple[float, float]: ...
    @property
    def density(self) -> float: ...
    @property
    def friction(self) -> float: ...
    @property
    def geometry(self) -> str: ...
    @property
    def round(self) -> bool: ...
    @property
    def yaws(self) -> int: ...
    @property
    def target_half_size(self) -> tuple[float, float, float]: ...

    # What it is.

    def fault(self, half_size: Sequence[float]) -> str | None:
        """Why three positive lengths are no half-extents of this shape; None if they are."""
        ...

    def nearest(self, size: Float[Any, "*batch 3"], library: Any) -> Float[Any, "*batch 3"]:
        """Half-extents of the solid of this shape that comes nearest to a superquadric with others [m]."""
        ...

    def volume(self, half_size: Float[Any, "*batch 3"], library: Any) -> Float[Any, "*batch"]:
        """[m3]."""
        ...

    def moments(self, half_size: Float[Any, "*batch 3"], library: Any) -> Float[Any, "*batch 3"]:
        """Principal moments of inertia of a homogeneous solid of 1 kg, about its own axes [m2]."""
        ...

    def geometry_size(self, half_size: Float[Any, "*batch 3"], library: Any) -> Float[Any, "*batch 3"]:
        """Size of its geometry in MuJoCo [m]."""
        ...

    def bounding_radius(self, half_size: Float[Any, "*batch 3"], library: Any) -> Float[Any, "*batch"]:
        """Radius of the smallest sphere about the centre that holds it [m]."""
        ...

    # Where its surface is.

    def reach(
        self, direction: Float[Any, "*batch 3"], half_size: Float[Any, "*other 3"], library: Any
    ) -> Float[Any, "..."]:
        """How far it reaches from its centre along unit vectors [m]; differentiable also along its axes."""
        ...

    def cut(
        self,
        origin: Sequence[Float[Any, "*#rays"]],
        direction: Sequence[Float[Any, "*#rays"]],
        half_size: Float[Any, " 3"],
        library: Any,
    ) -> Float[Any, "*rays"]:
        """Where rays from outside enter it; infinite where they miss, or it is behind them.

        Args:
          origin: where they begin, by component [m].
          direction: of any length, by component.
          half_size: [m].
          library: of the arrays.

        Returns:
          By how many times `direction` the surface is from `origin`.
        """
        ...

    def normal(
        self, point: Float[Any, "*batch 3"], half_size: Float[Any, "*batch 3"], library: Any
    ) -> Float[Any, "*batch 3"]:
        """Outward normals, of any length, at points on its surface [m]; of others, the normal of a point nearby."""
        ...

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
        ...

    def fall(self, before: Float[Any, "*batch 3"], after: Float[Any, "*batch 3"], library: Any) -> Float[Any, "*batch"]:
        """Cosine of the angle by which it has fallen over; to roll is not to fall.

        Args:
          before, after: the world's vertical, as unit vectors.
          library: of the arrays.
        """
        ...

    # Points spread evenly over its surface, from the same random numbers whatever the shape.

    def areas(self, half_size: Float[Any, " 3"], library: Any) -> Float[Any, " 3"]:
        """Areas of three parts of its surface, relative to each other."""
        ...

    def spread(
        self, part: Int[Any, " n"], even: Float[Any, "n 3"], sign: Float[Any, " n"], library: Any
    ) -> Float[Any, "n 3"]:
        """Points that lie evenly on parts of its surface, in half-extents.

        Args:
          part: which of the three.
          even: numbers that lie evenly between -1 and 1.
          sign: 1 or -1, evenly.
          library: of the arrays.
        """
        ...

    # What is asked of a few bodies on the host.

    def rim(self, half_size: Sequence[float]) -> Float[np.ndarray, "corners 2"]:
        """A convex polygon around its level cross-section, counter-clockwise [m]."""
        ...

    def mesh(self, half_size: Sequence[float]) -> trimesh.Trimesh:
        """Its surface, of triangles [m]."""
        ...

    def grasps(
        self, half_size: Sequence[float], count: int, max_yaw: float
    ) -> tuple[Float[np.ndarray, " g"], Float[np.ndarray, " g"]]:
        """How it is grasped from the side: directions of the approach seen from above [rad], and its widths there [m].

        Args:
          half_size: [m].
          count: number of approach directions, where all are as good.
          max_yaw: largest angle between those and its first axis [rad].
        """
        ...
