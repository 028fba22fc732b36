"""Places for a picked object: random ones, and whether arm and object get there."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.actions.approach import (
    CLOSE_WAYPOINTS,
    CROSSING_PLACES,
    SWEPT_PLACES,
    cloud_index,
    crossing_places,
    gripper_clouds,
    swept_places,
)
from mechsearch_jax.actions.config import OPEN, ActionSpace
from mechsearch_jax.actions.stacks import lift
from mechsearch_jax.actions.unseen_space import PossibleSpace, enters
from mechsearch_jax.dynamics.rigid import held_pose, in_hand
from mechsearch_jax.geometry.bodies import enlarged, surface_of
from mechsearch_jax.geometry.collision import clouds_of, collisions
from mechsearch_jax.geometry.footprints import lowest_points
from mechsearch_jax.geometry.masked import masked_vmap, taken
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import make, matmul, rotate, transform, translate, yaw_rotation
from mechsearch_jax.robot.arm_hits import arm_hits
from mechsearch_jax.robot.entry import CLOSE_CROSSINGS, crossing_length, ways_in
from mechsearch_jax.robot.gripper import arm_hits_shelf
from mechsearch_jax.workspace.shelf import Shelf, cloud_hits_shelf, hits_shelf, past_open_side

# A body that stands nearer to the front edge than this share of its height may fall over the edge.
EDGE_SHARE = 0.25
# Largest turn of a joint between taking an object out of the shelf and bringing it back in [rad].
LARGEST_TRANSFER = 2.0
# Number of places where an object in the hand is tested on its crossing. Crossings are at most 28 cm long, so that
# places are at most 2.3 cm apart: less than the thinnest object measures.
OBJECT_PLACES = 12


class ObjectGrasp(NamedTuple):
    """How an object is grasped.

    Attributes:
      object: its index.
      T_world_gripper: pose of the gripper, shape (4, 4).
      wrist: index of the wrist angle.
      wanted: whether a place is to be computed.
    """

    object: Int[Array, ""]
    T_world_gripper: Float[Array, "4 4"]
    wrist: Int[Array, ""]
    wanted: Bool[Array, ""]


class Ends(NamedTuple):
    """Both ends of possible transfers of an object in the hand: the grasp first, then the places; W in all.

    Attributes:
      T_world_gripper: pose of the gripper, shape (W, 4, 4).
      T_world_object: pose of the object in the hand, shape (W, 4, 4).
      wanted: which are tested, shape (W,).
    """

    T_world_gripper: Float[Array, "w 4 4"]
    T_world_object: Float[Array, "w 4 4"]
    wanted: Bool[Array, " w"]


def placement(
    key: Array,
    space: ActionSpace,
    scene: Superquadrics,
    possible: PossibleSpace,
    grasp: ObjectGrasp,
) -> tuple[Bool[Array, ""], Float[Array, "4 4"], Float[Array, "4 4"]]:
    """The first of several random places where a picked object can be put.

    Args:
      key: PRNG key.
      space: what all actions share.
      scene: the objects.
      possible: where the target may be.
      grasp: of the object; if it is not wanted, no place is possible.

    Returns:
      Whether a place is possible, `T_world_gripper` at the release, and `T_world_object` there.
    """
    index, T_grasp = grasp.object, grasp.T_world_gripper
    cloud = surface_of(scene, index, space.config.object_points)
    position, rotation, turn, stands = _drawn_places(key, space, scene, possible, cloud, grasp)
    # The object turns about its centre, and the gripper with it.
    held = held_pose(scene, index, T_grasp)
    arm = T_grasp[:3, 3] - held[:3, 3]
    T_place = make(matmul(yaw_rotation(turn), T_grasp[:3, :3]), rotate(yaw_rotation(turn), arm) + position)
    T_world_gripper = jnp.concatenate([T_grasp[None], T_place])
    T_world_object = jnp.concatenate([held[None], make(rotation, position)])
    wanted = jnp.concatenate([grasp.wanted[None], stands & grasp.wanted])
    able = transfers(space, scene, grasp, cloud, Ends(T_world_gripper, T_world_object, wanted))
    first = jnp.argmax(able)
    return jnp.any(able), T_place[first], T_world_object[1:][first]


def _drawn_places(key, space: ActionSpace, scene: Superquadrics, possible: PossibleSpace, cloud, grasp: ObjectGrasp):
    """Random places for a picked object, most promising first: (position, rotation, turn, whether it can stand there).

    All are on the board, wherever the object stands now.
    Places that overlap other objects or the shelf come last, before these the places in possible space, and before
    these, for a body of several parts, those at the front edge. `order` is below 1, so that each rule outweighs it.
    """
    shelf, config, index, T_grasp = space.shelf, space.config, grasp.object, grasp.T_world_gripper
    tries, tests = config.placements
    by_x, by_y, by_yaw, turns, order = jax.random.uniform(key, (5, tries))
    x = shelf.front + by_x * (shelf.back - shelf.front)
    y = shelf.right + by_y * (shelf.left - shelf.right)
    turn = jnp.where(turns < 0.5, (2.0 * by_yaw - 1.0) * config.place_yaw, 0.0)
    approach = jnp.arctan2(T_grasp[1, 2], T_grasp[0, 2])
    turn = jnp.clip(turn, -space.max_yaw - approach, space.max_yaw - approach)

    z = (scene.position[:, 2] - lift(space, lowest_points(scene)))[index]
    position = jnp.stack([x, y, jnp.full(tries, z)], axis=-1)
    rotation = matmul(yaw_rotation(turn), in_hand(scene, index, T_grasp))
    points = transform(make(rotation, position)[:, None], cloud[None])
    on_board = ~jnp.any(hits_shelf(shelf, points + jnp.array([0.0, 0.0, 1e-3])[None, None]), axis=1)
    on_board &= jnp.min(points[..., 0], axis=1) > shelf.front + config.clearance
    on_board &= ~jnp.any(past_open_side(shelf, points[..., 0], points[..., 1], config.clearance), axis=1)
    obstacles = scene.valid & (jnp.arange(scene.capacity) != index) & grasp.wanted
    wider = enlarged(scene, config.clearance)
    mask = obstacles[None] & on_board[:, None]
    body = clouds_of(cloud.T[None])
    overlaps = collisions(body, np.zeros(tries, np.int32), make(rotation, position), wider, mask, own=True)
    overlapping = jnp.any(overlaps, axis=1)
    intrudes = jnp.any(enters(possible, points), axis=1) & (not config.as_in_paper)
    score = order - 2.0 * intrudes - 8.0 * (overlapping | ~on_board)
    if scene.parts is not None:
        # Such a body is often held by a narrow part, a neck, and let go askew. Which part holds it is not considered.
        several = jnp.sum(scene.parts.valid[index]) > 1
        score -= several & _at_the_edge(shelf, points)
    _, best = jax.lax.top_k(score, tests)
    return position[best], rotation[best], turn[best], (~overlapping & on_board)[best]


def _at_the_edge(shelf: Shelf, points: Float[Array, "tries p 3"]) -> Bool[Array, " tries"]:
    """At which places a body with these points on its surface is so near to the front edge that it may fall over it."""
    height = jnp.max(points[..., 2], axis=1) - shelf.board
    return jnp.min(points[..., 0], axis=1) < shelf.front + EDGE_SHARE * height


def transfers(
    space: ActionSpace,
    scene: Superquadrics,
    grasp: ObjectGrasp,
    cloud: Float[Array, "p 3"],
    ends: Ends,
) -> Bool[Array, " places"]:
    """To which of several places a grasped object can be taken.

    The arm must follow the way out and the way in closely, in the same configuration: between them, outside the shelf,
    it turns freely, but a change of configuration would fling the object away. Links 2 to 5 and the gripper must touch
    neither shelf nor objects, the grasped object no other on its way to the place, both nothing on their crossings
    along x, and between the crossings the object must be outside the shelf.

    Args:
      space: what all actions share.
      scene: the objects.
      grasp: of the picked object.
      cloud: its surface in its own frame [m].
      ends: the grasp, and the places.
    """
    tables, gripper, wrist = space.tables, space.gripper, grasp.wrist
    obstacles = scene.replace(valid=scene.valid & (jnp.arange(scene.capacity) != grasp.object))
    swept, clouds = cloud_index(tables, OPEN, wrist), gripper_clouds(tables).points

    def follows(shared, scene, T):
        (shelf, clouds), (obstacles, q7, swept) = shared, scene
        q, reachable, outside = ways_in(T, q7, gripper, CLOSE_CROSSINGS, CLOSE_WAYPOINTS)
        # Poses at most 5 cm apart.
        touches = jnp.any(arm_hits(q[::2], obstacles)) | jnp.any(arm_hits_shelf(q, shelf))
        touches |= cloud_hits_shelf(shelf, T, taken(clouds, swept[None])[0])
        return reachable & ~touches, q[0], outside

    of_scene = (obstacles, tables.q7[OPEN, wrist], swept)
    able, q, outside = masked_vmap(
        follows, ends.wanted, (space.shelf, clouds), of_scene, ends.T_world_gripper, block=32
    )
    able &= jnp.all(jnp.abs(q - q[:1]) < LARGEST_TRANSFER, axis=-1)
    able &= able[0]
    able &= ~_gripper_meets(space, obstacles, wrist, ends._replace(wanted=able))
    able &= ~_object_meets(space, obstacles, scene.size[grasp.object], cloud, ends._replace(wanted=able), outside)
    return able[1:] & able[0]


def _gripper_meets(
    space: ActionSpace, obstacles: Superquadrics, wrist: Int[Array, ""], ends: Ends
) -> Bool[Array, " w"]:
    """Whether the gripper comes within `clearance` of obstacles as it approaches a place, or hits one on its crossing.

    The approach to the grasp was tested before.
    """
    T_world_gripper, _, wanted = ends
    n, w, tables = obstacles.capacity, len(T_world_gripper), space.tables
    swept, still = (cloud_index(tables, OPEN, wrist, at_rest) for at_rest in (False, True))
    wider = enlarged(obstacles, space.config.clearance)
    objects = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), wider, obstacles)
    crossings, crosses = crossing_places(space, T_world_gripper)
    places = jnp.concatenate([T_world_gripper[1:], crossings.reshape(-1, 4, 4)])
    at_rest = np.arange(len(places)) >= w - 1
    near = jnp.where(at_rest[:, None], np.arange(2 * n)[None] >= n, np.arange(2 * n)[None] < n)
    active = jnp.concatenate([wanted[1:], jnp.repeat(wanted & crosses, CROSSING_PLACES)])
    mask = active[:, None] & near & objects.valid[None]
    cloud = jnp.where(at_rest, still, swept)
    hits = jnp.any(collisions(gripper_clouds(tables), cloud, places, objects, mask), axis=1)
    approach, on_crossing = jnp.split(hits, [w - 1])
    return jnp.any(on_crossing.reshape(w, CROSSING_PLACES), axis=1) | jnp.pad(approach, (1, 0))


def _object_meets(
    space: ActionSpace,
    obstacles: Superquadrics,
    size: Float[Array, " 3"],
    cloud: Float[Array, "p 3"],
    ends: Ends,
    outside: Float[Array, " w"],
) -> Bool[Array, " w"]:
    """Whether the object in the hand hits obstacles on its way to a place or its crossing, or does not get outside.

    Its way out of the grasp was tested before.
    """
    T_world_gripper, T_world_object, wanted = ends
    w, p, gripper = len(T_world_gripper), OBJECT_PLACES, space.gripper
    back = -T_world_gripper[:, :3, 2]
    into = swept_places(T_world_object[1:], back[1:], gripper.approach)
    length = crossing_length(T_world_gripper, outside, gripper)
    share = (jnp.arange(p) + 1.0) / p
    shift = jnp.broadcast_to((gripper.approach * back)[:, None], (w, p, 3))
    shift = shift.at[..., 0].add(-length[:, None] * share[None])
    along = translate(jnp.broadcast_to(T_world_object[:, None], (w, p, 4, 4)), shift)
    ahead = jnp.sum(jnp.abs(T_world_object[:, 0, :3]) * size[None], axis=-1)
    inside = along[:, -1, 0, 3] + ahead > space.shelf.front
    places = jnp.concatenate([into.reshape(-1, 4, 4), along.reshape(-1, 4, 4)])
    active = jnp.concatenate([jnp.repeat(wanted[1:], SWEPT_PLACES), jnp.repeat(wanted & (length > 0.0), p)])
    mask = active[:, None] & obstacles.valid[None]
    body = clouds_of(cloud.T[None])
    hits = jnp.any(collisions(body, np.zeros(len(places), np.int32), places, obstacles, mask, own=True), axis=1)
    by_sweep, on_crossing = jnp.split(hits, [(w - 1) * SWEPT_PLACES])
    met = jnp.any(on_crossing.reshape(w, p), axis=1) | inside
    return met | jnp.pad(jnp.any(by_sweep.reshape(w - 1, SWEPT_PLACES), axis=1), (1, 0))
