"""Trials by name: the simulation in which actions are tried before one is made."""

from __future__ import annotations

import functools

from mechsearch_jax.planner.trials import Trials
from mechsearch_jax.runtime.errors import InputError


@functools.cache
def named_trials(name: str, arm_stop: float = 0.0) -> Trials | None:
    """The `Trials` of a name; the same object for the same arguments.

    Args:
      name: "physics" for a simulation, "learning" for one that learns the friction as the search goes, "none" for None.
      arm_stop: error of a joint at which the robot's controller stops the arm [rad], for "learning"; 0 if it has none.

    Raises:
      InputError: there is nothing of that name.
    """
    if name == "none":
        return None
    if name not in ("physics", "learning"):
        raise InputError(f'trials "{name}" is unknown; use none, physics, learning')
    # Imported here so that "none" does without the simulator.
    from mechsearch_jax.envs.trials.learning import LearningTrials
    from mechsearch_jax.envs.trials.native import NativeTrials

    if name == "physics":
        return NativeTrials()
    return LearningTrials(arm_stop=arm_stop) if arm_stop else LearningTrials()
