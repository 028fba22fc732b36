"""Prepare the images of a real depth camera for the `Recogniser` (appendices B.1, C.1 and C.3).

The camera's pose is corrected on the visible robot. The shelf is removed by its known shape, and its floor, which
touches every object, by the measured plane. The remaining points are segmented by a given mask or by colour. All this
runs once per image on the host:

    prepared = real_camera.prepare(key, problem.camera, problem.shelf, depth, colour, joints=joints)
    perceive = Recogniser(problem, camera=prepared.camera)
    observation = perceive(key, prepared.depth, mask=prepared.segmentation, target_id=prepared.target_id)
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.images.camera_pose import STAGES, PoseEstimate, estimate_pose, panda_distance
from mechsearch_jax.images.checks import check_images
from mechsearch_jax.images.colour import ColourDetection, TargetColour, cluster_by_colour, detect_target
from mechsearch_jax.images.detection import evened
from mechsearch_jax.images.labels import CAPACITY, FREE, MISSING, OTHER
from mechsearch_jax.images.planes import Plane, find_plane
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.pytree import PyTreeNode, static
from mechsearch_jax.workspace.camera import Camera, back_project, measured
from mechsearch_jax.workspace.shelf import Shelf

_evened = jax.jit(evened)

# Largest number of points for the plane of the floor and for the camera's pose.
FLOOR_POINTS = ROBOT_POINTS = 4096
# How far objects may stick out in front of the shelf [m].
OVERHANG = 0.02
# Points closer than this to the walls or the upper board are the shelf's [m].
WALL_CLEARANCE = 0.012
# Largest distance from the board of points that may be the floor's; those less than the second above its plane are [m].
FLOOR_SEARCH, FLOOR_CLEARANCE = 0.03, 0.005
# Least number of points on the floor's plane; with fewer, the shelf's board is used.
FLOOR_SUPPORT = 200
# Points this close to the robot are the robot's, if its joint angles are given; least distance in front of the shelf of
# points that are matched with it [m].
ROBOT_CLEARANCE, ROBOT_MARGIN = 0.02, 0.05


class PreparedImage(PyTreeNode):
    """A prepared depth and colour image.

    Attributes:
      segmentation: label of every pixel as in `images.labels`, int32, shape (h, w): a segment's number, by decreasing
        size if clustered by colour; FREE for the shelf and its surroundings; OTHER for the robot, other things in front
        of the shelf, and things on it without a segment; MISSING where nothing was measured. It is a `mask` of the
        `Recogniser`.
      depth: the depth image for the `Recogniser`, with NaN where nothing was measured.
      detection: whether one of the segments is the target, by its colour.
      floor: the plane of the shelf's floor, in the world; its `support` is 0 if it is the given shelf's board.
      pose: how the camera's pose was corrected; None without joint angles.
      camera: the camera at its corrected pose.
    """

    segmentation: jax.Array
    depth: jax.Array
    detection: ColourDetection
    floor: Plane
    pose: PoseEstimate | None
    camera: Camera = static()

    @property
    def target_id(self) -> jax.Array:
        """The target's number in the segmentation, int32; OTHER if it was not detected."""
        return jnp.where(self.detection.found, self.detection.segment, OTHER)


def _checked(camera: Camera, depth: np.ndarray, colour: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
    """The depth image with NaN where nothing was measured."""
    # Numbers of no segment are allowed here.
    check_images(camera, depth, colour, None if mask is None else np.clip(mask, OTHER, 0))
    if colour.dtype == np.uint8:
        raise InputError("colour image: must be floats from 0 to 1; divide 8-bit values by 255")
    known = np.isfinite(depth) & measured(depth)
    if not known.any():
        raise InputError(
            "depth image: nothing was measured: no positive depth; it must be in metres along the camera's axis"
        )
    return np.where(known, depth, np.nan).astype(np.float32)


def _fixed(rng: np.random.Generator, points: np.ndarray, count: int) -> tuple[Array, Array]:
    """At most `count` random points, padded to `count`, and which of them are valid."""
    chosen = points[rng.permutation(len(points))[:count]]
    padded = np.zeros((count, 3), np.float32)
    padded[: len(chosen)] = chosen
    return jnp.asarray(padded), jnp.arange(count) < len(chosen)


def _correct_pose(rng, camera, shelf, points, joints, opening) -> PoseEstimate:
    """The camera's pose from the points in front of the shelf, where there is only the robot."""
    rotation, position = np.array(camera.rotation), np.array(camera.position)
    in_front = points[:, 0] < shelf.front - ROBOT_MARGIN
    within = max(reach for _, reach in STAGES)
    distance, _ = panda_distance(jnp.asarray(points[in_front]), joints, opening)
    near = points[in_front][np.asarray(distance) < within]
    local, valid = _fixed(rng, (near - position) @ rotation, ROBOT_POINTS)
    T_world_camera = np.eye(4, dtype=np.float32)
    T_world_camera[:3, :3], T_world_camera[:3, 3] = rotation, position
    return estimate_pose(jnp.asarray(T_world_camera), local, valid, joints, opening)


def _find_floor(key, rng, shelf, points, inside) -> Plane:
    low = inside & (np.abs(points[..., 2] - shelf.board) <= FLOOR_SEARCH)
    floor = find_plane(key, *_fixed(rng, points[low], FLOOR_POINTS))
    if int(floor.support) >= FLOOR_SUPPORT:
        return floor
    return Plane(jnp.array([0.0, 0.0, 1.0]), jnp.float32(shelf.board), jnp.int32(0))


def _segment(colour, depth, points, foreground, mask, capacity) -> Int[np.ndarray, "h w"]:
    if mask is None:
        labels = cluster_by_colour(colour, depth, points, foreground)
    else:
        labels = np.where(foreground, mask, OTHER).astype(np.int32)
    return np.where((labels >= 0) & (labels <= capacity), labels, OTHER).astype(np.int32)


def _inside(shelf: Shelf, points: np.ndarray) -> Bool[np.ndarray, "h w"]:
    """Which points lie between the shelf's walls and below its upper board; its floor is ignored."""
    x, y, z = np.moveaxis(points, -1, 0)
    c = WALL_CLEARANCE
    with np.errstate(invalid="ignore"):
        return (
            (x > shelf.front - OVERHANG)
            & (x < shelf.back - c)
            & (y > shelf.right + c)
            & (y < shelf.left - c)
            & (z < shelf.ceiling - c)
        )


def prepare(
    key: Array,
    camera: Camera,
    shelf: Shelf,
    depth: Float[np.ndarray, "h w"],
    colour: np.ndarray,
    mask: np.ndarray | None = None,
    joints: Float[np.ndarray, " 7"] | None = None,
    opening: float = 0.0,
    target: TargetColour | None = None,
    capacity: int = CAPACITY,
) -> PreparedImage:
    """Segment the objects in a depth and a colour image of the shelf.

    Args:
      key: PRNG key of the points for the floor and the camera's pose.
      camera: intrinsics and pose; with joint angles, a pose within 2 cm and 2 degrees suffices.
      shelf: the shelf.
      depth: along the camera's axis [m]; 0, infinite or NaN where nothing was measured.
      colour: red, green and blue in 0 to 1, registered to the depth image, float, shape (h, w, 3).
      mask: whole numbers, the segment of every pixel, 0 to `capacity`, others for none; it need not separate
        shelf and robot. If None, pixels are clustered by colour.
      joints: the robot's joint angles when the images were taken [rad]; without them the pose is used as given, and the
        robot must be out of sight.
      opening: distance between its fingers [m].
      target: the target's colour; red if None.
      capacity: how many objects the recogniser can hold, beside the target.

    Raises:
      InputError: an image has the wrong size, type or unit.
    """
    depth = _checked(camera, depth, colour, mask)
    # The host draws the points, whose number differs between images; the key's bits are the seed.
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    pose = None
    if joints is not None:
        angles, fingers = jnp.asarray(joints, jnp.float32), jnp.float32(opening)
        seen = np.asarray(back_project(camera, jnp.asarray(depth)))[np.isfinite(depth)]
        pose = _correct_pose(rng, camera, shelf, seen, angles, fingers)
        camera = pose.camera(camera)
    # With noise, an object would be split, and pixels of the target would be missed and taken for an object in it.
    colour = np.asarray(_evened(jnp.asarray(colour, jnp.float32), jnp.asarray(depth)))
    points = np.asarray(back_project(camera, jnp.asarray(depth)))
    inside = _inside(shelf, points)
    floor = _find_floor(key, rng, shelf, points, inside)
    foreground = inside & (np.asarray(floor.height(jnp.asarray(points))) > FLOOR_CLEARANCE)
    # Things in front of the shelf hide what is in it.
    other = (points[..., 0] <= shelf.front - OVERHANG) & (points[..., 2] > shelf.board)
    if joints is not None:
        distance, _ = panda_distance(jnp.asarray(points[foreground]), angles, fingers)
        other[foreground] = np.asarray(distance) <= ROBOT_CLEARANCE
        foreground &= ~other
    labels = _segment(colour, depth, points, foreground, mask, capacity)
    labels = np.where(foreground | other, labels, np.where(np.isfinite(depth), FREE, MISSING)).astype(np.int32)
    image = jnp.asarray(labels)
    pixels = jnp.asarray(colour, jnp.float32).reshape(-1, 3)
    detection = detect_target(pixels, image.reshape(-1), capacity + 1, target or TargetColour.lit())
    return PreparedImage(image, jnp.asarray(depth), detection, floor, pose, camera)
