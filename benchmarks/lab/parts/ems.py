"""A classical recogniser as a baseline: probabilistic superquadric recovery, one segment at a time.

An independent implementation of W. Liu, Y. Wu, S. Ruan and G. Chirikjian, "Robust and accurate superquadric recovery: a
probabilistic approach", CVPR 2022. Points are Gaussian about the surface or uniform outliers. Expectation-maximisation
alternates between the odds of each point and a few steps of weighted least squares in the eleven parameters. Several
superquadrics look alike from few points (with another third axis, or turned by an eighth with another second exponent):
where it converges, it tries these in turn and continues from a better one.

It uses a segment's points alone: no shelf, no rays, no training.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.runtime.errors import InputError

EXPONENTS = (0.05, 2.0)
LEAST_POINTS = 11
# Mean square distance that counts as exact, relative to the square of the scale.
EXACT = 1e-7
# Prior probability that a point is an outlier.
OUTLIERS = 0.2
# Standard deviation of the Gaussian at the start, relative to the segment's scale, the root mean square radius.
SIGMA = 0.3
# Largest number of iterations of expectation-maximisation, over all restarts, and of evaluations of the distances in
# one maximisation; relative change of the cost below which it has converged.
ITERATIONS, EVALUATIONS, TOLERANCE = 40, 4, 1e-3
# Largest number of switches to a similar superquadric.
SWITCHES = 2
# Largest half-extent, relative to that of the points' bounding box; without it, extents that no points bound would grow
# indefinitely.
LARGEST = 2.0


@dataclasses.dataclass(frozen=True, eq=False)
class Recovered:
    """A superquadric in the frame of the points, float64.

    Attributes:
      size: half-extents [m].
      exponents: (e1, e2).
      position: its centre [m].
      rotation: its rotation matrix.
      cost: mean squared radial distance of the points, weighted by the odds that they are no outliers [m2].
      iterations: of expectation-maximisation.
    """

    size: np.ndarray
    exponents: np.ndarray
    position: np.ndarray
    rotation: np.ndarray
    cost: float
    iterations: int


def _norm2(a: np.ndarray, b: np.ndarray, p: float) -> np.ndarray:
    big, small = np.maximum(a, b), np.minimum(a, b)
    ratio = small / np.maximum(big, 1e-300)
    return big * (1.0 + ratio**p) ** (1.0 / p)


def _radial(shape: Recovered, points: np.ndarray) -> np.ndarray:
    """Signed radial distances, positive outside (the paper's equation 6, with its sign)."""
    local = (points - shape.position) @ shape.rotation
    x, y, z = np.abs(local.T) / shape.size[:, None]
    gauge = _norm2(_norm2(x, y, 2.0 / shape.exponents[1]), z, 2.0 / shape.exponents[0])
    return np.linalg.norm(local, axis=1) * (1.0 - 1.0 / np.maximum(gauge, 1e-6))


def _radial_jacobian(shape: Recovered, points: np.ndarray) -> np.ndarray:
    """Derivatives of `_radial` in log half-extents, exponents, centre and a rotation vector in the shape's frame."""
    local = (points - shape.position) @ shape.rotation
    x, y, z = np.maximum(np.abs(local.T) / shape.size[:, None], 1e-9)
    p, r = 2.0 / shape.exponents[1], 2.0 / shape.exponents[0]
    plane = _norm2(x, y, p)
    gauge = np.maximum(_norm2(plane, z, r), 1e-6)
    along = np.minimum(plane / gauge, 1.0) ** (r - 1.0)
    parts = [along * (x / plane) ** (p - 1.0), along * (y / plane) ** (p - 1.0), (z / gauge) ** (r - 1.0)]
    gradient = np.stack(parts, axis=1) * np.sign(local) / shape.size
    radius = np.linalg.norm(local, axis=1)[:, None]
    stretch = radius / gauge[:, None] ** 2
    outward = stretch * gradient + (1.0 - 1.0 / gauge[:, None]) * local / np.maximum(radius, 1e-9)
    step, base = 1e-6, _radial(shape, points)
    bent = [dataclasses.replace(shape, exponents=shape.exponents + step * np.eye(2)[i]) for i in range(2)]
    exponents = np.stack([(_radial(b, points) - base) / step for b in bent], axis=1)
    turning = stretch * np.cross(gradient, local)
    return np.concatenate([-stretch * gradient * local, exponents, -outward @ shape.rotation.T, turning], axis=1)


def _start(points: np.ndarray) -> Recovered:
    """An ellipsoid along the principal axes that spans all but the outermost points."""
    centre = points.mean(axis=0)
    _, axes = np.linalg.eigh(np.cov(points.T))
    axes = axes * np.linalg.det(axes)
    local = (points - centre) @ axes
    low, high = np.percentile(local, (3, 97), axis=0)
    size = np.maximum((high - low) / 2, 0.05)
    return Recovered(size, np.ones(2), centre + axes @ ((low + high) / 2), axes, np.inf, 0)


def _maximise(shape: Recovered, points: np.ndarray, weight: np.ndarray, limit: float, evaluations: int) -> Recovered:
    """A few steps of weighted least squares in half-extents, exponents, centre and rotation."""
    root = np.sqrt(weight)

    def unpacked(x):
        turn = Rotation.from_rotvec(x[8:]).as_matrix()
        return dataclasses.replace(
            shape, size=np.exp(x[:3]), exponents=x[3:5], position=x[5:8], rotation=shape.rotation @ turn
        )

    low = [np.log(0.02)] * 3 + [EXPONENTS[0]] * 2 + [-np.inf] * 6
    high = [np.log(limit)] * 3 + [EXPONENTS[1]] * 2 + [np.inf] * 6
    x = np.concatenate([np.log(shape.size), shape.exponents, shape.position, np.zeros(3)])
    x = np.clip(x, np.array(low) + 1e-9, np.array(high) - 1e-9)
    # The derivative of the rotation vector is exact at zero; those of a few steps are small.
    result = least_squares(
        lambda x: root * _radial(unpacked(x), points),
        x,
        lambda x: root[:, None] * _radial_jacobian(unpacked(x), points),  # pyright: ignore[reportArgumentType]
        bounds=(low, high),
        x_scale=0.1,
        max_nfev=evaluations,
    )
    return unpacked(result.x)


def _similar(shape: Recovered) -> Iterator[Recovered]:
    """Similar superquadrics: with another third axis, and turned by an eighth in the plane."""
    size, (e1, e2) = shape.size, shape.exponents
    for order in ((1, 2, 0), (2, 0, 1)):
        yield dataclasses.replace(
            shape, size=size[list(order)], exponents=np.array([e2, e1]), rotation=shape.rotation[:, list(order)]
        )
    turned = shape.rotation @ Rotation.from_euler("z", 45, degrees=True).as_matrix()
    mean = (size[0] + size[1]) / 2
    # A turn by an eighth maps the square |x| + |y| = 1 to max(|x|, |y|) = 1 and vice versa, with a scaled half-extent.
    side = mean * ((1 - 2**0.5) * e2 + 2**0.5)
    yield dataclasses.replace(
        shape, size=np.array([side, side, size[2]]), exponents=np.array([e1, 2.0 - e2]), rotation=turned
    )


def _expect(shape: Recovered, points: np.ndarray, sigma: float, volume: float, outliers: float):
    """Odds that each point belongs to the surface, and the weighted mean square of the distances."""
    square = _radial(shape, points) ** 2
    inlier = (1.0 - outliers) * np.exp(-square / (2 * sigma**2)) / (np.sqrt(2 * np.pi) * sigma) ** 3
    odds = inlier / (inlier + outliers / volume + 1e-300)
    total = odds.sum()
    return odds, (float((odds * square).sum() / total) if total > 1e-9 else float(square.mean()))


def recover(points: Float[np.ndarray, "n 3"]) -> Recovered:
    """The superquadric of a segment's points.

    Args:
      points: at least 11, not collinear [m].

    Raises:
      InputError: there are too few points, or a point is not finite.
    """
    points = np.asarray(points, float)
    if len(points) < LEAST_POINTS or not np.isfinite(points).all():
        raise InputError(f"recover: {len(points)} points; at least {LEAST_POINTS} finite ones are needed")
    middle = points.mean(axis=0)
    scale = float(np.sqrt(np.mean(np.sum((points - middle) ** 2, axis=1)))) or 1.0
    points = (points - middle) / scale
    extent = np.ptp(points, axis=0)
    volume, limit = float(np.prod(np.maximum(extent, 0.1))), LARGEST * float(extent.max()) / 2

    def climb(shape: Recovered, sigma: float, budget: int) -> tuple[Recovered, float]:
        for _ in range(budget):
            odds, _ = _expect(shape, points, sigma, volume, OUTLIERS)
            moved = _maximise(shape, points, odds, limit, EVALUATIONS)
            _, cost = _expect(moved, points, sigma, volume, OUTLIERS)
            settled = abs(shape.cost - cost) < TOLERANCE * cost or cost < EXACT
            shape = dataclasses.replace(moved, cost=cost, iterations=shape.iterations + 1)
            sigma = max(np.sqrt(cost / 3.0), 1e-3)
            if settled:
                break
        return shape, sigma

    shape, sigma = climb(_start(points), SIGMA, ITERATIONS)
    for _ in range(SWITCHES):
        budget = max(ITERATIONS - shape.iterations, 3)
        # A similar shape is compared by what it becomes after the same number of steps.
        climbed = [climb(dataclasses.replace(s, cost=np.inf), 3 * sigma, budget) for s in _similar(shape)]
        best, best_sigma = min(climbed, key=lambda pair: _score(pair[0], points, sigma, volume))
        if _score(best, points, sigma, volume) >= _score(shape, points, sigma, volume):
            break
        shape, sigma = best, best_sigma
    return dataclasses.replace(
        shape, size=shape.size * scale, position=middle + shape.position * scale, cost=shape.cost * scale**2
    )


def _score(shape: Recovered, points: np.ndarray, sigma: float, volume: float) -> float:
    """Negative mean log-likelihood of the points at a common sigma."""
    square = _radial(shape, points) ** 2
    inlier = (1.0 - OUTLIERS) * np.exp(-square / (2 * sigma**2)) / (np.sqrt(2 * np.pi) * sigma) ** 3
    return -float(np.mean(np.log(inlier + OUTLIERS / volume + 1e-300)))


def recover_scene(points: Float[np.ndarray, "p 3"], labels: Int[np.ndarray, " p"], capacity: int) -> Superquadrics:
    """Superquadrics of all segments of a cloud, in the slots of their labels; absent with too few points."""
    segments = [points[(labels == k) & np.isfinite(points).all(axis=1)] for k in range(capacity)]
    shapes = [recover(segment) if len(segment) >= LEAST_POINTS else None for segment in segments]
    absent = Recovered(np.full(3, 1e-3), np.ones(2), np.zeros(3), np.eye(3), np.inf, 0)
    filled = [shape or absent for shape in shapes]
    size, exponents, position, rotation = (
        jnp.asarray(np.stack([getattr(shape, field) for shape in filled]), jnp.float32)
        for field in ("size", "exponents", "position", "rotation")
    )
    return Superquadrics(size, exponents, position, rotation, valid=jnp.array([shape is not None for shape in shapes]))
