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
    from mechsearch_jax.actions.registry import ActionKind
    from mechsearch_jax.actions.trajectory import JointTrajectory, joint_trajectory
    from mechsearch_jax.actions.types import Action
    from mechsearch_jax.belief.belief import Belief, initial_belief, update_belief
    from mechsearch_jax.config.config import Config
    from mechsearch_jax.config.presets import paper, standard
    from mechsearch_jax.geometry.superquadric import Superquadrics
    from mechsearch_jax.images.examples import example_images
    from mechsearch_jax.observation import Observation
    from mechsearch_jax.perception.recogniser import Recogniser
    from mechsearch_jax.planner.policies import Policy, random_action, search_and_grasp, search_for_grasp
    from mechsearch_jax.planner.state import Decision
    from mechsearch_jax.problem.cache import cached_problem, keep_compilations
    from mechsearch_jax.problem.problem import Problem, build_problem
    from mechsearch_jax.problem.settings import Settings, load_settings
    from mechsearch_jax.problem.workcell import Workcell
    from mechsearch_jax.robot.arm_config import ArmConfig
    from mechsearch_jax.robot.gripper import Gripper
    from mechsearch_jax.robot.hand import HandConfig
    from mechsearch_jax.robot.robot_trajectory import RobotTrajectory
    from mechsearch_jax.runtime.errors import InputError
    from mechsearch_jax.session.searcher import Searcher
    from mechsearch_jax.session.step import SearchStep
    from mechsearch_jax.session.whole_trajectory import whole_trajectory
    from mechsearch_jax.workspace.camera import Camera
    from mechsearch_jax.workspace.render import render_depth
    from mechsearch_jax.workspace.scenario import load_scenario
    from mechsearch_jax.workspace.shelf import Shelf
    from mechsearch_jax.workspace.target import Target

# Where each name lies.
_ROOMS = {
    "Action": "actions.types",
    "ActionKind": "actions.registry",
    "ArmConfig": "robot.arm_config",
    "Belief": "belief.belief",
    "Camera": "workspace.camera",
    "Config": "config.config",
    "Decision": "planner.state",
    "Gripper": "robot.gripper",
    "HandConfig": "robot.hand",
    "InputError": "runtime.errors",
    "JointTrajectory": "actions.trajectory",
    "Observation": "observation",
    "Policy": "planner.policies",
    "Problem": "problem.problem",
    "Recogniser": "perception.recogniser",
    "RobotTrajectory": "robot.robot_trajectory",
    "SearchStep": "session.step",
    "Searcher": "session.searcher",
    "Settings": "problem.settings",
    "Shelf": "workspace.shelf",
    "Superquadrics": "geometry.superquadric",
    "Target": "workspace.target",
    "Workcell": "problem.workcell",
    "build_problem": "problem.problem",
    "cached_problem": "problem.cache",
    "example_images": "images.examples",
    "initial_belief": "belief.belief",
    "joint_trajectory": "actions.trajectory",
    "keep_compilations": "problem.cache",
    "load_scenario": "workspace.scenario",
    "load_settings": "problem.settings",
    "paper": "config.presets",
    "random_action": "planner.policies",
    "render_depth": "workspace.render",
    "search_and_grasp": "planner.policies",
    "search_for_grasp": "planner.policies",
    "standard": "config.presets",
    "update_belief": "belief.belief",
    "whole_trajectory": "session.whole_trajectory",
}

__all__ = [
    "Action",
    "ActionKind",
    "ArmConfig",
    "Belief",
    "Camera",
    "Config",
    "Decision",
    "Gripper",
    "HandConfig",
    "InputError",
    "JointTrajectory",
    "Observation",
    "Policy",
    "Problem",
    "Recogniser",
    "RobotTrajectory",
    "SearchStep",
    "Searcher",
    "Settings",
    "Shelf",
    "Superquadrics",
    "Target",
    "Workcell",
    "build_problem",
    "cached_problem",
    "example_images",
    "initial_belief",
    "joint_trajectory",
    "keep_compilations",
    "load_scenario",
    "load_settings",
    "paper",
    "random_action",
    "render_depth",
    "search_and_grasp",
    "search_for_grasp",
    "standard",
    "update_belief",
    "whole_trajectory",
]


def __getattr__(name: str) -> Any:
    if name not in _ROOMS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(_importlib.import_module(f"{__name__}.{_ROOMS[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
