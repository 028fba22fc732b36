"""How far the shelf may appear from its place."""

from __future__ import annotations

import dataclasses
import math

from mechsearch_jax.runtime.errors import InputError, check_range
from mechsearch_jax.runtime.options import angle

# Largest limits [m], [rad].
FARTHEST, STEEPEST = 1.0, math.pi


@dataclasses.dataclass(frozen=True)
class CalibrationLimits:
    """How far the shelf in an image may be from where camera and shelf say that it is; hashable.

    Shifts are those of the corner of the board that is farthest off; the first also holds for each face against the
    others.

    Attributes:
      warn_shift, warn_turn: beyond this there is a warning [m], [rad].
      refuse_shift, refuse_turn: beyond this the image is refused [m], [rad].
    """

    warn_shift: float = 0.003
    warn_turn: float = angle(math.radians(0.4), least_degrees=0.05)
    refuse_shift: float = 0.01
    refuse_turn: float = angle(math.radians(1.5), least_degrees=0.05)

    def __post_init__(self):
        for name, most, unit in (("shift", FARTHEST, "m"), ("turn", STEEPEST, "rad")):
            warn, refuse = getattr(self, f"warn_{name}"), getattr(self, f"refuse_{name}")
            check_range(f"CalibrationLimits: warn_{name}", warn, 1e-4, most, unit)
            check_range(f"CalibrationLimits: refuse_{name}", refuse, 1e-4, most, unit)
            if refuse < warn:
                raise InputError(f"CalibrationLimits: refuse_{name} ({refuse}) must be at least warn_{name} ({warn})")
