"""The set of actions, and constants computed from it."""

from __future__ import annotations

import dataclasses
import functools
import math

import jax
import numpy as np

from mechsearch_jax.actions.kinds.object_grasps import ObjectGraspConfig
from mechsearch_jax.dynamics.push_model import LEVERAGE
from mechsearch_jax.robot.grasp_frames import WRIST_ORIGIN
from mechsearch_jax.robot.gripper import Gripper, gripper_cloud, swept_cloud
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.options import in_degrees, option
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.workspace.shelf import Shelf

# Longer pushes would leave the shelf [m].
LONGEST_PUSH = 0.5
# How far the hand extends behind the finger tips' centres [m].
HAND_LENGTH = 0.11
# Index of the gripper's state on an action's approach in `ActionTables`.
OPEN, CLOSED = 0, 1


@dataclasses.dataclass(frozen=True)
class ActionConfig:
    """The set of candidate actions; hashable, static under jit.

    Attributes:
      actions: names of the kinds that are sampled: "push", "pick-and-place" or both.
      push_directions: directions of pushes as angles from +x (into the shelf) towards +y (to the left) [rad]; the
        paper's are left and right.
      push_distances: distances of the gripper's travel in a push [m].
      push_tilt: angle by which the pushing gripper points downwards [rad].
      push_wrists: angles of joint 7 in pushes, relative to 45 degrees [rad].
      push_yaws: angles between the gripper's approach and +x in a push to a side, seen from above [rad].
      push_height: largest height of the finger tips above the board in a push [m].
      push_leverage: limits of the contact height above which a push topples the object; see `push_model.LEVERAGE`.
      topple: largest predicted probability that an object falls over in a push that is executed.
      push_gap: distance between gripper and object where a push starts [m].
      push_depths: how far the finger tips reach past the object's front, or past its centre, in a push to a side [m].
      push_offsets: offset of the finger tips from the object's centre in other pushes, across the push and away from
        the robot, as a share of the object's half extent in that direction.
      push_postures: yaw of the gripper, and index of its wrist in `push_wrists`, in other pushes. Of all pairs of five
        yaws and three wrists these keep most of the feasible pushes in published scenes.
      grasps: how an object is grasped.
      placements: number of places drawn for a picked object, and number of those tested for collision.
      place_yaw: largest angle by which a picked object is turned [rad]; more if the hand would else come from more than
        `ActionSpace.max_yaw`.
      clearance: distance to neighbours when placing [m].
      contact_tolerance: depth of contact with other objects that is allowed on a picked object's way out [m]: touching
        objects are often recognised as overlapping, and would lock each other in.
      as_in_paper: set by preset `paper` alone. If False, candidates that enter space where the target may be are
        sampled only if their object has no others; the paper does not test this.
      cloud_points: points on the swept gripper.
      still_points: points on the gripper at rest.
      pusher_points: points on the hand and fingers.
      object_points: points on an object.
    """

    actions: tuple[str, ...] = option(
        ("push", "pick-and-place"), "kinds of action that are sampled, or the name of a preset for its actions"
    )
    push_directions: tuple[float, ...] = option(
        tuple(math.radians(angle) for angle in (90, -90, 0, 35, -35, 65, -65)),
        "directions of pushes, from straight into the shelf to the left [degrees]; the paper's are 90 and -90",
        least_degrees=4.0,
    )
    push_distances: tuple[float, ...] = option((0.05, 0.10, 0.15), "how far pushes go [m]")
    push_tilt: float = math.radians(30)
    push_wrists: tuple[float, ...] = (math.radians(-45), math.radians(-15), math.radians(30))
    push_yaws: tuple[float, ...] = (math.radians(-25), 0.0, math.radians(25))
    push_height: float = 0.08
    push_leverage: tuple[float, float] = LEVERAGE
    topple: float = 0.5
    push_gap: float = 0.01
    push_depths: tuple[float, float] = (0.02, 0.02)
    push_offsets: tuple[float, ...] = (-0.7, 0.0, 0.4)
    push_postures: tuple[tuple[float, int], ...] = ((math.radians(-25), 2), (0.0, 2), (math.radians(25), 1))
    grasps: ObjectGraspConfig = dataclasses.field(default_factory=ObjectGraspConfig)
    placements: tuple[int, int] = (32, 4)
    place_yaw: float = math.radians(30)
    clearance: float = 0.005
    contact_tolerance: float = 0.003
    as_in_paper: bool = False
    cloud_points: int = 1024
    still_points: int = 512
    pusher_points: int = 384
    object_points: int = 128

    def __post_init__(self):
        if not self.actions or isinstance(self.actions, str):
            raise InputError(f"actions {self.actions!r}: give a tuple of one or more kinds of action")
        if not self.contact_tolerance >= 0.0:
            raise InputError(f"contact_tolerance {self.contact_tolerance} m must not be negative")
        self._check_pushes()

    def _check_pushes(self):
        angles, distances = self.push_directions, self.push_distances
        if not angles or len(set(angles)) < len(angles) or not all(abs(angle) <= math.pi for angle in angles):
            shown = " ".join(f"{angle:.4g}" for angle in in_degrees(angles))
            raise InputError(
                f"push_directions {shown} [degrees] must be one or more different angles from -180 to 180 degrees"
            )
        if not distances or not all(0.0 < d <= LONGEST_PUSH for d in distances):
            raise InputError(
                f"push_distances {distances} must be one or more lengths above 0 and at most {LONGEST_PUSH} m"
            )
        if not self.push_offsets or not all(abs(share) <= 1.0 for share in self.push_offsets):
            raise InputError(f"push_offsets {self.push_offsets} must be one or more shares from -1 to 1")
        if not self.push_postures or not all(wrist in range(len(self.push_wrists)) for _, wrist in self.push_postures):
            raise InputError(f"push_postures {self.push_postures} must be pairs of a yaw and an index in push_wrists")


class ActionTables(PyTreeNode):
    """Constants of the actions, for W wrist angles; clouds are in the gripper's frame, open (`OPEN`), then closed.

    Attributes:
      q7: angles of joint 7, shape (2, W) [rad].
      clouds: points that the gripper sweeps on its way in, shape (2, W, 3, P) [m].
      low, high: bounding boxes of `clouds`, shape (2, W, 3) [m].
      still: points on the gripper at rest, shape (2, W, 3, S) [m].
      pusher: surface of the closed hand and fingers, shape (Q, 3) [m].
      turn: by how much the pushing hand is turned about its approach, as cosine and sine, shape (2,).
      contact: see `ActionConfig.contact_tolerance`, shape () [m].
    """

    q7: jax.Array
    clouds: jax.Array
    low: jax.Array
    high: jax.Array
    still: jax.Array
    pusher: jax.Array
    turn: jax.Array
    contact: jax.Array


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=("shelf", "tables"),
    meta_fields=("gripper", "config", "max_yaw", "waypoints"),
)
@dataclasses.dataclass(frozen=True)
class ActionSpace:
    """What all actions share, the same in every scene; a pytree.

    Attributes:
      shelf, tables: data.
      gripper, config: static.
      max_yaw: largest yaw of grasps of the target and of round objects, and of the hand as it puts anything down [rad];
        of grasps of flat sides see `ObjectGraspConfig.max_yaw`; static.
      waypoints: number of poses at which an approach must be reachable; static.
    """

    shelf: Shelf
    tables: ActionTables
    gripper: Gripper
    config: ActionConfig
    max_yaw: float
    waypoints: int

    @property
    def wrists(self) -> int:
        """Number of angles of joint 7."""
        return self.tables.q7.shape[1]


def action_tables(
    gripper: Gripper, grasp_wrists: tuple[float, ...], config: ActionConfig, turn: float = 0.0
) -> ActionTables:
    """Sample the clouds of the open and the closed gripper for every wrist.

    Args:
      gripper: the gripper.
      grasp_wrists: angles of joint 7 in grasps, relative to 45 degrees [rad].
      config: the actions; `push_wrists` must have as many angles.
      turn: of the pushing hand about its approach [rad]; at 0 its fingers are side by side, at a right angle one above
        the other, which makes it narrow.

    Raises:
      InputError: the numbers of angles differ.
    """
    if len(grasp_wrists) != len(config.push_wrists):
        raise InputError(
            f"{len(grasp_wrists)} wrist angles for grasps but {len(config.push_wrists)} for pushes; give as many each"
        )
    # The arm stays as it is: joint 7 alone turns the hand.
    q7 = WRIST_ORIGIN + np.array([grasp_wrists, np.add(config.push_wrists, turn)])
    hands = list(zip((gripper.max_opening, 0.0), q7, strict=True))
    clouds = np.stack(
        [[swept_cloud(gripper, opening, float(a), config.cloud_points) for a in angles] for opening, angles in hands]
    )
    still = np.stack(
        [[gripper_cloud(gripper, opening, float(a), config.still_points) for a in angles] for opening, angles in hands]
    )
    # Only hand and fingers push; points on the links behind them would leave fewer for these.
    surface = gripper_cloud(gripper, 0.0, float(q7[CLOSED][0]), 2048)
    pusher = surface[surface[:, 2] > -HAND_LENGTH][: config.pusher_points]
    tables = {
        "q7": np.float32(q7),
        "clouds": np.float32(np.swapaxes(clouds, -1, -2)),
        "low": np.float32(clouds.min(axis=-2)),
        "high": np.float32(clouds.max(axis=-2)),
        "still": np.float32(np.swapaxes(still, -1, -2)),
        "pusher": np.float32(pusher),
        "turn": np.array([math.cos(turn), math.sin(turn)], np.float32),
        "contact": np.float32(config.contact_tolerance),
    }
    return ActionTables(**jax.device_put(tables))
