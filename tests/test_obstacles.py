"""Obstacles of a cell: as values and in the configuration, on the arm's ways, and how near each body is passed."""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from test_robot_free_motion import ASIDE, BODY, DT, HERE, SHELF
from test_search_whole_trajectory import CONFIG, Q7, SETTING, grasp, seen, taken

from mechsearch_jax.actions.kinds.retrieve import retrieve_action
from mechsearch_jax.geometry.superquadric import empty
from mechsearch_jax.problem.settings import load_settings
from mechsearch_jax.problem.workcell import Workcell
from mechsearch_jax.robot.arm_clearance import Obstacles, clearance, tip_positions
from mechsearch_jax.robot.free_motion import FreeMotionConfig, free_motion
from mechsearch_jax.robot.gripper import fingers, hand_parts, link_parts
from mechsearch_jax.robot.nearest import nearest_rows
from mechsearch_jax.robot.robot_trajectory import Part
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.session.whole_trajectory import whole_trajectory
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.obstacle import Obstacle
from mechsearch_jax.workspace.shelf import Shelf

TURN = ((0.6, -0.8, 0.0), (0.8, 0.6, 0.0), (0.0, 0.0, 1.0))


def moved(*bodies, **config):
    obstacles = Obstacles.of(SHELF, bodies=bodies)
    return free_motion(HERE, ASIDE, BODY, obstacles, timestep=DT, config=FreeMotionConfig(**config)), obstacles


def test_a_way_goes_around_an_obstacle_in_its_middle():
    place = tuple(tip_positions((HERE + ASIDE)[None] / 2)[0].tolist())
    straight, _ = moved()
    around, obstacles = moved(Obstacle("box", (0.06, 0.06, 0.12), place))
    assert straight.straight
    assert not around.straight
    assert clearance(BODY, obstacles, straight.position).free.min() < 0.0
    assert clearance(BODY, obstacles, around.position).each[:, -1].min() > 0.005


@pytest.mark.parametrize(
    ("wall", "message"),
    [
        # A wall from 20 cm beside the robot's axis outwards, higher than the arm reaches.
        (Obstacle("screen", (1.4, 0.02, 2.4), (0.54, 0.72, 1.2), TURN),
         'no way around obstacle "screen" was found in 20 attempts'),
        (Obstacle("table", (0.5, 0.5, 0.1), tuple(tip_positions(ASIDE[None])[0].tolist())),
         r'where it ends the arm touches obstacle "table" \(\d+ mm deep\)'),
    ],
)  # fmt: skip
def test_a_way_that_is_not_free_is_refused_with_the_name(wall, message):
    with pytest.raises(InputError, match=message):
        moved(wall, attempts=20)


def test_a_mesh_is_the_box_of_its_corners(tmp_path):
    """Turned in its file, and once more in the cell, in millimetres."""
    size, place = (0.10, 0.20, 0.04), (0.35, 0.1, 0.6)
    inside = np.eye(4)
    inside[:3, :3], inside[:3, 3] = trimesh.transformations.euler_matrix(0.3, -0.5, 0.9)[:3, :3], (20.0, -30.0, 40.0)
    body = trimesh.creation.box(1000 * np.array(size), transform=inside)
    body.export(tmp_path / "stand.stl")
    mesh = Obstacle.of_mesh("stand", tmp_path / "stand.stl", 0.001, place, TURN)
    turned = np.array(TURN) @ inside[:3, :3]
    centre = np.array(TURN) @ inside[:3, 3] / 1000 + place
    box = Obstacle("stand", size, tuple(centre.tolist()), tuple(map(tuple, turned.tolist())))
    q = HERE + np.random.default_rng(0).normal(0.0, 0.5, (40, 7))
    each = [clearance(BODY, Obstacles.of(SHELF, bodies=(thing,)), q).each[:, -1] for thing in (mesh, box)]
    assert each[0].min() < 0.0 < 0.1 < each[0].max()
    np.testing.assert_allclose(*each, atol=1e-5)


def frames(q):
    """Poses of the seven links and the hand in double precision, from the maker's table of modified parameters."""
    right = np.pi / 2
    rows = zip((0, 0, 0, 0.0825, -0.0825, 0, 0.088), (0.333, 0, 0.316, 0, 0.384, 0, 0),
               (0, -right, right, right, -right, right, right), q, strict=True)  # fmt: skip
    T, poses = np.eye(4), []
    for a, d, alpha, theta in rows:
        c, s, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
        T = T @ [[c, -s, 0, a], [s * ca, c * ca, -sa, -d * sa], [s * sa, c * sa, ca, d * ca], [0, 0, 0, 1]]
        poses.append(T)
    c = np.sqrt(0.5)
    return [*poses, T @ [[c, c, 0, 0], [-c, c, 0, 0], [0, 0, 1, 0.107], [0, 0, 0, 1]]]


def surface_points(opening):
    """By frame: points of the arm's primitives, 4 mm apart in boxes, and how far the surface is around each."""
    bodies = [*enumerate(link_parts()), (7, hand_parts()), (7, fingers(opening))]
    for frame, primitives in bodies:
        for part in primitives:
            if part.kind == "capsule":
                radius, half = part.size
                z = np.linspace(-half, half, 60)
                local = np.stack([0 * z, 0 * z, z], axis=1)
            else:
                radius = 0.0
                axes = [np.linspace(-s, s, int(np.ceil(s / 0.002)) + 1) for s in part.size]
                local = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
            T = np.array(part.T_frame_primitive, float)
            yield frame, local @ T[:3, :3].T + T[:3, 3], radius


def brute_force(body, q, opening):
    """Distances of the arm from an obstacle outside it in double precision, shape (m,)."""
    R, half, points = np.array(body.rotation), np.array(body.size) / 2, list(surface_points(opening))
    distances = []
    for row in q:
        poses, least = frames(row), np.inf
        for frame, local, radius in points:
            T = poses[frame]
            at = (local @ T[:3, :3].T + T[:3, 3] - body.position) @ R
            if body.shape == "cylinder":
                across = np.maximum(np.hypot(at[:, 0], at[:, 1]) - half[0], 0.0)
                apart = np.hypot(across, np.maximum(np.abs(at[:, 2]) - half[2], 0.0))
            else:
                apart = np.linalg.norm(at - np.clip(at, -half, half), axis=1)
            least = min(least, apart.min() - radius)
        distances.append(least)
    return np.array(distances)


BESIDE = Obstacle("beside", (0.10, 0.06, 0.08), (0.33, -0.2, 0.55), TURN)
POST = Obstacle("post", (0.05, 0.05, 0.8), (0.2, 0.34, 0.5), shape="cylinder")


@functools.cache
def passing():
    """A retrieval in a cell with obstacles and an object beside the target."""
    objects = empty(8)
    objects = objects.replace(
        size=objects.size.at[4].set(jnp.float32([0.02, 0.02, 0.05])),
        position=objects.position.at[4].set(jnp.float32([0.62, -0.1, SHELF.board + 0.05])),
        valid=objects.valid.at[4].set(True),
    )
    config = dataclasses.replace(CONFIG, obstacles=(BESIDE, POST))
    action = retrieve_action(grasp(), Q7, jnp.float32(0.08))
    return whole_trajectory(SETTING, seen(objects), action, width=0.08, config=config)


def test_the_least_distance_from_each_obstacle_and_its_time_are_right():
    """As sampled in double precision on all rows, one in five: 4 mm are the spheres', 3 mm the sampled points'."""
    trajectory = passing()
    rows = np.arange(0, len(trajectory.time), 5)
    # What is held is larger than nothing, but far from both.
    for body in (BESIDE, POST):
        (near,) = [near for near in trajectory.nearest if near.body == f'obstacle "{body.name}"']
        exact = brute_force(body, trajectory.position[rows], 0.08)
        assert 0.005 < near.distance < 0.15
        assert exact.min() - 0.0075 < near.distance < exact.min() + 0.002
        assert exact[np.argmin(np.abs(trajectory.time[rows] - near.time))] < exact.min() + 0.006


def test_what_is_meant_to_be_touched_stands_apart():
    trajectory = passing()
    report = trajectory.report()
    assert [near.body for near in report.intended] == ["the target"]
    assert report.intended[0].distance < 0.002
    assert trajectory.part[round(report.intended[0].time / DT)] == Part.ACTION
    names = {near.body for near in report.nearest}
    assert names == {"object 4", "the target", "the shelf", "the floor", 'obstacle "beside"', 'obstacle "post"'}
    assert all(near.distance > 0.0 for near in report.nearest)
    assert list(report.nearest) == sorted(report.nearest, key=lambda near: near.distance)
    assert f"nearest to {report.nearest[0].body}: " in str(report)


def test_an_obstacle_in_the_actions_way_is_refused_with_the_name():
    way = tip_positions(taken().position[taken().part == Part.ACTION])
    inside = way[np.argmax(way[:, 0] > SHELF.front + 0.05)]
    config = dataclasses.replace(CONFIG, obstacles=(Obstacle("bar", (0.02, 0.02, 0.02), tuple(inside.tolist())),))
    with pytest.raises(InputError, match=r'retrieve: the arm would pass \d+ mm through obstacle "bar"; decide anew'):
        whole_trajectory(SETTING, seen(), retrieve_action(grasp(), Q7, jnp.float32(0.08)), config=config)


def test_what_is_far_is_as_far_as_is_looked():
    away = Obstacles.of(SHELF, bodies=(Obstacle("away", (0.1, 0.1, 0.1), (-3.0, 0.0, 1.0)),))
    assert nearest_rows(BODY, away, HERE[None])[-1] == ('obstacle "away"', 0.2, 0)


def read(tmp_path, text):
    (tmp_path / "mine.toml").write_text(text)
    return load_settings(tmp_path / "mine.toml").workcell


def test_obstacles_stand_in_the_configuration(tmp_path):
    trimesh.creation.box((100.0, 200.0, 300.0)).export(tmp_path / "stand.stl")
    cell = read(
        tmp_path,
        """
[base]
position = [0.5, 0, 0]
[camera]
position = [0.45, 0.5, 0.7]
body = [0.1, 0.03, 0.03]
[shelf]
front = 0.914
back = 1.288
[[obstacle]]
name = "post"
shape = "cylinder"
size = [0.04, 0.04, 1]
position = [0.5, 0.5, 0.5]
[[obstacle]]
name = "stand"
mesh = "stand.stl"
scale = 0.001
position = [1, -0.6, 0]
""",
    )
    camera, post, stand = cell.bodies
    np.testing.assert_allclose(camera.position, (-0.05, 0.5, 0.7), atol=1e-9)
    assert (camera.name, camera.size, camera.rotation) == ("camera", (0.1, 0.03, 0.03), Camera().rotation)
    assert post == Obstacle("post", (0.04, 0.04, 1.0), (0.0, 0.5, 0.5), shape="cylinder")
    np.testing.assert_allclose(sorted(stand.size), (0.1, 0.2, 0.3))
    np.testing.assert_allclose(stand.position, (0.5, -0.6, 0.0), atol=1e-9)
    assert read(tmp_path, "[camera]\nposition = [0, 0.5, 0.7]\nbody = [0, 0, 0]").bodies == ()
    assert repr(cell) == repr(dataclasses.replace(cell, obstacles=()))


def test_the_camera_is_among_them_unless_it_is_in_the_shelf_or_simulated():
    (camera,) = dataclasses.replace(Workcell(), camera=Camera(position=(-0.05, 0.5, 0.7))).bodies
    assert (camera.name, camera.position) == ("camera", (-0.05, 0.5, 0.7))
    assert Workcell().bodies == ()
    inside = dataclasses.replace(Workcell(), camera=Camera(position=(0.43, 0.1, 0.7)))
    assert inside.bodies == ()
    behind = dataclasses.replace(inside, camera=Camera(position=(Shelf().back + 0.3, 0.1, 0.7)))
    assert len(behind.bodies) == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[obstacle]\nname = 'a'", r"mine.toml:1: \[obstacle\] must have two brackets"),
        ("[[obstacle]]\nname = 'a'\nsize = [1, 1, 1]", r"mine.toml:1: \[obstacle 1\]: position is missing"),
        ("[[obstacle]]\nname = 'a'\nsizes = 1", r"mine.toml:3: \[obstacle 1\] sizes is unknown; did you mean size"),
        ("[[obstacle]]\nname = 'a'\nsize = [0, 1, 1]\nposition = [0, 0, 0]", r"mine.toml:3: \[obstacle 1\] size x"),
        ("[[obstacle]]\nname = 'a'\nmesh = 'no.stl'", r"\[obstacle 1\]: mesh: .*no.stl cannot be read"),
        ("[[obstacle]]\nname = 'camera'\nsize = [1, 1, 1]\nposition = [0, 0, 0]", "the camera's body is called so"),
        ("[camera]\nbody = [0.1, 0, 0]", r"mine.toml:2: \[camera\] body: size y"),
    ],
)
def test_what_is_no_obstacle_is_refused(tmp_path, text, message):
    with pytest.raises(InputError, match=message):
        read(tmp_path, text)


def test_a_robot_moves_at_three_tenths_of_its_limits():
    assert Workcell().arm.speed == 0.3
