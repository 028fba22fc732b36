"""Twelve objects instead of eight: masks, files, trials, and decisions that do not depend on the room for them."""

import dataclasses
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax import planner
from mechsearch_jax.actions.kinds.nothing import no_action
from mechsearch_jax.config.config import PlannerConfig, Weights
from mechsearch_jax.dynamics.quasi_static import QuasiStatic
from mechsearch_jax.envs.trials.native import NativeTrials, near_path
from mechsearch_jax.geometry.superquadric import empty, pad
from mechsearch_jax.grasping.graspability import INFEASIBLE, graspability, pairs
from mechsearch_jax.images.checks import Look
from mechsearch_jax.images.image_files import load_mask
from mechsearch_jax.images.labels import FREE, OTHER
from mechsearch_jax.observation import Observation
from mechsearch_jax.perception.recogniser import Recogniser
from mechsearch_jax.perception.segmentation import leave_out_smallest
from mechsearch_jax.planner.rollout import present_state
from mechsearch_jax.planner.trials import TrialResult, scenes_of
from mechsearch_jax.problem.settings import load_settings
from mechsearch_jax.problem.workcell import Workcell
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.session import preparing, warming
from mechsearch_jax.session.faults import recognition_warnings
from mechsearch_jax.session.searcher import Searcher
from mechsearch_jax.session.whole_trajectory import TrajectoryConfig
from mechsearch_jax.workspace import scenario
from mechsearch_jax.workspace.camera import Camera, rays
from mechsearch_jax.workspace.render import object_depth
from mechsearch_jax.workspace.scenario import Body, superquadrics
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

# A table, and a camera as of a Kinect that looks down at it by 40 degrees from 1 m.
TABLE = Shelf(front=0.4, back=1.0, right=-0.45, left=0.45, board=0.4, ceiling=0.85, faces=())
DOWN = np.deg2rad(40.0)
SIN, COS = float(np.sin(DOWN)), float(np.cos(DOWN))
ROTATION = ((0.0, -SIN, COS), (-1.0, 0.0, 0.0), (0.0, -COS, -SIN))
KINECT = Camera(640, 480, 525.0, 525.0, 320.0, 240.0, ROTATION, (0.7 - COS, 0.0, 0.43 + SIN))
KEY = jax.random.key(0)
# Twelve boxes, each with its place.
BOXES = [
    Body(
        "box",
        (0.02 + 0.003 * (i % 3), 0.03, 0.03 + 0.004 * (i % 4)),
        (x, y, 0.43 + 0.004 * (i % 4)),
        (1.0, 0.0, 0.0, 0.0),
    )
    for i, (x, y) in enumerate((x, y) for x in (0.52, 0.68, 0.84) for y in (-0.27, -0.09, 0.09, 0.27))
]


SETTING = types.SimpleNamespace(camera=KINECT, shelf=TABLE, target=Target.cylinder())


def recogniser(capacity):
    return Recogniser(SETTING, capacity=capacity)


@pytest.fixture(scope="module")
def look():
    """Depth of the table with noise of 1 mm, and the box that each pixel shows."""
    origin, directions = jnp.array(KINECT.position), rays(KINECT)
    each = jax.jit(lambda s: jax.lax.map(lambda one: object_depth(one, origin, directions), s))
    depths = np.asarray(each(superquadrics(BOXES, len(BOXES))))
    board = warming.board_depth(KINECT, TABLE)
    depth = np.minimum(depths.min(axis=0), board)
    mask = np.where(depths.min(axis=0) < board, depths.argmin(axis=0), FREE)
    return (depth + np.random.default_rng(0).normal(0.0, 1e-3, depth.shape)).astype(np.float32), mask.astype(np.int32)


def found(objects):
    """Of each box, which slots hold an object within 1 cm of its middle."""
    apart = np.linalg.norm(np.asarray(objects.position)[None] - np.array([b.position for b in BOXES])[:, None], axis=-1)
    return (apart < 0.01) & np.asarray(objects.valid)[None]


@pytest.mark.slow
def test_twelve_instances_of_a_mask_are_twelve_objects_in_its_order(look):
    depth, mask = look
    seen = recogniser(16)(KEY, depth, mask=mask, target_id=-1)
    assert seen.objects.capacity == len(seen.confidence) == 16
    np.testing.assert_array_equal(found(seen.objects), np.eye(12, 16, dtype=bool))
    # The target's slot goes to the instance beyond the slots.
    many = np.where(mask == 3, 16, mask)
    seen = recogniser(16)(KEY, depth, mask=np.where(mask == 5, 0, np.where(mask == 0, 5, many)), target_id=0)
    expected = np.eye(12, 16, dtype=bool)[[5, 1, 2, 0, 4, 3, *range(6, 12)]]
    expected[5] = False
    np.testing.assert_array_equal(found(seen.objects), expected)
    with pytest.raises(InputError, match="objects are 0 to 8, all else -1, -2 or -3; for more things, set capacity"):
        recogniser(8)(KEY, depth, mask=mask, target_id=-1)


@pytest.mark.parametrize(("count", "capacity"), [(9, 8), (18, 16), (18, 12), (9, 3), (9, 9)])
def test_the_largest_segments_stay_with_small_numbers(count, capacity):
    rng = np.random.default_rng(count + capacity)
    sizes = rng.permutation(np.arange(count)) * (rng.random(count) < 0.8)
    labels = np.concatenate([np.repeat(np.arange(count), sizes), [FREE, OTHER]])[None].astype(np.int8)
    kept = np.asarray(leave_out_smallest(jnp.asarray(labels), count, capacity))
    largest = sorted(np.argsort(sizes, kind="stable")[-capacity:].tolist())
    for number in range(count):
        after = np.unique(kept[labels == number])
        if sizes[number]:
            assert len(after) == 1
            assert (after[0] == OTHER) == (number not in largest)
            assert after[0] in ((number,) if number < capacity and number in largest else (*range(capacity), OTHER))
    assert kept[0, -2:].tolist() == [FREE, OTHER]
    assert len(np.unique(kept[kept >= 0])) == sum(sizes[number] > 0 for number in largest)


def test_the_file_and_the_workcell_say_how_many(tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text("[objects]\ncapacity = 12\n")
    assert load_settings(file).workcell == Workcell(capacity=12)
    assert hash(Workcell(capacity=12)) != hash(Workcell())
    for wrong in ("0", "17", "8.5"):
        file.write_text(f"[objects]\ncapacity = {wrong}\n")
        with pytest.raises(InputError, match=r"mine\.toml:2: \[objects\] capacity") as caught:
            load_settings(file)
        assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match="Workcell: capacity: 17 must be a whole number of objects, 1 to 16"):
        Workcell(capacity=17)
    with pytest.raises(InputError, match="capacity: True must"):
        recogniser(True)
    np.save(tmp_path / "mask.npy", np.arange(12).reshape(3, 4))
    assert len(load_mask(tmp_path / "mask.npy", 255, 11)[1]) == 12
    with pytest.raises(InputError, match="names 12 objects; at most 11 can be told apart; for more things, set cap"):
        load_mask(tmp_path / "mask.npy", 255, 10)


def test_a_search_is_saved_with_its_slots(tmp_path, problem):
    many, few = (Searcher(Workcell(capacity=n)) for n in (16, 8))
    many.__dict__["problem"] = few.__dict__["problem"] = problem
    many.save(tmp_path / "search.npz")
    many.load(tmp_path / "search.npz")
    assert many._now.observation.objects.capacity == 16
    with pytest.raises(InputError, match="is missing or of another shape"):
        few.load(tmp_path / "search.npz")


def test_a_full_observation_says_how_to_hold_more(look):
    depth, _ = look
    bodies = superquadrics(BOXES[:8], 8)
    seen = preparing.nothing_seen().replace(objects=bodies)
    see = recogniser(8)
    warnings = recognition_warnings(SETTING, Look(KINECT, TABLE, depth), seen, see)
    assert any("all 8 slots are taken" in w and "set capacity, now 8, to up to 16" in w for w in warnings)


def test_trials_have_room_for_what_is_nearest_to_the_gripper():
    objects = jax.device_get(superquadrics(BOXES, 16))
    T = np.eye(4, dtype=np.float32)
    T[:3, :3], T[:3, 3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]], (0.6, -0.27, 0.45)
    action = jax.device_get(no_action().replace(T_world_gripper=T, T_world_place=T, object=11))
    kept = near_path(objects, action, 0.3)
    assert len(kept) == 8
    # The row that the hand goes along, the next one, and what it acts on.
    assert {0, 1, 4, 5, 11} <= set(kept)
    assert not {3, 7} & set(kept)
    assert near_path(jax.tree.map(lambda a: a[:8], objects), action, 0.3) == tuple(range(8))


@pytest.mark.slow
def test_a_decision_among_twelve_objects_is_made_and_tried(problem):
    """Its trials come to what those of the eight nearest objects alone come to."""
    placed = [
        dataclasses.replace(body, half_size=(*body.half_size[:2], 0.08), position=(x, y, problem.shelf.board + 0.08))
        for body, (x, y) in zip(
            BOXES, ((x, y) for x in (0.48, 0.58, 0.69) for y in (-0.14, 0.0, 0.14, 0.28)), strict=True
        )
    ]
    seen = Observation(superquadrics(placed, 16), jnp.array(False), jnp.zeros(3)).judged()
    cell = Workcell(capacity=16)
    searcher = Searcher(
        cell,
        recogniser=lambda _: lambda *images: seen,
        trajectories=TrajectoryConfig(doubt=warming.TRUSTING),
    )
    searcher.__dict__["problem"] = problem
    step = searcher.next(*warming.images(cell.camera, cell.shelf, False, False, False))
    assert step.kind in ("push", "pick-and-place")
    assert len(step.to_json()["objects"]) == 12
    assert step.picture is not None

    action = jax.device_get(step.decision.action)
    kept = list(near_path(jax.device_get(seen.objects), action, problem.gripper.approach))
    near = seen.replace(objects=jax.tree.map(lambda a: a[np.array(kept)], seen.objects))
    results = [
        NativeTrials()(
            problem,
            jax.tree.map(lambda a: jnp.asarray(a)[None], scenes_of(step.belief, observation)),
            jax.tree.map(lambda a: jnp.asarray(a)[None, None], action.replace(object=np.int32(number))),
            np.ones((1, 1), bool),
        )
        for observation, number in ((seen, int(action.object)), (near, kept.index(int(action.object))))
    ]
    assert results[0] == results[1] != TrialResult.UNKNOWN


CAPACITIES = (8, 12)


@pytest.fixture(scope="module")
def objects():
    return scenario.superquadrics(scenario.load_scenario(scenario.example_scenarios()["crowded-shelf"]).objects)


def same(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def test_g_and_j_are_the_same(problem):
    rng = np.random.default_rng(0)
    belief = planner.initial_belief(problem)
    found_belief = belief.replace(found=jnp.array(True))
    rows = pairs(problem.grasps, belief.grasps.feasible)
    count = problem.poses.shape[0]
    exists, somewhere = jnp.asarray(rng.random(count) < 0.3), jnp.arange(count) == 400
    # Of eight objects and the target; more than there were counted as one more than there can be.
    hits = jnp.asarray(rng.random((rows.pose.shape[0], 9)) < 0.8).at[:, 8].set(False)
    wider = jnp.concatenate([hits[:, :8], jnp.zeros((len(hits), 4), bool), hits[:, 8:]], axis=1)
    g = np.asarray(graspability(rows, hits))
    np.testing.assert_array_equal(g, graspability(rows, wider))
    nothing = ~np.isin(np.arange(len(g)), np.asarray(rows.pose)[np.asarray(rows.allowed)])
    assert nothing.any()
    assert (g[nothing] == 1 - INFEASIBLE).all()
    assert g[~nothing].min() > 1 - INFEASIBLE
    for objective in (planner.search_for_grasp().objective, planner.search_and_grasp().objective):
        # Where a found target is hidden, no grasp counts.
        for known, at in (
            (belief, jnp.zeros_like(somewhere)),
            (found_belief, jnp.zeros_like(somewhere)),
            (found_belief, somewhere),
        ):
            state = present_state(problem, known, empty(8), PlannerConfig())
            state = state.replace(exists=exists | somewhere, target_at=at)
            costs = [float(objective.cost(problem, known, state.replace(hits=h), Weights())) for h in (hits, wider)]
            assert costs[0] == costs[1]


@pytest.mark.slow
def test_two_capacities_make_one_decision(problem, objects):
    policy = planner.search_for_grasp(sequences=6, horizon=2, push_model=QuasiStatic(), later_push_model=QuasiStatic())
    for found in (False, True):
        decisions = []
        for capacity in CAPACITIES:
            seen = Observation(pad(objects, capacity), jnp.array(found), jnp.float32([0.6, 0.1, 0.0]))
            belief = planner.update_belief(problem, planner.initial_belief(problem), seen)
            decisions.append(policy(jax.random.key(5), problem, belief, seen))
        one, other = decisions
        same(one.sequences.actions.kind, other.sequences.actions.kind)
        # The target's slot is the last one, whichever that is.
        moved = [
            -1 if int(decision.action.object) == capacity else int(decision.action.object)
            for decision, capacity in zip(decisions, CAPACITIES, strict=True)
        ]
        assert moved[0] == moved[1]
        actions = (decision.action.replace(object=0) for decision in decisions)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), *actions)
        np.testing.assert_allclose([one.value, one.cost], [other.value, other.cost], rtol=1e-5)
