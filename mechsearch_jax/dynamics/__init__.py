"""Prediction of what actions do to objects."""
