"""From the images of a real depth camera to a point cloud that recognition takes (appendices B.1, C.1 and C.3).

The camera's pose is corrected on the robot that it sees; the shelf is removed by its known shape, and its floor, which
touches every object, by the plane that is measured there; what is left is segmented by a given mask or by colour. All
this happens once an image and on the host, so that images of any size and any number of points are fine; what comes out
has fixed shapes.
"""

from __future__ import annotations

import dataclasses

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.errors import InputError
from mechsearch_jax.perception.camera_pose import PoseConfig, PoseEstimate, estimate_pose
from mechsearch_jax.perception.colour import ClusterConfig, Detection, TargetColour, cluster_by_colour, detect_target
from mechsearch_jax.perception.planes import Plane, PlaneConfig, find_plane
from mechsearch_jax.workspace.camera import Camera, back_project
from mechsearch_jax.workspace.scenario import MAX_OBJECTS
from mechsearch_jax.workspace.shelf import Shelf

BACKGROUND = -1
# The plane of the floor and the camera's pose are found from at most so many points.
FLOOR_POINTS = ROBOT_POINTS = 4096


@dataclasses.dataclass(frozen=True)
class RealCameraConfig:
    """How images become a cloud; lengths in metres.

    Attributes:
      points: number of points of the cloud.
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

    points: int = 2048
    segments: int = MAX_OBJECTS + 1
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
        if min(self.points, self.segments) < 1:
            raise InputError(
                f"RealCameraConfig: points ({self.points}) and segments ({self.segments}) must be positive"
            )
        lengths = ("overhang", "wall_clearance", "floor_search", "floor_clearance", "robot_clearance", "robot_margin")
        for field in lengths:
            if not getattr(self, field) >= 0:
                raise InputError(f"RealCameraConfig: {field} ({getattr(self, field)}) must not be negative, in metres")


class ObjectCloud(flax.struct.PyTreeNode):
    """Points of the objects on the shelf, ready for recognition.

    Attributes:
      points: in the world [m], float32, shape (P, 3); some are repeated where the camera saw fewer than P.
      labels: the segment of each, int32, shape (P,).
      colours: red, green and blue in 0 to 1, shape (P, 3).
      valid: all true, or all false where no object was seen, shape (P,).
    """

    points: jax.Array
    labels: jax.Array
    colours: jax.Array
    valid: jax.Array


class PreparedImage(flax.struct.PyTreeNode):
    """What was made of a depth and a colour image.

    Attributes:
      cloud: the objects' points.
      segmentation: segment of every pixel, int32, shape (h, w); -1 for the shelf, the robot and all else.
      depth: the depth image with NaN where nothing was measured, as `refinement.refine` takes it.
      detection: whether one of the segments is the target, by its colour.
      floor: the plane of the shelf's floor, in the world; its `support` is 0 where the known board was taken.
      pose: how the camera's pose was corrected; None where no joint angles were given.
      camera: the camera at its corrected pose.
    """

    cloud: ObjectCloud
    segmentation: jax.Array
    depth: jax.Array
    detection: Detection
    floor: Plane
    pose: PoseEstimate | None
    camera: Camera = flax.struct.field(pytree_node=False)


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
        raise InputError("depth image: holds no positive depth; it must be in metres along the camera's axis")
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
        labels = np.where(foreground, mask, BACKGROUND).astype(np.int32)
    return np.where((labels >= 0) & (labels < config.segments), labels, BACKGROUND).astype(np.int32)


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
    """The objects' points and segments in a depth and a colour image of the shelf.

    Args:
      key: which points are drawn.
      camera: intrinsics, and the pose as far as it is known: to 2 cm and 2 degrees if joint angles are given.
      shelf: the shelf's shape.
      depth: along the camera's axis [m]; 0, infinite or NaN where nothing was measured.
      colour: red, green and blue in 0 to 1, registered to the depth image, float, shape (h, w, 3).
      mask: whole numbers, the segment of every pixel, 0 to `config.segments - 1`, others for none; clusters of like
        colour if None.
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
    points = np.asarray(back_project(camera, jnp.asarray(depth)))
    inside = _inside(shelf, points, config)
    floor = _find_floor(key, rng, shelf, points, inside, config)
    foreground = inside & (np.asarray(floor.height(jnp.asarray(points))) > config.floor_clearance)
    if joints is not None:
        distance, _ = config.pose.robot_distance(jnp.asarray(points[foreground]), angles, fingers)
        foreground[foreground] = np.asarray(distance) > config.robot_clearance
    labels = _segment(colour, depth, points, foreground, mask, config)

    kept = np.flatnonzero(labels >= 0)
    if len(kept):
        drawn = kept[rng.permutation(len(kept))[: config.points]]
        drawn = np.resize(drawn, config.points)
        flat, tints, names = points.reshape(-1, 3)[drawn], colour.reshape(-1, 3)[drawn], labels.reshape(-1)[drawn]
    else:
        flat = tints = np.zeros((config.points, 3))
        names = np.full(config.points, BACKGROUND)
    cloud = ObjectCloud(
        points=jnp.asarray(flat, jnp.float32),
        labels=jnp.asarray(names, jnp.int32),
        colours=jnp.asarray(tints, jnp.float32),
        valid=jnp.full(config.points, bool(len(kept))),
    )
    image = jnp.asarray(labels)
    pixels = jnp.asarray(colour, jnp.float32).reshape(-1, 3)
    detection = detect_target(pixels, image.reshape(-1), config.segments, config.target)
    return PreparedImage(cloud, image, jnp.asarray(depth), detection, floor, pose, camera)
