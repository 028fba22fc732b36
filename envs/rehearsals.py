"""Rehearsals by name, as policies take them."""

from __future__ import annotations

import functools

from mechsearch_jax.errors import InputError
from mechsearch_jax.planner.rehearsal import Rehearsal


@functools.cache
def rehearsal(name: str) -> Rehearsal | None:
    """The rehearsal of a name; the same object for the same name, so that nothing is compiled twice.

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
    from mechsearch_jax.envs.physics_rehearsal import NativeRehearsal

    return NativeRehearsal()
