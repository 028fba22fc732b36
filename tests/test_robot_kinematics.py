"""The Panda's kinematics: known poses, round trips, paths, and the same answers however they are called."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mechsearch_jax.robot import kinematics
from mechsearch_jax.robot.arm_config import PANDA
from mechsearch_jax.robot.kinematics import HOME

inverse = jax.jit(kinematics.inverse_kinematics)
forward = jax.jit(kinematics.gripper_pose)
BENT = -0.48  # joint 4 beyond this is the almost straight arm


def configurations(seed: int, count: int) -> np.ndarray:
    """Random joint angles inside the limits, with a bent elbow."""
    rng = np.random.default_rng(seed)
    upper = np.where(np.arange(7) == 3, BENT, PANDA.upper - 1e-3)
    return rng.uniform(PANDA.lower + 1e-3, upper, (count, 7)).astype(np.float32)


def denavit_hartenberg(q: np.ndarray) -> np.ndarray:
    """The gripper's pose from the textbook's matrices, in float64."""
    T = np.eye(4)
    for angle, (a, turns, d) in zip(q.astype(np.float64), kinematics.JOINTS, strict=True):
        c, s, ca, sa = np.cos(angle), np.sin(angle), np.cos(turns * np.pi / 2), np.sin(turns * np.pi / 2)
        T = T @ [[c, -s, 0, a], [s * ca, c * ca, -sa, -sa * d], [s * sa, c * sa, ca, ca * d], [0, 0, 0, 1]]
    c = np.sqrt(0.5)
    return T @ [[c, c, 0, 0], [-c, c, 0, 0], [0, 0, 1, 0.107 + 0.1034], [0, 0, 0, 1]]


def errors(T: np.ndarray, reference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance [m] and angle [rad] between poses, in float64."""
    T, reference = np.float64(T), np.float64(reference)
    moved = np.linalg.norm(T[..., :3, 3] - reference[..., :3, 3], axis=-1)
    turned = np.linalg.norm(T[..., :3, :3] - reference[..., :3, :3], axis=(-2, -1)) / np.sqrt(2)
    return moved, turned


@given(st.integers(0, 2**31))
@settings(max_examples=25, deadline=None)
def test_forward_kinematics_follow_the_denavit_hartenberg_matrices(seed):
    q = configurations(seed, 4)
    moved, turned = errors(forward(q), np.stack([denavit_hartenberg(one) for one in q]))
    assert moved.max() < 2e-6
    assert turned.max() < 2e-6


def test_known_poses():
    frames = kinematics.forward_kinematics(jnp.zeros(7))
    np.testing.assert_allclose(frames[7, :3, 3], (0.088, 0.0, 0.333 + 0.316 + 0.384 - 0.107), atol=1e-6)
    ready = kinematics.forward_kinematics(np.array([0, -np.pi / 4, 0, -3 * np.pi / 4, 0, np.pi / 2, np.pi / 4]))[7]
    np.testing.assert_allclose(ready, [[1, 0, 0, 0.3069], [0, -1, 0, 0], [0, 0, -1, 0.5903], [0, 0, 0, 1]], atol=2e-4)


@given(st.integers(0, 2**31))
@settings(max_examples=25, deadline=None)
def test_inverse_kinematics_reach_what_the_arm_reaches(seed):
    q = configurations(seed, 256)
    T = forward(q)
    solutions, valid = (np.asarray(a) for a in inverse(T, q[:, 6]))
    assert np.isfinite(solutions).all()
    # With links 1 and 3 in line, float32 may turn one of these joints past its limit, and the other back.
    assert (valid.any(axis=-1) | (np.abs(q[:, 1]) < 0.01)).all()
    reached = np.broadcast_to(np.asarray(T)[:, None], (256, 4, 4, 4))[valid]
    moved, turned = errors(np.asarray(forward(solutions))[valid], reached)
    assert moved.max() < 1e-4
    assert turned.max() < 1e-3
    assert (solutions[valid] >= PANDA.lower).all()
    assert (solutions[valid] <= PANDA.upper).all()
    np.testing.assert_array_equal(solutions[..., 6], np.broadcast_to(q[:, None, 6], (256, 4)))
    # Near a singularity many configurations share a pose in float32; elsewhere the arm's own is among the solutions.
    nearest = np.abs(np.where(valid[..., None], solutions, np.inf) - q[:, None]).max(axis=-1).min(axis=-1)
    assert np.mean(nearest < 1e-3) > 0.97


@given(st.integers(0, 2**31))
@settings(max_examples=25, deadline=None)
def test_solutions_are_in_closed_form_for_every_elbow(seed):
    """All four solutions reproduce a reachable pose, whether or not they respect the joint limits."""
    q = configurations(seed, 64)
    T = forward(q)
    solutions, _ = inverse(T, q[:, 6])
    moved, turned = errors(forward(solutions), np.asarray(T)[:, None])
    assert moved.max() < 1e-4
    assert turned.max() < 1e-3


@pytest.mark.parametrize("position", [(0.0, 0.0, 0.333), (3.0, 0.0, 0.5), (0.0, 0.0, 0.0), (0.088, 0.0, 0.55)])
def test_out_of_reach_is_invalid_and_finite(position):
    T = jnp.eye(4).at[:3, 3].set(jnp.array(position))
    solutions, valid = inverse(T, jnp.float32(0.0))
    assert np.isfinite(solutions).all()
    reached = forward(solutions)
    moved, _ = errors(reached, np.asarray(T)[None])
    assert (moved[np.asarray(valid)] < 1e-4).all()
    far = jnp.eye(4).at[0, 3].set(3.0)
    assert not inverse(far, jnp.float32(0.0))[1].any()


def test_joint_limits_invalidate():
    q = HOME.copy()
    T = kinematics.gripper_pose(q)
    assert inverse(T, jnp.float32(q[6]))[1].any()
    assert not inverse(T, jnp.float32(2.95))[1].any()


def test_batch_axes_jit_and_vmap_agree():
    batch = 2, 3
    q = configurations(7, int(np.prod(batch, dtype=int))).reshape(*batch, 7)
    T, q7 = kinematics.gripper_pose(q), jnp.asarray(q[..., 6])
    distance = jnp.full(batch, 0.02)

    def line(T, distance, q7):
        return kinematics.line_kinematics(T, distance, q7, 3)

    cases = (
        (kinematics.forward_kinematics, (jnp.asarray(q),), (8, 4, 4)),
        (kinematics.gripper_pose, (jnp.asarray(q),), (4, 4)),
        (kinematics.inverse_kinematics, (T, q7), (4, 7)),
        (line, (T, distance, q7), (3, 7)),
    )
    for function, arguments, shape in cases:
        eager, mapped = function(*arguments), function
        for _ in batch:
            mapped = jax.vmap(mapped)
        assert jax.tree.leaves(eager)[0].shape == (*batch, *shape)
        for other in (jax.jit(function)(*arguments), mapped(*arguments)):
            jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=2e-4), eager, other)


def test_one_angle_serves_a_batch():
    q = configurations(3, 5)
    q[:, 6] = 0.7
    T = forward(q)
    solutions, valid = kinematics.inverse_kinematics(T, jnp.float32(0.7))
    repeated, same = kinematics.inverse_kinematics(T, jnp.full(5, 0.7))
    # A scalar and a batch of angles are compiled apart, and may round differently.
    np.testing.assert_allclose(solutions, repeated, atol=1e-6)
    np.testing.assert_array_equal(valid, same)


def test_line_runs_along_the_approach():
    T = kinematics.gripper_pose(HOME).at[0, 3].add(0.3)
    q, reachable = kinematics.line_kinematics(T, jnp.float32(0.3), jnp.float32(HOME[6]), 7)
    assert reachable
    poses = np.asarray(kinematics.gripper_pose(q))
    expected = np.array([[*(np.asarray(T)[:3, 3] - back * np.asarray(T)[:3, 2])] for back in np.linspace(0.3, 0, 7)])
    np.testing.assert_allclose(poses[:, :3, 3], expected, atol=1e-4)
    np.testing.assert_allclose(poses[:, :3, :3], np.broadcast_to(np.asarray(T)[:3, :3], (7, 3, 3)), atol=1e-3)
    assert np.abs(np.diff(q, axis=0)).max() < 0.35


def test_path_takes_the_branch_nearest_home():
    T = jnp.broadcast_to(kinematics.gripper_pose(HOME), (3, 4, 4))
    q, reachable = kinematics.path_kinematics(T, jnp.float32(HOME[6]))
    assert reachable
    np.testing.assert_allclose(q, np.broadcast_to(HOME, (3, 7)), atol=1e-3)


def test_path_with_a_jump_is_not_reachable():
    """Every pose is within reach, but only with another branch for each."""
    here = kinematics.gripper_pose(HOME)
    away = kinematics.gripper_pose(np.array([2.8, *HOME[1:]], np.float32))
    beyond = kinematics.gripper_pose(np.array([-2.8, *HOME[1:]], np.float32))
    assert kinematics.path_kinematics(jnp.stack([here, here]), jnp.float32(HOME[6]))[1]
    assert not kinematics.path_kinematics(jnp.stack([away, beyond]), jnp.float32(HOME[6]))[1]


def test_unreachable_line_is_flagged_and_finite():
    T = jnp.eye(4).at[:3, 3].set(jnp.array([0.9, 0.0, 0.5]))
    q, reachable = kinematics.line_kinematics(T, jnp.float32(0.3), jnp.float32(0.8), 4)
    assert not reachable
    assert np.isfinite(q).all()
