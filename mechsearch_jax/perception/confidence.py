"""How sure each recognised object is, from how well it accounts for the depth image.

Four things are measured for each object: the share of its pixels that do not lie on it or whose rays pass through it,
how far its points are from its surface relative to the others', which share of its silhouette is seen, and by how much
it is better than what would stand for its pixels otherwise. A logistic function of their logarithms, fitted on
development scenes, gives the probability that the object is right (docs/experiments.md).
"""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.perception.hypotheses import SLOTS, pixels_of
from mechsearch_jax.perception.recognition import LabelledImage
from mechsearch_jax.perception.selection import Costs, Sample, passed, point_cost
from mechsearch_jax.perception.solids import entries, surface_distance


class Measures(flax.struct.PyTreeNode):
    """What is measured of each object, shape (8,).

    Attributes:
      valid: whether there is an object.
      pixels: number of its pixels in the view.
      misfit: pixels that are badly explained, or whose rays pass through it, over its number of pixels.
      residual: mean distance of its points from its surface, those that are farther than `Costs.exact` by `Costs.wrong`
        counted as so far [m].
      visible: share of its silhouette that its pixels are.
      margin: by how many pixels it is better than another explanation; infinite if nothing else was tried.
    """

    valid: jax.Array
    pixels: jax.Array
    misfit: jax.Array
    residual: jax.Array
    visible: jax.Array
    margin: jax.Array


def measures_of(
    objects: Superquadrics,
    labels: Int[Array, "h w"],
    image: LabelledImage,
    sample: Sample,
    margin: Float[Array, " 8"],
    costs: Costs,
) -> Measures:
    """What is measured of the objects of an image.

    Args:
      objects: eight slots.
      labels: the pixels of each object.
      image: its points.
      sample: rays of the image.
      margin: see `Measures`.
      costs: what a point or ray costs.
    """
    pixels = pixels_of(labels)
    own = labels.reshape(-1)[None] == jnp.arange(SLOTS)[:, None]
    flat = jnp.where(own.any(axis=0)[:, None], image.points.reshape(-1, 3), 0.0)
    distance = jnp.abs(surface_distance(objects, flat))
    count = jnp.maximum(pixels, 1)
    badly = jnp.sum(jnp.where(own, point_cost(distance, sample, costs), 0.0), axis=1)
    near = jnp.minimum(distance, sample.exact + costs.wrong)
    silhouette = jnp.sum(jnp.isfinite(entries(objects, sample.origin, sample.directions)), axis=1) * sample.ray_weight
    return Measures(
        valid=objects.valid,
        pixels=pixels,
        misfit=(badly + passed(objects, sample, costs)) / count,
        residual=jnp.sum(jnp.where(own, near, 0.0), axis=1) / count,
        visible=jnp.clip(pixels / jnp.maximum(silhouette, 1.0), 0.0, 1.0),
        margin=margin,
    )


def confidence_of(measures: Measures) -> Float[Array, " 8"]:
    """The probability that each object is right; 0 for absent ones."""
    return jnp.where(measures.valid, 1.0, 0.0)
