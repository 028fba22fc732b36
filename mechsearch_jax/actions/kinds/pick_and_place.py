"""Pick-and-places: an object is taken out of the shelf and put down elsewhere on the board (paper appendix B.5)."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from mechsearch_jax.actions.approach import (
    PLACES,
    SWEPT_PLACES,
    approach_enters,
    cloud_index,
    object_clouds,
    swept_places,
)
from mechsearch_jax.actions.config import OPEN, ActionSpace
from mechsearch_jax.actions.kind import SampledKind, Sketch
from mechsearch_jax.actions.kinds.object_grasps import grasp_variants, object_grasps
from mechsearch_jax.actions.kinds.placement import ObjectGrasp, placement
from mechsearch_jax.actions.stacks import lift
from mechsearch_jax.actions.types import Action, Candidates, DrawnCandidate, Prediction, Sample
from mechsearch_jax.actions.unseen_space import PossibleSpace
from mechsearch_jax.dynamics.rigid import held_pose, pick_and_place
from mechsearch_jax.geometry.bodies import slimmed
from mechsearch_jax.geometry.collision import clouds_of, collisions
from mechsearch_jax.geometry.masked import masked_vmap
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.robot.motion import MotionConfig, Reference, pick_and_place_reference

CODE = 2
# Drafts that are computed together on a CPU.
DRAFTS = 32


def _object_hits(T, owner, held, scene, clouds, distance, mask):
    """Which of N objects a grasped object hits as it moves along the gripper's -z, for C grasps; shape (C, N).

    Args:
      T: gripper poses, shape (C, 4, 4).
      owner: index of the grasped object, shape (C,).
      held: its pose in the hand, shape (C, 4, 4).
      scene, clouds: the objects and their surface points.
      distance: length of the motion [m].
      mask: which pairs to test, shape (C, N); must be False for the grasped object itself.
    """
    c, n = mask.shape
    places = swept_places(held, -T[:, :3, 2], distance)
    tested = jnp.repeat(mask, SWEPT_PLACES, axis=0)
    hits = collisions(
        clouds_of(clouds), jnp.repeat(owner, SWEPT_PLACES), places.reshape(-1, 4, 4), scene, tested, own=True
    )
    return jnp.any(hits.reshape(c, SWEPT_PLACES, n), axis=1)


@dataclasses.dataclass(frozen=True)
class PickAndPlace(SampledKind):
    """A side grasp, and a random free place."""

    code: int = CODE
    name: str = "pick-and-place"
    moves_object: bool = True
    holds_object: bool = True
    returns_home: bool = True
    opening: int = OPEN
    surrounds_object: bool = True
    # A target that can be picked can be retrieved.
    moves_target: bool = False

    def wrists(self, space: ActionSpace) -> Int[np.ndarray, " v"]:
        return grasp_variants(space.config.grasps, space.wrists)[1]

    def distances(self, space: ActionSpace) -> int:
        return 1

    def propose(self, space, scene, prints, fresh):
        """See `object_grasps`."""
        T, plausible = object_grasps(
            space.shelf,
            space.gripper,
            prints,
            space.config.grasps,
            space.max_yaw,
            space.wrists,
            lift(space, prints.low),
        )
        return T, plausible.astype(jnp.float32)

    def travels(self, space, T, near) -> Bool[Array, "k d"]:
        """The way out is the way in."""
        return near[:, None]

    def swept_hits(self, space: ActionSpace, scene: Superquadrics, T, mask) -> Bool[Array, "k n"]:
        """Which objects the grasped object hits on its way out, deeper than `ActionTables.contact`."""
        n, config = scene.capacity, space.config
        owner = jnp.asarray(np.repeat(np.arange(n), len(self.wrists(space))))
        held = jax.vmap(functools.partial(held_pose, scene))(owner, T)
        clouds = object_clouds(slimmed(scene, space.tables.contact, 0.5), config.object_points)
        return _object_hits(T, owner, held, scene, clouds, space.gripper.approach, mask)

    def entering(
        self, space: ActionSpace, scene: Superquadrics, possible: PossibleSpace, candidates: Candidates
    ) -> Bool[Array, "n v d"]:
        """Whether the gripper enters possible space as it grasps; `placement` tests where the object is put."""
        n, v, d = candidates.reached.shape
        usable = candidates.reached & ~jnp.any(candidates.hits, axis=-1)[..., None] & (not space.config.as_in_paper)
        cloud = cloud_index(space.tables, OPEN, np.tile(self.wrists(space), n))
        T = candidates.T_world_gripper.reshape(-1, 4, 4)
        return approach_enters(space.tables, possible, cloud, T, usable.reshape(-1)).reshape(n, v, d)

    def draft(
        self, key, space: ActionSpace, scene, possible, candidates, drawn: DrawnCandidate
    ) -> tuple[Array, Sample]:
        """The grasp, a place where the object can be put, and the poses of gripper and object at both ends."""
        index, number = drawn.object, jnp.clip(drawn.number, 0, candidates.reached.shape[1] - 1)
        T, wrist = candidates.T_world_gripper[index, number], jnp.asarray(self.wrists(space))[number]
        grasp, data, rng = (
            ObjectGrasp(index, T, wrist, drawn.wanted),
            jax.random.key_data(key),
            jax.random.key_impl(key),
        )

        def place(space, element, _):
            data, scene, possible, grasp = element
            return placement(jax.random.wrap_key_data(data, impl=rng), space, scene, possible, grasp)

        # Of a batch of drafts only those that are wanted are computed.
        element = data, scene, possible, grasp
        placed, T_place, T_object = masked_vmap(place, drawn.wanted[None], space, element, None, block=DRAFTS)
        placed, T_place, T_object = placed[0], T_place[0], T_object[0]
        action = Action(
            kind=jnp.int32(CODE),
            object=index.astype(jnp.int32),
            T_world_gripper=T,
            displacement=jnp.zeros(3),
            T_world_place=T_place,
            q7=space.tables.q7[OPEN, wrist],
            opening=jnp.float32(space.gripper.max_opening),
        )
        grippers = jnp.stack([T, *[T_place] * (PLACES - 1)])
        return placed, Sample(action, wrist, grippers, jnp.broadcast_to(T_object, (PLACES, 4, 4)))

    def predict(self, space, push_model, scene, untouchable, action: Action, wrist) -> Prediction:
        """The object, turned in the hand, moves with the gripper; `draft` has tested that it can."""
        after = pick_and_place(scene, action.object, action.T_world_gripper, action.T_world_place)
        moved = scene.valid & (jnp.arange(scene.capacity) == action.object)
        return Prediction(after, moved, action.kind == CODE)

    def reference(self, action: Action, config: MotionConfig) -> tuple[Reference, Bool[Array, ""]]:
        """See `motion.pick_and_place_reference`."""
        return pick_and_place_reference(action.T_world_gripper, action.T_world_place, action.q7, action.opening, config)

    def sketch(self, scene: Superquadrics, after: Superquadrics, action: Action) -> Sketch:
        """The hand at both ends, and an arch from the object's top at the grasp to its top at the place."""
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
