"""Recognised things that are where others are: two solid things are not in one place, so at least one is wrong."""

from __future__ import annotations

import itertools

import numpy as np
from jaxtyping import Float

from mechsearch_jax.observation import Observation
from mechsearch_jax.perception.doubt import Thing, things_of
from mechsearch_jax.perception.recogniser import Setting

# Deeper in each other than this things are not by recognition's error alone [m]: what hides behind others is recognised
# to about a centimetre.
DEEPEST = 0.015
# Directions that two things are looked at along, beside their own axes.
_SPREAD = 64


def overlap_faults(setting: Setting, observation: Observation) -> tuple[str, ...]:
    """Which recognised things interpenetrate by more than recognition's error, or have no finite shape; a line each.

    Args:
      setting: whose shelf and target are meant; a problem is one.
      observation: what was recognised; without batch axes.
    """
    things = things_of(setting.shelf, setting.target, observation)
    deep = [(one.name, other.name, depth_in_each_other(one, other)) for one, other in itertools.combinations(things, 2)]
    lost = (thing.name for thing in things if not np.isfinite([thing.size, thing.position]).all())
    return *(f"recognition: {name} has no finite shape or place; look again" for name in lost), *(
        f"recognition: {one} and {other} are {100 * depth:.1f} cm deep in each other; at least one of them is wrong"
        for one, other, depth in deep
        if depth > DEEPEST
    )


def depth_in_each_other(one: Thing, other: Thing) -> float:
    """How far two convex things would have to move to be apart [m], at most; negative where they are.

    The least overlap of their shadows along some directions: exact for boxes whose faces meet, else a little more.
    """
    way = other.position - one.position
    if np.linalg.norm(way) > np.linalg.norm(one.size) + np.linalg.norm(other.size):
        return -float("inf")
    turn = np.pi * np.arange(_SPREAD) / _SPREAD
    level = np.stack([np.cos(turn), np.sin(turn), np.zeros(_SPREAD)], axis=1)
    directions = np.concatenate([one.rotation.T, other.rotation.T, level])
    return float(np.min(_reach(one, directions) + _reach(other, directions) - np.abs(directions @ way)))


def _reach(thing: Thing, directions: Float[np.ndarray, "d 3"]) -> Float[np.ndarray, " d"]:
    """How far a thing reaches from its centre along unit vectors [m]."""
    along = np.abs(thing.local(directions)) * thing.size
    if thing.is_round:
        return np.hypot(along[:, 0], along[:, 1]) + along[:, 2]
    return along.sum(axis=1)
