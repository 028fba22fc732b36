"""What the pixels of a labelled image show: one convention, for masks that come in and for labels that are made here.

A pixel of an instance holds the instance's number, 0 to `INSTANCES - 1`; every other pixel one of the numbers below.
"""

OTHER = -1
"""Something that is not to be recognised: the target, the robot, or a point of unknown belonging."""
FREE = -2
"""The shelf itself: there is nothing between it and the camera."""
MISSING = -3
"""Nothing was measured."""

INSTANCES = 9
"""The most instances in an image: eight objects and the target."""
