"""Stacks: what carries something is not moved before it, and what is on top is an object like others."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mechsearch_jax import planner
from mechsearch_jax.actions.candidates import all_candidates, free_candidates, sample_action
from mechsearch_jax.actions.kinds.push import Push
from mechsearch_jax.actions.registry import SAMPLED_KINDS, ActionKind
from mechsearch_jax.actions.types import DrawnCandidate
from mechsearch_jax.belief.belief import possible_space
from mechsearch_jax.dynamics.quasi_static import QuasiStatic
from mechsearch_jax.dynamics.rigid import pick_and_place
from mechsearch_jax.envs.episode.closed_loop import RunSettings, Start
from mechsearch_jax.envs.episode.episodes import run_episode, target_of
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.envs.simulators.native import NativeSimulator
from mechsearch_jax.envs.simulators.simulator import SimulatorConfig
from mechsearch_jax.envs.trials.native import TrialSetup, scene_at_rest, trial_world
from mechsearch_jax.geometry.footprints import footprints, supports
from mechsearch_jax.geometry.superquadric import EDGE_EXPONENT, Superquadrics, pad
from mechsearch_jax.grasping.retrieval import best_grasp
from mechsearch_jax.workspace.scenario import example_scenarios, load_scenario, parse_scenario

BOARD = 0.4045
PICK, PUSH = (
    [kind.code for kind in SAMPLED_KINDS].index(code) for code in (ActionKind.PICK_AND_PLACE, ActionKind.PUSH)
)
# The lower and the upper one of two boxes.
LOWER, UPPER = (0.03, 0.04, 0.035), (0.028, 0.036, 0.03)
SUPPORTS = jax.jit(lambda scene: supports(footprints(scene)))


def turn(yaw=0.0, tilt=0.0):
    """A rotation by a tilt about y, then by a yaw."""
    c, s, d, t = np.cos(yaw), np.sin(yaw), np.cos(tilt), np.sin(tilt)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.array([[d, 0, t], [0, 1, 0], [-t, 0, d]])


def scene_of(*bodies, capacity=5):
    """Bodies of (half-extents, x, y, lowest point above the board, rotation, whether round)."""
    half, x, y, low, rotation, is_round = (list(rows) for rows in zip(*bodies, strict=True))
    half, rotation = np.float32(half), np.float32(rotation)
    tall = np.abs(rotation[:, 2]) * half
    # Of a round body that leans, its circle's reach.
    reach = np.where(is_round, np.hypot(tall[:, 0], tall[:, 1]), tall[:, 0] + tall[:, 1]) + tall[:, 2]
    return pad(
        Superquadrics(
            size=jnp.array(half),
            exponents=jnp.array([[EDGE_EXPONENT, 1.0 if r else EDGE_EXPONENT] for r in is_round], jnp.float32),
            position=jnp.array(np.column_stack([x, y, BOARD + np.array(low) + reach]), jnp.float32),
            rotation=jnp.array(rotation),
            valid=jnp.ones(len(half), bool),
        ),
        capacity,
    )


def pairs(scene):
    return {(int(i), int(j)) for i, j in np.argwhere(SUPPORTS(scene))}


def box(half, x, y, low=0.0, yaw=0.0, tilt=0.0):
    return half, x, y, low, turn(yaw, tilt), False


def test_each_of_three_carries_the_next():
    tower = [box((0.04, 0.03, 0.03), 0.6, 0.1), box((0.03, 0.03, 0.02), 0.61, 0.1, 0.06, 0.4)]
    can = (0.025, 0.025, 0.03), 0.6, 0.09, 0.1, turn(), True
    assert pairs(scene_of(*tower, can, box((0.03, 0.03, 0.06), 0.6, 0.18))) == {(0, 1), (1, 2)}
    # Recognised a little too high or too low; and one that lies across two.
    assert pairs(scene_of(tower[0], box((0.03, 0.03, 0.02), 0.61, 0.1, 0.067))) == {(0, 1)}
    assert pairs(scene_of(tower[0], box((0.03, 0.03, 0.02), 0.61, 0.1, 0.053))) == {(0, 1)}
    bridge = box((0.02, 0.12, 0.01), 0.6, 0.175, 0.06)
    assert pairs(scene_of(tower[0], box((0.04, 0.03, 0.03), 0.6, 0.25), bridge)) == {(0, 2), (1, 2)}


def test_what_has_its_lowest_point_on_the_board_or_hangs_beside_is_carried_by_nothing():
    low, tall = box((0.04, 0.03, 0.03), 0.6, 0.1), box((0.02, 0.02, 0.1), 0.545, 0.1, 0.0, 0.0, 0.4)
    # It leans on the box, and its footprint is over it; a thin book, and another that is recognised into it.
    assert pairs(scene_of(low, tall)) == set()
    assert pairs(scene_of(box((0.05, 0.05, 0.004), 0.6, 0.1), box((0.05, 0.05, 0.004), 0.64, 0.1, 0.002))) == set()
    assert pairs(scene_of(low, box((0.03, 0.03, 0.02), 0.6, 0.159, 0.06))) == set()
    assert pairs(scene_of(low, box((0.03, 0.03, 0.02), 0.6, 0.1, 0.08))) == set()
    gone = scene_of(low, box((0.03, 0.03, 0.02), 0.6, 0.1, 0.06))
    assert pairs(gone) == {(0, 1)}
    assert pairs(gone.replace(valid=gone.valid.at[0].set(False))) == set()


numbers = st.floats(0.0, 1.0, width=32)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(*[numbers] * 7, st.booleans()), min_size=2, max_size=5), numbers, numbers, numbers)
def test_stacks_do_not_depend_on_where_and_how_turned_the_scene_is(rows, yaw, x, y):
    bodies = []
    for half_x, half_y, half_z, at_x, at_y, low, own, is_round in rows:
        half = 0.02 + 0.03 * np.array([half_x, half_x if is_round else half_y, half_z])
        # Heights that are not at the edge of what counts.
        heights = [0.0, *(2 * b[0][2] + b[3] for b in bodies), *(2 * b[0][2] + b[3] + 0.02 for b in bodies)]
        foot = heights[min(int(low * len(heights)), len(heights) - 1)]
        bodies.append((half, 0.1 * at_x, 0.1 * at_y, foot, turn(3.0 * own), is_round))
    scene, R = scene_of(*bodies), np.float32(turn(6.3 * yaw))
    moved = scene.replace(
        position=scene.position @ R.T + jnp.array([[x, y, 0.0]]), rotation=jnp.array(R)[None] @ scene.rotation
    )
    both = np.stack([SUPPORTS(s) for s in (scene, moved)])
    # Shortest way out of each other by 64-bit projections, as polygons of many corners.
    clear = np.abs(overlap(bodies) - 0.004) > 2e-3
    feet = np.array([b[3] for b in bodies])
    tops = feet + 2 * np.array([b[0][2] for b in bodies])
    near = np.abs(np.abs(feet[None] - tops[:, None]) - 0.01) > 1e-4
    n = len(bodies)
    np.testing.assert_array_equal(*(b[:n, :n] & clear & near for b in both))
    upon = (np.abs(feet[None] - tops[:, None]) < 0.01) & (overlap(bodies) > 0.004)
    upon &= feet[None] > (0.5 * (feet + tops))[:, None]
    exact = clear & near & ~np.logical_or.outer(*[[b[5] for b in bodies]] * 2)
    np.testing.assert_array_equal(both[0][:n, :n] & exact, upon & exact)
    assert pairs(scene_of(*((*b[:3], 0.0, *b[4:]) for b in bodies))) == set()


def overlap(bodies):
    """How far each pair of footprints overlaps at least in any of 720 directions."""
    angles = np.arange(720) * np.pi / 720
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    directions = np.concatenate([directions, *(b[4][:2, :2].T for b in bodies)])
    reach = []
    for half, *_, rotation, is_round in bodies:
        along = np.abs(directions @ rotation[:2, :2]) * half[:2]
        reach.append(np.hypot(*along.T) if is_round else along.sum(axis=1))
    at = np.array([[b[1], b[2]] for b in bodies]) @ directions.T
    reach = np.array(reach)
    return (reach[:, None] + reach[None] - np.abs(at[:, None] - at[None])).min(axis=-1)


def two(x=0.55, y=0.1, low=0.07):
    return box(LOWER, x, y), box(UPPER, x, y, low)


@pytest.fixture(scope="module")
def candidates(problem):
    """A function from a scene to its candidates, and the space that the target may fill: none."""
    belief = planner.initial_belief(problem)
    possible = possible_space(problem, belief, belief.exists & False)
    return jax.jit(lambda scene: all_candidates(problem.space, scene, possible)), possible


def movable(found):
    """Which objects can be picked, and which pushed, without hitting anything."""
    free = [np.asarray(free_candidates(kind).any((1, 2))) for kind in found]
    return {int(i) for i in np.flatnonzero(free[PICK])}, {int(i) for i in np.flatnonzero(free[PUSH])}


@pytest.mark.slow
def test_only_the_top_is_moved_first_and_it_is_put_down_on_the_board(problem, candidates):
    (candidates, possible), scene = candidates, scene_of(*two(), box((0.03, 0.03, 0.05), 0.6, -0.12))
    found = candidates(scene)
    assert movable(found) == ({1, 2}, {2})
    grasps = np.asarray(found[PICK].T_world_gripper)[1][np.asarray(free_candidates(found[PICK]))[1, :, 0]]
    # The hand stays as far above what carries the box as it does above the board.
    assert grasps[:, 2, 3].min() > BOARD + 0.07 + 0.0249
    able = jnp.arange(5)[None] == jnp.array([[1], [1]])
    draw = jax.jit(lambda key, scene, found: sample_action(key, problem.space, scene, possible, found, able))
    action = draw(jax.random.key(0), scene, found).action
    assert (int(action.kind), int(action.object)) == (ActionKind.PICK_AND_PLACE, 1)
    after = pick_and_place(scene, jnp.int32(1), action.T_world_gripper, action.T_world_place)
    np.testing.assert_allclose(float(footprints(after).low[1]), BOARD, atol=2e-3)
    assert pairs(after) == set()
    picked, pushed = movable(candidates(after))
    assert picked | pushed == {0, 1, 2}
    # Of three only the uppermost can be moved; of what hangs in the air, nothing can be pushed.
    tower = scene_of(*two(), box((0.025, 0.03, 0.03), 0.55, 0.1, 0.13), box((0.03, 0.03, 0.03), 0.6, -0.12, 0.05))
    assert movable(candidates(tower))[0] <= {2, 3}
    assert movable(candidates(tower))[1] == set()


@pytest.mark.slow
def test_a_push_touches_no_stack(problem, candidates):
    (candidates, possible), stack = candidates, scene_of(*two(0.6), box((0.03, 0.03, 0.05), 0.6, -0.065))
    alone = stack.replace(valid=stack.valid.at[1].set(False))
    found = candidates(alone)[PUSH]
    numbers = np.flatnonzero(np.asarray(free_candidates(found))[2])
    model, nobody = QuasiStatic(), jnp.zeros(5, bool)

    def predicted(scene, number):
        drawn = DrawnCandidate(jnp.int32(2), number, jnp.array(True))
        _, sample = Push().draft(jax.random.key(0), problem.space, scene, possible, found, drawn)
        return Push().predict(problem.space, model, scene, nobody, sample.action, sample.wrist)

    both = jax.jit(jax.vmap(lambda number: (predicted(stack, number), predicted(alone, number))))
    with_top, without = jax.device_get(both(jnp.array(numbers[:: max(1, len(numbers) // 60)])))
    can, could = with_top.possible, without.possible
    assert not (can & ~could).any()
    assert not (can & with_top.moved[:, :2].any(axis=1)).any()
    assert not (can & without.moved[:, 0]).any()
    assert (could & without.moved[:, 0]).any()
    # What ends elsewhere is predicted as if there were no stack, unless the hand, which is broad, meets the upper one.
    aside = could & ~without.moved[:, 0] & (without.scene.position[:, 2, 1] < -0.01)
    assert (can & aside).sum() > 0.6 * aside.sum() > 0
    kept = can & aside
    np.testing.assert_array_equal(with_top.scene.position[kept][:, [0, 2]], without.scene.position[kept][:, [0, 2]])
    np.testing.assert_array_equal(with_top.scene.valid, np.broadcast_to(stack.valid, with_top.scene.valid.shape))


@pytest.mark.slow
def test_a_target_that_carries_something_is_not_taken_out_from_under_it(problem):
    tall, pose = 2 * problem.target.half_size[2], jnp.float32([0.55, 0.1, 0.0])
    stands, gone = (scene_of(box((0.03, 0.03, 0.02), 0.55, 0.1, low), capacity=8) for low in (tall, 0.2))
    assert not bool(best_grasp(problem.target_grasps, stands, pose).feasible)
    assert bool(best_grasp(problem.target_grasps, gone, pose).success)


@pytest.mark.parametrize("low", [0.07, 0.073])
def test_trials_begin_with_the_stack_as_it_is_recognised(problem, low):
    scene = scene_of(*two(low=low), capacity=8)
    cell = TrialSetup(problem.target, problem.shelf, problem.gripper)
    world = jax.device_get(trial_world(*cell[:2], scene, jnp.zeros(3), jnp.array(False)))
    np.testing.assert_allclose(world.position[1, 2], BOARD + low + UPPER[2], atol=1e-6)
    made = scene_at_rest(cell, SimulatorConfig(), world, scene, 1.0)
    rest = made._data.qpos[-63:].reshape(9, 7)
    np.testing.assert_allclose(rest[:2, :3], [[0.55, 0.1, BOARD + 0.035], [0.55, 0.1, BOARD + 0.1]], atol=1.5e-3)


class Watched:
    """Watches an episode: the objects that are seen at every decision."""

    def __init__(self):
        self.seen = []

    def busy(self, stage): ...

    def decided(self, moment):
        self.seen.append(jax.device_get(moment.observation.objects))

    def acted(self, moment): ...


@pytest.mark.slow
def test_a_search_takes_a_stack_apart_from_above(problem):
    """With the shipped default, in MuJoCo."""
    target = load_scenario(example_scenarios()["first-light"]).target

    def entry(half, low):
        place = [0.55, 0.1, BOARD + low + half[2]]
        return {"shape": "box", "half_size": [*half], "position": place, "quaternion": [1, 0, 0, 0]}

    scenario = parse_scenario(
        {
            "format": "mechsearch-scenario",
            "version": 1,
            "name": "stack",
            "objects": [entry(LOWER, 0.0), entry(UPPER, 0.07)],
            "target": {
                "shape": target.shape,
                "half_size": [*target.half_size],
                "position": [0.64, 0.053, BOARD + target.half_size[2]],
                "quaternion": [1, 0, 0, 0],
            },
        },
        "stack",
    )
    assert target_of(scenario) == problem.target
    method, watched = Method(), Watched()
    settings = RunSettings(options=method.options(), trials=method.trials())
    start = Start(scenario, 0)
    episode = run_episode(start, problem, method.policy(), NativeSimulator(), settings, watched)
    assert (episode.retrieved, episode.failure) == (True, None)
    assert [step.failure for step in episode.steps] == [None] * len(episode.steps)
    first, *_ = episode.steps
    assert (first.action.kind, first.action.object) == ("pick-and-place", 1)
    assert pairs(watched.seen[0]) == {(0, 1)}
    # Nothing has fallen over, and what was on top is on the board, with nothing on it.
    for seen in watched.seen[1:]:
        np.testing.assert_allclose(seen.rotation[:2, 2, 2], 1.0, atol=1e-3)
        np.testing.assert_allclose(footprints(seen).low[:2], BOARD, atol=2e-3)
        assert pairs(seen) == set()
