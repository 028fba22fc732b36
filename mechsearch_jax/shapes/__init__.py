"""Shapes of bodies, one file for each, their registry, and compounds of several pieces; without JAX."""

from mechsearch_jax.shapes.capsule import Capsule
from mechsearch_jax.shapes.registry import PRIMITIVES, SHAPES, by_shape, in_order, shape_of
from mechsearch_jax.shapes.shape import Shape

__all__ = ["PRIMITIVES", "SHAPES", "Capsule", "Shape", "by_shape", "in_order", "shape_of"]
