"""How often objects are right by their stated confidence, and the constants that it is computed with."""

import numpy as np
import pytest
from scipy.special import expit

from mechsearch_jax.benchmarks.lab.looks.confidences import constants, reliability

TRUE = np.array([3.0, 1.5, -0.5, 0.2])


def drawn(count):
    random = np.random.default_rng(0)
    about = random.normal(size=(count, 3)) - np.array([1.0, 0.0, 2.0])
    confidence = expit(-(TRUE[0] + about @ TRUE[1:]))
    return about, confidence, random.random(count) < confidence


def test_constants_are_those_that_outcomes_were_drawn_with():
    about, _, right = drawn(40_000)
    np.testing.assert_allclose(constants(about, right), TRUE, atol=0.1)


def test_true_probabilities_hold_and_others_do_not():
    _, confidence, right = drawn(40_000)
    # In six standard errors.
    for line in reliability(confidence, right):
        assert line["right"] == pytest.approx(line["stated"], abs=3.0 / line["objects"] ** 0.5)
    too_sure = reliability(np.sqrt(confidence), right)
    assert max(line["stated"] - line["right"] for line in too_sure) > 0.1
    assert sum(line["objects"] for line in too_sure) == 40_000
