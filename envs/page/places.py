"""Places on the board in words: where an object stands, and behind which objects a hidden target can be."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from mechsearch_jax.envs.camera.snapshot import Snapshot
from mechsearch_jax.envs.recording.recording import RecordedStep, Recording
from mechsearch_jax.envs.world.world import TARGET, World, superquadrics
from mechsearch_jax.viz import drawing
from mechsearch_jax.workspace.shelf import Shelf

# A body whose surface is no farther from a wall stands against it, or near it [m].
AGAINST, NEAR = 0.01, 0.025
# Groups of places that are named, at most.
MOST_GROUPS = 3
# Levels at which the sides of a target are looked at, and how much nearer to the camera than it something is that
# hides it, at least [m].
_LEVELS, _BEFORE = 5, 0.005


class Group(NamedTuple):
    """Possible places of a target.

    Attributes:
      hider: the object behind which they are from the camera; None for those behind nothing, or out of its view.
      count: how many.
      where: in words.
    """

    hider: int | None
    count: int
    where: str


def area(shelf: Shelf, places: Float[np.ndarray, "*n 2"]) -> str:
    """In which part of the board places are, seen by the robot, in words: the middle of all of them."""
    x, y = np.asarray(places, float).reshape(-1, 2).mean(axis=0)
    deep, aside = (x - shelf.front) / (shelf.back - shelf.front), (shelf.left - y) / (shelf.left - shelf.right)
    depth = "front" if deep < 1 / 3 else "back" if deep > 2 / 3 else ""
    side = "left" if aside < 1 / 3 else "right" if aside > 2 / 3 else ""
    words = [word for word in (depth, side) if word]
    return f"at the {' '.join(words)}" if words else "in the middle"


def walls(shelf: Shelf, world: World, k: int) -> dict[str, float]:
    """How far the surface of a body is from the walls [m], the nearest first."""
    outline = drawing.outlines(_alone(world, k))[k]
    assert outline is not None
    gaps = {
        "the back wall": shelf.back - outline[:, 0].max(),
        "the left wall": shelf.left - outline[:, 1].max(),
        "the right wall": outline[:, 1].min() - shelf.right,
    }
    return {wall: float(gaps[wall]) for wall in sorted(gaps, key=lambda wall: gaps[wall])}


def beside_wall(shelf: Shelf, world: World, k: int) -> str:
    """That a body stands against a wall or near it, in words; empty if it does not."""
    wall, gap = next(iter(walls(shelf, world, k).items()))
    return f"against {wall}" if gap <= AGAINST else f"{100 * gap:.0f} cm from {wall}" if gap <= NEAR else ""


def where(shelf: Shelf, world: World, k: int) -> str:
    """Where a body stands: against a wall, or else in which part of the board."""
    return beside_wall(shelf, world, k) or area(shelf, np.asarray(world.position)[k, :2])


def groups(recording: Recording, step: RecordedStep) -> list[Group]:
    """Behind which objects a target that is not found can be, most places first."""
    places, hider = _hidden_at(recording, step)
    return [
        Group(None if k < 0 else k, int((hider == k).sum()), area(recording.shelf, places[hider == k]))
        for k in sorted(set(hider.tolist()), key=lambda k: (k < 0, -int((hider == k).sum())))
    ]


def groups_in_words(groups: Sequence[Group]) -> str:
    """Groups of possible places: "behind object 6 (20 places, at the back left) or object 2 (4, at the back)".

    Empty if none is behind an object.
    """
    behind = [group for group in groups if group.hider is not None][:MOST_GROUPS]
    words = [f"object {group.hider} ({_count(group.count, k)}, {group.where})" for k, group in enumerate(behind)]
    others = sum(group.count for group in groups) - sum(group.count for group in behind)
    words += [f"elsewhere ({others})"] if others else []
    listed = " or ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)
    return f"behind {listed}" if behind else ""


def _count(count: int, k: int) -> str:
    """A number of places, the first one with its noun."""
    return str(count) if k else f"{count} place{'' if count == 1 else 's'}"


def possible(recording: Recording, step: RecordedStep) -> Bool[np.ndarray, " cells"]:
    """At which places of the grid the target can be, turned in any way."""
    rows, columns = recording.target.grid
    return np.any(np.asarray(step.existence).reshape(rows * columns, -1), axis=1)


@functools.lru_cache(maxsize=32)
def _hidden_at(recording: Recording, step: RecordedStep) -> tuple[Float[np.ndarray, "n 2"], Int[np.ndarray, " n"]]:
    """The possible places, and the number of the object that hides most of a target at each; -1 for none."""
    target, shelf, camera = recording.target, recording.shelf, recording.camera
    rows, columns = target.grid
    poses = np.asarray(target.candidate_poses(shelf)).reshape(rows * columns, -1, 3)
    exists = np.asarray(step.existence).reshape(rows * columns, -1)
    at = possible(recording, step)
    image = Snapshot(camera, shelf, jax.tree.map(jnp.asarray, step.world)).image
    depth, owner = np.asarray(image.depth), np.asarray(image.segmentation)
    hider = []
    for cell in np.flatnonzero(at):
        ends = drawing.target_points(poses[cell, exists[cell].argmax()], target, shelf).reshape(2, -1, 3)
        share = np.linspace(0.0, 1.0, _LEVELS)[:, None, None]
        points = (ends[0] + share * (ends[1] - ends[0])).reshape(-1, 3)
        column, row = np.rint(drawing.pixels(camera, points)).astype(int).T
        seen = (row >= 0) & (row < depth.shape[0]) & (column >= 0) & (column < depth.shape[1])
        far = (points - np.asarray(camera.position)) @ np.asarray(camera.rotation)[:, 2]
        row, column, far = row[seen], column[seen], far[seen]
        of = owner[row, column][depth[row, column] < far - _BEFORE]
        counts = np.bincount(of[(of >= 0) & (of < TARGET)], minlength=1)
        hider.append(int(counts.argmax()) if 2 * counts.max() > len(points) - counts.sum() else -1)
    return poses[at, 0, :2], np.array(hider, int)


def _alone(world: World, k: int):
    bodies = jax.tree.map(np.asarray, superquadrics(jax.tree.map(jnp.asarray, world)))
    return bodies.replace(valid=np.arange(len(bodies.valid)) == k)
