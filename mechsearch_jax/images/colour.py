"""Detection of the target by its colour, and segmentation by colour."""

from __future__ import annotations

import colorsys
import dataclasses
import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.images.labels import OTHER
from mechsearch_jax.runtime.errors import InputError, check_range
from mechsearch_jax.runtime.pytree import PyTreeNode

# Maps colours (..., 3) and a reference colour (3,) to dissimilarities (...).
ColourDifference = Callable[[Array, Array], Array]

# The target's colour, if none is given: the paper's red.
RED = (0.7282, 0.1558, 0.2099)
# Largest difference of equal hues [degrees], a fourth of the way from red to yellow, and the largest that may be set.
HUE, LARGEST_HUE = 15.0, 60.0
# A colour of the target's hue counts as the target's with at least this share of its saturation.
SATURATION = 0.7
# Least chroma of a pixel; below it the hue is noise.
LEAST_CHROMA = 0.08
# Least chroma and saturation of a target's colour: white, grey, black and similar colours have no hue.
LEAST_TARGET_CHROMA = 0.15
LEAST_TARGET_SATURATION = 0.3


def mean_square(colours: Float[Array, "*batch 3"], reference: Float[Array, "3"]) -> Float[Array, "*batch"]:
    """Mean squared difference of red, green and blue, as in appendix C.3; depends on the lighting."""
    return jnp.mean((colours - reference.reshape([1] * (colours.ndim - 1) + [3])) ** 2, axis=-1)


def chromaticity(colours: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
    """Colours divided by their sum, which does not depend on brightness; grey for black."""
    total = jnp.sum(colours, axis=-1, keepdims=True)
    dark = total < 1e-3
    return jnp.where(dark, 1.0 / 3.0, colours / jnp.where(dark, 1.0, total))


def chroma(colours: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
    """Maximum minus minimum of red, green and blue: 0 for grey."""
    return jnp.max(colours, axis=-1) - jnp.min(colours, axis=-1)


def saturation(colours: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
    """Chroma over the maximum of red, green and blue, which does not depend on brightness; 0 for black."""
    return chroma(colours) / jnp.maximum(jnp.max(colours, axis=-1), 1e-6)


def _opponents(colours: Float[Array, "*batch 3"]) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
    """Coordinates in the plane perpendicular to the axis of greys, where the angle is the hue: 0 for red, pi/3 for
    yellow."""
    red, green, blue = (colours[..., i] for i in range(3))
    return red - 0.5 * (green + blue), (0.5 * math.sqrt(3.0)) * (green - blue)


def hue_difference(
    colours: Float[Array, "*batch 3"], reference: Float[Array, "3"], tolerance: float = HUE
) -> Float[Array, "*batch"]:
    """Difference from a reference in hue or saturation, whichever is larger; 1 at the tolerance of either.

    The difference in hue is the angle between the two in the plane perpendicular to the axis of greys, over `tolerance`
    [degrees]. A saturation below the reference's counts relative to its tolerance; one above does not count. Neither
    depends on brightness. Colours below `LEAST_CHROMA` are infinitely different.
    """
    a, b = _opponents(colours)
    x, y = _opponents(reference.reshape([1] * (colours.ndim - 1) + [3]))
    turn = jnp.abs(jnp.arctan2(a * y - b * x, a * x + b * y))
    full = saturation(reference)
    lack = (full - saturation(colours)) / ((1.0 - SATURATION) * full)
    return jnp.where(
        chroma(colours) < LEAST_CHROMA, jnp.inf, jnp.maximum(jnp.maximum(turn / math.radians(tolerance), lack), 0.0)
    )


@dataclasses.dataclass(frozen=True)
class HueDifference:
    """`hue_difference` with a tolerance of its own, as a `ColourDifference`.

    Attributes:
      tolerance: largest difference of equal hues [degrees].
    """

    tolerance: float

    def __call__(self, colours: Array, reference: Array) -> Array:
        return hue_difference(colours, reference, self.tolerance)


@dataclasses.dataclass(frozen=True)
class TargetColour:
    """How the target is recognised by its colour.

    The paper's threshold of 0.1 on the mean square also accepts brown and dark red things, so that more than one
    segment has the target's colour. `TargetColour.lit` compares hues and saturations, which separate a red target from
    these in any light.

    Attributes:
      rgb: the target's colour, each in 0 to 1.
      threshold: largest difference of the target's colour.
      difference: how colours are compared.
      minimum_pixels: smaller segments are ignored.
    """

    rgb: tuple[float, float, float] = RED
    threshold: float = 0.1
    difference: ColourDifference = mean_square
    minimum_pixels: int = 1

    def __post_init__(self):
        if len(self.rgb) != 3 or not all(0 <= c <= 1 for c in self.rgb):
            raise InputError(f"TargetColour: rgb {self.rgb} must be red, green and blue, each in 0 to 1")
        if not self.threshold > 0 or self.minimum_pixels < 1:
            raise InputError(
                f"TargetColour: threshold ({self.threshold}) must be positive, minimum_pixels "
                f"({self.minimum_pixels}) at least 1"
            )

    @classmethod
    def lit(cls, rgb: tuple[float, float, float] = RED, tolerance: float = HUE) -> TargetColour:
        """A detector that does not depend on lighting: the target has the hue of `rgb`, to `tolerance`, and at least
        0.7 of its saturation; it may be purer, brighter or darker.

        Args:
          rgb: the target's colour in a camera's image, each in 0 to 1; `rgb_of_hue` makes it from a hue.
          tolerance: largest difference of equal hues [degrees].

        Raises:
          InputError: a number is outside its range, or the colour has no hue.
        """
        check_range("TargetColour: hue_tolerance", tolerance, 1.0, LARGEST_HUE, "degrees")
        if len(rgb) != 3 or not all(0 <= c <= 1 for c in rgb):
            raise InputError(
                f"TargetColour: colour {tuple(rgb)} must be red, green and blue, each from 0 to 1; divide 8-bit values "
                "by 255"
            )
        spread = max(rgb) - min(rgb)
        if spread < LEAST_TARGET_CHROMA or spread < LEAST_TARGET_SATURATION * max(rgb):
            raise InputError(
                f"TargetColour: colour {tuple(rgb)} is white, grey or black, or nearly so: it has no hue that tells "
                "the target from other things; give masks with target_id instead"
            )
        return cls(rgb, threshold=1.0, difference=hue_difference if tolerance == HUE else HueDifference(tolerance))

    def __call__(self, colours: Float[Array, "*batch 3"]) -> Bool[Array, "*batch"]:
        """Which colours are the target's; a `recogniser.TargetDetector`."""
        return self.difference(colours, jnp.array(self.rgb)) < self.threshold


def rgb_of_hue(hue: float, saturation: float) -> tuple[float, float, float]:
    """The brightest red, green and blue, each in 0 to 1, of a hue and a saturation.

    Args:
      hue: 0 is red, 120 green, 240 blue [degrees].
      saturation: from 0 for grey to 1 for a pure colour.

    Raises:
      InputError: a number is outside its range.
    """
    check_range("TargetColour: hue", hue, 0.0, 360.0, "degrees")
    check_range("TargetColour: saturation", saturation, 0.0, 1.0, "")
    return colorsys.hsv_to_rgb(hue / 360.0, saturation, 1.0)


class ColourDetection(PyTreeNode):
    """Which segment is the target.

    Attributes:
      found: whether exactly one segment has the target's colour.
      segment: that segment, int32; the most similar one if none or several have it.
      difference: of every segment's mean colour from the target's, infinite for too small segments, shape (N,).
    """

    found: jax.Array
    segment: jax.Array
    difference: jax.Array


@functools.partial(jax.jit, static_argnames=("segments", "target"))
def detect_target(
    colours: Float[Array, "p 3"], labels: Int[Array, " p"], segments: int, target: TargetColour | None = None
) -> ColourDetection:
    """Find the target among segments by their mean colours (appendix C.3).

    Args:
      colours: of points or pixels, red, green and blue in 0 to 1.
      labels: the segment of each, 0 to `segments - 1`; other numbers for none.
      segments: number of segments; static.
      target: its colour; static; the paper's if None.
    """
    target = target or TargetColour()
    slot = jnp.where((labels >= 0) & (labels < segments), labels, segments)
    count = jax.ops.segment_sum(jnp.ones_like(colours[:, 0]), slot, segments + 1)[:-1]
    mean = jax.ops.segment_sum(colours, slot, segments + 1)[:-1] / jnp.maximum(count, 1.0)[:, None]
    difference = target.difference(mean, jnp.array(target.rgb))
    difference = jnp.where(count >= target.minimum_pixels, difference, jnp.inf)
    is_like_target = difference < target.threshold
    return ColourDetection(jnp.sum(is_like_target) == 1, jnp.argmin(difference).astype(jnp.int32), difference)


# Neighbouring pixels are of one segment if their chromaticities differ by at most `ALIKE`, and their depths by at most
# `STEP` [m]. Parts with mean chromaticities as alike and a gap of at most `REJOIN` are one, too, which something in
# front splits [m]. Segments of fewer than `LEAST_PIXELS` are dropped.
ALIKE, STEP, REJOIN, LEAST_PIXELS = 0.05, 0.015, 0.04, 20


def _components(size: int, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    from scipy.sparse import coo_array, csgraph

    graph = coo_array((np.ones(len(a), bool), (a, b)), shape=(size, size))
    return csgraph.connected_components(graph, directed=False)[1]


def cluster_by_colour(
    colour: Float[np.ndarray, "h w 3"],
    depth: Float[np.ndarray, "h w"],
    points: Float[np.ndarray, "h w 3"],
    foreground: Bool[np.ndarray, "h w"],
) -> Int[np.ndarray, "h w"]:
    """Connected segments of similar colour, for images without a mask.

    Objects of equal colour that touch in the image become one segment: give neighbouring objects different colours, as
    the paper does, or use a segmentation network. Runs on the host, by SciPy's connected components.

    Args:
      colour: red, green and blue in 0 to 1.
      depth: along the camera's axis [m].
      points: of the pixels, in the world [m].
      foreground: pixels to be clustered.

    Returns:
      segment of every pixel, numbered by decreasing size; `labels.OTHER` for none.
    """
    from scipy.spatial import KDTree

    tint = np.array(chromaticity(jnp.asarray(colour, jnp.float32)))
    index = np.arange(foreground.size).reshape(foreground.shape)
    pairs = []
    for first, second in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1, :], np.s_[1:, :])):
        with np.errstate(invalid="ignore"):
            near = np.abs(depth[first] - depth[second]) <= STEP
        alike = np.linalg.norm(tint[first] - tint[second], axis=-1) <= ALIKE
        linked = foreground[first] & foreground[second] & near & alike
        pairs.append((index[first][linked], index[second][linked]))
    part = _components(foreground.size, *(np.concatenate(ends) for ends in zip(*pairs, strict=True)))
    part = np.where(foreground.ravel(), part, -1)
    names, part = np.unique(part, return_inverse=True)
    part = part - (names[0] == -1)
    sizes = np.bincount(part[part >= 0], minlength=1)
    large = np.flatnonzero(sizes >= LEAST_PIXELS)

    if not large.size:
        return np.full(foreground.shape, OTHER, np.int32)
    flat, tints = points.reshape(-1, 3), tint.reshape(-1, 3)
    members = [np.flatnonzero(part == p) for p in large]
    means = np.array([tints[m].mean(axis=0) for m in members]).reshape(-1, 3)
    trees = [KDTree(flat[m]) for m in members]
    joined = [
        (i, j)
        for i in range(len(large))
        for j in range(i)
        if np.linalg.norm(means[i] - means[j]) <= ALIKE
        and np.min(trees[i].query(flat[members[j]], distance_upper_bound=REJOIN)[0]) <= REJOIN
    ]
    whole = _components(len(large), *np.array(joined, int).reshape(-1, 2).T)
    labels = np.full(foreground.size, OTHER, np.int32)
    for m, w in zip(members, whole, strict=True):
        labels[m] = w
    order = np.argsort(-np.bincount(whole, sizes[large], minlength=1), kind="stable")
    rank = np.empty(len(order), np.int32)
    rank[order] = np.arange(len(order))
    return np.where(labels >= 0, rank[labels], OTHER).astype(np.int32).reshape(foreground.shape)
