"""Sizes of the objects of generated scenes."""

from __future__ import annotations

import dataclasses

from mechsearch_jax.runtime.errors import InputError

# Bounds of an object's lengths [m].
LEAST, LARGEST = 0.001, 1.0


@dataclasses.dataclass(frozen=True)
class ObjectSizes:
    """Sizes from which the objects of generated scenes are drawn [m]; by default the paper's eleven objects.

    Attributes:
      boxes: full sizes in x, y and z; x and y may be swapped.
      cylinders: radius and height.
    """

    boxes: tuple[tuple[float, float, float], ...] = (
        (0.104, 0.058, 0.076),
        (0.084, 0.036, 0.07),
        (0.06, 0.024, 0.12),
        (0.108, 0.05, 0.108),
        (0.096, 0.056, 0.16),
        (0.156, 0.044, 0.192),
    )
    cylinders: tuple[tuple[float, float], ...] = (
        (0.034, 0.214),
        (0.032, 0.134),
        (0.032, 0.122),
        (0.024, 0.134),
        (0.028, 0.06),
    )

    def __post_init__(self):
        if not self.boxes and not self.cylinders:
            raise InputError("ObjectSizes: boxes and cylinders are both empty; give at least one size")
        for name in ("boxes", "cylinders"):
            for size in getattr(self, name):
                if not all(LEAST <= length <= LARGEST for length in size):
                    raise InputError(f"ObjectSizes: {name} {size} must be lengths in metres, {LEAST} to {LARGEST}")

    @property
    def catalogue(self) -> tuple[tuple[str, tuple[float, float, float]], ...]:
        """Shape and half-extents of every object [m]."""
        return (
            *(("box", (x / 2, y / 2, z / 2)) for x, y, z in self.boxes),
            *(("cylinder", (radius, radius, height / 2)) for radius, height in self.cylinders),
        )
