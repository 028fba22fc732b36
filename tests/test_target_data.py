"""Targets of pieces as data: one program for all of them, with tables of fixed shapes."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from test_workspace_target import BOTTLE, CUP, TEE

from mechsearch_jax.envs.scenes.generator import ScenarioGenerator
from mechsearch_jax.geometry.transforms import upright_pose
from mechsearch_jax.grasping.config import GraspConfig
from mechsearch_jax.grasping.graspability import feasible_grasps, filled_up, grasp_tables, pair_tables, thinned
from mechsearch_jax.robot.gripper import Gripper
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.identity import identity
from mechsearch_jax.shapes import union
from mechsearch_jax.shapes.compound import CONVEX, Piece
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

SHELF = Shelf()


def polyhedron(size, at=(0.0, 0.0, 0.0)):
    corners = np.array(np.meshgrid(*[(-0.5, 0.5)] * 3)).reshape(3, -1).T * size
    return Piece(CONVEX, (0.0, 0.0, 0.0), at, vertices=tuple(map(tuple, corners.tolist())))


# Two meshes of one class: neither looks the same after half a turn.
ELL = Target.from_parts((polyhedron((0.06, 0.02, 0.08)), polyhedron((0.02, 0.05, 0.08), (0.02, 0.035, 0.0))))
HOOK = Target.from_parts((polyhedron((0.03, 0.03, 0.1)), polyhedron((0.03, 0.01, 0.01), (0.03, 0.01, 0.03))))


def test_targets_of_polyhedra_share_their_programs():
    traced = []

    @jax.jit
    def numbers(target, shelf):
        traced.append(target)
        return target.height(shelf), target.tall, target.radius, target.data.parts[0]

    for target in (ELL, HOOK):
        height, tall, radius, size = numbers(target, SHELF)
        np.testing.assert_allclose(height, SHELF.board + target.solid.bottom, rtol=1e-6)
        np.testing.assert_allclose([tall, radius], [target.tall, target.solid.radius], rtol=1e-6)
        np.testing.assert_array_equal(size, target.data.parts[0])
    assert len(traced) == 1
    assert traced[0].compound is None
    assert identity(jax.tree.structure(ELL)) == identity(jax.tree.structure(HOOK))
    others = [Target.cylinder(), dataclasses.replace(ELL, yaws=4), Target.from_parts(CUP)]
    assert all(jax.tree.structure(other) != jax.tree.structure(ELL) for other in others)


def test_the_target_comes_back_from_its_arrays_and_no_other_target_does():
    assert jax.tree.map(lambda leaf: leaf, ELL) is ELL
    assert jax.device_put(ELL) is ELL
    assert jax.tree.map(lambda leaf: leaf, Target.box()) == Target.box()
    mixed = jax.tree.unflatten(jax.tree.structure(ELL), jax.tree.leaves(HOOK))
    assert mixed.compound is None
    with pytest.raises(AssertionError):
        _ = mixed.solid


@pytest.mark.parametrize("target", [ELL, HOOK, *map(Target.from_parts, (CUP, TEE, BOTTLE))])
def test_rays_meet_the_arrays_where_they_meet_the_pieces(target):
    rng = np.random.default_rng(0)
    origin = np.array([-0.5, 0.1, 0.3])
    rays = rng.normal(size=(2000, 3)) * 0.05 - origin
    parts = [[origin[i].reshape(1) for i in range(3)], [rays[:, i] for i in range(3)]]
    exact = union.cut(target.compound, *parts, 0.0, np)
    start, along = ([jnp.asarray(v, jnp.float32) for v in vector] for vector in parts)
    eager = target.data.cut(start, along)
    compiled = jax.jit(lambda target: target.data.cut(start, along))(target)
    mapped = jax.vmap(lambda *ray: target.data.cut(start, [v[None] for v in ray])[0])(*along)
    both = np.isfinite(exact) & np.isfinite(np.asarray(eager))
    assert both.sum() > 100
    # Rays that graze an edge are hits or misses by rounding.
    assert (np.isfinite(exact) != np.isfinite(np.asarray(eager))).mean() < 2e-3
    np.testing.assert_allclose(np.asarray(eager)[both], exact[both], atol=1e-5)
    np.testing.assert_allclose(compiled, eager, atol=1e-6)
    np.testing.assert_allclose(mapped, eager, atol=1e-6)


@given(able=arrays.arrays(bool, st.tuples(st.integers(1, 30), st.integers(1, 40))), most=st.integers(1, 16))
@settings(max_examples=60, deadline=None)
def test_pairs_are_thinned_evenly_and_none_is_made_up(able, most):
    kept = thinned(able, most)
    assert not (kept & ~able).any()
    count = kept.sum(axis=1)
    assert count.max() <= most
    assert count.sum() <= max(len(able) * most // 2, 0)
    # With room for one pair at each pose, none is left without.
    assert most < 2 or ((count > 0) == able.any(axis=1)).all()
    if np.minimum(able.sum(axis=1), most).sum() <= len(able) * most // 2:
        np.testing.assert_array_equal(count, np.minimum(able.sum(axis=1), most))


def test_tables_of_pairs_have_the_shape_that_they_have_room_for():
    able = np.zeros((20, 9), bool)
    able[3, :5] = able[7, 2] = True
    tables = pair_tables(able, 8)
    assert tables["pair_pose"].shape == (80,)
    assert tables["pose_pairs"].shape == (20, 8)
    assert tables["pair_valid"].sum() == 6
    rows = tables["pose_pairs"][3][:5]
    np.testing.assert_array_equal(tables["pair_grasp"][rows], range(5))
    np.testing.assert_array_equal(tables["pair_pose"][rows], 3)
    assert not len(pair_tables(np.zeros((4, 9), bool), 8)["pair_valid"])


def test_rows_without_a_grasp_are_feasible_nowhere():
    config = GraspConfig(yaw_step=np.pi / 4)
    tables = grasp_tables(Gripper(), HOOK, config)
    poses = np.array([[0.55, 0.1, yaw] for yaw in np.arange(8) * math.pi / 4], np.float32)
    T = upright_pose(jnp.asarray(poses), HOOK.height(SHELF))
    feasible = np.asarray(feasible_grasps(tables, SHELF, Gripper(), config, T))
    filled = np.asarray(tables.T_target_gripper)[:, 2, 3] < -1.0
    assert filled.any()
    assert feasible[:, ~filled].any()
    assert not feasible[:, filled].any()
    T, wrist = filled_up(np.eye(4)[None], np.zeros(1, int), 5)
    assert T.shape == (5, 4, 4)
    assert wrist.shape == (5,)


@pytest.mark.parametrize("target", [ELL, Target.from_parts((polyhedron((0.2, 0.04, 0.05)),)), Target.box()])
def test_no_candidate_pose_is_in_a_wall(target):
    poses = target.candidate_poses(SHELF)
    for angle in np.unique(poses[:, 2]):
        c, s = math.cos(angle), math.sin(angle)
        rim = target.solid.rim() @ np.array([[c, s], [-s, c]])
        low, high = (end(poses[:, :2], axis=0) for end in (np.min, np.max))
        assert (high + rim.max(axis=0) <= [SHELF.back + 2e-3, SHELF.left + 2e-3]).all()
        assert (low + rim.min(axis=0) >= [SHELF.front - 2e-3, SHELF.right - 2e-3]).all()
    reach = target.places(SHELF, np.array([[1.0, 1.0, 0.0]], np.float32))
    np.testing.assert_allclose(reach[..., 0].max(), SHELF.back - target.solid.breadth, atol=1e-3)


def test_a_target_wider_than_the_board_and_one_too_thin_are_refused_in_one_line():
    for make, message in (
        (lambda: Target.from_parts((polyhedron((0.5, 0.04, 0.05)),)).check_fits(SHELF), "too far for a board"),
        (lambda: Target.from_parts((polyhedron((0.05, 0.0005, 0.05)),)), "0.5 mm thick; make it at least 2 mm"),
    ):
        with pytest.raises(InputError) as caught:
            make()
        assert message in str(caught.value)
        assert "\n" not in str(caught.value)


def test_a_target_that_the_arm_reaches_nowhere_hides_in_no_scene():
    generator = ScenarioGenerator(HOOK, graspable=lambda pose: False)
    with pytest.raises(InputError, match="the arm reaches it nowhere on the board"):
        generator.generate(0, 3)
