"""Pick-and-places: an object is taken out of the shelf and put down elsewhere on the board (paper appendix B.5)."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.actions.approach import (
    CLOSE_WAYPOINTS,
    PLACES,
    approach_enters,
    crossing_hits,
    gripper_hits,
    object_clouds,
    swept_object,
)
from mechsearch_jax.actions.config import OPEN, ActionSpace, ActionTables
from mechsearch_jax.actions.object_grasps import grasp_variants, object_grasps
from mechsearch_jax.actions.sketch import Sketch
from mechsearch_jax.actions.types import Action, Draft, Prediction, Ways
from mechsearch_jax.actions.unseen_space import PossibleSpace, enters
from mechsearch_jax.dynamics.rigid import in_hand, pick_and_place
from mechsearch_jax.geometry import superquadric
from mechsearch_jax.geometry.collision import Pair, any_inside
from mechsearch_jax.geometry.masked import masked_vmap
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import compose, inverse, make, matmul, rotate, transform, yaw_rotation
from mechsearch_jax.robot.arm_hits import arm_hits
from mechsearch_jax.robot.entry import CLOSE_CROSSINGS, arm_enters, crossing_length, ways_in
from mechsearch_jax.robot.gripper import arm_hits_shelf
from mechsearch_jax.robot.motion import MotionConfig, Reference, pick_and_place_reference
from mechsearch_jax.workspace.shelf import hits_shelf

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

    def pair(_, row, i):
        T, scene, clouds, owner, held = row
        k, j = i // n, i % n
        o = owner[k]
        cloud = swept_object(clouds[o], matmul(held[k].T, T[k][:3, :3]), distance)
        T_object_world = inverse(make(scene.rotation[j], scene.position[j]))
        T_object_owner = compose(T_object_world, make(held[k], scene.position[o]))
        return Pair(cloud, T_object_owner, scene.size[j], scene.exponents[j])

    # A sphere around the owner, swept along a segment, against a sphere around the other.
    start = scene.position[owner]
    along = -T[:, :3, 2] * distance
    offset = scene.position[None] - start[:, None]
    t = jnp.clip(jnp.sum(offset * along[:, None], axis=-1) / distance**2, 0.0, 1.0)
    gap2 = jnp.sum((offset - t[..., None] * along[:, None]) ** 2, axis=-1)
    radius = superquadric.bounding_radius(scene.size)
    near = gap2 < (radius[owner][:, None] + radius[None]) ** 2
    return any_inside((mask & near).reshape(-1), pair, None, (T, scene, clouds, owner, held)).reshape(c, n)


def _drawn_places(key, space: ActionSpace, scene: Superquadrics, possible: PossibleSpace, index, T_grasp):
    """Random places for a picked object, most promising first: (position, rotation, turn, whether it can stand there).

    Those where it would overlap others or the shelf come last, those in possible space before them.
    """
    shelf, config = space.shelf, space.config
    tries, tests = config.placements
    n = scene.capacity
    key_x, key_y, key_yaw, key_turn, key_order = jax.random.split(key, 5)
    x = jax.random.uniform(key_x, (tries,), minval=shelf.front, maxval=shelf.back)
    y = jax.random.uniform(key_y, (tries,), minval=shelf.right, maxval=shelf.left)
    turn = jax.random.uniform(key_yaw, (tries,), minval=-config.place_yaw, maxval=config.place_yaw)
    turn = jnp.where(jax.random.bernoulli(key_turn, 0.5, (tries,)), turn, 0.0)
    approach = jnp.arctan2(T_grasp[1, 2], T_grasp[0, 2])
    turn = jnp.clip(turn, -space.max_yaw - approach, space.max_yaw - approach)

    position = jnp.stack([x, y, jnp.full(tries, scene.position[index, 2])], axis=-1)
    rotation = matmul(yaw_rotation(turn), in_hand(scene, index, T_grasp))
    cloud = superquadric.sample_surface(scene.size[index], scene.exponents[index], config.object_points)
    points = transform(make(rotation, position)[:, None], cloud[None])
    on_board = ~jnp.any(hits_shelf(shelf, points + jnp.array([0.0, 0.0, 1e-3])[None, None]), axis=1)
    on_board &= jnp.min(points[..., 0], axis=1) > shelf.front + config.clearance
    other = scene.replace(size=scene.size + config.clearance, valid=scene.valid.at[index].set(False))
    offset = position[:, None] - scene.position[None]
    reach = superquadric.bounding_radius(other.size) + superquadric.bounding_radius(scene.size[index])
    near = (jnp.sum(offset**2, axis=-1) < reach[None] ** 2) & other.valid[None] & on_board[:, None]

    def overlap(_, row, i):
        position, rotation, cloud, other = row
        k, j = i // n, i % n
        T_object_world = inverse(make(other.rotation[j], other.position[j]))
        T = compose(T_object_world, make(rotation[k], position[k]))
        return Pair(cloud[...].T, T, other.size[j], other.exponents[j])

    row = (position, rotation, cloud, other)
    overlapping = jnp.any(any_inside(near.reshape(-1), overlap, None, row).reshape(near.shape), axis=1)
    intrudes = jnp.any(enters(possible, points), axis=1) & config.avoid_unseen
    score = jax.random.uniform(key_order, (tries,)) - 2.0 * intrudes - 8.0 * (overlapping | ~on_board)
    _, best = jax.lax.top_k(score, tests)
    return position[best], rotation[best], turn[best], (~overlapping & on_board)[best]


def _placement(key, space: ActionSpace, tables: ActionTables, scene, possible, index, T_grasp, wrist):
    """A place for a picked object, and the gripper pose that puts it there: (found, T_world_place, T_world_object)."""
    shelf, config = space.shelf, space.config
    n, tests = scene.capacity, config.placements[1]
    position, rotation, turn, candidate = _drawn_places(key, space, scene, possible, index, T_grasp)
    other = scene.replace(size=scene.size + config.clearance, valid=scene.valid.at[index].set(False))
    cloud = superquadric.sample_surface(scene.size[index], scene.exponents[index], config.object_points)
    # The object turns about its own centre, and the gripper with it.
    arm = T_grasp[:3, 3] - scene.position[index]
    T_place = make(matmul(yaw_rotation(turn), T_grasp[:3, :3]), rotate(yaw_rotation(turn), arm) + position)

    def clear(tables, row, i):
        return ~jnp.any(hits_shelf(shelf, transform(row[0][i], tables.clouds[OPEN, row[1][...]].T)))

    q7 = jnp.broadcast_to(tables.q7[OPEN, wrist], tests)
    clear_way = arm_enters(shelf, space.gripper, space.waypoints, T_place, q7, candidate)
    clear_way = masked_vmap(clear, clear_way, tables, (T_place, wrist))

    mask = clear_way[:, None] & other.valid[None]
    hits = gripper_hits(tables, OPEN, jnp.full(tests, wrist), T_place, other, mask)

    def body_pair(_, row, i):
        T, position, rotation, cloud, scene = row
        k, j = i // n, i % n
        swept = swept_object(cloud[...].T, matmul(rotation[k].T, T[k][:3, :3]), space.gripper.approach)
        T_object_world = inverse(make(scene.rotation[j], scene.position[j]))
        T_object_body = compose(T_object_world, make(rotation[k], position[k]))
        return Pair(swept, T_object_body, scene.size[j], scene.exponents[j])

    row = (T_place, position, rotation, cloud, scene)
    mask = clear_way[:, None] & other.valid[None] & ~hits
    hits |= any_inside(mask.reshape(-1), body_pair, None, row, block=32).reshape(mask.shape)
    free = clear_way & ~jnp.any(hits, axis=1)
    first = jnp.argmax(free)
    return jnp.any(free), T_place[first], make(rotation[first], position[first])


def motion_free(
    space: ActionSpace, others: Superquadrics, T_world_gripper: Float[Array, "2 4 4"], q7: Float[Array, ""]
) -> tuple[Bool[Array, ""], Float[Array, "2"]]:
    """Whether the arm can follow both ways in and out closely, in one configuration, and links 2 to 5 touch nothing.

    Between them the arm is outside the shelf, where it may turn as it likes, but not into another of its
    configurations: it would fling away what it holds.

    Args:
      space: static.
      others: the objects without the one in the hand.
      T_world_gripper: where the object is grasped and where it is placed.
      q7: angle of joint 7 [rad].

    Returns:
      Whether it can, and from which places outside [m].
    """
    q, reachable, outside = jax.vmap(lambda T: ways_in(T, q7, space.gripper, CLOSE_CROSSINGS, CLOSE_WAYPOINTS))(
        T_world_gripper
    )
    # Poses 5 cm apart at most.
    hits = jnp.any(arm_hits(q[:, ::2].reshape(-1, q.shape[-1]), others))
    able = jnp.all(reachable) & ~jnp.any(arm_hits_shelf(q, space.shelf)) & ~hits
    return able & jnp.all(jnp.abs(q[1, 0] - q[0, 0]) < LARGEST_TRANSFER), outside


def crossings_free(
    space: ActionSpace,
    tables: ActionTables,
    scene: Superquadrics,
    after: Superquadrics,
    action: Action,
    wrist: Int[Array, ""],
    outside: Float[Array, "2"],
    picks: Bool[Array, ""],
) -> Bool[Array, ""]:
    """Whether gripper and object hit nothing on their ways along x, and the object is outside the shelf between them.

    Args:
      space: static.
      tables: constants of the problem.
      scene, after: the objects before and after.
      action: the pick-and-place.
      wrist: index of its wrist angle.
      outside: where the gripper is outside after the grasp, and before it places [m].
      picks: whether it is one.
    """
    n, index, p = scene.capacity, action.object, OBJECT_PLACES
    T = jnp.stack([action.T_world_gripper, action.T_world_place])
    others = scene.valid & (jnp.arange(n) != index) & picks
    hit = jnp.any(crossing_hits(space, tables, OPEN, wrist, T, scene, jnp.broadcast_to(others, (2, n))))

    held = in_hand(scene, index, action.T_world_gripper)
    rotation = jnp.stack([held, after.rotation[index]])
    position = jnp.stack([scene.position[index], after.position[index]]) - space.gripper.approach * T[:, :3, 2]
    length = crossing_length(T, outside, space.gripper)
    share = (jnp.arange(p) + 1.0) / p
    passed = jnp.broadcast_to(position[:, None], (2, p, 3)).at[..., 0].add(-length[:, None] * share[None])
    ahead = jnp.sum(jnp.abs(rotation[:, 0]) * scene.size[index][None], axis=-1)
    inside = passed[:, -1, 0] + ahead > space.shelf.front

    def pair(_, row, i):
        rotation, passed, cloud, scene = row
        way, place, j = i // (p * n), i // n % p, i % n
        T_object_world = inverse(make(scene.rotation[j], scene.position[j]))
        T = compose(T_object_world, make(rotation[way], passed[way, place]))
        return Pair(cloud[...].T, T, scene.size[j], scene.exponents[j])

    reach = superquadric.bounding_radius(scene.size)
    gap2 = jnp.sum((passed[:, :, None] - scene.position[None, None]) ** 2, axis=-1)
    near = others[None, None] & (length > 0.0)[:, None, None] & (gap2 < ((reach + reach[index]) ** 2)[None, None])
    cloud = superquadric.sample_surface(scene.size[index], scene.exponents[index], space.config.object_points)
    hit |= jnp.any(any_inside(near.reshape(-1), pair, None, (rotation, passed, cloud, scene), block=32))
    return ~hit & ~jnp.any(inside)


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
        wrist = np.tile(self.wrists(space), n)
        T = ways.T_world_gripper.reshape(-1, 4, 4)
        return approach_enters(tables, possible, OPEN, wrist, T, usable.reshape(-1)).reshape(n, v, d)

    def draft(self, key, space: ActionSpace, tables: ActionTables, scene, possible, ways: Ways, index, way) -> Draft:
        """The grasp, a place, and the space at both ends."""
        way = jnp.clip(way, 0, ways.reached.shape[1] - 1)
        T, wrist = ways.T_world_gripper[index, way], jnp.asarray(self.wrists(space))[way]
        placed, T_place, T_object = _placement(key, space, tables, scene, possible, index, T, wrist)
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
        """The object, turned in the hand, moves with the gripper; impossible where either cannot get in or out."""
        picks = action.kind == CODE
        after = pick_and_place(scene, action.object, action.T_world_gripper, action.T_world_place)

        def follows(_, row, i):
            others, grasp, place, q7 = jax.tree.map(lambda a: a[...], row)
            return motion_free(space, others, jnp.stack([grasp, place]), q7)

        others = scene.replace(valid=scene.valid & (jnp.arange(scene.capacity) != action.object))
        row = (others, action.T_world_gripper, action.T_world_place, action.q7)
        able, outside = (a[0] for a in masked_vmap(follows, picks[None], None, row))
        free = crossings_free(space, tables, scene, after, action, wrist, outside, able)
        return Prediction(after, scene.valid & ~others.valid, able & free)

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
