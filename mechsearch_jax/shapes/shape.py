"""The protocol of a shape of bodies; implementations are listed in `registry`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from jaxtyping import Float, Int

if TYPE_CHECKING:
    import trimesh


class Shape(Protocol):
    """A family of solids with three half-extents along their axes of symmetry.

    Methods with a `library`, NumPy or `jax.numpy`, take and return its arrays; this folder does not import JAX, so that
    the command line starts fast. Leading axes broadcast; directions and points are in the solid's frame.

    Attributes:
      code: its value in `World.kind`, counted from 0.
      name: in files and on the command line.
      exponents: (e1, e2) of the superquadric that represents it in plans.
      density: [kg/m3].
      friction: coefficient of sliding friction against anything that is not rougher.
      geometry: type of its geometry in MuJoCo.
      round: whether it is a solid of revolution about its third axis; the first two half-extents are then its radius.
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

    # Size and mass.

    def fault(self, half_size: Sequence[float]) -> str | None:
        """Why this shape cannot have three positive half-extents; None if it can."""
        ...

    def nearest(self, size: Float[Any, "*batch 3"], library: Any) -> Float[Any, "*batch 3"]:
        """Half-extents of the solid of this shape nearest to a superquadric's half-extents [m]."""
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

    # Surface.

    def reach(
        self, direction: Float[Any, "*batch 3"], half_size: Float[Any, "*other 3"], library: Any
    ) -> Float[Any, "..."]:
        """Its support function, from its centre along unit vectors [m]; differentiable also along its axes."""
        ...

    def cut(
        self,
        origin: Sequence[Float[Any, "*#rays"]],
        direction: Sequence[Float[Any, "*#rays"]],
        half_size: Float[Any, " 3"],
        library: Any,
    ) -> Float[Any, "*rays"]:
        """Where rays from outside enter it; infinite for misses, also if it is behind them.

        Args:
          origin: of the rays, by component [m].
          direction: of any length, by component.
          half_size: [m].
          library: of the arrays.

        Returns:
          Distance from `origin` in lengths of `direction`.
        """
        ...

    def normal(
        self, point: Float[Any, "*batch 3"], half_size: Float[Any, "*batch 3"], library: Any
    ) -> Float[Any, "*batch 3"]:
        """Outward normals, of any length, at points on its surface, or at surface points near others [m]."""
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
        """Cosine of the angle by which it has fallen over; rolling does not count.

        Args:
          before, after: the world's vertical, as unit vectors.
          library: of the arrays.
        """
        ...

    # Points spread evenly over its surface, from the same random numbers for all shapes.

    def areas(self, half_size: Float[Any, " 3"], library: Any) -> Float[Any, " 3"]:
        """Areas of three parts of its surface, relative to each other."""
        ...

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
        ...

    # On the host, for single bodies.

    def rim(self, half_size: Sequence[float]) -> Float[np.ndarray, "corners 2"]:
        """A convex polygon around its level cross-section, counter-clockwise [m]."""
        ...

    def mesh(self, half_size: Sequence[float]) -> trimesh.Trimesh:
        """Its surface as a triangle mesh [m]."""
        ...

    def grasps(
        self, half_size: Sequence[float], count: int, max_yaw: float
    ) -> tuple[Float[np.ndarray, " g"], Float[np.ndarray, " g"]]:
        """Grasps from the side: yaw angles of the approach [rad], and its widths there [m].

        Args:
          half_size: [m].
          count: number of approach directions of a round solid.
          max_yaw: their largest angle to its first axis [rad].
        """
        ...
