"""Shapes and motions of rigid bodies, with no knowledge of a robot or a shelf."""
