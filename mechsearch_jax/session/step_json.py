"""A step as JSON values, for robots that another program drives.

Lengths in metres, angles in radians, everything in the frame of the robot's base (x into the shelf, y to the left, z
up). Poses are rows of 4 x 4 matrices.
"""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from mechsearch_jax.actions.registry import kind_of
from mechsearch_jax.actions.types import Action
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.robot.hand import HandEvent
from mechsearch_jax.robot.kinematics import FINGER_TIPS
from mechsearch_jax.workspace.scenario import format_compound

if TYPE_CHECKING:
    from mechsearch_jax.session.step import SearchStep


def step_json(step: SearchStep) -> dict[str, Any]:
    """Everything of a step but its trajectory's rows, without NaN."""
    acts = step.trajectory is not None
    return {
        "index": step.index,
        "kind": step.kind,
        "reason": step.reason,
        "warnings": list(step.warnings),
        "motion": dataclasses.asdict(step.trajectory.report()) if step.trajectory is not None else None,
        "cost": _number(step.decision.cost),
        "predicted_cost": _number(step.decision.predicted_cost),
        "least_cost": _number(step.decision.least_cost),
        "poses": int(np.sum(np.asarray(step.belief.exists))),
        "found": bool(step.belief.found),
        "objects": _objects(step),
        "target": _target(step),
        "action": _action(step.decision.action) if acts else None,
        "hand": _hand(step.decision.action) if acts else None,
        "gripper": [_event(event) for event in step.trajectory.events] if step.trajectory is not None else None,
    }


def _number(value: Any) -> float | None:
    return float(value) if math.isfinite(float(value)) else None


def _list(array: Any) -> list[Any]:
    return np.asarray(array, float).tolist()


def _is_finite(scene: Superquadrics) -> np.ndarray:
    """Which objects have finite shapes and poses; a warning names the others."""
    fields = jax.tree.leaves(scene.replace(valid=None))
    finite = [np.isfinite(np.asarray(field)).reshape(scene.capacity, -1).all(axis=1) for field in fields]
    return np.logical_and.reduce(finite)


def _objects(step: SearchStep) -> list[dict[str, Any]]:
    """The recognised objects; `slot` is what an action's `object` refers to.

    Bodies of several parts have `parts`, in their own frames, and `size` and `exponents` of what bounds these.
    """
    from scipy.spatial.transform import Rotation

    scene, confidence = step.observation.objects, np.asarray(step.observation.judged().confidence)
    return [
        {
            "slot": i,
            "size": _list(scene.size[i]),
            "exponents": _list(scene.exponents[i]),
            "position": _list(scene.position[i]),
            "rotation": _list(scene.rotation[i]),
            "quaternion": np.roll(Rotation.from_matrix(np.asarray(scene.rotation[i], float)).as_quat(), 1).tolist(),
            "confidence": round(float(confidence[i]), 3),
            **_parts(scene, i),
        }
        for i in np.flatnonzero(np.asarray(scene.valid) & _is_finite(scene)).tolist()
    ]


def _parts(scene: Superquadrics, index: int) -> dict[str, Any]:
    """The parts of a body, if bodies have parts."""
    if (parts := scene.parts) is None:
        return {}
    there = np.flatnonzero(np.asarray(parts.valid[index])).tolist()
    names = ("size", "exponents", "position", "rotation")
    return {"parts": [{name: _list(getattr(parts, name)[index, p]) for name in names} for p in there]}


def _target(step: SearchStep) -> dict[str, Any]:
    """The target and the belief about it; poses are x, y [m] and yaw [rad]."""
    visible, found = bool(step.observation.target_visible), bool(step.belief.found)
    target = step.problem.target
    return {
        "shape": target.shape,
        "half_size": list(target.half_size),
        **({} if target.compound is None else {"pieces": format_compound(target.compound)["pieces"]}),
        "visible": visible,
        "pose": _list(step.observation.target_pose) if visible else None,
        "found": found,
        "found_pose": _list(step.belief.found_pose) if found else None,
        "T_world_target": _list(step.belief.grasps.T_world_target) if found else None,
        "belief_size": 0 if found else int(np.sum(np.asarray(step.belief.exists))),
    }


def _action(action: Action) -> dict[str, Any]:
    """The action as recorded in episodes."""
    kind = kind_of(int(action.kind))
    return {
        "kind": kind.name,
        "object": int(action.object) if kind.moves_object else None,
        "T_world_gripper": _list(action.T_world_gripper),
        "displacement": _list(action.displacement),
        "T_world_place": _list(action.T_world_place),
        "q7": float(action.q7),
        "opening": float(action.opening),
    }


def _event(event: HandEvent) -> dict[str, Any]:
    """What the hand does, when [s], and how [m, m/s, N]."""
    return {"kind": event.kind, **dataclasses.asdict(event)}


def _hand(action: Action) -> dict[str, Any]:
    """First and last pose of the Panda's hand frame, whose origin lies behind the gripper's along their common z."""
    back = np.eye(4)
    back[2, 3] = -FINGER_TIPS
    first, last = (np.asarray(T, float) @ back for T in (action.T_world_gripper, action.T_world_place))
    return {"T_world_hand": first.tolist(), "T_world_hand_end": last.tolist()}
