"""Grasps of the target: which there are, what each would hit, and how to take a found target out."""
