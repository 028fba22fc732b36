"""What a picture shows of an action, in the world and without any knowledge of how it is drawn."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float


@dataclasses.dataclass(frozen=True)
class Sketch:
    """Lines in the world; every part may be missing.

    Attributes:
      way_in: the way of the gripper before it acts, drawn dotted, shape (points, 3) [m].
      path: what moves while it acts, drawn as an arrow, shape (points, 3) [m].
      start: where it begins to act, drawn as a dot, shape (3,) [m].
      ghost: index of the object that is also drawn where it is predicted to end.
    """

    way_in: Float[np.ndarray, "points 3"] | None = None
    path: Float[np.ndarray, "points 3"] | None = None
    start: Float[np.ndarray, " 3"] | None = None
    ghost: int | None = None
