"""The observation of the shelf: the interface between perception and planning."""

from __future__ import annotations

import flax.struct
import jax

from mechsearch_jax.geometry.superquadric import Superquadrics


class Observation(flax.struct.PyTreeNode):
    """The recognised scene at one moment; every field may have leading batch axes.

    Attributes:
      objects: the recognised objects, without the target, fields (..., N, ...).
      target_visible: whether the target is visible, bool, shape (...).
      target_pose: x, y [m] and yaw [rad] in the world, shape (..., 3); arbitrary if it is not visible.
    """

    objects: Superquadrics
    target_visible: jax.Array
    target_pose: jax.Array
