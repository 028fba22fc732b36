"""The state of a search, in memory and in a file."""

from __future__ import annotations

import dataclasses
import io
import json
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mechsearch_jax.actions.kinds.nothing import no_action
from mechsearch_jax.actions.types import Action
from mechsearch_jax.belief.belief import Belief, initial_belief
from mechsearch_jax.geometry.superquadric import empty
from mechsearch_jax.images.labels import CAPACITY
from mechsearch_jax.observation import Observation
from mechsearch_jax.problem.problem import Problem
from mechsearch_jax.runtime.arrays import ARRAYS_LIMIT, read_arrays
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike, read_bytes, replacing

FORMAT = "mechsearch-search"
VERSION = 2


@dataclasses.dataclass(frozen=True, eq=False)
class State:
    """The state of a search.

    Attributes:
      index: number of actions taken.
      belief: after the last images.
      observation, action: recognised in the last images, and decided on.
      handed: whether the action's motion was returned and is not over yet.
      acted: whether the action was executed or attempted since the last images.
      finished: whether the target was taken out.
      refusals: number of steps without a motion since the last action.
      executed: whether that action was executed to its end.
      failures: places of the gripper in actions that failed since the last grasp that did not, [m].
      way: name of the motion that was returned, where it only clears the hand after `action`; else empty.
      stopped: joint angles at which the last motion was broken off [rad]; empty if it was not, or that is not known.
    """

    index: int
    belief: Belief
    observation: Observation
    action: Action
    handed: bool
    acted: bool
    finished: bool
    refusals: int = 0
    executed: bool = True
    failures: tuple[tuple[float, ...], ...] = ()
    stopped: tuple[float, ...] = ()
    way: str = ""


_PLAIN: dict[str, Callable[[Any], Any]] = {
    "index": int,
    "handed": bool,
    "acted": bool,
    "finished": bool,
    "refusals": int,
    "executed": bool,
    "failures": lambda places: tuple(tuple(map(float, place)) for place in places),
    "stopped": lambda joints: tuple(map(float, joints)),
    "way": str,
}
# What states hold that were saved before these fields existed.
_ADDED: dict[str, Any] = {"executed": True, "failures": (), "stopped": (), "way": ""}
_PYTREES = ("belief", "observation", "action")


def save_state(state: State, digest: str, path: PathLike) -> None:
    """Write a state as an archive of arrays, .npz, with a digest of the searcher that it belongs to.

    Raises:
      InputError: the file cannot be written.
    """
    head = {"format": FORMAT, "version": VERSION, "digest": digest, **{name: getattr(state, name) for name in _PLAIN}}
    buffer = io.BytesIO()
    arrays = {name: np.asarray(value) for name, value in _arrays(state).items()}
    np.savez_compressed(buffer, allow_pickle=False, head=np.array(json.dumps(head)), **arrays)
    with replacing(path) as file:
        file.write(buffer.getvalue())


def load_state(problem: Problem, digest: str, path: PathLike, capacity: int = CAPACITY) -> State:
    """Read a file of `save_state`.

    Raises:
      InputError: the file cannot be read, is not a state, or has another digest.
    """
    arrays = read_arrays(read_bytes(path, ARRAYS_LIMIT), path)
    try:
        head = json.loads(str(arrays.pop("head")))
        if (head["format"], head["version"]) != (FORMAT, VERSION):
            raise ValueError
        head = _ADDED | head
        kept, rest = head["digest"], {name: read(head[name]) for name, read in _PLAIN.items()}
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: is no search that was saved; begin a new one") from error
    if kept != digest:
        raise InputError(
            f"{path}: is of another workcell, configuration or seed; make the Searcher as it was made then"
        )
    like = beginning(problem, capacity)
    if "['observation'].confidence" not in arrays:
        # Saved before objects said how sure they are.
        like = dataclasses.replace(like, observation=like.observation.replace(confidence=None))
    if (size := arrays.get("['observation'].objects.parts.size")) is not None and size.ndim == 3:
        objects = empty(capacity, size.shape[1])
        like = dataclasses.replace(like, observation=like.observation.replace(objects=objects))
    state = _restored(like, arrays, rest, path)
    return dataclasses.replace(state, observation=state.observation.judged())


def beginning(problem: Problem, capacity: int = CAPACITY) -> State:
    """The state before the first images, with so many slots for objects."""
    nothing = Observation(empty(capacity), jnp.array(False), jnp.zeros(3)).judged()
    return State(0, initial_belief(problem), nothing, no_action(), handed=False, acted=False, finished=False)


def _arrays(state: State) -> dict[str, Any]:
    """The arrays of a state, by their paths in the pytree."""
    trees = {name: getattr(state, name) for name in _PYTREES}
    return {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(trees)}


def _restored(like: State, arrays: dict[str, np.ndarray], rest: dict[str, Any], path: PathLike) -> State:
    """A state from arrays that must have the shapes and types of those of `like`.

    Raises:
      InputError: an array is missing, or of another shape or type.
    """
    expected = _arrays(like)
    for name, value in expected.items():
        array = arrays.get(name)
        if array is None or array.shape != value.shape or array.dtype != value.dtype:
            raise InputError(f"{path}: {name} is missing or of another shape; begin a new search")
    trees = {name: getattr(like, name) for name in _PYTREES}
    leaves = [jnp.asarray(arrays[name]) for name in expected]
    return State(**jax.tree.unflatten(jax.tree.structure(trees), leaves), **rest)
