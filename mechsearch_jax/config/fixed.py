"""Options of stored rows that this version has no more: what they are fixed at, or what they are called now."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

# What stands in options of a row or an episode for all that preset `paper` has otherwise and is no option.
AS_IN_PAPER = "as_in_paper"


class Fixed(NamedTuple):
    """What an option is fixed at.

    Attributes:
      value: in preset `standard`, as JSON has it.
      in_paper: in preset `paper`.
    """

    value: Any
    in_paper: Any


def _degrees(*angles: int) -> list[float]:
    return [math.radians(angle) for angle in angles]


# By the option's name, as files and rows of results have it.
FIXED: Mapping[str, Fixed] = {
    "protocol": Fixed("strict", "strict"),
    "imitates": Fixed("nothing", "nothing"),
    "unseen_contact_penalty": Fixed(1.0, 0.0),
    "guided_fraction": Fixed(0.7, 0.0),
    "crowding_weight": Fixed(0.02, 0.0),
    "draws": Fixed(1, 8),
    "first_draws": Fixed(4, 1),
    "move_again": Fixed(False, True),
    "predicted_collisions": Fixed(False, True),
    "avoid_unseen": Fixed(True, False),
    "criterion": Fixed("detector", "depth-mse"),
    "cell_reach": Fixed([1.0], [0.5]),
    "closer_look": Fixed(3, 0),
    "erosion": Fixed(0.0, 0.0),
    "reopen": Fixed(True, False),
    "grasp_max_yaw": Fixed(math.radians(45), math.radians(45)),
    "grasp_tilts": Fixed(_degrees(20, 25, 30), _degrees(20)),
    "retrieval_max_yaw": Fixed(math.radians(75), math.radians(45)),
    "retrieval_tilts": Fixed(_degrees(20, 25, 30), _degrees(20)),
    "object_grasp_tilts": Fixed(_degrees(10, 20, 30), _degrees(20)),
    "object_grasp_max_yaw": Fixed(math.radians(90), math.radians(45)),
}


# What options are called now, by the names that rows of earlier versions have.
RENAMED: Mapping[str, str] = {
    "rehearsal": "trials",
    "color_noise": "colour_noise",
    "color": "colour",
    "colors": "colours",
}


def renamed(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options of a row or an episode of an earlier version, by the names that this version has."""
    prefixed = {f"mismatch.{former}": f"mismatch.{new}" for former, new in RENAMED.items()}
    return {{**RENAMED, **prefixed}.get(name, name): value for name, value in options.items()}


def without_fixed(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options of a row or an episode of an earlier version, as this version has them.

    What is fixed now is left out where it had the value that it has in a preset, and `AS_IN_PAPER` says in which.
    """
    options = renamed(options)
    former = {name: value for name, value in options.items() if name in FIXED}
    rest = {name: value for name, value in options.items() if name not in FIXED}
    if not former:
        return rest
    if any(value != FIXED[name].value for name, value in former.items()) and all(
        value == FIXED[name].in_paper for name, value in former.items()
    ):
        return {AS_IN_PAPER: True, **rest}
    others = {name: value for name, value in former.items() if value != FIXED[name].value}
    return {AS_IN_PAPER: False, **rest, **others}
