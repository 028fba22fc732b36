"""Compare a look's recognised objects with the true bodies: what is missing, off, turned, and what is a phantom."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_dilation
from scipy.optimize import linear_sum_assignment

from mechsearch_jax.envs.world.world import TARGET
from mechsearch_jax.perception.doubt import Thing
from mechsearch_jax.perception.overlaps import depth_in_each_other
from mechsearch_jax.shapes import shape_of
from mechsearch_jax.workspace.scenario import Body, rotation_matrix

# Only objects of at least so many pixels are scored [pixels of the full image].
PIXELS = 100
# A recognised object is off with its centre farther from the true one than this [m], and turned with a larger angle
# [degrees].
OFF, TURNED = 0.02, 15.0
# A recognised object that overlaps no body, and whose centre is farther than this from all, stands for none [m].
FARTHEST = 0.06
# Bodies with a smaller gap touch each other [m].
TOUCHING = 0.005
# Sizes along two axes that differ by less than this share may be exchanged by turning an object.
ALIKE = 0.12
# A segment holds two objects if the smaller has this share of its pixels; an object has two segments likewise, and none
# if fewer of its pixels than `COVERED` are in any.
SHARED, COVERED = 0.15, 0.5


@dataclasses.dataclass(frozen=True)
class SeenRow:
    """What became of one visible object.

    Attributes:
      scene: name of the scene.
      object: its slot.
      objects: number of objects in the scene, seen or not.
      segments: where its segment comes from.
      noise: name of the sensor.
      shape: name of its shape.
      pixels: number of pixels of the full image that show it.
      gap: to the nearest other body [m]; approximate.
      beside: whether it borders on another body in the image.
      outcome: "right", "missing", "off" or "turned", the first that holds of the last three.
      kind: why it is not right: "merged" with another object in one segment, "split" into several segments, "hole" for
        no segment, "shape" for a right segment; empty if it is right.
      centre: distance of the centres [m]; None if missing.
      angle: by which it is turned, but for the shape's symmetries [degrees]; None if missing.
      iou: intersection over union of the volumes; 0 if missing.
      confidence: of the recognised object; None if missing.
    """

    scene: str
    object: int
    objects: int
    segments: str
    noise: str
    shape: str
    pixels: int
    gap: float
    beside: bool
    outcome: str
    kind: str
    centre: float | None
    angle: float | None
    iou: float
    confidence: float | None


@dataclasses.dataclass(frozen=True)
class Phantom:
    """A recognised object that stands for no body.

    Attributes:
      scene, segments, noise: of the look.
      slot: of the recognised object.
      kind: "split" if its segment lies mostly on one body, else "other".
      confidence: of it.
    """

    scene: str
    segments: str
    noise: str
    slot: int
    kind: str
    confidence: float


@dataclasses.dataclass(frozen=True)
class Sighting:
    """Whether a look detected the target.

    Attributes:
      scene, segments, noise: of the look.
      pixels: number of pixels of the full image that show it.
      in_sight: whether these are enough to detect it, see `workspace.detector.found_pixels`.
      detected: whether it was.
    """

    scene: str
    segments: str
    noise: str
    pixels: int
    in_sight: bool
    detected: bool


def detection_counts(sightings: Sequence[Sighting]) -> dict[str, int]:
    """How many targets are in sight, how many of them are missed, and how many are detected that are not in sight."""
    in_sight = [sighting for sighting in sightings if sighting.in_sight]
    missed = sum(not sighting.detected for sighting in in_sight)
    false = sum(sighting.detected for sighting in sightings if not sighting.in_sight)
    return {"targets_in_sight": len(in_sight), "targets_missed": missed, "targets_false": false}


def thing_of(name: str, body: Body) -> Thing:
    """A true body as a `Thing`."""
    return Thing(
        name,
        np.array(body.half_size),
        shape_of(body.shape).round,
        rotation_matrix(body.quaternion),
        np.array(body.position),
    )


def gaps(bodies: Sequence[Body]) -> Float[np.ndarray, " n"]:
    """Approximate distance of each body from the nearest other, at most 1 m [m]; negative if they overlap."""
    things = [thing_of("", body) for body in bodies]
    apart = np.ones((len(things), len(things)))
    for i, j in itertools.combinations(range(len(things)), 2):
        apart[i, j] = apart[j, i] = -depth_in_each_other(things[i], things[j])
    return apart.min(axis=1, initial=1.0)


def _turns() -> np.ndarray:
    """The 24 rotations that map the axes to axes, shape (24, 3, 3)."""
    signed = [
        np.eye(3)[list(order)] * np.array(signs)[:, None]
        for order in itertools.permutations(range(3))
        for signs in itertools.product((1, -1), repeat=3)
    ]
    return np.array([turn for turn in signed if np.linalg.det(turn) > 0])


_TURNS = _turns()


def turned_by(truth: Thing, answer: Thing) -> float:
    """Angle between a body and a recognised object, but for the symmetries of the body's shape [degrees].

    Axes of the recognised object are named so that its sizes fit the true ones.
    """
    if truth.is_round:
        axis = truth.rotation[:, 2]
        axes = answer.rotation[:, 2:] if answer.is_round else answer.rotation
        return float(np.degrees(np.arccos(np.clip(np.abs(axis @ axes).max(), -1.0, 1.0))))
    sizes = np.abs(_TURNS) @ truth.size
    misfit = np.abs(np.log(sizes / answer.size)).max(axis=1)
    fits = misfit <= misfit.min() + ALIKE
    if answer.is_round:
        axes = truth.rotation.T @ answer.rotation[:, 2]
        return float(np.degrees(np.arccos(np.clip(np.abs(axes).max(), -1.0, 1.0))))
    relative = truth.rotation.T @ answer.rotation
    traces = np.einsum("nij,ji->n", _TURNS, relative)
    return float(np.degrees(np.arccos(np.clip((traces[fits].max() - 1.0) / 2.0, -1.0, 1.0))))


def matched(
    iou: Float[np.ndarray, "n m"], distance: Float[np.ndarray, "n m"]
) -> tuple[Int[np.ndarray, " n"], Bool[np.ndarray, " m"]]:
    """Which recognised object stands for each body (-1 for none), and which recognised objects stand for one.

    Args:
      iou: volumetric intersection over union of every body with every recognised object.
      distance: of their centres [m].
    """
    possible = (iou > 0.0) | (distance < FARTHEST)
    cost = np.where(possible, np.minimum(distance, 0.5) - iou, 1e3)
    bodies, answers = linear_sum_assignment(cost)
    chosen = np.full(len(iou), -1)
    taken = np.zeros(iou.shape[1], bool)
    for body, answer in zip(bodies, answers, strict=True):
        if possible[body, answer]:
            chosen[body], taken[answer] = answer, True
    return chosen, taken


def bordering(owner: Int[np.ndarray, "h w"], slot: int) -> bool:
    """Whether a body borders on another in the image."""
    mask = owner == slot
    ring = binary_dilation(mask, iterations=2) & ~mask
    return bool(((owner >= 0) & (owner <= TARGET) & ring).any())


def failure_kind(slot: int, owner: Int[np.ndarray, "h w"], segments: Int[np.ndarray, "h w"]) -> str:
    """Why a visible object was not recognised, by the pixels of its segments; see `SeenRow.kind`.

    Args:
      slot: of the object.
      owner: true slots, of the same pixels as ...
      segments: the labels; negative for no segment.
    """
    labels = segments[owner == slot]
    if len(labels) == 0 or (labels >= 0).mean() < COVERED:
        return "hole"
    counts = np.bincount(labels[labels >= 0])
    main = int(counts.argmax())
    inside = owner[segments == main]
    others = np.bincount(inside[(inside >= 0) & (inside != slot)], minlength=1)
    if others.max(initial=0) >= SHARED * len(inside):
        return "merged"
    return "split" if np.sort(counts)[:-1].sum() >= SHARED * counts.sum() else "shape"


def phantom_kind(slot: int, owner: Int[np.ndarray, "h w"], segments: Int[np.ndarray, "h w"]) -> str:
    """Whether the segment of a phantom is "split" from a body, or "other"."""
    inside = owner[segments == slot]
    on_body = inside[(inside >= 0) & (inside <= TARGET)]
    return "split" if len(inside) and np.bincount(on_body, minlength=1).max() > 0.5 * len(inside) else "other"
