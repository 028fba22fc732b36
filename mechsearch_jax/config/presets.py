"""Presets: named configurations."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

from mechsearch_jax.actions.config import ActionConfig
from mechsearch_jax.actions.kinds.object_grasps import ObjectGraspConfig
from mechsearch_jax.config.config import Config, PlannerConfig, ProblemConfig
from mechsearch_jax.existence import ExistenceConfig
from mechsearch_jax.grasping.config import GraspConfig
from mechsearch_jax.runtime.errors import InputError


def standard(**changes: Any) -> Config:
    """Our settings, the default; `docs/method.md` lists how they differ from the paper's.

    Args:
      **changes: options by name, see `Config.with_options`.
    """
    return Config().with_options(**changes)


def paper(**changes: Any) -> Config:
    """The paper's settings (appendices B.2 to B.5), and those of `standard` that it does not give, such as gamma.

    f compares depth images, is never reopened, and rules out collisions in predicted states, too; grasps are tilted by
    20 degrees; actions are drawn uniformly, until one is possible, of any object at any step; the cost is J alone.
    Depth images are those of `standard`: the paper's integral of an occupancy takes ten times as long, and changes f at
    less than 2% of the poses (docs/method.md, "Depth").

    Args:
      **changes: options by name, see `Config.with_options`.
    """
    tilts, max_yaw = (math.radians(20),), math.radians(45)
    problem = ProblemConfig(
        existence=ExistenceConfig(as_in_paper=True),
        grasps=GraspConfig(tilts=tilts),
        retrieval=dataclasses.replace(GraspConfig.dense(), tilts=tilts, max_yaw=max_yaw, turn=0.0),
        actions=ActionConfig(as_in_paper=True, grasps=ObjectGraspConfig(tilts=tilts, max_yaw=max_yaw)),
    )
    planner = PlannerConfig(as_in_paper=True, unseen_contact_penalty=0.0, guided_fraction=0.0, crowding_weight=0.0)
    settings = {
        "push_directions": (math.radians(90), math.radians(-90)),
        "push_distances": (0.05, 0.10, 0.15),
        "actions": ("push", "pick-and-place"),
        "move_target": False,
        "trials": "none",
        "horizon": 3,
        "sequences": 30,
    }
    return Config(problem, planner).with_options(**settings | changes)


PRESETS: Mapping[str, Callable[..., Config]] = {
    "standard": standard,
    "paper": paper,
}
DEFAULT_PRESET = "standard"

# The options that define the possible actions, not how they are chosen.
ACTION_OPTIONS = ("actions", "push_directions", "push_distances")


def action_set(name: str) -> dict[str, Any]:
    """The options that define the possible actions, from a preset."""
    options = PRESETS[name]().options()
    return {option: options[option] for option in ACTION_OPTIONS}


def expanded(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options by name, with the name of a preset in `actions` replaced by its options; other given options win.

    Raises:
      InputError: `actions` holds more than the preset's name.
    """
    sets = [name for name in options.get("actions", ()) if name in PRESETS]
    if not sets:
        return dict(options)
    if len(options["actions"]) > 1:
        raise InputError(f"actions: {sets[0]} is a whole set of actions; give it alone")
    return {**action_set(sets[0]), **{name: value for name, value in options.items() if name != "actions"}}
