"""Trials by name: the simulation in which actions are tried before one is made."""

from __future__ import annotations

import functools

from mechsearch_jax.planner.trials import Trials
from mechsearch_jax.runtime.errors import InputError


@functools.cache
def named_trials(name: str) -> Trials | None:
    """The `Trials` of a name; the same object for the same name.

    Args:
      name: "physics" for a simulation, "none" for None.

    Raises:
      InputError: there is nothing of that name.
    """
    if name == "none":
        return None
    if name != "physics":
        raise InputError(f'trials "{name}" is unknown; use none, physics')
    # Imported here so that "none" does without the simulator.
    from mechsearch_jax.envs.trials.native import NativeTrials

    return NativeTrials()
