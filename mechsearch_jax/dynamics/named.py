"""The push models that need no simulator, by name; `envs.pushing.push_models` knows them all."""

from __future__ import annotations

import functools
from typing import Literal, get_args

from mechsearch_jax.dynamics.push_model import PushModel
from mechsearch_jax.dynamics.quasi_static import QuasiStatic
from mechsearch_jax.runtime.errors import InputError

PushModelName = Literal["quasi-static", "learned", "physics"]


def check_name(name: str) -> None:
    """Check the name of a push model.

    Raises:
      InputError: it is unknown.
    """
    if name not in get_args(PushModelName):
        raise InputError(f'push model "{name}" is unknown; use {", ".join(get_args(PushModelName))}')


@functools.cache
def own_push_model(name: str) -> PushModel:
    """The push model of a name; the same object for the same name, so that nothing is compiled twice.

    Args:
      name: "quasi-static" or "learned".

    Raises:
      InputError: the name is unknown, the model needs a simulator, or its weights are missing or damaged.
    """
    check_name(name)
    if name == "physics":
        raise InputError(
            'push model "physics" needs a simulator; give the policy those of mechsearch_jax.envs.pushing.push_models'
        )
    if name == "quasi-static":
        return QuasiStatic()
    # Networks take long to import.
    from mechsearch_jax.dynamics.learned import LearnedPush

    try:
        return LearnedPush()
    except InputError as error:
        raise InputError(f'push model "learned" cannot be used: {error}; `mechsearch train push` makes them') from None
