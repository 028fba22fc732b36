"""Pick-and-places: an object is taken out of the shelf and put down elsewhere on the board (paper appendix B.5)."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.actions.approach import (
    CLOSE_WAYPOINTS,
    CROSSING_PLACES,
    PLACES,
    SWEPT_PLACES,
    approach_enters,
    cloud_index,
    crossing_places,
    gripper_clouds,
    object_clouds,
    swept_places,
)
from mechsearch_jax.actions.config import OPEN, ActionSpace, ActionTables
from mechsearch_jax.actions.object_grasps import grasp_variants, object_grasps
from mechsearch_jax.actions.sketch import Sketch
from mechsearch_jax.actions.types import Action, Draft, Prediction, Ways
from mechsearch_jax.actions.unseen_space import PossibleSpace, enters
from mechsearch_jax.dynamics.rigid import in_hand, pick_and_place
from mechsearch_jax.geometry import superquadric
from mechsearch_jax.geometry.collision import clouds_of, collisions
from mechsearch_jax.geometry.masked import masked_vmap, taken
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import make, matmul, rotate, transform, translate, yaw_rotation
from mechsearch_jax.robot.arm_hits import arm_hits
from mechsearch_jax.robot.entry import CLOSE_CROSSINGS, crossing_length, ways_in
from mechsearch_jax.robot.gripper import arm_hits_shelf
from mechsearch_jax.robot.motion import MotionConfig, Reference, pick_and_place_reference
from mechsearch_jax.workspace.shelf import cloud_hits_shelf, hits_shelf

CODE = 2
# How far a joint may turn between where an object is taken out of the shelf and where it is brought in [rad].
LARGEST_TRANSFER = 2.0
# At how many places of its crossing an object in the hand is tested. Crossings are at most 28 cm long, which leaves
# 2.3 cm from place to place: less than the thinnest object measures.
OBJECT_PLACES = 12


def _object_hits(T, owner, held, scene, clouds, distance, mask):
    """Which others an object hits on its way along the gripper's -z: (C,) grasps of objects `owner` against (N).

    `held` says how each owner is turned in the hand. Its own column has to be masked out.
    """
    c, n = mask.shape
    places = swept_places(make(held, scene.position[owner]), -T[:, :3, 2], distance)
    wanted = jnp.repeat(mask, SWEPT_PLACES, axis=0)
    hits = collisions(
        clouds_of(clouds), jnp.repeat(owner, SWEPT_PLACES), places.reshape(-1, 4, 4), scene, wanted, own=True
    )
    return jnp.any(hits.reshape(c, SWEPT_PLACES, n), axis=1)


def _drawn_places(key, space: ActionSpace, scene: Superquadrics, possible: PossibleSpace, cloud, index, T_grasp, picks):
    """Random places for a picked object, most promising first: (position, rotation, turn, whether it can stand there).

    Those where it would overlap others or the shelf come last, those in possible space before them.
    """
    shelf, config = space.shelf, space.config
    tries, tests = config.placements
    by_x, by_y, by_yaw, turns, order = jax.random.uniform(key, (5, tries))
    x = shelf.front + by_x * (shelf.back - shelf.front)
    y = shelf.right + by_y * (shelf.left - shelf.right)
    turn = jnp.where(turns < 0.5, (2.0 * by_yaw - 1.0) * config.place_yaw, 0.0)
    approach = jnp.arctan2(T_grasp[1, 2], T_grasp[0, 2])
    turn = jnp.clip(turn, -space.max_yaw - approach, space.max_yaw - approach)

    position = jnp.stack([x, y, jnp.full(tries, scene.position[index, 2])], axis=-1)
    rotation = matmul(yaw_rotation(turn), in_hand(scene, index, T_grasp))
    points = transform(make(rotation, position)[:, None], cloud[None])
    on_board = ~jnp.any(hits_shelf(shelf, points + jnp.array([0.0, 0.0, 1e-3])[None, None]), axis=1)
    on_board &= jnp.min(points[..., 0], axis=1) > shelf.front + config.clearance
    others = scene.valid & (jnp.arange(scene.capacity) != index) & picks
    wider = scene.replace(size=scene.size + config.clearance)
    mask = others[None] & on_board[:, None]
    body = clouds_of(cloud.T[None])
    overlaps = collisions(body, np.zeros(tries, np.int32), make(rotation, position), wider, mask, own=True)
    overlapping = jnp.any(overlaps, axis=1)
    intrudes = jnp.any(enters(possible, points), axis=1) & config.avoid_unseen
    score = order - 2.0 * intrudes - 8.0 * (overlapping | ~on_board)
    _, best = jax.lax.top_k(score, tests)
    return position[best], rotation[best], turn[best], (~overlapping & on_board)[best]


def placement(
    key: Array,
    space: ActionSpace,
    tables: ActionTables,
    scene: Superquadrics,
    possible: PossibleSpace,
    index: Int[Array, ""],
    T_grasp: Float[Array, "4 4"],
    wrist: Int[Array, ""],
    picks: Bool[Array, ""],
) -> tuple[Bool[Array, ""], Float[Array, "4 4"], Float[Array, "4 4"]]:
    """A place for a picked object where it can be put: the first of those that are drawn, if any will do.

    Args:
      key: PRNG key.
      space: all but the shelf is static.
      tables: constants of the problem.
      scene: the objects.
      possible: where the target may be.
      index: the object.
      T_grasp: where it is grasped.
      wrist: index of the wrist angle.
      picks: whether it is wanted; there is no place where it is not.

    Returns:
      Whether there is one, `T_world_gripper` as the object is released, and `T_world_object` then.
    """
    cloud = superquadric.sample_surface(scene.size[index], scene.exponents[index], space.config.object_points)
    drawn = _drawn_places(key, space, scene, possible, cloud, index, T_grasp, picks)
    position, rotation, turn, stands = drawn
    # The object turns about its own centre, and the gripper with it.
    arm = T_grasp[:3, 3] - scene.position[index]
    T_place = make(matmul(yaw_rotation(turn), T_grasp[:3, :3]), rotate(yaw_rotation(turn), arm) + position)
    held = make(in_hand(scene, index, T_grasp), scene.position[index])
    T_world_gripper = jnp.concatenate([T_grasp[None], T_place])
    T_world_object = jnp.concatenate([held[None], make(rotation, position)])
    wanted = jnp.concatenate([picks[None], stands & picks])
    able = transfers(space, tables, scene, index, cloud, wrist, T_world_gripper, T_world_object, wanted)
    first = jnp.argmax(able)
    return jnp.any(able), T_place[first], T_world_object[1:][first]


def transfers(
    space: ActionSpace,
    tables: ActionTables,
    scene: Superquadrics,
    index: Int[Array, ""],
    cloud: Float[Array, "p 3"],
    wrist: Int[Array, ""],
    T_world_gripper: Float[Array, "w 4 4"],
    T_world_object: Float[Array, "w 4 4"],
    wanted: Bool[Array, " w"],
) -> Bool[Array, " places"]:
    """To which of several places an object can be taken from where it is grasped.

    The arm has to follow both ways closely, in one configuration: between them it is outside the shelf, where it may
    turn as it likes, but not into another of its configurations: it would fling away what it holds. Links 2 to 5 and
    the gripper must touch neither the shelf nor another object, the object no other on its way to the place, both
    nothing on their ways along x, and between them the object has to be outside the shelf.

    Args:
      space: all but the shelf is static.
      tables: constants of the problem.
      scene: the objects.
      index: the one that is picked.
      cloud: its surface in its own frame [m].
      wrist: index of the wrist angle.
      T_world_gripper: where it is grasped, and the gripper at the places.
      T_world_object: the object in the hand where it is grasped, and at the places.
      wanted: which of them are looked at.
    """
    n, gripper = scene.capacity, space.gripper
    others = scene.replace(valid=scene.valid & (jnp.arange(n) != index))
    swept, clouds = cloud_index(tables, OPEN, wrist), gripper_clouds(tables).points

    def follows(shared, own, T):
        (shelf, clouds), (others, q7, swept) = shared, own
        q, reachable, outside = ways_in(T, q7, gripper, CLOSE_CROSSINGS, CLOSE_WAYPOINTS)
        # Poses 5 cm apart at most.
        touches = jnp.any(arm_hits(q[::2], others)) | jnp.any(arm_hits_shelf(q, shelf))
        touches |= cloud_hits_shelf(shelf, T, taken(clouds, swept[None])[0])
        return reachable & ~touches, q[0], outside

    own = (others, tables.q7[OPEN, wrist], swept)
    able, q, outside = masked_vmap(follows, wanted, (space.shelf, clouds), own, T_world_gripper, block=32)
    able &= jnp.all(jnp.abs(q - q[:1]) < LARGEST_TRANSFER, axis=-1)
    able &= able[0]
    able &= ~_gripper_meets(space, tables, others, wrist, T_world_gripper, able)
    able &= ~_object_meets(space, others, scene.size[index], cloud, T_world_gripper, T_world_object, outside, able)
    return able[1:] & able[0]


def _gripper_meets(
    space: ActionSpace,
    tables: ActionTables,
    others: Superquadrics,
    wrist: Int[Array, ""],
    T_world_gripper: Float[Array, "w 4 4"],
    wanted: Bool[Array, " w"],
) -> Bool[Array, " w"]:
    """Whether the gripper hits others on its approach to a place, at a distance from them, or on its way along x.

    What it meets on its approach to the grasp, which comes first, was looked at before.
    """
    n, ways = others.capacity, len(T_world_gripper)
    swept, still = (cloud_index(tables, OPEN, wrist, at_rest) for at_rest in (False, True))
    wider = others.replace(size=others.size + space.config.clearance)
    objects = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), wider, others)
    crossings, crosses = crossing_places(space, T_world_gripper)
    places = jnp.concatenate([T_world_gripper[1:], crossings.reshape(-1, 4, 4)])
    at_rest = np.arange(len(places)) >= ways - 1
    near = jnp.where(at_rest[:, None], np.arange(2 * n)[None] >= n, np.arange(2 * n)[None] < n)
    active = jnp.concatenate([wanted[1:], jnp.repeat(wanted & crosses, CROSSING_PLACES)])
    mask = active[:, None] & near & objects.valid[None]
    cloud = jnp.where(at_rest, still, swept)
    hits = jnp.any(collisions(gripper_clouds(tables), cloud, places, objects, mask), axis=1)
    approach, on_crossing = jnp.split(hits, [ways - 1])
    return jnp.any(on_crossing.reshape(ways, CROSSING_PLACES), axis=1) | jnp.pad(approach, (1, 0))


def _object_meets(
    space: ActionSpace,
    others: Superquadrics,
    size: Float[Array, " 3"],
    cloud: Float[Array, "p 3"],
    T_world_gripper: Float[Array, "w 4 4"],
    T_world_object: Float[Array, "w 4 4"],
    outside: Float[Array, " w"],
    wanted: Bool[Array, " w"],
) -> Bool[Array, " w"]:
    """Whether the object in the hand hits others on its way to a place, or along x, or is still in the shelf then.

    What it meets on its way from the grasp, which comes first, was looked at before.
    """
    ways, p, gripper = len(T_world_gripper), OBJECT_PLACES, space.gripper
    back = -T_world_gripper[:, :3, 2]
    into = swept_places(T_world_object[1:], back[1:], gripper.approach)
    length = crossing_length(T_world_gripper, outside, gripper)
    share = (jnp.arange(p) + 1.0) / p
    shift = jnp.broadcast_to((gripper.approach * back)[:, None], (ways, p, 3))
    shift = shift.at[..., 0].add(-length[:, None] * share[None])
    along = translate(jnp.broadcast_to(T_world_object[:, None], (ways, p, 4, 4)), shift)
    ahead = jnp.sum(jnp.abs(T_world_object[:, 0, :3]) * size[None], axis=-1)
    inside = along[:, -1, 0, 3] + ahead > space.shelf.front
    places = jnp.concatenate([into.reshape(-1, 4, 4), along.reshape(-1, 4, 4)])
    active = jnp.concatenate([jnp.repeat(wanted[1:], SWEPT_PLACES), jnp.repeat(wanted & (length > 0.0), p)])
    mask = active[:, None] & others.valid[None]
    body = clouds_of(cloud.T[None])
    hits = jnp.any(collisions(body, np.zeros(len(places), np.int32), places, others, mask, own=True), axis=1)
    by_sweep, on_crossing = jnp.split(hits, [(ways - 1) * SWEPT_PLACES])
    met = jnp.any(on_crossing.reshape(ways, p), axis=1) | inside
    return met | jnp.pad(jnp.any(by_sweep.reshape(ways - 1, SWEPT_PLACES), axis=1), (1, 0))


@dataclasses.dataclass(frozen=True)
class PickAndPlace:
    """A `kind.SampledKind`: a side grasp, and a random free place."""

    code: int = CODE
    name: str = "pick-and-place"
    moves_object: bool = True
    holds_object: bool = True
    takes_target: bool = False
    returns_home: bool = True
    opening: int = OPEN
    surrounds_object: bool = True
    # What could be picked could be taken out.
    moves_target: bool = False

    def wrists(self, space: ActionSpace) -> Int[np.ndarray, " v"]:
        return grasp_variants(space.config.grasps, space.wrists)[1]

    def distances(self, space: ActionSpace) -> int:
        return 1

    def propose(self, space, tables, scene, prints, fresh):
        """See `object_grasps`."""
        T, plausible = object_grasps(
            space.shelf, space.gripper, prints, space.config.grasps, space.max_yaw, space.wrists
        )
        return T, plausible.astype(jnp.float32)

    def travels(self, space, tables, T, near) -> Bool[Array, "k d"]:
        """The way out is the way in."""
        return near[:, None]

    def swept_hits(self, space: ActionSpace, scene: Superquadrics, T, mask) -> Bool[Array, "k n"]:
        """Which objects the grasped one hits on its way out; it may brush them `contact_tolerance` deep."""
        n, config = scene.capacity, space.config
        owner = jnp.asarray(np.repeat(np.arange(n), len(self.wrists(space))))
        held = jax.vmap(lambda index, T: in_hand(scene, index, T))(owner, T)
        slim = scene.replace(size=jnp.maximum(scene.size - config.contact_tolerance, 0.5 * scene.size))
        clouds = object_clouds(slim, config.object_points)
        return _object_hits(T, owner, held, scene, clouds, space.gripper.approach, mask)

    def entering(
        self, space: ActionSpace, tables: ActionTables, scene: Superquadrics, possible: PossibleSpace, ways: Ways
    ) -> Bool[Array, "n v d"]:
        """Whether the gripper enters possible space as it grasps; where the object is put is looked at later."""
        n, v, d = ways.reached.shape
        usable = ways.reached & ~jnp.any(ways.hits, axis=-1)[..., None] & space.config.avoid_unseen
        cloud = cloud_index(tables, OPEN, np.tile(self.wrists(space), n))
        T = ways.T_world_gripper.reshape(-1, 4, 4)
        return approach_enters(tables, possible, cloud, T, usable.reshape(-1)).reshape(n, v, d)

    def draft(self, key, space: ActionSpace, tables: ActionTables, scene, possible, ways, index, way, wanted) -> Draft:
        """The grasp, a place that it can be taken to, and the space at both ends."""
        way = jnp.clip(way, 0, ways.reached.shape[1] - 1)
        T, wrist = ways.T_world_gripper[index, way], jnp.asarray(self.wrists(space))[way]
        placed, T_place, T_object = placement(key, space, tables, scene, possible, index, T, wrist, wanted)
        action = Action(
            kind=jnp.int32(CODE),
            object=index.astype(jnp.int32),
            T_world_gripper=T,
            displacement=jnp.zeros(3),
            T_world_place=T_place,
            q7=tables.q7[OPEN, wrist],
            opening=jnp.float32(space.gripper.max_opening),
        )
        grippers = jnp.stack([T, *[T_place] * (PLACES - 1)])
        return Draft(placed, action, wrist, grippers, jnp.broadcast_to(T_object, (PLACES, 4, 4)))

    def predict(self, space, tables, push_model, scene, untouchable, action: Action, wrist) -> Prediction:
        """The object, turned in the hand, moves with the gripper; `draft` has found out that it can."""
        after = pick_and_place(scene, action.object, action.T_world_gripper, action.T_world_place)
        moved = scene.valid & (jnp.arange(scene.capacity) == action.object)
        return Prediction(after, moved, action.kind == CODE)

    def reference(self, action: Action, config: MotionConfig) -> tuple[Reference, Bool[Array, ""]]:
        """See `motion.pick_and_place_reference`."""
        return pick_and_place_reference(action.T_world_gripper, action.T_world_place, action.q7, action.opening, config)

    def sketch(self, scene: Superquadrics, after: Superquadrics, action: Action) -> Sketch:
        """The hand at both ends, and the object's way, as an arch above the others from its top to its top."""
        i = int(action.object)
        begin, end = (np.asarray(s.position, float)[i] for s in (scene, after))
        top = np.array([0.0, 0.0, float(np.abs(np.asarray(scene.rotation)[i, 2]) @ np.asarray(scene.size)[i])])
        share = np.linspace(0.0, 1.0, 40)[:, None]
        arch = 4 * share * (1 - share) * np.array([0.0, 0.0, 0.25 * np.linalg.norm(end - begin)])
        hands = np.stack([np.asarray(T, float) for T in (action.T_world_gripper, action.T_world_place)])
        return Sketch(hands, float(action.opening), path=begin + top + share * (end - begin) + arch)

    def describe(self, action: Action, target: int | None = None) -> str:
        shift = np.asarray(action.T_world_place - action.T_world_gripper)[:2, 3]
        return f"pick object {int(action.object)} and place it {100 * np.linalg.norm(shift):.0f} cm away"
