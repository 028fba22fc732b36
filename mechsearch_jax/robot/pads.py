"""What is between the pads of open fingers."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from mechsearch_jax.shapes.compound import Compound
from mechsearch_jax.shapes.union import Field, field_of

# Half the width of a finger's pad, how far it reaches before and behind the line between the tips [m], and lines across
# it either way.
PAD, PAD_FRONT, PAD_BACK, PAD_LINES = 0.0095, 0.006, 0.012, 5
# Steps along a line [m].
ALONG = 0.001


def _pad_lines(R_body_gripper: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch l 3"]:
    """Where lines across the pads start from the point between the finger tips [m]."""
    wide, deep = np.linspace(-PAD, PAD, PAD_LINES), np.linspace(-PAD_BACK, PAD_FRONT, PAD_LINES)
    places = np.stack(np.meshgrid(wide, deep, indexing="ij"), axis=-1).reshape(-1, 2)
    return places @ np.swapaxes(R_body_gripper[..., ::2], -1, -2)


def between(
    field: Field, R_body_gripper: Float[np.ndarray, "*batch 3 3"], point: Float[np.ndarray, "*batch 3"], opening: float
) -> tuple[Float[np.ndarray, "*batch l 2"], Float[np.ndarray, "*batch l 3"]]:
    """What is between open fingers: the first and last material on lines across the pads, from the middle of the
    fingers, NaN where there is none [m]; and where the lines start [m]."""
    across = R_body_gripper[..., None, None, :, 1]
    starts = point[..., None, :] + _pad_lines(R_body_gripper)
    lateral = np.arange(-opening / 2, opening / 2 + ALONG / 2, ALONG)
    material = np.less(field.at(starts[..., None, :] + lateral[:, None] * across), 0.0)
    there = np.any(material, axis=-1)
    ends = np.stack([lateral[material.argmax(axis=-1)], lateral[::-1][material[..., ::-1].argmax(axis=-1)]], axis=-1)
    return np.where(there[..., None], ends, np.nan), starts


def grip_between(compound: Compound, T_body_gripper: Float[np.ndarray, "4 4"], opening: float) -> tuple[float, float]:
    """Half of the width of what is between open fingers [m]: on the widest line across the pads, and between the pads
    as they come to rest; 0 where there is nothing."""
    ends, _ = between(field_of(compound), T_body_gripper[:3, :3], T_body_gripper[:3, 3], opening)
    if np.isnan(ends).all():
        return 0.0, 0.0
    return float(np.nanmax(ends[:, 1] - ends[:, 0])) / 2, float(np.nanmax(ends[:, 1]) - np.nanmin(ends[:, 0])) / 2
