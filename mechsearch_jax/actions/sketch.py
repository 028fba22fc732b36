"""What a picture shows of an action, in the world and without any knowledge of how it is drawn.

Objects that are predicted to move are drawn where they end, whatever the kind of action.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float


@dataclasses.dataclass(frozen=True)
class Sketch:
    """Lines in the world; every part may be missing.

    Attributes:
      hands: poses of the gripper, where it begins to act and then where else it acts, shape (k, 4, 4) [m].
      opening: distance between its fingers [m].
      path: what moves while it acts, drawn as an arrow, shape (points, 3) [m].
      takes_target: whether it is the target that moves along the path.
    """

    hands: Float[np.ndarray, "k 4 4"] | None = None
    opening: float = 0.0
    path: Float[np.ndarray, "points 3"] | None = None
    takes_target: bool = False
