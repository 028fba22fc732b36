"""What to do next, and why, in words and in a picture."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from mechsearch_jax.actions.registry import ActionKind, kind_of
from mechsearch_jax.actions.sketch import Sketch
from mechsearch_jax.actions.trajectory import JointTrajectory, joint_trajectory
from mechsearch_jax.errors import InputError
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner.belief import Belief, graspability_map
from mechsearch_jax.planner.impasse import impasse
from mechsearch_jax.planner.problem import Problem
from mechsearch_jax.planner.state import Decision
from mechsearch_jax.viz.filmstrip import Frame, filmstrip


@dataclasses.dataclass(frozen=True, eq=False)
class SearchStep:
    """What to do next, and why.

    Attributes:
      index: how many actions were taken before.
      kind: name of the kind of action: "push", "pick-and-place", "retrieve", or "none" where nothing is possible.
      reason: what is to be done and what for, or why nothing can be, in one line.
      warnings: what does not fit, a line each; empty where all is well.
      trajectory: the motion; None where there is no action.
      observation, belief, decision: everything behind it.
      problem: what it was decided for.
      image: what was seen, uint8 (H, W, 3): the colour image, or the depth as shades of grey.
    """

    index: int
    kind: str
    reason: str
    warnings: tuple[str, ...]
    trajectory: JointTrajectory | None
    observation: Observation
    belief: Belief
    decision: Decision
    problem: Problem
    image: np.ndarray

    @functools.cached_property
    def picture(self) -> Figure:
        """What was seen, where the target can be and how it could be grasped there, and the action."""
        objects, after = (jax.tree.map(np.asarray, s) for s in (self.observation.objects, self.decision.predicted))
        action, found = self.decision.action, bool(self.belief.found)
        kind, moves = kind_of(int(action.kind)), self.trajectory is not None
        possible = np.asarray(self.belief.exists)
        frame = Frame(
            title=f"{self.index + 1}  {kind.describe(action, objects.capacity) if moves else 'nothing to be done'}",
            caption=self.reason,
            image=self.image,
            owner=np.full(self.image.shape[:2], -1),
            scene=objects,
            existence=np.zeros_like(possible) if found else possible,
            graspability=np.asarray(graspability_map(self.problem, self.belief, self.observation.objects)),
            target_pose=np.asarray(self.belief.found_pose) if found else None,
            found=found,
            after=after,
            sketch=kind.sketch(objects, after, action) if moves else Sketch(),
        )
        heading = "; ".join(self.warnings) or "What the robot sees, and what it is to do"
        return filmstrip([frame], self.problem.camera, self.problem.shelf, self.problem.target, heading)


def motion(
    problem: Problem, belief: Belief, observation: Observation, decision: Decision
) -> tuple[str, str, JointTrajectory | None]:
    """The name of the kind of action, why it is taken or none is, and its motion."""
    kind = kind_of(int(decision.action.kind))
    found = bool(belief.found)
    known = "the target is found" if found else f"the target can be at {int(jnp.sum(belief.exists))} poses"
    if kind.code == ActionKind.NONE:
        return kind.name, f"{known}; {impasse(problem, belief, observation.objects)}", None
    does = kind.describe(decision.action, observation.objects.capacity)
    try:
        trajectory = joint_trajectory(problem, decision.action)
    except InputError as error:
        return kind_of(ActionKind.NONE).name, f"{known}; {does}: {error}", None
    if kind.takes_target:
        return kind.name, f"{known}; {does}: a grasp is known that meets nothing", trajectory
    cost = f"cost {float(decision.cost):.0f}, {float(decision.predicted_cost):.0f} expected afterwards"
    return kind.name, f"{known}; {does}: {cost}", trajectory


def shown(depth: np.ndarray, colour: Any) -> np.ndarray:
    """What was seen, as an image of 8 bits a channel."""
    if colour is not None:
        image = np.asarray(colour)
        return image if image.dtype == np.uint8 else np.round(255 * image).astype(np.uint8)
    measured = np.isfinite(depth) & (depth > 0)
    low, high = np.percentile(depth[measured], (1, 99)) if measured.any() else (0.0, 1.0)
    with np.errstate(invalid="ignore"):
        shade = np.clip((high - depth) / max(high - low, 1e-6), 0.0, 1.0) * 200 + 30
    grey = np.where(measured, shade, 0.0).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=-1)
