"""The checker that the tests put around every annotated function of the package."""

import typing

from beartype import beartype


def check(function):
    """Check the arguments and results of `function` against its annotations, shapes and element types included.

    Constructors stay unchecked: JAX rebuilds pytrees with whatever stands for their leaves (None, shapes, axes), and
    configurations refuse bad values themselves, with a message of their own.
    """
    if function.__name__ == "__init__":
        return function
    for hint in function.__annotations__.values():
        for part in (hint, *typing.get_args(hint)):
            if getattr(part, "_is_protocol", False):
                typing.runtime_checkable(part)
    return beartype(function)
