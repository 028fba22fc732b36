"""The search as a robot programmer runs it: images in, the next motion out, and `acted` when the motion is over.

    searcher = ms.Searcher(ms.Workcell(camera=..., shelf=..., target=...))  # or envs.cell.loading.load_searcher(FILE)
    while True:
        step = searcher.next(depth, colour)         # kind, reason, warnings, trajectory
        ...                                         # move along step.trajectory
        searcher.acted(ok=True)

A thin layer over `Recogniser`, `update_belief`, a policy and `whole_trajectory` that keeps the belief between steps and
puts decisions into words. It is the only part of the library that has a state.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import hashlib
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from mechsearch_jax.actions.kinds.nothing import no_action
from mechsearch_jax.actions.registry import KINDS, ActionKind, kind_of
from mechsearch_jax.actions.trajectory import grip_for
from mechsearch_jax.belief.belief import Belief
from mechsearch_jax.belief.impasse import hindrance, impasse
from mechsearch_jax.belief.unseen_motion import expected
from mechsearch_jax.config.config import Config
from mechsearch_jax.config.presets import standard
from mechsearch_jax.dynamics.push_model import PushModel
from mechsearch_jax.images.colour import RED
from mechsearch_jax.observation import Observation
from mechsearch_jax.perception.plausibility import EMPTY_SHELF, sight_faults
from mechsearch_jax.perception.recogniser import Recogniser
from mechsearch_jax.planner.policies import PlanningPolicy, Policy
from mechsearch_jax.planner.rollout import no_decision
from mechsearch_jax.planner.state import Decision
from mechsearch_jax.planner.step import Decided, SearchState, believe, decide, unsearched
from mechsearch_jax.planner.trials import Trials, nothing_tried
from mechsearch_jax.problem.problem import NOWHERE, Problem
from mechsearch_jax.problem.workcell import Workcell
from mechsearch_jax.robot.arm_clearance import ArmBody, shows_arm
from mechsearch_jax.robot.arm_config import check_joints
from mechsearch_jax.robot.hand import HandConfig, checked_width
from mechsearch_jax.robot.motion import motion_with
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike
from mechsearch_jax.runtime.own_settings import in_own_settings
from mechsearch_jax.session import faults, warming
from mechsearch_jax.session.images import Images, converted
from mechsearch_jax.session.models import UNTRIED, policy_and_trials, tries_nothing
from mechsearch_jax.session.preparing import Preparing, first_decision, nothing_seen, plan
from mechsearch_jax.session.state import State, beginning, load_state, save_state
from mechsearch_jax.session.step import (
    TRIES,
    Motion,
    Present,
    SearchStep,
    View,
    display_image,
    motion_of,
    renamed,
    times,
    touches,
)
from mechsearch_jax.session.whole_trajectory import CLEARER, PUT_BACK, WITHDRAW, TrajectoryConfig, way_back, way_out
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.sight import check_camera

# Reachable share of the candidate poses below which `check` warns.
LEAST_REACH = 0.5
# Names of the kinds of action that leave the target on the shelf.
KEEPS_TARGET = frozenset(kind.name for kind in KINDS.values() if not kind.takes_target and kind.code != ActionKind.NONE)
# A motion was handed out, and its end was not reported.
UNREPORTED = (
    "the last motion was not reported: it counts as not made; if it was made, or begun, call acted before the next look"
)
# Fingers this near to each other, or to where they opened, hold nothing [m].
EMPTY = 0.004
# What `warm_up` compiles, in this order.
STAGES = ("the problem", "recognition", "the belief", "the plan", "the grasp", "the motion")


@dataclasses.dataclass(frozen=True)
class Check:
    """A check of a workcell before the first image.

    Attributes:
      reach: share of the target's candidate poses at which the arm could grasp it in an empty shelf.
      warnings: probable mistakes, a line each.
      notices: settings that may surprise, a line each.
    """

    reach: float
    warnings: tuple[str, ...]
    notices: tuple[str, ...] = ()


class Searcher:
    """Searches for a target with a camera and an arm. Not thread-safe."""

    def __init__(
        self,
        workcell: Workcell | None = None,
        config: Config | None = None,
        *,
        seed: int = 0,
        policy: Policy | None = None,
        push_model: PushModel | None = None,
        later_push_model: PushModel | None = None,
        trials: Trials | None = None,
        recogniser: Callable[[Problem], Any] = Recogniser,
        trajectories: TrajectoryConfig | None = None,
        view: View | None = None,
    ):
        """Set up a search. Nothing is compiled yet; see `warm_up`.

        Args:
          workcell: camera, shelf, gripper and target; the defaults if left out.
          config: of the problem and the planner, and the largest number of actions; if left out, preset `standard`
            without retrievals that touch other objects. `envs.cell.loading.load_searcher` reads it from a file.
          seed: of all random numbers.
          policy: decides; by default search-for-grasp with `config.planner`. A policy brings its own planner
            configuration and push models.
          push_model, later_push_model: predict pushes, the latter those after the first action of a sequence; by
            default the one that `config` names.
          trials: tries the policy's actions before one is executed, such as `envs.trials.native.NativeTrials()`; by
            default what `config` names. With "none", the target is only taken out where nothing is touched; `check`
            and each step's reason say so.
          recogniser: makes a recogniser of a problem; it is called like `Recogniser`.
          trajectories: how motions are made, where a controller should stop, and when recognition is too doubtful to
            move; the default if left out.
          view: shows every step and what came of it, such as `envs.viewer.live.LiveView()`; nothing is shown if left
            out.

        Raises:
          InputError: the target cannot be grasped by the gripper, the camera does not see the shelf, a policy is given
            together with push models, or `config` names others than are given.
        """
        self.workcell = workcell or Workcell()
        check_camera(self.workcell.camera, self.workcell.shelf)
        self.config = config or standard().with_options(retrieval_contact=False)
        self._seed = seed
        self._policy, self._trials = policy_and_trials(
            self.config, self.workcell.shelf, policy, trials, push_model, later_push_model
        )
        self._make_recogniser = recogniser
        self._trajectories = trajectories
        self._view, self._shown = view, None
        self._state: State | None = None

    @functools.cached_property
    @in_own_settings
    def problem(self) -> Problem:
        """The constants of the search; built when first needed, and kept on disk."""
        return self.workcell.problem(config=self.config.problem)

    @functools.cached_property
    @in_own_settings
    def recogniser(self) -> Any:
        """The recogniser of this search."""
        if self._make_recogniser is Recogniser:
            return Recogniser(self.problem, detector=self.workcell.detector, capacity=self.workcell.capacity)
        return self._make_recogniser(self.problem)

    @property
    def belief(self) -> Belief:
        """The belief after the last images."""
        return self._now.belief

    @property
    def finished(self) -> bool:
        """Whether the target was taken out."""
        return self._now.finished

    @property
    def moving(self) -> bool:
        """Whether `next` returned a motion and `acted` was not called since."""
        return self._now.handed

    @property
    @in_own_settings
    def _now(self) -> State:
        if self._state is None:
            self._state = beginning(self.problem, self.workcell.capacity)
        return self._state

    @in_own_settings
    def check(self) -> Check:
        """Check that the arm reaches into the shelf, the camera sees it, and the networks know such views."""
        poses = self.problem.poses.shape[0]
        reach = len(np.unique(np.asarray(self.problem.grasps.pair_pose))) / poses
        warnings = list(self._view_warnings)
        if reach == 0.0:
            warnings.insert(0, NOWHERE)
        elif reach < LEAST_REACH:
            warnings.append(f"shelf: the arm can grasp the target at {100 * reach:.0f}% of its possible poses only")
        notices = [UNTRIED] if tries_nothing(self._policy, self._trials) else []
        if isinstance(self.recogniser, Recogniser) and self.workcell.colour == RED:
            notices.append(f"target: {self.workcell.told_by}")
        return Check(reach, tuple(warnings), tuple(notices))

    @in_own_settings
    def warm_up(
        self,
        progress: Callable[[str, int], None] = lambda what, left: None,
        *,
        colour: bool = True,
        mask: bool = False,
        target_id: bool = False,
    ) -> None:
        """Compile and load everything that `next` needs for such images.

        Args:
          progress: called with the name of each stage and the number of stages after it.
          colour, mask, target_id: whether `next` will be called with them. Call `warm_up` once for each combination.

        Raises:
          InputError: as `next`, or target_id is used without a mask.
        """
        stages = iter(STAGES)

        def stage() -> None:
            name = next(stages)
            progress(name, len(STAGES) - 1 - STAGES.index(name))

        stage()
        problem, key = self.problem, jax.random.key(0)
        images = warming.images(self.workcell.camera, self.workcell.shelf, colour, mask, target_id)
        config = self._trajectories.motion if self._trajectories else None
        nothing = nothing_seen(capacity=self.workcell.capacity)
        first = first_decision(problem, self._policy, motion_with(problem.gripper, config), nothing)
        # The longest programs are compiled in threads while the stages run, which wait for them where they call them.
        with Preparing(lambda text: None) as preparing:
            preparing.add(first)
            stage()
            seen = jax.block_until_ready(self._recognised(key, images))
            warming.yaw(problem)
            hidden, visible = warming.hidden(problem, seen), warming.in_the_open(problem, seen)
            stage()
            belief = jax.block_until_ready(believe(problem, unsearched(problem, hidden), hidden)).belief
            if isinstance(self._policy, PlanningPolicy):
                # Of a found target that cannot be taken out yet.
                found = belief.replace(found=jax.numpy.array(True))
                preparing.add(plan(self._policy, key, problem, found, visible))
            stage()
            twin = self._twin()
            searching = twin._step_on(hidden, images)
            stage()
            twin._state = dataclasses.replace(twin._now, handed=False, acted=True)
            retrieving = twin._step_on(visible, images)
            stage()
            impasse(problem, searching.belief, hidden.objects)
            action = retrieving.decision.action
            warming.motions(problem, action, config)
            if self._trials is not None:
                warming.trials(self._trials, problem, belief, hidden, action)
            for step in (searching, retrieving):
                step.to_json()
                _ = step.picture

    def _twin(self) -> Searcher:
        """A copy of this searcher at the beginning of its search, for which no recognition is too doubtful to move."""
        _ = self._view_warnings
        twin = copy.copy(self)
        twin._state, twin._view = beginning(self.problem, self.workcell.capacity), None
        twin._trajectories = dataclasses.replace(self._trajectories or TrajectoryConfig(), doubt=warming.TRUSTING)
        return twin

    def _step_on(self, observation: Observation, images: Images) -> SearchStep:
        """The next step as if `observation` had been recognised in the images."""
        self.__dict__["recogniser"] = warming.fixed_recogniser(self.recogniser, observation)
        return self.next(*images)

    @in_own_settings
    def next(
        self,
        depth: Any,
        colour: Any = None,
        mask: Any = None,
        target_id: int | None = None,
        joints: Any = None,
        width: Any = None,
    ) -> SearchStep:
        """Recognise the objects, update the belief and decide what to do next.

        Call it again without `acted` if nothing was done since. If no action was possible, other actions are then
        drawn.

        Args:
          depth: float (H, W), metres along the camera's z; 0, NaN or 65.535 where nothing was measured.
          colour: (H, W, 3), floats in 0 to 1 or uint8, registered to the depth image.
          mask: integers (H, W), the number of the object that a pixel shows; see `Recogniser`.
          target_id: the target's number in the mask; negative where the mask does not show it.
          joints: where the arm is, seven angles [rad]; if left out, where `acted` was told that it stopped, or at home.
            What the image shows of the arm there counts as not measured.
          width: present distance between the fingers [m]; if left out, they are taken to be open.

        Returns:
          The step. Follow its trajectory as it is, then call `acted`.

        Raises:
          InputError: an image has the wrong shape, type or unit, nothing was measured, the shelf is far from where it
            should be in it, or the search is finished.
        """
        problem, now = self.problem, self._now
        if now.finished:
            raise InputError("next: the target was taken out, and the search is finished; make another Searcher")
        # As of an episode with this seed.
        keys = jax.random.split(jax.random.key(self._seed))
        decision_key, recognition_key = (jax.random.fold_in(key, now.index) for key in keys)
        images, present = converted(depth, colour, mask, target_id), self._present(joints, width)
        if present.joints is not None:
            images = images._replace(depth=self._without_arm(images.depth, present.joints))
        observation, warnings, unseen = self._seen(recognition_key, images)
        if now.handed:
            warnings.append(UNREPORTED)
        before = SearchState(now.belief, now.observation, now.action)
        if not now.acted:
            before = before.replace(observation=observation, action=no_action())
        state = believe(problem, before, observation)
        warnings += faults.belief_warnings(now.belief, state.belief, shelf_is_empty=EMPTY_SHELF in unseen)
        first = self._held(observation, present) or self._way_out(observation, present)
        if first is None:
            decided, motion = self._decide(decision_key, self._trials, state, images.depth, unseen, present)
        else:
            decided, motion = Decided(no_decision(observation.objects), nothing_tried()), first
        warnings += motion.warnings
        if motion.trajectory is not None and motion.trajectory.place_fault:
            warnings.append(f"the target is to stay in the hand: {motion.trajectory.place_fault}")
        step = SearchStep(
            index=now.index,
            kind=motion.kind,
            reason=motion.reason,
            warnings=tuple(warnings),
            trajectory=motion.trajectory,
            observation=observation,
            belief=state.belief,
            decision=decided.decision,
            problem=problem,
            image=display_image(images.depth, images.colour),
        )
        if first is None:
            self._keep(step)
        elif first.trajectory is not None:
            # The arm, or what it holds, hides things: nothing else of this look counts.
            action = now.action if now.acted else no_action()
            self._state = dataclasses.replace(now, action=action, handed=True, way=first.kind)
        if self._view is not None:
            self._view.decided(step, decided.tried)
            self._shown = step
        return step

    def _seen(self, key: Array, images: Images) -> tuple[Observation, list[str], tuple[str, ...]]:
        """What is recognised in images, warnings about them, and those that say why nothing is recognised.

        Raises:
          InputError: as `next`.
        """
        problem = self.problem
        look, of_images = faults.check_image(problem, self.workcell.calibration, images, self.recogniser)
        observation = faults.checked(self._recognised(key, images)).judged()
        unseen = sight_faults(look, observation)
        of_objects = faults.recognition_warnings(problem, look, observation, self.recogniser)
        return observation, [*self._view_warnings, *of_images, *unseen, *of_objects], unseen

    def _recognised(self, key: Array, images: Images) -> Observation:
        """What is recognised in images that were checked, with what the last look showed better."""
        if not isinstance(self.recogniser, Recogniser):
            return self.recogniser(key, *images)
        now = self._now
        action = now.action if now.acted and now.executed else no_action()
        # A found target may have been seen before the last look.
        found, pose = now.belief.found, now.belief.found_pose
        before = Observation(now.observation.objects, found, pose, now.observation.confidence)
        return self.recogniser.unchecked(key, *images, before=expected(before, action))

    def _keep(self, step: SearchStep) -> None:
        """Keep of a step what the next one needs."""
        handed = step.trajectory is not None
        self._state = State(
            step.index,
            step.belief,
            step.observation,
            step.decision.action,
            handed=handed,
            acted=False,
            finished=False,
            refusals=self._now.refusals + (not handed),
            failures=self._now.failures,
            stopped=self._now.stopped,
        )

    def _present(self, joints: Any, width: Any) -> Present:
        """Arm and hand, as `next` is given them.

        Raises:
          InputError: as `next`.
        """
        if joints is None and self._now.stopped:
            joints = self._now.stopped
        return Present(
            self._checked(joints), None if width is None else checked_width(width, self.problem.gripper.max_opening)
        )

    def _checked(self, joints: Any) -> Float[np.ndarray, " 7"] | None:
        """Joint angles [rad] as an array, or None.

        Raises:
          InputError: they are not seven, or beyond the limits.
        """
        if joints is not None:
            joints = np.asarray(joints, float)
            check_joints("joints", joints, self.workcell.gripper.arm)
        return joints

    def _without_arm(self, depth: np.ndarray, joints: Float[np.ndarray, " 7"]) -> np.ndarray:
        """A depth image in which the arm counts as not measured; other arrays, which are refused later, unchanged."""
        camera = self.workcell.camera
        if depth.shape != (camera.height, camera.width) or depth.dtype.kind != "f":
            return depth
        shown = shows_arm(camera, depth, ArmBody.of(self.problem.gripper.max_opening), joints)
        return np.where(shown, np.float32(np.nan), depth) if shown.any() else depth

    def _held(self, observation: Observation, present: Present) -> Motion | None:
        """What is done with what the fingers hold after a grasp that was reported as failed; None if it is nothing."""
        now, kind = self._now, kind_of(int(self._now.action.kind))
        grasps = now.acted and not now.executed and (kind.takes_target or kind.holds_object)
        opened, width = float(now.action.opening), present.width
        if not grasps or width is None or not EMPTY < width < opened - EMPTY:
            return None
        what = "the target" if kind.takes_target else f"object {int(now.action.object)}"
        held = (
            f"the hand holds something {1000 * width:.0f} mm wide after a grasp of {what} that was reported as failed"
        )
        try:
            fault, motion = "", self._with_held(observation, present, width)
        except InputError as error:
            fault, motion = f" (it is not moved: {error})", None
        if motion is not None and motion.trajectory is not None:
            trajectory = renamed(motion.trajectory, now.observation, observation)
            warnings = touches(trajectory, observation)
            return motion._replace(reason=f"{held}: {motion.reason}", trajectory=trajectory, warnings=warnings)
        over = "if it is the target, call acted(ok=True), and the search is over; else " if kind.takes_target else ""
        by_hand = "take it out of the hand, or open the hand where it may fall, and give the new width"
        return Motion(kind_of(ActionKind.NONE).name, f"{held}{fault}; {over}{by_hand}", None)

    def _with_held(self, observation: Observation, present: Present, width: float) -> Motion | None:
        """The motion out of the shelf with what the hand holds, or outside, back to where it stood; None for a target,
        and for what was not put back once.

        Raises:
          InputError: there is none, or something else is held.
        """
        now, kind = self._now, kind_of(int(self._now.action.kind))
        config, arm, joints = self._motions, self.workcell.arm, present.joints
        settings = {"home": np.array(arm.home), "width": width, "speed": arm.speed, "config": config}
        grasp = grip_for(self.problem, now.observation, now.action).grasp(
            float(now.action.opening), 0.0, 0.0, config.hand or HandConfig()
        )
        if not grasp.width - grasp.inner <= width <= grasp.width + grasp.outer:
            raise InputError(f"{1000 * grasp.width:.0f} mm were expected")
        if joints is not None:
            way = way_out(self.problem, now.observation, joints, holding=now.action, **settings)
            if way is not None:
                return Motion(WITHDRAW, "first straight back, out of the shelf and home, with it", way)
        if kind.takes_target or times(now.failures, np.asarray(now.action.T_world_gripper)[:3, 3]) >= TRIES:
            return None
        back = way_back(self.problem, now.observation, now.action, observation, joints=joints, **settings)
        return Motion(PUT_BACK, "back to where it stood", back)

    def _way_out(self, observation: Observation, present: Present) -> Motion | None:
        """The motion out of the shelf, where the hand is inside of it; None where it is not."""
        if present.joints is None:
            return None
        arm, action = self.workcell.arm, self._now.action
        pushed = self._now.acted and not self._now.executed and np.any(np.asarray(action.displacement))
        try:
            trajectory = way_out(
                self.problem,
                observation,
                present.joints,
                home=np.array(arm.home),
                width=present.width,
                speed=arm.speed,
                config=self._motions,
                pushing=action if pushed else None,
            )
        except InputError as error:
            return Motion(kind_of(ActionKind.NONE).name, f"the hand is inside the shelf; {error}", None)
        if trajectory is None:
            return None
        why = "the hand is inside the shelf: first straight back, out and home, with the fingers as they are"
        return Motion(WITHDRAW, why, trajectory, warnings=touches(trajectory, observation))

    def _decide(
        self,
        key: Array,
        trials: Trials | None,
        state: SearchState,
        depth: np.ndarray,
        unseen: tuple[str, ...],
        present: Present,
    ) -> tuple[Decided, Motion]:
        """A decision and its motion, drawn anew where the arm cannot execute it.

        Where no gain is expected it looks one action farther ahead: what is in the way may have to be cleared first.
        Where that finds nothing for a found target either, or nothing that the arm can execute, it tries the actions of
        `Problem.bolder`.
        """
        problem, arm, motions = self.problem, self.workcell.arm, list[Motion]()
        refused = self._now.refusals
        # Where nothing is clear enough, less has to do.
        share = CLEARER[min(refused, len(CLEARER) - 1)]
        config = dataclasses.replace(self._motions, beside=share * self._motions.beside)

        def executable(decision: Decision) -> bool:
            belief, observation = state.belief, state.observation
            settings = unseen, present, arm, config, self._now.failures
            motions.append(motion_of(problem, belief, observation, decision, depth, *settings))
            return not motions[-1].blocked

        last = self._now.index >= self.config.max_steps
        arguments = trials, key, problem, state
        farther = self._policy.farther if isinstance(self._policy, PlanningPolicy) else None

        def enough(decision: Decision) -> bool:
            return executable(decision) or (motions[-1].idle and farther is not None)

        decided = decide(self._policy, *arguments, last=last, refusals=refused, executable=enough)
        if motions[-1].idle and farther is not None:
            decided = decide(farther, *arguments, last=last, refusals=refused, executable=executable)
        motion, nothing = motions[-1], int(decided.decision.action.kind) == ActionKind.NONE
        stuck = motion.blocked or (nothing and not unseen)
        if farther is not None and state.belief.found and stuck and not last:
            settings = {"last": last, "refusals": refused, "executable": executable}
            bolder = decide(farther, trials, key, problem.bolder, state, **settings)
            if motions[-1].trajectory is not None:
                decided, motion = bolder, motions[-1]
        return decided, self._within_limit(motion, state)

    @property
    def _motions(self) -> TrajectoryConfig:
        """How motions are made: as given, with the workcell's obstacles, and its hand and place where these are not."""
        config, cell = self._trajectories or TrajectoryConfig(), self.workcell
        hand, place = config.hand or cell.hand, config.place or cell.arm.place
        return dataclasses.replace(config, hand=hand, place=place, obstacles=(*config.obstacles, *cell.bodies))

    def _within_limit(self, motion: Motion, state: SearchState) -> Motion:
        """The motion if the limit of actions allows it; beyond it only the target is taken out, as in an episode."""
        most = self.config.max_steps
        if self._now.index >= most and motion.kind in KEEPS_TARGET:
            why = (
                f"all {most} actions of max_steps are used up; only a found target is still taken out (raise max_steps "
                "to go on)"
            )
            if not state.belief.found:
                why = f"{why}; {hindrance(self.problem, state.belief, state.observation.objects)}"
            return Motion(kind_of(ActionKind.NONE).name, f"{motion.reason}; not done: {why}", None)
        untried = (
            "; not tried out before"
            if tries_nothing(self._policy, self._trials) and motion.trajectory is not None
            else ""
        )
        return motion._replace(reason=motion.reason + untried)

    @in_own_settings
    def acted(self, ok: bool = True, joints: Any = None) -> None:
        """Report that the last step's motion is over, after a failure, too: the hand may have moved something unseen.

        Args:
          ok: whether it was executed to its end. A retrieval that was finishes the search. One that was reported as
            failed, after which the target is in the hand nevertheless, may be reported again. After a way out of the
            shelf, or the way back of an object, what was reported of the action before it still holds.
          joints: where the arm stopped, seven angles [rad], if that is not where the motion ends: `next` takes it to be
            there unless it is told otherwise, and takes it out of the shelf first.

        Raises:
          InputError: no motion was returned since the last call, or the joints are impossible.
        """
        now = self._now
        kind, stopped = kind_of(int(now.action.kind)), self._checked(joints)
        if not (now.handed or (ok and now.acted and not now.executed and kind.takes_target)):
            raise InputError("acted: no motion was handed out since the last one; call next first")
        failures = now.failures
        if kind.code != ActionKind.NONE and not (now.way and (ok or now.way == WITHDRAW)):
            place = tuple(np.asarray(now.action.T_world_gripper, float)[:3, 3].tolist())
            grasps = kind.takes_target or kind.holds_object
            failures = (*failures, place) if not ok else () if grasps else failures
        self._state = dataclasses.replace(
            now,
            # The way out of the shelf, or back, is no action.
            index=now.index + (now.handed and not now.way and kind.code != ActionKind.NONE),
            handed=False,
            acted=True,
            executed=now.executed if now.way else ok,
            finished=ok and kind.takes_target and not now.way,
            refusals=0,
            failures=failures,
            stopped=() if stopped is None else tuple(stopped.tolist()),
            way="",
        )
        if self._view is not None and self._shown is not None:
            self._view.acted(self._shown, ok)

    @in_own_settings
    def save(self, path: PathLike) -> None:
        """Save the search's state as an archive of arrays, .npz, so that `load` can continue it after a crash.

        Raises:
          InputError: the file cannot be written.
        """
        save_state(self._now, self._digest, path)

    @in_own_settings
    def load(self, path: PathLike) -> None:
        """Continue a search that was saved by a searcher with the same workcell, configuration and seed.

        The hand, the camera's pose, the arm's speed, obstacles and the target's place may have changed.

        Raises:
          InputError: the file cannot be read, was not made by `save`, or belongs to another searcher.
        """
        self._state = load_state(self.problem, self._digest, path, self.workcell.capacity)

    @functools.cached_property
    def _view_warnings(self) -> tuple[str, ...]:
        return faults.view_warnings(self.workcell, self.recogniser)

    @functools.cached_property
    def _digest(self) -> str:
        """SHA-256 of everything that a saved state depends on; not of the hand, the camera's pose, the arm's speed,
        obstacles, or the target's place."""
        cell, camera = self.workcell, Camera()
        camera = dataclasses.replace(cell.camera, rotation=camera.rotation, position=camera.position)
        arm = dataclasses.replace(cell.arm, speed=1.0, place=())
        same = dataclasses.replace(cell, camera=camera, arm=arm)
        return hashlib.sha256(repr((same, self.config, self._seed)).encode()).hexdigest()
