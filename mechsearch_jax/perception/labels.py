"""What the pixels of a labelled image show, where it is not one of the instances 0, 1, 2, ..."""

OTHER = -1
"""Something on the shelf that is not to be recognised: the target, or a point of unknown belonging."""
FREE = -2
"""The shelf itself: there is nothing between it and the camera."""
MISSING = -3
"""Nothing was measured."""

INSTANCES = 9
"""The most instances in an image."""
