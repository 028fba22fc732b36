"""Every registered shape against references in float64, and a made-up one from a scenario file to the simulator."""

import dataclasses
import json
import math

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import trimesh
from matplotlib.figure import Figure
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from mechsearch_jax.envs.camera import simulated_camera
from mechsearch_jax.envs.pushing import physics_push
from mechsearch_jax.envs.simulators.batch_model import BodyFields, body_fields, cells_of
from mechsearch_jax.envs.simulators.native import NativeWorld
from mechsearch_jax.envs.world import model, world
from mechsearch_jax.envs.world.mismatch import ASSUMED_CELL
from mechsearch_jax.grasping import graspability
from mechsearch_jax.grasping.config import GraspConfig
from mechsearch_jax.images.target_pose import target_poses
from mechsearch_jax.perception import scores
from mechsearch_jax.robot.gripper import Gripper
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.shapes import SHAPES, Shape
from mechsearch_jax.shapes.primitives import Cylinder
from mechsearch_jax.viz.drawing import draw_target
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import Body, Scenario, format_scenario, parse_scenario, superquadrics
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

UPRIGHT = (1.0, 0.0, 0.0, 0.0)
SIZES = np.array([(0.03, 0.03, 0.05), (0.02, 0.06, 0.04), (0.08, 0.05, 0.02)])


@dataclasses.dataclass(frozen=True)
class Ball(Shape):
    """A shape that the package does not have."""

    code: int = 2
    name: str = "ball"
    exponents: tuple[float, float] = (1.0, 1.0)
    density: float = 100.0
    friction: float = 0.5
    geometry: str = "sphere"
    round: bool = True
    yaws: int = 1
    target_half_size: tuple[float, float, float] = (0.025, 0.025, 0.025)

    def fault(self, half_size):
        return None if len(set(half_size)) == 1 else "a ball has one radius, three times"

    def nearest(self, size, library):
        return library.prod(size, axis=-1, keepdims=True) ** (1 / 3) * library.ones_like(size)

    def volume(self, half_size, library):
        return 4 / 3 * math.pi * library.prod(half_size, axis=-1)

    def moments(self, half_size, library):
        return 0.4 * half_size**2

    def geometry_size(self, half_size, library):
        return half_size * library.asarray([1.0, 0.0, 0.0]).reshape((1,) * (half_size.ndim - 1) + (3,))

    def bounding_radius(self, half_size, library):
        return half_size[..., 0]

    def inside(self, point, half_size, library):
        return library.sum(point**2, axis=-1) < half_size[0] ** 2

    def reach(self, direction, half_size, library):
        return library.sqrt(library.sum(direction**2, axis=-1)) * half_size[..., 0]

    def cut(self, origin, direction, half_size, library):
        dot = lambda p, q: p[0] * q[0] + p[1] * q[1] + p[2] * q[2]  # noqa: E731
        a, b, c = dot(direction, direction), dot(origin, direction), dot(origin, origin)
        square = b * b - a * (c - half_size[0] ** 2)
        near = (-b - library.sqrt(library.maximum(square, 0.0))) / a
        return library.where((square >= 0.0) & (near > 0.0), near, library.inf)

    def normal(self, point, half_size, library):
        return point

    def distance(self, level, height, half_size, library):
        square = library.sum(level**2, axis=-1) + height**2
        return library.sqrt(library.maximum(square, 1e-12)) - half_size[0]

    def fall(self, before, after, library):
        return library.ones_like(before[..., 0])

    def areas(self, half_size, library):
        return library.asarray([1.0, 0.0, 0.0])

    def spread(self, part, even, sign, library):
        angle, height = math.pi * even[:, 0], even[:, 1]
        across = library.sqrt(1.0 - height**2)
        return library.stack([across * library.cos(angle), across * library.sin(angle), height], axis=-1)

    def rim(self, half_size):
        return Cylinder().rim(half_size)

    def mesh(self, half_size):
        return trimesh.creation.icosphere(4, half_size[0])

    def grasps(self, half_size, count, max_yaw):
        return Cylinder().grasps(half_size, count, max_yaw)


# The made-up one shows that what is tested holds for more than the two shapes there are.
EVERY = [*SHAPES.values(), Ball()]


@pytest.fixture(params=EVERY, ids=lambda shape: shape.name)
def shape(request):
    return request.param


@pytest.fixture(params=range(len(SIZES)))
def half(request, shape):
    """Half-extents of the shape."""
    return shape.nearest(SIZES[request.param], np)


def directions(count, seed=0):
    drawn = np.random.default_rng(seed).normal(size=(count, 3))
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def distance(shape, points, half):
    return shape.distance(points[..., :2], points[..., 2], half, np)


def surface(shape, half, count=20_000):
    """Points spread over the surface, as the training draws them."""
    rng = np.random.default_rng(0)
    areas = np.asarray(shape.areas(half, np))
    part = rng.choice(3, count, p=areas / areas.sum())
    return shape.spread(part, rng.uniform(-1, 1, (count, 3)), rng.choice([-1.0, 1.0], count), np) * half


def test_half_extents_that_are_nearest_are_of_the_shape_and_keep_its_volume(shape, half):
    assert shape.fault(tuple(half.tolist())) is None
    np.testing.assert_allclose(shape.nearest(half, np), half)
    assert any(np.prod(half) == pytest.approx(np.prod(size)) for size in SIZES)


def test_volume_moments_and_radius_are_those_of_mujoco(shape, half):
    size = " ".join(map(repr, shape.geometry_size(half, np).tolist()))
    geometry = f'<geom type="{shape.geometry}" size="{size}" density="{shape.density}"/>'
    alone = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><body name="it"><freejoint/>{geometry}</body></worldbody></mujoco>'
    )
    mass = shape.volume(half, np) * shape.density
    assert mass == pytest.approx(alone.body("it").mass[0])
    turn = np.abs(Rotation.from_quat(alone.body("it").iquat, scalar_first=True).as_matrix())
    np.testing.assert_allclose(mass * shape.moments(half, np), turn @ alone.body("it").inertia)
    assert shape.bounding_radius(half, np) == pytest.approx(alone.geom_rbound[0])


def test_the_mesh_is_the_solid(shape, half):
    mesh = shape.mesh(half.tolist())
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(shape.volume(half, np), rel=0.01)
    np.testing.assert_allclose(np.diag(mesh.moment_inertia) / mesh.volume, shape.moments(half, np), rtol=0.015)
    np.testing.assert_allclose(mesh.bounds, [-half, half], rtol=0.005)
    assert np.abs(distance(shape, mesh.vertices, half)).max() < 1e-9
    assert np.linalg.norm(mesh.vertices, axis=1).max() <= shape.bounding_radius(half, np) + 1e-9


def test_the_superquadric_that_stands_for_it_is_the_solid(shape, half):
    """All but its edges, which the planner sees rounded."""
    point = np.random.default_rng(0).uniform(-1.1, 1.1, (20_000, 3)) * half
    e1, e2 = (max(e, scores.SHARP) if e > scores.EDGE else scores.SHARP for e in shape.exponents)
    x = np.abs(point / half)
    across = np.max(x[:, :2], axis=1) if e2 == scores.SHARP else (x[:, :2] ** (2 / e2)).sum(axis=1) ** (e2 / 2)
    gauge = (
        np.maximum(across, x[:, 2]) if e1 == scores.SHARP else (across ** (2 / e1) + x[:, 2] ** (2 / e1)) ** (e1 / 2)
    )
    np.testing.assert_array_equal(gauge < 1, distance(shape, point, half) < 0)


def test_surface_points_are_on_the_surface_and_spread_by_area(shape, half):
    points = surface(shape, half)
    assert np.abs(distance(shape, points, half)).max() < 1e-9
    mesh = shape.mesh(half.tolist())
    corners = mesh.triangles
    # Of a triangle: the mean of a square is that at the corners and thrice that at the middle, over 4 times 3.
    squares = ((corners**2).sum(axis=1) + 9 * corners.mean(axis=1) ** 2) / 12
    expected = np.average(squares, axis=0, weights=mesh.area_faces)
    np.testing.assert_allclose((points**2).mean(axis=0), expected, rtol=0.04)
    np.testing.assert_allclose(points.mean(axis=0) / half, 0, atol=0.03)


def test_distance_is_that_to_the_nearest_point_of_the_surface(shape, half):
    points = np.random.default_rng(1).uniform(-2, 2, (300, 3)) * half
    nearest, _ = KDTree(surface(shape, half, 200_000)).query(points)
    signed = distance(shape, points, half)
    outside = signed > 0
    assert 50 < outside.sum() < 299
    np.testing.assert_allclose(signed[outside], nearest[outside], atol=1e-3)
    assert (nearest[~outside] >= -signed[~outside] - 1e-9).all()
    steepness = jax.jit(jax.vmap(jax.grad(lambda p: shape.distance(p[:2], p[2], tuple(half.tolist()), jnp))))
    assert jnp.isfinite(steepness(jnp.float32([*points[:20], *np.diag(half), *np.zeros((1, 3))]))).all()


def test_it_reaches_as_far_as_its_surface(shape, half):
    towards = np.concatenate([directions(50), np.eye(3), -np.eye(3)])
    farthest = (surface(shape, half, 50_000) @ towards.T).max(axis=0)
    reach = shape.reach(towards, half[None], np)
    assert (reach >= farthest - 1e-9).all()
    np.testing.assert_allclose(reach, farthest, rtol=0.02)
    np.testing.assert_allclose(reach[-3:], half, rtol=1e-6)
    steepness = jax.jit(jax.vmap(jax.grad(lambda d: shape.reach(d, jnp.float32(half), jnp))))
    assert jnp.isfinite(steepness(jnp.float32(towards))).all()


def test_rays_are_cut_where_they_first_enter(shape, half):
    radius = float(np.linalg.norm(half))
    origin = 3 * radius * directions(400)
    aim = np.random.default_rng(2).uniform(-1.3, 1.3, (400, 3)) * half
    # Along its axes too, and in the planes of its faces.
    origin[:3], aim[:3] = 3 * radius * np.eye(3), 0.0
    ray = aim - origin
    at = np.asarray(shape.cut(origin.T, ray.T, half, np))
    hit = np.isfinite(at)
    assert 50 < hit.sum() < 400
    assert hit[:3].all()
    assert np.abs(distance(shape, origin[hit] + at[hit, None] * ray[hit], half)).max() < 1e-9
    before = np.linspace(0, 1, 2000, endpoint=False) * np.where(hit, at, 3.0)[:, None]
    along = distance(shape, origin[:, None] + before[..., None] * ray[:, None], half)
    assert along.min() > -1e-9
    away = shape.cut(origin.T, -ray.T, half, np)
    assert np.isinf(away).all()
    single = jax.jit(lambda *arrays: shape.cut(*arrays, jnp))(*(jnp.float32(a) for a in (origin.T, ray.T, half)))
    grazing = np.abs(along.min(axis=1)) < 1e-6
    np.testing.assert_allclose(np.asarray(single)[hit | ~grazing], at[hit | ~grazing], atol=1e-4)


def test_normals_point_where_the_distance_grows(shape, half):
    points = surface(shape, half, 2000)
    normal = shape.normal(points, np.broadcast_to(half, points.shape), np)
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    step = 1e-6
    outside = distance(shape, points + step * normal, half)
    inside = distance(shape, points - step * normal, half)
    inner = np.abs(points) < 0.995 * half
    flat = inner.sum(axis=1) >= (2 if shape.exponents[0] < 0.5 else 0)
    assert flat.mean() > 0.5
    np.testing.assert_allclose(outside[flat], step, rtol=0.01)
    np.testing.assert_allclose(inside[flat], -step, rtol=0.01)


def test_what_rolls_or_stays_does_not_fall(shape):
    up = directions(100)
    turned = Rotation.from_rotvec(np.array([0.0, 0.0, 1.0]) * np.linspace(-3, 3, 100)[:, None]).apply(up)
    np.testing.assert_allclose(shape.fall(up, up, np), 1.0)
    if shape.round:
        np.testing.assert_allclose(shape.fall(up, turned, np), 1.0)
    else:
        np.testing.assert_allclose(shape.fall(up, turned, np), np.sum(up * turned, axis=1))
    # The angle is never more than that between the verticals.
    other = directions(100, seed=1)
    assert (shape.fall(up, other, np) >= np.sum(up * other, axis=1) - 1e-9).all()


def test_the_rim_is_a_convex_polygon_around_the_level_cross_section(shape, half):
    rim = shape.rim(half.tolist())
    sides = np.roll(rim, -1, axis=0) - rim
    following = np.roll(sides, -1, axis=0)
    assert (sides[:, 0] * following[:, 1] - sides[:, 1] * following[:, 0] > 0).all()
    angle = np.linspace(0, 2 * np.pi, 90)
    towards = np.stack([np.cos(angle), np.sin(angle), np.zeros(90)], axis=1)
    reach = shape.reach(towards, half[None], np)
    wide = (rim @ towards[:, :2].T).max(axis=0)
    assert (wide >= reach - 1e-9).all()
    assert (wide <= 1.02 * reach).all()


@pytest.mark.parametrize("count", [1, 5])
def test_it_is_as_wide_between_the_fingers_as_grasps_say(shape, half, count):
    yaws, widths = shape.grasps(half, count, 0.7)
    assert len(yaws) == len(widths)
    assert not shape.round or (len(yaws) == count and np.abs(yaws).max() <= 0.7)
    across = np.stack([-np.sin(yaws), np.cos(yaws), np.zeros(len(yaws))], axis=1)
    np.testing.assert_allclose(widths, 2 * shape.reach(across, half[None], np), rtol=1e-9)


def test_float32_is_close(shape, half):
    """What JAX makes of it, with a leading axis for the bodies."""
    several, points = np.stack([half, 1.2 * half]), surface(shape, half, 2) * 1.01
    for name in ("volume", "moments", "geometry_size", "bounding_radius", "nearest"):
        values = getattr(shape, name)(jnp.float32(several), jnp)
        np.testing.assert_allclose(values, getattr(shape, name)(several, np), rtol=1e-5, err_msg=name)
    for name, first, second in (("reach", directions(2), several), ("fall", directions(2), directions(2, seed=1))):
        values = getattr(shape, name)(jnp.float32(first), jnp.float32(second), jnp)
        np.testing.assert_allclose(values, getattr(shape, name)(first, second, np), rtol=1e-4, err_msg=name)
    values = shape.distance(jnp.float32(points[:, :2]), jnp.float32(points[:, 2]), tuple(half.tolist()), jnp)
    np.testing.assert_allclose(values, distance(shape, points, half), atol=1e-6)


@pytest.fixture
def ball(monkeypatch):
    """A third shape, registered."""
    monkeypatch.setitem(SHAPES, "ball", Ball())
    return SHAPES["ball"]


def balls():
    shelf = Shelf()
    on_board = lambda shape, half, x, y: Body(shape, half, (x, y, shelf.board + half[2]), UPRIGHT)  # noqa: E731
    objects = (on_board("ball", (0.05, 0.05, 0.05), 0.6, 0.1), on_board("box", (0.03, 0.02, 0.05), 0.5, -0.1))
    return Scenario("balls", objects, on_board("ball", (0.025, 0.025, 0.025), 0.7, 0.25))


def test_a_new_shape_is_read_seen_and_recognised_for_what_it_is(ball):
    scenario = parse_scenario(json.loads(format_scenario(balls())), "balls.json")
    assert scenario == balls()
    odd = dataclasses.replace(scenario, target=dataclasses.replace(scenario.target, half_size=(0.02, 0.02, 0.03)))
    with pytest.raises(InputError, match=r"target.half_size: a ball has one radius"):
        parse_scenario(json.loads(format_scenario(odd)), "balls.json")
    there = world.from_scenario(scenario)
    assert there.kind[jnp.array([0, 1, world.TARGET])].tolist() == [2, 0, 2]
    assert [body and body.shape for body in world.bodies_of(there)] == ["ball", "box", *[None] * 6, "ball"]
    np.testing.assert_allclose(world.superquadrics(there).exponents[0], ball.exponents)
    np.testing.assert_allclose(superquadrics(scenario.objects).exponents[0], ball.exponents)

    # No other test has this camera: what was compiled for it knows of the ball.
    camera = Camera().scaled(11)
    seen = jax.tree.map(np.asarray, simulated_camera.observe(camera, there))
    rows, columns = np.nonzero(seen.segmentation == 0)
    assert len(rows) > 30
    ray = np.stack([(columns + 0.5 - camera.cx) / camera.fx, (rows + 0.5 - camera.cy) / camera.fy, np.ones(len(rows))])
    points = np.array(camera.position) + (np.array(camera.rotation) @ ray).T * seen.depth[rows, columns, None]
    np.testing.assert_allclose(np.linalg.norm(points - scenario.objects[0].position, axis=1), 0.05, atol=1e-5)

    bodies = physics_push.bodies(world.superquadrics(there))
    assert bodies.kind[jnp.array([0, 1, world.TARGET])].tolist() == [2, 0, 2]
    np.testing.assert_allclose(bodies.half_size[0], there.half_size[0], rtol=1e-5)


def test_a_new_shape_is_simulated(ball):
    scenario = balls()
    compiled = model.compile_model(Shelf(), Camera())
    expected = model.with_bodies(compiled, world.slots(scenario))
    assert expected.body("body0").mass[0] == pytest.approx(4 / 3 * math.pi * 0.05**3 * ball.density)
    there = jax.tree.map(lambda leaf: leaf[None], world.from_scenario(scenario))
    fields = body_fields(compiled, there.kind, there.half_size, there.valid, cells_of(compiled, [ASSUMED_CELL]))
    for name in BodyFields.__dataclass_fields__:
        value = np.asarray(getattr(fields, name)[0])
        np.testing.assert_allclose(value, getattr(expected, name).reshape(value.shape), 2e-6, err_msg=name)
    simulator = NativeWorld()
    before = simulator.reset(scenario)
    outcome = simulator.settle()
    assert outcome.settled
    assert not outcome.fallen.any()
    assert np.abs(np.asarray(simulator.world.position - before.position)).max() < 1e-3
    assert simulator.scenario("after").objects[0].shape == "ball"


def test_a_new_shape_is_searched_for(ball):
    target, shelf = Target.of("ball"), Shelf()
    T = graspability._target_grasps(target, Gripper(), GraspConfig()).T_target_gripper
    assert len(T) == 7 * 3 * 3
    swept = graspability.swept_target(target, np.array([-1.0, 0.0, 0.0]), 0.3, 500, 0.0)
    assert np.linalg.norm(swept[:, 1:], axis=1).max() <= 0.025 + 1e-6
    place = np.array([0.6, 0.1, target.height(shelf)])
    points = place + surface(ball, np.array(target.half_size), 400)
    towards = np.array(Camera().position) - place
    shown = jnp.asarray((points - place) @ towards > 0)
    poses, costs = target_poses(target, shelf, jnp.float32(Camera().position), jnp.float32(points), shown)
    np.testing.assert_allclose(poses[jnp.argmin(costs)], [0.6, 0.1, 0.0], atol=1e-4)
    axes = Figure().subplots()
    draw_target(axes, np.array([0.6, 0.1, 0.0]), target, certain=True)
    assert axes.patches[0].get_radius() == 0.025
