"""Checks of the images of a camera."""
