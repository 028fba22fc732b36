"""The search as a robot programmer runs it: images in, the next motion out, told again when it is over.

    searcher = ms.Searcher(ms.Workcell(camera=..., shelf=..., target=...))  # or envs.cell.loading.load_searcher(FILE)
    while True:
        step = searcher.next(depth, colour)         # kind, reason, warnings, trajectory
        ...                                         # move along step.trajectory
        searcher.acted(ok=True)

A thin shell over `Recogniser`, `update_belief`, a policy and `whole_trajectory`; it keeps the belief between the steps,
and says in words what the arrays say. It is the only part of the library that has a state.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import hashlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from mechsearch_jax.actions.nothing import no_action
from mechsearch_jax.actions.registry import KINDS, ActionKind, kind_of
from mechsearch_jax.belief.belief import Belief, initial_belief, update_belief
from mechsearch_jax.belief.impasse import impasse
from mechsearch_jax.config.config import Config
from mechsearch_jax.config.presets import standard
from mechsearch_jax.dynamics.push_model import PushModel
from mechsearch_jax.images.trained_view import view_faults
from mechsearch_jax.observation import Observation
from mechsearch_jax.perception.overlaps import overlap_faults
from mechsearch_jax.perception.plausibility import (
    EMPTY_SHELF,
    check_measured,
    colour_faults,
    identity_faults,
    image_faults,
    sight_faults,
)
from mechsearch_jax.perception.recogniser import Recogniser
from mechsearch_jax.planner.policies import Policy
from mechsearch_jax.planner.state import Decision
from mechsearch_jax.planner.trials import Trials, decide
from mechsearch_jax.problem.problem import NOWHERE, Problem
from mechsearch_jax.problem.workcell import Workcell
from mechsearch_jax.robot.free_motion import check_joints
from mechsearch_jax.robot.motion import MotionConfig
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike
from mechsearch_jax.session import warming
from mechsearch_jax.session.images import Images, alike
from mechsearch_jax.session.preparing import first_decision, prepared
from mechsearch_jax.session.slots import UNTRIED, filled, tries_nothing
from mechsearch_jax.session.state import State, beginning, load_state, save_state
from mechsearch_jax.session.step import Motion, SearchStep, motion, shown
from mechsearch_jax.session.whole_trajectory import TrajectoryConfig
from mechsearch_jax.workspace.sight import camera_faults, check_camera

# Share of the candidate poses below which a target that is found would often be out of reach.
LEAST_REACH = 0.5
# Names of the kinds that leave the target where it is, or put it back.
KEEPS_TARGET = frozenset(kind.name for kind in KINDS.values() if not kind.takes_target and kind.code != ActionKind.NONE)
# How often is decided anew in one step where the arm cannot do what was decided on.
DRAWS = 4
# What `warm_up` compiles, in this order.
STAGES = ("the problem", "recognition", "the belief", "the plan", "the grasp", "the motion")


@dataclasses.dataclass(frozen=True)
class Check:
    """What is known of a workcell before the first image.

    Attributes:
      reach: share of the target's candidate poses at which the arm could grasp it in an empty shelf.
      warnings: what should be looked at, a line each.
      notices: what is as it was asked for and may surprise all the same, a line each.
    """

    reach: float
    warnings: tuple[str, ...]
    notices: tuple[str, ...] = ()


class Searcher:
    """Searches for a target with a camera and an arm; the one object of this package that has a state.

    Not thread-safe. What decides is a `Policy`, and what sees is a `Recogniser`; both can be others.
    """

    def __init__(
        self,
        workcell: Workcell | None = None,
        config: Config | None = None,
        *,
        seed: int = 0,
        policy: Policy | None = None,
        push_model: PushModel | None = None,
        later_push_model: PushModel | None = None,
        rehearsal: Trials | None = None,
        recogniser: Callable[[Problem], Any] = Recogniser,
        trajectories: TrajectoryConfig | None = None,
    ):
        """Set up a search. Nothing is compiled yet; see `warm_up`.

        Args:
          workcell: camera, shelf, gripper and target; the defaults if left out.
          config: how the problem is built and how the planner decides, and how many actions it may take; preset
            `standard` without a rehearsal if left out. What it names and needs a simulator has to be given beside it:
            `envs.cell.loading.load_searcher` makes all of that from a file.
          seed: of all random numbers.
          policy: what decides; by default search-for-grasp with the planner's part of `config`. One that is given has
            that part and its models itself.
          push_model, later_push_model: predict pushes, the latter those that are not the first action of a sequence; by
            default what `config` names.
          rehearsal: tries the policy's actions out before one is made, such as `envs.trials.native.NativeTrials()`. If
            left out, nothing does, and the target is only taken out where nothing is touched; `check` and each step's
            reason say so.
          recogniser: makes what recognises of a problem, with the signature of `Recogniser`.
          trajectories: how motions are made, where a controller should stop, and when recognition is too doubtful to
            move; the default if left out.

        Raises:
          InputError: the target cannot be grasped by the gripper, the camera does not see the shelf, a policy is given
            beside what it should have itself, or `config` names what is not given.
        """
        slots: dict[str, Any] = {
            "push_model": push_model,
            "later_push_model": later_push_model,
        }
        self.workcell = workcell or Workcell()
        check_camera(self.workcell.camera, self.workcell.shelf)
        self.config = config or standard(rehearsal="none")
        self._seed = seed
        self._policy, self._trials = filled(policy, self.config, rehearsal, slots), rehearsal
        self._make_recogniser = recogniser
        self._trajectories = trajectories
        self._state: State | None = None

    @functools.cached_property
    def problem(self) -> Problem:
        """What does not change; built when it is first needed, and kept on disk."""
        return self.workcell.problem(config=self.config.problem)

    @functools.cached_property
    def recogniser(self) -> Any:
        """What sees."""
        if self._make_recogniser is Recogniser:
            return Recogniser(self.problem, detector=self.workcell.detector)
        return self._make_recogniser(self.problem)

    @property
    def belief(self) -> Belief:
        """What is known of the target."""
        return self._now.belief

    @property
    def finished(self) -> bool:
        """Whether the target was taken out."""
        return self._now.finished

    @property
    def moving(self) -> bool:
        """Whether a motion was handed out of which nothing was said since."""
        return self._now.handed

    @property
    def _now(self) -> State:
        if self._state is None:
            self._state = beginning(self.problem)
        return self._state

    def check(self) -> Check:
        """Whether the arm can work in this shelf, the camera sees it, and the networks are used to such a view."""
        poses = self.problem.poses.shape[0]
        reach = len(np.unique(np.asarray(self.problem.grasps.pair_pose))) / poses
        warnings = list(self._camera_faults)
        if reach == 0.0:
            warnings.insert(0, NOWHERE)
        elif reach < LEAST_REACH:
            warnings.append(f"shelf: the arm can grasp the target at {100 * reach:.0f}% of its possible poses only")
        return Check(reach, tuple(warnings), (UNTRIED,) if tries_nothing(self._policy, self._trials) else ())

    def warm_up(
        self,
        progress: Callable[[str, int], None] = lambda what, left: None,
        *,
        colour: bool = True,
        mask: bool = False,
        target_id: bool = False,
    ) -> None:
        """Compile and load all that `next` needs with such images, so that nothing is left to compile.

        Args:
          progress: told what comes next, and how many things come after it.
          colour, mask, target_id: which of them `next` is given beside the depth image. Who uses several combinations
            calls this once for each.

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
        first = first_decision(problem, self._policy, config or MotionConfig(gripper=problem.gripper))
        # What takes longest is compiled while the rest is gone through, which waits for it where it needs it.
        with prepared(first, lambda text: None):
            stage()
            seen = jax.block_until_ready(self.recogniser(key, *images))
            hidden, found = warming.hidden(problem, seen), warming.in_the_open(problem, seen)
            stage()
            belief = update_belief(problem, initial_belief(problem), hidden)
            jax.block_until_ready(update_belief(problem, belief, hidden, hidden, no_action()))
            stage()
            twin = self._twin()
            step = twin._looking(hidden, images)
            stage()
            twin._state = dataclasses.replace(twin._now, handed=False, acted=True)
            taken = twin._looking(found, images)
            stage()
            impasse(problem, step.belief, hidden.objects)
            action = taken.decision.action
            warming.motions(problem, action, config)
            if self._trials is not None:
                warming.trials(self._trials, problem, belief, hidden, action)
            for each in (step, taken):
                each.to_json()
                _ = each.picture

    def _twin(self) -> Searcher:
        """A searcher at the beginning of a search, that shares all but how far it is, and makes any motion."""
        _ = self._camera_faults
        twin = copy.copy(self)
        twin._state = beginning(self.problem)
        twin._trajectories = dataclasses.replace(self._trajectories or TrajectoryConfig(), doubt=warming.TRUSTING)
        return twin

    def _looking(self, observation: Observation, images: Images) -> SearchStep:
        """The next step where images show what is said, whatever they show."""
        self.__dict__["recogniser"] = warming.saying(self.recogniser, observation)
        return self.next(*images)

    def next(
        self,
        depth: Any,
        colour: Any = None,
        mask: Any = None,
        target_id: int | None = None,
        joints: Any = None,
    ) -> SearchStep:
        """Look, and decide what to do next.

        Asked again without `acted` in between, it looks again: nothing was done since. Where all that was tried out did
        harm, or the arm could do none of what was decided on, it then draws other actions.

        Args:
          depth: float (H, W), metres along the camera's z; 0 or NaN where nothing was measured.
          colour: (H, W, 3), floats in 0 to 1 or uint8, registered to the depth image.
          mask: integers (H, W), the number of the object that a pixel shows; see `Recogniser`.
          target_id: the target's number in the mask; negative where the mask does not show it.
          joints: where the arm is, seven angles [rad]; at home if left out.

        Returns:
          The step. Its trajectory is to be followed as it is; then `acted` is to be told.

        Raises:
          InputError: an image's shape, type or unit is not as said, nothing was measured, or the search is finished.
        """
        problem, now = self.problem, self._now
        if now.finished:
            raise InputError("next: the target was taken out, and the search is finished; make another Searcher")
        here = jax.random.fold_in(jax.random.key(self._seed), now.index)
        # What was refused or doubted would be drawn again.
        seeing, deciding = jax.random.split(jax.random.fold_in(here, now.refusals))
        depth, colour, mask, target_id = alike(depth, colour, mask, target_id)
        if joints is not None:
            joints = np.asarray(joints, float)
            check_joints("joints", joints)
        observation = self.recogniser(seeing, depth, colour, mask, target_id)
        check_measured(problem.camera, problem.shelf, depth)
        warnings = [*self._camera_faults, *self._faults(depth, colour, mask, target_id)]
        nothing = sight_faults(problem.camera, problem.shelf, depth, observation)
        warnings += [*nothing, *crowd_faults(observation), *overlap_faults(problem, observation)]
        last = (now.observation, now.action) if now.acted else (None, None)
        belief = update_belief(problem, now.belief, observation, *last)
        # Of an empty shelf f is empty because the target is not there.
        if int(belief.restarts) > int(now.belief.restarts) and EMPTY_SHELF not in nothing:
            warnings.append(
                "f became empty and was started anew: something moved that was not seen, or a shape is wrong"
            )
        if bool(now.belief.found) and not bool(belief.found):
            warnings.append("the target is not where it was found any more: it is searched for anew")
        decision, done = self._decided(deciding, belief, observation, depth, joints)
        step = SearchStep(
            index=now.index,
            kind=done.kind,
            reason=done.reason,
            warnings=tuple(warnings),
            trajectory=done.trajectory,
            observation=observation,
            belief=belief,
            decision=decision,
            problem=problem,
            image=shown(depth, colour),
        )
        handed = done.trajectory is not None
        refusals = now.refusals + (not handed)
        self._state = State(
            now.index,
            belief,
            observation,
            decision.action,
            handed=handed,
            acted=False,
            finished=False,
            refusals=refusals,
        )
        return step

    def _decided(
        self, key: Array, belief: Belief, observation: Observation, depth: np.ndarray, joints: np.ndarray | None
    ) -> tuple[Decision, Motion]:
        """What is decided on, and its motion; decided anew, a few times, where the arm cannot do it.

        Which grasp takes the target out does not hang on chance, so that there another draw finds no other.
        """
        problem, arm = self.problem, self.workcell.arm
        for draw in range(DRAWS):
            # The first is that of a policy by itself.
            drawn = jax.random.fold_in(key, draw) if draw else key
            decision = decide(self._policy, self._trials, drawn, problem, belief, observation)
            done = motion(problem, belief, observation, decision, depth, joints, arm, self._trajectories)
            if not done.blocked or kind_of(int(decision.action.kind)).takes_target:
                break
        return decision, self._allowed(done)

    def _allowed(self, done: Motion) -> Motion:
        """What is done, where there are actions left; afterwards only the target is taken out, as in an episode."""
        most = self.config.max_steps
        if self._now.index >= most and done.kind in KEEPS_TARGET:
            why = (
                f"all {most} actions of max_steps are used up; only a found target is still taken out (raise max_steps "
                "to go on)"
            )
            return Motion(kind_of(ActionKind.NONE).name, f"{done.reason}; not done: {why}", None)
        untried = (
            "; not tried out before"
            if tries_nothing(self._policy, self._trials) and done.trajectory is not None
            else ""
        )
        return done._replace(reason=done.reason + untried)

    def acted(self, ok: bool = True) -> None:
        """Say that the last step's motion is over.

        After a failure, too: whatever the hand may have moved unseen until it stopped is then reckoned with.

        Args:
          ok: whether it was carried out to its end. With a retrieval that was, the search is finished.

        Raises:
          InputError: there is no step whose motion could be over.
        """
        now = self._now
        if not now.handed:
            raise InputError("acted: no motion was handed out since the last one; call next first")
        took = ok and kind_of(int(now.action.kind)).takes_target
        self._state = dataclasses.replace(now, index=now.index + 1, handed=False, acted=True, finished=took, refusals=0)

    def save(self, path: PathLike) -> None:
        """Write down how far the search is, so that `load` can go on after a crash: an archive of arrays, .npz.

        Raises:
          InputError: the file cannot be written.
        """
        save_state(self._now, self._digest, path)

    def load(self, path: PathLike) -> None:
        """Go on where a search was that was saved by a searcher that was made as this one.

        Raises:
          InputError: the file cannot be read, is none of `save`, or is of another workcell or configuration.
        """
        self._state = load_state(self.problem, self._digest, path)

    @functools.cached_property
    def _camera_faults(self) -> tuple[str, ...]:
        """What is wrong with the camera's pose, or far from what the networks know; it does not change."""
        faults = camera_faults(self.workcell.camera, self.workcell.shelf)
        recogniser = self.recogniser
        # What else recognises may have no networks, or others.
        if faults or not isinstance(recogniser, Recogniser):
            return faults
        return view_faults(recogniser.camera, recogniser.shelf, recogniser.trained)

    def _faults(self, depth: np.ndarray, colour: Any, mask: Any, target_id: int | None) -> list[str]:
        """What in the images does not fit camera, shelf and target."""
        problem, recogniser = self.problem, self.recogniser
        mask, colour = (None if image is None else np.asarray(image) for image in (mask, colour))
        faults = list(image_faults(problem.camera, problem.shelf, depth, mask))
        # What else recognises may know the target in another way.
        if isinstance(recogniser, Recogniser):
            faults += identity_faults(colour, mask, target_id)
            if colour is not None and target_id is None:
                detector = recogniser.detector
                faults += colour_faults(problem.camera, problem.shelf, problem.target, detector, depth, colour)
        return faults

    @functools.cached_property
    def _digest(self) -> str:
        """What tells searches apart that cannot go on with each other's state."""
        return hashlib.sha256(repr((self.workcell, self.config, self._seed)).encode()).hexdigest()


def crowd_faults(observation: Observation) -> list[str]:
    """What there is too much of."""
    slots = observation.objects.capacity
    if not bool(jnp.all(observation.objects.valid)):
        return []
    return [f"recognition: all {slots} slots are taken; objects beyond the largest {slots} are not seen"]
