"""The observation of the shelf: the interface between perception and planning."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from mechsearch_jax.geometry.superquadric import ROUND_EXPONENT, Superquadrics, as_boxes
from mechsearch_jax.runtime.compiled import cached_jit
from mechsearch_jax.runtime.pytree import PyTreeNode


class Observation(PyTreeNode):
    """The recognised scene at one moment; every field may have leading batch axes.

    Attributes:
      objects: the recognised objects, without the target, fields (..., N, ...); each may have several parts.
      target_visible: whether the target is visible, bool, shape (...).
      target_pose: x, y [m] and yaw [rad] in the world, shape (..., 3); arbitrary if it is not visible.
      confidence: the probability that each object is where it is and as it is, to 1 cm and 10 degrees, shape (..., N);
        see `perception.confidence`. 1 for true shapes, 0 for absent objects; None if nothing says how sure they are.
      measured: the share of each pixel of a coarse image that was measured, see `images.measured.measured_share`, shape
        (..., h, w); None if everything was. Where nothing was measured the target, and anything else, may be.
    """

    objects: Superquadrics
    target_visible: jax.Array
    target_pose: jax.Array
    confidence: jax.Array | None = None
    measured: jax.Array | None = None

    def judged(self) -> Observation:
        """The same observation with a confidence: 1 for every object if there is none."""
        if self.confidence is not None:
            return self
        return self.replace(confidence=jnp.asarray(self.objects.valid).astype(jnp.float32))

    def with_boxes(self) -> Observation:
        """The same observation with every box described as one; see `superquadric.as_boxes`. Whatever reads an
        observation that somebody else made begins with it."""
        # Nearly always there is nothing to do, which outside of transformations needs no program.
        return self.replace(objects=_with_boxes(self.objects)) if _may_turn(self.objects) else self


def _may_turn(objects: Superquadrics) -> bool:
    """Whether a box may be described otherwise; True where that is not known yet."""
    described = objects.exponents if objects.parts is None else objects.parts.exponents
    return isinstance(described, Tracer) or bool(np.any(np.asarray(described)[..., 1] > 2.0 - ROUND_EXPONENT))


@cached_jit()
def _with_boxes(objects: Superquadrics) -> Superquadrics:
    return as_boxes(objects)
