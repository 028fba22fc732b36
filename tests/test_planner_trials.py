"""Which of a decision's actions are tried."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mechsearch_jax.actions.kinds.nothing import no_action
from mechsearch_jax.actions.registry import ActionKind
from mechsearch_jax.actions.types import Action
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.planner.state import Sequences
from mechsearch_jax.planner.trials import ALIKE, ALIKE_APPROACH, TRIES, sequences_to_try

OBJECTS = Superquadrics(
    size=jnp.ones((2, 3)),
    exponents=jnp.ones((2, 2)),
    position=jnp.zeros((2, 3)),
    rotation=jnp.broadcast_to(jnp.eye(3), (2, 3, 3)),
    valid=jnp.ones(2, bool),
)


def pose(x=0.0, y=0.0, turned=0.0):
    c, s = math.cos(turned), math.sin(turned)
    return np.array([[c, 0, s, x], [0, 1, 0, y], [-s, 0, c, 0], [0, 0, 0, 1]], np.float32)


def action(kind=ActionKind.PUSH, object=0, x=0.0, end=0.1, turned=0.0) -> Action:
    """A push along x, or another action between the same places."""
    blank = no_action()
    return blank.replace(
        kind=jnp.int32(kind),
        object=jnp.int32(object),
        T_world_gripper=jnp.asarray(pose(x, turned=turned)),
        T_world_place=jnp.asarray(pose(x + end, turned=turned)),
    )


def sequences_of(*actions: Action, value=None) -> Sequences:
    """Sequences of one action each, best first."""
    count = len(actions)
    stacked = jax.tree.map(lambda *a: jnp.stack(a)[:, None], *actions)
    return Sequences(
        actions=stacked,
        cost=jnp.zeros((count, 1)),
        value=jnp.arange(count, dtype=jnp.float32) if value is None else jnp.asarray(value, jnp.float32),
        length=jnp.ones(count, jnp.int32),
        after=jax.tree.map(lambda a: jnp.broadcast_to(a, (count, *a.shape)), OBJECTS),
    )


def tried(sequences: Sequences):
    alternatives = sequences_to_try(sequences, OBJECTS, jnp.float32(0.0))
    worth = np.asarray(alternatives.worth)
    return np.asarray(alternatives.sequence)[worth].tolist(), alternatives


@pytest.mark.parametrize(
    ("other", "alike"),
    [
        (action(), True),
        (action(x=0.9 * ALIKE), True),
        (action(turned=0.9 * ALIKE_APPROACH), True),
        (action(kind=ActionKind.PICK_AND_PLACE), False),
        (action(object=1), False),
        (action(x=1.1 * ALIKE), False),
        (action(end=0.1 + 1.1 * ALIKE), False),
        (action(turned=1.1 * ALIKE_APPROACH), False),
    ],
)
def test_an_action_like_a_better_one_is_not_tried(other, alike):
    assert tried(sequences_of(action(), other))[0] == ([0] if alike else [0, 1])


def test_the_best_of_each_are_tried_best_first():
    pushes = [action(x=0.001 * i + 0.5 * (i // 10)) for i in range(10 * (TRIES + 2))]
    order, alternatives = tried(sequences_of(*pushes))
    assert order == [10 * i for i in range(TRIES)]
    for i, number in enumerate(order):
        np.testing.assert_array_equal(alternatives.actions.T_world_gripper[i], pushes[number].T_world_gripper)


def test_what_is_impossible_is_not_tried_and_hides_nothing():
    first = sequences_of(no_action(), action(), action(x=0.5), value=[0.0, np.inf, 2.0])
    assert tried(first)[0] == [2]
    refused = sequences_of(action(), action(), value=[np.inf, 1.0])
    assert tried(refused)[0] == [1]


def test_where_few_differ_every_place_is_of_another_sequence():
    order, alternatives = tried(sequences_of(*[action()] * (TRIES + 4)))
    assert order == [0]
    assert len(set(np.asarray(alternatives.sequence).tolist())) == len(alternatives.worth) == TRIES
    assert len(sequences_to_try(sequences_of(action()), OBJECTS, jnp.float32(0.0)).worth) == 1


def reference(kinds, objects, starts, ends, values):
    """The indices in float64: an action is taken unless it is like one that was."""
    taken = []
    for i, kind in enumerate(kinds):
        same = [
            j
            for j in taken
            if (kinds[j], objects[j]) == (kind, objects[i])
            and abs(starts[j] - starts[i]) < ALIKE
            and abs(starts[j] + ends[j] - starts[i] - ends[i]) < ALIKE
        ]
        if kind != ActionKind.NONE and np.isfinite(values[i]) and not same and len(taken) < TRIES:
            taken.append(i)
    return taken


BATCHED = jax.jit(jax.vmap(functools.partial(sequences_to_try, now=OBJECTS, reached=jnp.float32(0.0))))


@settings(max_examples=25, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.sampled_from([ActionKind.NONE, ActionKind.PUSH, ActionKind.PICK_AND_PLACE]),
            st.integers(0, 1),
            st.integers(0, 12),
            st.sampled_from([0.05, 0.1, 0.15]),
            st.booleans(),
        ),
        min_size=30,
        max_size=30,
    )
)
def test_the_tried_are_those_of_a_loop_alone_and_batched(drawn):
    # Steps of 7 mm, so that no distance is as large as what counts as alike.
    starts, ends = [0.007 * steps for *_, steps, _, _ in drawn], [end for *_, end, _ in drawn]
    values = [float(i) if finite else np.inf for i, (*_, finite) in enumerate(drawn)]
    actions = [
        action(kind, o, x, end) if kind != ActionKind.NONE else no_action()
        for (kind, o, *_), x, end in zip(drawn, starts, ends, strict=True)
    ]
    sequences = sequences_of(*actions, value=values)
    order, alternatives = tried(sequences)
    kinds, objects = [kind for kind, *_ in drawn], [o for _, o, *_ in drawn]
    assert order == reference(kinds, objects, np.array(starts), np.array(ends), values)
    twice = BATCHED(jax.tree.map(lambda a: jnp.stack([a, a]), sequences))
    np.testing.assert_array_equal(twice.sequence[1], alternatives.sequence)
    np.testing.assert_array_equal(twice.worth[1], alternatives.worth)
