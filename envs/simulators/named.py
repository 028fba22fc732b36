"""Simulators by the names that episodes record."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Literal, get_args

from mechsearch_jax.envs.simulators.simulator import Simulator
from mechsearch_jax.problem.workcell import Workcell
from mechsearch_jax.runtime.errors import InputError

EngineName = Literal["NativeSimulator", "MjxSimulator"]


def _native(workcell: Workcell) -> Simulator:
    from mechsearch_jax.envs.simulators.native import NativeSimulator

    return NativeSimulator(shelf=workcell.shelf, camera=workcell.camera)


def _mjx(workcell: Workcell) -> Simulator:
    # Takes long to import, and is not always installed.
    from mechsearch_jax.envs.simulators.mjx_simulator import MjxSimulator

    return MjxSimulator(workcell.shelf, workcell.camera)


SIMULATORS: Mapping[EngineName, Callable[[Workcell], Simulator]] = {"NativeSimulator": _native, "MjxSimulator": _mjx}


def new_simulator(engine: EngineName, workcell: Workcell) -> Simulator:
    """A simulator of a workcell.

    Raises:
      InputError: there is none of that name, or it cannot be imported.
    """
    if engine not in SIMULATORS:
        raise InputError(f'simulator "{engine}" is unknown; use {" or ".join(get_args(EngineName))}')
    return SIMULATORS[engine](workcell)
