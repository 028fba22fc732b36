"""The feasible pairs of a candidate pose and a grasp as tables of fixed shapes."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Array, Bool, Float, Int

# The numbers of feasible pairs in all, and at a pose, are rounded up to multiples of these.
PAIRS_STEP, POSE_STEP = 1024, 8
# Of a target of pieces a pose has so many pairs at most, and all poses together half as many each on average; and the
# same for one that is a solid of revolution. Fixed numbers, so that all such targets share their programs.
PIECES_PAIRS, ROUND_PAIRS = 16, 32
# Where the gripper is in rows that hold no grasp: out of the arm's reach [m].
NO_GRASP = 10.0


def filled_up(
    T_target_gripper: Float[Array | np.ndarray, "g 4 4"], wrist: Int[np.ndarray, " g"], rows: int
) -> tuple[Float[np.ndarray, "rows 4 4"], Int[np.ndarray, " rows"]]:
    """Grasps with as many rows as others have; those beyond the given ones are feasible nowhere."""
    T = np.asarray(T_target_gripper)
    none = T[-1:].copy()
    none[:, 2, 3] = -NO_GRASP
    missing = rows - len(T)
    return np.concatenate([T, np.repeat(none, missing, axis=0)]), np.pad(wrist, (0, missing), mode="edge")


def is_grasp(T_target_gripper: Float[Array | np.ndarray, "g 4 4"]) -> Bool[np.ndarray, " g"]:
    """Which of the rows of `filled_up` hold a grasp."""
    return np.asarray(T_target_gripper)[:, 2, 3] > -0.5 * NO_GRASP


def pair_tables(able: Bool[np.ndarray, "x g"], most: int | None = None) -> dict[str, Any]:
    """The fields of `graspability.CandidateGrasps` for the feasible pairs of a candidate pose and a grasp.

    Args:
      able: which grasps are feasible at which poses.
      most: room for pairs at a pose; there are half as many rows in all on average. The least in steps if None.
    """
    pose, grasp = np.nonzero(able if most is None else thinned(able, most))
    poses = len(able)
    count = np.bincount(pose, minlength=poses)
    place = np.arange(len(pose)) - np.repeat(np.cumsum(count) - count, count)
    width, rows = int(count.max(initial=0)), len(pose) + -len(pose) % PAIRS_STEP
    width = width + -width % POSE_STEP
    if most is not None:
        rows, width = poses * most // 2, most
    pose_pairs = np.full((poses, width), rows, np.int32)
    pose_pairs[pose, place] = np.arange(len(pose))
    return {
        "pair_pose": np.int32(np.pad(pose, (0, rows - len(pose)), mode="edge") if len(pose) else pose),
        "pair_grasp": np.int32(np.pad(grasp, (0, rows - len(pose)), mode="edge") if len(pose) else grasp),
        "pair_valid": np.arange(rows if len(pose) else 0) < len(pose),
        "pose_pairs": pose_pairs,
    }


def thinned(able: Bool[np.ndarray, "x g"], most: int) -> Bool[np.ndarray, "x g"]:
    """Feasible pairs of poses and grasps, at most `most` at a pose and half as many on average.

    What is left out lies evenly between what stays: neighbouring grasps are alike.
    """
    count, room = able.sum(axis=1), len(able) * most // 2
    while np.minimum(count, most).sum() > room:
        most -= 1
    kept = np.minimum(count, most)
    rank = np.cumsum(able, axis=1) - 1
    # Of `count` in order, those where the number of the kept ones so far rises.
    share = kept[:, None] / np.maximum(count, 1)[:, None]
    return able & (np.floor((rank + 1) * share + 1e-9) > np.floor(rank * share + 1e-9))
