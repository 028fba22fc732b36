"""Pushes: the closed hand moves along the board and pushes objects (paper appendix B.5)."""

from __future__ import annotations

import dataclasses
import itertools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from mechsearch_jax.actions.approach import (
    CLOSE_WAYPOINTS,
    CROSSING_PLACES,
    PLACES,
    cloud_index,
    crossing_places,
    gripper_clouds,
    object_clouds,
)
from mechsearch_jax.actions.config import CLOSED, ActionConfig, ActionSpace
from mechsearch_jax.actions.kind import SampledKind, Sketch
from mechsearch_jax.actions.kinds.object_grasps import PASSING_GAP
from mechsearch_jax.actions.stacks import stacks
from mechsearch_jax.actions.types import Action, Candidates, DrawnCandidate, Prediction, Sample
from mechsearch_jax.actions.unseen_space import PossibleSpace, cloud_enters
from mechsearch_jax.dynamics.push_model import LOW_CONTACT, PushModel
from mechsearch_jax.geometry.bodies import slimmed
from mechsearch_jax.geometry.collision import collisions
from mechsearch_jax.geometry.footprints import TOUCH, Footprints, extents, footprints, turned
from mechsearch_jax.geometry.masked import masked_vmap, taken
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import back_off, make, transform, translate
from mechsearch_jax.robot.arm_hits import arm_hits
from mechsearch_jax.robot.entry import (
    CLOSE_CROSSINGS,
    FEW_CROSSINGS,
    arm_follows,
    arm_path,
    crossing_poses,
    way_in,
)
from mechsearch_jax.robot.grasp_frames import gripper_rotation
from mechsearch_jax.robot.gripper import Gripper
from mechsearch_jax.robot.motion import MotionConfig, Reference, push_reference
from mechsearch_jax.workspace.shelf import Shelf, cloud_hits_shelf, past_open_side

# A push within these angles of +x or -x starts behind the object, any other beside it [rad].
BEHIND = (math.radians(75), math.radians(45))
CODE = 1
# Pushes that are predicted together on a CPU.
PUSHES = 32
# Number of places along a push that are tested for collision.
PUSH_PLACES = 3
# Least distance of a pushed object's centre from the front edge [m].
EDGE = 0.01
# As the hand goes back, moved objects are tested smaller by this on every side, since many touch the hand [m].
TOUCHING = 0.008


class PushStarts(NamedTuple):
    """Start poses of pushes relative to an object, V of them; constants.

    Attributes:
      heading: unit vector of the push, seen from above, shape (V, 2).
      across: unit vector across the push, away from the robot, shape (V, 2).
      share: offset of the finger tips across the push, as a share of the object's half extent, shape (V,).
      depth: offset across the push in addition [m], shape (V,).
      yaw: angle between the gripper's approach and +x, seen from above [rad], shape (V,).
      wrist: index of the wrist angle, shape (V,).
    """

    heading: Float[np.ndarray, "v 2"]
    across: Float[np.ndarray, "v 2"]
    share: Float[np.ndarray, " v"]
    depth: Float[np.ndarray, " v"]
    yaw: Float[np.ndarray, " v"]
    wrist: Int[np.ndarray, " v"]


def planar_unit(angle: float) -> Float[np.ndarray, "2"]:
    """The unit vector at an angle from +x towards +y [rad]; exact along the axes."""
    vector = np.array([math.cos(angle), math.sin(angle)])
    return np.where(np.abs(vector) < 1e-12, 0.0, vector).astype(np.float32)


def away_from_robot(heading: Shaped[Any, "2"], xp: Any) -> Shaped[Any, "2"]:
    """Unit vector across a heading, pointing away from the robot; `xp` is NumPy or `jax.numpy`."""
    return xp.stack([xp.abs(heading[1]), -heading[0] * xp.where(heading[1] < 0, -1.0, 1.0)])


def contact_height(
    config: ActionConfig, is_round: Bool[Array, "*batch"], along: Float[Array, "*batch"], tall: Float[Array, "*batch"]
) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
    """Height of the finger tips above the board in a push, and largest height of the first contact [m].

    Args:
      config: static.
      is_round: whether the pushed object is round.
      along: its half extent along the push [m].
      tall: its height [m].
    """
    leverage = jnp.where(is_round, config.push_leverage[1], config.push_leverage[0]) * along
    return jnp.clip(jnp.minimum(leverage, 0.75 * tall), LOW_CONTACT, config.push_height), leverage


def push_starts(config: ActionConfig, wrists: int) -> PushStarts:
    """Start poses of pushes: for each direction, each place across it, and each yaw and wrist of the gripper.

    Beside an object the finger tips reach just past its front, or past its centre so that the palm pushes. Behind it
    the places are spread over its width.

    Args:
      config: static.
      wrists: number of angles of joint 7.
    """
    rows = []
    for angle in config.push_directions:
        if BEHIND[0] < abs(angle) < math.pi - BEHIND[1]:
            places = zip((-1.0, 0.0), config.push_depths, strict=True)
            postures = tuple(itertools.product(config.push_yaws, range(wrists)))
        else:
            places = ((share, 0.0) for share in config.push_offsets)
            postures = config.push_postures
        heading = planar_unit(angle)
        for (share, depth), (yaw, wrist) in itertools.product(places, postures):
            rows.append((heading, away_from_robot(heading, np), share, depth, yaw, wrist))
    *numbers, wrist = zip(*rows, strict=True)
    heading, across, share, depth, yaw = (np.asarray(a, np.float32) for a in numbers)
    return PushStarts(heading, across, share, depth, yaw, np.asarray(wrist))


def _exit_distance(half, is_round, points, direction):
    """How far points must move along a direction to leave a footprint, in its frame; 0 if they never are inside."""
    safe = jnp.where(jnp.abs(direction) < 1e-6, 1e-6, direction)
    a, b = (-half - points) / safe, (half - points) / safe
    enter, leave = jnp.max(jnp.minimum(a, b), axis=-1), jnp.min(jnp.maximum(a, b), axis=-1)
    flat = jnp.where(enter < leave, leave, 0.0)
    p, d = points / half, direction / half
    dd, pd, pp = jnp.sum(d * d, axis=-1), jnp.sum(p * d, axis=-1), jnp.sum(p * p, axis=-1)
    square = pd**2 - dd * (pp - 1.0)
    meets = square > 0
    circle = jnp.where(meets, (-pd + jnp.sqrt(jnp.where(meets, square, 1.0))) / dd, 0.0)
    return jnp.maximum(jnp.where(is_round, circle, flat), 0.0)


def _half_extents(scene: Superquadrics, vectors: Float[np.ndarray, "v 2"]) -> Float[Array, "n v"]:
    """How far objects reach from their centres along planar unit vectors, many of them equal [m]."""
    unique, row = np.unique(vectors, axis=0, return_inverse=True)
    return extents(scene, jnp.asarray(np.pad(unique, ((0, 0), (0, 1))).T))[:, row.reshape(-1)]


def object_pushes(
    space: ActionSpace, scene: Superquadrics, prints: Footprints, fresh: Bool[Array, " n"]
) -> tuple[Float[Array, "n v 4 4"], Float[Array, "n v"]]:
    """Gripper poses where pushes start, at `push_gap` from each object, or from the footprint that bounds a body of
    several parts, and their sampling weights.

    The weight is 1 if the first contact is so low that it cannot topple the object, else 0. Computed for `fresh`
    objects only, in the order of `push_starts`.
    """
    shelf, config = space.shelf, space.config
    starts = push_starts(config, space.wrists)
    n, v = scene.capacity, len(starts.yaw)
    rotation = gripper_rotation(jnp.asarray(starts.yaw), jnp.full(v, config.push_tilt, jnp.float32))
    (x, y, z), (cosine, sine) = jnp.moveaxis(rotation, -1, 0), space.tables.turn
    rotation = jnp.stack([cosine * x + sine * y, cosine * y - sine * x, z], axis=-1)
    wide = _half_extents(scene, starts.across)
    along = _half_extents(scene, starts.heading)
    place = prints.position[:, None] + (starts.share[None] * wide)[..., None] * starts.across[None]
    place = place + (starts.depth[:, None] * starts.across)[None]
    tall = jnp.broadcast_to((prints.high - shelf.board)[:, None], (n, v))
    height, leverage = contact_height(config, jnp.broadcast_to(prints.round[:, None], (n, v)), along, tall)
    centre = jnp.concatenate([place, (shelf.board + height)[..., None]], axis=-1)
    T = make(jnp.broadcast_to(rotation[None], (n, v, 3, 3)), centre)
    # The pose of hand and fingers does not depend on the wrist's angle.
    begins = np.column_stack([starts.heading, starts.share, starts.depth, starts.yaw])
    _, first, alike = np.unique(begins, axis=0, return_index=True, return_inverse=True)
    headings = starts.heading[first]

    def clear(shared, _, row):
        (shelf, pusher), (body, T, heading) = shared, row
        world = transform(T, pusher)
        level = (world[:, 2] > body.low - config.push_gap) & (world[:, 2] < body.high + config.push_gap)
        local = turned(-body.yaw, world[:, :2] - body.position[None])
        heading = turned(-body.yaw, -heading)
        # The palm may pass close to the object's front; only along the push it keeps the whole gap.
        grown = body.half + PASSING_GAP
        away = _exit_distance(grown[None], body.round, local, jnp.broadcast_to(heading[None], local.shape))
        away = jnp.where(level, away, 0.0)
        farthest = jnp.max(away)
        touching = level & (away > farthest - TOUCH)
        lowest = jnp.min(jnp.where(touching, world[:, 2], jnp.inf))
        return farthest + config.push_gap - PASSING_GAP, lowest - shelf.board

    bodies = jax.tree.map(lambda a: jnp.repeat(a, len(first), axis=0), prints.replace(parts=None))
    rows = (bodies, T[:, first].reshape(-1, 4, 4), np.tile(headings, (n, 1)))
    measured = masked_vmap(clear, jnp.repeat(fresh, len(first)), (shelf, space.tables.pusher), None, rows)
    distance, contact = (a.reshape(n, len(first))[:, alike.reshape(-1)] for a in measured)
    stable = contact <= jnp.maximum(leverage, LOW_CONTACT)
    back = -distance[..., None] * starts.heading[None]
    return T.at[..., :2, 3].add(back), stable.astype(jnp.float32)


def _displacements(config: ActionConfig, heading: Float[np.ndarray, "*batch 2"]) -> Float[Array, "*batch d 3"]:
    """Displacements of the gripper along planar unit vectors, by every distance [m]."""
    level = np.concatenate([heading, np.zeros_like(heading[..., :1])], axis=-1)
    return jnp.asarray(level[..., None, :] * np.asarray(config.push_distances, np.float32)[:, None])


def motion_free(
    shelf: Shelf,
    gripper: Gripper,
    scene: Superquadrics,
    after: Superquadrics,
    still: Bool[Array, " n"],
    action: Action,
) -> Bool[Array, ""]:
    """Whether the arm can follow a push from outside the shelf and back, and links 2 to 5 touch nothing.

    It stays in one configuration and passes no singularity. `Push.travels` tests all candidates at fewer poses; this is
    the close test of the few that are drawn.

    Args:
      shelf: the shelf.
      gripper: static.
      scene, after: the objects before and after the push.
      still: which objects the push leaves in place.
      action: the push.
    """
    n = CLOSE_WAYPOINTS
    start, end = action.T_world_gripper, action.T_world_place
    push = translate(
        jnp.broadcast_to(start, (n, 4, 4)), jnp.linspace(0.0, 1.0, n)[:, None] * (end - start)[None, :3, 3]
    )
    into, back = jax.vmap(lambda T: way_in(T, gripper.nearest_outside, gripper, CLOSE_CROSSINGS, n))(
        jnp.stack([start, end])
    )
    q, follows = arm_path(jnp.concatenate([into, push[1:], back[::-1][1:]]), action.q7, shelf, gripper.arm)
    begins, ends = len(into), len(into) + n - 1
    # Poses at most 5 cm apart; those before the push are tested against the objects before it.
    stretches = q[:begins:2], q[begins:ends:3], q[ends::2]
    both = arm_hits(jnp.concatenate(stretches), _joined(scene, after))
    first, second = len(stretches[0]), len(stretches[0]) + len(stretches[1])
    into, along, back = (jnp.any(part, axis=0) for part in (both[:first], both[first:second], both[second:]))
    now = np.arange(2 * scene.capacity) < scene.capacity
    hits = jnp.where(now, into | (along & jnp.concatenate([still, still])), back)
    return follows & ~jnp.any(hits)


def _joined(*scenes: Superquadrics) -> Superquadrics:
    """The objects of all scenes."""
    return jax.tree.map(lambda *a: jnp.concatenate(a), *scenes)


def gripper_meets(
    space: ActionSpace,
    scene: Superquadrics,
    after: Superquadrics,
    action: Action,
    wrist: Int[Array, ""],
    moved: Bool[Array, " n"],
    pushes: Bool[Array, ""],
) -> Bool[Array, ""]:
    """Whether the gripper hits objects that a push must not touch.

    The `PushModel` covers hand and fingers while they push. Tested here are:
    links 6 and 7 during the push, against objects that stay; the way in along x, against all objects before the push;
    the way back, against moved objects except the pushed one, and along x against all objects after the push.

    Args:
      space: what all actions share.
      scene, after: the objects before and after the push.
      action: the push.
      wrist: index of its wrist angle.
      moved: which objects the push moves.
      pushes: whether the action is a push; if not, the result is False.
    """
    n, k, tables = scene.capacity, PUSH_PLACES, space.tables
    slim = slimmed(after, TOUCHING, 0.5)
    ends = jnp.stack([action.T_world_gripper, action.T_world_place])
    share = (jnp.arange(k) + 1.0) / k
    along = translate(jnp.broadcast_to(ends[0], (k, 4, 4)), share[:, None] * action.displacement[None])
    crossings, crosses = crossing_places(space, ends)
    places = jnp.concatenate([along, ends[1:], crossings.reshape(-1, 4, 4)])
    moved_along = moved & (jnp.arange(n) != action.object)
    nothing = jnp.zeros(n, bool)
    rows = [
        jnp.concatenate(row)
        for row in (
            (~moved, nothing, nothing),
            (nothing, nothing, moved_along),
            (jnp.broadcast_to(crosses[0], n), nothing, nothing),
            (nothing, jnp.broadcast_to(crosses[1], n), nothing),
        )
    ]
    objects = _joined(scene, after, slim)
    mask = jnp.repeat(jnp.stack(rows), np.array([k, 1, *[CROSSING_PLACES] * 2]), axis=0)
    swept, still = (cloud_index(tables, CLOSED, wrist, at_rest) for at_rest in (False, True))
    cloud = jnp.where(np.arange(len(places)) <= k, swept, still)
    return jnp.any(collisions(gripper_clouds(tables), cloud, places, objects, mask & objects.valid[None] & pushes))


def _in_words(displacement: Float[np.ndarray, " 3"]) -> str:
    """A direction in words as seen by the robot, to the nearest eighth of a turn."""
    eighth = round(math.atan2(displacement[1], displacement[0]) / (math.pi / 4))
    ahead = {0: "forward", 1: "forward", 3: "back", 4: "back"}.get(abs(eighth))
    side = {1: "to the left", -1: "to the right"}.get(np.sign(eighth)) if abs(eighth) in (1, 2, 3) else None
    return " and ".join(part for part in (ahead, side) if part)


@dataclasses.dataclass(frozen=True)
class Push(SampledKind):
    """A push in one of a few directions by one of a few distances."""

    code: int = CODE
    name: str = "push"
    moves_object: bool = True
    returns_home: bool = True
    opening: int = CLOSED
    surrounds_object: bool = False
    moves_target: bool = True

    def _starts(self, space: ActionSpace) -> PushStarts:
        return push_starts(space.config, space.wrists)

    def wrists(self, space: ActionSpace) -> Int[np.ndarray, " v"]:
        return self._starts(space).wrist

    def distances(self, space: ActionSpace) -> int:
        return len(space.config.push_distances)

    def propose(self, space, scene, prints, fresh):
        """See `object_pushes`."""
        return object_pushes(space, scene, prints, fresh)

    def _displacements(self, space: ActionSpace, capacity: int) -> Float[Array, "k d 3"]:
        return _displacements(space.config, np.tile(self._starts(space).heading, (capacity, 1)))

    def travels(self, space: ActionSpace, T, near) -> Bool[Array, "k d"]:
        """Whether the arm follows the push from outside and back, and the gripper misses the shelf at its end."""
        d, tables = self.distances(space), space.tables
        wrist = self.wrists(space)
        capacity = T.shape[0] // len(wrist)
        wrist = np.tile(wrist, capacity)
        ends = translate(jnp.broadcast_to(T[:, None], (T.shape[0], d, 4, 4)), self._displacements(space, capacity))

        gripper, outside = space.gripper, space.gripper.nearest_outside

        def leaves(shared, _, row):
            (shelf, clouds), (T, end, q7, cloud) = shared, row
            back = jnp.float32(gripper.approach)
            middle = translate(T, 0.5 * (end[:3, 3] - T[:3, 3]))
            into, out = crossing_poses(jnp.stack([T, end]), outside, gripper, FEW_CROSSINGS)
            push = jnp.stack([back_off(T, back), T, middle, end, back_off(end, back)])
            follows = arm_follows(jnp.concatenate([into, push, out[::-1]]), q7, shelf, gripper.arm)
            return follows & ~cloud_hits_shelf(shelf, end, taken(clouds, cloud[None])[0])

        q7, cloud = jnp.repeat(tables.q7[CLOSED, wrist], d), np.repeat(cloud_index(tables, CLOSED, wrist), d)
        rows = (jnp.repeat(T, d, axis=0), ends.reshape(-1, 4, 4), q7, jnp.asarray(cloud))
        shared = (space.shelf, gripper_clouds(tables).points)
        return masked_vmap(leaves, jnp.repeat(near, d), shared, None, rows).reshape(-1, d)

    def swept_hits(self, space, scene, T, mask):
        """The hand is empty."""
        return jnp.zeros(mask.shape, bool)

    def entering(
        self, space: ActionSpace, scene: Superquadrics, possible: PossibleSpace, candidates: Candidates
    ) -> Bool[Array, "n v d"]:
        """Whether gripper or object enters possible space, at places along the push less than two fingers apart."""
        n, v, d = candidates.reached.shape
        tables, wrist, owner = space.tables, np.tile(self.wrists(space), n), np.repeat(np.arange(n), v)
        clouds = object_clouds(scene, space.config.object_points)
        usable = candidates.reached & ~jnp.any(candidates.hits, axis=-1)[..., None] & (not space.config.as_in_paper)
        shift = self._displacements(space, n)

        def enters(grippers, scene, row):
            T, shift, gripper, owner = row
            possible, poses, bodies = scene
            passed = shift[None] * jnp.linspace(0.0, 1.0, PLACES)[:, None]
            along = [
                translate(jnp.broadcast_to(pose, (PLACES, 4, 4)), passed) for pose in (T, taken(poses, owner[None])[0])
            ]
            swept = [taken(grippers, gripper[None]), taken(bodies, owner[None])]
            entered = [cloud_enters(possible, *pair) for pair in zip(along, swept, strict=True)]
            return jnp.any(entered[0] | entered[1])

        rows = (
            jnp.repeat(candidates.T_world_gripper.reshape(-1, 4, 4), d, axis=0),
            shift.reshape(-1, 3),
            jnp.asarray(np.repeat(cloud_index(tables, CLOSED, wrist), d)),
            jnp.asarray(np.repeat(owner, d)),
        )
        grippers, of_scene = gripper_clouds(tables).points, (possible, make(scene.rotation, scene.position), clouds)
        return masked_vmap(enters, usable.reshape(-1), grippers, of_scene, rows, block=64).reshape(n, v, d)

    def draft(
        self, key, space: ActionSpace, scene, possible, candidates, drawn: DrawnCandidate
    ) -> tuple[Array, Sample]:
        """The push, and the poses of gripper and object between its ends."""
        _, v, d = candidates.reached.shape
        index, number = drawn.object, jnp.clip(drawn.number, 0, v * d - 1)
        push, distance = number // d, number % d
        starts = self._starts(space)
        T, wrist = candidates.T_world_gripper[index, push], jnp.asarray(starts.wrist)[push]
        displacement = _displacements(space.config, starts.heading)[push, distance]
        action = Action(
            kind=jnp.int32(CODE),
            object=index.astype(jnp.int32),
            T_world_gripper=T,
            displacement=displacement,
            T_world_place=translate(T, displacement),
            q7=space.tables.q7[CLOSED, wrist],
            opening=jnp.float32(0.0),
        )
        T_object = make(scene.rotation[index], scene.position[index])
        passed = displacement[None] * jnp.linspace(0.0, 1.0, PLACES)[:, None]
        grippers = translate(jnp.broadcast_to(T, (PLACES, 4, 4)), passed)
        bodies = translate(jnp.broadcast_to(T_object, (PLACES, 4, 4)), passed)
        return jnp.array(True), Sample(action, wrist, grippers, bodies)

    def predict(
        self,
        space: ActionSpace,
        push_model: PushModel,
        scene: Superquadrics,
        untouchable: Bool[Array, " n"],
        action: Action,
        wrist: Int[Array, ""],
    ) -> Prediction:
        """The prediction of the push model, and whether the push is possible.

        It is impossible if the arm cannot follow, or if the push jams, tips an object, moves an untouchable one, pushes
        one to the front edge, or makes the gripper hit one that stays; or if the prediction is not finite.

        Nothing of a stack is touched: push models predict what slides on the board, and are not shown what stands on
        something. What is moved must not end within its circle around what stands on something, as seen from above.
        """

        def predicted(space, element, _):
            return self._predicted(space, push_model, *element)

        # Of a batch of actions only the pushes are predicted.
        pushes, element = action.kind == CODE, (scene, untouchable, action, wrist)
        return jax.tree.map(lambda a: a[0], masked_vmap(predicted, pushes[None], space, element, None, block=PUSHES))

    def _predicted(
        self,
        space: ActionSpace,
        push_model: PushModel,
        scene: Superquadrics,
        untouchable: Bool[Array, " n"],
        action: Action,
        wrist: Int[Array, ""],
    ) -> Prediction:
        """`predict` of a push."""
        pushes = action.kind == CODE
        # Of a block that is not full, a push model that simulates has less to do.
        displacement = jnp.where(pushes, action.displacement, 0.0)
        prints = footprints(scene)
        carries, aloft = stacks(space, prints)
        standing = scene.replace(valid=scene.valid & ~aloft)
        pushed = push_model(space.shelf, standing, space.tables.pusher, action.T_world_gripper, displacement, action.q7)
        pushed = pushed.replace(scene=pushed.scene.replace(valid=scene.valid))
        moved = pushed.moved
        config = space.config
        allowed = pushed.resolved & jnp.isfinite(pushed.residual) & jnp.all(pushed.topples <= config.topple)
        spoiled = ~allowed | jnp.any(moved & (untouchable | jnp.any(carries, axis=1)))
        radius = jnp.sqrt(jnp.sum(prints.half**2, axis=1))
        apart = jnp.sum((pushed.scene.position[:, None, :2] - prints.position[None]) ** 2, axis=-1)
        near = apart < (radius[:, None] + radius[None]) ** 2
        spoiled |= jnp.any(moved[:, None] & aloft[None] & near)
        x, y, _ = pushed.scene.position.T
        spoiled |= jnp.any(moved & ((x < space.shelf.front + EDGE) | past_open_side(space.shelf, x, y, EDGE)))
        spoiled |= gripper_meets(space, scene, pushed.scene, action, wrist, moved, pushes & ~spoiled)

        def free(shelf, push, _):
            return motion_free(shelf, space.gripper, *push)

        push = (scene, pushed.scene, scene.valid & ~moved, action)
        follows = masked_vmap(free, (pushes & ~spoiled)[None], space.shelf, push, None)[0]
        return Prediction(pushed.scene, moved, ~spoiled & follows)

    def reference(self, action: Action, config: MotionConfig) -> tuple[Reference, Bool[Array, ""]]:
        """See `motion.push_reference`."""
        return push_reference(action.T_world_gripper, action.displacement, action.q7, config)

    def sketch(self, scene: Superquadrics, after: Superquadrics, action: Action) -> Sketch:
        """The hand at the start and the end of the push, and the line between them."""
        start, displacement = np.asarray(action.T_world_gripper, float), np.asarray(action.displacement, float)
        end = start.copy()
        end[:3, 3] += displacement
        share = np.linspace(0.0, 1.0, 40)[:, None]
        return Sketch(np.stack([start, end]), float(action.opening), path=start[:3, 3] + share * displacement)

    def describe(self, action: Action, target: int | None = None) -> str:
        d = np.asarray(action.displacement)
        what = "the target" if int(action.object) == target else f"object {int(action.object)}"
        on_edge = abs(float(np.asarray(action.T_world_gripper)[2, 1])) > 0.5
        how = ", the hand on edge" if on_edge else ""
        return f"push {what} by {100 * np.linalg.norm(d):.0f} cm {_in_words(d)}{how}"
