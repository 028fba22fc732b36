"""What tries actions out, by name."""

from __future__ import annotations

import functools

from mechsearch_jax.planner.trials import Trials
from mechsearch_jax.runtime.errors import InputError


@functools.cache
def rehearsal(name: str) -> Trials | None:
    """What tries actions out before one is made; the same object for the same name.

    Args:
      name: "physics", a simulation, or "none": None.

    Raises:
      InputError: there is none of that name.
    """
    if name == "none":
        return None
    if name != "physics":
        raise InputError(f'rehearsal "{name}" is unknown; use none, physics')
    # Where it is not asked for, the simulator is not imported.
    from mechsearch_jax.envs.trials.native import NativeTrials

    return NativeTrials()
