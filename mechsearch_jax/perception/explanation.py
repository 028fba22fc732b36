"""Explain the image: split, join or drop segments where other objects account for the measured depth better.

The network's segments are a proposal. Each object that was fitted to one should lie on the segment's points, and no
measured ray should pass through it. Where two objects were taken for one, or one for two, it does not: so doubtful
segments are also tried in parts, bordering segments as one, and of all these objects those are chosen that account for
the image with the least cost: points that lie on no object, rays that pass through an object, objects that overlap, and
a price for every object. The number of hypotheses is fixed; those that are not needed cost nothing outside of a batch.
"""

from __future__ import annotations

import dataclasses
import functools
import math

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from mechsearch_jax.geometry.superquadric import Superquadrics, standard_edges
from mechsearch_jax.geometry.transforms import yaw_rotation
from mechsearch_jax.images.cloud import draw
from mechsearch_jax.images.labels import FREE, MISSING, OTHER
from mechsearch_jax.perception.hypotheses import SLOTS, WAYS, bordering, fitted, parts
from mechsearch_jax.perception.recognition import LabelledImage, ShapeNetwork, fitted_segments
from mechsearch_jax.perception.refinement import FAR, RefinementConfig
from mechsearch_jax.perception.solids import entries, penetrations, surface_distance
from mechsearch_jax.runtime.compiled import kept
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.camera import Camera, pixel_rays
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target


@dataclasses.dataclass(frozen=True)
class ExplanationConfig:
    """Which segments are tried otherwise, and what an explanation costs; lengths in metres, costs in view pixels.

    Attributes:
      splits: number of the most doubtful segments that are divided.
      merges: number of pairs of bordering segments that are joined.
      points: number of points that an explanation is judged by.
      rays: at most about so many rays, spread evenly over the view.
      exact: a point this near to an object's surface is explained, or one that is so many times as near as ...
      deviations: ... the median of the points of the segments.
      wrong: a point that is farther by this is not; between the two its cost grows evenly.
      shrink: rays may pass this deep below an object's faces.
      doubtful: a segment is divided if so many of its pixels are badly explained, and ...
      doubtful_share: ... such a share of them.
      part: least number of pixels of a part.
      object: price of an object.
      gain: by how much another explanation must be better, and ...
      gain_share: ... by which share of the pixels of the segments that it changes.
      jump: neighbouring pixels whose points are farther apart are not connected.
      overlap: objects may be so deep in each other; recognition's own error.
      overlap_cost: of each further centimetre.
    """

    splits: int = 3
    merges: int = 3
    points: int = 4096
    rays: int = 16384
    exact: float = 0.003
    deviations: float = 2.5
    wrong: float = 0.005
    shrink: float = 0.005
    doubtful: float = 8.0
    doubtful_share: float = 0.04
    part: int = 12
    object: float = 8.0
    gain: float = 4.0
    gain_share: float = 0.01
    jump: float = 0.012
    overlap: float = 0.01
    overlap_cost: float = 20.0

    def __post_init__(self):
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"ExplanationConfig: {field.name} ({value}) must be positive")
        if self.splits > SLOTS:
            raise InputError(f"ExplanationConfig: splits ({self.splits}) must be at most {SLOTS}")


class Explained(flax.struct.PyTreeNode):
    """The objects that explain an image.

    Attributes:
      scene: the objects; those of segments that stay keep their slots.
      labels: the pixels of each object, as `LabelledImage.labels`.
      badly: share of each object's points that lie on no surface, shape (8,).
      passed: number of the view's rays through each object that pass, over its number of pixels, shape (8,).
      pixels: number of each object's pixels, shape (8,).
      changed: whether an object is not that of the given segment, bool, shape (8,).
    """

    scene: Superquadrics
    labels: jax.Array
    badly: jax.Array
    passed: jax.Array
    pixels: jax.Array
    changed: jax.Array


class _Sample(flax.struct.PyTreeNode):
    """Points and rays that an explanation is judged by.

    Attributes:
      points: of things on the board [m], shape (M, 3).
      label: of each point.
      weight: pixels for each point.
      directions: of rays, shape (R, 3).
      free: length up to which each ray is free; 0 if nothing was measured.
      exact: a point this near to a surface is explained [m].
      ray_weight: pixels for each ray; static.
    """

    points: jax.Array
    label: jax.Array
    weight: jax.Array
    directions: jax.Array
    free: jax.Array
    exact: jax.Array
    ray_weight: float = flax.struct.field(pytree_node=False)


def _sample(
    key: Array, image: LabelledImage, base: Superquadrics, camera: Camera, config: ExplanationConfig
) -> _Sample:
    things = (image.labels != FREE) & (image.labels != MISSING) & ~image.of_target
    index, total = draw(key, things.reshape(-1), config.points)
    height, width = image.labels.shape
    step = max(1, math.ceil(math.sqrt(height * width / config.rays)))
    rows, columns = (jnp.arange(step // 2, size, step) for size in (height, width))
    seen = image.depth[rows[:, None], columns[None, :]].reshape(-1)
    grid = jnp.meshgrid(rows * 1.0, columns * 1.0, indexing="ij")
    free = jnp.where(jnp.isnan(seen), 0.0, jnp.minimum(seen, FAR))
    label = jnp.where(total > 0, image.labels.reshape(-1)[index], OTHER).astype(jnp.int32)
    points = jnp.where(total > 0, image.points.reshape(-1, 3)[index], 0.0)
    own = jnp.abs(surface_distance(base, points))[jnp.maximum(label, 0), jnp.arange(config.points)]
    usual = jnp.nanmedian(jnp.where((label >= 0) & base.valid[jnp.maximum(label, 0)], own, jnp.nan))
    return _Sample(
        points=points,
        label=label,
        weight=total / config.points,
        directions=pixel_rays(camera, *grid).reshape(-1, 3),
        free=free,
        exact=jnp.maximum(config.exact, config.deviations * jnp.nan_to_num(usual)),
        ray_weight=float(step**2),
    )


def _point_cost(distance: Array, sample: _Sample, config: ExplanationConfig) -> Array:
    return jnp.clip((jnp.abs(distance) - sample.exact) / config.wrong, 0.0, 1.0)


def _passed(scene: Superquadrics, origin: Array, sample: _Sample, config: ExplanationConfig) -> Float[Array, " n"]:
    """Number of pixels whose measured rays pass through each object."""
    enter = entries(scene, origin, sample.directions, config.shrink)
    return jnp.sum(enter < sample.free[None] - config.shrink, axis=1) * sample.ray_weight


class _Moves(flax.struct.PyTreeNode):
    """Changes of an explanation, each from one set of objects to another, shape (Q, C), and which are possible."""

    removed: jax.Array
    added: jax.Array
    possible: jax.Array


@functools.partial(jax.jit, static_argnames=("refinement", "config"))
def explain(
    key: Key[Array, ""],
    image: LabelledImage,
    base: Superquadrics,
    target: Superquadrics,
    shapes: ShapeNetwork,
    camera: Camera,
    shelf: Shelf,
    refinement: RefinementConfig,
    config: ExplanationConfig,
) -> Explained:
    """The objects that explain a labelled image better than those of its segments alone.

    Args:
      key: PRNG key.
      image: of the camera.
      base: the objects of the image's segments, eight slots.
      target: the found target, one slot; absent if it is not visible.
      shapes: the recognition network.
      camera, shelf: of the image.
      refinement, config: static.
    """
    keys = jax.random.split(key, 2)
    origin = jnp.array(camera.position)
    sample = _sample(keys[0], image, base, camera, config)
    distance = surface_distance(base, sample.points)
    pixels = jnp.sum(image.labels.reshape(-1)[:, None] == jnp.arange(SLOTS)[None], axis=0)
    of_own = sample.label[None] == jnp.arange(SLOTS)[:, None]
    badly = jnp.sum(_point_cost(distance, sample, config) * of_own, axis=1) * sample.weight
    bad = jnp.where(base.valid, badly + _passed(base, origin, sample, config), 0.0)

    # Hypotheses: both parts of every division, and every union.
    worst, chosen = jax.lax.top_k(bad, config.splits)
    doubtful = (worst > config.doubtful) & (worst > config.doubtful_share * pixels[chosen])
    first = parts(image, base, chosen, sample.exact + config.wrong / 2, config.jump)
    whole = (image.labels[None] == chosen[:, None, None])[:, None]
    halves = jnp.stack([first, whole & ~first], axis=2).reshape(-1, *image.labels.shape)
    counts = jnp.sum(halves, axis=(1, 2)).reshape(-1, 2)
    divided = jnp.repeat(doubtful, WAYS) & (jnp.min(counts, axis=1) >= config.part)
    borders, pair = jax.lax.top_k(bordering(image, config.jump).reshape(-1), config.merges)
    low, high = pair // SLOTS, pair % SLOTS
    joined = (borders >= 3) & base.valid[low] & base.valid[high]
    union = (image.labels[None] == low[:, None, None]) | (image.labels[None] == high[:, None, None])
    active = jnp.concatenate([jnp.repeat(divided, 2), joined])
    masks = jnp.concatenate([halves, union])
    fits = fitted(keys[1], image, masks, active, shapes, camera, shelf, refinement)
    fits = fits.replace(valid=fits.valid & active, size=jnp.where(active[:, None], fits.size, 0.01))
    everything = jax.tree.map(lambda *a: jnp.concatenate(a), base, fits, target)

    moves = _moves(everything.capacity, chosen, divided, (low, high), joined)
    selected = _selected(everything, moves, origin, sample, pixels, config)
    return _explained(everything, selected, image, origin, sample, config)


def _moves(
    capacity: int,
    chosen: Int[Array, " k"],
    divided: Bool[Array, " d"],
    pair: tuple[Array, Array],
    joined: Bool[Array, " m"],
) -> _Moves:
    """Divide a segment into two objects or one of them, join a pair, or drop an object; the target stays."""
    count = len(divided)
    of_segment = jax.nn.one_hot(jnp.repeat(chosen, WAYS), capacity, dtype=bool)
    one, other = (jax.nn.one_hot(SLOTS + 2 * jnp.arange(count) + i, capacity, dtype=bool) for i in (0, 1))
    merged = [jax.nn.one_hot(slots, capacity, dtype=bool) for slots in pair]
    union = jax.nn.one_hot(SLOTS + 2 * count + jnp.arange(len(joined)), capacity, dtype=bool)
    each = jnp.eye(capacity, dtype=bool)[:-1]
    return _Moves(
        removed=jnp.concatenate([of_segment, of_segment, of_segment, merged[0] | merged[1], each]),
        added=jnp.concatenate([one | other, one, other, union, jnp.zeros_like(each)]),
        possible=jnp.concatenate([divided, divided, divided, joined, jnp.ones(len(each), bool)]),
    )


def _selected(
    scene: Superquadrics,
    moves: _Moves,
    origin: Array,
    sample: _Sample,
    pixels: Int[Array, " 8"],
    config: ExplanationConfig,
) -> Bool[Array, " c"]:
    """Which objects explain the image at the least cost, by the best change at a time from those of the segments."""
    capacity = scene.capacity
    of_target = jnp.arange(capacity) == capacity - 1
    cost = jnp.where(scene.valid[:, None], _point_cost(surface_distance(scene, sample.points), sample, config), 1.0)
    price = config.object + _passed(scene, origin, sample, config)
    price = jnp.where(of_target, 0.0, price)
    overlap = config.overlap_cost * 100.0 * jnp.maximum(penetrations(scene) - config.overlap, 0.0)

    def total(selected):
        left = jnp.min(jnp.where(selected[:, None], cost, 1.0), axis=0)
        both = jnp.sum(jnp.where(selected[:, None] & selected[None], overlap, 0.0)) / 2.0
        return jnp.sum(left) * sample.weight + jnp.sum(jnp.where(selected, price, 0.0)) + both

    # What a change must gain, for those that begin with a segment.
    size = jnp.concatenate([pixels, jnp.zeros(capacity - SLOTS)])
    needed = config.gain + config.gain_share * jnp.sum(moves.removed * size[None], axis=1)

    def step(state):
        selected, present, _, rounds = state
        after = (selected[None] & ~moves.removed) | (moves.added & scene.valid[None])
        possible = moves.possible & jnp.all(~moves.removed | selected[None], axis=1)
        possible &= jnp.all(~moves.added | scene.valid[None], axis=1)
        possible &= jnp.sum(after & ~of_target[None], axis=1) <= SLOTS
        gains = jnp.where(possible, present - jax.lax.map(total, after) - needed, -jnp.inf)
        best = jnp.argmax(gains)
        better = gains[best] > 0.0
        selected = jnp.where(better, after[best], selected)
        return selected, total(selected), better, rounds + 1

    start = scene.valid & ((jnp.arange(capacity) < SLOTS) | of_target)
    state = (start, total(start), jnp.array(True), 0)
    return jax.lax.while_loop(lambda state: state[2] & (state[3] < SLOTS), step, state)[0]


def _explained(
    everything: Superquadrics,
    selected: Bool[Array, " c"],
    image: LabelledImage,
    origin: Array,
    sample: _Sample,
    config: ExplanationConfig,
) -> Explained:
    """The selected objects in eight slots, with the labels of their pixels and how badly they explain them."""
    kept, new = selected[:SLOTS], selected[SLOTS:-1]
    order = jnp.argsort(~new, stable=True)[:SLOTS]
    free = jnp.cumsum(~kept) - 1
    filled = ~kept & (free < jnp.sum(new))
    source = jnp.where(filled, SLOTS + order[jnp.clip(free, 0, SLOTS - 1)], jnp.arange(SLOTS))
    scene: Superquadrics = jax.tree.map(lambda a: a[source], everything)
    scene = scene.replace(valid=kept | filled)

    # Pixels of segments that are no more go to the nearest of the objects.
    labels = image.labels
    gone = (labels >= 0) & ~kept[jnp.maximum(labels, 0)] & everything.valid[:SLOTS][jnp.maximum(labels, 0)]
    flat = jnp.where((labels == MISSING).reshape(-1, 1), 0.0, image.points.reshape(-1, 3))
    near = jnp.where(scene.valid[:, None], jnp.abs(surface_distance(scene, flat)), jnp.inf)
    nearest = jnp.where(jnp.min(near, axis=0) < sample.exact + 2 * config.wrong, jnp.argmin(near, axis=0), OTHER)
    labels = jnp.where(gone, nearest.reshape(labels.shape), labels).astype(labels.dtype)

    own = labels.reshape(-1)[None] == jnp.arange(SLOTS)[:, None]
    pixels = jnp.sum(own, axis=1)
    wrong = jnp.sum(jnp.where(own, _point_cost(near, sample, config), 0.0), axis=1)
    return Explained(
        scene=scene,
        labels=labels,
        badly=wrong / jnp.maximum(pixels, 1),
        passed=_passed(scene, origin, sample, config) / jnp.maximum(pixels, 1),
        pixels=pixels,
        changed=filled,
    )


@kept(static_argnames=("target", "refinement", "config"))
def explained_image(
    keys: Key[Array, "3"],
    image: LabelledImage,
    shapes: ShapeNetwork,
    camera: Camera,
    shelf: Shelf,
    target: Target,
    refinement: RefinementConfig,
    config: ExplanationConfig,
) -> tuple[Explained, Float[Array, " 3"]]:
    """The objects that explain an image, with `superquadric.standard_edges`, and the target's pose.

    Args:
      keys: for the points drawn from the objects, and from the target, and for the explanation.
      image: of the camera, labelled by a segmenter.
      shapes, camera, shelf: as of `recognise_image`.
      target, refinement, config: static.
    """
    base, labels, pose, has_pixels = fitted_segments(keys[:2], image, shapes, camera, shelf, target, refinement)
    place = jnp.stack([pose[0], pose[1], jnp.float32(target.height(shelf))])
    body = Superquadrics(
        size=jnp.array([target.half_size], jnp.float32),
        exponents=jnp.array([target.exponents], jnp.float32),
        position=place[None],
        rotation=yaw_rotation(pose[2])[None],
        valid=has_pixels[None],
    )
    segmented = image.replace(labels=labels)
    explained = explain(keys[2], segmented, base, body, shapes, camera, shelf, refinement, config)
    return explained.replace(scene=standard_edges(explained.scene)), pose
