"""From images to what the planner plans with.

The way of a depth image: `recogniser` (the front door) -> `cloud` (the shelf's part of it, as points) -> `segmentation`
(labels, as `labels` has them) -> `segments` -> `recognition` -> `refinement` -> `target_pose` -> `Observation`. Images
of a real camera, with the robot in view, first pass through `real_camera`. `noise` and `scores` serve training and
measurements.
"""
