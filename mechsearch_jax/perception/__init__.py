"""Perception: from images to observations.

A depth image passes `recogniser` (the entry point) -> `cloud` (points of the shelf's part of the image) ->
`segmentation` (labels as in `labels`) -> `segments` -> `recognition` -> `refinement` -> `target_pose` -> `Observation`.
Images of a real camera, with the robot in view, are first prepared by `real_camera`. `noise` and `scores` are for
training and benchmarks.
"""
