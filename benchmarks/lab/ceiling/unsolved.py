"""Why a search with full knowledge did not retrieve the target of a scene: in words, and as a picture."""

from __future__ import annotations

from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool
from matplotlib.figure import Figure

from mechsearch_jax.envs.camera.snapshot import Snapshot, objects_on_the_board, true_target_pose
from mechsearch_jax.envs.known_target.in_the_way import blocking, grasps_in_words, least_sets
from mechsearch_jax.envs.known_target.judgement import Judgement
from mechsearch_jax.envs.known_target.search import KnownSearchResult, Node
from mechsearch_jax.envs.recording.pictures import colour_image
from mechsearch_jax.planner import Problem
from mechsearch_jax.viz.blockers import Moment, blockers_figure


def in_the_way(judgement: Judgement) -> list[tuple[int, ...]]:
    """The minimal sets of objects that feasible grasps hit, the smallest first; empty if no grasp is feasible."""
    return least_sets(_allowed(judgement))


def blockers(judgement: Judgement) -> tuple[int, ...]:
    """The objects that the best grasps hit, those that hit the fewest objects."""
    return blocking(_allowed(judgement))


def _allowed(judgement: Judgement) -> Bool[np.ndarray, "grasps n"]:
    """What each grasp hits that arm and shelf allow."""
    return np.asarray(judgement.hits)[np.asarray(judgement.feasible)]


def reason(result: KnownSearchResult) -> str:
    """Why the target was not retrieved, in a few sentences.

    Args:
      result: of a search that did not succeed.
    """
    judgement, tries = result.best.judgement, f"{result.simulated} actions simulated in {result.rounds} rounds"
    if result.retrievals:
        reasons = ", ".join(f"{why} ({_times(count, 'time')})" for why, count in result.retrievals.most_common())
        return (
            "A grasp that hits nothing was reached, but every attempt to take the target out failed: "
            f"{reasons}; {tries}."
        )
    if judgement.least is None and result.start.judgement.least is None:
        return f"Arm and shelf allow no grasp of the target, nor of one that was pushed; {tries}."
    start = f"At the start {_grasps(result.start.judgement)}."
    if result.best is result.start:
        return f"{start} No action brought it nearer to being graspable ({tries}). {_moved(result, result.start)}"
    after = f"At best, after {_times(len(result.best.actions), 'action')}, {_grasps(judgement)}"
    return f"{start} {after} ({tries}). {_moved(result, result.best)}"


def _grasps(judgement: Judgement) -> str:
    """The objects that the feasible grasps hit, in words."""
    return grasps_in_words(_allowed(judgement))


def _times(count: int, noun: str) -> str:
    return f"{count} {noun}" + ("" if count == 1 else "s")


def _moved(result: KnownSearchResult, node: Node) -> str:
    """The actions on the objects in the way, in words."""
    sentences = []
    for index in blockers(node.judgement):
        sampled = {kind: count for (kind, i), count in result.sampled.items() if i == index}
        if not sampled:
            sentences.append(f"Object {index} could be neither picked nor pushed.")
            continue
        done = Counter({kind: result.executed[kind, index] for kind in sampled})
        failed = Counter({kind: 0 for kind in sampled})
        for (kind, i, _), count in result.failed.items():
            if i == index:
                failed[kind] += count
        counts = ", ".join(f"{kind} {done[kind]} times ({failed[kind]} more failed)" for kind in sorted(sampled))
        missing = [kind for kind in ("pick-and-place", "push") if kind not in sampled]
        never = f"; never {missing[0]}" if missing else ""
        sentences.append(f"Object {index}: {counts}{never}.")
    return " ".join(sentences)


def picture(result: KnownSearchResult, problem: Problem, name: str, text: str) -> Figure:
    """The start and the best world that was reached, with the objects marked that the best grasps hit.

    Args:
      result: of a search that did not succeed.
      problem: built for the target.
      name: of the scene.
      text: the reason; see `reason`.
    """
    moments = [_moment("start", result.start, problem)]
    if result.best is not result.start:
        moments.append(_moment(f"after {_times(len(result.best.actions), 'action')}", result.best, problem))
    return blockers_figure(moments, problem.camera, problem.shelf, problem.target, name, text)


def _moment(title: str, node: Node, problem: Problem) -> Moment:
    world = jax.tree.map(jnp.asarray, node.world)
    snapshot = Snapshot(problem.camera, problem.shelf, world)
    least = node.judgement.least
    hit = "no grasp" if least is None else f"the best grasp hits {_times(least, 'object')}"
    return Moment(
        title=f"{title}: {hit}",
        image=colour_image(snapshot.image),
        owner=np.asarray(snapshot.image.segmentation),
        scene=jax.tree.map(np.asarray, objects_on_the_board(snapshot)),
        target_pose=np.asarray(true_target_pose(world)),
        blockers=blockers(node.judgement),
    )
