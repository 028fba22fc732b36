"""What was seen of the shelf at one moment: the interface between perception and planning."""

from __future__ import annotations

import flax.struct
import jax

from mechsearch_jax.geometry.superquadric import Superquadrics


class Observation(flax.struct.PyTreeNode):
    """What was seen at one moment; every field may carry leading batch axes.

    Attributes:
      objects: the recognised objects, without the target, fields (..., N, ...).
      target_visible: whether the target is seen, bool, shape (...).
      target_pose: where, as x, y [m] and yaw [rad] in the world, shape (..., 3); anything where it is not visible.
    """

    objects: Superquadrics
    target_visible: jax.Array
    target_pose: jax.Array
