"""Flat patches of a depth image: small blocks of pixels, each with a point and a normal.

Of a plane, the inverse of the depth is linear in the coordinates of a pixel: a patch is one linear least-squares fit,
which averages the noise of its pixels, without those far from a plane through medians (P. Rousseeuw and A. Leroy,
"Robust regression and outlier detection", 1987): one pixel that is metres off would spoil its whole block. Blocks
across an edge or on a curved surface are not flat, and are left out.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mechsearch_jax.workspace.camera import Camera, measured

# Side of a block in pixels of the thinned image.
SIDE = 8
# Least share of a block's pixels with a depth.
LEAST_MEASURED = 0.2
# A pixel counts that is off by at most so many standard deviations of its block, by their median, and this [m]; at
# least this share of a block's measured pixels must count.
NEAR, LEAST_NEAR, LEAST_COUNTED = 4.0, 0.0005, 0.75
# A block is flat if its depth deviates from a plane by at most so many times the median of all blocks, and this [m].
FLATNESS, LEAST_DEVIATION = 2.0, 0.0005


class Patches(NamedTuple):
    """N flat patches in the camera's frame.

    Attributes:
      point: the middle of each, on its plane [m].
      normal: unit vectors towards the camera.
      pixels: how many of the image's pixels each stands for.
    """

    point: Float[np.ndarray, "n 3"]
    normal: Float[np.ndarray, "n 3"]
    pixels: Float[np.ndarray, " n"]


def flat_patches(camera: Camera, depth: Float[np.ndarray, "h w"], most: int) -> Patches:
    """The flat patches of a depth image.

    Args:
      camera: of the image.
      depth: along the camera's axis [m].
      most: the image is thinned to at most about so many pixels.
    """
    stride = max(1, round(math.sqrt(depth.size / most)))
    thin = np.asarray(depth[::stride, ::stride])
    rows, columns = (size // SIDE for size in thin.shape)
    blocks = thin[: rows * SIDE, : columns * SIDE].reshape(rows, SIDE, columns, SIDE).swapaxes(1, 2)
    blocks = blocks.reshape(rows * columns, SIDE**2)
    is_measured = np.isfinite(blocks) & measured(blocks)
    enough = is_measured.sum(axis=1) >= max(LEAST_MEASURED * SIDE**2, 4)
    blocks, is_measured = blocks[enough], is_measured[enough]
    # The middle of each block in the image, at unit depth.
    place = (np.arange(rows), np.arange(columns))
    down, across = ((p * SIDE + (SIDE - 1) / 2.0) * stride + 0.5 for p in place)
    down, across = np.meshgrid((down - camera.cy) / camera.fy, (across - camera.cx) / camera.fx, indexing="ij")
    middle = np.stack([across.ravel(), down.ravel()], axis=1)[enough]
    # The pixels of all blocks lie alike around their middles.
    offset = (np.arange(SIDE) - (SIDE - 1) / 2.0) * stride
    v, u = np.meshgrid(offset / camera.fy, offset / camera.fx, indexing="ij")
    basis = np.stack([u.ravel(), v.ravel(), np.ones(SIDE**2)], axis=1)
    inverse = np.where(is_measured, 1.0 / np.where(is_measured, blocks, 1.0), np.nan)
    slopes = _plane_of_medians(inverse, v, u)
    off = np.abs(inverse - slopes @ basis.T) / np.maximum(slopes[:, 2:], 1e-6) ** 2
    counted = off <= NEAR * 1.4826 * _median(off) + LEAST_NEAR
    enough = counted.sum(axis=1) >= LEAST_COUNTED * is_measured.sum(axis=1)
    weight, inverse = counted.astype(float), np.where(counted, inverse, 0.0)
    products = (basis[:, :, None] * basis[:, None, :]).reshape(SIDE**2, 9)
    matrix, right = (weight @ products).reshape(-1, 3, 3), inverse @ basis
    # A block whose pixels lie on a line has no plane.
    solid = enough & (np.linalg.cond(matrix * np.outer(*[1.0 / np.sqrt(np.diag(basis.T @ basis))] * 2)) < 1e4)
    slopes = np.zeros_like(right)
    slopes[solid] = np.linalg.solve(matrix[solid], right[solid][..., None])[..., 0]
    return _flat(middle, slopes, inverse, weight, basis, solid, stride)


def _median(values: Float[np.ndarray, "n p"]) -> Float[np.ndarray, "n 1"]:
    """The lower median of each row's finite values; NaN without any."""
    middle = np.maximum(np.isfinite(values).sum(axis=1, keepdims=True) - 1, 0) // 2
    # NaN is sorted last.
    return np.take_along_axis(np.sort(values, axis=1), middle, axis=1)


def _plane_of_medians(
    inverse: Float[np.ndarray, "n p"], v: Float[np.ndarray, "s s"], u: Float[np.ndarray, "s s"]
) -> Float[np.ndarray, "n 3"]:
    """Slopes of blocks' inverse depths along u and v, and those at their middles, by the medians of differences.

    Args:
      inverse: depth of the pixels, NaN where not measured.
      v, u: of the pixels at unit depth.
    """
    square = inverse.reshape(-1, SIDE, SIDE)

    def slope(along: Float[np.ndarray, "n s s"], at: Float[np.ndarray, " s"]) -> Float[np.ndarray, "n 1"]:
        # Two distances, for a sensor may measure every second or third row or column only.
        parts = [(along[:, by:] - along[:, :-by]) / (at[by] - at[0]) for by in (SIDE // 2 - 1, SIDE // 2)]
        return np.nan_to_num(_median(np.concatenate(parts, axis=1).reshape(len(along), (SIDE + 1) * SIDE)))

    across, down = slope(square.swapaxes(1, 2), u[0]), slope(square, v[:, 0])
    return np.hstack([across, down, _median(inverse - across * u.ravel() - down * v.ravel())])


def _flat(
    middle: np.ndarray,
    slopes: np.ndarray,
    inverse: np.ndarray,
    weight: np.ndarray,
    basis: np.ndarray,
    solid: np.ndarray,
    stride: int,
) -> Patches:
    """The blocks that are flat.

    Args:
      middle: of each block at unit depth, shape (n, 2).
      slopes: of its inverse depth, and that at its middle, shape (n, 3).
      inverse: its pixels' inverse depths, 0 where not measured, shape (n, p).
      weight: 1 where measured, else 0, shape (n, p).
      basis: offset of each pixel from the middle at unit depth, and 1, shape (p, 3).
      solid: which blocks have a plane, shape (n,).
      stride: thinning of the image.
    """
    count = weight.sum(axis=1)
    centre = weight @ basis[:, :2] / np.maximum(count, 1)[:, None]
    at_centre = np.sum(slopes[:, :2] * centre, axis=1) + slopes[:, 2]
    solid = solid & (at_centre > 1e-3)
    safe = np.where(solid, at_centre, 1.0)
    residual = weight * (inverse - slopes @ basis.T)
    deviation = np.sqrt(np.sum(residual**2, axis=1) / np.maximum(count - 3, 1)) / safe**2
    usual = float(np.median(deviation[solid])) if solid.any() else 0.0
    flat = solid & (deviation <= FLATNESS * usual + LEAST_DEVIATION)
    ray = np.concatenate([middle + centre, np.ones((len(middle), 1))], axis=1)
    normal = np.concatenate([slopes[:, :2], (slopes[:, 2] - np.sum(slopes[:, :2] * middle, axis=1))[:, None]], axis=1)
    # It points away from the camera, for its product with a point is 1.
    normal = -normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return Patches((ray / safe[:, None])[flat], normal[flat], stride**2 * count[flat])
