"""Why a search with everything known did not take the target of a scene out: in words, and as a picture."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from mechsearch_jax.envs.camera.snapshot import Snapshot, objects_on_the_board, true_target_pose
from mechsearch_jax.envs.known_target.judgement import Judgement
from mechsearch_jax.envs.known_target.search import Found, Node
from mechsearch_jax.envs.recording.pictures import colour_image
from mechsearch_jax.planner import Problem
from mechsearch_jax.viz.blockers import Moment, blockers_figure

# At most so many ways of being in the way are told.
TOLD = 3


def in_the_way(judgement: Judgement) -> list[tuple[int, ...]]:
    """What feasible grasps hit, as sets of objects, the smallest first; none that holds another one, and none at all
    where no grasp is feasible."""
    hits = {frozenset(np.flatnonzero(row).tolist()) for row in judgement.hits[judgement.feasible]}
    least = [one for one in hits if not any(other < one for other in hits)]
    return sorted((tuple(sorted(one)) for one in least), key=lambda one: (len(one), one))


def blockers(judgement: Judgement) -> tuple[int, ...]:
    """The objects that some of the best grasps hit: those that hit fewest."""
    sets = in_the_way(judgement)
    return tuple(sorted({index for one in sets if len(one) == len(sets[0]) for index in one}))


def reason(found: Found) -> str:
    """Why the target was not taken out, in a few sentences.

    Args:
      found: of a search that did not succeed.
    """
    judgement, tries = found.best.judgement, f"{found.simulated} actions simulated in {found.rounds} rounds"
    if found.retrievals:
        told = ", ".join(f"{why} ({_times(count, 'time')})" for why, count in found.retrievals.most_common())
        return (
            f"A grasp that hits nothing was reached, but every attempt to take the target out failed: {told}; {tries}."
        )
    if judgement.least is None and found.start.judgement.least is None:
        return f"Arm and shelf allow no grasp of the target, nor of one that was pushed; {tries}."
    start = f"At the start {_grasps(found.start.judgement)}."
    if found.best is found.start:
        return f"{start} No action brought it nearer to being graspable ({tries}). {_moved(found, found.start)}"
    after = f"At best, after {_times(len(found.best.actions), 'action')}, {_grasps(judgement)}"
    return f"{start} {after} ({tries}). {_moved(found, found.best)}"


def _grasps(judgement: Judgement) -> str:
    """What the feasible grasps hit."""
    if judgement.least is None:
        return "arm and shelf allow no grasp of the target"
    sets = in_the_way(judgement)
    told = ", or ".join(_objects(one) for one in sets[:TOLD]) + (", or others" if len(sets) > TOLD else "")
    return f"each of the {int(judgement.feasible.sum())} grasps that arm and shelf allow hits {told}"


def _objects(indices: Sequence[int]) -> str:
    return ("object " if len(indices) == 1 else "objects ") + " and ".join(map(str, indices))


def _times(count: int, what: str) -> str:
    return f"{count} {what}" + ("" if count == 1 else "s")


def _moved(found: Found, node: Node) -> str:
    """What could be done to the objects in the way."""
    told = []
    for index in blockers(node.judgement):
        sampled = {kind: count for (kind, i), count in found.sampled.items() if i == index}
        if not sampled:
            told.append(f"Object {index} could be neither picked nor pushed.")
            continue
        done = Counter({kind: found.executed[kind, index] for kind in sampled})
        failed = Counter({kind: 0 for kind in sampled})
        for (kind, i, _), count in found.failed.items():
            if i == index:
                failed[kind] += count
        each = ", ".join(f"{kind} {done[kind]} times ({failed[kind]} more failed)" for kind in sorted(sampled))
        missing = [kind for kind in ("pick-and-place", "push") if kind not in sampled]
        never = f"; never {missing[0]}" if missing else ""
        told.append(f"Object {index}: {each}{never}.")
    return " ".join(told)


def picture(found: Found, problem: Problem, name: str, text: str) -> Figure:
    """The start and the best world that was reached, with the objects marked that the best grasps hit.

    Args:
      found: of a search that did not succeed.
      problem: built for the target.
      name: of the scene.
      text: why it did not; see `reason`.
    """
    moments = [_moment("start", found.start, problem)]
    if found.best is not found.start:
        moments.append(_moment(f"after {_times(len(found.best.actions), 'action')}", found.best, problem))
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
