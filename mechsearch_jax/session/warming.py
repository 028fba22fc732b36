"""Stand-in images and scenes with which a search is compiled before the first real image."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mechsearch_jax.actions.registry import KINDS
from mechsearch_jax.actions.trajectory import reference_motion
from mechsearch_jax.actions.types import Action
from mechsearch_jax.belief.belief import Belief
from mechsearch_jax.images.detection import BESIDE, TARGET_POINTS, other_yaw
from mechsearch_jax.images.target_pose import SampledPixels
from mechsearch_jax.observation import Observation
from mechsearch_jax.perception.doubt import DoubtConfig
from mechsearch_jax.perception.recogniser import Recogniser
from mechsearch_jax.planner.trials import PLANNED, Trials, scenes_of
from mechsearch_jax.problem.problem import Problem
from mechsearch_jax.robot.motion import MotionConfig, motion_with
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.session.images import Images
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf

# Half-extents of the stand-in object [m], and the depth beyond the board [m].
BOX = (0.03, 0.03, 0.06)
FAR = 3.0
# Bounds that no recognition exceeds.
TRUSTING = DoubtConfig(missing=1.0, unexplained=1.0, passed=1.0)


def images(camera: Camera, shelf: Shelf, colour: bool, mask: bool, target_id: bool) -> Images:
    """Images of an empty shelf.

    Args:
      camera, shelf: of the search.
      colour, mask, target_id: whether to make them.

    Raises:
      InputError: target_id without a mask.
    """
    if target_id and not mask:
        raise InputError("warm_up: target_id names a number of a mask; say mask=True, too")
    size = (camera.height, camera.width)
    return Images(
        depth=board_depth(camera, shelf),
        colour=np.full((*size, 3), 128, np.uint8) if colour else None,
        mask=np.full(size, -1, np.int32) if mask else None,
        target_id=0 if target_id else None,
    )


def board_depth(camera: Camera, shelf: Shelf) -> Float[np.ndarray, "h w"]:
    """The depth image of an infinite board [m], float32; at most `FAR`."""
    rows, columns = np.meshgrid(np.arange(camera.height), np.arange(camera.width), indexing="ij")
    x, y = (columns + 0.5 - camera.cx) / camera.fx, (rows + 0.5 - camera.cy) / camera.fy
    up = np.array(camera.rotation)[2]
    falls = -(up[0] * x + up[1] * y + up[2])
    depth = (camera.position[2] - shelf.board) / np.where(falls > 1e-6, falls, np.inf)
    return np.where((depth > 0.0) & (depth < FAR), depth, FAR).astype(np.float32)


def hidden(problem: Problem, seen: Observation) -> Observation:
    """One object on the shelf, and no target."""
    x, y, _ = np.asarray(problem.poses)[len(problem.poses) // 2].tolist()
    slots = seen.objects.capacity
    is_first = np.arange(slots) == 0
    position = np.where(is_first[:, None], [x, y, problem.shelf.board + BOX[2]], 0.0)
    objects = seen.objects.replace(
        size=jnp.asarray(np.broadcast_to(BOX, (slots, 3)), jnp.float32),
        exponents=jnp.full((slots, 2), 0.2, jnp.float32),
        position=jnp.asarray(position, jnp.float32),
        rotation=jnp.asarray(np.broadcast_to(np.eye(3), (slots, 3, 3)), jnp.float32),
        valid=jnp.asarray(is_first),
    )
    return seen.replace(objects=objects, target_visible=jnp.array(False))


def in_the_open(problem: Problem, seen: Observation) -> Observation:
    """The target alone, where most of its grasps are feasible."""
    grasps = problem.grasps
    pose = np.asarray(grasps.pair_pose)[np.asarray(grasps.pair_valid)]
    counts = np.bincount(pose, minlength=len(problem.poses))
    pose = np.asarray(problem.poses)[int(np.argmax(counts))]
    objects = seen.objects.replace(valid=jnp.zeros(seen.objects.capacity, bool))
    return seen.replace(
        objects=objects, target_visible=jnp.array(True), target_pose=jnp.asarray(pose, seen.target_pose.dtype)
    )


class _FixedRecogniser(Recogniser):
    """A copy of a recogniser that returns the same observation for all images."""

    def __init__(self, like: Recogniser, observation: Observation):
        for field in dataclasses.fields(like):
            object.__setattr__(self, field.name, getattr(like, field.name))
        object.__setattr__(self, "_observation", observation)

    def unchecked(self, *images: Any, **before: Any) -> Observation:
        return self.__dict__["_observation"]


def fixed_recogniser(recogniser: Any, observation: Observation) -> Callable[..., Observation]:
    """A recogniser that returns `observation` for all images, and else is like `recogniser`."""
    if isinstance(recogniser, Recogniser):
        return _FixedRecogniser(recogniser, observation)
    return lambda *images: observation


def yaw(problem: Problem) -> None:
    """Compile what says whether another yaw of the target is possible."""
    zeros = jnp.zeros((BESIDE, 3))
    sample = SampledPixels(zeros, zeros, zeros[:, 0], jnp.zeros(BESIDE, bool), zeros[:, 0])
    other_yaw(problem.target, problem.shelf, jnp.zeros(3), jnp.zeros((TARGET_POINTS, 3)), sample, jnp.zeros(3))


def motions(problem: Problem, action: Action, config: MotionConfig | None) -> None:
    """Compile the reference motions of all kinds of action."""
    for kind in KINDS.values():
        reference_motion(kind, action, motion_with(problem.gripper, config))


def trials(tries: Trials, problem: Problem, belief: Belief, observation: Observation, action: Action) -> None:
    """Compile the trials by trying one action of each planned kind, also those that the arm cannot execute."""
    count = len(PLANNED)
    actions: Action = jax.tree.map(lambda a: np.broadcast_to(a, (1, count, *a.shape)), jax.device_get(action))
    kinds = np.array([[int(kind) for kind in PLANNED]], np.int32)
    actions = actions.replace(kind=kinds, object=np.zeros((1, count), np.int32))
    scene = jax.tree.map(lambda a: np.asarray(a)[None], jax.device_get(scenes_of(belief, observation)))
    tries(problem, scene, actions, np.ones((1, count), bool))
