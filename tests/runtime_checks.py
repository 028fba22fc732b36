"""The checks that the tests put around every annotated function of the package: types, shapes and element types.

jaxtyping's import hook decorates every function and class as it is imported. Most of them are never called in a
process, and most of the others have no array among their annotations. So a check is made when its function is first
called, and shapes are compared only where there are some.
"""

import functools
import inspect
import types
import typing

import jaxtyping
from beartype import beartype


def install(package):
    """Check the functions of `package`, which is not imported yet."""
    shaped = jaxtyping.jaxtyped

    def decorate(decorated=None, *, typechecker=None):
        if decorated is None:
            return functools.partial(decorate, typechecker=typechecker)
        return checked(decorated, shaped) if isinstance(decorated, types.FunctionType) else decorated

    # What the hook puts around everything, looked up by this name.
    jaxtyping.jaxtyped = decorate
    jaxtyping.install_import_hook(package, None)


def checked(function, shaped=jaxtyping.jaxtyped):
    """`function`, whose arguments and results are checked against its annotations.

    Constructors stay unchecked: JAX rebuilds pytrees with whatever stands for their leaves (None, shapes, axes), and
    configurations refuse bad values themselves, with a message of their own. An annotation that names what its module
    does not hold at the first call allows everything.
    """
    if not function.__annotations__ or function.__name__ == "__init__":
        return function
    check = None

    @functools.wraps(function)
    def checks(*args, **kwargs):
        __tracebackhide__ = True
        nonlocal check
        if check is None:
            check = _check(function, shaped)
        return check(*args, **kwargs)

    return checks


def _check(function, shaped):
    hints = {name: _resolved(hint, function.__globals__) for name, hint in function.__annotations__.items()}
    for hint in hints.values():
        for part in (hint, *typing.get_args(hint)):
            if getattr(part, "_is_protocol", False):
                typing.runtime_checkable(part)
    # The function itself keeps its annotations as they are written.
    names = function.__name__, function.__defaults__, function.__closure__
    copy = types.FunctionType(function.__code__, function.__globals__, *names)
    copy.__kwdefaults__, copy.__module__, copy.__qualname__ = (
        function.__kwdefaults__,
        function.__module__,
        function.__qualname__,
    )
    copy.__annotations__ = hints
    check = beartype(copy)
    # What a generator yields is not looked at.
    if inspect.isgeneratorfunction(function) or not any(map(_has_shapes, hints.values())):
        return check
    return shaped(check, typechecker=None)


def _resolved(annotation, names):
    def annotated(): ...

    annotated.__annotations__ = {"hint": annotation}
    try:
        return typing.get_type_hints(annotated, names, include_extras=True)["hint"]
    except Exception:
        # A name that is imported for type checkers alone, or a class within a function.
        return typing.Any


def _has_shapes(hint):
    parts = hint if isinstance(hint, list) else typing.get_args(hint)
    return str(getattr(hint, "__module__", "")).startswith("jaxtyping") or any(map(_has_shapes, parts))
