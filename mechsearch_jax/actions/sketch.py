"""What a picture shows of an action, in the world frame and independent of how it is drawn.

For every kind of action, objects that are predicted to move are drawn where they end.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float


@dataclasses.dataclass(frozen=True)
class Sketch:
    """Lines in the world; every part may be missing.

    Attributes:
      hands: poses of the gripper, first where the action begins, shape (k, 4, 4) [m].
      opening: distance between its fingers [m].
      path: path of the hand or of the object in it, drawn as an arrow, shape (points, 3) [m].
      takes_target: whether the target moves along the path.
    """

    hands: Float[np.ndarray, "k 4 4"] | None = None
    opening: float = 0.0
    path: Float[np.ndarray, "points 3"] | None = None
    takes_target: bool = False
