"""What a searcher does before it moves a robot: nothing without a gain, out of the shelf first, and nothing dropped."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from stage import HIDDEN, OPEN, grab
from test_search import CAMERA, IMAGES, TRUSTING, one_push, searcher_of, seen

from mechsearch_jax import planner
from mechsearch_jax.actions import Action
from mechsearch_jax.actions.kinds.nothing import no_action
from mechsearch_jax.actions.registry import ActionKind
from mechsearch_jax.actions.trajectory import grip_for
from mechsearch_jax.belief.impasse import hindrance
from mechsearch_jax.geometry.transforms import make
from mechsearch_jax.planner import initial_belief, update_belief
from mechsearch_jax.problem.workcell import Workcell
from mechsearch_jax.robot.arm_clearance import HAND_FRAME, ArmBody, link_poses, shows_arm, tip_positions
from mechsearch_jax.robot.arm_config import ArmConfig
from mechsearch_jax.robot.grasp_frames import gripper_rotation
from mechsearch_jax.robot.kinematics import HOME
from mechsearch_jax.robot.robot_trajectory import Part
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.session.searcher import UNREPORTED, Searcher
from mechsearch_jax.session.step import gains
from mechsearch_jax.session.whole_trajectory import way_out
from mechsearch_jax.workspace.target import Target


def costly(cost, after):
    """A policy that decides on a push of object 0, with costs before and after it."""

    def policy(key, problem, belief, observation):
        decision = grab(key, problem, belief, observation)
        action = decision.action.replace(kind=jnp.int32(ActionKind.PUSH), object=jnp.int32(0))
        sequences = decision.sequences.replace(cost=jnp.full_like(decision.sequences.cost, after))
        expected = {"cost": jnp.float32(cost), "predicted_cost": jnp.float32(after), "sequences": sequences}
        return decision.replace(action=action, **expected)

    return policy


def inside(searcher):
    """Joint angles in the middle of the retrieval of a target in the open, the hand inside the shelf."""
    trajectory = searcher.next(IMAGES.depth).trajectory
    deepest = int(np.argmax(tip_positions(trajectory.position)[:, 0]))
    return trajectory.position[deepest]


def test_nothing_is_moved_without_an_expected_gain_unless_that_is_wanted(problem):
    step = searcher_of(problem, HIDDEN, policy=costly(11.0, 11.0)).next(IMAGES.depth)
    assert (step.kind, step.trajectory) == ("none", None)
    assert "no gain is expected of what could be done; object 0 hides it at" in step.reason
    bold = dataclasses.replace(TRUSTING, without_gain=True)
    assert (
        "no gain"
        not in searcher_of(problem, HIDDEN, policy=costly(11.0, 11.0), trajectories=bold).next(IMAGES.depth).reason
    )
    assert gains(costly(11.0, 10.0)(jax.random.key(0), problem, initial_belief(problem), seen(HIDDEN)))


def test_where_no_action_gains_anything_it_looks_one_farther(problem):
    """And says what is expected: nothing of the first action, but of what it makes possible."""
    push, horizons = one_push(problem), []

    def plan(rollout, key, objects):
        horizons.append(rollout.config.horizon)
        decision = push(rollout, key, objects)
        cost = jnp.broadcast_to(jnp.float32([9.0, 4.0][: rollout.config.horizon]), decision.sequences.cost.shape)
        sequences = decision.sequences.replace(cost=cost)
        return decision.replace(predicted_cost=jnp.float32(9.0), sequences=sequences)

    policy = planner.search_for_grasp(sequences=4).replace(plan=plan)
    step = searcher_of(problem, HIDDEN, policy=policy).next(IMAGES.depth)
    assert horizons == [1, 2]
    assert step.kind == "push"
    assert "cost 9, 9 expected afterwards, 4 after what it makes possible" in step.reason
    assert step.to_json()["least_cost"] == 4.0
    assert policy.farther.farther.config.horizon == 3
    assert policy.replace(weigh=len).farther.weigh is len


def test_what_blocks_a_target_in_sight_is_named(problem):
    observation = seen(OPEN)
    belief = update_belief(problem, initial_belief(problem), observation)
    assert hindrance(problem, belief, observation.objects) == ""
    # A wide box right before it.
    x, y, _ = np.asarray(belief.found_pose)
    wall = jax.tree.map(lambda a: a[:1], observation.objects)
    wall = wall.replace(
        position=jnp.array([[x - 0.06, y, problem.shelf.board + 0.1]]),
        rotation=jnp.eye(3)[None],
        size=jnp.array([[0.015, 0.15, 0.1]]),
        valid=jnp.array([True]),
    )
    reason = hindrance(problem, belief, wall)
    assert reason.startswith("each of its ")
    assert "object 0 is in the way of" in reason
    nowhere = belief.replace(grasps=belief.grasps.replace(feasible=jnp.zeros_like(belief.grasps.feasible)))
    assert "is possible there in an empty shelf" in hindrance(problem, nowhere, wall)


def test_a_target_that_was_seen_to_be_almost_nowhere_is_probably_not_there(problem):
    belief = initial_belief(problem)
    few = belief.replace(exists=jnp.arange(len(belief.exists)) < 10)
    assert "probably not in this shelf" in hindrance(problem, few, seen(HIDDEN).objects)
    assert "probably" not in hindrance(problem, belief, seen(HIDDEN).objects)


def test_a_hand_inside_the_shelf_comes_out_first_and_straight(problem):
    searcher = searcher_of(problem, OPEN)
    joints = inside(searcher)
    searcher.acted(ok=False, joints=joints)
    step = searcher.next(IMAGES.depth, width=0.0)
    assert (step.kind, step.index) == ("withdraw", 1)
    way = step.trajectory
    np.testing.assert_allclose(way.position[0], joints, atol=1e-6)
    np.testing.assert_allclose(way.position[-1], HOME, atol=1e-6)
    assert way.events == ()
    assert way.report().within()
    tips = tip_positions(way.position)
    out = int(np.argmax(tips[:, 0] < problem.gripper.nearest_outside))
    # Straight back along the hand, then straight out: no point is beside these two lines.
    offset = tips[: out + 1] - tips[0]
    assert (np.diff(offset[:, 0]) < 1e-3).all()
    searcher.acted()
    after = searcher.next(IMAGES.depth)
    assert (after.kind, after.index) == ("retrieve", 1)


def test_a_hand_that_was_stopped_in_a_push_backs_away_from_it_first(problem):
    """By up to a centimetre against the push, measured with the tip's positions; then as from everywhere."""
    observation = without(seen(OPEN))
    joints = inside(searcher_of(problem, OPEN))
    (tip,) = tip_positions(joints[None])
    for advanced, backs in ((0.05, 0.01), (0.004, 0.004)):
        push = no_action().replace(
            kind=jnp.int32(ActionKind.PUSH),
            displacement=jnp.float32([0.0, 0.1, 0.0]),
            T_world_gripper=make(jnp.eye(3), jnp.float32(tip - [0.0, advanced, 0.0])),
        )
        tips = tip_positions(way_out(problem, observation, joints, width=0.0, pushing=push).position)
        straight = tip_positions(way_out(problem, observation, joints, width=0.0).position)
        np.testing.assert_allclose(tips[0], tip, atol=1e-5)
        out = int(np.argmax(tips[:, 0] < problem.gripper.nearest_outside))
        np.testing.assert_allclose(np.min(np.linalg.norm(tips[:out] - tip + [0.0, backs, 0.0], axis=1)), 0.0, atol=1e-3)
        beside = straight - [0.0, backs, 0.0]
        apart = np.linalg.norm(tips[out // 2 : out, None] - beside[None], axis=-1).min(axis=1)
        np.testing.assert_allclose(apart, 0.0, atol=1e-3)


def test_what_the_hand_holds_after_a_failed_grasp_is_asked_for_and_not_dropped(problem):
    searcher = searcher_of(problem, OPEN)
    searcher.next(IMAGES.depth)
    searcher.acted(ok=False)
    step = searcher.next(IMAGES.depth, width=0.034)
    assert (step.kind, step.trajectory) == ("none", None)
    assert "the hand holds something 34 mm wide after a grasp of the target" in step.reason
    searcher.acted(ok=True)
    assert searcher.finished
    empty = searcher_of(problem, OPEN)
    empty.next(IMAGES.depth)
    empty.acted(ok=False)
    assert empty.next(IMAGES.depth, width=0.0).kind == "retrieve"


def picks(key, problem, belief, observation):
    """A policy that picks object 0 of `OPEN` and puts it down beside."""
    rotation = gripper_rotation(jnp.float32(-0.2), jnp.float32(0.436))
    T = make(rotation, jnp.asarray(observation.objects.position[0]) + jnp.float32([0.0, 0.0, 0.01]))
    action = Action(
        kind=jnp.int32(ActionKind.PICK_AND_PLACE),
        object=jnp.int32(0),
        T_world_gripper=T,
        displacement=jnp.zeros(3),
        T_world_place=T.at[:2, 3].add(jnp.float32([-0.04, 0.07])),
        q7=jnp.float32(math.radians(45)),
        opening=jnp.float32(0.08),
    )
    return costly(11.0, 1.0)(key, problem, belief, observation).replace(action=action)


def stopped(searcher, width):
    """The step after the arm was stopped on its way down with object 0 in the hand."""
    trajectory = searcher.next(IMAGES.depth).trajectory
    carrying = np.flatnonzero((trajectory.force > 0.0) & (trajectory.part == Part.ACTION))
    joints = trajectory.position[carrying[-40]]
    searcher.acted(ok=False, joints=joints)
    return searcher.next(IMAGES.depth, width=width)


def without(observation):
    """The same observation without object 0."""
    objects = observation.objects
    return dataclasses.replace(observation, objects=objects.replace(valid=objects.valid.at[0].set(False)))


def test_an_object_in_a_hand_that_was_stopped_is_taken_out_and_put_back(problem, tmp_path):
    shown = [seen(OPEN)]
    of_shown = {"policy": picks, "recogniser": lambda problem: lambda *images: shown[-1]}
    searcher = searcher_of(problem, OPEN, **of_shown)
    step = stopped(searcher, 0.058)
    assert (step.kind, step.index) == ("withdraw", 1)
    assert "the hand holds something 58 mm wide after a grasp of object 0" in step.reason
    assert step.trajectory.events == ()
    np.testing.assert_array_equal(step.trajectory.width, 0.058)
    assert (step.trajectory.force[1:] > 0.0).all()
    # A search that is gone on with after a crash knows of it, too.
    searcher.save(tmp_path / "search.npz")
    searcher = searcher_of(problem, OPEN, **of_shown)
    searcher.load(tmp_path / "search.npz")
    searcher.acted()
    blocked = searcher.next(IMAGES.depth, width=0.058)
    assert (blocked.kind, blocked.trajectory) == ("none", None)
    assert "on the way to its place the hand, or object 0 in it, would touch object 0" in blocked.reason
    shown.append(without(shown[0]))
    back = searcher.next(IMAGES.depth, width=0.058)
    assert (back.kind, back.index) == ("put-back", 1)
    way = back.trajectory
    assert way.report().within()
    np.testing.assert_allclose(way.position[[0, -1]], [HOME, HOME], atol=1e-6)
    opens = np.flatnonzero(np.diff((way.force > 0.0).astype(int)) < 0)
    (place,) = tip_positions(way.position[opens]) - np.asarray(seen(OPEN).objects.position[0])
    np.testing.assert_allclose(place[:2], 0.0, atol=1e-3)
    assert 0.012 < place[2] < 0.022
    assert [(event.kind, event.waits) for event in way.events] == [("move", True)]
    searcher.acted()
    shown.append(shown[0])
    after = searcher.next(IMAGES.depth, width=0.08)
    assert (after.kind, after.index) == ("pick-and-place", 1)


def test_what_is_in_a_hand_that_was_stopped_is_not_moved_where_that_is_not_safe(problem):
    other = stopped(searcher_of(problem, OPEN, policy=picks), 0.03)
    assert (other.kind, other.trajectory) == ("none", None)
    assert "it is not moved: 65 mm were expected" in other.reason
    shown = [seen(OPEN)]
    searcher = searcher_of(problem, OPEN, policy=picks, recogniser=lambda problem: lambda *images: shown[-1])
    stopped(searcher, 0.058)
    searcher.acted()
    shown.append(without(shown[0]))
    assert searcher.next(IMAGES.depth, width=0.058).kind == "put-back"
    searcher.acted(ok=False, joints=HOME)
    assert searcher.next(IMAGES.depth, width=0.058).kind == "none"
    # A target is taken out of the shelf, and then asked for.
    searcher = searcher_of(problem, OPEN)
    searcher.acted(ok=False, joints=inside(searcher))
    step = searcher.next(IMAGES.depth, width=0.04)
    assert (step.kind, float(step.trajectory.force[-1]) > 0.0) == ("withdraw", True)
    searcher.acted()
    assert "if it is the target, call acted(ok=True)" in searcher.next(IMAGES.depth, width=0.04).reason
    searcher.acted(ok=True)
    assert searcher.finished


def test_a_grasp_that_failed_twice_is_not_tried_a_third_time(problem):
    searcher = searcher_of(problem, OPEN)
    for _ in range(2):
        assert searcher.next(IMAGES.depth).kind == "retrieve"
        searcher.acted(ok=False)
    step = searcher.next(IMAGES.depth)
    assert step.kind == "none"
    assert "it failed 2 times at this place" in step.reason


def test_a_push_that_failed_twice_is_not_tried_a_third_time(problem):
    made = []

    def policy(*arguments):
        made.append(costly(10.0, 5.0)(*arguments))
        return made[-1]

    searcher = searcher_of(problem, OPEN, policy=policy)
    for _ in range(2):
        assert "failed" not in searcher.next(IMAGES.depth).reason
        # As if it had been handed out.
        searcher._state = dataclasses.replace(searcher._now, handed=True, action=made[-1].action)
        searcher.acted(ok=False)
    assert "it failed 2 times at this place" in searcher.next(IMAGES.depth).reason


def test_a_motion_that_was_not_reported_is_warned_of(problem):
    searcher = searcher_of(problem, OPEN)
    assert UNREPORTED not in searcher.next(IMAGES.depth).warnings
    assert UNREPORTED in searcher.next(IMAGES.depth).warnings


def test_a_search_goes_on_with_a_corrected_camera_and_another_speed(problem, tmp_path):
    path = tmp_path / "search.npz"
    searcher_of(problem, OPEN).save(path)
    turned = dataclasses.replace(CAMERA, position=tuple(np.add(CAMERA.position, 0.002).tolist()))
    searcher_of(problem, OPEN, workcell=Workcell(camera=turned, arm=ArmConfig(speed=0.2))).load(path)
    with pytest.raises(InputError, match="of another workcell"):
        searcher_of(problem, OPEN, workcell=Workcell(camera=dataclasses.replace(CAMERA, fx=500.0))).load(path)


def test_the_arm_in_an_image_counts_as_not_measured(problem):
    searcher = searcher_of(problem, OPEN)
    joints = inside(searcher)
    # A plane through the middle of the hand: the hand is in it, and nothing far from the hand is.
    hand = link_poses(joints[None])[0, HAND_FRAME]
    middle = hand[:3, 3] + 0.03 * hand[:3, 2]
    depth = np.full((CAMERA.height, CAMERA.width), 0.0, np.float32)
    away = (middle - np.array(CAMERA.position)) @ np.array(CAMERA.rotation)
    depth[:] = away[2]
    shown = shows_arm(CAMERA, depth, ArmBody.of(0.08), joints)
    row, column = (
        round(float(f * a / away[2] + c - 0.5))
        for f, a, c in ((CAMERA.fy, away[1], CAMERA.cy), (CAMERA.fx, away[0], CAMERA.cx))
    )
    assert shown[row, column]
    assert 0 < shown.mean() < 0.1
    rows, columns = np.nonzero(shown)
    reach = 0.25 / away[2] * CAMERA.fx
    assert math.hypot(np.abs(rows - row).max(), np.abs(columns - column).max()) < 2 * reach
    assert not shows_arm(CAMERA, depth, ArmBody.of(0.08), np.array(HOME)).any()
    kept = searcher._without_arm(depth, joints)
    assert np.isnan(kept[shown]).all()
    assert np.array_equal(kept[~shown], depth[~shown])


def test_a_robot_brushes_nothing_unless_it_may():
    assert not Searcher().config.planner.retrieval_contact


def test_a_target_may_have_been_grasped_by_its_other_sides(problem):
    box = dataclasses.replace(Target.of("box"), half_size=(0.0225, 0.0175, 0.055))
    observation = seen(OPEN)
    belief = update_belief(problem, initial_belief(problem), observation)
    action = grab(jax.random.key(0), problem, belief, observation).action
    grip = grip_for(problem.replace(target=box), observation, action.replace(opening=jnp.float32(0.08)))
    # Turned as it may be, it is at most as wide as its diagonal.
    assert (grip.low, grip.high) == (pytest.approx(0.035, abs=1e-3), pytest.approx(0.051, abs=7e-3))
