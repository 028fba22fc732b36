"""Which part of a depth image was measured: only a pixel that was says what is not there.

Black, shiny and transparent things, shadows of a stereo camera and mirrors have no depth: what is there is not known.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.images.cloud import View
from mechsearch_jax.runtime.compiled import cached_jit
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.camera import Camera, measured
from mechsearch_jax.workspace.detector import longer

# How much coarser than an image of 1280 x 720 shares are counted; with other images scaled like f's own image.
DOWNSCALE = 7
# Pixels of which less than this share was measured count as not measured. A few rays tell that nothing stands there,
# before a dark board that loses most of them, too; not fewer, since edges of things without depth cross pixels.
LEAST = 0.2


def share_step(camera: Camera) -> int:
    """Side of the blocks of pixels in which `measured_share` counts, in pixels of a camera's image."""
    return max(round(DOWNSCALE * longer(camera)), 1)


@cached_jit()
def measured_share(camera: Camera, view: View, depth: Float[Array, "h w"]) -> Float[Array, "rows columns"]:
    """The share of the pixels of each block of a camera's image that was measured, from a view of the image.

    Blocks in which the view has no ray take the nearest ray's. The size is that of `camera.scaled(share_step(camera))`.

    Args:
      camera: of the full image.
      view: the rays of it that `depth` has.
      depth: along the camera's z [m]; see `camera.measured`.
    """
    step = share_step(camera)
    there = measured(depth).astype(jnp.float32)
    rows, columns = camera.height // step, camera.width // step
    at_rows, near_rows = _blocks(rows, step, view.row, view.stride, depth.shape[0])
    at_columns, near_columns = _blocks(columns, step, view.column, view.stride, depth.shape[1])
    seen = jnp.matmul(jnp.matmul(at_rows, there, precision="highest"), at_columns.T, precision="highest")
    count = jnp.sum(at_rows, axis=1)[:, None] * jnp.sum(at_columns, axis=1)[None]
    return jnp.where(count > 0.0, seen / jnp.maximum(count, 1.0), there[near_rows][:, near_columns])


def _blocks(
    count: int, step: int, first: int | Int[Array, ""], stride: int | Int[Array, ""], rays: int
) -> tuple[Float[Array, "count rays"], Int[Array, " count"]]:
    """Which of the rays along an axis lie in each block, as ones, and the ray nearest to each block's middle."""
    block = (first + stride * jnp.arange(rays)) // step
    members = (block[None] == jnp.arange(count)[:, None]).astype(jnp.float32)
    middle = jnp.arange(count) * step + step // 2
    return members, jnp.clip((middle - first + stride // 2) // stride, 0, rays - 1)


def sampled(camera: Camera, share: Float[Array, "h w"], step: int) -> Float[Array, "rows columns"]:
    """`measured_share` at the resolution of `camera.scaled(step)`: that of the block around each pixel's middle."""
    own = share_step(camera)
    if step == own:
        return share
    rows, columns = (
        jnp.minimum((jnp.arange(size // step) * step + step // 2) // own, blocks - 1)
        for size, blocks in zip((camera.height, camera.width), share.shape, strict=True)
    )
    return share[rows][:, columns]


def veiled(image: Float[Array, "h w"], share: Float[Array, "h w"] | None) -> Float[Array, "h w"]:
    """A depth image in which pixels that were hardly measured hide whatever is there, as if by a thing at the lens.

    Args:
      image: of the recognised bodies [m].
      share: as `sampled` at the image's resolution; None where everything was measured.
    """
    return image if share is None else jnp.where(unmeasured(share), 0.0, image)


def beside(share: Float[Array, "h w"]) -> Float[Array, "h w"]:
    """The least share that was measured of each pixel and of the four next to it."""
    padded = jnp.pad(share, 1, constant_values=1.0)
    across = jnp.minimum(padded[1:-1, :-2], padded[1:-1, 2:])
    along = jnp.minimum(padded[:-2, 1:-1], padded[2:, 1:-1])
    return jnp.minimum(share, jnp.minimum(across, along))


def unmeasured(share: Float[Array, "*shape"]) -> Bool[Array, "*shape"]:
    """Which pixels were hardly measured."""
    return share < LEAST


def median_depth(frames: Sequence[Float[np.ndarray, "h w"]]) -> Float[np.ndarray, "h w"]:
    """One depth image of several frames of the same view: each pixel's median, 0 where fewer than half measured it.

    Of an even number it is the nearer of the two in the middle, so that no depth between two surfaces arises.

    Args:
      frames: at least one, along the camera's z [m]; what counts as measured is in `camera.measured`.

    Raises:
      InputError: their sizes differ.
    """
    sizes = list(dict.fromkeys(frame.shape for frame in frames))
    if len(sizes) > 1:
        raise InputError(f"depth images: frames of one look must have the same size, not {sizes[0]} and {sizes[1]}")
    stack = np.stack(frames).astype(np.float32)
    stack = np.sort(np.where(measured(stack), stack, np.float32(np.nan)), axis=0)
    count = np.sum(~np.isnan(stack), axis=0, keepdims=True)
    middle = np.take_along_axis(stack, np.maximum(count - 1, 0) // 2, axis=0)
    return np.where(2 * count >= len(frames), middle, np.float32(0.0))[0]
