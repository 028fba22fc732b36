"""Mechanical search on cluttered shelves, in JAX."""
