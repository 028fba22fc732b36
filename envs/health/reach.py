"""At which of the target's poses no grasp is possible in an empty shelf, why, and whether other tilts would help."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator

import jax
import numpy as np
from jaxtyping import Bool, Int

from mechsearch_jax.geometry.transforms import compose
from mechsearch_jax.grasping.graspability import CandidateGrasps, GraspTables, feasible_grasps, grasp_tables
from mechsearch_jax.problem.problem import Problem
from mechsearch_jax.workspace.shelf import Shelf

FACES = {"back": "the back wall", "right": "the right wall", "left": "the left wall", "ceiling": "the upper board"}
# Angles by which the hand could point down beside those of the configuration [degrees].
OTHER_TILTS = tuple(range(0, 61, 10))
# So many parts of the board are named, of which at least this share of the worst part's share is lost.
PARTS, NAMED = 3, 0.5

# At which of the target's candidate poses, given by their indices, a shelf allows a grasp.
Able = Callable[[Shelf, Int[np.ndarray, " n"]], Bool[np.ndarray, " n"]]
_feasible = jax.jit(feasible_grasps, static_argnames=("gripper", "config"))


def lost_poses(problem: Problem) -> Iterator[str]:
    """A line for each reason why the target cannot be grasped at some of its poses, and one about other tilts."""
    lost = np.setdiff1d(np.arange(len(problem.poses)), np.asarray(problem.grasps.pair_pose))
    for why, rows in _causes(problem, lost).items():
        yield f"not at {len(rows)} of them: {why}; {_where(problem, rows)}"
    if len(lost):
        low, high = (round(float(np.rad2deg(of(problem.config.grasps.tilts)))) for of in (min, max))
        config = dataclasses.replace(problem.config.grasps, tilts=tuple(np.deg2rad(OTHER_TILTS).tolist()))
        able = _able(problem, grasp_tables(problem.gripper, problem.target, config))
        yield (
            f"a hand that points down by {OTHER_TILTS[0]} to {OTHER_TILTS[-1]}° instead of {low} to {high}° could grasp"
            f" it at {able(problem.shelf, lost).sum() or 'none'} of these {len(lost)}"
        )


def _causes(problem: Problem, lost: Int[np.ndarray, " n"]) -> dict[str, Int[np.ndarray, " m"]]:
    """The lost poses by the reason; reasons of none are left out."""
    able, shelf, causes = _able(problem, problem.grasps), problem.shelf, {}
    turned = ~_from_the_front(problem.grasps, lost)
    causes["the sides that fit between the fingers do not face the front"], lost = lost[turned], lost[~turned]
    # The same without each face, whose place is data: it compiles nothing anew.
    free = able(dataclasses.replace(shelf, faces=()), lost)
    causes["out of the arm's reach"], lost = lost[~free], lost[free]
    for face in shelf.faces:
        free = able(dataclasses.replace(shelf, faces=tuple(other for other in shelf.faces if other != face)), lost)
        causes[f"{FACES[face]} is in the way"], lost = lost[free], lost[~free]
    causes["several faces of the shelf are in the way"] = lost
    return {why: rows for why, rows in causes.items() if len(rows)}


def _from_the_front(tables: CandidateGrasps, rows: Int[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """At which poses a grasp comes from the front."""
    T = compose(tables.T_world_target[rows][:, None], tables.T_target_gripper[None])
    x, y = np.moveaxis(np.asarray(T)[..., :2, 2], -1, 0)
    return (x >= np.asarray(tables.ahead)[None] * np.hypot(x, y)).any(axis=1)


def _able(problem: Problem, tables: GraspTables) -> Able:
    def able(shelf: Shelf, rows: Int[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        if not len(rows):
            return np.zeros(0, bool)
        # Few shapes are compiled.
        poses = problem.grasps.T_world_target[np.resize(rows, 1 << len(rows).bit_length())]
        feasible = _feasible(tables, shelf, problem.gripper, problem.config.grasps, poses)
        return np.any(np.asarray(feasible)[: len(rows)], axis=1)

    return able


def _where(problem: Problem, rows: Int[np.ndarray, " n"]) -> str:
    """On which thirds of the board, and at which yaws, which share of the poses is among these."""
    poses, shelf = np.asarray(problem.poses), problem.shelf
    chosen = np.isin(np.arange(len(poses)), rows)
    x, y = (
        (poses[:, 0] - shelf.front) / (shelf.back - shelf.front),
        (poses[:, 1] - shelf.right) / (shelf.left - shelf.right),
    )
    part = 3 * np.clip(3 * x, 0, 2).astype(int) + np.clip(3 * y, 0, 2).astype(int)
    names = [f"{along} {across}" for along in ("front", "middle", "back") for across in ("right", "middle", "left")]
    shares = {name: float(chosen[part == i].mean()) for i, name in enumerate(names) if (part == i).any()}
    worst = sorted(shares, key=lambda name: -shares[name])[:PARTS]
    words = [f"{name} {shares[name]:.0%}" for name in worst if shares[name] >= NAMED * shares[worst[0]]]
    yaws = [(yaw, float(chosen[poses[:, 2] == yaw].mean())) for yaw in np.unique(poses[:, 2])]
    turned = ", ".join(f"{np.rad2deg(yaw):.0f}° {share:.0%}" for yaw, share in yaws)
    return f"of the board's {', '.join(words)}" + (f"; at yaw {turned}" if len(yaws) > 1 else "")
