"""Noise models of depth cameras."""

from __future__ import annotations

import dataclasses
from typing import Protocol

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.camera import Camera, back_project, project


class NoiseModel(Protocol):
    """Simulates a sensor's image of points from the true depth."""

    def __call__(self, key: Key[Array, ""], camera: Camera, depth: Float[Array, "h w"]) -> Float[Array, "h w 3"]:
        """Measured world points [m], NaN where nothing was measured.

        Args:
          key: PRNG key.
          camera: the camera; may be traced.
          depth: along the optical axis [m]; infinite where nothing is.
        """
        ...


def no_noise(key: Key[Array, ""], camera: Camera, depth: Float[Array, "h w"]) -> Float[Array, "h w 3"]:
    """The `NoiseModel` of a perfect sensor."""
    return back_project(camera, depth)


def depth_of(camera: Camera, points: Float[Array, "h w 3"]) -> Float[Array, "h w"]:
    """The depth of the measured points of a `NoiseModel` [m]; NaN where nothing was measured."""
    finite: Bool[Array, "h w"] = jnp.isfinite(points).all(axis=-1)
    _, measured = project(camera, jnp.where(finite[..., None], points, 0.0))
    return jnp.where(finite, measured, jnp.nan)


def measured_depth(camera: Camera, depth: Float[Array, "h w"], points: Float[Array, "h w 3"]) -> Float[Array, "h w"]:
    """The depth of the measured points of a `NoiseModel` [m]; without a measurement infinite if nothing is there, else
    NaN.

    Args:
      camera: of the image.
      depth: the true one [m]; infinite where nothing is.
      points: measured for it.
    """
    measured = depth_of(camera, points)
    return jnp.where(jnp.isnan(measured) & ~jnp.isfinite(depth), jnp.inf, measured)


def scattered(
    key: Key[Array, ""], points: Float[Array, "h w 3"], deviation: float | Float[Array, ""]
) -> Float[Array, "h w 3"]:
    """Points moved along random directions by Gaussian distances with a standard deviation [m]."""
    towards, along = jax.random.split(key)
    direction = jax.random.normal(towards, points.shape)
    direction = direction / jnp.maximum(jnp.linalg.norm(direction, axis=-1, keepdims=True), 1e-9)
    return points + deviation * jax.random.normal(along, points.shape[:-1])[..., None] * direction


@dataclasses.dataclass(frozen=True)
class RandomDirection:
    """The paper's noise: each point moves along a random direction by a Gaussian distance (appendix B.1).

    Attributes:
      deviation: standard deviation of the distance [m].
    """

    deviation: float = 0.001

    def __post_init__(self):
        if not self.deviation >= 0:
            raise InputError(f"RandomDirection: deviation {self.deviation} must be at least 0 m")

    def __call__(self, key: Key[Array, ""], camera: Camera, depth: Float[Array, "h w"]) -> Float[Array, "h w 3"]:
        return scattered(key, back_project(camera, depth), self.deviation)


@dataclasses.dataclass(frozen=True)
class TimeOfFlight:
    """Noise like that of a time-of-flight camera.

    Depth is noisier the farther and the more slanted a surface is; surfaces at a grazing angle may return nothing; a
    pixel across an edge may measure a mixture of both depths. The model is phenomenological: it has these three effects
    at the size that such cameras show, but does not describe a particular one.

    Attributes:
      deviation: standard deviation of the depth at 1 m of a surface seen face on [m]; it grows with the square of the
        depth and with the inverse of the cosine of the angle of incidence, which is at least 0.2 here.
      grazing: cosine of the angle of incidence at which half of the returns are missing.
      softness: width of the transition, in units of that cosine.
      missing: share of missing returns everywhere.
      mixed: share of the pixels at an edge that measure a mixture.
      edge: difference in depth between neighbouring pixels that makes an edge [m].
    """

    deviation: float = 0.0015
    grazing: float = 0.1
    softness: float = 0.03
    missing: float = 0.005
    mixed: float = 0.5
    edge: float = 0.01

    def __post_init__(self):
        if min(self.deviation, self.missing, self.mixed) < 0 or max(self.missing, self.mixed) > 1:
            raise InputError("TimeOfFlight: deviation must be at least 0 m, missing and mixed between 0 and 1")
        if self.softness <= 0 or self.edge <= 0:
            raise InputError("TimeOfFlight: softness and edge must be positive")

    def __call__(self, key: Key[Array, ""], camera: Camera, depth: Float[Array, "h w"]) -> Float[Array, "h w 3"]:
        mix, blend, noise, lost = jax.random.split(key, 4)
        points = back_project(camera, depth)
        cosine = incidence(camera, points)
        right, below = jnp.roll(depth, -1, axis=1), jnp.roll(depth, -1, axis=0)
        other = jnp.where(jnp.abs(right - depth) > self.edge, right, below)
        at_edge = (jnp.abs(other - depth) > self.edge) & jnp.isfinite(other) & jnp.isfinite(depth)
        mixes = at_edge & (jax.random.uniform(mix, depth.shape) < self.mixed)
        share = jax.random.uniform(blend, depth.shape)
        mean = jnp.where(mixes, depth + share * (jnp.where(at_edge, other, depth) - depth), depth)
        deviation = self.deviation * mean**2 / jnp.maximum(cosine, 0.2)
        measured = mean + jnp.where(jnp.isfinite(mean), deviation, 0.0) * jax.random.normal(noise, depth.shape)
        returns = jax.nn.sigmoid((cosine - self.grazing) / self.softness)
        kept = jax.random.uniform(lost, depth.shape) < returns * (1.0 - self.missing)
        return back_project(camera, jnp.where(kept, measured, jnp.nan))


def incidence(camera: Camera, points: Float[Array, "h w 3"]) -> Float[Array, "h w"]:
    """Cosine of the angle between each pixel's ray and the normal of the surface through its neighbours.

    The neighbours to the right and below give one normal, those to the left and above another; the larger cosine
    counts, because the other pair may lie across an edge. 1 if neither pair is measured.
    """
    # Otherwise XLA recomputes the points for each neighbour, in one very large GPU kernel.
    points = jax.lax.optimization_barrier(points)
    ray = points - jnp.array(camera.position).reshape(1, 1, 3)

    def cosine(side):
        across, down = (jnp.roll(points, side, axis=axis) - points for axis in (1, 0))
        normal = jnp.cross(across, down)
        lengths = jnp.linalg.norm(normal, axis=-1) * jnp.linalg.norm(ray, axis=-1)
        defined = jnp.isfinite(lengths) & (lengths > 0)
        return jnp.where(defined, jnp.abs(jnp.sum(normal * ray, axis=-1)) / jnp.where(defined, lengths, 1.0), -1.0)

    best = jnp.maximum(cosine(-1), cosine(1))
    return jnp.where(best < 0, 1.0, best)
