"""Labels of pixels, for users' masks and for our own labels.

A pixel of an instance holds the instance's number, 0 to `INSTANCES - 1`; every other pixel one of the numbers below.
"""

OTHER = -1
"""Something that is not to be recognised: the target, the robot, or an unassigned point."""
FREE = -2
"""The shelf, with nothing between it and the camera."""
MISSING = -3
"""Nothing was measured."""

INSTANCES = 9
"""The most instances in an image: eight objects and the target."""
