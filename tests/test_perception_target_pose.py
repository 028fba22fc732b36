"""A target of known shape is found where it stands, from the part of it that the camera sees."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax.images.detection import fitted_pose
from mechsearch_jax.images.target_pose import distance, target_poses
from mechsearch_jax.shapes import shape_of
from mechsearch_jax.workspace.camera import Camera, back_project, rays
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

CAMERA, SHELF = Camera(), Shelf()
TARGETS = {"cylinder": Target.cylinder(), "box": Target.box()}


def visible_points(target, pose, rng, count=120, noise=0.001, side="both"):
    """float64: points on the surface, of which the camera sees the part that faces it; hidden below the middle."""
    a, b, h = target.half_size
    if target.shape == "cylinder":
        angle = rng.uniform(-np.pi, np.pi, 6000)
        normal = np.stack([np.cos(angle), np.sin(angle)], -1)
        local = a * normal
    else:
        face, t = rng.integers(0, 4, 6000), rng.uniform(-1, 1, 6000)
        normal = np.array([(1, 0), (-1, 0), (0, 1), (0, -1)])[face]
        local = normal * (a, b) + (1 - np.abs(normal)) * (a, b) * t[:, None]
    R = np.array([[np.cos(pose[2]), -np.sin(pose[2])], [np.sin(pose[2]), np.cos(pose[2])]])
    z = rng.uniform(0, h, 6000) + target.height(SHELF)
    points = np.column_stack([local @ R.T + pose[:2], z])
    seen = np.einsum("pi,pi->p", normal @ R.T, np.array(CAMERA.position[:2]) - points[:, :2]) > 0
    across = np.array([0.9, -0.43])
    if side != "both":
        seen &= (local @ R.T) @ np.array([-across[1], across[0]]) * {"left": 1, "right": -1}[side] > 0
    points = points[seen][:count]
    direction = rng.normal(size=points.shape)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return points + rng.normal(scale=noise, size=(len(points), 1)) * direction


@functools.partial(jax.jit, static_argnums=0)
def best_pose(target, points, valid):
    """The one of `target_poses` that fits best."""
    poses, costs = target_poses(target, SHELF, jnp.float32(CAMERA.position), points, valid)
    return poses[jnp.argmin(costs)]


def fit(target, points, capacity=256):
    valid = np.arange(capacity) < len(points)
    padded = np.zeros((capacity, 3), np.float32)
    padded[: len(points)] = points
    return np.asarray(best_pose(target, jnp.asarray(padded), jnp.asarray(valid)))


@pytest.mark.parametrize("shape", TARGETS)
def test_distance_is_that_to_the_nearest_of_many_surface_points(shape):
    target, rng, pose = TARGETS[shape], np.random.default_rng(0), np.array([0.6, 0.1, 0.7])
    R = np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]])
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 81)] * 3, indexing="ij"), -1).reshape(-1, 3)
    inside = np.abs(grid).max(1) <= 1 if shape == "box" else np.hypot(grid[:, 0], grid[:, 1]) <= 1
    local = grid[inside] * target.half_size
    solid = np.column_stack([local[:, :2] @ R.T + pose[:2], local[:, 2] + target.height(SHELF)])
    points = rng.uniform(-0.05, 0.05, (40, 3)) * (1, 1, 2) + [0.6, 0.1, target.height(SHELF)]
    nearest = np.array([np.linalg.norm(solid - p, axis=1).min() for p in points])
    signed = np.asarray(distance(target, SHELF, jnp.float32(pose), jnp.float32(points)))
    outside = nearest > 0.004
    assert 5 < outside.sum() < 40
    np.testing.assert_allclose(signed[outside], nearest[outside], atol=1.5e-3)
    assert (signed[~outside] < 0.005).all()


@pytest.mark.parametrize("shape", TARGETS)
@pytest.mark.parametrize("side", ["both", "left", "right"])
def test_the_pose_is_found_within_millimetres_from_noisy_points(shape, side):
    target, rng = TARGETS[shape], np.random.default_rng(1)
    errors, turns = [], []
    for _ in range(12):
        pose = np.array([rng.uniform(0.47, 0.73), rng.uniform(-0.2, 0.4), rng.uniform(0, np.pi)])
        fitted = fit(target, visible_points(target, pose, rng, side=side))
        errors.append(np.linalg.norm(fitted[:2] - pose[:2]))
        turns.append(abs((fitted[2] - pose[2] + np.pi / 2) % np.pi - np.pi / 2))
    assert np.median(errors) < (0.0015 if side == "both" else 0.003)
    if shape == "box" and side == "both":
        assert np.median(turns) < np.radians(6)


def test_points_of_others_among_them_move_it_little():
    target, rng, pose = TARGETS["cylinder"], np.random.default_rng(2), np.array([0.6, 0.1, 0.0])
    points = visible_points(target, pose, rng)
    stray = points[:15] + np.array([0.03, 0.0, 0.0])
    fitted = fit(target, np.concatenate([points, stray]))
    assert np.linalg.norm(fitted[:2] - pose[:2]) < 0.004


def test_without_points_it_is_finite_and_a_batch_gives_what_each_gives_alone():
    target, rng = TARGETS["box"], np.random.default_rng(3)
    poses = np.array([[0.5, 0.0, 0.3], [0.7, 0.3, 2.0]])
    clouds = np.stack([visible_points(target, pose, rng, count=100) for pose in poses] + [np.zeros((100, 3))])
    valid = jnp.array([True, True, False])[:, None] & jnp.ones((1, 100), bool)
    batch = jax.vmap(lambda p, v: best_pose(target, p, v))(jnp.float32(clouds), valid)
    assert np.isfinite(batch).all()
    for i in range(2):
        np.testing.assert_allclose(batch[i], fit(target, clouds[i], 100), atol=2e-4)


SMALL = Camera(width=320, height=180, fx=152.4, fy=152.4, cx=160.0, cy=90.0)


def half_hidden(target, pose, shown, side):
    """float64: the depth of a target before the back wall, of which a plate close before it leaves a part of its width.

    Args:
      shown: the part that is seen [m], at its left end as the camera sees it for side 1, at its right for side -1.
    """
    along, origin = np.asarray(rays(SMALL), np.float64), np.array(SMALL.position)
    c, s = np.cos(pose[2]), np.sin(pose[2])
    R, centre = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), np.array([pose[0], pose[1], target.height(SHELF)])
    start, way = R.T @ (origin - centre), along @ R
    of_target = shape_of(target.shape).cut(list(start), [way[..., i] for i in range(3)], np.array(target.half_size), np)
    wall, board = (SHELF.back - origin[0]) / along[..., 0], (SHELF.board - origin[2]) / along[..., 2]
    depth = np.minimum(np.where(wall > 0, wall, np.inf), np.where(board > 0, board, np.inf))
    # Across the view, from the camera to the target.
    ahead = (centre - origin)[:2] / np.linalg.norm((centre - origin)[:2])
    across = np.array([-ahead[1], ahead[0]])
    corners = np.array([[a, b] for a in (-1, 1) for b in (-1, 1)]) * target.half_size[:2] @ R[:2, :2].T @ across
    end = (corners * side).max() - shown
    plate = ((centre - origin)[:2] @ ahead - 0.06) / (along[..., :2] @ ahead)
    place = (plate[..., None] * along[..., :2]) @ across * side
    at_target = place * ((centre - origin)[:2] @ ahead) / ((centre - origin)[:2] @ ahead - 0.06)
    covered = (at_target < end) & (plate > 0) & (origin[2] + plate * along[..., 2] > SHELF.board)
    depth = np.where(covered, np.minimum(depth, plate), depth)
    return np.minimum(depth, of_target), of_target < depth


@pytest.mark.parametrize("side", [1, -1])
def test_a_narrow_part_of_a_flat_face_is_at_its_end_where_nothing_hides_the_rest(side):
    """Its points fit anywhere along the face, but a target that reached farther would be seen there."""
    target, rng, fits = (
        Target.of("box", (0.02, 0.025, 0.06)),
        np.random.default_rng(4),
        jax.jit(
            lambda points, depth, of_target: fitted_pose(
                jax.random.key(0), target, SHELF, SMALL, points, depth, of_target
            )[0]
        ),
    )
    for yaw in (0.0, 0.4, 1.2):
        pose = np.array([0.65, 0.1, yaw])
        depth, of_target = half_hidden(target, pose, 0.012, side)
        assert 20 < of_target.sum() < 400
        depth = jnp.float32(depth + rng.normal(scale=0.0005, size=depth.shape))
        fitted = np.asarray(fits(back_project(SMALL, depth), depth, jnp.asarray(of_target)))
        assert np.linalg.norm(fitted[:2] - pose[:2]) < 0.01, (yaw, fitted, of_target.sum())
