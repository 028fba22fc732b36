"""Warnings about recognised things that overlap: at least one of them is wrong."""

from __future__ import annotations

import itertools

import numpy as np
from jaxtyping import Float

from mechsearch_jax.observation import Observation
from mechsearch_jax.perception.doubt import Thing, things_of
from mechsearch_jax.perception.recogniser import Setting

# Deeper overlaps are not explained by recognition's error alone [m]: hidden things are recognised to about 1 cm.
DEEPEST = 0.015
# Level directions that are tested as separating axes, beside the things' axes.
_SPREAD = 64


def overlap_faults(setting: Setting, observation: Observation) -> tuple[str, ...]:
    """Warnings about recognised things that overlap by more than recognition's error, or have no finite shape.

    Args:
      setting: gives shelf and target, such as a problem.
      observation: without batch axes.
    """
    things = things_of(setting.shelf, setting.target, observation)
    overlaps = [(a.name, b.name, depth_in_each_other(a, b)) for a, b in itertools.combinations(things, 2)]
    not_finite = (thing.name for thing in things if not np.isfinite([thing.size, thing.position]).all())
    return *(f"recognition: {name} has no finite shape or place; look again" for name in not_finite), *(
        f"recognition: {a} and {b} are {100 * depth:.1f} cm deep in each other; at least one of them is wrong"
        for a, b, depth in overlaps
        if depth > DEEPEST
    )


def depth_in_each_other(a: Thing, b: Thing) -> float:
    """Upper bound of the penetration depth of two convex things [m]; negative if they do not overlap.

    The least overlap of their projections on several directions: exact for boxes whose faces meet, else slightly more.
    """
    way = b.position - a.position
    if np.linalg.norm(way) > np.linalg.norm(a.size) + np.linalg.norm(b.size):
        return -float("inf")
    turn = np.pi * np.arange(_SPREAD) / _SPREAD
    level = np.stack([np.cos(turn), np.sin(turn), np.zeros(_SPREAD)], axis=1)
    directions = np.concatenate([a.rotation.T, b.rotation.T, level])
    return float(np.min(_reach(a, directions) + _reach(b, directions) - np.abs(directions @ way)))


def _reach(thing: Thing, directions: Float[np.ndarray, "d 3"]) -> Float[np.ndarray, " d"]:
    """How far a thing reaches from its centre along unit vectors [m]."""
    along = np.abs(thing.local(directions)) * thing.size
    if thing.is_round:
        return np.hypot(along[:, 0], along[:, 1]) + along[:, 2]
    return along.sum(axis=1)
