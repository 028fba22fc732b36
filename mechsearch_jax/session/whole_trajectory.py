"""The trajectory of a decision: from the present joints through the action and home."""

from __future__ import annotations

import dataclasses
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from mechsearch_jax.actions.kind import Kind
from mechsearch_jax.actions.registry import kind_of
from mechsearch_jax.actions.trajectory import reference_motion
from mechsearch_jax.actions.types import Action
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import upright_pose
from mechsearch_jax.observation import Observation
from mechsearch_jax.perception import recogniser
from mechsearch_jax.perception.doubt import DoubtConfig, check_recognition
from mechsearch_jax.robot.arm_clearance import ArmBody, Held, Obstacles, clearance, tip_positions
from mechsearch_jax.robot.free_motion import SPARE, FreeMotion, FreeMotionConfig, check_joints, free_motion
from mechsearch_jax.robot.gripper import Gripper
from mechsearch_jax.robot.kinematics import HOME
from mechsearch_jax.robot.motion import MotionConfig, Reference
from mechsearch_jax.robot.robot_trajectory import (
    Bounds,
    Part,
    RobotTrajectory,
    derivatives,
    limit_shares,
    places_when_slowed,
    slowed,
)
from mechsearch_jax.runtime.errors import InputError

# How fast the distance between the fingers changes on the ways through free space [m/s].
FINGER_SPEED = 0.1
# Tolerance within which a gripper counts as at `Gripper.nearest_outside` [m].
OUTSIDE = 2e-3


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
      bounds: where a controller should stop, and how it grips.
      doubt: when recognition is too doubtful to move.
    """

    motion: MotionConfig | None = None
    free: FreeMotionConfig = dataclasses.field(default_factory=FreeMotionConfig)
    bounds: Bounds = dataclasses.field(default_factory=Bounds)
    doubt: DoubtConfig = dataclasses.field(default_factory=DoubtConfig)


@dataclasses.dataclass(frozen=True, eq=False)
class _Stage:
    """Rows of one part: joint angles [rad], distance between the fingers [m] and grip force [N].

    The first row comes one timestep after the last row of the part before.
    """

    part: Part
    position: np.ndarray
    width: np.ndarray
    force: np.ndarray


def whole_trajectory(
    problem: Setting,
    observation: Observation,
    decision: Any,
    *,
    joints: Any = None,
    home: Any = None,
    width: float = 0.0,
    speed: float = 1.0,
    depth: Any = None,
    config: TrajectoryConfig | None = None,
) -> RobotTrajectory:
    """The trajectory from the present joints through a decision's action and home; not to be called inside `jit`.

    The ways through free space are straight in joint space, or planned if something is in the way: the whole arm with
    what it holds keeps clear of the shelf, of the observed objects, of itself and, on the way home, of the predicted
    objects. After a retrieval the hand brings the target home, or stops outside the shelf if the target would hit
    something at home. The trajectory of no action is the way home.

    Args:
      problem: the constants.
      observation: before the action, without batch axes.
      decision: a `Decision`, or an `Action` without a prediction.
      joints: present joint angles, shape (7,) [rad]; `home` if left out.
      home: final joint angles, shape (7,) [rad]; `kinematics.HOME` if left out.
      width: present distance between the fingers [m].
      speed: share of the joints' velocity limits, above 0 and at most 1; accelerations reach the share's square of
        their limits, and jerks its cube.
      depth: the depth image that `observation` comes from; with it, recognition that does not explain the image is
        refused, see `perception.doubt`.
      config: how it is made; the default if None.

    Raises:
      InputError: an argument is impossible, recognition is too doubtful, the arm does not reach all of the action, or
        the way to it or home is blocked.
    """
    config = config or TrajectoryConfig()
    home = np.array(HOME if home is None else home, float)
    joints = home if joints is None else np.array(joints, float)
    check_joints("home", home)
    check_joints("joints", joints)
    if not 0.0 < speed <= 1.0:
        raise InputError(f"speed: {speed} must be above 0 and at most 1, a share of the joints' limits")
    if not 0.0 <= width <= problem.gripper.max_opening + 1e-6:
        raise InputError(f"width: {width} m must be between 0 and the gripper's {problem.gripper.max_opening}")
    if depth is not None:
        check_recognition(problem, observation, depth, config.doubt)
    action = getattr(decision, "action", decision)
    after = getattr(decision, "predicted", None)
    return _Assembly(problem, observation, action, after, config, speed).run(joints, home, width)


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
        self.config, self.speed = config, speed
        self.motion = config.motion or MotionConfig(gripper=problem.gripper)
        self.kind: Kind = kind_of(int(action.kind))

    def run(self, joints: np.ndarray, home: np.ndarray, width: float) -> RobotTrajectory:
        reference = self._reference()
        if reference is None:
            back = self._free("the way home", joints, home, ArmBody.of(width), self._obstacles(), abs(width))
            return self._joined(joints, width, [self._travel(Part.WAY_HOME, back, width, 0.0)], [back], True)

        begin = np.asarray(reference.start, float)
        opened = 2.0 * max(begin[7], 0.0)
        body = ArmBody.of(max(width, opened))
        approach = self._free(
            f"the way to the {self.kind.name}", joints, begin[:7], body, self._obstacles(), opened - width
        )
        stages, ways = [self._travel(Part.WAY_THERE, approach, width, opened)], [approach]

        acting = self._acting(reference)
        stages.append(acting)
        between = self._between(acting)

        end, left = acting.position[-1], float(acting.width[-1])
        held = self._held() if self.kind.takes_target else None
        body, obstacles = ArmBody.of(0.0 if held else left, held), self._obstacles(afterwards=True)
        at_home = held is None or _is_free(body, obstacles, home)
        if at_home:
            pace = self.motion.carry_pace if held else 1.0
            back = self._free("the way home", end, home, body, obstacles, 0.0 if held else left, pace)
            stages.append(self._travel(Part.WAY_HOME, back, left, left if held else 0.0, acting.force[-1]))
            ways.append(back)
        return self._joined(joints, width, stages, ways, at_home, between)

    def _reference(self) -> Reference | None:
        motion = reference_motion(self.kind, self.action, self.motion)
        if motion is None:
            return None
        reference, reachable = motion
        if not reachable:
            raise InputError(f"{self.kind.name}: the arm does not reach all of this motion; decide anew")
        return jax.device_get(reference)

    def _obstacles(self, afterwards: bool = False, without: int | None = None) -> Obstacles:
        """The shelf and the objects: as observed, and if `afterwards`, also as predicted after the action."""
        seen = self.observation.objects
        if without is not None and without < seen.capacity:
            seen = seen.replace(valid=np.asarray(seen.valid) & (np.arange(seen.capacity) != without))
        scenes = [seen]
        if afterwards and self.after is not None:
            scenes.append(self.after)
        # A target that the action takes out, pushes or carries leaves its place.
        moved = self.kind.takes_target or (self.kind.moves_object and int(self.action.object) >= seen.capacity)
        if bool(self.observation.target_visible) and not ((afterwards or without is not None) and moved):
            scenes.append(self._target_scene())
        return Obstacles.of(self.problem.shelf, tuple(scenes), self.config.free.floor)

    def _target_pose(self) -> np.ndarray:
        pose = jnp.asarray(self.observation.target_pose, jnp.float32)
        return np.asarray(upright_pose(pose, self.problem.target.height(self.problem.shelf)), float)

    def _target_scene(self) -> Superquadrics:
        """The target as observed, as a scene of one object."""
        T, target = self._target_pose()[None], self.problem.target
        return Superquadrics(
            size=np.array([target.half_size]),  # pyright: ignore[reportArgumentType]
            exponents=np.array([target.exponents]),  # pyright: ignore[reportArgumentType]
            position=T[:, :3, 3],  # pyright: ignore[reportArgumentType]
            rotation=T[:, :3, :3],  # pyright: ignore[reportArgumentType]
            valid=np.array([True]),  # pyright: ignore[reportArgumentType]
        )

    def _held(self) -> Held:
        """What the closed hand holds; a target that is not visible is assumed between the fingers."""
        T_world_gripper = np.asarray(self.action.T_world_gripper, float)
        scene, i = self.observation.objects, int(self.action.object)
        if self.kind.holds_object and i < scene.capacity:
            T_world_held = np.eye(4)
            T_world_held[:3, :3], T_world_held[:3, 3] = np.asarray(scene.rotation[i]), np.asarray(scene.position[i])
            x, y, z = np.asarray(scene.size[i], float).tolist()
            return Held(np.linalg.inv(T_world_gripper) @ T_world_held, (x, y, z))
        T_world_held = self._target_pose()
        if not bool(self.observation.target_visible):
            T_world_held[:3, 3] = T_world_gripper[:3, 3]
        return Held(np.linalg.inv(T_world_gripper) @ T_world_held, self.problem.target.half_size)

    def _free(
        self,
        name: str,
        start: np.ndarray,
        end: np.ndarray,
        body: ArmBody,
        obstacles: Obstacles,
        opens: float,
        pace: float = 1.0,
    ) -> FreeMotion:
        # The fingers start and stop smoothly, which takes 1.5 times as long.
        least = 1.5 * abs(opens) / (FINGER_SPEED * self.speed)
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
            )
        except InputError as error:
            raise InputError(f"{name}: {error}") from error

    def _travel(self, part: Part, way: FreeMotion, before: float, after: float, force: float = 0.0) -> _Stage:
        share = np.arange(1, len(way.position) + 1) / max(len(way.position), 1)
        width = before + (after - before) * share * share * (3.0 - 2.0 * share)
        return _Stage(part, way.position, width, np.full(len(width), force))

    def _acting(self, reference: Reference) -> _Stage:
        """The rows of the action, slowed down until they respect the joints' limits."""
        steps, timestep = int(reference.length), self.motion.timestep
        start = np.asarray(reference.start, float)
        position = np.concatenate([start[None, :7], np.asarray(reference.q[:steps], float)])
        fingers = np.concatenate([start[7:], np.asarray(reference.fingers[:steps], float)])
        force = np.zeros(steps + 1)
        closed, opens = int(reference.closed), int(reference.opens)
        if closed:
            force[closed - self.motion.close_steps + 1 : opens + 1] = self.config.bounds.grip_force
        velocity, acceleration, jerk = limit_shares(position, timestep)
        reached = max(velocity, acceleration ** (1 / 2), jerk ** (1 / 3))
        factor = max(1.0, reached / (self.speed * (1.0 - SPARE)))
        places = places_when_slowed(len(position), factor)
        rows = np.arange(len(position))
        return _Stage(
            Part.ACTION,
            slowed(position, factor)[1:],
            2.0 * np.maximum(np.interp(places, rows, fingers), 0.0)[1:],
            force[np.round(places).astype(int)][1:],
        )

    def _between(self, acting: _Stage) -> float:
        """Clearance while a pick-and-place carries its object from one pose outside the shelf to another [m].

        Raises:
          InputError: the arm touches something there.
        """
        if not self.kind.holds_object:
            return np.inf
        x = tip_positions(acting.position)[:, 0]
        carries = (x <= self.problem.gripper.nearest_outside + OUTSIDE) & (acting.force > 0.0)
        if not carries.any():
            return np.inf
        body = ArmBody.of(self.problem.gripper.max_opening, self._held())
        obstacles = self._obstacles(without=int(self.action.object))
        free = float(clearance(body, obstacles, acting.position[carries]).free.min())
        if free <= 0.0:
            raise InputError(f"{self.kind.name}: the arm touches something in front of the shelf; decide anew")
        return free

    def _joined(
        self,
        joints: np.ndarray,
        width: float,
        stages: list[_Stage],
        ways: list[FreeMotion],
        at_home: bool,
        between: float = np.inf,
    ) -> RobotTrajectory:
        position = np.concatenate([joints[None], *(s.position for s in stages)])
        timestep = self.motion.timestep
        velocity, acceleration = derivatives(position, timestep)
        return RobotTrajectory(
            time=np.arange(len(position)) * timestep,
            position=position,
            velocity=velocity,
            acceleration=acceleration,
            width=np.concatenate([[width], *(s.width for s in stages)]),
            force=np.concatenate([[0.0], *(s.force for s in stages)]),
            part=np.concatenate([[stages[0].part], *(np.full(len(s.width), s.part) for s in stages)]),
            action=self.kind.name,
            bounds=self.config.bounds,
            clearance=min(between, *(way.clearance for way in ways)),
            straight=all(way.straight for way in ways),
            ends_at_home=at_home,
        )


def _is_free(body: ArmBody, obstacles: Obstacles, q: np.ndarray) -> bool:
    distances = clearance(body, obstacles, q[None])
    return bool(distances.free[0] > 0.0 and distances.inside[0] <= 0.0)
