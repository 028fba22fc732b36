"""Labels of pixels, for users' masks and for our own labels.

A pixel of an instance holds the instance's number, from 0; every other pixel one of the numbers below.
"""

from mechsearch_jax.runtime.errors import InputError

OTHER = -1
"""Something that is not to be recognised: the target, the robot, or an unassigned point."""
FREE = -2
"""The shelf, with nothing between it and the camera."""
MISSING = -3
"""Nothing was measured."""

CAPACITY, MOST = 8, 16
"""The number of objects that recognition can hold if nothing else is said, and the largest that can be said. A mask may
name the target beside them."""

INSTANCES = 9
"""The instances that the segmentation network tells apart."""


def more_room(capacity: int) -> str:
    """The end of a message that there are too many objects: how to make room for more."""
    return "" if capacity == MOST else f"; for more things, set capacity, now {capacity}, to up to {MOST}"


def check_capacity(capacity: int, where: str = "capacity") -> None:
    """Check a number of objects that recognition can hold.

    Raises:
      InputError: it is no whole number from 1 to `MOST`.
    """
    if type(capacity) is not int or not 1 <= capacity <= MOST:
        raise InputError(
            f"{where}: {capacity!r} must be a whole number of objects, 1 to {MOST}; the default is {CAPACITY}"
        )
