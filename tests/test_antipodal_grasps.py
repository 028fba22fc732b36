"""Grasps of a found target of pieces that are spread over all opposite places of its surface."""

import dataclasses
import functools
import math

import numpy as np
import pytest
from test_workspace_target import BOTTLE, CUP, TEE

from mechsearch_jax.grasping import antipodal as places
from mechsearch_jax.grasping.antipodal import STEEPEST, WRISTS, antipodal_grasps, spread
from mechsearch_jax.grasping.closings import OpenHand
from mechsearch_jax.grasping.config import GraspConfig
from mechsearch_jax.grasping.graspability import grasp_tables, is_grasp
from mechsearch_jax.robot.gripper import Gripper, primitives_in_gripper
from mechsearch_jax.robot.pads import grip_between
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.shapes.compound import Piece
from mechsearch_jax.shapes.solid import surface
from mechsearch_jax.workspace.target import Target

TARGETS = {name: Target.from_parts(pieces) for name, pieces in (("bottle", BOTTLE), ("cup", CUP), ("tee", TEE))}
GRIPPER = Gripper()
BOXES = primitives_in_gripper(GRIPPER, GRIPPER.max_opening, 0.0)[:11]


@pytest.fixture(scope="module", autouse=True)
def found_once():
    """Where a body can be held takes seconds to find; most tests ask for the same few bodies."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(places, "_holding", functools.lru_cache(places._holding))
        yield


def compound_of(target):
    assert target.compound is not None
    return target.compound


def meets(body, pose, slack):
    """Whether a box of the open hand holds a point of the body on the way in: by places on the way, float64."""
    local = (body - pose[:3, 3]) @ pose[:3, :3]
    for back in np.linspace(0.0, 0.15, 31):
        for box in BOXES:
            T = box.T_frame_primitive
            placed = (local + np.array([0.0, 0.0, back]) - T[:3, 3]) @ T[:3, :3]
            if (np.abs(placed) < np.array(box.size) - slack).all(axis=1).any():
                return True
    return False


@pytest.mark.parametrize("target", TARGETS.values(), ids=TARGETS.keys())
def test_the_fingers_close_on_material_that_the_open_hand_reaches_free(target):
    T, wrist = antipodal_grasps(compound_of(target), GRIPPER, 300)
    assert len(T) == len(wrist) == 300
    assert set(wrist) <= set(range(len(WRISTS)))
    R = T[:, :3, :3]
    np.testing.assert_allclose(np.swapaxes(R, 1, 2) @ R, np.tile(np.eye(3), (len(T), 1, 1)), atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-6)
    assert (R[:, 2, 0] > -1e-9).all()
    tilt = np.arcsin(np.clip(-R[:, 2, 2], -1.0, 1.0))
    assert (tilt > -2e-3).all()
    assert (tilt <= STEEPEST).all()
    body = surface(compound_of(target), 1500)
    for pose in T[::10]:
        low, high = grip_between(compound_of(target), pose, GRIPPER.max_opening)
        assert 0.001 < low <= high <= GRIPPER.usable_opening / 2 + 1e-3
        assert not meets(body, pose, 0.002)
    # The hand stays above the board.
    corners = OpenHand.of(GRIPPER).corners @ np.swapaxes(R, 1, 2) + T[:, None, :3, 3]
    near = np.linalg.norm(corners[..., :2] - T[:, None, :2, 3], axis=2) < 0.15
    assert corners[..., 2][near].min() > -target.bottom - 1e-9


@pytest.mark.parametrize("name", ["cup", "tee"])
def test_whatever_the_yaw_many_grasps_come_from_the_front(name):
    T, _ = antipodal_grasps(compound_of(TARGETS[name]), GRIPPER, 600)
    yaw = np.arctan2(T[:, 1, 2], T[:, 0, 2])
    for turned in np.radians(np.arange(0, 360, 15)):
        assert (np.cos(yaw + turned) > math.cos(math.radians(45))).sum() >= 60


def test_the_same_body_has_the_same_grasps():
    T, wrist = antipodal_grasps(compound_of(TARGETS["tee"]), GRIPPER, 50)
    places._holding.cache_clear()
    again, other = antipodal_grasps(compound_of(TARGETS["tee"]), GRIPPER, 50)
    np.testing.assert_array_equal(T, again)
    np.testing.assert_array_equal(wrist, other)


def test_how_far_a_hand_must_stop_short_is_where_it_meets_nothing():
    body, hand = surface(compound_of(TARGETS["cup"]), 400), OpenHand.of(GRIPPER)
    T, _ = antipodal_grasps(compound_of(TARGETS["cup"]), GRIPPER, 40)
    deep = 0
    for pose in T[::4]:
        ahead = pose.copy()
        ahead[:3, 3] += 0.03 * pose[:3, 2]
        back = hand.too_deep(body, ahead[:3, :3], ahead[:3, 3])
        deep += back > 0.0
        ahead[:3, 3] -= back * ahead[:3, 2]
        # The boxes are smaller than the primitives by 1.5 mm.
        assert not meets(body, ahead, 0.002)
        ahead[:3, 3] += 0.003 * ahead[:3, 2]
        assert back == 0.0 or meets(body, ahead, 0.0)
    assert deep > 0


def test_rows_are_each_the_farthest_from_those_before():
    rows = np.random.default_rng(0).normal(size=(40, 3))
    chosen = spread(rows, 12)
    assert len(set(chosen)) == 12
    for i in range(1, 12):
        away = np.linalg.norm(rows[:, None] - rows[chosen[:i]], axis=2).min(axis=1)
        assert away[chosen[i]] == pytest.approx(away.max())
    assert sorted(spread(rows[:3], 12)) == [0, 1, 2]
    assert len(spread(rows[:0], 12)) == 0


def test_a_body_that_is_too_wide_is_taken_by_its_narrower_lid():
    pieces = (Piece("box", (0.0382, 0.0382, 0.05)), Piece("box", (0.034, 0.034, 0.01), (0.0, 0.0, 0.06)))
    target = Target.from_parts(pieces)
    lid = 0.05 - pieces[0].half_size[2] + 2 * 0.05 - target.bottom
    for config in (GraspConfig(), GraspConfig.dense()):
        T = np.asarray(grasp_tables(GRIPPER, target, config).T_target_gripper)
        T = T[is_grasp(T)]
        assert len(T) > 20
        assert (T[:, 2, 3] > lid).all()


def test_what_slopes_is_taken_by_a_hand_that_is_turned_about_its_approach():
    # A bar on a foot that slopes up to the side: square to it the fingers are not level.
    slope = math.radians(30)
    bar = Piece("box", (0.02, 0.06, 0.015), (0.0, 0.0, 0.07), (math.cos(slope / 2), math.sin(slope / 2), 0.0, 0.0))
    target = Target.from_parts((bar, Piece("box", (0.045, 0.045, 0.01), (0.0, 0.0, 0.01))))
    T, _ = antipodal_grasps(compound_of(target), GRIPPER, 300)
    turned = np.degrees(np.arcsin(np.abs(T[:, 2, 1])))
    assert (turned > 20).sum() > 30


def test_a_found_target_of_pieces_has_as_many_rows_as_are_wanted():
    config = dataclasses.replace(GraspConfig.dense(), antipodal=40)
    tables = grasp_tables(GRIPPER, TARGETS["tee"], config)
    assert tables.q7.shape == (40,)
    assert is_grasp(tables.T_target_gripper).all()
    assert tables.still_gripper.shape[0] == len(WRISTS)
    with pytest.raises(InputError, match="antipodal -1 must not be negative"):
        GraspConfig(antipodal=-1)
