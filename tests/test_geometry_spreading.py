"""Farthest-point sampling, which clouds and grasps share."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from scipy.spatial.distance import cdist

from mechsearch_jax.geometry.spreading import farthest_points

# Few different numbers, so that distances are often equal.
POINTS = arrays.arrays(
    np.float64, st.tuples(st.integers(1, 30), st.integers(1, 4)), elements=st.integers(-3, 3).map(lambda i: i / 4)
)


@given(points=POINTS, count=st.integers(1, 30), first=st.integers(0, 29))
def test_each_point_is_the_farthest_from_all_before(points, count, first):
    """Against all distances; whoever gives them may use the same array each time."""
    first, apart = first % len(points), cdist(points, points, "sqeuclidean")
    room = np.empty(len(points))

    def distance(i):
        room[:] = apart[i]
        return room

    chosen = farthest_points(count, first, distance)
    expected = [first]
    while len(expected) < count:
        expected.append(int(np.argmax(apart[expected].min(axis=0))))
    assert chosen.tolist() == expected
