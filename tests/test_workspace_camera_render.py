"""Cameras and depth images, against exact ray-casts of boxes, cylinders and superquadrics in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial.transform import Rotation

from mechsearch_jax.geometry import superquadric, transforms
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.shapes import shape_of
from mechsearch_jax.workspace import camera, render
from mechsearch_jax.workspace.camera import Camera

COARSE = Camera().scaled(7)


def scene_of(*bodies):
    """Upright objects from (half size, exponents, position, yaw)."""
    size, exponents, position, yaw = (np.float32(column) for column in zip(*bodies, strict=True))
    return superquadric.Superquadrics(
        size=jnp.asarray(size),
        exponents=jnp.asarray(exponents),
        position=jnp.asarray(position),
        rotation=transforms.yaw_rotation(jnp.asarray(yaw)),
        valid=jnp.ones(len(bodies), bool),
    )


BOX = ((0.048, 0.028, 0.08), shape_of("box").exponents, (0.55, 0.1, 0.4845), 0.4)
CYLINDER = ((0.032, 0.032, 0.067), shape_of("cylinder").exponents, (0.6, -0.05, 0.4715), 0.0)


def reference_superquadric_depth(cam, scene):
    """March every ray in float64 and refine the first crossing of equation 5 by bisection."""
    directions = np.asarray(camera.rays(cam), np.float64).reshape(-1, 3)
    depth = np.full(len(directions), np.inf)
    for k in range(scene.capacity):
        R, t = np.asarray(scene.rotation[k], np.float64), np.asarray(scene.position[k], np.float64)
        a, (e1, e2) = np.asarray(scene.size[k], np.float64), np.asarray(scene.exponents[k], np.float64)
        o, d = (np.array(cam.position) - t) @ R, directions @ R
        nearest = -(d @ o) / np.sum(d * d, axis=1)
        close = np.linalg.norm(o + nearest[:, None] * d, axis=1) < np.linalg.norm(a)
        if not close.any():
            continue

        def gauge(s, d, o=o, a=a, e1=e1, e2=e2):
            x = np.abs((o + s[..., None] * d) / a)
            plane = (x[..., 0] ** (2 / e2) + x[..., 1] ** (2 / e2)) ** (e2 / 2)
            return (plane ** (2 / e1) + x[..., 2] ** (2 / e1)) ** (e1 / 2)

        d, mid = d[close], nearest[close]
        radius = np.linalg.norm(a)
        grid = mid[:, None] + np.linspace(-radius, radius, 400)
        inside = gauge(grid, d[:, None]) < 1
        hit = inside.any(axis=1)
        first = inside.argmax(axis=1)
        high = grid[np.arange(len(grid)), first]
        low = grid[np.arange(len(grid)), np.maximum(first - 1, 0)]
        for _ in range(40):
            middle = (low + high) / 2
            within = gauge(middle, d) < 1
            low, high = np.where(within, low, middle), np.where(within, middle, high)
        depth[close] = np.minimum(depth[close], np.where(hit, high, np.inf))
    return depth.reshape(cam.height, cam.width)


def analytic_depth(cam, half, position, yaw, shape):
    """An exact box or cylinder."""
    directions = np.asarray(camera.rays(cam), np.float64)
    c, s = np.cos(yaw), np.sin(yaw)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    o, d = (np.array(cam.position) - np.array(position)) @ R, directions @ R
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (-np.array(half) - o) / d, (np.array(half) - o) / d
    enter, leave = np.minimum(a, b), np.maximum(a, b)
    if shape == "cylinder":
        aa, bb = np.sum(d[..., :2] ** 2, -1), d[..., :2] @ o[:2]
        square = bb**2 - aa * (o[:2] @ o[:2] - half[0] ** 2)
        root = np.sqrt(np.maximum(square, 0))
        near = np.where(square > 0, (-bb - root) / aa, np.inf)
        far = np.where(square > 0, (-bb + root) / aa, -np.inf)
        enter = np.stack([near, enter[..., 2]], -1)
        leave = np.stack([far, leave[..., 2]], -1)
    near, far = enter.max(-1), leave.min(-1)
    return np.where(near < far, near, np.inf)


def test_projection_undoes_the_rays():
    cam = Camera().scaled(20)
    rows, columns = np.meshgrid(np.arange(cam.height), np.arange(cam.width), indexing="ij")
    points = 0.7 * camera.rays(cam) + jnp.array(cam.position)[None, None]
    pixels, depth = camera.project(cam, points)
    np.testing.assert_allclose(depth, 0.7, rtol=1e-5)
    np.testing.assert_allclose(pixels[..., 0], rows, atol=2e-3)
    np.testing.assert_allclose(pixels[..., 1], columns, atol=2e-3)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"width": 0}, r"width \(0\) must be from 1 to 16384 pixels"),
        ({"height": 100_000}, r"height \(100000\) must be from"),
        ({"fx": float("nan")}, r"fx \(nan\) must be from"),
        ({"cx": float("inf")}, r"cx \(inf\) must be from"),
        ({"position": (0.0, 448.0, 653.0)}, r"position y \(448.0\) must be from -10 to 10 m"),
        ({"rotation": ((1.0, 0.0, 0.0), (0.0, 2.0, 0.0), (0.0, 0.0, 1.0))}, "three orthonormal rows"),
        ({"rotation": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, -1.0))}, "rotation mirrors"),
    ],
)
def test_a_camera_that_is_none_is_refused(change, reason):
    with pytest.raises(InputError, match=reason):
        Camera(**change)


def test_root_depth_is_an_exact_ray_cast_of_the_superquadric():
    scene = scene_of(BOX, CYLINDER)
    depth = np.asarray(jax.jit(render.render_depth, static_argnums=0)(COARSE, scene))
    exact = reference_superquadric_depth(COARSE, scene)
    both = np.isfinite(depth) & np.isfinite(exact)
    assert both.sum() > 150
    # At silhouettes one of the two may just miss.
    assert (np.isfinite(depth) != np.isfinite(exact)).sum() <= 3
    error = np.abs(depth[both] - exact[both])
    assert np.mean(error) < 1e-4
    assert np.percentile(error, 99) < 1e-3


@pytest.mark.parametrize(("body", "shape"), [(BOX, "box"), (CYLINDER, "cylinder")])
def test_exponents_of_two_tenths_stand_for_boxes_and_cylinders(body, shape):
    depth = np.asarray(render.render_depth(COARSE, scene_of(body)))
    exact = analytic_depth(COARSE, body[0], body[2], body[3], shape)
    both = np.isfinite(depth) & np.isfinite(exact)
    assert np.mean(np.abs(depth[both] - exact[both])) < 2e-3
    # Exponents of 0.2 round the edges, so a few silhouette pixels see past them.
    assert (np.isfinite(depth) != np.isfinite(exact)).sum() < 0.15 * both.sum()


def test_windows_merge_to_the_whole_image():
    scene = scene_of(BOX, CYLINDER)
    windows = jax.vmap(lambda one: render.object_window(COARSE, one, (48, 48)))(scene)
    assert np.all(np.asarray(windows.stride) == 1)
    np.testing.assert_allclose(render.merge_windows(COARSE, windows), render.render_depth(COARSE, scene), rtol=1e-5)


LARGEST = {"tall cylinder": (0.034, 0.034, 0.107), "long box": (0.078, 0.022, 0.096), "fits nowhere": (0.3, 0.3, 0.3)}


@pytest.mark.parametrize("half", LARGEST.values(), ids=LARGEST)
@pytest.mark.parametrize(("yaw", "lean"), [(0.0, 0.0), (0.6, 0.0), (-1.0, np.pi / 2), (0.4, 0.7)])
def test_no_image_outgrows_its_window(half, yaw, lean):
    along = transforms.yaw_rotation(jnp.float32(yaw))
    rotation = np.asarray(along @ Rotation.from_rotvec([0.0, lean, 0.0]).as_matrix())
    # As near to the camera as the board allows: its left front corner.
    position = (0.42, 0.47, 0.4045 + np.abs(rotation[2]) @ np.array(half))
    scene = scene_of((half, shape_of("box").exponents, position, 0.0)).replace(rotation=jnp.float32(rotation)[None])
    window = jax.vmap(lambda one: render.object_window(COARSE, one, (48, 48)))(scene)
    stride = int(window.stride[0])
    merged, whole = (
        np.isfinite(image) for image in (render.merge_windows(COARSE, window), render.render_depth(COARSE, scene))
    )
    assert whole.sum() > 400
    if stride == 1:
        np.testing.assert_array_equal(merged, whole)
    blurred = np.ones((2 * stride + 1,) * 2)
    assert np.all(merged[ndimage.binary_erosion(whole, blurred, border_value=1)])
    assert np.all(ndimage.binary_dilation(whole, blurred)[merged])


def test_absent_objects_are_not_seen():
    scene = scene_of(BOX, CYLINDER)
    alone = scene.replace(valid=jnp.array([True, False]))
    np.testing.assert_array_equal(render.render_depth(COARSE, alone), render.render_depth(COARSE, scene_of(BOX)))


def test_depth_has_the_gradient_of_finite_differences():
    scene = scene_of(CYLINDER)
    origin = jnp.array(COARSE.position)
    aim = scene.position[0] + jnp.float32([0.0, 0.01, 0.012]) - origin
    one = jax.tree.map(lambda a: a[0], scene)

    @jax.jit
    def depth(shift, grow):
        moved = one.replace(position=one.position + shift, size=one.size * grow)
        return render.object_depth(moved, origin, aim)

    gradient = jax.grad(depth, argnums=(0, 1))(jnp.zeros(3), jnp.float32(1.0))
    h = 2e-3
    numeric = [(depth(h * e, 1.0) - depth(-h * e, 1.0)) / (2 * h) for e in jnp.eye(3)]
    np.testing.assert_allclose(gradient[0], numeric, atol=0.05)
    np.testing.assert_allclose(
        gradient[1], (depth(jnp.zeros(3), 1 + h) - depth(jnp.zeros(3), 1 - h)) / (2 * h), atol=0.05
    )


def test_back_projected_points_project_to_their_pixels():
    depth = jnp.linspace(0.5, 1.5, COARSE.height * COARSE.width).reshape(COARSE.height, COARSE.width)
    depth = depth.at[3, 5].set(jnp.inf)
    points = camera.back_project(COARSE, depth)
    assert jnp.all(jnp.isnan(points[3, 5]))
    pixels, z = camera.project(COARSE, jnp.where(jnp.isnan(points), 0.0, points))
    rows, columns = np.indices(depth.shape)
    seen = np.isfinite(depth)
    np.testing.assert_allclose(pixels[seen], np.stack([rows, columns], axis=-1)[seen], atol=0.01)
    np.testing.assert_allclose(z[seen], depth[seen], atol=1e-5)
