"""The way into the shelf: from outside along +x to the pre-grasp, then along the gripper's z. The way out reverses it.

The pre-grasp, `Gripper.approach` behind the pose, may lie inside the shelf. The gripper reaches it from outside along
x, without turning. This stretch is called the crossing; its length is 0 if the pre-grasp is outside.

Hand, fingers and links 6 and 7 cannot touch the shelf on a crossing unless they do at its end: they are rigid in the
gripper's frame, and the free space of the shelf is a prism along x. Links 2 to 5 can.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.geometry.masked import masked_vmap, taken
from mechsearch_jax.geometry.transforms import back_off, translate
from mechsearch_jax.robot.arm_config import PANDA, Arm
from mechsearch_jax.robot.gripper import Gripper, joints_hit_shelf
from mechsearch_jax.robot.kinematics import path_joints, path_kinematics, still_ahead
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.shelf import Shelf, cloud_hits_shelf

# How far in front of the shelf the gripper must be to count as outside [m]: then a held target is outside, and so are
# the open fingers, of which one is up to 4 cm ahead if the hand is turned by 45 degrees.
MARGIN = 0.04
# Poses of a crossing at which the arm is tested: for all proposals, and for the few actions that are drawn. The longest
# crossing to the nearest place outside is 17 cm, which makes the poses 6 and 3 cm apart; it is 24 cm for a found target
# from 75 degrees to the side.
FEW_CROSSINGS, CLOSE_CROSSINGS = 3, 6


def check_outside(gripper: Gripper, shelf: Shelf) -> None:
    """Check that the gripper's places outside are in front of this shelf.

    Raises:
      InputError: they are not.
    """
    farthest = shelf.front - MARGIN
    if gripper.nearest_outside > farthest + 1e-6:
        raise InputError(
            f"Gripper: outside {gripper.outside} must lie in front of the shelf, at {farthest:.3f} m or less"
        )


def crossing_length(
    T_world_gripper: Float[Array, "*batch 4 4"], outside: float | Float[Array, "*#batch"], gripper: Gripper
) -> Float[Array, "*batch"]:
    """Length of the crossing from a place outside to the pre-grasp of a pose [m]."""
    T = jnp.asarray(T_world_gripper)
    return jnp.maximum(T[..., 0, 3] - gripper.approach * T[..., 0, 2] - outside, 0.0)


def crossing_poses(
    T_world_gripper: Float[Array, "*batch 4 4"],
    outside: float | Float[Array, "*#batch"],
    gripper: Gripper,
    count: int,
) -> Float[Array, "*batch {count} 4 4"]:
    """Evenly spaced poses on the crossing, from outside to before the pre-grasp."""
    T = jnp.asarray(T_world_gripper)
    return _before(T, crossing_length(T, outside, gripper), np.full(count, gripper.approach), _to_cross(count))


def _to_cross(count: int) -> Float[np.ndarray, " {count}"]:
    """Remaining share of the crossing at each pose on it."""
    return np.arange(count, 0, -1) / count


def _before(
    T_world_gripper: Float[Array, "*batch 4 4"],
    crossing: Float[Array, "*#batch"],
    back: Float[np.ndarray, " w"],
    to_cross: Float[np.ndarray, " w"],
) -> Float[Array, "*batch w 4 4"]:
    """Poses on a way in: moved back along the gripper's z [m], and along x by a share of the crossing [m].

    One formula gives all positions, since concatenated parts would be written to memory.
    """
    T = T_world_gripper[..., None, :, :]
    across = crossing[..., None] * jnp.asarray(to_cross, T.dtype).reshape(*[1] * crossing.ndim, -1)
    along_x = np.array([1.0, 0.0, 0.0], np.float32).reshape(*[1] * across.ndim, 3)
    moved = back_off(T, jnp.asarray(back, T.dtype).reshape(*[1] * (T.ndim - 3), -1))
    return translate(moved, -across[..., None] * along_x)


def way_in(
    T_world_gripper: Float[Array, "*batch 4 4"],
    outside: float | Float[Array, "*#batch"],
    gripper: Gripper,
    crossings: int,
    waypoints: int,
) -> Float[Array, "*batch {crossings}+{waypoints} 4 4"]:
    """Gripper poses from outside the shelf to a pose.

    Args:
      T_world_gripper: where the way ends.
      outside: x of the gripper where it begins, unless the pre-grasp is further out [m].
      gripper: gives the length of the approach.
      crossings: number of poses on the crossing, without the pre-grasp.
      waypoints: number of poses on the approach, both ends included; the first is row `crossings`.
    """
    T = jnp.asarray(T_world_gripper)
    back = gripper.approach * np.append(np.ones(crossings), still_ahead(waypoints))
    to_cross = np.append(_to_cross(crossings), np.zeros(waypoints))
    return _before(T, crossing_length(T, outside, gripper), back, to_cross)


def ways_in(
    T_world_gripper: Float[Array, "4 4"], q7: Float[Array, ""], gripper: Gripper, crossings: int, waypoints: int
) -> tuple[Float[Array, "{crossings}+{waypoints} 7"], Bool[Array, ""], Float[Array, ""]]:
    """Joint angles on the way in from the reachable place outside that is farthest from the shelf, for a full hand.

    Args:
      T_world_gripper: where the way ends.
      q7: angle of joint 7 [rad].
      gripper: gives the places outside.
      crossings, waypoints: as in `way_in`.

    Returns:
      q: joint angles, in one configuration of the arm [rad].
      reachable: whether the arm follows the way from any of the places.
      outside: the place's x [m].
    """
    places = jnp.float32(gripper.outside)
    T = jnp.broadcast_to(T_world_gripper[None], (len(places), 4, 4))
    paths = way_in(T, places, gripper, crossings, waypoints)
    q, reachable = path_kinematics(paths, q7, gripper.arm)
    # The first reachable place, or the first one. Selects instead of an index, which would write all paths to memory.
    best, outside = q[0], jnp.float32(gripper.outside[0])
    for i, place in reversed(list(enumerate(gripper.outside))):
        best = jax.lax.select(reachable[i], q[i], best)
        outside = jax.lax.select(reachable[i], jnp.float32(place), outside)
    return best, jnp.any(reachable), outside


def arm_path(
    path: Float[Array, "w 4 4"], q7: Float[Array, ""], shelf: Shelf, arm: Arm = PANDA
) -> tuple[Float[Array, "w 7"], Bool[Array, ""]]:
    """Joint angles along a path of gripper poses [rad], and whether the arm can follow it.

    It can if it stays in one configuration and links 2 to 5 do not touch the shelf.
    """
    q, follows = _followed(path, q7, shelf, arm)
    return jnp.stack(q, axis=-1), follows


def arm_follows(path: Float[Array, "w 4 4"], q7: Float[Array, ""], shelf: Shelf, arm: Arm = PANDA) -> Bool[Array, ""]:
    """Whether the arm can follow a path of gripper poses; see `arm_path`."""
    return _followed(path, q7, shelf, arm)[1]


def _followed(
    path: Float[Array, "w 4 4"], q7: Float[Array, ""], shelf: Shelf, arm: Arm
) -> tuple[list[Float[Array, " w"]], Bool[Array, ""]]:
    """`arm_path`, with one array of angles for each joint."""
    q, reachable = path_joints(path, q7, arm)
    return q, reachable & ~jnp.any(joints_hit_shelf(q, shelf))


class WaysIn(NamedTuple):
    """Ways into the shelf; C of them.

    Attributes:
      T_world_gripper: where they end, shape (C, 4, 4).
      q7: angles of joint 7 [rad], shape (C,).
      cloud: which of several clouds the gripper sweeps on each, shape (C,).
    """

    T_world_gripper: Float[Array, "c 4 4"]
    q7: Float[Array, " c"]
    cloud: Int[Array | np.ndarray, " c"]


def gripper_enters(
    shelf: Shelf,
    gripper: Gripper,
    waypoints: int,
    clouds: Float[Array, "k 3 p"],
    ways: WaysIn,
    mask: Bool[Array, " c"],
) -> Bool[Array, " c"]:
    """Whether the arm can follow the way in to each pose, and neither it nor the gripper's sweep touches the shelf.

    Only the nearest place outside is tested, for ways from farther places pass it.

    Args:
      shelf: the shelf.
      gripper: static.
      waypoints: poses on the approach; there are `FEW_CROSSINGS` on the crossing.
      clouds: swept clouds of grippers in their frames, as rows of coordinates [m].
      ways: the ways in.
      mask: which ways to test; the result is False for the others.
    """

    def enters(shared, _, row):
        (shelf, clouds), (T, q7, cloud) = shared, row
        path = way_in(T, gripper.nearest_outside, gripper, FEW_CROSSINGS, waypoints)
        return arm_follows(path, q7, shelf, gripper.arm) & ~cloud_hits_shelf(shelf, T, taken(clouds, cloud[None])[0])

    return masked_vmap(enters, mask, (shelf, clouds), None, (ways.T_world_gripper, ways.q7, jnp.asarray(ways.cloud)))
