"""From the images of a real depth camera to a mask that the `Recogniser` takes (appendices B.1, C.1 and C.3).

The camera's pose is corrected on the robot that it sees; the shelf is removed by its known shape, and its floor, which
touches every object, by the plane that is measured there; what is left is segmented by a given mask or by colour. All
this happens once an image and on the host, so that images of any size are fine; what comes out has fixed shapes:

    prepared = real_camera.prepare(key, problem.camera, problem.shelf, depth, colour, joints=joints)
    perceive = Recogniser(problem, camera=prepared.camera)
    observation = perceive(key, prepared.depth, mask=prepared.segmentation, target_id=prepared.target_id)
"""

from __future__ import annotations

import dataclasses

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.images.camera_pose import PoseConfig, PoseEstimate, estimate_pose
from mechsearch_jax.images.colour import ClusterConfig, Detection, TargetColour, cluster_by_colour, detect_target
from mechsearch_jax.images.labels import FREE, INSTANCES, MISSING, OTHER
from mechsearch_jax.images.planes import Plane, PlaneConfig, find_plane
from mechsearch_jax.images.target_pixels import evened
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.camera import Camera, back_project
from mechsearch_jax.workspace.shelf import Shelf

_evened = jax.jit(evened)

# The plane of the floor and the camera's pose are found from at most so many points.
FLOOR_POINTS = ROBOT_POINTS = 4096


@dataclasses.dataclass(frozen=True)
class RealCameraConfig:
    """How images become a cloud; lengths in metres.

    Attributes:
      segments: number of segments that are kept, the largest first: eight objects and the target.
      overhang: how far before the shelf's front edge things on it are looked for.
      wall_clearance: points that are closer to the walls and the upper board than this are the shelf's.
      floor_search: points whose height over the board is at most this may be its floor.
      floor_clearance: points less than this above the floor's plane are the floor's.
      floor_support: points that the plane must have to be believed; the known board is taken otherwise.
      robot_clearance: points this close to the robot are the robot's, if its joint angles are given.
      robot_margin: the robot is looked for at least this far before the shelf's front edge.
      pose: how the camera's pose is corrected.
      plane: how the floor is found.
      clusters: how pixels are clustered by colour.
      target: the target's colour.
    """

    segments: int = INSTANCES
    overhang: float = 0.02
    wall_clearance: float = 0.012
    floor_search: float = 0.03
    floor_clearance: float = 0.005
    floor_support: int = 200
    robot_clearance: float = 0.02
    robot_margin: float = 0.05
    pose: PoseConfig = dataclasses.field(default_factory=PoseConfig)
    plane: PlaneConfig = dataclasses.field(default_factory=PlaneConfig)
    clusters: ClusterConfig = dataclasses.field(default_factory=ClusterConfig)
    target: TargetColour = dataclasses.field(default_factory=TargetColour.lit)

    def __post_init__(self):
        if not 1 <= self.segments <= INSTANCES:
            raise InputError(f"RealCameraConfig: segments ({self.segments}) must be from 1 to {INSTANCES}")
        lengths = ("overhang", "wall_clearance", "floor_search", "floor_clearance", "robot_clearance", "robot_margin")
        for field in lengths:
            if not getattr(self, field) >= 0:
                raise InputError(f"RealCameraConfig: {field} ({getattr(self, field)}) must not be negative, in metres")


class PreparedImage(flax.struct.PyTreeNode):
    """What was made of a depth and a colour image.

    Attributes:
      segmentation: what every pixel shows, as `images.labels` has it, int32, shape (h, w): a segment's number, the
        one with the most pixels first where they were clustered; FREE for the shelf and what is seen beside it; OTHER
        for the robot, whatever else is before the shelf, and what is on it but in no segment; MISSING where nothing
        was measured. It is a `mask` of the `Recogniser`.
      depth: the depth image with NaN where nothing was measured, as the `Recogniser` takes it.
      detection: whether one of the segments is the target, by its colour.
      floor: the plane of the shelf's floor, in the world; its `support` is 0 where the known board was taken.
      pose: how the camera's pose was corrected; None where no joint angles were given.
      camera: the camera at its corrected pose.
    """

    segmentation: jax.Array
    depth: jax.Array
    detection: Detection
    floor: Plane
    pose: PoseEstimate | None
    camera: Camera = flax.struct.field(pytree_node=False)

    @property
    def target_id(self) -> jax.Array:
        """The target's number in the segmentation, int32; OTHER where it was not detected."""
        return jnp.where(self.detection.found, self.detection.segment, OTHER)


def _checked(camera: Camera, depth: np.ndarray, colour: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
    """The depth image with NaN where nothing was measured."""
    size = (camera.height, camera.width)
    for name, image, shape in (("depth", depth, size), ("colour", colour, (*size, 3)), ("mask", mask, size)):
        if image is not None and image.shape != shape:
            raise InputError(f"{name} image: its shape is {image.shape}, the camera's images are {shape}")
    if colour.dtype.kind != "f" or not np.all((colour >= 0) & (colour <= 1)):
        raise InputError("colour image: must be floats from 0 to 1; divide 8-bit values by 255")
    if mask is not None and mask.dtype.kind not in "iu":
        raise InputError(f"mask image: must hold whole numbers, -1 for no object, not {mask.dtype}")
    measured = np.isfinite(depth) & (depth > 0)
    if not measured.any():
        raise InputError(
            "depth image: nothing was measured: no positive depth; it must be in metres along the camera's axis"
        )
    if np.median(depth[measured]) > 20:
        raise InputError(
            f"depth image: its median is {np.median(depth[measured]):.0f}; it must be in metres, not millimetres"
        )
    return np.where(measured, depth, np.nan).astype(np.float32)


def _fixed(rng: np.random.Generator, points: np.ndarray, count: int) -> tuple[Array, Array]:
    """At most `count` of the points, drawn at random and padded to that number, and which of them count."""
    chosen = points[rng.permutation(len(points))[:count]]
    padded = np.zeros((count, 3), np.float32)
    padded[: len(chosen)] = chosen
    return jnp.asarray(padded), jnp.arange(count) < len(chosen)


def _correct_pose(rng, camera, shelf, points, joints, opening, config) -> PoseEstimate:
    """The camera's pose from the points in front of the shelf, where there is nothing but the robot."""
    rotation, position = np.array(camera.rotation), np.array(camera.position)
    before = points[:, 0] < shelf.front - config.robot_margin
    within = max(reach for _, reach in config.pose.stages)
    distance, _ = config.pose.robot_distance(jnp.asarray(points[before]), joints, opening)
    near = points[before][np.asarray(distance) < within]
    local, valid = _fixed(rng, (near - position) @ rotation, ROBOT_POINTS)
    T_world_camera = np.eye(4, dtype=np.float32)
    T_world_camera[:3, :3], T_world_camera[:3, 3] = rotation, position
    return estimate_pose(jnp.asarray(T_world_camera), local, valid, joints, opening, config.pose)


def _find_floor(key, rng, shelf, points, inside, config) -> Plane:
    low = inside & (np.abs(points[..., 2] - shelf.board) <= config.floor_search)
    floor = find_plane(key, *_fixed(rng, points[low], FLOOR_POINTS), config=config.plane)
    if int(floor.support) >= config.floor_support:
        return floor
    return Plane(jnp.array([0.0, 0.0, 1.0]), jnp.float32(shelf.board), jnp.int32(0))


def _segment(colour, depth, points, foreground, mask, config) -> Int[np.ndarray, "h w"]:
    if mask is None:
        labels = cluster_by_colour(colour, depth, points, foreground, config.clusters)
    else:
        labels = np.where(foreground, mask, OTHER).astype(np.int32)
    return np.where((labels >= 0) & (labels < config.segments), labels, OTHER).astype(np.int32)


def _inside(shelf: Shelf, points: np.ndarray, config: RealCameraConfig) -> Bool[np.ndarray, "h w"]:
    """Which points lie in the shelf's free space, off its walls; its floor is not looked at."""
    x, y, z = np.moveaxis(points, -1, 0)
    c = config.wall_clearance
    with np.errstate(invalid="ignore"):
        return (
            (x > shelf.front - config.overhang)
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
    config: RealCameraConfig | None = None,
) -> PreparedImage:
    """The objects' segments in a depth and a colour image of the shelf.

    Args:
      key: which points the floor and the camera's pose are found from.
      camera: intrinsics, and the pose as far as it is known: to 2 cm and 2 degrees if joint angles are given.
      shelf: the shelf's shape.
      depth: along the camera's axis [m]; 0, infinite or NaN where nothing was measured.
      colour: red, green and blue in 0 to 1, registered to the depth image, float, shape (h, w, 3).
      mask: whole numbers, the segment of every pixel, 0 to `config.segments - 1`, others for none; clusters of like
        colour if None. The shelf and the robot need not be told apart in it.
      joints: the robot's joint angles when the images were taken [rad]; without them the pose is taken as given, and
        the robot must be out of the way.
      opening: distance between its fingers [m].
      config: the default if None.

    Raises:
      InputError: an image's size, type or unit is not as said.
    """
    config = config or RealCameraConfig()
    depth = _checked(camera, depth, colour, mask)
    # The key's own bits seed the draws on the host, whose number of points differs from image to image.
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    pose = None
    if joints is not None:
        angles, fingers = jnp.asarray(joints, jnp.float32), jnp.float32(opening)
        seen = np.asarray(back_project(camera, jnp.asarray(depth)))[np.isfinite(depth)]
        pose = _correct_pose(rng, camera, shelf, seen, angles, fingers, config)
        camera = pose.camera(camera)
    # Noise would split a thing into several, or leave out of the target what would then be an object in it.
    colour = np.asarray(_evened(jnp.asarray(colour, jnp.float32), jnp.asarray(depth)))
    points = np.asarray(back_project(camera, jnp.asarray(depth)))
    inside = _inside(shelf, points, config)
    floor = _find_floor(key, rng, shelf, points, inside, config)
    foreground = inside & (np.asarray(floor.height(jnp.asarray(points))) > config.floor_clearance)
    # What is before the shelf hides what is in it.
    other = (points[..., 0] <= shelf.front - config.overhang) & (points[..., 2] > shelf.board)
    if joints is not None:
        distance, _ = config.pose.robot_distance(jnp.asarray(points[foreground]), angles, fingers)
        other[foreground] = np.asarray(distance) <= config.robot_clearance
        foreground &= ~other
    labels = _segment(colour, depth, points, foreground, mask, config)
    labels = np.where(foreground | other, labels, np.where(np.isfinite(depth), FREE, MISSING)).astype(np.int32)
    image = jnp.asarray(labels)
    pixels = jnp.asarray(colour, jnp.float32).reshape(-1, 3)
    detection = detect_target(pixels, image.reshape(-1), config.segments, config.target)
    return PreparedImage(image, jnp.asarray(depth), detection, floor, pose, camera)
