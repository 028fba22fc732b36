"""Why an object could not be moved at a step: its pushes and grasps, computed again from the recorded scene.

A recording holds the candidates that were compared, and not those that were ruled out before.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from mechsearch_jax.actions import (
    SAMPLED_KINDS,
    ActionSpace,
    PossibleSpace,
    action_tables,
    all_candidates,
    widen,
)
from mechsearch_jax.actions.types import Candidates
from mechsearch_jax.actions.unseen_space import BORDER, bordered
from mechsearch_jax.config.config import OPTIONS
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.envs.recording.recording import RecordedStep, Recording
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import upright_pose
from mechsearch_jax.runtime.compiled import kept
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.target_view import main_body

# What the motions of each kind are called; of another kind nothing is said.
_NOUNS = {"push": ("push", "pushes"), "pick-and-place": ("grasp", "grasps")}
# Objects that are named as in the way, at most.
_MOST_NAMED = 3


class Ways(NamedTuple):
    """The motions of one kind for one object.

    Attributes:
      kind: its name.
      able: whether it is among the actions of the search.
      plausible: number of motions that suit the object: it fits the hand, or is pushed low enough not to tip.
      reached: number of those that the arm can follow, and that meet no wall.
      free: number of those at which hand and object meet nothing.
      entering: number of those that pass where the target may be.
      blockers: objects of which each motion that is reached meets one; one more than the last stands for the target.
        Empty if some are free.
    """

    kind: str
    able: bool
    plausible: int
    reached: int
    free: int
    entering: int
    blockers: tuple[int, ...]


def ways(recording: Recording, i: int, k: int) -> tuple[Ways, ...] | None:
    """The motions that were possible for an object at a step, one item for each kind of action; None if not known.

    Args:
      recording: of the episode.
      i: index of the step.
      k: the object.
    """
    space = _space(recording)
    if space is None or not recording.steps[i].scene.valid[k]:
        return None
    every = _candidates_at(recording, i)
    return tuple(
        _ways(kind.name, kind.name in space.config.actions, each, k)
        for kind, each in zip(SAMPLED_KINDS, every, strict=True)
    )


def none_in_words(ways: Sequence[Ways], capacity: int) -> str:
    """Why none of an object's motions was possible, in words; empty if some could be begun.

    Args:
      ways: of the object.
      capacity: number of objects a scene has room for: the number of the target.
    """
    known = [each for each in ways if each.kind in _NOUNS]
    if begun(known):
        return ""
    words = [_none(each) for each in known if not each.blockers]
    for blockers in dict.fromkeys(each.blockers for each in known if each.blockers):
        nouns = " and ".join(_NOUNS[each.kind][0] for each in known if each.blockers == blockers)
        words.append(f"{_blocking(blockers, capacity)} in the way of each {nouns} that the arm can follow")
    return ", and ".join(words)


def begun(ways: Sequence[Ways]) -> int:
    """How many motions could be begun."""
    return sum(each.free for each in ways)


def only_entering(ways: Sequence[Ways]) -> bool:
    """Whether some motions could be begun, and each of these passes where the target may be."""
    return bool(begun(ways)) and begun(ways) == sum(each.entering for each in ways)


def _none(ways: Ways) -> str:
    one, many = _NOUNS[ways.kind]
    if not ways.able:
        return f"{many} are not among the actions"
    if not ways.plausible:
        return "each push would tip it" if one == "push" else "no grasp of it fits the hand"
    return f"the arm can follow no {one} of it"


def _blocking(blockers: Sequence[int], capacity: int) -> str:
    words = [f"object {k}" for k in blockers if k < capacity][:_MOST_NAMED]
    words += ["the target"] if capacity in blockers else []
    words += ["another"] if len(blockers) > len(words) else []
    return f"{' or '.join(words)} is"


def _ways(kind: str, able: bool, candidates: Candidates, k: int) -> Ways:
    """The motions of one kind for the k-th object."""
    plausible = np.asarray(candidates.weight[k] > 0)
    reached = np.asarray(candidates.reached[k]) & plausible[:, None]
    hits, enters = np.asarray(candidates.hits[k]), np.asarray(candidates.enters[k])
    free = reached & ~hits.any(axis=1, keepdims=True)
    blockers = () if free.any() else _cover(np.repeat(hits, reached.shape[1], axis=0)[reached.reshape(-1)])
    counts = (int(plausible.sum()) * reached.shape[1], int(reached.sum()), int(free.sum()), int((free & enters).sum()))
    return Ways(kind, able, *counts, blockers)


def _cover(hits: Bool[np.ndarray, "motions n"]) -> tuple[int, ...]:
    """A few objects of which each motion hits one."""
    left: np.ndarray = np.asarray(hits)
    chosen: list[int] = []
    while len(left):
        chosen.append(int(left.sum(axis=0).argmax()))
        left = left[~left[:, chosen[-1]]]
    return tuple(sorted(chosen))


@functools.lru_cache(maxsize=8)
def _space(recording: Recording) -> ActionSpace | None:
    """The actions of a search; None if the record does not hold them all, or where bodies have several parts."""
    if recording.target.is_compound or any(step.scene.parts is not None for step in recording.steps):
        return None
    options = {} if recording.episode is None else recording.episode.config
    actions = {option.name for option in OPTIONS if option.path[:2] == ("problem", "actions")}
    if not actions <= set(options):
        return None
    try:
        method = Method.of_options(options)
    except InputError:
        return None
    config, gripper = method.config.problem, method.workcell.gripper
    tables = action_tables(gripper, config.grasps.wrists, config.actions)
    grasps = config.grasps
    return ActionSpace(recording.shelf, tables, gripper, config.actions, grasps.max_yaw, grasps.waypoints)


@functools.lru_cache(maxsize=32)
def _candidates_at(recording: Recording, i: int) -> tuple[Candidates, ...]:
    step, space = recording.steps[i], _space(recording)
    assert space is not None
    return jax.device_get(_all(space, _obstacles(recording, step), _possible(recording, step)))


@kept(on_host=True)
def _all(space: ActionSpace, scene: Superquadrics, possible: PossibleSpace) -> tuple[Candidates, ...]:
    return all_candidates(space, scene, possible)


def _obstacles(recording: Recording, step: RecordedStep) -> Superquadrics:
    """The recognised objects and, in one more slot, the target where it is believed, absent until it is found."""
    believed = np.full(3, np.nan) if step.evidence is None else step.evidence.believed_pose
    found = bool(np.isfinite(believed).all())
    T = upright_pose(jnp.asarray(np.where(found, believed, 0.0)), recording.target.height(recording.shelf))
    target = main_body(recording.target, T[:3, 3], T[:3, :3], jnp.array(found))
    return jax.tree.map(lambda a, b: jnp.concatenate([jnp.asarray(a), b[None]]), step.scene, target)


def _possible(recording: Recording, step: RecordedStep) -> PossibleSpace:
    """Where a target that is not found may be: as `belief.possible_space`, without a problem."""
    target, shelf = recording.target, recording.shelf
    grid = step.existence.reshape(*target.grid, -1).sum(axis=-1) * (not step.found)
    cell = np.asarray(target.cell(shelf)[:2], np.float32)
    space = bordered(widen(jnp.asarray(grid > 0)))
    return PossibleSpace(
        target=jnp.where(space, jnp.float32(shelf.board + target.tall), -jnp.inf),
        unmeasured=jnp.full(space.shape, -jnp.inf),
        chance=jnp.asarray(grid / max(grid.sum(), 1), jnp.float32),
        origin=jnp.asarray(target.candidate_poses(shelf)[0, :2] - BORDER * cell, jnp.float32),
        cell=jnp.asarray(cell),
    )
