"""The trajectory of a decision: from the present joints through the action and home."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mechsearch_jax.actions.kind import Kind
from mechsearch_jax.actions.kinds.nothing import no_action
from mechsearch_jax.actions.registry import kind_of
from mechsearch_jax.actions.trajectory import grasped, grip_for, reference_motion, target_pose
from mechsearch_jax.actions.types import Action
from mechsearch_jax.geometry.bodies import world_parts
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.observation import Observation
from mechsearch_jax.perception import recogniser
from mechsearch_jax.perception.doubt import DoubtConfig, check_recognition
from mechsearch_jax.robot.acting import Rows, acting, joined, opening_to
from mechsearch_jax.robot.arm_clearance import (
    ALWAYS,
    FARTHEST,
    HAND_FRAME,
    SHELF,
    TARGET,
    ArmBody,
    Held,
    Obstacles,
    clearance,
    link_poses,
    tip_positions,
    touched,
)
from mechsearch_jax.robot.arm_config import check_joints, check_place
from mechsearch_jax.robot.entry import ways_in
from mechsearch_jax.robot.free_motion import WAYPOINTS, FreeMotion, FreeMotionConfig, free_motion, respaced, timed_rows
from mechsearch_jax.robot.gripper import Gripper
from mechsearch_jax.robot.hand import HandConfig, HandMove, checked_width, longest_way, stroke
from mechsearch_jax.robot.kinematics import HOME
from mechsearch_jax.robot.motion import MotionConfig, Reference, motion_with
from mechsearch_jax.robot.nearest import nearest_rows
from mechsearch_jax.robot.robot_trajectory import Bounds, Nearest, Part, RobotTrajectory, derivatives
from mechsearch_jax.runtime.errors import InputError, check_range
from mechsearch_jax.runtime.own_settings import in_own_settings
from mechsearch_jax.session.placing import PlaceWay, place_ways
from mechsearch_jax.workspace.obstacle import Obstacle
from mechsearch_jax.workspace.target_view import body_at

# Tolerance within which a gripper counts as at `Gripper.nearest_outside` [m].
OUTSIDE = 2e-3
# How far a joint may be from where inverse kinematics has it, at rest and a centimetre away [rad], and how much nearer
# to anything than where it is the arm may come on its way out [m].
AT_REST, BACKED, NEARER = 0.02, 0.1, 0.005
# Names of the motions that clear the hand before the search goes on.
WITHDRAW, PUT_BACK = "withdraw", "put-back"
# By how much what is held may have turned between the pads when it is put down [rad]: held off its centre, a box of
# 0.35 kg turned by up to 5 degrees in MuJoCo, and a corner that meets the board stops the arm.
SAG = math.radians(5)
# Least confidence of an object by which the distance kept from it is divided.
LEAST_SURE = 0.3
# Of the distance kept where something is put down, the share kept elsewhere in an action.
PASSING = 0.5
# Of that distance, the shares kept after 0, 1, 2, and 3 or more looks at which nothing could be done.
CLEARER = (1.0, 0.5, 0.0, -0.3)
# Farthest that the hand may come into what it does not move [m].
DEEPEST = -0.01
# An object that is predicted to move farther than this is pushed [m].
MOVED = 1e-3
# What stands beside what is picked up may come nearer to it by this as it is taken away [m].
CLOSER = 1e-3


class Setting(recogniser.Setting, Protocol):
    """What a trajectory needs of a problem; `Problem` fulfils it."""

    @property
    def gripper(self) -> Gripper: ...


@dataclasses.dataclass(frozen=True)
class TrajectoryConfig:
    """How trajectories of a robot are made.

    Attributes:
      motion: lengths and durations of the action; with the problem's gripper if None.
      free: how ways through free space are planned.
      bounds: where a controller should stop.
      doubt: when recognition is too doubtful to move.
      hand: how the real hand is used; a `Searcher`'s workcell's, else the default, if None.
      place: where a target that was taken out is put down, see `ArmConfig.place`; a `Searcher`'s workcell's if empty.
      beside: how far hand and held object keep from other objects as they put one down, divided by how sure these are
        [m], and half of it elsewhere in an action that moves an object; below 0, how far they may come into them, and
        into the shelf's margins. A `Searcher` takes less after looks at which nothing could be done (`CLEARER`).
      without_gain: whether a `Searcher` also hands out motions of which no lower cost is expected.
      obstacles: what else the arm keeps clear of; a `Searcher` adds its workcell's, the camera's body among them.
    """

    motion: MotionConfig | None = None
    free: FreeMotionConfig = dataclasses.field(default_factory=FreeMotionConfig)
    bounds: Bounds = dataclasses.field(default_factory=Bounds)
    doubt: DoubtConfig = dataclasses.field(default_factory=DoubtConfig)
    hand: HandConfig | None = None
    place: tuple[float, ...] = ()
    beside: float = 0.01
    without_gain: bool = False
    obstacles: tuple[Obstacle, ...] = ()

    def __post_init__(self):
        check_place("TrajectoryConfig: place", self.place)
        check_range("TrajectoryConfig: beside", self.beside, DEEPEST, FARTHEST, "m")


@dataclasses.dataclass(frozen=True, eq=False)
class _Stage:
    """Rows of one part, the first one timestep after the last row of the part before, the free ways among them, and
    where the target is once the hand has put it down."""

    part: Part
    rows: Rows
    way: FreeMotion | None = None
    placed: np.ndarray | None = None


@in_own_settings
def whole_trajectory(
    problem: Setting,
    observation: Observation,
    decision: Any,
    *,
    joints: Any = None,
    home: Any = None,
    width: Any = None,
    speed: float = 1.0,
    depth: Any = None,
    config: TrajectoryConfig | None = None,
) -> RobotTrajectory:
    """The trajectory from the present joints through a decision's action and home; not to be called inside `jit`.

    The ways through free space are straight in joint space, or planned if something is in the way: the whole arm with
    what it holds keeps clear of the shelf, of the observed objects, of `config.obstacles`, of itself and, on the way
    home, of the predicted objects. In the action, too, it touches none of the obstacles. After a retrieval the hand
    puts the target down at `config.place`; if there is none, or it cannot, it brings the target home, or stops outside
    the shelf if the target would hit something at home. The trajectory of no action is the way home.

    As it puts an object down, the hand and what it holds keep `config.beside`, divided by the other object's
    confidence, from each other object, and the hand stays out of the shelf's margins; the object is let go as high as a
    corner may hang if it turns between the fingers. On its way there, and where it pushes, it keeps half of that from
    what the action is not predicted to move. A retrieval does not: its grasp is the clearest that there is.

    The fingers move as a real hand does: what it does is in `events`, and the arm stands still where one has to have
    ended. The first, which opens or closes them for the action, is there whatever `width` is.

    Args:
      problem: the constants.
      observation: before the action, without batch axes.
      decision: a `Decision`, or an `Action` without a prediction.
      joints: present joint angles, shape (7,) [rad]; `home` if left out.
      home: final joint angles, shape (7,) [rad]; `kinematics.HOME` if left out.
      width: present distance between the fingers [m]; if left out, they are taken to be open, and there is time for
        the longest way that they may have.
      speed: share of the joints' velocity limits, above 0 and at most 1; accelerations reach the share's square of
        their limits, and jerks its cube.
      depth: the depth image that `observation` comes from; with it, recognition that does not explain the image is
        refused, see `perception.doubt`.
      config: how it is made; the default if None.

    Raises:
      InputError: an argument is impossible, recognition is too doubtful, the arm does not reach all of the action,
        touches an obstacle in it, or comes too near to what it does not move, or the way to it or home is blocked.
    """
    config, observation = config or TrajectoryConfig(), observation.with_boxes()
    home = np.array(HOME if home is None else home, float)
    joints = home if joints is None else np.array(joints, float)
    arm = problem.gripper.arm
    check_joints("home", home, arm)
    check_joints("joints", joints, arm)
    check_place("TrajectoryConfig: place", config.place, arm)
    if not 0.0 < speed <= 1.0:
        raise InputError(f"speed: {speed} must be above 0 and at most 1, a share of the joints' limits")
    width = None if width is None else checked_width(width, problem.gripper.max_opening)
    if depth is not None:
        check_recognition(problem, observation, depth, config.doubt)
    action = getattr(decision, "action", decision)
    after = getattr(decision, "predicted", None)
    return _Assembly(problem, observation, action, after, config, speed).run(joints, home, width)


@in_own_settings
def way_out(
    problem: Setting,
    observation: Observation,
    joints: Float[np.ndarray, " 7"],
    *,
    home: Any = None,
    width: float | None = None,
    speed: float = 1.0,
    config: TrajectoryConfig | None = None,
    holding: Action | None = None,
    pushing: Action | None = None,
) -> RobotTrajectory | None:
    """The trajectory of a hand inside the shelf straight back, out and home, with its fingers as they are; None for a
    hand outside. Not to be called inside `jit`. From what it pushes it backs away first, as after a push.

    Args:
      problem, observation, home, width, speed, config: as of `whole_trajectory`.
      joints: present joint angles [rad].
      holding: the action in which the hand grasped what it holds, if anything, as `observation` has it.
      pushing: the push in which it stopped, if it did.

    Raises:
      InputError: the arm does not follow that way in its present configuration, or comes nearer to the shelf on it,
        with something in the hand also to an object; or the way home is blocked.
    """
    config = config or TrajectoryConfig()
    home = np.array(HOME if home is None else home, float)
    tip = tip_positions(joints[None])[0]
    if tip[0] <= problem.gripper.nearest_outside + OUTSIDE:
        return None
    making = _Assembly(problem, observation.with_boxes(), holding or no_action(), None, config, speed)
    away = np.zeros(3)
    if pushing is not None:
        ahead = np.asarray(pushing.displacement, float)
        ahead /= np.linalg.norm(ahead)
        pushed = (tip - np.asarray(pushing.T_world_gripper, float)[:3, 3]) @ ahead
        away = -np.clip(pushed, 0.0, making.motion.release) * ahead
    return making.out(joints, home, problem.gripper.max_opening if width is None else width, away)


@in_own_settings
def way_back(
    problem: Setting,
    observation: Observation,
    action: Action,
    now: Observation,
    *,
    joints: Any = None,
    home: Any = None,
    width: float,
    speed: float = 1.0,
    config: TrajectoryConfig | None = None,
) -> RobotTrajectory:
    """The trajectory of a hand outside the shelf that holds an object: it puts it back where it grasped it, and goes
    home. Not to be called inside `jit`.

    Args:
      problem, joints, home, width, speed, config: as of `whole_trajectory`.
      observation, action: the action in which the hand grasped the object, and what was observed before it.
      now: the present observation.

    Raises:
      InputError: the arm does not reach that place, something stands there now, or the way there or home is blocked.
    """
    config = config or TrajectoryConfig()
    home = np.array(HOME if home is None else home, float)
    joints = home if joints is None else np.array(joints, float)
    making = _Assembly(problem, observation.with_boxes(), action, None, config, speed)
    return making.back(joints, home, width, now.with_boxes().objects)


class _Assembly:
    """The making of one trajectory."""

    def __init__(
        self,
        problem: Setting,
        observation: Observation,
        action: Action,
        after: Superquadrics | None,
        config: TrajectoryConfig,
        speed: float,
    ):
        self.problem, self.observation, self.action, self.after = problem, observation, action, after
        self.config, self.speed, self.hand = config, speed, config.hand or HandConfig()
        self.motion = motion_with(problem.gripper, config.motion)
        self.kind: Kind = kind_of(int(action.kind))
        self._known: dict[_Stage, list[tuple[bool, Nearest]]] = {}

    def run(self, joints: np.ndarray, home: np.ndarray, width: float | None) -> RobotTrajectory:
        widest = self.problem.gripper.max_opening
        present = widest if width is None else width
        reference = self._reference()
        if reference is None:
            back = self._free("the way home", joints, home, ArmBody.of(present), self._obstacles())
            return self._joined(joints, present, [self._travel(Part.WAY_HOME, back, present)], True)

        begin = np.asarray(reference.start, float)
        opened = 2.0 * max(begin[7], 0.0)
        farthest = longest_way(opened, widest) if width is None else opened - present
        stages = [self._way_there(joints, begin[:7], present, opened, self.hand.time(farthest))]
        grip = grip_for(self.problem, self.observation, self.action)
        stages.append(_Stage(Part.ACTION, acting(reference, grip, self.motion, self.hand, self.speed)))
        self._check_obstacles(stages[-1])
        self._check_beside(stages[-1])
        between = self._between(stages[-1].rows)

        fault, at_home = "", True
        if self.kind.takes_target and self.config.place:
            try:
                placing = self._placing(stages[-1].rows, home)
                return self._joined(joints, present, stages + placing, True, between)
            except InputError as error:
                fault = str(error)
        way_home = self._way_home(stages[-1].rows, home)
        at_home = way_home is not None
        stages += [way_home] if way_home is not None else []
        return self._joined(joints, present, stages, at_home, between, fault)

    def out(self, joints: np.ndarray, home: np.ndarray, width: float, away: np.ndarray) -> RobotTrajectory:
        """`way_out`, after a displacement of the hand [m]."""
        T = np.array(link_poses(joints[None])[0, HAND_FRAME], float)
        T[:3, 3] = tip_positions(joints[None])[0] + away
        q, follows = self._straight_in(T, joints[6])
        moves = away.any()
        if not follows or np.abs(q[-1] - joints).max() > (BACKED if moves else AT_REST):
            raise InputError("withdraw: the arm cannot follow a straight way out of the shelf; take it out by hand")
        q = np.concatenate([joints[None], q[::-1][0 if moves else 1 :]])
        holds, known = self.kind.holds_object or self.kind.takes_target, self.config.obstacles
        body, around = ArmBody.of(width, self._held() if holds else None), self._around
        # A hand that holds nothing goes where it came from, between objects.
        fixed = around if holds else Obstacles.of(self.problem.shelf, (), self.config.free.floor, bodies=known)
        each = clearance(body, fixed, q).each
        touches = np.flatnonzero((each < np.minimum(each[:1], 0.0) - NEARER).any(axis=0))
        if len(touches):
            what = fixed.names[touches[0]]
            raise InputError(f"withdraw: on a straight way out the arm would touch {what}; take it out by hand")
        force, pace = (self.hand.force, self.motion.carry_pace) if holds else (0.0, 1.0)
        # The arm rests where it has backed away, lest it cut the corner.
        ways = [self._timed(way, width, force) for way in ([q[:2], q[1:]] if moves else [q])]
        back = self._free("the way home", ways[-1].position[-1], home, body, around, pace=pace)
        stages = [*(_Stage(Part.WAY_HOME, way) for way in ways), self._travel(Part.WAY_HOME, back, width, force)]
        return dataclasses.replace(self._joined(joints, width, stages, True), action=WITHDRAW)

    def back(self, joints: np.ndarray, home: np.ndarray, width: float, now: Superquadrics) -> RobotTrajectory:
        """`way_back`."""
        T, opened, name = np.array(self.action.T_world_gripper, float), float(self.action.opening), self._acted_on
        T[2, 3] += self.motion.clearance + self._sag()
        q, follows = self._straight_in(T, self.action.q7)
        if not follows:
            raise InputError("the arm does not reach its place")
        held = ArmBody.of(width, self._held())
        there = self._free("the way to its place", joints, q[0], held, self._around, pace=self.motion.carry_pace)
        parts = [
            self._timed(q, width, self.hand.force),
            opening_to(q[-1], width, opened, self.hand, self.motion.timestep),
        ]
        parts.append(self._timed(q[::-1], opened, 0.0))
        action = _Stage(Part.ACTION, joined(parts, self.motion.timestep))
        seen = Obstacles.of(self.problem.shelf, (now,), self.config.free.floor)
        near = [(each.body, each.distance) for each in self._nearest([action])[0]]
        near += [(body, distance) for body, distance, _ in nearest_rows(held, seen, q)]
        meets = [body for body, distance in near if body not in ALWAYS and distance < -NEARER]
        if meets:
            raise InputError(f"on the way to its place the hand, or {name} in it, would touch {meets[0]}")
        back = self._free("the way home", q[0], home, ArmBody.of(opened), self._around)
        stages = [
            self._travel(Part.WAY_THERE, there, width, self.hand.force),
            action,
            self._travel(Part.WAY_HOME, back, opened),
        ]
        return dataclasses.replace(self._joined(joints, width, stages, True), action=PUT_BACK)

    @property
    def _around(self) -> Obstacles:
        """What was observed, without what the hand holds."""
        holds = self.kind.holds_object or self.kind.takes_target
        return self._obstacles(without=int(self.action.object) if holds else None)

    def _straight_in(self, T: np.ndarray, q7: Any) -> tuple[np.ndarray, bool]:
        """Joint angles of the way in to a pose of the gripper [rad], no two alike, and whether the arm follows it."""
        waypoints, gripper = self.motion.waypoints, self.problem.gripper
        way, follows, _ = ways_in(jnp.asarray(T, jnp.float32), jnp.float32(q7), gripper, waypoints, waypoints)
        q = np.array(way, float)
        # What is the same pose twice would have no direction.
        return q[np.concatenate([np.abs(np.diff(q, axis=0)).max(axis=1) > 1e-6, [True]])], bool(follows)

    def _timed(self, q: np.ndarray, width: float, force: float) -> Rows:
        """Rows along joint angles, from rest to rest with resting fingers, at the pace with something in the hand."""
        pace, timestep = self.speed * self.motion.carry_pace, self.motion.timestep
        rows = timed_rows(respaced(q, WAYPOINTS), timestep, pace, arm=self.motion.gripper.arm)
        return Rows(rows, np.full(len(rows), width), np.full(len(rows), force))

    def _way_there(self, joints: np.ndarray, end: np.ndarray, before: float, after: float, least: float) -> _Stage:
        """The way to where the action begins, while the fingers move from one distance to another."""
        body = ArmBody.of(max(before, after))
        way = self._free(f"the way to the {self.kind.name}", joints, end, body, self._obstacles(), least=least)
        width, _ = stroke(before, after, len(way.position), self.motion.timestep, self.hand)
        event = HandMove(0.0, least, False, after, self.hand.speed)
        return _Stage(Part.WAY_THERE, Rows(way.position, width, np.zeros(len(width)), (event,)), way)

    def _way_home(self, acted: Rows, home: np.ndarray) -> _Stage | None:
        """The way home after the action; None if home is not free with what the hand holds."""
        held = self._held() if self.kind.takes_target else None
        left = float(acted.width[-1])
        body, obstacles = ArmBody.of(left, held), self._obstacles(afterwards=True)
        if held is not None and not _is_free(body, obstacles, home):
            return None
        pace = self.motion.carry_pace if held else 1.0
        back = self._free("the way home", acted.position[-1], home, body, obstacles, pace=pace)
        return self._travel(Part.WAY_HOME, back, left, float(acted.force[-1]))

    def _placing(self, acted: Rows, home: np.ndarray) -> list[_Stage]:
        """The ways to the place of the target, down to it, back from it, and home.

        Raises:
          InputError: the arm does not reach the place, or a way is not free.
        """
        what = grasped(self.problem, self.observation, self.action)
        T_world_gripper = np.asarray(self.action.T_world_gripper, float)
        # As an object is let go: so high that a corner which turned between the fingers does not meet its stand.
        foot = self.problem.target.solid.bottom + self._sag()
        ways = place_ways(
            self.config.place,
            T_world_gripper,
            what.T_world_object if what.seen else None,
            foot,
            self.motion.gripper.arm,
        )
        fault: InputError | None = None
        for way in ways:
            try:
                return self._placing_along(way, acted, home)
            except InputError as error:
                fault = fault or error
        assert fault is not None
        raise fault

    def _placing_along(self, way: PlaceWay, acted: Rows, home: np.ndarray) -> list[_Stage]:
        """`_placing` along one way."""
        held, opened = float(acted.width[-1]), self.problem.gripper.max_opening
        force, pace, timestep = float(acted.force[-1]), self.speed * self.motion.carry_pace, self.motion.timestep
        around, body = self._obstacles(afterwards=True), ArmBody.of(opened)
        free = clearance(body, around, np.concatenate([way.down, way.back]))
        if free.free.min() <= 0.0:
            raise InputError(f"place: there the arm touches {touched(around, free.each)}")
        if free.inside.max() > 0.0:
            raise InputError("place: there the arm is inside the shelf")
        there = self._free(
            "the way to the place",
            acted.position[-1],
            way.down[0],
            ArmBody.of(held, self._held()),
            around,
            pace=self.motion.carry_pace,
        )
        parts = [Rows(there.position, np.full(len(there.position), held), np.full(len(there.position), force))]
        if len(way.down) > 1:
            q = timed_rows(way.down, timestep, pace, arm=self.motion.gripper.arm)
            parts.append(Rows(q, np.full(len(q), held), np.full(len(q), force)))
        parts.append(opening_to(way.down[-1], held, opened, self.hand, timestep))
        if len(way.back) > 1:
            q = timed_rows(way.back, timestep, pace, arm=self.motion.gripper.arm)
            parts.append(Rows(q, np.full(len(q), opened), np.zeros(len(q))))
        if way.T_world_placed is not None:
            around = self._obstacles(afterwards=True, placed=way.T_world_placed)
        back = self._free("the way home from the place", way.back[-1], home, body, around)
        return [
            _Stage(Part.PLACE, joined(parts, timestep), there, way.T_world_placed),
            dataclasses.replace(self._travel(Part.WAY_HOME, back, opened), placed=way.T_world_placed),
        ]

    def _reference(self) -> Reference | None:
        action = self.action
        if self.kind.holds_object:
            action = action.replace(T_world_place=jnp.asarray(action.T_world_place).at[2, 3].add(self._sag()))
        motion = reference_motion(self.kind, action, self.motion)
        if motion is None:
            return None
        reference, reachable = motion
        if not reachable:
            raise InputError(f"{self.kind.name}: the arm does not reach all of this motion; decide anew")
        return jax.device_get(reference)

    def _obstacles(
        self, afterwards: bool = False, without: int | None = None, placed: np.ndarray | None = None
    ) -> Obstacles:
        """The shelf and the objects: as observed, and if `afterwards`, also as predicted after the action.

        Args:
          afterwards: whether the action is over.
          without: slot of an object that is left out.
          placed: pose of the target at its place.
        """
        seen = self.observation.objects
        if without is not None and without < seen.capacity:
            seen = seen.replace(valid=np.asarray(seen.valid) & (np.arange(seen.capacity) != without))
        scenes = [seen]
        if afterwards and self.after is not None:
            scenes.append(self.after)
        # A target that the action takes out, pushes or carries leaves its place.
        moved = self.kind.takes_target or (self.kind.moves_object and int(self.action.object) >= seen.capacity)
        target = []
        if bool(self.observation.target_visible) and not ((afterwards or without is not None) and moved):
            target.append(self._target_scene(target_pose(self.problem, self.observation)))
        if placed is not None:
            target.append(self._target_scene(placed))
        config = self.config
        return Obstacles.of(
            self.problem.shelf, tuple(scenes), config.free.floor, target=tuple(target), bodies=config.obstacles
        )

    def _target_scene(self, pose: np.ndarray) -> Superquadrics:
        """The target at a pose, as a scene of one object."""
        T = pose[None]
        scene = body_at(self.problem.target, T[:, :3, 3], T[:, :3, :3], np.array([True]))
        # Boxes around the parts are nearer to it than the one around the whole.
        return scene if scene.parts is None else world_parts(jax.tree.map(jnp.asarray, scene))

    def _held(self) -> Held:
        """What the closed hand holds; a target that is not visible is assumed between the fingers."""
        what = grasped(self.problem, self.observation, self.action)
        T_gripper_world = np.linalg.inv(np.asarray(self.action.T_world_gripper, float))
        return Held.of(T_gripper_world @ what.T_world_object, what.size, what.exponents)

    def _sag(self) -> float:
        """How much lower a corner of the held object may hang, which turns about the closing direction [m]."""
        what, T = grasped(self.problem, self.observation, self.action), np.asarray(self.action.T_world_gripper, float)
        across = np.cross(T[:3, 1], [0.0, 0.0, 1.0])
        pose = what.T_world_object
        reach = abs(across @ (pose[:3, 3] - T[:3, 3])) + np.abs(across @ pose[:3, :3]) @ np.array(what.size)
        return float(reach) * math.sin(SAG)

    def _free(
        self,
        name: str,
        start: np.ndarray,
        end: np.ndarray,
        body: ArmBody,
        obstacles: Obstacles,
        *,
        least: float = 0.0,
        pace: float = 1.0,
    ) -> FreeMotion:
        try:
            return free_motion(
                start,
                end,
                body,
                obstacles,
                timestep=self.motion.timestep,
                pace=self.speed * pace,
                least=least,
                config=self.config.free,
                arm=self.motion.gripper.arm,
            )
        except InputError as error:
            raise InputError(f"{name}: {error}") from error

    def _travel(self, part: Part, way: FreeMotion, width: float, force: float = 0.0) -> _Stage:
        """A way through free space with resting fingers."""
        rows = len(way.position)
        return _Stage(part, Rows(way.position, np.full(rows, width), np.full(rows, force)), way)

    def _between(self, acted: Rows) -> float:
        """Clearance while a pick-and-place carries its object from one pose outside the shelf to another [m].

        Raises:
          InputError: the arm touches something there.
        """
        if not self.kind.holds_object:
            return np.inf
        x = tip_positions(acted.position)[:, 0]
        carries = (x <= self.problem.gripper.nearest_outside + OUTSIDE) & (acted.force > 0.0)
        if not carries.any():
            return np.inf
        body = ArmBody.of(self.problem.gripper.max_opening, self._held())
        obstacles = self._obstacles(without=int(self.action.object))
        distances = clearance(body, obstacles, acted.position[carries])
        free = float(distances.free.min())
        if free <= 0.0:
            what = touched(obstacles, distances.each)
            raise InputError(f"{self.kind.name}: in front of the shelf the arm touches {what}; decide anew")
        return free

    @property
    def _acted_on(self) -> str | None:
        """What the action pushes or grasps, as messages call it."""
        number = int(self.action.object)
        if self.kind.takes_target or (self.kind.moves_object and number >= self.observation.objects.capacity):
            return TARGET
        return f"object {number}" if self.kind.moves_object else None

    def _check_obstacles(self, action: _Stage) -> None:
        """Check that the arm touches no obstacle of the cell in the action.

        Raises:
          InputError: it does.
        """
        bodies = {f'obstacle "{body.name}"' for body in self.config.obstacles}
        touches = [near for near in self._nearest([action])[0] if near.body in bodies and near.distance <= 0.0]
        if touches:
            name, depth = touches[0].body, -1000 * touches[0].distance
            raise InputError(f"{self.kind.name}: the arm would pass {depth:.0f} mm through {name}; decide anew")

    def _check_beside(self, action: _Stage) -> None:
        """Check that hand and held object keep clear of what the action is not to move; where they put an object down,
        more, and of the shelf, too.

        Raises:
          InputError: they do not.
        """
        if not self.kind.moves_object or self.kind.takes_target:
            return
        acted, carried, keep = action.rows, int(self.action.object), self.config.beside
        others = np.arange(self.observation.objects.capacity) != carried
        beside = {f"object {i}": max(keep, keep / share) for i, share in enumerate(self._sure()) if others[i]}
        if self._acted_on != TARGET:
            beside[TARGET] = keep
        x, holds, rows = tip_positions(acted.position)[:, 0], acted.force > 0.0, np.arange(len(acted.width))
        outside = rows[(x <= self.problem.gripper.nearest_outside + OUTSIDE) & holds]
        before = rows < outside[-1] if len(outside) else rows >= 0
        near = f"the hand{' or what it holds' if self.kind.holds_object else ''} would be"
        # The shelf has margins of its own, 9 mm and more.
        what = f"where it puts object {carried} down, {near}"
        for phase, part in ((1, rows[~before & holds]), (2, rows[~before & ~holds])):
            self._keep_clear(action, phase, part, {**beside, SHELF: min(keep, 0.0)}, what)
        still = {name: PASSING * least for name, least in beside.items() if name not in self._moved()}
        for phase, part in ((0, rows[before & ~holds]), (1, rows[before & holds])):
            self._keep_clear(action, phase, part, still, f"on its way {near}", from_start=True)

    def _keep_clear(
        self, action: _Stage, phase: int, rows: np.ndarray, least: dict[str, float], what: str, from_start: bool = False
    ) -> None:
        """Check that rows of a phase keep distances from bodies by their names [m].

        Args:
          action, phase, rows: of it.
          least: the distances.
          what: comes too near, in words.
          from_start: whether it may come as near as in the first of the rows, and a little nearer.

        Raises:
          InputError: it comes too near.
        """
        if not len(rows):
            return
        at_start = {n: d - CLOSER for n, d, _ in self._nearest_rows(action, phase, rows[:1])} if from_start else {}
        for name, distance, _ in self._nearest_rows(action, phase, rows):
            if distance < min(least.get(name, -np.inf), at_start.get(name, np.inf)):
                raise InputError(
                    f"{self.kind.name}: {what} {1000 * distance:.0f} mm from {name}, not "
                    f"{1000 * least[name]:.0f} mm or more; decide anew"
                )

    def _moved(self) -> set[str]:
        """Names of the objects that the action is predicted to move."""
        now, after = self.observation.objects, self.after
        if after is None:
            return set()
        shift = np.linalg.norm(np.asarray(after.position, float) - np.asarray(now.position, float), axis=-1)
        return {f"object {i}" for i in np.flatnonzero(shift > MOVED)}

    def _sure(self) -> np.ndarray:
        """The confidence of each object, at least `LEAST_SURE`."""
        return np.maximum(np.asarray(self.observation.judged().confidence, float), LEAST_SURE)

    def _nearest(self, stages: list[_Stage]) -> tuple[tuple[Nearest, ...], tuple[Nearest, ...]]:
        """How near the stages come to everything, and to what the action is for while it lasts, the nearest first."""
        least: tuple[dict[str, Nearest], dict[str, Nearest]] = {}, {}
        before = 0.0
        for stage in stages:
            if stage not in self._known:
                self._known[stage] = self._nearest_in(stage)
            for intended, near in self._known[stage]:
                known = least[intended].get(near.body)
                if known is None or near.distance < known.distance:
                    least[intended][near.body] = dataclasses.replace(near, time=before + near.time)
            before += len(stage.rows.width) * self.motion.timestep
        nearest, contacts = (tuple(sorted(each.values(), key=lambda near: near.distance)) for each in least)
        return nearest, contacts

    def _nearest_in(self, stage: _Stage) -> list[tuple[bool, Nearest]]:
        """How near a stage comes to each body in each of its phases, and whether that is what the action is for."""
        found = []
        acts, holds = stage.part in (Part.ACTION, Part.PLACE), stage.rows.force > 0.0
        # Before, while and after the hand holds something.
        phases = np.where(holds, 1, 2 * np.maximum.accumulate(holds))
        for phase in np.unique(phases):
            rows = np.flatnonzero(phases == phase)
            for name, distance, row in self._nearest_rows(stage, int(phase), rows):
                near = Nearest(name, distance, float(rows[row] + 1) * self.motion.timestep)
                found.append((acts and name == self._acted_on, near))
        return found

    def _nearest_rows(self, stage: _Stage, phase: int, rows: np.ndarray) -> list[tuple[str, float, int]]:
        """Each body, the least distance from it in rows of a phase of a stage [m], and in which of them."""
        acts, holding = stage.part in (Part.ACTION, Part.PLACE), phase == 1
        capacity = self.observation.objects.capacity
        carried = capacity if self.kind.takes_target else int(self.action.object)
        obstacles = self._obstacles(
            afterwards=phase == 2 or stage.part in (Part.PLACE, Part.WAY_HOME),
            without=carried if holding else None,
            placed=None if holding else stage.placed,
        )
        q, opening = stage.rows.position[rows], float(stage.rows.width[rows].max())
        near = nearest_rows(ArmBody.of(opening, self._held() if holding else None), obstacles, q)
        if holding and acts:
            # What is held stands on the shelf, or the floor, before and after.
            bare = nearest_rows(ArmBody.of(opening), obstacles.bare, q)
            near = [*bare, *near[len(bare) :]]
        return near

    def _joined(
        self,
        joints: np.ndarray,
        width: float,
        stages: list[_Stage],
        at_home: bool,
        between: float = np.inf,
        fault: str = "",
    ) -> RobotTrajectory:
        timestep = self.motion.timestep
        rows = joined([stage.rows for stage in stages], timestep)
        position = np.concatenate([joints[None], rows.position])
        velocity, acceleration = derivatives(position, timestep, rows.rests)
        ways = [stage.way for stage in stages if stage.way is not None]
        nearest, intended = self._nearest(stages)
        return RobotTrajectory(
            time=np.arange(len(position)) * timestep,
            position=position,
            velocity=velocity,
            acceleration=acceleration,
            width=np.concatenate([[width], rows.width]),
            force=np.concatenate([[0.0], rows.force]),
            part=np.concatenate([[stages[0].part], *(np.full(len(s.rows.width), s.part) for s in stages)]),
            action=self.kind.name,
            bounds=self.config.bounds,
            clearance=min(between, *(way.clearance for way in ways)),
            straight=all(way.straight for way in ways),
            ends_at_home=at_home,
            events=rows.events,
            place_fault=fault,
            arm=self.motion.gripper.arm,
            nearest=nearest,
            intended=intended,
        )


def _is_free(body: ArmBody, obstacles: Obstacles, q: np.ndarray) -> bool:
    distances = clearance(body, obstacles, q[None])
    return bool(distances.free[0] > 0.0 and distances.inside[0] <= 0.0)
