"""What files of earlier versions say of the options of an episode."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

# An option's name then, and its name now.
RENAMED: Mapping[str, str] = {
    "method": "policy",
    "caution": "unseen_contact_penalty",
    "focus": "guided_fraction",
    "give": "contact_tolerance",
    "jam": "max_penetration",
    "kinds": "actions",
}
# What options that files of earlier versions do not hold were then.
EARLIER: Mapping[str, Any] = {
    "protocol": "strict",
    "push_model": "quasi-static",
    "rehearsal": "none",
    "crowding_weight": 0.02,
    "draws": 1,
    "first_draws": 1,
    "move_again": False,
    "move_target": False,
    "predicted_collisions": False,
    "imitates": "nothing",
    "avoid_unseen": True,
    "cell_reach": [0.5],
    "closer_look": 0,
    "erosion": 0.0,
    "reopen": False,
    "push_directions": [math.radians(angle) for angle in (90, -90)],
    "grasp_tilts": [math.radians(angle) for angle in (20, 25, 30)],
    "retrieval_tilts": [math.radians(angle) for angle in (20, 22.5, 25, 27.5, 30)],
    "object_grasp_tilts": [math.radians(angle) for angle in (20, 30)],
}
# Options that there are no longer, and the value with which an episode ran then as all do now. An episode that ran with
# another goes on saying it: it is not like today's.
GONE: Mapping[str, Any] = {
    "topple_charge": 0.0,
    "high_pushes": 0.0,
    "hindrance_weight": 1.0,
    "later_draws": "predicted",
    "later_placements": True,
}
# What some of these said of an episode with the planner of preset `published-code`, which one option says today.
_PUBLISHED: Mapping[str, Any] = {"hindrance_weight": 0.1, "later_draws": "present", "later_placements": False}
# When there were two kinds of action, their set was a word.
_KINDS: Mapping[str, list[str]] = {
    "both": ["push", "pick-and-place"],
    "push": ["push"],
    "pick-and-place": ["pick-and-place"],
}


def present_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """The options of an episode by their present names and in their present form, whichever version wrote them."""
    present = {**EARLIER, **{RENAMED.get(name, name): value for name, value in options.items()}}
    if all(present.get(name) == value for name, value in _PUBLISHED.items()):
        present = {name: value for name, value in present.items() if name not in _PUBLISHED}
        present["imitates"] = "published-code"
    if isinstance(present.get("actions"), str):
        present["actions"] = _KINDS.get(present["actions"], present["actions"])
    return {name: value for name, value in present.items() if name not in GONE or value != GONE[name]}
