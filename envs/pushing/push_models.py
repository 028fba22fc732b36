"""Push models by name, including those that need a simulator."""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax

from mechsearch_jax.dynamics.named import own_push_model
from mechsearch_jax.dynamics.push_model import PushModel
from mechsearch_jax.workspace.shelf import Shelf


class PushModels(NamedTuple):
    """The push models of a plan: `push_model` and `later_push_model` of a `planner.PolicyFactory`.

    Attributes:
      first: predicts pushes that are the first action of a sequence.
      later: predicts later pushes.
    """

    first: PushModel
    later: PushModel


@functools.cache
def push_models(name: str, shelf: Shelf | None = None) -> PushModels:
    """The push models of a name; the same objects for the same arguments, so that nothing is compiled twice.

    "physics" simulates every push on a GPU. On a CPU, where that would take too long, it simulates the first action of
    every sequence, and the network predicts later ones.

    Args:
      name: "quasi-static", "learned" or "physics".
      shelf: in which a GPU simulates; the default shelf if None. Other models work in any shelf.

    Raises:
      InputError: there is no model of that name, its weights are missing or damaged, or Warp cannot be imported.
    """
    if name != "physics":
        return PushModels(own_push_model(name), own_push_model(name))
    # Imported here so that other models do without the simulators.
    from mechsearch_jax.envs.pushing.physics_push import MjxPhysics, NativePhysics

    if jax.default_backend() == "cpu":
        return PushModels(NativePhysics(), own_push_model("learned"))
    simulated = MjxPhysics(shelf or Shelf())
    return PushModels(simulated, simulated)
