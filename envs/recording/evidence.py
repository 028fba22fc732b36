"""What lies behind a recorded decision: how sure recognition was, what trials came to, and what was expected.

A recording may lack it: one of an earlier version does.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.actions import Action, ActionKind, kind_of, no_action
from mechsearch_jax.envs.camera.snapshot import objects_on_the_board, true_target_pose
from mechsearch_jax.envs.episode.moments import Moment
from mechsearch_jax.envs.recording.sampled import Sampled, sampled
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.grasping.graspability import INFEASIBLE
from mechsearch_jax.grasping.retrieval import TargetGrasps, found_grasps, found_hits
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner import Belief, Decision, Problem, graspability_map, initial_belief, update_belief
from mechsearch_jax.planner.trials import TrialResult, TriedActions, nothing_tried
from mechsearch_jax.runtime.compiled import cached_jit
from mechsearch_jax.session.preparing import Program, program
from mechsearch_jax.workspace.scenario import MAX_OBJECTS

# Of so many of the best candidates the predicted f and g are kept, and of the best that moves another object.
FORESEEN = 2


@dataclasses.dataclass(frozen=True, eq=False)
class Forecasts:
    """f and g as they are predicted after M of the candidates of a decision; NumPy arrays.

    Attributes:
      row: index of the candidate among those of the decision, shape (M,).
      existence: f, shape (M, X); nowhere once the target is found.
      graspability: g, shape (M, X).
      in_the_way: number of objects that the best grasp of a found target hits, shape (M,); -1 if it is not found.
    """

    row: Int[np.ndarray, " m"]
    existence: Bool[np.ndarray, "m x"]
    graspability: Int[np.ndarray, "m x"]
    in_the_way: Int[np.ndarray, " m"]

    def __len__(self) -> int:
        return len(self.in_the_way)

    def of(self, candidate: int) -> int | None:
        """The index of the forecast of a candidate; None if there is none."""
        rows = np.flatnonzero(self.row == candidate)
        return int(rows[0]) if len(rows) else None


@dataclasses.dataclass(frozen=True, eq=False)
class Evidence:
    """What lies behind one decision; NumPy arrays.

    Attributes:
      confidence: of each recognised object, shape (N,); NaN where nothing says how sure recognition is.
      believed_pose: x, y [m] and yaw [rad] of the target as the robot believes it; NaN if it has not found it.
      hits: which true objects are hit by each grasp of the target at its true pose that arm and shelf allow.
      forecasts: of the best candidates.
      tried: the candidates that were tried out, and what came of them.
    """

    confidence: Float[np.ndarray, " n"]
    believed_pose: Float[np.ndarray, " 3"]
    hits: Bool[np.ndarray, "grasps n"]
    forecasts: Forecasts
    tried: TriedActions


@cached_jit()
def grasps_at(
    grasps: TargetGrasps, objects: Superquadrics, pose: Float[Array, "3"]
) -> tuple[Bool[Array, " f"], Bool[Array, "f n"]]:
    """Which grasps of a target at a pose arm and shelf allow, and which objects each of them hits on its whole way."""
    found = found_grasps(grasps, grasps.standing(pose), jnp.array(True))
    return found.feasible, found_hits(grasps, found, objects, jnp.array(True))


def evidence(moment: Moment, problem: Problem) -> Evidence:
    """What lies behind the decision of a moment."""
    seen, belief = moment.observation, moment.belief
    there = objects_on_the_board(moment.snapshot)
    feasible, hits = jax.device_get(grasps_at(problem.target_grasps, there, true_target_pose(moment.snapshot.world)))
    return Evidence(
        confidence_of(seen),
        believed_pose(belief),
        hits[feasible],
        forecasts(problem, belief, seen, moment.decision),
        moment.tried,
    )


def programs(problem: Problem, seen: Superquadrics, there: Superquadrics) -> list[Program]:
    """The programs of `evidence` that take long to compile, but for those of a first decision.

    Args:
      problem: of the search.
      seen, there: objects with the shapes of those that are recognised, and of those that are there.
    """
    return [
        program("hits", grasps_at, problem.target_grasps, there, jnp.zeros(3)),
        program("g", graspability_map, problem, initial_belief(problem), seen),
    ]


def evidence_without_truth(
    problem: Problem, belief: Belief, observation: Observation, decision: Decision | None, tried: TriedActions
) -> Evidence:
    """What lies behind a decision where nobody knows the truth: grasps are those of the target where it is believed.

    Args:
      problem, belief, observation: of the decision.
      decision: of a policy; None where nothing was decided.
      tried: what trials came to.
    """
    hits = np.zeros((0, observation.objects.capacity), bool)
    if bool(belief.found):
        feasible, every = jax.device_get(grasps_at(problem.target_grasps, observation.objects, belief.found_pose))
        hits = every[feasible]
    foreseen = forecasts(problem, belief, observation, decision)
    return Evidence(confidence_of(observation), believed_pose(belief), hits, foreseen, tried)


def confidence_of(observation: Observation) -> Float[np.ndarray, " n"]:
    """How sure each recognised object is; NaN where nothing says so."""
    if observation.confidence is None:
        return np.full(observation.objects.capacity, np.nan, np.float32)
    return np.asarray(observation.confidence, np.float32)


def believed_pose(belief: Belief) -> Float[np.ndarray, " 3"]:
    """x, y [m] and yaw [rad] of the target as the robot believes it; NaN if it has not found it."""
    return np.asarray(belief.found_pose, np.float32) if bool(belief.found) else np.full(3, np.nan, np.float32)


def forecasts(problem: Problem, belief: Belief, observation: Observation, decision: Decision | None) -> Forecasts:
    """f and g as predicted after the best candidates of a decision; see `foreseen_rows`."""
    candidates = None if decision is None else sampled(decision.sequences)
    if candidates is None or not len(candidates) or not len(candidates.position):
        return nothing_foreseen(len(problem.poses))
    objects = jax.tree.map(np.asarray, observation.objects)
    rows = foreseen_rows(candidates)
    foreseen = [_forecast(problem, belief, observation, candidates.after(k, objects)) for k in rows]
    exists, g, least = zip(*foreseen, strict=True)
    return Forecasts(np.array(rows), np.stack(exists), np.stack(g), np.array(least, np.int32))


def foreseen_rows(candidates: Sampled) -> list[int]:
    """The candidates whose f and g are predicted: the best ones, and the best that moves another object."""
    best = list(range(min(FORESEEN, len(candidates))))
    return best + [k for k in (of_another_object(candidates),) if k is not None and k not in best]


def of_another_object(candidates: Sampled) -> int | None:
    """The best candidate that moves another object than the best one; None if there is none."""
    others = np.flatnonzero(candidates.action.object != candidates.action.object[:1])
    return int(others[0]) if len(others) else None


def _forecast(
    problem: Problem, belief: Belief, seen: Observation, after: Superquadrics
) -> tuple[np.ndarray, np.ndarray, int]:
    """f, g, and the least number of objects in the way of a found target, once the objects are as predicted."""
    after = jax.tree.map(jnp.asarray, after)
    g = np.asarray(graspability_map(problem, belief, after), np.int32)
    if bool(belief.found):
        feasible, hits = jax.device_get(grasps_at(problem.target_grasps, after, belief.found_pose))
        least = hits[feasible].sum(axis=1).min() if feasible.any() else INFEASIBLE
        return np.zeros(len(g), bool), g, int(least)
    # As after an action that moved nothing unseen: the same program as at the first look.
    hidden = seen.replace(objects=after, target_visible=jnp.array(False))
    then = update_belief(problem, belief, hidden, jax.tree.map(jnp.asarray, seen), no_action())
    # Where the prediction leaves no pose, f would be started anew.
    empty = int(then.restarts) > int(belief.restarts)
    return np.zeros(len(g), bool) if empty else np.asarray(then.exists), g, -1


def nothing_foreseen(poses: int) -> Forecasts:
    """No candidates."""
    return Forecasts(
        np.zeros(0, int), np.zeros((0, poses), bool), np.zeros((0, poses), np.int32), np.zeros(0, np.int32)
    )


def no_evidence(poses: int) -> Evidence:
    """Nothing is known."""
    return Evidence(
        confidence=np.full(MAX_OBJECTS, np.nan, np.float32),
        believed_pose=np.full(3, np.nan, np.float32),
        hits=np.zeros((0, MAX_OBJECTS), bool),
        forecasts=nothing_foreseen(poses),
        tried=nothing_tried(),
    )


def packed(steps: Sequence[Evidence | None], poses: int) -> dict[str, np.ndarray]:
    """The evidence of steps as arrays; none if no step has any."""
    if all(step is None for step in steps):
        return {}
    whole = [step or no_evidence(poses) for step in steps]
    arrays = {"evidence.known": np.array([step is not None for step in steps])}
    for name in ("confidence", "believed_pose"):
        arrays[f"evidence.{name}"] = np.stack([getattr(step, name) for step in whole])
    for name, parts in _ragged(whole).items():
        arrays[f"evidence.{name}.rows"] = np.array([len(part) for part in parts])
        arrays[f"evidence.{name}"] = np.concatenate(parts)
    return arrays


def _ragged(steps: Sequence[Evidence]) -> dict[str, list[np.ndarray]]:
    """The arrays with another number of rows at each step, by their names."""
    tried = {f"tried.{f.name}": [getattr(s.tried.action, f.name) for s in steps] for f in dataclasses.fields(Action)}
    foreseen = {
        f"foreseen.{f.name}": [getattr(s.forecasts, f.name) for s in steps] for f in dataclasses.fields(Forecasts)
    }
    return {"hits": [s.hits for s in steps], "result": [s.tried.result for s in steps], **tried, **foreseen}


def unpacked(arrays: Mapping[str, np.ndarray], steps: int, poses: int) -> list[Evidence | None]:
    """The inverse of `packed`; None for each step of a recording without evidence.

    Raises:
      ValueError: shapes, types or values are wrong.
      KeyError: an array is missing.
    """
    if "evidence.known" not in arrays:
        return [None] * steps
    empty = no_evidence(poses)
    if "evidence.foreseen.row" not in arrays:
        arrays = {**arrays, **_first_rows(arrays, steps)}
    recorded = _checked(arrays, "known", (steps,), np.dtype(bool))
    confidence = _checked(arrays, "confidence", (steps, *empty.confidence.shape), np.dtype(float), finite=False)
    believed = _checked(arrays, "believed_pose", (steps, 3), np.dtype(float), finite=False)
    parts = {name: _rows(arrays, name, like[0], steps) for name, like in _ragged([empty]).items()}
    result: list[Evidence | None] = []
    for i in range(steps):
        fields: dict[str, Any] = {f.name: parts[f"tried.{f.name}"][i] for f in dataclasses.fields(Action)}
        tried = TriedActions(Action(**fields), parts["result"][i])
        foreseen = Forecasts(*(parts[f"foreseen.{f.name}"][i] for f in dataclasses.fields(Forecasts)))
        _check_step(tried, foreseen)
        step = Evidence(confidence[i], believed[i], parts["hits"][i], foreseen, tried)
        result.append(step if recorded[i] else None)
    return result


def _first_rows(arrays: Mapping[str, np.ndarray], steps: int) -> dict[str, np.ndarray]:
    """The candidates that an earlier version predicted f and g of: always the best ones."""
    counts = _checked(arrays, "foreseen.in_the_way.rows", (steps,), np.dtype(int))
    rows = [np.arange(count) for count in counts.clip(0, FORESEEN).tolist()]
    return {"evidence.foreseen.row": np.concatenate(rows), "evidence.foreseen.row.rows": counts}


def _check_step(tried: TriedActions, foreseen: Forecasts) -> None:
    counts = {len(getattr(tried.action, field.name)) for field in dataclasses.fields(Action)} | {len(tried.result)}
    if len(counts) > 1 or len({len(getattr(foreseen, field.name)) for field in dataclasses.fields(Forecasts)}) > 1:
        raise ValueError("trials or forecasts are missing")
    for kind, result in zip(tried.action.kind.tolist(), tried.result.tolist(), strict=True):
        if kind_of(kind).code == ActionKind.NONE or result not in iter(TrialResult):
            raise ValueError("a trial is of no action, or came to nothing known")


def _rows(arrays: Mapping[str, np.ndarray], name: str, like: np.ndarray, steps: int) -> list[np.ndarray]:
    """The rows of each step."""
    counts = _checked(arrays, f"{name}.rows", (steps,), np.dtype(int))
    if counts.min() < 0:
        raise ValueError("a number of rows is negative")
    # Compared before anything of that size is made: a damaged file may claim any number of rows.
    whole = _checked(arrays, name, (int(counts.sum()), *like.shape[1:]), like.dtype)
    return np.split(whole, np.cumsum(counts)[:-1])


def _checked(
    arrays: Mapping[str, np.ndarray], name: str, shape: tuple[int, ...], dtype: np.dtype, finite: bool = True
) -> np.ndarray:
    array = arrays[f"evidence.{name}"]
    if array.shape != shape or array.dtype.kind != dtype.kind:
        raise ValueError(f"evidence.{name} is of another shape or type")
    if finite and not np.isfinite(array).all():
        raise ValueError("there are numbers that are not finite")
    return array
