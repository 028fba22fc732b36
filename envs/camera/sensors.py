"""Depth cameras as values: one function simulates them all, and their numbers are data, so that a sweep compiles once.

Lengths in pixels are of an image of 1280 x 720 of the default camera, as those of `holes`. Noise that neighbours share
belongs to the rays: a thinned image has that of the full one. `benchmarks.lab.parts.sensors` measures what comes of it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from mechsearch_jax.envs.camera.holes import USUAL_FX, plane_waves, shadows
from mechsearch_jax.envs.camera.simulated_camera import BACKGROUND, SHELF, mirrored_depth
from mechsearch_jax.envs.world.mismatch import USUAL_NOISE, SensorName
from mechsearch_jax.envs.world.world import World
from mechsearch_jax.images.noise import incidence, scattered
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.workspace.camera import Camera, back_project, rays
from mechsearch_jax.workspace.shelf import Shelf

# Waves of which a field consists.
WAVES = 64
# Difference in depth between neighbouring pixels that makes an edge [m].
EDGE = 0.015
# Least cosine of the angle of incidence that noise grows with.
STEEPEST = 0.2
# How far from the board's height the board is seen [m].
ON_BOARD = 1e-3
# A hand before the camera: its depth [m], half its width, and the ranges of its middle and of its upper end, as the
# tangents of angles to the right and down from the camera's axis.
HAND_DEPTH, HAND_WIDTH, HAND_MIDDLE, HAND_TOP = 0.3, 0.07, (-0.4, 0.4), (0.4, 0.55)


class Surfaces(PyTreeNode):
    """What an image shows, for a sensor that measures some surfaces worse than others.

    Attributes:
      material: of each pixel's surface, uniformly distributed over things in 0 to 1; large is dark or shiny; 0 where
        nothing is; shape (h, w).
      shelf: which pixels show the shelf.
      mirrored: at which depth a pixel of the board would show the mirror image of what stands there [m]; infinite where
        it shows none, shape (h, w).
    """

    material: jax.Array
    shelf: jax.Array
    mirrored: jax.Array


def surfaces_of(
    key: Key[Array, ""],
    camera: Camera,
    shelf: Shelf,
    world: World,
    owner: Int[Array, "h w"],
    depth: Float[Array, "h w"],
) -> Surfaces:
    """The surfaces of an image.

    Args:
      key: PRNG key of the materials; of the scene, so that all its images show the same.
      camera: of the image, where it truly is.
      shelf, world: what it shows.
      owner: the slot that each pixel shows, as `Image.segmentation`.
      depth: the true one [m].
    """
    # Not the colours' key.
    material = jax.random.uniform(jax.random.fold_in(key, 1), (SHELF + 1,))[jnp.clip(owner, 0, SHELF)]
    height = camera.position[2] + depth * rays(camera)[..., 2]
    on_board = (owner == SHELF) & (jnp.abs(height - shelf.board) < ON_BOARD)
    mirrored = jnp.where(on_board, mirrored_depth(camera, world, shelf), jnp.inf)
    return Surfaces(jnp.where(owner == BACKGROUND, 0.0, material), owner == SHELF, mirrored)


class Sensor(PyTreeNode):
    """A depth camera, as a `NoiseModel`; by default a perfect one. Each number may be traced.

    The model is phenomenological. Noise of depth z is z^2 times an error of 1 / z, as that of disparities is; its
    deviations are those at a depth of 1 m [m].

    Attributes:
      scatter: standard deviation by which points move in a random direction, at any depth [m].
      jitter: of each pixel's own noise.
      noise, length: of the noise that neighbours share, whose correlation is exp(-r^2 / (2 length^2)) at r pixels.
      wave, wave_length: of long waves, the same.
      step: steps of the depth at 1 m [m].
      slant: power of the inverse cosine of the angle of incidence that noise grows with.
      baseline, widest: how far the second eye or the projector is to the right [m]: what it does not see, at least 4 cm
        behind something nearer, is not measured, at most so many pixels on the nearer's left.
      fattening: how far nearer surfaces reach beyond their edges on average, in pixels.
      mixed: share of the pixels at an edge that measure a mixture of both depths.
      missing: share of pixels that are lost singly.
      grazing, softness: cosine of the angle of incidence at which half of the pixels are lost, and the width of the
        transition.
      poor, poor_shelf: share of things, and of shelves, that are dark or shiny.
      lost: share of the pixels of these that are lost.
      hole: length of the holes that lost pixels make, in pixels.
      mirror: a shiny board shows mirrored points down to so far below it [m].
      colour_shift: how far the colours lie too far to the right, in pixels.
      arm: share of images with a hand before the lower edge.
    """

    scatter: jax.Array | np.ndarray | float = 0.0
    jitter: jax.Array | np.ndarray | float = 0.0
    noise: jax.Array | np.ndarray | float = 0.0
    length: jax.Array | np.ndarray | float = 6.0
    wave: jax.Array | np.ndarray | float = 0.0
    wave_length: jax.Array | np.ndarray | float = 70.0
    step: jax.Array | np.ndarray | float = 0.0
    slant: jax.Array | np.ndarray | float = 0.0
    baseline: jax.Array | np.ndarray | float = 0.0
    widest: jax.Array | np.ndarray | float = 0.0
    fattening: jax.Array | np.ndarray | float = 0.0
    mixed: jax.Array | np.ndarray | float = 0.0
    missing: jax.Array | np.ndarray | float = 0.0
    grazing: jax.Array | np.ndarray | float = -1.0
    softness: jax.Array | np.ndarray | float = 0.03
    poor: jax.Array | np.ndarray | float = 0.0
    poor_shelf: jax.Array | np.ndarray | float = 0.0
    lost: jax.Array | np.ndarray | float = 0.0
    hole: jax.Array | np.ndarray | float = 8.0
    mirror: jax.Array | np.ndarray | float = 0.0
    colour_shift: jax.Array | np.ndarray | float = 0.0
    arm: jax.Array | np.ndarray | float = 0.0

    def __call__(
        self, key: Key[Array, ""], camera: Camera, depth: Float[Array, "h w"], surfaces: Surfaces | None = None
    ) -> Float[Array, "h w 3"]:
        """Measured world points [m], NaN where nothing was measured; see `NoiseModel`.

        Args:
          key: PRNG key.
          camera: the camera; may be traced.
          depth: along the optical axis [m]; infinite where nothing is.
          surfaces: in the image; if None, all are bright and matt.
        """
        number = jax.tree.map(jnp.asarray, self)
        keys = [jax.random.fold_in(key, place) for place in range(3, 12)]
        scale, shape = camera.fx / USUAL_FX, (depth.shape[0], depth.shape[1])
        true, depth = depth, jnp.where(hand(keys[0], camera, shape, number.arm), HAND_DEPTH, depth)
        poor = jnp.zeros(shape, bool)
        if surfaces is not None:
            share = jnp.where(surfaces.shelf, number.poor_shelf, number.poor)
            poor = (surfaces.material > 1.0 - share) & (depth == true)
            below = (depth - surfaces.mirrored) * rays(camera)[..., 2]
            mirrors = poor & jnp.isfinite(surfaces.mirrored) & (below < number.mirror)
            depth = jnp.where(mirrors, surfaces.mirrored, depth)
        cosine = incidence(camera, back_project(camera, depth))
        ragged = 2.0 * jax.scipy.stats.norm.cdf(field(keys[1], camera, shape, number.hole))
        depth = fattened(depth, number.fattening * scale * ragged, number.fattening * scale * 2.0)
        lost = shadows(camera, depth, number.baseline, 0.0, number.widest)
        depth = _mixed(keys[2], depth, number.mixed * scale)
        error = number.jitter * jax.random.normal(keys[3], shape)
        error += number.noise * field(keys[4], camera, shape, number.length)
        error += number.wave * field(keys[5], camera, shape, number.wave_length)
        error *= jnp.maximum(cosine, STEEPEST) ** -number.slant
        finite = jnp.isfinite(depth)
        # Of 1 / z, so that z is exact where there is no error.
        measured = depth / (1.0 + jnp.where(finite, depth * error, 0.0))
        step = jnp.where(finite & (number.step > 0.0), number.step, 1.0)
        stepped = 1.0 / (jnp.maximum(jnp.round(1.0 / (measured * step)), 1.0) * step)
        measured = jnp.where(finite & (number.step > 0.0), stepped, measured)
        kept = jax.nn.sigmoid((cosine - number.grazing) / number.softness) * (1.0 - number.lost * poor)
        holes = field(keys[6], camera, shape, number.hole) > jax.scipy.stats.norm.ppf(kept)
        # Which pixels are lost does not depend on the noise.
        single = jax.random.uniform(jax.random.fold_in(key, 2), shape) < number.missing
        points = scattered(key, back_project(camera, measured), number.scatter)
        return jnp.where((lost | holes | single)[..., None], jnp.nan, points)

    def shifted(self, camera: Camera, colour: Float[Array, "h w 3"]) -> Float[Array, "h w 3"]:
        """A colour image as the sensor registers it to its depth, interpolated between columns."""
        width = colour.shape[1]
        column = jnp.clip(jnp.arange(width) - self.colour_shift * camera.fx / USUAL_FX, 0.0, width - 1.0)
        left = jnp.floor(column).astype(int)
        share = (column - left).reshape(1, -1, 1)
        return (1.0 - share) * colour[:, left] + share * colour[:, jnp.minimum(left + 1, width - 1)]


SENSORS: Mapping[SensorName, Sensor] = MappingProxyType(
    {
        # The paper's noise, as `RandomDirection` has it.
        "ideal": Sensor(scatter=USUAL_NOISE),
        # Like a Kinect of 2010.
        "structured-light": Sensor(
            jitter=0.0011, noise=0.0014, length=6.0, wave=0.0022, wave_length=70.0, step=0.0029,
            baseline=0.055, widest=22.0, fattening=1.5, grazing=0.08, softness=0.02,
            poor=0.08, poor_shelf=0.08, lost=0.3, colour_shift=1.5, arm=0.05,
        ),
        # Like a RealSense before a shelf of metal.
        "active-stereo": Sensor(
            jitter=0.0012, noise=0.0062, length=10.0, wave=0.0042, wave_length=90.0,
            baseline=0.025, widest=22.0, fattening=2.5, missing=0.003, grazing=0.2, softness=0.1,
            poor=0.15, poor_shelf=0.8, lost=0.6, hole=5.0, mirror=0.035, colour_shift=2.0, arm=0.05,
        ),
        # Like `images.noise.TimeOfFlight`, with the waves of light that takes several ways.
        "time-of-flight": Sensor(
            jitter=0.0012, noise=0.0006, length=4.0, wave=0.001, wave_length=70.0, slant=1.0,
            mixed=0.5, missing=0.005, grazing=0.1, softness=0.03,
            poor=0.08, poor_shelf=0.08, lost=0.3, colour_shift=1.0, arm=0.05,
        ),
    }
)  # fmt: skip


def field(
    key: Key[Array, ""], camera: Camera, shape: tuple[int, int], length: jax.Array | float
) -> Float[Array, "h w"]:
    """Normally distributed numbers that neighbours share: exp(-r^2 / (2 length^2)) is their correlation at r pixels.

    A sum of plane waves of random direction and length (A. Rahimi and B. Recht, "Random features", 2007).

    Args:
      key: PRNG key.
      camera: of the image; may be traced.
      shape: of the image.
      length: of the correlation, in pixels.
    """
    phases, turns = jax.random.split(key)
    right, down = jax.random.normal(turns, (2, WAVES)) * USUAL_FX / length
    phase = jax.random.uniform(phases, (WAVES,), maxval=2 * math.pi)
    return math.sqrt(2 / WAVES) * plane_waves(camera, shape, right, down, phase)


def fattened(
    depth: Float[Array, "h w"], reach: Float[Array, "h w"], most: Float[Array, ""] | float
) -> Float[Array, "h w"]:
    """Depth where nearer surfaces reach beyond their edges.

    Args:
      depth: [m].
      reach: by how many pixels.
      most: the largest of these.
    """
    for axis in (0, 1):

        def grow(k, best, axis=axis, depth=depth):
            for by in (k, -k):
                other = _beside(depth, by, axis)
                best = jnp.where((depth - other > EDGE) & (k - 0.5 < reach), jnp.minimum(best, other), best)
            return best

        depth = jax.lax.fori_loop(1, jnp.ceil(jnp.asarray(most)).astype(int) + 1, grow, depth)
    return depth


def hand(key: Key[Array, ""], camera: Camera, shape: tuple[int, int], share: jax.Array | float) -> Bool[Array, "h w"]:
    """Which pixels show a hand, in a share of the images."""
    drawn = jax.random.uniform(key, (3,))
    middle, top = (low + (high - low) * drawn[i] for i, (low, high) in enumerate((HAND_MIDDLE, HAND_TOP)))
    right = (jnp.arange(shape[1]) + 0.5 - camera.cx) / camera.fx
    down = (jnp.arange(shape[0]) + 0.5 - camera.cy) / camera.fy
    return (drawn[2] < share) & (jnp.abs(right - middle) < HAND_WIDTH)[None] & (down > top)[:, None]


def _mixed(key: Key[Array, ""], depth: Float[Array, "h w"], share: Float[Array, ""]) -> Float[Array, "h w"]:
    """Depth of which a share of the pixels at an edge is a mixture with that of the pixel beside it."""
    mixes, blend = jax.random.uniform(key, (2, *depth.shape))
    right, below = _beside(depth, 1, 1), _beside(depth, 1, 0)
    other = jnp.where(jnp.abs(right - depth) > EDGE, right, below)
    at_edge = (jnp.abs(other - depth) > EDGE) & jnp.isfinite(other) & jnp.isfinite(depth) & (mixes < share)
    return jnp.where(at_edge, depth + blend * (other - depth), depth)


def _beside(depth: Float[Array, "h w"], by: Int[Array, ""] | int, axis: int) -> Float[Array, "h w"]:
    """Depth so many pixels further along an axis; infinite beyond the image."""
    place = jnp.arange(depth.shape[axis]) + by
    inside = jnp.expand_dims((place >= 0) & (place < depth.shape[axis]), 1 - axis)
    return jnp.where(inside, jnp.roll(depth, -by, axis=axis), jnp.inf)
