"""Shapes of bodies, one file for each, and their registry; without JAX."""

from mechsearch_jax.shapes.registry import SHAPES, by_shape, in_order, shape_of
from mechsearch_jax.shapes.shape import Shape

__all__ = ["SHAPES", "Shape", "by_shape", "in_order", "shape_of"]
