"""A step of a search: what to do next and why, in words and as a picture."""

from __future__ import annotations

import dataclasses
import functools
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mechsearch_jax.actions.kind import Sketch
from mechsearch_jax.actions.registry import ActionKind, kind_of
from mechsearch_jax.belief.belief import Belief, graspability_map, sweeps_unmeasured
from mechsearch_jax.belief.impasse import hindrance, impasse
from mechsearch_jax.belief.unseen_motion import same_objects
from mechsearch_jax.grasping.retrieval import retrieval_hits
from mechsearch_jax.observation import Observation
from mechsearch_jax.perception.doubt import check_recognition
from mechsearch_jax.planner.state import Decision
from mechsearch_jax.planner.trials import TriedActions
from mechsearch_jax.problem.problem import Problem
from mechsearch_jax.robot.arm_clearance import FLOOR, SHELF, TARGET
from mechsearch_jax.robot.arm_config import ArmConfig
from mechsearch_jax.robot.robot_trajectory import RobotTrajectory
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.session.step_json import step_json
from mechsearch_jax.session.whole_trajectory import LEAST_SURE, TrajectoryConfig, whole_trajectory
from mechsearch_jax.workspace.camera import measured

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from mechsearch_jax.viz.filmstrip import Frame


class View(Protocol):
    """Shows a search while it runs, such as `envs.viewer.live.LiveView`.

    It is called in the thread of the search, which goes on when the call returns; what takes long belongs into another
    thread. It changes nothing of the search.
    """

    def decided(self, step: SearchStep, tried: TriedActions) -> None:
        """Show a step.

        Args:
          step: what `next` is about to return.
          tried: what trials came to before that decision; nothing without trials.
        """
        ...

    def acted(self, step: SearchStep, ok: bool) -> None:
        """Show that the motion of a step is over.

        Args:
          step: the last one that was shown.
          ok: the argument of `acted`.
        """
        ...


# Why no motion is made that would sweep space in which something may stand that has no depth.
UNMEASURED = (
    "on its way the hand, or what it moves, enters space of which nothing was measured: a thing without depth (black, "
    "shiny, transparent) may stand there; look from elsewhere, or light it otherwise"
)
# A motion that comes this near to something may touch it: the arm, what is recognised and the models are no better [m].
BESIDE = 0.005
# What comes this far into the shelf did not touch it in physics: its margins and the hand's model add up to that [m].
INTO_SHELF = 0.002
# An action has a gain if the cost is expected to fall by more than this share of it.
GAIN = 1e-3
# How often an action is tried at a place, and how near another one's place is the same [m].
TRIES, SAME_PLACE = 2, 0.03


@dataclasses.dataclass(frozen=True, eq=False)
class SearchStep:
    """What to do next, and why.

    Attributes:
      index: number of actions taken before.
      kind: name of the kind of action: "push", "pick-and-place", "retrieve", or "none" if no action is possible or all
        that were tried do harm; "withdraw" for a hand that first leaves the shelf, and "put-back" for one that first
        puts back what it holds.
      reason: what to do and what for, or why nothing can be done, in one line.
      warnings: inconsistencies in the images or the belief, a line each.
      trajectory: the motion from the present joints through the action and home; None without an action.
      observation, belief, decision: what it is based on.
      problem: the constants of the search.
      image: the colour image, or the depth as shades of grey, uint8 (H, W, 3).
    """

    index: int
    kind: str
    reason: str
    warnings: tuple[str, ...]
    trajectory: RobotTrajectory | None
    observation: Observation
    belief: Belief
    decision: Decision
    problem: Problem
    image: np.ndarray

    def to_json(self) -> dict[str, Any]:
        """Everything but the trajectory's rows as JSON values: objects, target, action, and where the hand goes.

        Metres and radians in the frame of the robot's base; docs/commands.md, "A step's file", explains each key.
        """
        return step_json(self)

    @functools.cached_property
    def frame(self) -> Frame:
        """The step as `viz.filmstrip.filmstrip` draws it, alone or beside others."""
        from mechsearch_jax.viz.filmstrip import Frame

        objects, after = (jax.tree.map(np.asarray, s) for s in (self.observation.objects, self.decision.predicted))
        action, found = self.decision.action, bool(self.belief.found)
        kind, moves = kind_of(int(action.kind)), self.trajectory is not None
        possible = np.asarray(self.belief.exists)
        # The way out of the shelf, or back, is no action.
        what = self.kind if kind.code == ActionKind.NONE else kind.describe(action, objects.capacity)
        return Frame(
            title=f"{self.index + 1}  {what if moves else 'nothing to be done'}",
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

    @functools.cached_property
    def picture(self) -> Figure:
        """The image, f and g from above, and the action."""
        from mechsearch_jax.viz.filmstrip import filmstrip

        heading = "\n".join(self.warnings) or "What the robot sees, and what it is to do"
        return filmstrip([self.frame], self.problem.camera, self.problem.shelf, self.problem.target, heading)


class Motion(NamedTuple):
    """The motion of a decision.

    Attributes:
      kind: name of the kind of action; "none" if it cannot be executed.
      reason: why it is done, or why nothing is.
      trajectory: of the arm; None if nothing is done.
      blocked: whether the action is not to be made; another one may be possible.
      warnings: what it is known to do beside what it is for, a line each.
      idle: whether it is not made because no gain is expected of it.
    """

    kind: str
    reason: str
    trajectory: RobotTrajectory | None
    blocked: bool = False
    warnings: tuple[str, ...] = ()
    idle: bool = False


class Present(NamedTuple):
    """How arm and hand are at present.

    Attributes:
      joints: joint angles [rad], shape (7,); at home if None.
      width: distance between the fingers [m]; not known if None.
    """

    joints: Float[np.ndarray, " 7"] | None
    width: float | None


def motion_of(
    problem: Problem,
    belief: Belief,
    observation: Observation,
    decision: Decision,
    depth: Float[np.ndarray, "h w"],
    unseen: tuple[str, ...],
    present: Present,
    arm: ArmConfig,
    config: TrajectoryConfig,
    failures: tuple[tuple[float, ...], ...] = (),
) -> Motion:
    """The motion of a decision, or why there is none.

    Args:
      problem, belief, observation, decision: the decision and what it is based on.
      depth: the image that `observation` comes from.
      unseen: why nothing is recognised in it; empty if anything is.
      present: arm and hand.
      arm: home and speed.
      config: how trajectories are made.
      failures: places of the gripper in actions that failed [m].
    """
    kind, nothing = kind_of(int(decision.action.kind)), kind_of(ActionKind.NONE).name
    target = "the target is found" if belief.found else f"the target can be at {int(jnp.sum(belief.exists))} poses"
    if kind.code == ActionKind.NONE:
        if unseen:
            return Motion(nothing, "; ".join(unseen), None)
        count = int(decision.refused)
        why = f"each of the {count} best actions does harm as it is tried out; ask again, and others are drawn"
        return Motion(nothing, f"{target}; {why if count else impasse(problem, belief, observation.objects)}", None)
    verb = kind.describe(decision.action, observation.objects.capacity)

    def refused(why: str) -> Motion:
        return Motion(nothing, f"{target}; to {verb} is not possible: {why}", None, blocked=True)

    if not kind.takes_target and not config.without_gain and not gains(decision):
        why = f"no gain is expected of what could be done; {hindrance(problem, belief, observation.objects)}"
        return Motion(nothing, f"{target}; {why}", None, blocked=True, idle=True)
    place = np.asarray(decision.action.T_world_gripper)[:3, 3]
    if times(failures, place) >= TRIES:
        return refused(f"it failed {TRIES} times at this place; see why, and mend that or move it by hand")
    if sweeps_unmeasured(problem, belief, observation.objects, decision.action):
        return refused(UNMEASURED)
    try:
        check_recognition(problem, observation, depth, config.doubt)
    except InputError as error:
        return Motion(nothing, f"{target}; to {verb} is not possible: {error}", None)
    try:
        trajectory = whole_trajectory(
            problem,
            observation,
            decision,
            joints=present.joints,
            width=present.width,
            home=np.array(arm.home),
            speed=arm.speed,
            config=config,
        )
    except InputError as error:
        return refused(str(error))
    if kind.takes_target:
        hit = retrieval_hits(problem.target_grasps, belief.grasps, observation.objects, decision.action)
        brushed = " and ".join(f"object {i}" for i in np.flatnonzero(np.asarray(hit)))
        known = f"a grasp that takes it out is known{brushed and '; it will brush '}{brushed}"
        warnings = (f"the hand, or the target in it, will brush {brushed} on its way",) if brushed else ()
        warnings += touches(trajectory, observation)
        return Motion(kind.name, f"{target}; {verb}: {known}", trajectory, warnings=warnings)
    now, then, best = float(decision.cost), float(decision.predicted_cost), float(decision.least_cost)
    cost = f"cost {now:.0f}, {then:.0f} expected afterwards"
    if best < then - GAIN * abs(now):
        cost += f", {best:.0f} after what it makes possible"
    return Motion(kind.name, f"{target}; {verb}: {cost}", trajectory, warnings=touches(trajectory, observation))


def touches(trajectory: RobotTrajectory, observation: Observation) -> tuple[str, ...]:
    """A warning of what a motion may touch beside what it is for, since it comes so near to it; none if nothing is.

    Objects and the target up to `BESIDE`, divided by how sure an object is, and anything that it reaches into.
    """
    sure = np.maximum(np.asarray(observation.judged().confidence, float), LEAST_SURE)
    least = {f"object {i}": BESIDE / share for i, share in enumerate(sure)} | {TARGET: BESIDE, SHELF: -INTO_SHELF}
    least[FLOOR] = -np.inf
    found = [
        f"{near.body} ({abs(1000 * near.distance):.0f} mm {'beside it' if near.distance > 0.0 else 'into it'})"
        for near in trajectory.nearest
        if near.distance <= least.get(near.body, 0.0)
    ]
    return (f"the hand, or what it holds, may touch {' and '.join(found)}",) if found else ()


def renamed(trajectory: RobotTrajectory, then: Observation, now: Observation) -> RobotTrajectory:
    """A trajectory that was made of an earlier look, with the names that objects have in this one."""
    place = np.asarray(then.objects.position)
    same, matched = (np.asarray(a) for a in same_objects(then.objects, now.objects, then.objects.position))
    apart = np.linalg.norm(np.asarray(now.objects.position)[same] - place, axis=-1)
    names = {
        f"object {i}": f"object {same[i]}" if matched[i] and apart[i] < SAME_PLACE else f"what was object {i}"
        for i in range(len(place))
    }
    nearest = tuple(dataclasses.replace(near, body=names.get(near.body, near.body)) for near in trajectory.nearest)
    return dataclasses.replace(trajectory, nearest=nearest)


def gains(decision: Decision) -> bool:
    """Whether a lower cost is expected after a decision's action, or after actions that it begins."""
    cost = float(decision.cost)
    return not float(decision.least_cost) >= cost - GAIN * abs(cost) or cost == 0.0


def times(failures: tuple[tuple[float, ...], ...], place: np.ndarray) -> int:
    """How many failures were at a place."""
    return sum(float(np.linalg.norm(np.subtract(failure, place))) < SAME_PLACE for failure in failures)


def display_image(depth: np.ndarray, colour: Any) -> np.ndarray:
    """The colour image, or else the depth as shades of grey, uint8 (H, W, 3)."""
    if colour is not None:
        image = np.asarray(colour)
        return image if image.dtype == np.uint8 else np.round(255 * image).astype(np.uint8)
    known = np.isfinite(depth) & measured(depth)
    low, high = np.percentile(depth[known], (1, 99)) if known.any() else (0.0, 1.0)
    with np.errstate(invalid="ignore"):
        shade = np.clip((high - depth) / max(high - low, 1e-6), 0.0, 1.0) * 200 + 30
    grey = np.where(known, shade, 0.0).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=-1)
