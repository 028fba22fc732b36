"""The baseline that moves the object that occludes most: which object that is, and which is next if it cannot move."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax import planner
from mechsearch_jax.actions import ActionKind
from mechsearch_jax.benchmarks.policies.occlusion import (
    EACH,
    most_occluding,
    most_occluding_first,
)
from mechsearch_jax.dynamics.quasi_static import QuasiStatic
from mechsearch_jax.observation import Observation
from mechsearch_jax.workspace import scenario

# Far from each other: one that hides much, one that hides less, one that hides little.
SIZES = {"wide": ((0.03, 0.06, 0.08), 0.1), "narrow": ((0.025, 0.03, 0.06), 0.3), "low": ((0.02, 0.02, 0.05), -0.15)}
ORDERS = (("wide", "narrow", "low"), ("low", "wide", "narrow"), ("narrow", "low", "wide"))
POLICY = most_occluding(push_model=QuasiStatic(), sequences=12)


def body(name):
    half_size, y = SIZES[name]
    return scenario.Body("box", half_size, (0.5, y, 0.4045 + half_size[2]), (1.0, 0.0, 0.0, 0.0))


def seen(names, pose=None):
    """What is observed of objects, and of a target at a pose; of a hidden target without one."""
    objects = scenario.superquadrics([body(name) for name in names])
    return Observation(objects, jnp.array(pose is not None), jnp.float32(pose or (0.0, 0.0, 0.0)))


def look(problem, observation):
    return planner.update_belief(problem, planner.initial_belief(problem), observation)


def decided(problem, names, seed=0, policy=POLICY, pose=None):
    observation = seen(names, pose)
    return policy.planned(jax.random.key(seed), problem, look(problem, observation), observation)


def object_of(decision, names):
    assert int(decision.action.kind) in (ActionKind.PUSH, ActionKind.PICK_AND_PLACE)
    return names[int(decision.action.object)]


def test_actions_come_by_their_objects_and_few_of_each():
    push, none = int(ActionKind.PUSH), int(ActionKind.NONE)
    index = jnp.int32([1, 0, 0, 0, 2, 0, 0, 0, 1])
    kind = jnp.int32([push, push, none, push, push, push, push, push, push])
    value = np.asarray(most_occluding_first(kind, index, jnp.float32([30.0, 5.0, 0.0])))
    assert EACH == 4
    # The impossible one counts for nothing, and the fifth possible one of object 0 is left out.
    np.testing.assert_array_equal(value, [-5.0, -30.0, np.inf, -30.0, 0.0, -30.0, -30.0, np.inf, -5.0])


@pytest.mark.slow
def test_the_object_that_hides_most_is_moved_in_any_order_of_the_objects(problem):
    alone = {name: int(look(problem, seen((name,))).exists.sum()) for name in SIZES}
    assert alone["wide"] > 1.5 * alone["narrow"] > 1.5 * alone["low"]
    for names in ORDERS:
        for seed in range(3):
            decision = decided(problem, names, seed)
            assert object_of(decision, names) == "wide"
        hidden = {names[i]: -float(v) for i, v in first_values(decision).items()}
        assert sorted(hidden, key=hidden.get, reverse=True) == [n for n in ("wide", "narrow", "low") if n in hidden]
        # It hides about as much as where it stands alone.
        assert hidden["wide"] == pytest.approx(alone["wide"], rel=0.4)
        assert float(decision.cost) == int(look(problem, seen(names)).exists.sum())
        assert float(decision.predicted_cost) == float(decision.cost) - hidden["wide"]


def first_values(decision):
    """The value of the first action of each object."""
    sequences = jax.device_get(decision.sequences)
    rows = [(int(i), v) for i, v in zip(sequences.actions.object[:, 0], sequences.value, strict=True) if np.isfinite(v)]
    return dict(reversed(rows))


@pytest.mark.slow
def test_once_the_target_is_found_the_object_that_blocks_most_of_its_grasps_is_moved(problem):
    for names in ORDERS[:2]:
        for behind in ("narrow", "wide"):
            pose = (0.62, SIZES[behind][1], 0.0)
            decision = decided(problem, names, pose=pose)
            assert object_of(decision, names) == behind
            assert float(decision.value) < 0.0
        # The target itself is never moved.
        assert not (decision.sequences.actions.object == len(decision.predicted.valid)).any()
