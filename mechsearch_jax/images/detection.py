"""Detection of the target in a colour and a depth image, by its colour and its known shape and size.

The same on a robot and in simulation: all that is used is the images, the target's colour, shape and size.

A detector judges single pixels. In a sensor's noise it misses pixels of the target, which would be taken for an
obstacle inside the target. So colours are averaged within surfaces before detection, neighbours then vote, and pixels
on the surface of the fitted target are the target's, too.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from mechsearch_jax.images.cloud import MARGIN, above_board, draw
from mechsearch_jax.images.labels import CAPACITY, OTHER
from mechsearch_jax.images.target_pose import (
    DEVIATIONS,
    LARGEST_TOLERANCE,
    LEAST_TOLERANCE,
    Evidence,
    Placement,
    SampledPixels,
    away_from,
    depth_tolerance,
    descend,
    distance,
    evidence,
    target_poses,
    tilted_placements,
    upright,
    upright_placements,
    within_shelf,
)
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.workspace.camera import Camera, rays
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

# Number of points for fitting the target's pose.
TARGET_POINTS = 256
# Where its fits begin, see `target_poses`, and the number of pixels near it by which they are compared.
SIDES, BESIDE = (0.0, -0.5, 0.5, -1.0, 1.0), 1024
# Fits whose evidence differs by less than this share of the best one's are compared by the distances of points alone.
EQUAL = 0.03
# A pose of before that is turned by more than this from the new one [rad] stays if it fits within such a distance of
# where it was [m], less of the evidence speaks for it by at most the third share, and the new one's cost is not lower
# than the last share of its own.
TURNED, STANDS, UNDECIDED, DECIDED = 0.5, 0.015, 0.1, 0.8
# A yaw is not decided where the cost of another is less than so many times that of the chosen one.
ALIKE = 1.1
# Neighbours are pixels within a square of this width whose depth differs by at most `LIKE_DEPTH` [m] and, where colours
# are averaged, whose colour differs by at most `LIKE_COLOUR`, as the length of the difference of red, green and blue:
# with noise of 8/255 in each channel, one in a thousand differs more.
WINDOW = 5
LIKE_DEPTH = 0.01
LIKE_COLOUR = 0.25
# Largest width of the strips along edges where a sensor's colours and depths do not match, in pixels of a view.
STRIP = 4
# Points within this distance of the fitted target's surface are on it [m]: four standard deviations of 1 mm noise.
SURFACE = 0.004
# Number of points that the densest place is chosen from, and that the target is fitted to.
DRAWN = 256
# Number of pixels by which placements are compared.
COMPARED = 1024
# Where less than this share of the evidence in more than so many of these pixels is for it, the others are left out.
HOPELESS, LEAST_COMPARED = 0.5, 50
# Largest number of places of the target's colour that are examined, the one with the densest pixels first.
PLACES = 16
# Radius of a place, and of the part of it that is not a place again, relative to the diagonal of the target.
PLACE, PASSED = 0.6, 0.25
# The target is where at least this share of the evidence is for it.
SHARE = 0.85
# Pixels of the target's colour up to this far from its surface are its own, such as those across its edges [m].
OWN = 0.012


def _neighbours(image: Array, fill: float | bool) -> list[Array]:
    """Shifted copies of an image (h, w, ...), in which each pixel holds one of its neighbours or itself."""
    reach, (height, width) = WINDOW // 2, image.shape[:2]
    edges = [(reach, reach), (reach, reach), *[(0, 0)] * (image.ndim - 2)]
    padded = jnp.pad(image, edges, constant_values=fill)
    return [padded[i : i + height, j : j + width] for i in range(WINDOW) for j in range(WINDOW)]


def evened(colour: Float[Array, "h w 3"], depth: Float[Array, "h w"]) -> Float[Array, "h w 3"]:
    """Mean colour of each pixel's neighbours of similar depth and colour: less noise, and the same edges.

    Args:
      colour: red, green and blue in 0 to 1.
      depth: [m]; a pixel without a finite depth keeps its colour.
    """
    total, count = jnp.zeros(colour.shape, colour.dtype), jnp.zeros(depth.shape, colour.dtype)
    for near, other in zip(_neighbours(depth, math.nan), _neighbours(colour, 0.0), strict=True):
        alike = jnp.sum((other - colour) ** 2, axis=-1) < LIKE_COLOUR**2
        counts = alike & (jnp.abs(near - depth) < LIKE_DEPTH)
        total, count = total + jnp.where(counts[..., None], other, 0.0), count + counts
    return jnp.where((count > 0)[..., None], total / jnp.maximum(count, 1.0)[..., None], colour)


def elected(chosen: Bool[Array, "h w"], depth: Float[Array, "h w"]) -> Bool[Array, "h w"]:
    """Majority vote among each pixel's neighbours of similar depth; at a tie or without a finite depth [m] it stays."""
    votes = jnp.zeros(depth.shape, jnp.int32)
    for near, other in zip(_neighbours(depth, math.nan), _neighbours(chosen, False), strict=True):
        votes = votes + jnp.where(jnp.abs(near - depth) < LIKE_DEPTH, jnp.where(other, 1, -1), 0)
    return (votes > 0) | (chosen & (votes == 0))


def coloured_pixels(
    detector: Callable[[Array], Array], colour: Float[Array, "h w 3"], depth: Float[Array, "h w"]
) -> Bool[Array, "h w"]:
    """The pixels in which a detector sees the target, robust to the noise of single pixels.

    Args:
      detector: gives the target's pixels of a colour image.
      colour: red, green and blue in 0 to 1.
      depth: [m]; NaN where nothing was measured.
    """
    return without_strips(elected(detector(evened(colour, depth)), depth), depth)


def without_strips(chosen: Bool[Array, "h w"], depth: Float[Array, "h w"]) -> Bool[Array, "h w"]:
    """Chosen pixels without strips of up to `STRIP` pixels along the edges of surfaces that are else not chosen.

    There a sensor sees what is nearer some pixels too wide, or its colours shifted: the pixels have the colour of what
    is behind the edge, and the depth of what is before it. Next to what is not measured, a narrow strip may be of it.

    Args:
      chosen: the pixels.
      depth: [m]; NaN where nothing was measured.
    """
    strips = jnp.zeros(chosen.shape, bool)
    for there, picked, strip in ((depth, chosen, strips), (depth.T, chosen.T, strips.T)):
        ends = [_steps_to(there, picked, by) for by in (1, -1)]
        for (edge, _), (_, other) in (ends, ends[::-1]):
            strip = strip | (edge + other <= STRIP + 1)
        strips = strips | (strip if there is depth else strip.T)
    return chosen & ~strips


def _steps_to(depth: Array, chosen: Array, by: int) -> tuple[Array, Array]:
    """How many pixels along rows, to the right (1) or left (-1), the measured surface ends, and something not chosen
    begins that may belong to it; many where neither is within `STRIP`."""
    width, many = depth.shape[1], jnp.full(depth.shape, 2 * STRIP)
    edges = ((0, 0), (STRIP, STRIP))
    depths, picks = jnp.pad(depth, edges, constant_values=math.nan), jnp.pad(chosen, edges)
    edge, other, last, goes_on = many, many, depth, jnp.ones(depth.shape, bool)
    for k in range(1, STRIP + 1):
        near, picked = (a[:, STRIP + by * k :][:, :width] for a in (depths, picks))
        gap, alike = jnp.isnan(near), jnp.abs(near - last) < LIKE_DEPTH
        edge = jnp.where((edge == many) & ~alike, k, edge)
        goes_on = goes_on & (gap | alike)
        other = jnp.where((other == many) & goes_on & ~picked, k, other)
        last = jnp.where(gap, last, near)
    return edge, other


def fitted_pose(
    key: Key[Array, ""],
    target: Target,
    shelf: Shelf,
    camera: Camera,
    points: Float[Array, "h w 3"],
    depth: Float[Array, "h w"],
    of_target: Bool[Array, "h w"],
) -> tuple[Float[Array, " 3"], Bool[Array, ""]]:
    """The pose of the target from its pixels: x, y [m] and yaw [rad]; and whether it has any pixels.

    Of the poses that its points fit equally well, it is one where nothing is seen behind the target's surface.

    Args:
      key: PRNG key of the drawn points.
      target: static.
      shelf, camera: of the image.
      points: in the world [m].
      depth: of the points [m]; NaN where nothing was measured, infinite where there is nothing.
      of_target: the target's pixels; if there are none, the pose is meaningless, but finite.
    """
    drawn, seen, sample = _compared(key, target, camera, points, depth, of_target)
    origin = jnp.array(camera.position)
    poses, costs = target_poses(target, shelf, origin, drawn, seen, SIDES)
    proof = jax.vmap(lambda pose: evidence(target, upright(target, shelf, pose), origin, sample))(poses)
    worth = proof.support - proof.contrary
    good = worth >= jnp.max(worth) - jnp.maximum(2.0, EQUAL * jnp.max(proof.support))
    return poses[jnp.argmin(jnp.where(good, costs, jnp.inf))], seen[0]


def _compared(
    key: Key[Array, ""],
    target: Target,
    camera: Camera,
    points: Float[Array, "h w 3"],
    depth: Float[Array, "h w"],
    of_target: Bool[Array, "h w"],
) -> tuple[Float[Array, "n 3"], Bool[Array, " n"], SampledPixels]:
    """Points of the target, which of them count, and pixels whose rays may meet it; arguments as of `fitted_pose`."""
    flat, origin = points.reshape(-1, 3), jnp.array(camera.position)
    index, count = draw(key, of_target.reshape(-1), TARGET_POINTS)
    drawn, seen = flat[index], jnp.broadcast_to(count > 0, TARGET_POINTS)
    reach = 2.0 * float(sum(half**2 for half in target.half_size)) ** 0.5
    middle = jnp.sum(jnp.where(seen[:, None], drawn, 0.0), axis=0) / TARGET_POINTS - origin
    along = rays(camera).reshape(-1, 3)
    nearest = jnp.sum(along * middle[None], axis=-1, keepdims=True) / jnp.sum(along**2, axis=-1, keepdims=True)
    passes = jnp.sum((nearest * along - middle[None]) ** 2, axis=-1) < reach**2
    beside, _ = draw(jax.random.fold_in(key, 1), passes, BESIDE)
    chosen, tolerance = of_target.reshape(-1), depth_tolerance(depth, of_target)
    sample = SampledPixels(
        along[beside], flat[beside], depth.reshape(-1)[beside], chosen[beside], jnp.broadcast_to(tolerance, BESIDE)
    )
    return drawn, seen, sample


def steady_pose(
    key: Key[Array, ""],
    target: Target,
    shelf: Shelf,
    camera: Camera,
    points: Float[Array, "h w 3"],
    depth: Float[Array, "h w"],
    of_target: Bool[Array, "h w"],
    pose: Float[Array, " 3"],
    before: Float[Array, " 3"],
) -> Float[Array, " 3"]:
    """The pose of a target that may still stand where it stood: the earlier one, fitted to this image, unless the image
    decides for its own.

    Where sides are about as wide, or few of them are seen, noise decides between poses that explain an image alike, and
    their yaw would flip from look to look.

    Args:
      key: PRNG key of the drawn points.
      target, shelf, camera, points, depth, of_target: as of `fitted_pose`.
      pose: fitted to this image, as x, y [m] and yaw [rad].
      before: of an earlier look.
    """
    drawn, seen, sample = _compared(key, target, camera, points, depth, of_target)
    weight, origin = seen.astype(jnp.float32), jnp.array(camera.position)
    drawn = jnp.where(seen[:, None], drawn, 0.0)
    both, costs = jax.vmap(lambda start: descend(lambda at: distance(target, shelf, at, drawn), weight, start))(
        jnp.stack([pose, before])
    )
    proof = jax.vmap(lambda at: evidence(target, upright(target, shelf, at), origin, sample))(both)
    worth = proof.support - proof.contrary
    turned = turned_by(target, pose[2], both[1, 2]) > TURNED
    stays = jnp.sum((both[1, :2] - before[:2]) ** 2) < STANDS**2
    alike = worth[1] >= worth[0] - jnp.maximum(2.0, UNDECIDED * proof.support[0])
    kept = turned & stays & alike & (costs[0] > DECIDED * costs[1])
    return jnp.where(kept, both[1].at[2].set(jnp.mod(both[1, 2], target.turn)), pose)


def turned_by(target: Target, yaw: Array, other: Array) -> Array:
    """By how much one yaw differs from another, after which the target looks otherwise [rad]."""
    return jnp.abs(jnp.mod(other - yaw + target.turn / 2, target.turn) - target.turn / 2)


@functools.partial(jax.jit, static_argnames="target")
def other_yaw(
    target: Target,
    shelf: Shelf,
    origin: Float[Array, " 3"],
    drawn: Float[Array, "n 3"],
    sample: SampledPixels,
    pose: Float[Array, " 3"],
) -> Float[Array, ""]:
    """Another yaw [rad] at which the target would explain an image about as well as at its pose; NaN if there is none.

    Args:
      target: static.
      shelf: on which it stands.
      origin: the camera's position in the world [m].
      drawn: points of the target, in the world [m].
      sample: pixels whose rays may meet it; their tolerance is that of the drawn points' distances.
      pose: as x, y [m] and yaw [rad].
    """
    usual = jnp.median(jnp.abs(distance(target, shelf, pose, drawn))) / 0.6745
    tolerance = jnp.clip(DEVIATIONS * usual, LEAST_TOLERANCE, LARGEST_TOLERANCE)
    sample = sample.replace(tolerance=jnp.broadcast_to(tolerance, sample.depth.shape))
    fit = descend(lambda at: distance(target, shelf, at, drawn), jnp.ones(len(drawn)), pose)
    fits = target_poses(target, shelf, origin, drawn, jnp.ones(len(drawn), bool), SIDES)
    poses, costs = (jnp.concatenate([a[None], b]) for a, b in zip(fit, fits, strict=True))
    proof = jax.vmap(lambda at: evidence(target, upright(target, shelf, at), origin, sample))(poses)
    worth = proof.support - proof.contrary
    alike = worth >= worth[0] - jnp.maximum(2.0, UNDECIDED * proof.support[0])
    alike &= (costs < ALIKE * costs[0]) & (turned_by(target, pose[2], poses[:, 2]) > TURNED)
    return jnp.where(jnp.any(alike), poses[jnp.argmin(jnp.where(alike, costs, jnp.inf)), 2], jnp.nan)


def near_target(
    target: Target, shelf: Shelf, pose: Float[Array, " 3"], points: Float[Array, "*batch 3"]
) -> Bool[Array, "*batch"]:
    """Which world points [m] are on the surface of a target at a pose x, y [m] and yaw [rad].

    False for NaN, and for points deep inside the target, since something seen there is not the target.
    """
    return (jnp.abs(distance(target, shelf, pose, points.reshape(-1, 3))) < SURFACE).reshape(points.shape[:-1])


def without_phantoms(
    labels: Int[Array, "h w"], on_it: Bool[Array, "h w"], of_target: Bool[Array, "h w"], capacity: int = CAPACITY
) -> Int[Array, "h w"]:
    """Labels in which a segment that lies mostly on the fitted target is OTHER, for its points are the target's.

    A segment that is larger than the visible part of the target stays: the pose fitted to a narrow part is uncertain,
    and may reach into a neighbour.

    Args:
      labels: as in `images.labels`.
      on_it: pixels on the fitted target; none if it is not visible.
      of_target: the target's pixels.
      capacity: segments are numbered up to it.
    """
    member = labels[..., None] == jnp.arange(capacity + 1, dtype=labels.dtype).reshape(1, 1, -1)
    size, within = jnp.sum(member, axis=(0, 1)), jnp.sum(member & on_it[..., None], axis=(0, 1))
    is_phantom = (2 * within > size) & (size <= jnp.sum(of_target))
    phantom = jnp.any(member & is_phantom.reshape(1, 1, -1), axis=-1)
    return jnp.where(phantom, OTHER, labels).astype(labels.dtype)


class ColouredDepth(PyTreeNode):
    """A depth image with colours.

    Attributes:
      points: in the world [m], shape (h, w, 3); NaN where nothing was measured.
      depth: of the points [m], shape (h, w); NaN where nothing was measured, infinite where there is nothing.
      colour: red, green and blue in 0 to 1, shape (h, w, 3).
    """

    points: jax.Array
    depth: jax.Array
    colour: jax.Array


class Detection(PyTreeNode):
    """The target in an image.

    Attributes:
      visible: whether it is there, in more pixels than the threshold.
      coloured: its pixels of its colour, bool, shape (h, w).
      pixels: these, and the others on the surface of an upright target; none if it is not visible.
      unclear: pixels of its colour where too few show to tell what they are; they may be the target's.
      share: of the evidence at the last place that is for the target; 0 where nothing has its colour.
    """

    visible: jax.Array
    coloured: jax.Array
    pixels: jax.Array
    unclear: jax.Array
    share: jax.Array


def no_detection(image: Float[Array, "h w"]) -> Detection:
    """The detection in an image of this shape that shows no target."""
    nowhere = jnp.zeros(image.shape, bool)
    return Detection(jnp.zeros((), bool), nowhere, nowhere, nowhere, jnp.zeros(()))


def detect(
    key: Key[Array, ""],
    detector: Callable[[Array], Array],
    target: Target,
    shelf: Shelf,
    camera: Camera,
    image: ColouredDepth,
    threshold: Array | float,
) -> Detection:
    """Find the target's pixels.

    The target is fitted to the pixels of its colour where they are densest, first upright, then leaning or lying. It
    is there if at least `SHARE` of the evidence is for it (`target_pose.evidence`): if it is seen on its whole
    surface that nothing hides, and nothing of its colour goes on beyond it. Else the next densest place is looked at,
    up to `PLACES` of them.

    Args:
      key: PRNG key of the drawn points.
      detector: gives the pixels of the target's colour in a colour image.
      target: whose size and shape are known; static.
      shelf, camera: of the image.
      image: of the shelf.
      threshold: a target of at most this many pixels is not visible.
    """
    # Points on the board's faces may be the target's.
    near = above_board(shelf, image.points, -MARGIN)
    coloured = coloured_pixels(detector, image.colour, image.depth) & near
    tolerance = jnp.broadcast_to(depth_tolerance(image.depth, coloured), coloured.shape)
    sample = SampledPixels(rays(camera), image.points, image.depth, coloured, tolerance)
    scene = _Scene(sample, near, jnp.array(camera.position), shelf, threshold)

    def goes_on(state):
        place, left, found = state
        return (place < PLACES) & ~found.visible & jnp.any(left)

    def look(state):
        place, left, found = state
        at = densest_place(jax.random.fold_in(key, place), target, image.points, left)
        apart = jnp.sum((image.points - at.reshape(1, 1, 3)) ** 2, axis=-1) / _diagonal(target) ** 2
        within = apart < PLACE**2
        seen = _at_place(jax.random.fold_in(key, PLACES + place), target, scene, at, left & within)
        few = coloured & within & (jnp.sum(coloured & within) <= threshold)
        seen = seen.replace(unclear=(found.unclear | few) & ~seen.visible)
        return place + 1, left & ~(apart < PASSED**2) & ~few, seen

    return jax.lax.while_loop(goes_on, look, (jnp.int32(0), coloured, no_detection(image.depth)))[2]


class _Scene(PyTreeNode):
    """What is the same at every place: the pixels, which are near the shelf's space, the camera's position, ..."""

    sample: SampledPixels
    near: jax.Array
    origin: jax.Array
    shelf: Shelf
    threshold: jax.Array | float


def _diagonal(target: Target) -> float:
    """Of the box around the target [m]."""
    return 2.0 * float(sum(half**2 for half in target.half_size)) ** 0.5


def densest_place(
    key: Key[Array, ""], target: Target, points: Float[Array, "h w 3"], coloured: Bool[Array, "h w"]
) -> Float[Array, " 3"]:
    """The point around which most pixels are as near as one target's can be [m].

    Args:
      key: PRNG key of the drawn points.
      target: whose size is known; static.
      points: in the world [m].
      coloured: pixels that may be the target's; if there are none, the point is meaningless.
    """
    index, _ = draw(key, coloured.reshape(-1), DRAWN)
    drawn = points.reshape(-1, 3)[index]
    square = sum((drawn[:, None, i] - drawn[None, :, i]) ** 2 for i in range(3))
    return drawn[jnp.argmax(jnp.sum(square < (0.5 * _diagonal(target)) ** 2, axis=1))]


def _at_place(
    key: Key[Array, ""], target: Target, scene: _Scene, at: Float[Array, " 3"], here: Bool[Array, "h w"]
) -> Detection:
    """What is detected at a place, whose middle [m] and pixels are given."""
    sample, shelf, origin = scene.sample, scene.shelf, scene.origin
    fit_key, compare_key = jax.random.split(key)
    flat = jax.tree.map(lambda a: a.reshape(here.size, *a.shape[2:]), sample)
    index, count = draw(fit_key, here.reshape(-1), DRAWN)
    drawn, valid = flat.points[index], jnp.broadcast_to(count > 0, DRAWN)
    # Rays that may meet a target near the place.
    towards = (at - origin).reshape(1, 3)
    reach = jnp.sum(flat.rays * towards, axis=-1, keepdims=True) / jnp.sum(flat.rays**2, axis=-1, keepdims=True)
    passes = jnp.sum((reach * flat.rays - towards) ** 2, axis=-1) < _diagonal(target) ** 2
    region, _ = draw(compare_key, passes, COMPARED)
    compared: SampledPixels = jax.tree.map(lambda a: a[region], flat)

    def best(placements: Placement) -> tuple[Placement, Evidence]:
        each = jax.vmap(lambda placement: evidence(target, placement, origin, compared))(placements)
        possible = jax.vmap(lambda placement: within_shelf(target, placement, shelf))(placements)
        worth = jnp.where(possible, each.support - each.contrary, -2 * COMPARED)
        chosen, rough = jax.tree.map(lambda a: a[jnp.argmax(worth)], (placements, each))
        hopeless = (rough.share < HOPELESS) & (rough.support + rough.contrary > LEAST_COMPARED)
        return chosen, jax.lax.cond(hopeless, lambda: rough, lambda: evidence(target, chosen, origin, flat))

    placement, proof = best(upright_placements(target, shelf, origin, drawn, valid))
    stands = proof.share >= SHARE
    placement, proof = jax.lax.cond(
        stands, lambda: (placement, proof), lambda: best(tilted_placements(target, origin, drawn, valid))
    )
    away = jnp.abs(away_from(target, placement, flat.points)).reshape(here.shape)
    own = sample.coloured & (away < OWN)
    enough = jnp.sum(own) > scene.threshold
    visible = enough & (proof.share >= SHARE) & within_shelf(target, placement, shelf)
    # The pose is unreliable if it would add more pixels than the colour shows.
    on_it = (away < SURFACE) & scene.near & stands
    on_it &= jnp.sum(on_it & ~own) <= jnp.sum(own)
    return Detection(visible, own & visible, (own | on_it) & visible, jnp.zeros(here.shape, bool), proof.share)
