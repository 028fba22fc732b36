"""How objects are grasped: between the fingers, clear of the palm, and as far round as the opening allows."""

import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax.actions.kinds.object_grasps import (
    LOWEST,
    PALM,
    PASSING_GAP,
    BoxGrasp,
    ObjectGraspConfig,
    grasp_variants,
    object_grasps,
)
from mechsearch_jax.dynamics import rigid
from mechsearch_jax.geometry import footprints, superquadric, transforms
from mechsearch_jax.robot.gripper import Gripper
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.shapes import shape_of
from mechsearch_jax.workspace.shelf import Shelf

SHELF, GRIPPER = Shelf(), Gripper()
MAX_YAW, WRISTS = np.pi / 4, 3
# From the front alone, and from the side, too.
CONFIG, WIDE = ObjectGraspConfig(max_yaw=MAX_YAW), ObjectGraspConfig()
GRASPS = {
    config: jax.jit(lambda prints, config=config: object_grasps(SHELF, GRIPPER, prints, config, MAX_YAW, WRISTS))
    for config in (CONFIG, WIDE)
}


def upright(half, exponents, yaw):
    return superquadric.Superquadrics(
        size=jnp.float32([half]),
        exponents=jnp.float32([exponents]),
        position=jnp.float32([[0.6, 0.1, SHELF.board + half[2]]]),
        rotation=transforms.yaw_rotation(jnp.float32([yaw])),
        valid=jnp.ones(1, bool),
    )


def grasps_of(half, exponents, yaw, config=CONFIG):
    """float64: tip centres relative to the object's centre (A, 3), rotations (A, 3, 3), and whether each fits (A,)."""
    scene = upright(half, exponents, yaw)
    T, fits = GRASPS[config](footprints.footprints(scene))
    T = np.asarray(T[0], np.float64)
    return T[:, :3, 3] - np.asarray(scene.position[0]), T[:, :3, :3], np.asarray(fits[0])


def corners(half, yaw):
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([(a * half[0], b * half[1]) for a in (-1, 1) for b in (-1, 1)]) @ np.array([[c, s], [-s, c]])


boxes = st.tuples(st.floats(0.01, 0.08), st.floats(0.01, 0.08), st.floats(0.03, 0.1))


@pytest.mark.parametrize("config", [CONFIG, WIDE], ids=["front", "side"])
@hypothesis.given(half=boxes, yaw=st.floats(-np.pi, np.pi))
@hypothesis.settings(deadline=None, max_examples=60)
def test_a_box_passes_between_the_open_fingers_and_stays_off_the_palm(config, half, yaw):
    tips, R, fits = grasps_of(half, shape_of("box").exponents, yaw, config)
    for tip, rotation in zip(tips[fits], R[fits], strict=True):
        heading = rotation[:2, 2] / np.linalg.norm(rotation[:2, 2])
        assert abs(np.arctan2(heading[1], heading[0])) <= config.max_yaw + 2e-3
        across = corners(half, yaw) @ rotation[:2, 1]
        assert np.abs(across).max() <= 0.5 * GRIPPER.usable_opening + 1e-5
        # The palm is a plane PALM behind the tips; the corners at the height of the tips and below must be beyond it.
        tilt = np.arcsin(-rotation[2, 2])
        level = (corners(half, yaw) - tip[:2]) @ heading
        assert (level * np.cos(tilt)).min() >= -PALM + 0.5 * PASSING_GAP
        assert tip[2] + half[2] >= LOWEST - 1e-6


@hypothesis.given(radius=st.floats(0.01, 0.037), yaw=st.floats(-np.pi, np.pi))
@hypothesis.settings(deadline=None, max_examples=30)
def test_grasps_of_a_round_object_do_not_depend_on_its_yaw_and_pass_through_its_axis(radius, yaw):
    half = (radius, radius, 0.06)
    tips, R, fits = grasps_of(half, shape_of("cylinder").exponents, yaw)
    still, _, _ = grasps_of(half, shape_of("cylinder").exponents, 0.0)
    assert fits.all()
    np.testing.assert_allclose(tips, still, atol=1e-5)
    np.testing.assert_allclose(np.einsum("ai,ai->a", tips[:, :2], R[:, :2, 1]), 0.0, atol=1e-5)


def test_a_turned_grasp_is_turned_towards_the_front_and_back_by_the_hand():
    half, yaw = (0.03, 0.012, 0.06), np.radians(50)
    way, _, _ = grasp_variants(CONFIG, WRISTS)
    _, R, fits = grasps_of(half, shape_of("box").exponents, yaw)
    approach = np.arctan2(R[:, 1, 2], R[:, 0, 2])
    square, fully = way == 0, way == CONFIG.boxes.index(BoxGrasp(turn=1.0))
    # The nearest face points 40 degrees to the right; 22 degrees of that are made up.
    np.testing.assert_allclose(np.degrees(approach[square]), -40, atol=0.01)
    np.testing.assert_allclose(np.degrees(approach[fully]), -18, atol=0.01)
    assert fits[fully].all()
    scene = upright(half, shape_of("box").exponents, yaw)
    for rotation in R[fits]:
        held = rigid.in_hand(scene, jnp.int32(0), transforms.make(jnp.float32(rotation), jnp.zeros(3)))
        alignment = np.abs(np.asarray(held)[:2, :2].T @ rotation[:2, 1])
        np.testing.assert_allclose(np.sort(alignment), [0, 1], atol=1e-5)


@pytest.mark.parametrize("yaw", [-0.2, 0.0, 0.1])
def test_a_box_that_stands_across_is_grasped_from_the_side_alone(yaw):
    half, box = (0.022, 0.078, 0.096), shape_of("box").exponents
    _, _, fits = grasps_of(half, box, yaw)
    assert not fits.any()
    tips, R, fits = grasps_of(half, box, yaw, WIDE)
    square = (grasp_variants(WIDE, WRISTS)[0] == 0) & fits
    headings = np.arctan2(R[:, 1, 2], R[:, 0, 2])
    # Of its two narrow sides the one that faces the robot more.
    assert square.any()
    assert np.ptp(headings[square]) < 1e-5
    assert (np.abs(headings[fits]) <= np.pi / 2 + 2e-3).all()
    # The hand stands beside the box, at the end that it approaches.
    assert (np.sign(tips[fits, 1]) == -np.sign(headings[fits])).all()
    assert (np.abs(tips[fits, 1]) > half[1] - PALM).all()


@hypothesis.given(half=boxes, yaw=st.floats(-np.pi, np.pi))
@hypothesis.settings(deadline=None, max_examples=60)
def test_what_is_grasped_from_the_front_is_grasped_as_well_where_sides_are_allowed(half, yaw):
    exponents = shape_of("box").exponents
    front, side = (grasps_of(half, exponents, yaw, config) for config in (CONFIG, WIDE))
    first = np.array([box.face == 0 for box in CONFIG.boxes])[grasp_variants(CONFIG, WRISTS)[0]]
    # At 45 degrees two sides are equally square.
    hypothesis.assume(abs(yaw % (np.pi / 2) - np.pi / 4) > 1e-3)
    # The side that is the most square to the hand stays the first if it can be grasped.
    both = first & front[2]
    assert side[2][both].all()
    for a, b in zip(front[:2], side[:2], strict=True):
        np.testing.assert_allclose(a[both], b[both], atol=1e-6)


@pytest.mark.parametrize("max_yaw", [0.0, -0.1, 1.7, np.nan])
def test_approaches_from_behind_are_refused(max_yaw):
    with pytest.raises(InputError, match="max_yaw"):
        ObjectGraspConfig(max_yaw=max_yaw)


def test_what_is_too_wide_for_the_hand_is_not_grasped():
    _, _, fits = grasps_of((0.04, 0.04, 0.05), shape_of("box").exponents, 0.1)
    assert not fits.any()
    _, _, fits = grasps_of((0.04, 0.04, 0.05), shape_of("cylinder").exponents, 0.1)
    assert not fits.any()


def test_a_box_that_fills_the_hand_is_grasped_square_only():
    way, _, _ = grasp_variants(CONFIG, WRISTS)
    _, _, fits = grasps_of((0.05, 0.036, 0.05), shape_of("box").exponents, 0.1)
    turned = np.array([box.turn != 0 for box in CONFIG.boxes])[way]
    assert fits[~turned].all()
    assert not fits[turned].any()
