"""The checker around the package's functions: it is there, and refuses what is not as annotated."""

import jax.numpy as jnp
import numpy as np
import pytest
from beartype.roar import BeartypeCallHintViolation
from jaxtyping import Array, Float
from runtime_checks import checked

from mechsearch_jax.geometry import transforms
from mechsearch_jax.planner.rollout import Rollout


@checked
def scaled(points: 'Float[Array, "n 3"]', weights: 'Float[Array, " n"]', by: "float" = 1.0) -> 'Float[Array, "n 3"]':
    return points * weights[:, None] * by


@checked
def repeated(count: int, value: float) -> Float[np.ndarray, " {count}"]:
    return np.full(3, value)


ONES = jnp.ones((4, 3))


@pytest.mark.parametrize(
    "wrong",
    [
        pytest.param(lambda: scaled(ONES, jnp.ones(3)), id="another length"),
        pytest.param(lambda: scaled(jnp.ones((4, 3), int), jnp.ones(4)), id="another element type"),
        pytest.param(lambda: scaled(ONES, jnp.ones(4), by="2"), id="no number"),
        pytest.param(lambda: repeated(2, 1.0), id="a result of another length than an argument says"),
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


def test_classes_of_the_package_are_themselves():
    assert hasattr(Rollout.step, "__wrapped__")
    assert isinstance(Rollout, type)
    assert not hasattr(Rollout.__init__, "__wrapped__")
