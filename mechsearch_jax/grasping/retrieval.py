"""The grasps of a found target: which of them arm and shelf allow, which objects each hits, and which are best.

There are ten times as many as at candidate poses, and they are tested more closely than in g: the crossing along x
before the straight approach counts too, and so do links 2 to 5.

A grasp succeeds if nothing is hit on the whole way in and out. But many that hit an object only brush it, or push it
aside. So a few grasps are worth a trial, the clearest first; see `planner.trials`.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.actions.approach import CLOSE_WAYPOINTS, CROSSING_PLACES
from mechsearch_jax.actions.kinds.retrieve import retrieve_action
from mechsearch_jax.actions.types import Action
from mechsearch_jax.actions.unseen_space import PossibleSpace, enters_unmeasured
from mechsearch_jax.geometry.bodies import enlarged, slimmed
from mechsearch_jax.geometry.collision import clouds_of, collisions
from mechsearch_jax.geometry.footprints import footprints, supports
from mechsearch_jax.geometry.masked import masked_vmap
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import compose, inverse, transform, upright_pose
from mechsearch_jax.grasping.config import GraspConfig
from mechsearch_jax.grasping.graspability import INFEASIBLE, GraspTables, feasible_grasps, grasp_tables
from mechsearch_jax.robot.arm_hits import arm_hits
from mechsearch_jax.robot.entry import arm_path, crossing_length, crossing_poses, way_in
from mechsearch_jax.robot.gripper import Gripper
from mechsearch_jax.robot.kinematics import JOINTS
from mechsearch_jax.runtime.compiled import cached_jit
from mechsearch_jax.runtime.pytree import PyTreeNode, static
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target
from mechsearch_jax.workspace.target_view import body_at

# Largest number of grasps that are tried.
TRIES = 8
# Number of poses on the crossing of each grasp; with fewer the arm may pass a singularity unnoticed.
CROSSINGS = 15
# Poses of the way in where the arm is tested against objects: at most 5.5 cm apart, 6.5 from 75 degrees to the side,
# and half of that before the fingers close. Closer poses would rule out grasps that succeed, since the arm's model is a
# little wider than the arm.
ARM_POSES = np.array([*range(2, CROSSINGS, 4), *range(CROSSINGS, CROSSINGS + CLOSE_WAYPOINTS, 2)])
# Amounts by which objects are grown to find the grasp with the most clearance [m].
CLEARANCES = (0.004, 0.008, 0.012, 0.02)
# Amounts by which objects are shrunk to find the grasp that hits them least deep [m].
DEPTHS = (0.006, 0.012, 0.024)
# Two grasps are alike if their approaches and their angles of joint 7 differ by less than these [rad].
ALIKE, ALIKE_WRIST = math.radians(10), math.radians(20)
# What a grasp that is turned from square ranks behind others that hit as many objects, whatever their clearance.
TURNED = 50
# Larger than the rank of any grasp that arm and shelf allow.
FAR = 1_000_000


class TargetGrasps(PyTreeNode):
    """The grasps for a found target, and the cell that decides which of them are feasible.

    Attributes:
      tables: constants of the grasps.
      shelf: data.
      target: as of a `Problem`.
      gripper, config: static.
    """

    tables: GraspTables
    shelf: Shelf
    gripper: Gripper = static()
    target: Target
    config: GraspConfig = static()

    def standing(self, pose: Float[Array, "3"]) -> Float[Array, "4 4"]:
        """`T_world_target` of the target standing on the board at x, y [m] and yaw [rad].

        Of one that looks alike at every yaw, which may have spun, it has yaw 0: its grasps are known about +x alone.
        """
        pose = pose.at[2].set(0.0) if self.target.round else pose
        return upright_pose(pose, self.target.height(self.shelf))


class FoundGrasps(PyTreeNode):
    """Feasibility of the F grasps of a found target, at any pose.

    Attributes:
      T_world_target: pose of the target, shape (4, 4).
      feasible: which grasps arm and shelf allow, shape (F,).
      q: joint angles at `ARM_POSES` on the way in to each, shape (F, W, 7) [rad].
    """

    T_world_target: jax.Array
    feasible: jax.Array
    q: jax.Array


class GraspChoice(PyTreeNode):
    """How to take out a found target.

    Attributes:
      success: whether neither gripper, target nor arm hits anything on the grasp's whole way in and out.
      feasible: whether arm and shelf allow the grasp.
      hits: number of objects that the grasp hits; `graspability.INFEASIBLE` if it is not feasible.
      action: the retrieval with the grasp; the best grasp is the one with the most clearance on its straight way among
        those with the fewest hits, square ones first.
    """

    success: jax.Array
    feasible: jax.Array
    hits: jax.Array
    action: Action


def target_grasps(shelf: Shelf, gripper: Gripper, target: Target, config: GraspConfig) -> TargetGrasps:
    """The grasps of a configuration for a found target. Not for use inside `jit`.

    Raises:
      InputError: the target is too wide for the gripper.
    """
    return TargetGrasps(grasp_tables(gripper, target, config), shelf, gripper, target, config)


def can_be_joined(sets: Sequence[TargetGrasps]) -> bool:
    """Whether several sets of grasps for the same target can be `joined`: they may differ in which grasps there are,
    but not in how grasps are tested."""

    def tested(one: TargetGrasps) -> tuple[Any, ...]:
        tables, config = one.tables, one.config
        shapes = tables.swept.points.shape[1:], tables.still_gripper.shape[1:], tables.still_target.shape
        return config.waypoints, shapes

    return len({tested(one) for one in sets}) == 1


def joined(sets: Sequence[TargetGrasps]) -> TargetGrasps:
    """All grasps of several sets for the same target, in order, as one set.

    Raises:
      ValueError: they cannot be joined.
    """
    if not can_be_joined(sets):
        raise ValueError("joined: the sets differ in waypoints or the numbers of points")
    first, tables = sets[0], [one.tables for one in sets]
    # Each set has its own wrists.
    before = np.cumsum([0, *(len(table.still_gripper) for table in tables)])
    fields: dict[str, Any] = {
        name: jax.tree.map(lambda *a: jnp.concatenate(a), *(getattr(table, name) for table in tables))
        for name in ("T_target_gripper", "q7", "turned", "ahead", "swept", "still_gripper")
    }
    wrist = jnp.concatenate([table.wrist + np.int32(start) for table, start in zip(tables, before, strict=False)])
    return first.replace(tables=GraspTables(**fields, wrist=wrist, still_target=tables[0].still_target))


def no_grasps(grasps: TargetGrasps) -> FoundGrasps:
    """The grasps of a target that is not found: none is feasible."""
    count = grasps.tables.q7.shape[0]
    return FoundGrasps(jnp.eye(4), jnp.zeros(count, bool), jnp.zeros((count, len(ARM_POSES), len(JOINTS))))


def found_grasps(
    grasps: TargetGrasps, T_world_target: Float[Array, "4 4"], active: Bool[Array, ""] | bool = True
) -> FoundGrasps:
    """The grasps of a target at any pose that arm and shelf allow on the whole way in and out.

    Args:
      grasps: the grasps to choose from.
      T_world_target: pose of the target.
      active: whether the target is found; if not, no grasp is feasible and little is computed.
    """
    tables, gripper, shelf = grasps.tables, grasps.gripper, grasps.shelf
    feasible = feasible_grasps(tables, shelf, gripper, grasps.config, T_world_target[None], active)[0]

    def enters(shelf, _, row):
        T, q7 = row
        path = way_in(T, gripper.nearest_outside, gripper, CROSSINGS, CLOSE_WAYPOINTS)
        q, follows = arm_path(path, q7, shelf, gripper.arm)
        return follows, q[ARM_POSES]

    T = compose(T_world_target[None], tables.T_target_gripper)
    able, q = masked_vmap(enters, feasible, shelf, None, (T, tables.q7), block=64)
    return FoundGrasps(T_world_target, feasible & able, q)


def straight_hits(
    tables: GraspTables, found: FoundGrasps, scene: Superquadrics, active: Bool[Array, ""] | bool = True
) -> Bool[Array, "f n"]:
    """Which objects gripper or target hit on the straight way in and out of each feasible grasp.

    Args:
      tables: the grasps.
      found: their feasibility for the found target.
      scene: the objects, without the target.
      active: if false, nothing is hit and little is computed.
    """
    T_world_gripper = compose(found.T_world_target[None], tables.T_target_gripper)
    mask = (found.feasible & jnp.asarray(active))[:, None] & scene.valid[None]
    return collisions(tables.swept, np.arange(len(tables.q7), dtype=np.int32), T_world_gripper, scene, mask)


def found_hits(
    grasps: TargetGrasps,
    found: FoundGrasps,
    scene: Superquadrics,
    active: Bool[Array, ""] | bool = True,
    previous: Bool[Array, "f n"] | None = None,
    moved: Bool[Array, " n"] | None = None,
) -> Bool[Array, "f n"]:
    """Which objects each grasp of a found target hits on its whole way; grasps that are not feasible hit none.

    Args:
      grasps: the grasps, as in `found_grasps`.
      found: their feasibility for the found target.
      scene: the objects, without the target.
      active: if false, nothing is hit and little is computed.
      previous: the hits before objects moved.
      moved: which objects moved since; only their columns are computed anew.
    """
    if found.feasible.shape[0] == 0:
        return jnp.zeros((0, scene.capacity), bool)
    here = jnp.asarray(active)
    fresh = scene.replace(valid=scene.valid if moved is None else scene.valid & moved)
    hits = straight_hits(grasps.tables, found, fresh, here)
    feasible = found.feasible & here
    hits |= crossing_hits(grasps.tables, grasps.gripper, fresh, found.T_world_target, feasible)

    def touches(_, scene, q):
        return jnp.any(arm_hits(q, scene), axis=0)

    hits |= masked_vmap(touches, feasible & jnp.any(fresh.valid), None, fresh, found.q, block=16)
    return hits if previous is None or moved is None else jnp.where(moved[None], hits, previous)


@jax.jit
def retrieval_hits(grasps: TargetGrasps, found: FoundGrasps, scene: Superquadrics, action: Action) -> Bool[Array, " n"]:
    """Which objects a retrieval hits on its whole way, shape (N,).

    Args:
      grasps: the grasps, one of which the retrieval makes.
      found: their feasibility for the found target.
      scene: the objects, without the target.
      action: the retrieval.
    """
    T = compose(found.T_world_target[None], grasps.tables.T_target_gripper)
    apart = jnp.sum((T - action.T_world_gripper[None]) ** 2, axis=(1, 2)) + (grasps.tables.q7 - action.q7) ** 2
    chosen = jnp.arange(len(apart)) == jnp.argmin(apart)
    return jnp.any(found_hits(grasps, found.replace(feasible=chosen), scene), axis=0)


def crossing_hits(
    tables: GraspTables,
    gripper: Gripper,
    scene: Superquadrics,
    T_world_target: Float[Array, "4 4"],
    feasible: Bool[Array, " g"],
) -> Bool[Array, "g n"]:
    """Which objects gripper or target hit on the crossing of each grasp of a found target.

    Args:
      tables: the grasps.
      gripper: static.
      scene: the objects, without the target.
      T_world_target: pose of the target.
      feasible: which grasps are tested.
    """
    g, n, p = tables.q7.shape[0], scene.capacity, CROSSING_PLACES
    T = compose(T_world_target[None], tables.T_target_gripper)
    length = crossing_length(T, gripper.nearest_outside, gripper)
    places = crossing_poses(T, gripper.nearest_outside, gripper, p)
    target = transform(inverse(tables.T_target_gripper)[:, None], tables.still_target.T[None])
    still = clouds_of(jnp.concatenate([tables.still_gripper[tables.wrist], jnp.swapaxes(target, 1, 2)], axis=-1))
    # Few grasps have a crossing.
    crosses = feasible & (length > 0.0)
    mask = jnp.repeat(crosses[:, None] & scene.valid[None], p, axis=0)
    hits = collisions(still, jnp.repeat(jnp.arange(g), p), places.reshape(-1, 4, 4), scene, mask)
    return jnp.any(hits.reshape(g, p, n), axis=1)


@cached_jit()
def top_grasps(
    grasps: TargetGrasps,
    scene: Superquadrics,
    pose: Float[Array, "3"],
    active: Bool[Array, ""] | bool = True,
    space: PossibleSpace | None = None,
) -> GraspChoice:
    """`TRIES` different grasps of a target at a pose for trials, leading axis, best first.

    Grasps that hit nothing come first, ranked as in `best_grasp`, then those that hit objects least deep.

    Args:
      grasps, scene, pose, active, space: as in `best_grasp`.
    """
    ranked = _ranked(grasps, scene, pose, active, DEPTHS, space)
    approach, q7 = ranked.T_world_gripper[:, :3, 2], grasps.tables.q7

    def pick(order, _):
        i = jnp.argmin(order)
        cosine = jnp.sum(approach * approach[i][None], axis=-1)
        alike = (cosine > math.cos(ALIKE)) & (jnp.abs(q7 - q7[i]) < ALIKE_WRIST)
        return (order + jnp.where(alike, FAR, 0)).at[i].add(100 * FAR), i

    _, best = jax.lax.scan(pick, ranked.order, length=min(TRIES, len(q7)))
    return jax.vmap(lambda i: _choice(grasps, ranked, i))(best)


@cached_jit()
def best_grasp(
    grasps: TargetGrasps,
    scene: Superquadrics,
    pose: Float[Array, "3"],
    active: Bool[Array, ""] | bool = True,
    space: PossibleSpace | None = None,
) -> GraspChoice:
    """Whether and how a target at a pose can be grasped without hitting anything.

    Args:
      grasps: the grasps to choose from.
      scene: the objects, without the target.
      pose: pose of the target as x, y [m], yaw [rad]; need not be a candidate pose.
      active: whether the target is found; if not, no grasp is feasible and little is computed.
      space: says what was not measured: a grasp that sweeps it ranks as if it hit one more object; None if everything
        was.
    """
    ranked = _ranked(grasps, scene, pose, active, space=space)
    # Independent of the ranking: a caller that uses only these does not compute the clearances.
    fewest = jnp.min(ranked.hits)
    choice = _choice(grasps, ranked, jnp.argmin(ranked.order))
    return choice.replace(success=fewest == 0, feasible=jnp.any(ranked.feasible), hits=fewest.astype(jnp.int32))


@functools.partial(jax.jit, static_argnames=("count",))
def best_grasps(grasps: TargetGrasps, scene: Superquadrics, pose: Float[Array, "3"], count: int) -> GraspChoice:
    """The `count` best grasps of a target at a pose, ranked as in `best_grasp`; leading axis, best first.

    Args:
      grasps, scene, pose: as in `best_grasp`.
      count: number of grasps, at most all.
    """
    ranked = _ranked(grasps, scene, pose, True)
    best = jnp.argsort(ranked.order, stable=True)[:count]
    return jax.vmap(lambda i: _choice(grasps, ranked, i))(best)


class _Ranked(NamedTuple):
    """All grasps: pose of the gripper, feasibility, number of objects hit, and rank, the best lowest."""

    T_world_gripper: Float[Array, "f 4 4"]
    feasible: Bool[Array, " f"]
    hits: Int[Array, " f"]
    order: Int[Array, " f"]


def _ranked(
    grasps: TargetGrasps,
    scene: Superquadrics,
    pose: Float[Array, "3"],
    active: Bool[Array, ""] | bool,
    depths: tuple[float, ...] = (),
    space: PossibleSpace | None = None,
) -> _Ranked:
    """All grasps, ranked by number of hits, then by clearance.

    Args:
      grasps, scene, pose, active, space: as in `best_grasp`.
      depths: amounts by which objects are shrunk [m]; hits of the shrunk objects rank before the number of hits.
    """
    T_world_target = grasps.standing(pose)
    tables = grasps.tables
    found = found_grasps(grasps, T_world_target, active)
    # Trials would take it out from under what falls on the board.
    found = found.replace(feasible=found.feasible & ~jnp.any(_carried(grasps, T_world_target, scene)))

    def near(clearance):
        return jnp.sum(straight_hits(tables, found, enlarged(scene, clearance), active), axis=1)

    def hit(depth):
        return jnp.sum(found_hits(grasps, found, slimmed(scene, depth, 0.25), active), axis=1)

    all_hits, *deeper = jax.lax.map(hit, jnp.float32((0.0, *depths)))
    hits = jnp.where(found.feasible, all_hits, INFEASIBLE)
    crowd = jnp.sum(jax.lax.map(near, jnp.float32(CLEARANCES)), axis=0) + TURNED * tables.turned
    # Infeasible grasps come last, even after those marked as alike.
    order = jnp.where(found.feasible, 1000 * sum(deeper, jnp.zeros_like(hits)) + 100 * hits + crowd, 10 * FAR)
    T_world_gripper = compose(T_world_target[None], tables.T_target_gripper)
    if space is not None:
        order += 100 * _sweep_unmeasured(tables, T_world_gripper, space, found.feasible)
    return _Ranked(T_world_gripper, found.feasible, hits, order)


def _carried(grasps: TargetGrasps, T_world_target: Float[Array, "4 4"], scene: Superquadrics) -> Bool[Array, " n"]:
    """Which objects stand on a target at a pose; see `footprints.supports`.

    An approximation: to what stands on it, a target of several pieces is the box around it, and so are objects.
    """
    target = body_at(grasps.target, T_world_target[:3, 3], T_world_target[:3, :3], jnp.array(True))
    plain = [scene.replace(parts=None), jax.tree.map(lambda a: a[None], target.replace(parts=None))]
    return supports(footprints(jax.tree.map(lambda *a: jnp.concatenate(a), *plain)))[-1, :-1]


def _sweep_unmeasured(
    tables: GraspTables, T_world_gripper: Float[Array, "f 4 4"], space: PossibleSpace, mask: Bool[Array, " f"]
) -> Bool[Array, " f"]:
    """Which grasps sweep, on their straight way, space in which something may stand that has no depth."""

    def enters(_, space, row):
        T, cloud = row
        return jnp.any(enters_unmeasured(space, transform(T, cloud.T)))

    anything = jnp.any(jnp.isfinite(space.unmeasured))
    return masked_vmap(enters, mask & anything, None, space, (T_world_gripper, tables.swept.points), block=64)


def _choice(grasps: TargetGrasps, ranked: _Ranked, i: Int[Array, ""]) -> GraspChoice:
    T, q7 = ranked.T_world_gripper[i], grasps.tables.q7[i]
    return GraspChoice(
        success=ranked.feasible[i] & (ranked.hits[i] == 0),
        feasible=ranked.feasible[i],
        hits=ranked.hits[i].astype(jnp.int32),
        action=retrieve_action(T, q7, jnp.float32(grasps.gripper.max_opening)),
    )
