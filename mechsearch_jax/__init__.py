"""Mechanical search with superquadrics, in JAX: find and grasp a hidden object on a cluttered shelf.

    import jax, mechsearch_jax as ms

What stands in `__all__` is promised to users; everything else may change. A name is imported when it is first used, so
that a program only waits for what it needs.
"""

from __future__ import annotations

import importlib as _importlib
from pathlib import Path as _Path
from typing import TYPE_CHECKING, Any

# In a checkout, `mechsearch_jax.envs`, `train` and `benchmarks` lie beside this folder; installed, they lie in it.
if not (_Path(__file__).parent / "envs").is_dir():
    __path__.append(str(_Path(__file__).parents[1]))

if TYPE_CHECKING:
    from mechsearch_jax.actions.registry import ActionKind as ActionKind
    from mechsearch_jax.actions.trajectory import joint_trajectory as joint_trajectory
    from mechsearch_jax.belief.belief import (
        Belief as Belief,
    )
    from mechsearch_jax.belief.belief import (
        initial_belief as initial_belief,
    )
    from mechsearch_jax.belief.belief import (
        update_belief as update_belief,
    )
    from mechsearch_jax.config.presets import paper as paper
    from mechsearch_jax.config.presets import standard as standard
    from mechsearch_jax.geometry.superquadric import Superquadrics as Superquadrics
    from mechsearch_jax.images.examples import example_images as example_images
    from mechsearch_jax.images.measured import median_depth as median_depth
    from mechsearch_jax.observation import Observation as Observation
    from mechsearch_jax.perception.recogniser import Recogniser as Recogniser
    from mechsearch_jax.planner.policies import (
        Policy as Policy,
    )
    from mechsearch_jax.planner.policies import (
        search_and_grasp as search_and_grasp,
    )
    from mechsearch_jax.planner.policies import (
        search_for_grasp as search_for_grasp,
    )
    from mechsearch_jax.planner.state import Decision as Decision
    from mechsearch_jax.problem.cache import keep_compilations as keep_compilations
    from mechsearch_jax.problem.problem import Problem as Problem
    from mechsearch_jax.problem.problem import build_problem as build_problem
    from mechsearch_jax.problem.settings import load_settings as load_settings
    from mechsearch_jax.problem.workcell import Workcell as Workcell
    from mechsearch_jax.robot.arm_config import ArmConfig as ArmConfig
    from mechsearch_jax.robot.gripper import Gripper as Gripper
    from mechsearch_jax.robot.hand import HandConfig as HandConfig
    from mechsearch_jax.runtime.errors import InputError as InputError
    from mechsearch_jax.session.loop import run_search as run_search
    from mechsearch_jax.session.searcher import Searcher as Searcher
    from mechsearch_jax.session.whole_trajectory import whole_trajectory as whole_trajectory
    from mechsearch_jax.workspace.camera import Camera as Camera
    from mechsearch_jax.workspace.scenario import load_scenario as load_scenario
    from mechsearch_jax.workspace.shelf import Shelf as Shelf
    from mechsearch_jax.workspace.target import Target as Target

# Where each name lies: the imports above, for when the program runs.
_ROOMS = {
    "ActionKind": "actions.registry",
    "ArmConfig": "robot.arm_config",
    "Belief": "belief.belief",
    "Camera": "workspace.camera",
    "Decision": "planner.state",
    "Gripper": "robot.gripper",
    "HandConfig": "robot.hand",
    "InputError": "runtime.errors",
    "Observation": "observation",
    "Policy": "planner.policies",
    "Problem": "problem.problem",
    "Recogniser": "perception.recogniser",
    "Searcher": "session.searcher",
    "Shelf": "workspace.shelf",
    "Superquadrics": "geometry.superquadric",
    "Target": "workspace.target",
    "Workcell": "problem.workcell",
    "build_problem": "problem.problem",
    "example_images": "images.examples",
    "initial_belief": "belief.belief",
    "joint_trajectory": "actions.trajectory",
    "keep_compilations": "problem.cache",
    "load_scenario": "workspace.scenario",
    "load_settings": "problem.settings",
    "median_depth": "images.measured",
    "paper": "config.presets",
    "run_search": "session.loop",
    "search_and_grasp": "planner.policies",
    "search_for_grasp": "planner.policies",
    "standard": "config.presets",
    "update_belief": "belief.belief",
    "whole_trajectory": "session.whole_trajectory",
}

__all__ = list(_ROOMS)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _ROOMS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(_importlib.import_module(f"{__name__}.{_ROOMS[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
