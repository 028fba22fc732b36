"""Retrieval models by name, as policies take them."""

from __future__ import annotations

import functools

from mechsearch_jax.errors import InputError
from mechsearch_jax.planner.retrieval import RetrievalModel


@functools.cache
def retrieval_model(name: str) -> RetrievalModel | None:
    """The retrieval model of a name; the same object for the same name, so that nothing is compiled twice.

    Args:
      name: "physics", which simulates, or "collision-free": None, grasps that hit nothing.

    Raises:
      InputError: there is none of that name.
    """
    if name == "collision-free":
        return None
    if name != "physics":
        raise InputError(f'retrieval model "{name}" is unknown; use collision-free, physics')
    # Where it is not asked for, the simulator is not imported.
    from mechsearch_jax.envs.physics_retrieval import NativeRetrieval

    return NativeRetrieval()
