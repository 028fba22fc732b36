"""Checks whether a search is possible in the cell of a configuration file: one line for each part of the cell."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mechsearch_jax.envs.health.finding import Finding, State
from mechsearch_jax.images.trained_view import view_faults
from mechsearch_jax.perception.recogniser import Recogniser
from mechsearch_jax.problem.settings import Settings
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.session.searcher import LEAST_REACH
from mechsearch_jax.shapes import shape_of
from mechsearch_jax.workspace.sight import blindness, camera_faults, share_seen


def camera(settings: Settings) -> Iterator[Finding]:
    """Whether the camera sees the shelf."""
    seen_by, shelf = settings.workcell.camera, settings.workcell.shelf
    remedy = "mend [camera] position and rotation, or the focal lengths"
    if (fault := blindness(seen_by, shelf)) is not None:
        yield Finding("camera", State.BROKEN, fault, remedy)
        return
    for fault in camera_faults(seen_by, shelf):
        yield Finding("camera", State.DOUBTFUL, fault, remedy)
    share = share_seen(seen_by, shelf)
    yield Finding("camera", State.FINE, f"{seen_by.width} x {seen_by.height}, sees {100 * share:.0f}% of the board")


def target(settings: Settings) -> Iterator[Finding]:
    """Whether the target fits the gripper and the shelf."""
    cell = settings.workcell
    body, shelf, opening = cell.target, cell.shelf, cell.gripper.usable_opening
    grasps = settings.config.problem.grasps
    _, widths = shape_of(body.shape).grasps(body.half_size, grasps.yaws, grasps.max_yaw)
    size = " x ".join(f"{200 * half:.1f}" for half in body.half_size)
    if min(widths) > opening:
        says = f"target: {min(widths):.3f} m wide, but the gripper takes {opening} m"
        yield Finding("target", State.BROKEN, says, "mend [target] half_size, or [gripper] usable_opening")
    elif 2 * body.half_size[2] >= shelf.ceiling - shelf.ceiling_margin - shelf.board:
        says = f"target: {2 * body.half_size[2]:.3f} m high, more than the shelf's free space"
        yield Finding("target", State.BROKEN, says, "mend [target] half_size, or [shelf] board and ceiling")
    else:
        yield Finding("target", State.FINE, f"{body.shape}, {size} cm, fits gripper and shelf")


def shelf(settings: Settings) -> Iterator[Finding]:
    """The share of the target's possible poses that the arm reaches."""
    cell = settings.workcell
    remedy = "mend [shelf] front to ceiling, or [base] position: x into the shelf, z up, in the robot's frame"
    if blindness(cell.camera, cell.shelf) is not None:
        yield Finding("shelf", State.MISSING, "the arm's reach is not looked at before the camera sees the shelf")
        return
    try:
        problem = cell.problem(config=settings.config.problem)
    except InputError as error:
        yield Finding("shelf", State.BROKEN, str(error), remedy)
        return
    share = len(np.unique(np.asarray(problem.grasps.pair_pose))) / len(problem.poses)
    says = f"the arm can grasp the target at {100 * share:.0f}% of its {len(problem.poses)} possible poses"
    few = share < LEAST_REACH
    yield Finding("shelf", State.DOUBTFUL if few else State.FINE, says, remedy if few else "")


def networks(settings: Settings) -> Iterator[Finding]:
    """Whether the view is like those that the networks were trained on."""
    cell = settings.workcell
    if blindness(cell.camera, cell.shelf) is not None:
        yield Finding("networks", State.MISSING, "the view is not looked at before the camera sees the shelf")
        return
    try:
        trained = Recogniser(cell).trained
        faults = view_faults(cell.camera, cell.shelf, trained)
    except InputError as error:
        yield Finding("networks", State.BROKEN, str(error), "mend [camera]")
        return
    for fault in faults:
        yield Finding("networks", State.DOUBTFUL, fault, "see docs/method.md, Other cameras and shelves")
    if not faults:
        yield Finding("networks", State.FINE, f"the view is like that which {' and '.join(trained)} were trained on")


def planner(settings: Settings) -> Iterator[Finding]:
    """The planner's settings in this cell."""
    config = settings.config
    says = (
        f"preset {settings.preset}, trials {config.trials}, push model {config.push_model}, "
        f"at most {config.max_steps} actions"
    )
    yield Finding("planner", State.FINE, says)
