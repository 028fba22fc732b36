"""What a search needs of the simulator, by name.

Only here, and in `commands`, does this package look up to `envs`: when a search is made, so that importing the package
loads no simulator.
"""

from __future__ import annotations

from mechsearch_jax.dynamics.push_model import PushModel
from mechsearch_jax.planner.trials import Trials
from mechsearch_jax.workspace.shelf import Shelf


def trials(name: str) -> Trials | None:
    """The trials of a name; None for "none".

    Raises:
      InputError: there is nothing of that name.
    """
    from mechsearch_jax.envs.trials.named import named_trials

    return named_trials(name)


def push_models(name: str, shelf: Shelf) -> tuple[PushModel, PushModel]:
    """The push models of a name: for the first action of a sequence, and for later ones.

    Args:
      name: "quasi-static", "learned" or "physics".
      shelf: in which pushes are simulated.

    Raises:
      InputError: there is no model of that name, its weights are missing or damaged, or Warp cannot be imported.
    """
    from mechsearch_jax.envs.pushing.push_models import push_models as of_name

    return of_name(name, shelf)
