"""Whether targets of any shape are grasped wherever physics says so: drawn grasps, made meshes, and what is counted."""

import dataclasses
import math

import numpy as np
import pytest
import trimesh

from mechsearch_jax.benchmarks.lab.tables import targets_table
from mechsearch_jax.benchmarks.lab.targets.antipodal import Approaches, Lines, crossings, gripper_poses, lines
from mechsearch_jax.benchmarks.lab.targets.everyday import surface_of, write_things
from mechsearch_jax.benchmarks.lab.targets.graspable import GivenMesh, TargetRow, TargetsBench, by_mesh, load, summary
from mechsearch_jax.envs.scenes.household import thing_of
from mechsearch_jax.runtime.errors import InputError

ROW = TargetRow("mug", 0.6, 0.1, 0.3, 200, 0, 0, False, 12, 9, True, [10.0, 30.0, 0.0, 80.0, 4.0])


def test_rays_cross_a_sphere_where_they_should():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.05)
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(70, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    origin = -0.2 * direction + rng.normal(0.0, 0.01, (70, 3))
    found = crossings(np.asarray(ball.triangles), origin, direction)
    middle = np.sum(-origin * direction, axis=1)
    half = np.sqrt(0.05**2 - np.sum(origin**2, axis=1) + middle**2)
    np.testing.assert_array_equal(found.ray, np.repeat(np.arange(70), 2))
    np.testing.assert_allclose(found.distance[::2], middle - half, atol=4e-4)
    np.testing.assert_allclose(found.distance[1::2], middle + half, atol=4e-4)
    np.testing.assert_array_equal(found.leaves, np.tile([-1, 1], 70))


def test_lines_join_opposite_places_of_the_outer_surface():
    # Two boxes that overlap are one of 30 mm by 80 mm by 20 mm.
    boxes = [trimesh.creation.box((0.03, 0.05, 0.02)) for _ in range(2)]
    boxes[1].apply_translation((0.0, 0.03, 0.0))
    both = trimesh.util.concatenate(boxes)
    found = lines(both, 300, 0.076, math.radians(20), np.random.default_rng(0))
    assert len(found.width) == 300
    along = np.abs(found.axis).argmax(axis=1)
    np.testing.assert_allclose(found.width, np.array([0.03, np.nan, 0.02])[along], atol=1e-6)
    # By area: the 30 mm are between sides of 80 mm by 20 mm.
    assert np.mean(along == 0) == pytest.approx(0.4, abs=0.08)
    assert np.abs(found.middle[along == 0, 0]).max() < 1e-6
    assert np.ptp(found.middle[:, 1]) == pytest.approx(0.08, abs=0.005)


def test_a_hollow_thing_is_taken_across_a_wall_or_across_both():
    glass = surface_of(thing_of("glass").sized(0.9), hollow=True)
    assert glass.is_watertight
    assert glass.volume > 0
    found = lines(glass, 500, 0.076, math.radians(45), np.random.default_rng(0))
    level = np.abs(found.axis[:, 2]) < 0.3
    assert (found.width[level] < 0.005).any()
    assert (found.width[level] > 0.04).any()


def test_the_gripper_closes_on_lines_from_an_allowed_side():
    rng, allowed = np.random.default_rng(1), Approaches()
    axis = rng.normal(size=(200, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    found = Lines(rng.normal(0.0, 0.03, (200, 3)), axis, np.full(200, 0.05))
    T_world_mesh = trimesh.transformations.rotation_matrix(0.7, (0, 0, 1)) @ np.eye(4)
    T_world_mesh[:3, 3] = (0.6, 0.1, 0.45)
    T, line = gripper_poses(found, T_world_mesh, allowed, rng)
    assert len(T) > 100
    assert (np.diff(line) > 0).all()
    R = T[:, :3, :3]
    np.testing.assert_allclose(np.swapaxes(R, 1, 2) @ R, np.tile(np.eye(3), (len(R), 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1.0)
    np.testing.assert_allclose(np.abs(np.einsum("ni,ni->n", R[:, :, 1], axis[line] @ T_world_mesh[:3, :3].T)), 1.0)
    np.testing.assert_allclose(T[:, :3, 3], trimesh.transform_points(found.middle[line], T_world_mesh), atol=1e-12)
    yaw, tilt = np.arctan2(R[:, 1, 2], R[:, 0, 2]), np.arcsin(-R[:, 2, 2])
    assert (np.abs(yaw) <= allowed.max_yaw).all()
    assert (R[:, 2, 0] >= 0).all()
    assert (tilt >= allowed.tilts[0]).all()
    assert (tilt <= allowed.tilts[1]).all()


def test_things_are_made_again_from_their_seed(tmp_path):
    files = write_things(3, 3, tmp_path / "a")
    again = write_things(3, 3, tmp_path / "b")
    assert [file.name for file in files] == [file.name for file in again]
    assert len({f.stem for f in files}) == 3
    assert [file.read_bytes() for file in files] == [file.read_bytes() for file in again]
    assert [file.name for file in files] != [file.name for file in write_things(3, 4, tmp_path / "c")]
    for file in files:
        mesh = trimesh.load(str(file), force="mesh")
        assert mesh.is_watertight
        assert max(mesh.extents) < 0.35
    with pytest.raises(InputError, match=r"--things 1000: only \d+ kinds fit the hand"):
        write_things(1000, 3, tmp_path / "d")


def test_a_mesh_is_in_the_frame_of_its_target(tmp_path):
    box = trimesh.creation.box((30.0, 40.0, 100.0))
    box.apply_translation((5.0, 6.0, 50.0))
    box.export(str(tmp_path / "box.stl"))
    target, surface = load(GivenMesh("box", tmp_path / "box.stl", 1e-3))
    np.testing.assert_allclose(surface.bounds, [[-0.015, -0.02, -0.05], [0.015, 0.02, 0.05]], atol=1e-6)
    assert target.bottom == pytest.approx(0.05, abs=1e-6)


def test_the_share_is_of_poses_where_physics_succeeds():
    rows = [
        ROW,
        dataclasses.replace(ROW, mesh="can", feasible=7, tried=3),
        dataclasses.replace(ROW, mesh="can", feasible=7, tried=1, planner=True),
        dataclasses.replace(ROW, mesh="can", planner=True, physics=False, grasp=None),
        dataclasses.replace(ROW, mesh="bowl", grasps=0),
    ]
    line = summary(rows)
    assert (line["meshes"], line["poses"], line["physics"], line["both"], line["planner_alone"]) == (3, 5, 4, 1, 1)
    assert line["share"] == 0.25
    assert line["interval"][0] < 0.25 < line["interval"][1]
    assert line["faults"] == {"no grasp is feasible": 1, "no tried grasp succeeds": 1, "no grasp is known": 1}
    assert list(by_mesh(rows)) == ["mug", "can", "bowl"]
    assert summary(rows[3:4])["share"] is None
    assert targets_table(rows).renderables[0].row_count == 4


def test_what_cannot_be_compared_is_one_line(tmp_path):
    with pytest.raises(InputError, match="there are no meshes"):
        TargetsBench(())
    with pytest.raises(InputError, match="two meshes are called mug"):
        TargetsBench([GivenMesh("mug", tmp_path), GivenMesh("mug", tmp_path / "b")])


@pytest.mark.slow
def test_both_sides_take_a_box_out(tmp_path):
    trimesh.creation.box((0.03, 0.04, 0.1)).export(str(tmp_path / "box.obj"))
    bench = TargetsBench([GivenMesh("box", tmp_path / "box.obj")], poses=1, grasps=60, seed=2)
    seen = []
    (row,) = bench.run(seen.append)
    assert row.planner
    assert row.physics
    assert 0 < row.tried <= row.feasible <= row.grasps
    assert 0 < row.executed <= row.drawn <= 60
    assert row.grasp[4] == pytest.approx(30.0, abs=0.1) or row.grasp[4] == pytest.approx(40.0, abs=0.1)
    assert seen == [[row]]
