"""Explain the image: split, join or drop segments where other objects account for the measured depth better.

The network's segments are a proposal. Each object that was fitted to one should lie on the segment's points, and no
measured ray should pass through it. Where two objects were taken for one, or one for two, it does not: so doubtful
segments are also tried in parts, bordering segments as one, and of all these objects those are chosen that account for
the image with the least cost: points that lie on no object, rays that pass through an object, objects that overlap each
other or the target, and a price for every object. The number of hypotheses is fixed; those that are not needed cost
nothing outside of a batch.
"""

from __future__ import annotations

import dataclasses
import functools
import types
from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from mechsearch_jax.geometry.superquadric import Superquadrics, standard_edges
from mechsearch_jax.geometry.transforms import yaw_rotation
from mechsearch_jax.images.detection import fitted_pose, near_target, without_phantoms
from mechsearch_jax.images.labels import MISSING, MOST, OTHER
from mechsearch_jax.perception.confidence import Measures, confidence_of, measures_of
from mechsearch_jax.perception.hypotheses import (
    WAYS,
    Fits,
    bordering,
    distinct,
    fitted,
    mended,
    parts,
    pixels_of,
    rows_where,
    standing,
)
from mechsearch_jax.perception.recognition import LabelledImage, ShapeNetwork
from mechsearch_jax.perception.refinement import RefinementConfig
from mechsearch_jax.perception.selection import (
    Costs,
    Moves,
    Sample,
    Selection,
    check_numbers,
    moves_of,
    passed,
    point_cost,
    sample_of,
    select_objects,
)
from mechsearch_jax.perception.solids import penetrations, surface_distance
from mechsearch_jax.runtime.compiled import cached_jit
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target
from mechsearch_jax.workspace.target_view import main_body


@dataclasses.dataclass(frozen=True)
class ExplanationConfig(Costs):
    """Which segments are tried otherwise, and what an explanation costs; lengths in metres, costs in view pixels.

    Attributes:
      splits: number of the most doubtful segments that are divided; 0 for none.
      merges: number of pairs of segments that are joined; 0 for none.
      drops: whether an object is left out that explains less than it costs.
      doubtful: a segment is doubtful if so many of its pixels are badly explained, and ...
      doubtful_share: ... such a share of them.
      touching: two segments are joined if they border on each other and one is doubtful, or if their objects are so
        deep in each other.
      part: least number of pixels of a part.
      jump: neighbouring pixels whose points are farther apart are not connected.
    """

    splits: int = 3
    merges: int = 3
    drops: bool = True
    doubtful: float = 8.0
    doubtful_share: float = 0.04
    touching: float = 0.005
    part: int = 12
    jump: float = 0.012

    def __post_init__(self):
        check_numbers(self, positive=("points", "rays", "wrong"))
        for name, most in (("splits", MOST), ("merges", MOST**2)):
            if (number := getattr(self, name)) > most:
                raise InputError(f"ExplanationConfig: {name} ({number}) must be at most {most}")


AS_SEGMENTED = ExplanationConfig(splits=0, merges=0, drops=False)


class Fitted(PyTreeNode):
    """What was made of a labelled image.

    Attributes:
      objects: N slots, with `superquadric.standard_edges`.
      target_pose: x, y [m] and yaw [rad], meaningless but finite if the target has no pixels.
      confidence: of each object, see `Observation`, shape (N,).
      measures: what it comes from.
      labels: the pixels of each object, as `LabelledImage.labels`.
      changed: whether an object is not that of the given segment, bool, shape (N,).
    """

    objects: Superquadrics
    target_pose: jax.Array
    confidence: jax.Array
    measures: Measures
    labels: jax.Array
    changed: jax.Array


class Fitter(Protocol):
    """Fits objects and the target to a labelled image."""

    def __call__(
        self,
        keys: Key[Array, "2"],
        image: LabelledImage,
        shapes: ShapeNetwork,
        camera: Camera,
        shelf: Shelf,
        target: Target,
        refinement: RefinementConfig,
        least: Float[Array, ""] | float = 0.0,
    ) -> Fitted:
        """Fit the objects.

        Args:
          keys: for the points drawn from the objects, and from the target.
          image: of the camera, labelled by a segmenter.
          shapes: the recognition network.
          camera, shelf: of the image; they may be traced.
          target, refinement: static.
          least: an object of at most so many pixels may be a target that is not detected; no new one is made of them.
        """
        ...


def as_segmented(
    keys: Key[Array, "2"],
    image: LabelledImage,
    shapes: ShapeNetwork,
    camera: Camera,
    shelf: Shelf,
    target: Target,
    refinement: RefinementConfig,
    least: Float[Array, ""] | float = 0.0,
) -> Fitted:
    """The `Fitter` that keeps the segments as they are, such as true masks."""
    return explained_image(keys, image, shapes, camera, shelf, target, refinement, AS_SEGMENTED, least)


@dataclasses.dataclass(frozen=True)
class Explaining:
    """The `Fitter` that splits, joins and drops segments where that explains the image better.

    Attributes:
      config: of the explanation.
    """

    config: ExplanationConfig = dataclasses.field(default_factory=ExplanationConfig)

    def __call__(
        self,
        keys: Key[Array, "2"],
        image: LabelledImage,
        shapes: ShapeNetwork,
        camera: Camera,
        shelf: Shelf,
        target: Target,
        refinement: RefinementConfig,
        least: Float[Array, ""] | float = 0.0,
    ) -> Fitted:
        return explained_image(keys, image, shapes, camera, shelf, target, refinement, self.config, least)


@cached_jit(static_argnames=("target", "refinement", "config"))
def explained_image(
    keys: Key[Array, "2"],
    image: LabelledImage,
    shapes: ShapeNetwork,
    camera: Camera,
    shelf: Shelf,
    target: Target,
    refinement: RefinementConfig,
    config: ExplanationConfig,
    least: Float[Array, ""] | float = 0.0,
) -> Fitted:
    """The objects that explain an image; arguments as of `Fitter`, `config` is static."""
    most = {"splits": min(config.splits, image.capacity), "merges": min(config.merges, image.capacity**2)}
    config = dataclasses.replace(config, **most)
    pose, has_pixels = fitted_pose(keys[1], target, shelf, camera, image.points, image.depth, image.of_target)
    on_it = near_target(target, shelf, pose, image.points) & has_pixels
    labels = without_phantoms(image.labels, on_it, image.of_target, image.capacity)
    # An instance beyond the slots has no object.
    image = image.replace(labels=jnp.where(labels < image.capacity, labels, OTHER).astype(labels.dtype))
    place = jnp.stack([pose[0], pose[1], jnp.float32(target.height(shelf))])
    body = main_body(target, place[None], yaw_rotation(pose[2])[None], has_pixels[None])
    fitted_target = _FittedTarget(body, pose, on_it)
    return _explain(keys[0], image, fitted_target, (shapes, camera, shelf, refinement), config, least)


class _FittedTarget(PyTreeNode):
    """The target: its body in one slot, absent if it is not visible; its pose; and the pixels on it."""

    body: Superquadrics
    pose: jax.Array
    on_it: jax.Array


class _Tried(PyTreeNode):
    """What is fitted beside the segments' objects: both parts of every division, every union, and what is raised.

    Attributes:
      image: with pixels of segments without an object as OTHER.
      sample: points and rays of it.
      masks, active, boards: as of `fitted`.
      moves: by which they enter an explanation.
    """

    image: LabelledImage
    sample: Sample
    masks: jax.Array
    active: jax.Array
    boards: jax.Array
    moves: Moves


def _explain(
    key: Array,
    image: LabelledImage,
    fitted_target: _FittedTarget,
    settings: tuple[ShapeNetwork, Camera, Shelf, RefinementConfig],
    config: ExplanationConfig,
    least: Float[Array, ""] | float,
) -> Fitted:
    """`explained_image` for a fitted target."""
    keys, body, shelf, slots = jax.random.split(key, 3), fitted_target.body, settings[2], image.capacity
    segments = image.labels[None] == jnp.arange(slots, dtype=image.labels.dtype)[:, None, None]
    small = pixels_of(image.labels, slots) <= jnp.sum(image.of_target)

    def present(fits):
        base = jax.tree.map(lambda a: a[:slots], fits.objects)
        return base.replace(valid=base.valid & ~(_inside(base, body) & small))

    def tried(fits):
        return _tried(keys[1], image, present(fits), fitted_target, settings[1:3], config, least)

    def fit(key, given):
        return fitted(key, image, given.masks, given.active, given.boards, *settings)

    # First the segments, then what is tried beside them: in a loop, so that the fits are compiled once.
    def step(turn, state):
        fits, given = state
        more = fit(keys[turn * 2], given)
        # What stands on another object was taken to stand on the board, and is fitted again.
        better = given.active & (more.objects.valid | ~fits.objects.valid)
        both = jax.tree.map(functools.partial(rows_where, better), more, fits)
        return both, jax.lax.cond(turn == 0, tried, lambda _: given, both)

    masks = jnp.pad(segments, ((0, 2 * WAYS * config.splits + config.merges), (0, 0), (0, 0)))
    segmented = {
        "masks": masks,
        "active": jnp.any(masks, axis=(1, 2)),
        "boards": jnp.full(len(masks), shelf.board),
    }
    nothing = _zeros(lambda: fit(key, types.SimpleNamespace(**segmented)))
    start = _zeros(lambda: tried(nothing)).replace(**segmented)
    fits, given = jax.lax.fori_loop(0, 2, step, (nothing, start))
    objects = fits.objects.replace(
        valid=jnp.concatenate([present(fits).valid, fits.objects.valid[slots:] & ~_inside(fits.objects, body)[slots:]])
    )
    everything = jax.tree.map(lambda *a: jnp.concatenate(a), objects, body)
    selection = select_objects(everything, given.moves, given.sample, pixels_of(given.image.labels, slots), config)
    return _chosen(fits.replace(objects=objects), given, selection, fitted_target, settings[1:3], config)


def _zeros(of: Callable[[], Any]) -> Any:
    """Zeros of the shapes that a function returns."""
    return jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), jax.eval_shape(of))


def _tried(
    key: Array,
    image: LabelledImage,
    base: Superquadrics,
    fitted_target: _FittedTarget,
    setting: tuple[Camera, Shelf],
    config: ExplanationConfig,
    least: Float[Array, ""] | float,
) -> _Tried:
    """What is worth trying beside the objects of the segments."""
    camera, shelf = setting
    # Pixels of segments without an object belong to none.
    image = image.replace(labels=_without(image.labels, ~base.valid))
    slots = jnp.arange(image.capacity, dtype=image.labels.dtype)
    segments = image.labels[None] == slots[:, None, None]
    sample = sample_of(key, image, base, camera, shelf, config)
    pixels = pixels_of(image.labels, image.capacity)
    belongs = sample.label[None] == slots[:, None]
    badly = jnp.sum(point_cost(surface_distance(base, sample.points), sample, config) * belongs, axis=1) * sample.weight
    bad = jnp.where(base.valid, badly + passed(base, sample, config), 0.0)
    doubtful = (bad > config.doubtful) & (bad > config.doubtful_share * pixels)

    chosen = jax.lax.top_k(bad, config.splits)[1]
    first = parts(image, base, chosen, sample.exact + config.wrong / 2, config.jump)
    whole = (image.labels[None] == chosen[:, None, None])[:, None]
    halves = jnp.stack([first, whole & ~first], axis=2).reshape(-1, *image.labels.shape)
    counts = jnp.sum(halves & sample.judged[None], axis=(1, 2))
    divided = (doubtful[chosen][:, None] & distinct(first, pixels[chosen])).reshape(-1)
    divided &= jnp.min(counts.reshape(-1, 2), axis=1) >= config.part
    of_target = 2 * jnp.sum(halves & fitted_target.on_it[None], axis=(1, 2)) > jnp.sum(halves, axis=(1, 2))
    of_target &= counts <= jnp.sum(image.of_target)
    parted = jnp.repeat(divided, 2) & (counts > least) & ~of_target

    # What something hides in the middle shows two segments that do not border on each other, but whose objects overlap.
    borders = bordering(image.points, image.labels, config.jump, image.capacity)
    deep = jnp.triu(penetrations(base) - config.touching, 1)
    either = (borders >= 3) & (doubtful[:, None] | doubtful[None])
    likely = jnp.where(either, borders, 0.0) + 1e4 * jnp.maximum(deep, 0.0)
    likely, pair = jax.lax.top_k(likely.reshape(-1), config.merges)
    low, high = pair // image.capacity, pair % image.capacity
    joined = (likely > 0.0) & base.valid[low] & base.valid[high]
    union = (image.labels[None] == low[:, None, None]) | (image.labels[None] == high[:, None, None])

    masks = jnp.concatenate([segments, halves, union])
    boards = standing(masks, base, sample, shelf.board)
    raised = base.valid & (boards[: image.capacity] > shelf.board)
    active = jnp.concatenate([raised, parted, joined])
    moves = moves_of(image.capacity, chosen, divided, (low, high), joined, config.drops)
    return _Tried(image, sample, masks, active, boards, moves)


def _without(labels: Int[Array, "h w"], absent: Bool[Array, " n"]) -> Int[Array, "h w"]:
    """Labels in which the pixels of absent objects are OTHER."""
    is_absent = (labels >= 0) & absent[jnp.clip(labels, 0, len(absent) - 1)]
    return jnp.where(is_absent, OTHER, labels).astype(labels.dtype)


def _inside(scene: Superquadrics, body: Superquadrics) -> Bool[Array, " n"]:
    """Which objects have their centres in the found target, or above or below it, where none can stand.

    Args:
      scene: the objects.
      body: the target, one slot; absent if it is not visible.
    """
    level = scene.position.at[:, 2].set(body.position[0, 2])
    return (surface_distance(body, level)[0] < 0.0) & body.valid[0]


def _chosen(
    fits: Fits,
    given: _Tried,
    selection: Selection,
    fitted_target: _FittedTarget,
    setting: tuple[Camera, Shelf],
    config: ExplanationConfig,
) -> Fitted:
    """The selected objects in slots, those of segments that stay in theirs, with the labels of their pixels."""
    image, sample, slots = given.image, given.sample, given.image.capacity
    # There may be no hypotheses.
    stays, new = selection.selected[:slots], jnp.pad(selection.selected[slots:-1], (0, slots))
    order = jnp.argsort(~new, stable=True)[:slots]
    free = jnp.cumsum(~stays) - 1
    filled = ~stays & (free < jnp.sum(new))
    source = jnp.where(filled, slots + order[jnp.clip(free, 0, slots - 1)], jnp.arange(slots))
    fits, boards = jax.tree.map(lambda a: a[source], (fits, given.boards))
    scene = fits.objects.replace(valid=stays | filled)

    # Pixels of segments that are no more go to the nearest of the objects that they lie on. What was no object's, such
    # as an undetected target, stays so.
    labels = image.labels
    gone = (labels >= 0) & ~stays[jnp.clip(labels, 0, slots - 1)]
    flat = jnp.where((labels == MISSING).reshape(-1, 1), 0.0, image.points.reshape(-1, 3))
    near = jnp.where(scene.valid[:, None], jnp.abs(surface_distance(scene, flat)), jnp.inf)
    nearest = jnp.where(jnp.min(near, axis=0) < sample.exact + config.wrong, jnp.argmin(near, axis=0), OTHER)
    nearest = jnp.where(fitted_target.on_it, OTHER, nearest.reshape(labels.shape))
    labels = jnp.where(gone, nearest, labels).astype(labels.dtype)
    masks = labels[None] == jnp.arange(slots, dtype=labels.dtype)[:, None, None]
    fits = mended(fits.replace(objects=scene), image, masks, boards, *setting)
    scene = fits.objects
    measures = measures_of(scene, labels, image, sample, fits.error, selection.margin[source], config)
    return Fitted(standard_edges(scene), fitted_target.pose, confidence_of(measures), measures, labels, filled)
