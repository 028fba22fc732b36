"""Motions within the joints' limits: the curve through waypoints, its duration, and the references made of them."""

import dataclasses
import functools
import logging
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from mechsearch_jax.actions import ActionConfig
from mechsearch_jax.envs.simulators.mjx_model import MjxConfig, MjxModel
from mechsearch_jax.geometry.transforms import make
from mechsearch_jax.robot import motion
from mechsearch_jax.robot.arm_config import PANDA
from mechsearch_jax.robot.grasp_frames import WRIST_ORIGIN, gripper_rotation
from mechsearch_jax.robot.kinematics import HOME, line_poses, path_kinematics
from mechsearch_jax.robot.motion import MotionConfig
from mechsearch_jax.robot.time_scaling import RAMPS, angles_along, progress, smooth_curve, timing
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf

PLAN = MotionConfig()
COUNT = 256
BUILD = {
    "push": motion.push_reference,
    "retrieve": motion.retrieve_reference,
    "pick and place": motion.pick_and_place_reference,
}


smooth_curve, timed = jax.jit(smooth_curve), jax.jit(timing)


def random_poses(rng, count=COUNT):
    x, y, z = rng.uniform(0.5, 0.7, count), rng.uniform(-0.15, 0.35, count), rng.uniform(0.03, 0.17, count)
    position = jnp.asarray(np.stack([x, y, Shelf().board + z], axis=-1), jnp.float32)
    yaw, tilt = rng.uniform(-0.4, 0.4, count), np.radians(rng.choice([20, 30], count))
    return jax.vmap(lambda p, a, t: make(gripper_rotation(a, t), p))(position, jnp.float32(yaw), jnp.float32(tilt))


@functools.cache
def arguments(kind):
    """Random motions, many of them out of reach."""
    rng = np.random.default_rng(0)
    T, place, opening = random_poses(rng), random_poses(rng), jnp.full(COUNT, 0.075, jnp.float32)
    angle, length = rng.uniform(-math.pi / 2, math.pi / 2, COUNT), rng.uniform(0.02, 0.2, COUNT)
    way = jnp.asarray(length[:, None] * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1), jnp.float32)
    q7 = jnp.asarray(WRIST_ORIGIN + rng.choice(ActionConfig().push_wrists, COUNT), jnp.float32)
    return {"push": (T, way, q7), "retrieve": (T, q7, opening), "pick and place": (T, place, q7, opening)}[kind]


@functools.cache
def references(kind):
    build = jax.jit(jax.vmap(lambda *a: BUILD[kind](*a, PLAN)))
    return jax.device_get(build(*arguments(kind)))


def sampled(reference, timestep=PLAN.timestep):
    """Velocities, accelerations and jerks as a controller sees them: differences of the samples, from rest."""
    rest = np.repeat(np.asarray(reference.start, float)[..., None, :7], 3, axis=-2)
    values = np.concatenate([rest, np.asarray(reference.q, float)], axis=-2)
    for _ in range(3):
        values = np.diff(values, axis=-2) / timestep
        yield values


@functools.cache
def line(count=31):
    """Waypoints of a straight approach."""
    T = make(gripper_rotation(jnp.float32(0.2), jnp.float32(0.4)), jnp.float32([0.6, 0.1, 0.5]))
    q, reachable = path_kinematics(line_poses(T, jnp.float32(0.3), count), jnp.float32(WRIST_ORIGIN))
    assert reachable
    return q


@pytest.mark.parametrize(
    "kind", ["push", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("pick and place", "retrieve"))]
)
def test_no_joint_exceeds_its_limits_in_the_samples_of_random_motions(kind):
    reference, reachable = references(kind)
    assert reachable.sum() > 25
    limits = (PANDA.velocity, PANDA.acceleration, PANDA.jerk)
    ratios = [
        np.abs(values[reachable]).max(axis=1) / limit for values, limit in zip(sampled(reference), limits, strict=True)
    ]
    for ratio in ratios:
        assert ratio.max() < 1.02
    # And no motion takes longer than it must: a limit is what slows it down, but for the rounding of durations.
    assert np.max(ratios, axis=(0, 2)).min() > 0.93
    np.testing.assert_allclose(reference.velocity, next(sampled(reference))[:, 2:], atol=1e-2)


def test_what_is_held_is_moved_more_gently():
    reference, reachable = references("pick and place")
    held = (np.arange(reference.q.shape[1]) >= reference.closed[:, None]) & (
        np.arange(reference.q.shape[1]) < reference.opens[:, None]
    )
    velocity, acceleration, _ = sampled(reference)
    for values, limit, power in ((velocity, PANDA.velocity, 1), (acceleration, PANDA.acceleration, 2)):
        values = values[:, -reference.q.shape[1] :][held & reachable[:, None]]
        assert (np.abs(values).max(axis=0) / limit).max() < 1.02 * PLAN.carry_pace**power


@pytest.mark.parametrize("kind", ["push", "pick and place", pytest.param("retrieve", marks=pytest.mark.slow)])
def test_references_are_padded_with_their_last_row(kind):
    reference, reachable = references(kind)
    rows = np.arange(reference.q.shape[1])
    assert ((reference.length < len(rows)) | ~reachable).all()
    over = rows >= reference.length[:, None]
    last = reference.q[np.arange(COUNT), reference.length - 1]
    assert (np.where(over[..., None], reference.q - last[:, None], 0.0) == 0.0).all()
    before = rows >= reference.length[:, None] + 1
    assert (np.where(before[..., None], reference.velocity, 0.0) == 0.0).all()
    # Shortly before, it still moves.
    moved = np.abs(last - reference.q[np.arange(COUNT), reference.length - 60]).max(axis=1)
    assert moved[reachable].min() > 1e-3


def test_the_hand_closes_and_opens_when_the_reference_says():
    reference, reachable = references("pick and place")
    for i in np.flatnonzero(reachable)[:5]:
        closed, opens = int(reference.closed[i]), int(reference.opens[i])
        fingers = reference.fingers[i]
        np.testing.assert_allclose(fingers[closed - 1 : opens], -PLAN.squeeze, atol=1e-6)
        np.testing.assert_allclose(fingers[: closed - PLAN.close_steps], 0.075 / 2, atol=1e-6)
        np.testing.assert_allclose(fingers[opens + PLAN.open_steps - 1 :], 0.075 / 2, atol=1e-6)
        assert fingers[closed - 2] > -PLAN.squeeze
        assert fingers[opens] > -PLAN.squeeze
        np.testing.assert_array_equal(np.ptp(reference.q[i, opens : opens + PLAN.open_steps], axis=0), 0.0)
    pushing, _ = references("push")
    np.testing.assert_array_equal(pushing.opens, pushing.length)
    assert (pushing.closed == 0).all()


def scheduled(q, least=1, pace=1.0):
    """Along waypoints, and back after the hand has closed."""
    there, close = motion._Stretch(500, 0, 30, (0.0, 0.02)), motion._Stretch(10, 30, 30, (0.02, 0.0))
    return motion._schedule(q, (there, close, motion._Stretch(400, 30, 0, (0.0, 0.0), least, pace)), PLAN.timestep)


ALL_SCHEDULED = jax.jit(jax.vmap(lambda q, pace: scheduled(q, pace=pace)))


@pytest.mark.parametrize("compiled", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_motion_is_the_same_alone_and_among_others(compiled):
    q = jnp.stack([line(), line()[::-1], 0.5 * line()])
    batch, in_time = ALL_SCHEDULED(q, jnp.ones(3))
    assert in_time.all()
    assert len(set(batch.length.tolist())) > 1
    alone, _ = (jax.jit(scheduled) if compiled else scheduled)(q[2])
    for one, many in zip(jax.tree.leaves(alone), jax.tree.leaves(batch), strict=True):
        np.testing.assert_allclose(one, many[2], atol=1e-2 if one is alone.velocity else 1e-5)


def test_a_stretch_takes_at_least_what_it_must_and_one_that_takes_too_long_is_out_of_reach():
    q = jnp.stack([line()] * 3)
    reference, in_time = ALL_SCHEDULED(q, jnp.array([1.0, 0.8, 0.5]))
    assert in_time.tolist() == [True, True, False]
    usual, gentle, too_gentle = (reference.length - reference.closed).tolist()
    assert abs(gentle - usual / 0.8) <= 2 * motion.GRAIN
    assert too_gentle == 400
    assert np.isfinite(reference.q).all()
    late, in_time = jax.jit(lambda q: scheduled(q, 350))(line())
    assert in_time
    assert int(late.length - late.closed) == 350


@pytest.mark.slow
def test_a_push_that_takes_too_long_is_out_of_reach():
    _, reachable = references("push")
    one = [a[int(np.flatnonzero(reachable)[0])] for a in arguments("push")]
    build = jax.jit(motion.push_reference, static_argnums=3)
    for changes in ({"approach_longest": 20}, {"push_longest": 20, "push_least": 1}):
        assert not build(*one, dataclasses.replace(PLAN, **changes))[1]


def test_a_world_has_memory_for_the_longest_reference():
    model = MjxModel(Shelf(), Camera(), MjxConfig())
    without = 3 * sum(leaf.nbytes for leaf in jax.tree.leaves(model._single(MjxConfig().contacts)))
    build = jax.tree.map(lambda reference: functools.partial(reference, config=PLAN), BUILD)
    shapes = [jax.eval_shape(build[kind], *(a[0] for a in arguments(kind))) for kind in BUILD]
    rows = max(reference.q.shape[0] for reference, _ in shapes)
    assert model.bytes_per_world() - without == 8 * rows * 9 * 4


def test_the_curve_is_a_natural_spline_through_the_waypoints():
    q = line()
    curve = smooth_curve(q)
    knots = np.asarray(curve.knots, float)
    assert (np.diff(knots) > 0.2 / 30).all()
    places = np.linspace(0, 1, 200)
    expected = CubicSpline(knots, np.asarray(q, float), bc_type="natural")
    both = jax.tree.map(lambda a: jnp.stack([a[::-1] if a.ndim > 1 else 1 - a[::-1], a]), curve)
    along = jax.jit(angles_along)
    angles = along(both, jnp.ones(200, jnp.int32), jnp.asarray(places, jnp.float32))
    np.testing.assert_allclose(angles, expected(places), atol=1e-5)
    np.testing.assert_allclose(curve.bend, expected(knots, 2), atol=2e-2 * np.abs(expected(knots, 2)).max())
    back = along(both, jnp.zeros(200, jnp.int32), jnp.asarray(1 - places, jnp.float32))
    np.testing.assert_allclose(back, expected(places), atol=1e-5)


def test_progress_rises_from_rest_to_rest():
    u = np.linspace(0, 1, 1001)
    for ramp in range(len(RAMPS)):
        s = np.asarray(progress(jnp.asarray(u, jnp.float32), jnp.full(1001, ramp)), float)
        assert abs(s[0]) < 1e-6
        assert abs(s[-1] - 1) < 1e-6
        assert (np.diff(s) > -1e-7).all()
        np.testing.assert_allclose(s + s[::-1], 1.0, atol=1e-6)
        assert s[10] < 2e-3


def test_the_duration_follows_the_pace_and_the_least():
    curve = smooth_curve(line())
    seconds, _ = timed(curve, 0.0, 1.0)
    assert 0.4 < float(seconds) < 2.0
    assert float(timed(curve, 0.0, 0.5)[0]) == pytest.approx(2 * float(seconds), rel=1e-5)
    assert [float(x) for x in timed(curve, 3.0, 1.0)] == [3.0, 0.0]


def test_a_stretch_takes_no_less_than_the_time_optimal_one():
    """And at most half as long again, although its jerk is bounded and its profile is one of six."""
    toppra = pytest.importorskip("toppra")
    logging.getLogger("toppra").setLevel(logging.ERROR)
    bounds = [np.outer(limit, (-1.0, 1.0)) for limit in (PANDA.velocity, PANDA.acceleration)]
    limits = [
        toppra.constraint.JointVelocityConstraint(bounds[0]),
        toppra.constraint.JointAccelerationConstraint(bounds[1]),
    ]
    reference, reachable = references("push")
    ways = [np.linspace(HOME, q, 31) for q in reference.q[reachable][:3, -1]] + [line(), line()[::-1]]
    for q in ways:
        curve = smooth_curve(jnp.asarray(q, jnp.float32))
        path = toppra.SplineInterpolator(np.asarray(curve.knots, float), np.asarray(q, float), bc_type="natural")
        gridpoints = np.linspace(0, path.path_interval[1], 301)
        solver = toppra.algorithm.TOPPRA(limits, path, gridpoints, parametrizer="ParametrizeConstAccel")
        optimal = solver.compute_trajectory().duration
        assert 0.999 < float(timed(curve, 0.0, 1.0)[0]) / optimal < 1.5


def test_a_still_stretch_takes_no_time_and_has_gradients():
    q = jnp.tile(jnp.asarray(HOME)[None], (31, 1))

    def timed_angles(q):
        curve = smooth_curve(q)
        both = jax.tree.map(lambda a: a[None], curve)
        places = jnp.linspace(0.0, 1.0, 50)
        return timing(curve, 0.0)[0], angles_along(both, jnp.zeros(50, jnp.int32), places)

    (seconds, angles), pullback = jax.vjp(jax.jit(timed_angles), q)
    assert float(seconds) < 2 * PLAN.timestep
    np.testing.assert_allclose(angles, np.tile(HOME, (50, 1)), atol=1e-6)
    assert np.isfinite(pullback((jnp.float32(1.0), jnp.ones((50, 7))))[0]).all()
