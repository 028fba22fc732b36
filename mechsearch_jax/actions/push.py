"""Pushes: the closed hand travels along the board, and what it meets gives way (paper appendix B.5)."""

from __future__ import annotations

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.actions.approach import CLOSE_WAYPOINTS, PLACES, crossing_hits, gripper_hits, object_clouds
from mechsearch_jax.actions.config import CLOSED, ActionConfig, ActionSpace, ActionTables
from mechsearch_jax.actions.push_starts import PushStarts, object_pushes, push_starts
from mechsearch_jax.actions.sketch import Sketch
from mechsearch_jax.actions.types import Action, Draft, Prediction, Ways
from mechsearch_jax.actions.unseen_space import PossibleSpace, enters
from mechsearch_jax.dynamics.push_model import PushModel
from mechsearch_jax.geometry.masked import masked_vmap
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import back_off, make, transform, translate
from mechsearch_jax.robot.arm_hits import arm_hits
from mechsearch_jax.robot.entry import (
    CLOSE_CROSSINGS,
    FEW_CROSSINGS,
    arm_follows,
    arm_path,
    crossing_length,
    crossing_poses,
    way_in,
)
from mechsearch_jax.robot.motion import MotionConfig, Reference, push_reference
from mechsearch_jax.workspace.shelf import hits_shelf

CODE = 1
# Number of places on the way of a push that are tested for collision.
PUSH_PLACES = 3
# An object is not to be pushed to where its centre is nearer than this to the front edge [m].
EDGE = 0.01
# As the hand goes back, objects that the push moved are tested smaller by this on every side: many touch the hand [m].
TOUCHING = 0.008


def _displacements(config: ActionConfig, heading: Float[np.ndarray, "*batch 2"]) -> Float[Array, "*batch d 3"]:
    """The ways of the gripper along planar unit vectors, by every distance [m]."""
    level = np.concatenate([heading, np.zeros_like(heading[..., :1])], axis=-1)
    return jnp.asarray(level[..., None, :] * np.asarray(config.push_distances, np.float32)[:, None])


def motion_free(
    space: ActionSpace, scene: Superquadrics, after: Superquadrics, still: Bool[Array, " n"], action: Action
) -> Bool[Array, ""]:
    """Whether the arm can follow a push from outside the shelf to outside, and links 2 to 5 touch nothing.

    It stays in one configuration and passes no singularity. Proposals are looked at in few poses, which is enough to
    rule out most; this is for the few that are drawn.

    Args:
      space: static.
      scene, after: the objects before and after the push.
      still: which objects it leaves in place.
      action: the push.
    """
    n, gripper = CLOSE_WAYPOINTS, space.gripper
    start, end = action.T_world_gripper, action.T_world_place
    way = translate(jnp.broadcast_to(start, (n, 4, 4)), jnp.linspace(0.0, 1.0, n)[:, None] * (end - start)[None, :3, 3])
    into, back = (way_in(T, gripper.nearest_outside, gripper, CLOSE_CROSSINGS, n) for T in (start, end))
    q, follows = arm_path(jnp.concatenate([into, way[1:], back[::-1][1:]]), action.q7, space.shelf)
    begins, ends = len(into), len(into) + n - 1
    # Poses 5 cm apart at most.
    hits = arm_hits(q[:begins:2], scene) | arm_hits(q[ends::2], after) | (arm_hits(q[begins:ends:3], scene) & still)
    return follows & ~jnp.any(hits)


def push_hits_others(
    space: ActionSpace,
    tables: ActionTables,
    scene: Superquadrics,
    action: Action,
    wrist: Int[Array, ""],
    still: Bool[Array, " n"],
) -> Bool[Array, ""]:
    """Whether a pushing gripper, on its way or on its retreat, hits an object that the push should leave in place.

    A `PushModel` knows the hand and the fingers; links 6 and 7 and the retreat are tested here.

    Args:
      space: static.
      tables: constants of the problem.
      scene: the objects, before or after the push.
      action: the push.
      wrist: index of its wrist angle.
      still: which objects it leaves in place.
    """
    share = (jnp.arange(PUSH_PLACES) + 1.0) / PUSH_PLACES
    T = jnp.broadcast_to(action.T_world_gripper, (PUSH_PLACES, 4, 4))
    T = translate(T, share[:, None] * action.displacement[None])
    mask = jnp.broadcast_to(still & scene.valid, (PUSH_PLACES, scene.capacity))
    return jnp.any(gripper_hits(tables, CLOSED, jnp.broadcast_to(wrist, PUSH_PLACES), T, scene, mask))


def retreat_hits(
    space: ActionSpace,
    tables: ActionTables,
    after: Superquadrics,
    action: Action,
    wrist: Int[Array, ""],
    moved: Bool[Array, " n"],
) -> Bool[Array, ""]:
    """Whether the gripper, on its straight way back, hits an object that the push moved beside its own.

    Args:
      space: static.
      tables: constants of the problem.
      after: the objects after the push.
      action: the push.
      wrist: index of its wrist angle.
      moved: which objects it moved.
    """
    others = moved & after.valid & (jnp.arange(after.capacity) != action.object)
    slim = after.replace(size=jnp.maximum(after.size - TOUCHING, 0.5 * after.size))
    return jnp.any(gripper_hits(tables, CLOSED, wrist[None], action.T_world_place[None], slim, others[None]))


def crossings_hit(
    space: ActionSpace,
    tables: ActionTables,
    scene: Superquadrics,
    after: Superquadrics,
    action: Action,
    wrist: Int[Array, ""],
    pushes: Bool[Array, ""],
) -> Bool[Array, ""]:
    """Whether the gripper hits an object before a push on its way in along x, or after the push on its way out.

    Args:
      space: static.
      tables: constants of the problem.
      scene, after: the objects before and after the push.
      action: the push.
      wrist: index of its wrist angle.
      pushes: whether it is one.
    """
    both = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), scene, after)
    now = jnp.arange(2 * scene.capacity) < scene.capacity
    mask = jnp.stack([now, ~now]) & both.valid[None] & pushes
    T = jnp.stack([action.T_world_gripper, action.T_world_place])
    return jnp.any(crossing_hits(space, tables, CLOSED, wrist, T, both, mask))


def _in_words(displacement: Float[np.ndarray, " 3"]) -> str:
    """A direction as the robot sees it, to the nearest eighth of a turn."""
    eighth = round(math.atan2(displacement[1], displacement[0]) / (math.pi / 4))
    ahead = {0: "forward", 1: "forward", 3: "back", 4: "back"}.get(abs(eighth))
    side = {1: "to the left", -1: "to the right"}.get(np.sign(eighth)) if abs(eighth) in (1, 2, 3) else None
    return " and ".join(part for part in (ahead, side) if part)


@dataclasses.dataclass(frozen=True)
class Push:
    """A `kind.SampledKind`: a push in one of a few directions by one of a few distances."""

    code: int = CODE
    name: str = "push"
    moves_object: bool = True
    holds_object: bool = False
    takes_target: bool = False
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

    def propose(self, space, tables, scene, prints, fresh):
        """See `object_pushes`."""
        return object_pushes(space, tables, scene, prints, fresh)

    def _displacements(self, space: ActionSpace, capacity: int) -> Float[Array, "k d 3"]:
        return _displacements(space.config, np.tile(self._starts(space).heading, (capacity, 1)))

    def travels(self, space: ActionSpace, tables: ActionTables, T, near) -> Bool[Array, "k d"]:
        """Whether the arm follows the push from outside to outside and nothing of it touches the shelf at its end."""
        d = self.distances(space)
        wrist = self.wrists(space)
        capacity = T.shape[0] // len(wrist)
        wrist = np.tile(wrist, capacity)
        ends = translate(jnp.broadcast_to(T[:, None], (T.shape[0], d, 4, 4)), self._displacements(space, capacity))

        gripper, outside = space.gripper, space.gripper.nearest_outside

        def follows(tables, row, i, crossing):
            starts, ends = row
            T, end = starts[i // d], ends[i // d, i % d]
            back = jnp.float32(gripper.approach)
            middle = translate(T, 0.5 * (end[:3, 3] - T[:3, 3]))
            path = jnp.stack([back_off(T, back), T, middle, end, back_off(end, back)])
            if crossing:
                into, out = (crossing_poses(pose, outside, gripper, FEW_CROSSINGS) for pose in (T, end))
                path = jnp.concatenate([into, path, out[::-1]])
            return arm_follows(path, tables.q7[CLOSED, jnp.asarray(wrist)[i // d]], space.shelf)

        def leaves(tables, row, i):
            points = transform(row[1][i // d, i % d], tables.clouds[CLOSED, jnp.asarray(wrist)[i // d]].T)
            return follows(tables, row, i, crossing=False) & ~jnp.any(hits_shelf(space.shelf, points))

        crosses = functools.partial(follows, crossing=True)
        reached = masked_vmap(leaves, jnp.repeat(near, d), tables, (T, ends), block=512)
        longest = jnp.maximum(crossing_length(T, outside, gripper)[:, None], crossing_length(ends, outside, gripper))
        crossing = reached & (longest > 0.0).reshape(-1)
        reached = (reached & ~crossing) | masked_vmap(crosses, crossing, tables, (T, ends), block=128)
        return reached.reshape(-1, d)

    def swept_hits(self, space, scene, T, mask):
        """The hand is empty."""
        return jnp.zeros(mask.shape, bool)

    def entering(
        self, space: ActionSpace, tables: ActionTables, scene: Superquadrics, possible: PossibleSpace, ways: Ways
    ) -> Bool[Array, "n v d"]:
        """Whether gripper or object enter possible space at places on the way less than two finger widths apart."""
        n, v, d = ways.reached.shape
        wrist, owner = np.tile(self.wrists(space), n), np.repeat(np.arange(n), v)
        clouds = object_clouds(scene, space.config.object_points)
        usable = ways.reached & ~jnp.any(ways.hits, axis=-1)[..., None] & space.config.avoid_unseen
        shift = self._displacements(space, n)

        def one(tables, row, i):
            T, shift, possible, scene, clouds = row
            k, j = i // d, i % d
            w, o = jnp.asarray(wrist)[k], jnp.asarray(owner)[k]
            way = shift[k, j][None] * jnp.linspace(0.0, 1.0, PLACES)[:, None]
            gripper = transform(T[k], tables.clouds[CLOSED, w].T)
            body = transform(make(scene.rotation[o], scene.position[o]), clouds[o].T)
            both = jnp.concatenate([gripper[None] + way[:, None], body[None] + way[:, None]], axis=1)
            return jnp.any(enters(jax.tree.map(lambda a: a[...], possible), both))

        row = (ways.T_world_gripper.reshape(-1, 4, 4), shift, possible, scene, clouds)
        return masked_vmap(one, usable.reshape(-1), tables, row, block=64).reshape(n, v, d)

    def draft(self, key, space: ActionSpace, tables: ActionTables, scene, possible, ways: Ways, index, way) -> Draft:
        """The push, and the space that it sweeps between its ends."""
        _, v, d = ways.reached.shape
        way = jnp.clip(way, 0, v * d - 1)
        push, distance = way // d, way % d
        starts = self._starts(space)
        T, wrist = ways.T_world_gripper[index, push], jnp.asarray(starts.wrist)[push]
        displacement = _displacements(space.config, starts.heading)[push, distance]
        action = Action(
            kind=jnp.int32(CODE),
            object=index.astype(jnp.int32),
            T_world_gripper=T,
            displacement=displacement,
            T_world_place=translate(T, displacement),
            q7=tables.q7[CLOSED, wrist],
            opening=jnp.float32(0.0),
        )
        T_object = make(scene.rotation[index], scene.position[index])
        passed = displacement[None] * jnp.linspace(0.0, 1.0, PLACES)[:, None]
        grippers = translate(jnp.broadcast_to(T, (PLACES, 4, 4)), passed)
        bodies = translate(jnp.broadcast_to(T_object, (PLACES, 4, 4)), passed)
        return Draft(jnp.array(True), action, wrist, grippers, bodies)

    def predict(
        self,
        space: ActionSpace,
        tables: ActionTables,
        push_model: PushModel,
        scene: Superquadrics,
        untouchable: Bool[Array, " n"],
        action: Action,
        wrist: Int[Array, ""],
    ) -> Prediction:
        """What the push model says; impossible where the arm cannot follow, or where it would do what it must not.

        That is: jam, tip an object, move what is untouchable, push an object to the front edge, or hit one that stays.
        A prediction that is not a number makes a push impossible, too.
        """
        pushes = action.kind == CODE
        # A model that simulates has less to do where nothing is pushed.
        way = jnp.where(pushes, action.displacement, 0.0)
        pushed = push_model(space.shelf, scene, tables.pusher, action.T_world_gripper, way, action.q7)
        moved = pushed.moved
        still = scene.valid & ~moved & pushes
        config = space.config
        holds = pushed.resolved & jnp.isfinite(pushed.residual) & jnp.all(pushed.topples <= config.topple)
        spoiled = ~holds | jnp.any(moved & untouchable)
        spoiled |= jnp.any(moved & (pushed.scene.position[:, 0] < space.shelf.front + EDGE))
        spoiled |= push_hits_others(space, tables, scene, action, wrist, still)
        spoiled |= retreat_hits(space, tables, pushed.scene, action, wrist, moved & pushes)
        spoiled |= crossings_hit(space, tables, scene, pushed.scene, action, wrist, pushes & ~spoiled)

        def free(_, row, i):
            return motion_free(space, *jax.tree.map(lambda a: a[...], row))

        follows = masked_vmap(free, (pushes & ~spoiled)[None], None, (scene, pushed.scene, still, action))[0]
        return Prediction(pushed.scene, moved, ~spoiled & follows)

    def reference(self, action: Action, config: MotionConfig) -> tuple[Reference, Bool[Array, ""]]:
        """See `motion.push_reference`."""
        return push_reference(action.T_world_gripper, action.displacement, action.q7, config)

    def sketch(self, scene: Superquadrics, after: Superquadrics, action: Action) -> Sketch:
        """The hand where it begins and where it ends, and its way between them."""
        start, way = np.asarray(action.T_world_gripper, float), np.asarray(action.displacement, float)
        end = start.copy()
        end[:3, 3] += way
        share = np.linspace(0.0, 1.0, 40)[:, None]
        return Sketch(np.stack([start, end]), float(action.opening), path=start[:3, 3] + share * way)

    def describe(self, action: Action, target: int | None = None) -> str:
        d = np.asarray(action.displacement)
        what = "the target" if int(action.object) == target else f"object {int(action.object)}"
        return f"push {what} by {100 * np.linalg.norm(d):.0f} cm {_in_words(d)}"
