"""f is opened again where an action may have moved the target unseen, and nowhere else."""

import dataclasses
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax import planner
from mechsearch_jax.actions import no_action
from mechsearch_jax.actions.registry import ActionKind
from mechsearch_jax.belief.moved_target import nearest_candidate
from mechsearch_jax.belief.unseen_motion import reopened, same_objects
from mechsearch_jax.envs.camera.snapshot import Snapshot
from mechsearch_jax.envs.episode import slots
from mechsearch_jax.envs.episode.episode_log import Choice
from mechsearch_jax.envs.world.world import from_scenario
from mechsearch_jax.geometry import superquadric
from mechsearch_jax.geometry.transforms import make, translate
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner import step
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.scenario import example_scenarios, load_scenario

LEFT = jnp.float32([0.0, 0.1, 0.0])
# The gripper's z points into the shelf, tilted down by 30 degrees.
FORWARD = jnp.float32([[0.5, 0.0, 0.8660254], [0.0, -1.0, 0.0], [0.8660254, 0.0, -0.5]])


def boxes(*centres):
    many = superquadric.Superquadrics(
        size=jnp.tile(jnp.float32([0.025, 0.025, 0.06]), (len(centres), 1)),
        exponents=jnp.full((len(centres), 2), 0.2),
        position=jnp.float32([(x, y, 0.4645) for x, y in centres]),
        rotation=jnp.tile(jnp.eye(3), (len(centres), 1, 1)),
        valid=jnp.ones(len(centres), bool),
    )
    return superquadric.pad(many, 8)


BEFORE, AFTER = boxes((0.6, 0.0), (0.6, 0.3)), boxes((0.6, 0.09), (0.6, 0.3))


def push(way=LEFT):
    start = make(FORWARD, jnp.float32([0.6, -0.05, 0.46]))
    return no_action().replace(
        kind=jnp.int32(ActionKind.PUSH), T_world_gripper=start, displacement=way, T_world_place=translate(start, way)
    )


def at(problem, *places):
    rows = [int(nearest_candidate(problem.poses, jnp.float32([x, y, 0.0]))) for x, y in places]
    return jnp.zeros(problem.poses.shape[0], bool).at[jnp.array(rows)].set(True)


@pytest.fixture(scope="module")
def opened(problem):
    function = jax.jit(reopened)
    return lambda *arguments: np.asarray(function(problem, *arguments))


def distances(problem, x, y):
    return np.linalg.norm(np.asarray(problem.poses)[:, :2] - (x, y), axis=1)


def test_a_push_opens_f_beside_what_it_swept(problem, opened):
    """The target stood at the box's left side and is 6 cm farther to the left now."""
    where = opened(at(problem, (0.6, 0.08)), BEFORE, AFTER, push())
    assert where[np.asarray(at(problem, (0.6, 0.14)))].all()
    # Not where nothing passed, and not farther away than the hand went.
    poses = np.asarray(problem.poses)
    # The hand is 20 cm wide and ends at 5 cm.
    assert not where[poses[:, 1] > 0.05 + 0.1 + 0.04].any()
    assert not where[distances(problem, 0.6, 0.08) > 0.1 + 0.04].any()
    assert where.sum() < 0.2 * where.size


def test_what_no_possible_pose_is_beside_stays_ruled_out(problem, opened):
    assert not opened(at(problem, (0.6, 0.35), (0.7, 0.12)), BEFORE, AFTER, push()).any()
    everywhere = jnp.ones(problem.poses.shape[0], bool)
    assert not opened(everywhere, BEFORE, AFTER, no_action()).any()


def test_a_push_that_moved_nothing_opens_f_beside_the_hand_alone(problem, opened):
    everywhere = jnp.ones(problem.poses.shape[0], bool)
    where, whole = (opened(everywhere, BEFORE, after, push()) for after in (BEFORE, AFTER))
    assert where.any()
    assert where.sum() < whole.sum()
    assert not (where & ~whole).any()


def shuffled(objects, order):
    return jax.tree.map(lambda a: a[np.asarray(order)], objects)


@pytest.mark.parametrize("noise", [0.0, 0.004])
def test_only_what_is_seen_says_which_object_is_which(problem, opened, noise):
    """In whatever slots the objects are, before the push and after it, the same poses are opened."""
    rng = np.random.default_rng(7)
    everywhere = jnp.ones(problem.poses.shape[0], bool)
    before = boxes((0.6, 0.0), (0.6, 0.06), (0.55, 0.3), (0.68, 0.02))
    sets = []
    # The first is pushed, by as much as it should be, or less, and pushes the second on.
    for way, on in ((0.1, 0.09), (0.04, 0.03), (0.08, 0.075)):
        after = boxes((0.6, way), (0.6, 0.06 + on), (0.55, 0.3), (0.68, 0.02))
        after = after.replace(
            position=after.position + noise * jnp.float32(rng.normal(size=(8, 3))) * after.valid[:, None],
            size=after.size + noise * jnp.float32(rng.uniform(-1, 1, size=(8, 3))) * after.valid[:, None],
        )
        expected = opened(everywhere, before, after, push())
        assert expected.any()
        sets.append(expected)
        for _ in range(3):
            again = opened(everywhere, before, shuffled(after, rng.permutation(8)), push())
            np.testing.assert_array_equal(again, expected)
        order = rng.permutation(8)
        pushed = push().replace(object=jnp.int32(int(np.flatnonzero(order == 0)[0])))
        np.testing.assert_array_equal(opened(everywhere, shuffled(before, order), after, pushed), expected)
    assert not np.array_equal(sets[0], sets[1])


def test_no_object_is_taken_for_two():
    before, after = boxes((0.6, 0.0), (0.6, 0.06), (0.5, 0.3)), boxes((0.5, 0.3), (0.6, 0.055), (0.6, 0.12))
    meant = before.position.at[0].add(LEFT)
    same, matched = same_objects(before, after, meant)
    assert same[:3].tolist() == [2, 1, 0]
    assert matched.tolist() == [True] * 3 + [False] * 5
    # One is not seen any more.
    same, matched = same_objects(before, after.replace(valid=after.valid.at[2].set(False)), meant)
    assert matched.tolist() == [False, True, True] + [False] * 5
    assert same[1:3].tolist() == [1, 0]
    # Any number of slots will do, and one that is seen from another side is the same.
    many, turned = (superquadric.pad(a, 12) for a in (before, after.replace(size=after.size[:, jnp.array([2, 0, 1])])))
    assert same_objects(many, turned, jnp.pad(meant, ((0, 4), (0, 0))))[0][:3].tolist() == [2, 1, 0]


def test_a_picked_object_may_have_touched_the_target_at_both_ends(problem, opened):
    grasp = make(FORWARD, jnp.float32([0.6, 0.0, 0.46]))
    pick = no_action().replace(
        kind=jnp.int32(ActionKind.PICK_AND_PLACE),
        opening=jnp.float32(0.08),
        T_world_gripper=grasp,
        T_world_place=translate(grasp, jnp.float32([0.05, -0.15, 0.0])),
    )
    everywhere = jnp.ones(problem.poses.shape[0], bool)
    # Dropped where it stood, it may all the same have been carried to its place.
    for after in (boxes((0.65, -0.15), (0.6, 0.3)), BEFORE):
        where = opened(everywhere, BEFORE, after, pick)
        for place in ((0.6, 0.04), (0.65, -0.19)):
            assert where[np.asarray(at(problem, place))].all()
        assert not where[np.asarray(at(problem, (0.6, 0.25)))].any()


def test_what_moves_away_touches_nothing_where_it_stood(problem, opened):
    """Behind the box and beyond the finger tips: the box does not drag the target along, the hand does not reach it."""
    grasp = make(FORWARD, jnp.float32([0.6, 0.0, 0.46]))
    there = jnp.float32([0.0, -0.2, 0.0])
    pick = no_action().replace(
        kind=jnp.int32(ActionKind.PICK_AND_PLACE),
        opening=jnp.float32(0.08),
        T_world_gripper=grasp,
        T_world_place=translate(grasp, there),
    )
    behind = at(problem, (0.67, 0.0))
    assert not opened(behind, BEFORE, boxes((0.6, -0.2), (0.6, 0.3)), pick).any()


def seen(objects):
    return Observation(objects, jnp.array(False), jnp.zeros(3))


def test_a_belief_is_opened_before_it_looks(problem):
    """Behind the tall box, where the target was pushed to, f was ruled out before."""
    wall = (0.5, 0.1)
    before, after = boxes((0.6, 0.0), wall), boxes((0.6, 0.05), wall)
    belief = planner.initial_belief(problem)
    belief = belief.replace(exists=at(problem, (0.6, 0.06)))
    open_again = planner.update_belief(problem, belief, seen(after), seen(before), push())
    fresh = planner.update_belief(problem, planner.initial_belief(problem), seen(after))
    assert not (open_again.exists & ~fresh.exists).any()
    assert (open_again.exists & ~belief.exists).any()
    assert not open_again.restarts
    existence = dataclasses.replace(problem.config.existence, as_in_paper=True)
    paper = problem.replace(config=dataclasses.replace(problem.config, existence=existence))
    looks = [(seen(after),), (seen(after), seen(before), push())]
    never, as_before = (planner.update_belief(paper, belief, *look) for look in looks)
    np.testing.assert_array_equal(as_before.exists, never.exists)


def world_of_none():
    one = load_scenario(example_scenarios()["first-light"])
    return jax.tree.map(lambda a: a[None], from_scenario(one))


def test_an_episode_tells_the_belief_what_it_did(problem, monkeypatch):
    updates = []

    def update(problem, belief, observation, before, action):
        updates.append((int(action.kind), before))
        return belief

    monkeypatch.setattr(step, "update_belief", update)
    monkeypatch.setattr(slots.OneSlot, "_snapshot", lambda self, world: Snapshot(problem.camera, problem.shelf, world))
    choice = Choice(push(), jnp.float32(3.0), jnp.float32(2.0), jnp.int32(1))
    monkeypatch.setattr(slots, "chosen", lambda decision: choice)
    decided = types.SimpleNamespace(decision=types.SimpleNamespace(action=push()))
    monkeypatch.setattr(slots, "decide", lambda *arguments, last: decided)

    views = [seen(BEFORE), seen(AFTER), seen(AFTER)]
    waiting = iter(views)
    slot = slots.OneSlot(problem, None, lambda *_: next(waiting))
    world, keys = world_of_none(), jax.random.split(jax.random.key(0), 1)
    slot.look(world, keys, [0])
    slot.decide(keys, [0])
    slot.look(world, keys, [0])
    slot.forget(np.array([True]))
    slot.look(world, keys, [0])
    assert [kind for kind, _ in updates] == [0, ActionKind.PUSH, 0]
    assert [before for _, before in updates] == [views[0], views[0], views[2]]


def test_an_action_without_what_was_seen_before_it_is_refused(problem):
    with pytest.raises(InputError, match="or neither"):
        planner.update_belief(problem, planner.initial_belief(problem), seen(AFTER), action=push())
