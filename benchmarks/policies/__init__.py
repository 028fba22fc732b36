"""Policies to compare with that are examples of one of your own: each fills the engine's slots (docs/extend.md)."""
