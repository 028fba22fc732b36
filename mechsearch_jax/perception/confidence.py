"""How sure each recognised object is.

Three things are measured for each object: how far the recognition network expects the centre to be from the true one,
which share of its pixels does not lie on it or has rays that pass through it, and by how much it is better than what
would stand for its pixels otherwise. A logistic function of their logarithms, fitted on simulated tables and shelves
before four kinds of sensor, gives the probability that the object is right to 1 cm and 10 degrees
(docs/record/experiments.md, "Networks of tables, shelves and sensors").
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.perception.hypotheses import pixels_of
from mechsearch_jax.perception.recognition import LabelledImage
from mechsearch_jax.perception.selection import Costs, Sample, passed, point_cost
from mechsearch_jax.perception.solids import surface_distance
from mechsearch_jax.runtime.pytree import PyTreeNode

# Logarithm of the odds that an object is wrong: a constant, and by how much it grows with each logarithm.
BIAS, PER_ERROR, PER_MISFIT, PER_MARGIN = 7.320, 1.417, 0.155, -0.067
# Expected errors are limited to this range [m]; these shares are the least that count.
ERRORS = (1e-4, 0.02)
LEAST_MISFIT, LEAST_MARGIN = 0.01, 0.01


class Measures(PyTreeNode):
    """What is measured of each object, shape (N,).

    Attributes:
      valid: whether there is an object.
      pixels: number of its pixels in the view.
      misfit: pixels that are badly explained, or whose rays pass through it, over its number of pixels.
      error: how far the network expects the centre to be from the true one [m].
      margin: by how many pixels it is better than another explanation; infinite if nothing else was tried.
    """

    valid: jax.Array
    pixels: jax.Array
    misfit: jax.Array
    error: jax.Array
    margin: jax.Array


def measures_of(
    objects: Superquadrics,
    labels: Int[Array, "h w"],
    image: LabelledImage,
    sample: Sample,
    error: Float[Array, " n"],
    margin: Float[Array, " n"],
    costs: Costs,
) -> Measures:
    """What is measured of the objects of an image.

    Args:
      objects: in N slots.
      labels: the pixels of each object.
      image: its points.
      sample: rays of the image.
      error, margin: see `Measures`.
      costs: what a point or ray costs.
    """
    pixels = pixels_of(labels, objects.capacity)
    member = (labels.reshape(-1)[None] == jnp.arange(objects.capacity)[:, None]) & sample.judged.reshape(1, -1)
    flat = jnp.where(member.any(axis=0)[:, None], image.points.reshape(-1, 3), 0.0)
    badly = jnp.sum(jnp.where(member, point_cost(surface_distance(objects, flat), sample, costs), 0.0), axis=1)
    return Measures(
        valid=objects.valid,
        pixels=pixels,
        misfit=(badly + passed(objects, sample, costs)) / jnp.maximum(pixels, 1),
        error=error,
        margin=margin,
    )


def logarithms(measures: Measures) -> Float[Array, "n 3"]:
    """The logarithms of error, misfit and margin, within their ranges."""
    error = jnp.log(jnp.clip(measures.error, *ERRORS))
    misfit = jnp.log(measures.misfit + LEAST_MISFIT)
    margin = jnp.log(jnp.clip(measures.margin / jnp.maximum(measures.pixels, 1), LEAST_MARGIN, 1.0))
    return jnp.stack([error, misfit, margin], axis=-1)


def confidence_of(measures: Measures) -> Float[Array, " n"]:
    """The probability that each object is right to 1 cm and 10 degrees; 0 for absent ones."""
    odds = BIAS + jnp.sum(logarithms(measures) * jnp.array([PER_ERROR, PER_MISFIT, PER_MARGIN])[None], axis=-1)
    return jnp.where(measures.valid, jax.nn.sigmoid(-odds), 0.0)
