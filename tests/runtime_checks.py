"""The checker that the tests put around every annotated function of the package."""

from beartype import beartype


def check(function):
    """Check the arguments and results of `function` against its annotations, shapes and element types included.

    Constructors stay unchecked: JAX rebuilds pytrees with whatever stands for their leaves (None, shapes, axes), and
    configurations refuse bad values themselves, with a message of their own.
    """
    return function if function.__name__ == "__init__" else beartype(function)
