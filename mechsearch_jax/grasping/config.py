"""Which grasps of the target are candidates, and how finely they are tested."""

from __future__ import annotations

import dataclasses
import math

from mechsearch_jax.runtime.errors import InputError

# From farther to the side the hand would come from behind [rad]; a little more, for a rounded right angle.
LARGEST_YAW = math.pi / 2 + 1e-3


@dataclasses.dataclass(frozen=True)
class GraspConfig:
    """The candidate grasps and how finely they are tested.

    Attributes:
      max_yaw: largest angle between the approach and +x, seen from above [rad]; that of the grasps at candidate poses
        also limits grasps of round objects, and how a hand puts things down.
      yaw_step: largest angle between neighbouring approach directions to round objects [rad]; boxes are grasped square
        to their faces.
      turn: by how much a box is also approached from either side of square [rad]; as the fingers close it turns in the
        hand, or is held at two edges. 0 for square approaches alone.
      tilts: angles by which the gripper points downwards [rad].
      wrists: angles of joint 7 relative to 45 degrees [rad]; each places link 6 differently beside the hand.
      height: height of the grasp above the target's centre [m]; higher grasps keep the wrist clear of the board.
      points: points on the swept gripper.
      target_points: points on the swept target.
      still_points: points on the gripper at rest, and on the target, for the crossing with a found target.
      waypoints: number of poses on an approach at which inverse kinematics must succeed.
      erosion: by how much the target is shrunk for the collision test of its way out [m].
      antipodal: of a target of several pieces, the number of grasps that are spread over all opposite places of its
        surface, from any side and angle (`antipodal_grasps`); 0 for the best level ones at `tilts` and `wrists` alone.
    """

    max_yaw: float = math.radians(45)
    yaw_step: float = math.radians(15)
    turn: float = 0.0
    tilts: tuple[float, ...] = (math.radians(20), math.radians(25), math.radians(30))
    wrists: tuple[float, ...] = (math.radians(-60), 0.0, math.radians(60))
    height: float = 0.03
    points: int = 2048
    target_points: int = 512
    still_points: tuple[int, int] = (512, 128)
    waypoints: int = 4
    erosion: float = 0.001
    antipodal: int = 0

    def __post_init__(self):
        if not self.tilts or not self.wrists:
            raise InputError("GraspConfig: tilts and wrists must hold at least one angle each")
        if not 0 <= self.max_yaw <= LARGEST_YAW:
            raise InputError(f"GraspConfig: max_yaw {self.max_yaw} must be from 0 to {LARGEST_YAW:.4f} rad")
        if not self.yaw_step > 0:
            raise InputError(f"GraspConfig: yaw_step {self.yaw_step} must be above 0")
        if not 0 <= self.turn < math.pi / 4:
            raise InputError(f"GraspConfig: turn {self.turn} must be from 0 to below {math.pi / 4:.4f} rad")
        if self.antipodal < 0:
            raise InputError(f"GraspConfig: antipodal {self.antipodal} must not be negative")
        if self.waypoints < 2:
            raise InputError(f"GraspConfig: {self.waypoints} waypoints make no line; use at least 2")

    @property
    def yaws(self) -> int:
        """Number of approach directions to round objects; one of them is straight into the shelf."""
        return 2 * math.ceil(self.max_yaw / self.yaw_step - 1e-6) + 1

    @classmethod
    def dense(cls) -> GraspConfig:
        """More grasps than the default, of a cylinder ten times as many, for the single pose of a found target."""

        def angles(*degrees: float) -> tuple[float, ...]:
            return tuple(map(math.radians, degrees))

        return cls(
            max_yaw=math.radians(75),
            yaw_step=math.radians(3.75),
            turn=math.radians(20),
            tilts=angles(20.0, 25.0, 30.0),
            wrists=angles(-60.0, -30.0, 0.0, 30.0, 60.0),
            antipodal=600,
        )
