"""Lenses that distort, and several frames of one look."""

import dataclasses
import json

import numpy as np
import pytest
from scipy.optimize import fsolve

from mechsearch_jax.commands import plan
from mechsearch_jax.images.image_files import load_camera, load_lens, save_camera, save_colour, save_depth, save_mask
from mechsearch_jax.images.labels import MISSING
from mechsearch_jax.images.lens import Lens, distortion_of
from mechsearch_jax.images.measured import median_depth
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.camera import Camera

CAMERA = Camera(width=320, height=240, fx=260.0, fy=255.0, cx=163.0, cy=118.0)
LENSES = {
    "barrel": (-0.28, 0.07, 0.0011, -0.0007, 0.01),
    "four numbers": (0.12, -0.05, -0.002, 0.001),
    # As a camera of 120 degrees has it.
    "rational": (0.52, -2.61, 0.0006, -0.0002, 1.52, 0.40, -2.43, 1.44),
}


def distorted(points, camera, D):
    """Where a lens shows points of the camera's frame, in pixels from the first one's corner: by OpenCV's formulas."""
    k1, k2, p1, p2, k3, k4, k5, k6 = np.pad(np.array(D, np.float64), (0, 8 - len(D)))
    x, y = points[..., 0] / points[..., 2], points[..., 1] / points[..., 2]
    r2 = x**2 + y**2
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    v = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    return np.stack([camera.fx * u + camera.cx, camera.fy * v + camera.cy], -1)


def ray(pixel, camera, D):
    """The direction that a lens shows at a place in its image, solved for in double precision."""
    start = ((pixel[0] - camera.cx) / camera.fx, (pixel[1] - camera.cy) / camera.fy)
    return np.array([*fsolve(lambda xy: distorted(np.array([*xy, 1.0]), camera, D) - pixel, start, xtol=1e-10), 1.0])


@pytest.fixture(params=LENSES)
def lens(request):
    return Lens(CAMERA, LENSES[request.param])


def taken(lens, value):
    """An image of the lens: a function of the direction (x, y) of each pixel's ray, on a coarse grid made finer."""
    from scipy import ndimage

    step, rim = 8, 3
    rows, columns = (np.mgrid[-rim : 240 // step + rim, -rim : 320 // step + rim] * step) + 0.5
    pixels = np.stack([columns.ravel(), rows.ravel()], -1)
    rays = np.array([ray(pixel, CAMERA, lens.distortion)[:2] for pixel in pixels]).reshape(*rows.shape, 2)
    places = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width] / step + rim
    return value(*(ndimage.map_coordinates(rays[..., i], places, order=3, mode="nearest") for i in range(2)))


def straight():
    """The direction (x, y) of each pixel of the pinhole camera."""
    rows, columns = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width] + 0.5
    return (columns - CAMERA.cx) / CAMERA.fx, (rows - CAMERA.cy) / CAMERA.fy


def test_pixels_are_taken_from_where_the_lens_shows_them(lens):
    """Points before the lens, projected through it, are found where the pinhole camera shows them."""
    generator = np.random.default_rng(0)
    found = 0
    for row, column in generator.integers(0, (CAMERA.height, CAMERA.width), (40, 2)):
        u, v = lens.sources[:, row, column][::-1] + 0.5
        if np.isnan(u):
            continue
        x, y, _ = ray((u, v), CAMERA, lens.distortion)
        assert abs(CAMERA.fx * x + CAMERA.cx - column - 0.5) < 1e-6
        assert abs(CAMERA.fy * y + CAMERA.cy - row - 0.5) < 1e-6
        found += 1
    assert found > 30


def test_a_plane_and_a_checkerboard_come_out_straight(lens):
    depth = taken(lens, lambda x, y: 0.9 / (1.0 + 0.2 * x - 0.3 * y)).astype(np.float32)
    x, y = straight()
    true = 0.9 / (1.0 + 0.2 * x - 0.3 * y)
    image = lens.depth(depth)
    seen = image > 0
    assert image.dtype == np.float32
    assert seen.mean() > 0.8
    # The nearest pixel is at most half a pixel away in each direction, and the lens shrinks by a third at most; a bias
    # of a tenth of a pixel would be 0.1 mm.
    slope = true**2 / 0.9 * (0.2 / CAMERA.fx + 0.3 / CAMERA.fy)
    assert (np.abs(image - true) < 0.75 * slope)[seen].all()
    assert abs(np.mean((image - true)[seen])) < 2e-5
    # A smooth checkerboard: a tenth of a pixel is 0.1 / 260 * 25 * 120 levels.
    board = lambda x, y: 127.5 + 120.0 * np.sin(25.0 * x) * np.sin(25.0 * y)  # noqa: E731
    raw = np.repeat(np.round(taken(lens, board)).astype(np.uint8)[..., None], 3, -1)
    wrong = np.abs(lens.colour(raw).astype(float) - board(x, y)[..., None])[seen]
    assert np.sqrt(np.mean(wrong**2)) < 1.0
    assert not lens.colour(raw)[~seen].any()


def test_holes_stay_holes_and_nothing_is_measured_where_the_lens_did_not_see(lens):
    depth, mask = np.ones((240, 320), np.float32), np.zeros((240, 320), np.int32)
    depth[100:110, 150:160], depth[120:130, 150:160], depth[140:150, 150:160] = 0.0, np.nan, np.inf
    seen = ~np.isnan(lens.sources[0])
    image = lens.depth(depth)
    assert set(image[np.isfinite(image)].tolist()) == {0.0, 1.0}
    for kind in (np.isnan, np.isposinf):
        assert 60 < kind(image).sum() < 160
    assert (image[~seen] == 0).all()
    numbers = lens.mask(mask)
    assert (numbers[seen] == 0).all()
    assert (numbers[~seen] == MISSING).all()


def test_beyond_where_the_polynomial_turns_back_nothing_was_seen():
    """x (1 - x^2 / 2) is largest at 0.816: what the formula says of wider rays would show the image twice."""
    wide = Camera(width=301, height=101, fx=100.0, fy=100.0, cx=150.5, cy=50.5)
    _rows, columns = Lens(wide, (-0.5, 0.0, 0.0, 0.0)).sources
    assert np.isnan(columns[50, [60, 240]]).all()
    assert np.isfinite(columns[50, [70, 230]]).all()
    row = columns[50][np.isfinite(columns[50])]
    assert (np.diff(row) > 0).all()


@pytest.mark.parametrize(
    ("model", "D", "words"),
    [
        ("equidistant", [0.0] * 4, "distortion_model equidistant is not understood; give images that are rectified"),
        ("thin_prism", [0.1] * 12, 'distortion_model "thin_prism" is not understood'),
        ("plumb_bob", [0.1] * 8, "D must have 4 or 5 numbers, not 8"),
        ("", [0.1] * 3, "D must have 4 or 5 or 8 numbers, not 3"),
    ],
)
def test_a_lens_that_is_not_understood_is_refused(model, D, words):
    with pytest.raises(InputError, match=f"^camera: {words}"):
        distortion_of(model, D, "camera")


def test_a_file_of_a_camera_keeps_its_lens(tmp_path):
    path = tmp_path / "camera.json"
    save_camera(CAMERA, path, LENSES["rational"])
    assert load_lens(path) == Lens(CAMERA, LENSES["rational"])
    with pytest.raises(InputError, match="the lens distorts; read it with load_lens"):
        load_camera(path)
    path.write_text(json.dumps(json.loads(path.read_text()) | {"distortion_model": 3}))
    with pytest.raises(InputError, match="distortion_model must be a name"):
        load_lens(path)


def test_plan_undistorts_all_images(tmp_path):
    depth, lens = np.full((240, 320), 0.8, np.float32), Lens(CAMERA, LENSES["barrel"])
    mask, colour = np.arange(320 * 240).reshape(240, 320) // 20000, np.full((240, 320, 3), 90, np.uint8)
    save_depth(depth, tmp_path / "depth.png")
    save_colour(colour, tmp_path / "colour.png")
    save_mask(mask, tmp_path / "mask.png")
    save_camera(CAMERA, tmp_path / "camera.json", lens.distortion)
    paths = {name: tmp_path / f"{name}.png" for name in ("colour", "mask")}
    files = plan.ImageFiles((tmp_path / "depth.png",), camera=tmp_path / "camera.json", **paths)
    images, camera, _ = files.load(None, Camera())
    assert camera == CAMERA
    np.testing.assert_array_equal(images["depth"], lens.depth(depth))
    np.testing.assert_array_equal(images["colour"], lens.colour(colour))
    np.testing.assert_array_equal(images["mask"], lens.mask(mask))


def test_the_median_of_frames_is_measured_in_half_of_them_and_between_no_surfaces(tmp_path):
    nan, inf = np.nan, np.inf
    columns = {
        "all": ([1.0, 3.0, 2.0, 1.5], 1.5),
        "half": ([0.0, 3.0, nan, 1.0], 1.0),
        "fewer": ([0.0, 3.0, nan, 65.535], 0.0),
        "two surfaces": ([1.0, 2.0, 1.0, 2.0], 1.0),
        "out of range": ([inf, inf, inf, 1.0], inf),
    }
    frames = [np.array([[values[i] for values, _ in columns.values()]], np.float32) for i in range(4)]
    np.testing.assert_array_equal(median_depth(frames)[0], [middle for _, middle in columns.values()])
    with pytest.raises(InputError, match="must have the same size"):
        median_depth([*frames, np.zeros((2, 5), np.float32)])
    for i, frame in enumerate(frames):
        np.save(tmp_path / f"{i}.npy", frame)
    files = plan.ImageFiles(tuple(tmp_path / f"{i}.npy" for i in range(4)))
    camera = dataclasses.replace(CAMERA, width=5, height=1)
    np.testing.assert_array_equal(files.load(None, camera)[0]["depth"], median_depth(frames))
