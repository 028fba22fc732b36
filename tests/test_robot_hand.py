"""The real hand: how wide what it grasps is, how long it takes, and that the arm waits for it."""

import functools
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from test_search_whole_trajectory import CONFIG, HERE, PLACE, Q7, SETTING, grasp, pushed, seen

from mechsearch_jax.actions import Action, joint_trajectory
from mechsearch_jax.actions.kinds.retrieve import retrieve_action
from mechsearch_jax.geometry.superquadric import empty
from mechsearch_jax.geometry.transforms import yaw_rotation
from mechsearch_jax.robot.arm_clearance import tip_positions
from mechsearch_jax.robot.gripper import Gripper
from mechsearch_jax.robot.hand import (
    EMPTY,
    Grip,
    HandConfig,
    grip_of,
    grip_of_any_yaw,
    grip_of_anything,
    stroke,
)
from mechsearch_jax.robot.kinematics import gripper_pose
from mechsearch_jax.robot.robot_trajectory import Part
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.session.whole_trajectory import TrajectoryConfig, whole_trajectory
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

ACROSS = np.array([0.0, -1.0, 0.0])
BOX = (0.2, 0.2)
ROUND = (0.2, 1.0)
# Where a target can stand beside the robot.
BESIDE = (0.35, -0.45, 0.1)


def yawed(degrees):
    return np.asarray(yaw_rotation(jnp.float32(np.radians(degrees))), float)


def picked(scene, place=(0.6, -0.1)):
    """A pick-and-place of object 0 across the shelf."""
    T_place = grasp(0.08).at[:2, 3].set(jnp.float32(place))
    return Action(
        kind=jnp.int32(2),
        object=jnp.int32(0),
        T_world_gripper=grasp(0.08),
        displacement=jnp.zeros(3),
        T_world_place=T_place,
        q7=Q7,
        opening=jnp.float32(0.08),
    )


def standing(size=(0.02, 0.025, 0.08), degrees=0.0, exponents=BOX):
    """A scene of one object where the hand grasps."""
    scene = empty(8)
    return scene.replace(
        size=scene.size.at[0].set(jnp.float32(size)),
        exponents=scene.exponents.at[0].set(jnp.float32(exponents)),
        position=scene.position.at[0].set(jnp.float32([*PLACE, Shelf().board + size[2]])),
        rotation=scene.rotation.at[0].set(jnp.float32(yawed(degrees))),
        valid=scene.valid.at[0].set(True),
    )


def with_hand(**changes):
    return TrajectoryConfig(motion=CONFIG.motion, **changes)


def check(trajectory, hand, widest=0.08):
    """The hand never moves faster than it can, nor the arm while it waits for the hand, and events fit the rows."""
    step = 0.004
    width, force = trajectory.width, trajectory.force
    assert width.min() >= 0.0
    assert width.max() <= widest + 1e-9
    assert np.abs(np.diff(width)).max() / step <= hand.speed * (1 + 1e-6)
    assert trajectory.report().within()
    now = 0.0
    for event in trajectory.events:
        assert event.start >= now - 1e-9
        now = event.start + event.duration
        assert now <= trajectory.time[-1] + 1e-9
        first, last = round(event.start / step), round(now / step + 0.499)
        assert event.speed == hand.speed
        assert 0.0 <= event.width <= widest
        assert width[min(last, len(width) - 1)] == pytest.approx(event.width, abs=1e-9)
        # What the real hand needs at most: all of its way, at its speed, and its reserve.
        assert event.duration >= abs(width[first] - event.width) / hand.speed + hand.settle - 1e-9
        if event.waits:
            np.testing.assert_array_equal(np.ptp(trajectory.position[first : last + 1], axis=0), 0.0)
            assert np.abs(trajectory.velocity[first : last + 1]).max() < 2e-2
        if event.kind == "grasp":
            assert event.width > event.inner + EMPTY / 2 > 0.0
            assert event.force == hand.force
            assert (force[first : first + 2] == 0.0).all()
            assert force[last] == hand.force
    # Between events nothing changes.
    changes = np.flatnonzero(np.diff(width) != 0.0) + 1
    spans = [(e.start / step, (e.start + e.duration) / step + 1) for e in trajectory.events]
    assert all(any(a <= row <= b for a, b in spans) for row in changes)


@settings(max_examples=12, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    kind=st.sampled_from(["push", "pick-and-place", "retrieve"]),
    shift=st.tuples(st.floats(-0.08, 0.08), st.floats(-0.2, 0.15), st.floats(0.0, 0.03)),
    size=st.tuples(st.floats(0.008, 0.037), st.floats(0.008, 0.037)),
    degrees=st.floats(-90.0, 90.0),
    width=st.one_of(st.none(), st.floats(0.0, 0.08)),
    speed=st.sampled_from([0.3, 1.0]),
    fingers=st.sampled_from([0.02, 0.1, 0.3]),
)
def test_the_hand_has_its_time_in_every_trajectory(kind, shift, size, degrees, width, speed, fingers):
    scene = standing((*size, 0.08), degrees)
    moved = jnp.zeros((4, 4)).at[:3, 3].set(jnp.float32(shift))
    action = picked(scene) if kind == "pick-and-place" else retrieve_action(grasp(), Q7, jnp.float32(0.08))
    if kind == "push":
        action = action.replace(
            kind=jnp.int32(1), displacement=jnp.float32([0.0, -0.05, 0.0]), opening=jnp.float32(0.0)
        )
    action = action.replace(T_world_gripper=action.T_world_gripper + moved)
    hand = HandConfig(speed=fingers)
    try:
        trajectory = whole_trajectory(
            SETTING, seen(scene, visible=False), action, width=width, speed=speed, config=with_hand(hand=hand)
        )
    except InputError as error:
        # Where the arm cannot go there is no trajectory to be checked.
        if not any(words in str(error) for words in ("reach", "touches", "no way")):
            raise
        return
    check(trajectory, hand)
    kinds = [event.kind for event in trajectory.events]
    assert kinds == {"push": ["move"], "retrieve": ["move", "grasp"]}.get(kind, ["move", "grasp", "move"])
    assert trajectory.events[0].start == 0.0
    assert trajectory.events[0].width == (0.0 if kind == "push" else pytest.approx(0.08))


@functools.cache
def retrieved(place=(), target="cylinder"):
    setting = types.SimpleNamespace(**{**vars(SETTING), "target": Target.of(target)})
    action = retrieve_action(grasp(), Q7, jnp.float32(0.08))
    return whole_trajectory(setting, seen(), action, width=0.0, config=with_hand(place=place))


def test_what_is_gripped_has_its_own_width():
    event = retrieved().events[-1]
    assert (event.kind, event.waits) == ("grasp", True)
    assert event.width == pytest.approx(0.04)
    assert (event.inner, event.outer) == (0.01, 0.01)
    action = picked(standing((0.012, 0.025, 0.08), 90.0))
    trajectory = whole_trajectory(SETTING, seen(standing((0.012, 0.025, 0.08), 90.0), False), action, config=CONFIG)
    # The hand is turned by 0.1 rad.
    assert trajectory.events[1].width == pytest.approx(0.024, abs=3e-3)
    check(trajectory, HandConfig())
    gripped = trajectory.force > 0.0
    np.testing.assert_allclose(trajectory.width[gripped], trajectory.events[1].width)


@pytest.mark.parametrize(
    ("size", "degrees", "exponents", "low", "high"),
    [
        ((0.02, 0.03, 0.1), 0.0, BOX, 0.06, 0.06),
        ((0.02, 0.03, 0.1), 90.0, BOX, 0.04, 0.04),
        ((0.02, 0.03, 0.1), 10.0, BOX, 0.06, 0.066),
        ((0.02, 0.02, 0.1), 33.0, ROUND, 0.04, 0.04),
        ((0.02, 0.09, 0.1), 0.0, BOX, 0.077, 0.077),
    ],
)
def test_the_width_is_that_along_the_closing_direction(size, degrees, exponents, low, high):
    grip = grip_of(ACROSS, yawed(degrees), np.array(size), np.array(exponents), 0.08)
    assert (grip.low, grip.high) == (pytest.approx(low, abs=1e-6), pytest.approx(high, abs=1e-3))
    assert grip.low <= grip.width <= grip.high


def test_nothing_is_ever_grasped_at_width_0():
    hand = HandConfig()
    widest = grip_of(ACROSS, np.eye(3), np.array((0.04, 0.04, 0.1)), np.array(BOX), 0.08)
    usable = grip_of(ACROSS, np.eye(3), np.full(3, Gripper().usable_opening / 2), np.array(BOX), 0.08)
    assert usable.width == pytest.approx(Gripper().usable_opening)
    any_yaw = grip_of_any_yaw((0.01, 0.03, 0.05), 0.08)
    for grip in (grip_of_anything(0.08), any_yaw, Grip(0.0061, 0.0061), usable, widest):
        event = grip.grasp(0.08, 1.0, 0.5, hand)
        assert event.width > 0.0
        # Fingers that closed on nothing are no grasp; those that did not close are none, either.
        assert event.width - event.inner > EMPTY / 2
        assert event.width + event.outer <= 0.08 - EMPTY + 1e-9
        assert event.width - event.inner < max(grip.low, 2 * EMPTY)
    assert grip_of(ACROSS, np.eye(3), np.full(3, 1e-4), np.array(BOX), 0.08).width == pytest.approx(2 * EMPTY)


def test_a_push_begins_with_closed_fingers():
    trajectory = pushed(width=0.03)
    check(trajectory, HandConfig())
    (closes,) = trajectory.events
    assert (closes.kind, closes.width, closes.waits) == ("move", 0.0, False)
    assert (trajectory.width[trajectory.part == Part.ACTION] == 0.0).all()


def test_fingers_move_at_their_speed_and_then_rest():
    hand = HandConfig(speed=0.05, settle=0.3)
    width, arrived = stroke(0.08, 0.02, 700, 0.004, hand)
    assert np.abs(np.diff(np.concatenate([[0.08], width]))).max() / 0.004 <= 0.05
    assert (width[arrived >= 0] == 0.02).all()
    assert hand.time(0.06) == pytest.approx(1.5 * 0.06 / 0.05 + 0.3)
    still, _ = stroke(0.03, 0.03, 5, 0.004, hand)
    assert (still == 0.03).all()


def test_the_present_opening_decides_how_long_the_way_there_takes_at_least():
    def first(width):
        action = retrieve_action(grasp(), Q7, jnp.float32(0.08))
        return whole_trajectory(SETTING, seen(), action, width=width, config=CONFIG).events[0]

    hand = HandConfig()
    assert first(0.08).duration == pytest.approx(hand.settle)
    assert first(0.0).duration == pytest.approx(hand.time(0.08))
    # Not known: the arm waits for the longest way.
    assert first(None).duration == pytest.approx(hand.time(0.08))
    assert first(None).width == pytest.approx(0.08)
    slow = whole_trajectory(
        SETTING,
        seen(),
        retrieve_action(grasp(), Q7, jnp.float32(0.08)),
        width=0.0,
        config=with_hand(hand=HandConfig(speed=0.01)),
    )
    begins = slow.time[np.argmax(slow.part == Part.ACTION)]
    assert begins >= 1.5 * 0.08 / 0.01
    with pytest.raises(InputError, match=r"width: 8\.0 m"):
        first(8.0)


@pytest.mark.parametrize("width", ["0.04", "x", True, [0.04], np.zeros(2), float("nan"), object()])
def test_a_width_that_is_no_number_is_refused_in_a_line(width):
    action = retrieve_action(grasp(), Q7, jnp.float32(0.08))
    for make in (
        lambda: whole_trajectory(SETTING, seen(), action, width=width, config=CONFIG),
        lambda: joint_trajectory(SETTING, action, CONFIG.motion, width=width),
    ):
        with pytest.raises(InputError, match=r"^width: [^\n]*$"):
            make()


def test_the_plain_trajectory_of_an_action_waits_for_the_hand_too():
    action, hand = retrieve_action(grasp(), Q7, jnp.float32(0.08)), HandConfig()
    trajectory = joint_trajectory(SETTING, action, CONFIG.motion, observation=seen(), width=0.01)
    opens, closes = trajectory.events
    assert (opens.kind, opens.start, opens.width) == ("move", 0.0, pytest.approx(0.08))
    assert closes.width == pytest.approx(0.04)
    width, position = np.asarray(trajectory.gripper), np.asarray(trajectory.position)
    assert np.abs(np.diff(width)).max() / 0.004 <= 0.1 * 1.001
    for event in trajectory.events:
        # Its row i comes i + 1 steps after the beginning.
        first, last = round(event.start / 0.004), round((event.start + event.duration) / 0.004)
        assert np.ptp(position[max(first - 1, 0) : last], axis=0).max() == 0.0
    assert width[-1] == pytest.approx(0.04)
    is_open = joint_trajectory(SETTING, action, CONFIG.motion, width=0.08)
    assert is_open.events[0].duration == pytest.approx(hand.settle, abs=0.005)
    # Not known: after a push they are closed.
    usual = joint_trajectory(SETTING, action, CONFIG.motion)
    assert usual.events[0].duration == pytest.approx(hand.time(0.08), abs=0.005)
    anything = usual.events[1]
    assert anything.width - anything.inner < 0.01 < 0.07 < anything.width + anything.outer
    assert len(jax.tree.leaves(usual)) == 4


def test_the_target_is_put_down_where_it_is_to_stand():
    trajectory, hand = retrieved(BESIDE), HandConfig()
    assert trajectory.place_fault == ""
    check(trajectory, hand)
    assert [event.kind for event in trajectory.events] == ["move", "grasp", "move"]
    assert trajectory.ends_at_home
    np.testing.assert_allclose(trajectory.position[-1], HERE, atol=1e-9)
    row = trajectory.put_down
    assert trajectory.part[row] == Part.PLACE
    assert trajectory.time[row] == pytest.approx(trajectory.events[-1].start)
    # The target was grasped 5 cm above the board, in the middle of its 10 cm, and is let go as high above the place and
    # what a corner of it can hang.
    tip = tip_positions(trajectory.position[row][None])[0]
    np.testing.assert_allclose(tip[:2], BESIDE[:2], atol=4e-3)
    assert 0.0 < tip[2] - BESIDE[2] - 0.05 < 0.012
    tilted = np.asarray(gripper_pose(jnp.asarray(trajectory.position[row])))
    assert tilted[2, 2] == pytest.approx(float(grasp()[2, 2]), abs=1e-3)
    assert (trajectory.force[row + 1 :] == 0.0).all()
    assert trajectory.width[-1] == pytest.approx(0.08)
    # The hand backs away before it leaves.
    away = tip_positions(trajectory.position[trajectory.part == Part.PLACE][-1:])[0]
    assert np.linalg.norm(away - tip) == pytest.approx(0.1, abs=5e-3)


def test_the_hand_opens_at_joint_angles_that_are_given():
    bin_above = tuple((HERE + np.array([-0.7, 0.2, 0, 0, 0, 0, 0])).tolist())
    trajectory = retrieved(bin_above)
    check(trajectory, HandConfig())
    np.testing.assert_allclose(trajectory.position[trajectory.put_down], bin_above, atol=1e-6)
    assert trajectory.width[-1] == pytest.approx(0.08)


def test_a_place_out_of_reach_leaves_the_target_in_the_hand_and_says_so():
    trajectory = retrieved((1.5, 0.0, 0.0))
    assert "does not reach [1.5, 0.0, 0.0]" in trajectory.place_fault
    assert trajectory.put_down is None
    assert trajectory.force[-1] == HandConfig().force
    np.testing.assert_array_equal(trajectory.position, retrieved().position)
    assert "the target stays in the hand: place" in str(trajectory.report())
    inside = retrieved((0.55, 0.0, Shelf().board))
    assert inside.place_fault
    assert inside.put_down is None
