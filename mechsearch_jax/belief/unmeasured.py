"""Where something that has no depth may stand on the shelf.

A place is free if it was seen to be. Behind recognised bodies nothing but the target is expected, as in f: an
approximation. In front of them, a place whose pixels were not measured may hold anything.
"""

from __future__ import annotations

import itertools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mechsearch_jax.actions.unseen_space import BORDER
from mechsearch_jax.problem.problem import Problem
from mechsearch_jax.workspace.camera import project

# The least thing that may stand somewhere: its half-width, and the height of a layer and how many layers it has [m].
HALF_WIDTH, LAYER, LAYERS = 0.01, 0.02, 3
# Share of its rays without depth from which on a place may be filled. A dark board loses 60%; less than all, since a
# thing 2 cm wide covers few pixels whole: half of those up to 4 cm wide are not noticed.
FILLED = 0.7
# Height up to which things are expected [m].
TALLEST = 0.3


def unmeasured_heights(
    problem: Problem, measured: Float[Array, "h w"], image: Float[Array, "h w"]
) -> Float[Array, "rows columns"]:
    """The height up to which each cell of `PossibleSpace` may be filled by a thing without depth [m]; -inf if by none.

    Args:
      problem: the constants.
      measured: share of each pixel of f's image that was measured.
      image: the depth image of the recognised bodies in it [m].
    """
    config, camera, board = problem.config.existence, problem.camera, problem.shelf.board
    coarse = camera.scaled(config.step(camera))
    layers = round(TALLEST / LAYER)
    corners = np.array([(0.0, 0.0), *itertools.product((-HALF_WIDTH, HALF_WIDTH), repeat=2)], np.float32)
    rows, columns = (size + 2 * BORDER for size in problem.target.grid)
    first = problem.poses[0, :2] - BORDER * problem.cell
    x, y = (first[a] + problem.cell[a] * jnp.arange(n) for a, n in enumerate((rows, columns)))
    z = board + LAYER * (jnp.arange(layers) + 0.5)
    shape = (rows, columns, layers, len(corners))
    points = jnp.stack(
        [
            jnp.broadcast_to(x[:, None, None, None] + corners[:, 0].reshape(1, 1, 1, -1), shape),
            jnp.broadcast_to(y[None, :, None, None] + corners[:, 1].reshape(1, 1, 1, -1), shape),
            jnp.broadcast_to(z[None, None, :, None], shape),
        ],
        axis=-1,
    )
    pixels, depth = project(coarse, points)
    pixel = jnp.round(pixels).astype(jnp.int32)
    row, column = (jnp.clip(pixel[..., i], 0, size - 1) for i, size in enumerate((coarse.height, coarse.width)))
    in_image = (row == pixel[..., 0]) & (column == pixel[..., 1]) & (depth > 0.0)
    in_front = depth < image[row, column]
    missing = in_front * (1.0 - jnp.where(in_image, measured[row, column], 0.0))
    of_layers = jnp.mean(missing, axis=-1)
    filled = of_layers > FILLED
    some = jnp.mean(of_layers[..., :LAYERS], axis=-1) > FILLED
    number = LAYERS + jnp.sum(jnp.cumprod(filled[..., LAYERS:], axis=-1), axis=-1)
    shelf = problem.shelf
    on_board = ((x > shelf.front) & (x < shelf.back))[:, None] & ((y > shelf.right) & (y < shelf.left))[None]
    return jnp.where(some & on_board, board + LAYER * number, -jnp.inf)
