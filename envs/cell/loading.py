"""A searcher for a real cell from its configuration file, planning as `mechsearch search` does.

    from mechsearch_jax.envs.cell.loading import load_searcher

    searcher = load_searcher("mine.toml")

Trials and push model of the configuration are built here, since they may need the simulator, which the planner must
not import.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.perception.recogniser import Recogniser
from mechsearch_jax.problem.cache import keep_compilations
from mechsearch_jax.problem.problem import Problem
from mechsearch_jax.problem.settings import Settings, load_settings
from mechsearch_jax.robot.arm_config import ArmModel
from mechsearch_jax.runtime.files import PathLike
from mechsearch_jax.session.searcher import Searcher
from mechsearch_jax.session.step import View
from mechsearch_jax.session.whole_trajectory import TrajectoryConfig
from mechsearch_jax.workspace.camera import Camera


def load_searcher(
    path: PathLike | None = None,
    *,
    camera: Camera | None = None,
    arm: ArmModel | None = None,
    policy: str = "search-for-grasp",
    preset: str | None = None,
    seed: int = 0,
    recogniser: Callable[[Problem], Any] = Recogniser,
    trajectories: TrajectoryConfig | None = None,
    view: View | None = None,
    keep: bool = True,
    **options: Any,
) -> Searcher:
    """A `Searcher` with the workcell and all planner options of a configuration file.

    It plans as `mechsearch search` does with that file, including its push model, trials and `max_steps`, but takes the
    target out without touching other objects unless `retrieval_contact` is given. Compiled functions and the problem
    are kept on disk, so that the next process starts in seconds.

    Args:
      path: of the file; all defaults if None.
      camera: replaces the file's, for example one of `images.image_files.load_camera`.
      arm: replaces the file's model of the arm.
      policy: name or import path, as `--policy` of the command line.
      preset: replaces the file's.
      seed: of all random numbers.
      recogniser, trajectories, view: as for a `Searcher`.
      keep: whether this process keeps what it compiles from now on; see `keep_compilations`.
      **options: planner options that override the file's, such as `trials="none"`.

    Raises:
      InputError: the file cannot be used, an option is impossible, or the camera does not see the shelf.
    """
    settings = Settings() if path is None else load_settings(path)
    if keep:
        keep_compilations()
    return searcher_of(
        settings.with_options(preset, **options),
        camera=camera,
        arm=arm,
        policy=policy,
        seed=seed,
        recogniser=recogniser,
        trajectories=trajectories,
        view=view,
    )


def searcher_of(
    settings: Settings,
    *,
    camera: Camera | None = None,
    arm: ArmModel | None = None,
    policy: str = "search-for-grasp",
    **arguments: Any,
) -> Searcher:
    """A `Searcher` of settings, without retrievals that touch other objects if `retrieval_contact` is not given.

    Args:
      settings: of a configuration file.
      camera, arm, policy: as for `load_searcher`.
      **arguments: of a `Searcher`: seed, recogniser, trajectories, view.

    Raises:
      InputError: as `load_searcher`.
    """
    workcell = settings.workcell
    if camera is not None:
        workcell = dataclasses.replace(workcell, camera=camera)
    if arm is not None:
        workcell = workcell.with_arm(arm)
    # A robot touches nothing on purpose that is not to be moved, unless it is said that it may.
    config = settings.with_options(**{"retrieval_contact": False, **settings.given}).config
    method = Method(policy, config, workcell=workcell)
    return Searcher(workcell, config, policy=method.policy(), trials=method.trials(), **arguments)
