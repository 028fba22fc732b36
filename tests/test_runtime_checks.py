"""The checker around the package's functions: what it refuses, what it leaves alone, and that it is there."""

import dataclasses
import inspect
import typing

import jax.numpy as jnp
import numpy as np
import pytest
from beartype.roar import BeartypeCallHintViolation
from jaxtyping import Array, Float, Int
from runtime_checks import checked

from mechsearch_jax.geometry import transforms
from mechsearch_jax.planner.rollout import Rollout


@checked
def scaled(points: 'Float[Array, "n 3"]', weights: 'Float[Array, " n"]', by: "float" = 1.0) -> 'Float[Array, "n 3"]':
    """Says so."""
    return points * weights[:, None] * by


@checked
def repeated(count: int, value: float) -> Float[np.ndarray, " {count}"]:
    return np.full(3, value)


@checked
def labelled(labels: Int[Array, "*batch"] | None, name: "Later | str") -> "tuple[int, str]":
    return (0 if labels is None else labels.size), name if isinstance(name, str) else 3


@checked
def unknown(value: "nobody.Knows") -> "int":
    return value


@dataclasses.dataclass
class Later:
    """Is defined after what names it."""

    @checked
    def __init__(self, size: int):
        self.size = size


ONES = jnp.ones((4, 3))


@pytest.mark.parametrize(
    "wrong",
    [
        pytest.param(lambda: scaled(ONES, jnp.ones(3)), id="another length"),
        pytest.param(lambda: scaled(ONES[0], jnp.ones(4)), id="an axis too few"),
        pytest.param(lambda: scaled(jnp.ones((4, 3), int), jnp.ones(4)), id="another element type"),
        pytest.param(lambda: scaled(np.ones((4, 3)), jnp.ones(4)), id="NumPy's array"),
        pytest.param(lambda: scaled(ONES, jnp.ones(4), by="2"), id="no number"),
        pytest.param(lambda: scaled(jnp.ones((4, 3)), jnp.ones(4), jnp.ones(2)), id="an array for a number"),
        pytest.param(lambda: repeated(2, 1.0), id="a result of another length than an argument says"),
        pytest.param(lambda: labelled(None, Later(1)), id="a result without arrays"),
        pytest.param(lambda: labelled(ONES, "a"), id="an element type in a union"),
        pytest.param(lambda: labelled(None, 3), id="neither of two types"),
        pytest.param(lambda: unknown("a"), id="a result beside what nobody knows"),
        pytest.param(lambda: transforms.inverse(jnp.ones((4, 3))), id="in the package"),
    ],
)
def test_what_is_not_as_annotated_is_refused(wrong):
    with pytest.raises(BeartypeCallHintViolation):
        wrong()


def test_what_is_as_annotated_passes():
    assert scaled(ONES, jnp.ones(4), by=2.0).tolist() == [[2.0] * 3] * 4
    # Each call has lengths of its own.
    assert scaled(ONES[:2], jnp.ones(2)).shape == (2, 3)
    assert repeated(3, 2.0).tolist() == [2.0] * 3
    assert labelled(jnp.ones((2, 2), int), "a") == (4, "a")
    assert unknown(3) == 3
    # Constructors refuse bad values themselves.
    assert Later("large").size == "large"


def test_a_checked_function_looks_as_it_is_written():
    assert (scaled.__name__, scaled.__doc__, scaled.__module__) == ("scaled", "Says so.", __name__)
    assert inspect.signature(scaled).parameters["by"].annotation == "float"

    def plain(a, b=1):
        return a + b

    assert checked(plain) is plain


def test_functions_of_the_package_are_checked_and_its_classes_are_themselves():
    assert typing.cast(typing.Any, transforms.inverse).__wrapped__.__name__ == "inverse"
    assert hasattr(Rollout.step, "__wrapped__")
    assert isinstance(Rollout, type)
    assert not hasattr(Rollout.__init__, "__wrapped__")
