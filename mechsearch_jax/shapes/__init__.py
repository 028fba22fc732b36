"""Shapes of bodies, their registries, and compounds of several pieces; without JAX."""

from mechsearch_jax.shapes.primitives import PRIMITIVES, SHAPES, Capsule, Shape, by_shape, in_order, shape_of

__all__ = ["PRIMITIVES", "SHAPES", "Capsule", "Shape", "by_shape", "in_order", "shape_of"]
