"""A camera that was calibrated again is data: it compiles nothing, and its results are those of a constant."""

import dataclasses
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mechsearch_jax.calibration.limits import CalibrationLimits
from mechsearch_jax.envs.camera.simulated_camera import observe
from mechsearch_jax.envs.world.world import from_scenario
from mechsearch_jax.images.cloud import BLOCK, STRIDE, middle, shelf_view, thinned_view, view
from mechsearch_jax.images.labels import MISSING
from mechsearch_jax.perception.recogniser import Recogniser
from mechsearch_jax.runtime.compiled import CachedJit, keep_in
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.session.faults import check_image, recognition_warnings
from mechsearch_jax.session.images import converted
from mechsearch_jax.workspace import render
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import example_scenarios, load_scenario, superquadrics
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

KEY = jax.random.key(0)
SHELF, TARGET = Shelf(), Target.cylinder()
OBJECTS = superquadrics(load_scenario(example_scenarios()["first-light"]).objects)


def recalibrated(camera, turn=1e-6, shift=1e-4):
    """The camera as another calibration has it: turned [rad] and moved [m] a little."""
    turned = Rotation.from_rotvec([turn, -turn, turn]).as_matrix() @ np.array(camera.rotation)
    rotation = tuple(map(tuple, turned.tolist()))
    return dataclasses.replace(camera, rotation=rotation, fx=camera.fx + 1e-3).moved((shift, -shift, shift))


NEW = recalibrated(Camera())


def traced_as(tree):
    """What a jitted function is traced from."""
    leaves, structure = jax.tree.flatten(tree)
    return structure, [(jnp.shape(a), jnp.result_type(a), jax.typeof(a).weak_type) for a in leaves]


def test_a_camera_survives_jax_and_is_what_it_was_outside():
    camera = Camera(fx=600, position=(0, 0.25, 0.5))
    leaves, structure = jax.tree.flatten(camera)
    assert [type(leaf) for leaf in leaves] == [float] * 16
    again = jax.tree.unflatten(structure, leaves)
    assert (again, hash(again), repr(again)) == (camera, hash(camera), repr(camera))
    assert camera == Camera(fx=600.0, position=(0.0, 0.25, 0.5)) != NEW
    assert len({camera, again, NEW, Camera()}) == 3
    assert jax.tree.structure(camera) == jax.tree.structure(NEW)
    assert jax.tree.structure(camera) != jax.tree.structure(camera.scaled(2))
    assert Camera(fx=np.float64(600.0), position=(np.float64(0.0), 0.25, 0.5)) == camera
    # Whatever JAX puts in the place of leaves is not looked at.
    for other in (None, True, object(), jax.ShapeDtypeStruct((), jnp.float32), jnp.float32(-1.0)):
        rebuilt = jax.tree.unflatten(structure, [other] * 16)
        assert rebuilt.fx is other
        assert rebuilt.position == (other,) * 3


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"width": 0}, "Camera: width (0) must be from 1 to 16384 pixels"),
        ({"fx": -1.0}, "Camera: fx (-1.0) must be from 0.001 to 1.6384e+06 pixels"),
        ({"cy": float("nan")}, "Camera: cy (nan) must be from -163840 to 163840 pixels"),
        ({"rotation": ((1.0, 0.0, 0.0),) * 3}, "Camera: rotation must be a rotation matrix, three orthonormal rows"),
        (
            {"rotation": ((-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))},
            "Camera: rotation mirrors; its columns are the camera's x, y and z, a right-handed frame",
        ),
        ({"position": (0.0, 11.0, 0.0)}, "Camera: position y (11.0) must be from -10 to 10 m"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_an_impossible_camera_is_refused_as_before(wrong, message):
    with pytest.raises(InputError) as caught:
        Camera(**wrong)
    assert str(caught.value) == message


def test_what_was_kept_on_disk_is_found_for_another_pose(tmp_path):
    traced = []

    def depths(camera, scene):
        traced.append("depths")
        return render.render_depth(camera, scene)

    # As a function of a module, which another process finds.
    small = [camera.scaled(20) for camera in (Camera(), NEW)]
    keep_in(tmp_path)
    first = CachedJit(depths, ())(small[0], OBJECTS)
    again = CachedJit(depths, ())
    assert again.is_ready(small[1], OBJECTS)
    second = again(small[1], OBJECTS)
    assert traced == ["depths"]
    assert not np.array_equal(first, second)


def test_cameras_of_a_batch_may_differ():
    """Rendered together and one by one."""
    cameras = [c.scaled(20) for c in (Camera(), NEW.moved((0.05, 0.0, 0.0)))]
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), *cameras)
    together = jax.vmap(lambda camera: render.render_depth(camera, OBJECTS))(both)
    for camera, image in zip(cameras, together, strict=True):
        one = render.render_depth(camera, OBJECTS)
        same = np.isfinite(one) & np.isfinite(image)
        assert (np.isfinite(one) == np.isfinite(image)).mean() > 0.999
        np.testing.assert_allclose(image[same], one[same], atol=1e-4)


def test_of_100_calibrations_a_millimetre_apart_nearly_all_share_a_program():
    rng = np.random.default_rng(0)
    expected = traced_as(thinned_view(Camera(), SHELF))
    cameras = [recalibrated(Camera(), *rng.normal(scale=1e-3, size=2)) for _ in range(100)]
    views = [thinned_view(camera, SHELF) for camera in cameras]
    assert sum(traced_as(seen) == expected for seen in views) >= 90
    for seen in views:
        assert seen.camera.height % BLOCK == seen.camera.width % BLOCK == 0


@pytest.mark.parametrize("stride", [1, 2, 3])
@pytest.mark.parametrize("channels", [(), (3,)])
def test_a_view_takes_its_rays_from_an_image_wherever_they_begin(stride, channels):
    image = jnp.arange(72 * 128 * max(1, *channels, 1)).reshape(72, 128, *channels)
    small = dataclasses.replace(Camera().scaled(10), width=128, height=72)
    of = jax.jit(lambda seen, image: seen.of(image))
    for row, column in ((0, 0), (5, 11), (12, 27)):
        seen = view(small, (row, row + 60), (column, column + 101), stride)
        expected = image[row : row + 60 : stride, column : column + 101 : stride]
        np.testing.assert_array_equal(seen.of(image), expected)
        np.testing.assert_array_equal(of(seen, image), expected)
    assert of._cache_size() == 1


def wrist(down, distance, camera):
    """The camera at a pose that looks at the middle of the board, down by an angle [degrees], from a distance [m]."""
    angle = np.radians(down)
    forward = np.array([np.cos(angle), 0.0, -np.sin(angle)])
    rotation = np.stack([(0.0, -1.0, 0.0), np.cross(forward, (0.0, -1.0, 0.0)), forward], axis=1)
    position = np.array([*middle(SHELF)]) - distance * forward
    return dataclasses.replace(camera, rotation=tuple(map(tuple, rotation.tolist())), position=tuple(position.tolist()))


@pytest.mark.parametrize(("width", "height", "focal"), [(1280, 720, 609.635), (640, 480, 525.0), (848, 480, 424.0)])
def test_all_poses_of_a_camera_share_two_programs(width, height, focal):
    """And the view of each shows all of the shelf that the image does, at about the density of training."""
    one = dataclasses.replace(Camera(), width=width, height=height, fx=focal, fy=focal, cx=width / 2.0, cy=height / 2.0)
    views, trained = [], Camera().fx / np.linalg.norm(np.subtract(Camera().position, middle(SHELF))) / STRIDE
    for down in (10, 25, 45, 60):
        for distance in (0.4, 0.7, 1.1, 1.6):
            camera = wrist(down, distance, one)
            seen, tight = thinned_view(camera, SHELF), shelf_view(camera, SHELF, 1)
            inside = seen.inside(camera)
            for first, count, wanted, end, size in (
                (seen.row, inside.camera.height, tight.row, tight.row + tight.camera.height, height),
                (seen.column, inside.camera.width, tight.column, tight.column + tight.camera.width, width),
            ):
                assert 0 <= first <= wanted
                assert end - seen.stride < first + (count - 1) * seen.stride + 1 <= size
            assert 0.65 < focal / distance / seen.stride / trained < 1.7
            views.append(seen)
    assert len({seen.stride for seen in views}) > 1
    kinds = [traced_as(seen) for seen in views]
    assert len(set(map(str, kinds))) <= 2


def test_a_view_that_ends_beyond_the_image_has_no_depth_there():
    camera = Camera().scaled(5)
    seen = thinned_view(camera, SHELF)
    image = np.arange(camera.height * camera.width, dtype=np.float32).reshape(camera.height, camera.width) + 1.0
    part, inside = np.asarray(seen.of(jnp.asarray(image))), np.asarray(seen.is_inside(camera))
    np.testing.assert_array_equal(np.isfinite(part), inside)
    kept = seen.inside(camera)
    np.testing.assert_array_equal(part[: kept.camera.height, : kept.camera.width], kept.cut(image))
    assert kept.camera.height * kept.camera.width == inside.sum() < inside.size
    number = np.asarray(seen.of(jnp.zeros((camera.height, camera.width), jnp.int32)))
    assert (number[~inside] < MISSING).all()


@pytest.mark.slow
def test_another_pose_of_a_wrist_camera_compiles_nothing():
    """Neither recognition nor the checks of its images, if its view is of the size of one before."""
    names = []

    def count(name, seconds, **_):
        if "backend_compile" in name:
            names.append(name)

    world, shelf, counted = from_scenario(load_scenario(example_scenarios()["first-light"])), Shelf(faces=()), []
    looks = []
    for down, distance in ((25, 1.1), (10, 1.6), (60, 0.45), (20, 0.6)):
        camera = wrist(down, distance, Camera())
        image = observe(camera, world, shelf)
        depth = np.where(np.isfinite(image.depth), image.depth, 0.0).astype(np.float32)
        looks.append((camera, converted(depth, np.uint8(255 * np.asarray(image.colour)), None, None)))
    jax.monitoring.register_event_duration_secs_listener(count)
    for camera, images in looks:
        names.clear()
        setting = types.SimpleNamespace(camera=camera, shelf=shelf, target=TARGET)
        recognise = Recogniser(setting)
        look, _ = check_image(setting, CalibrationLimits(), images, recognise)
        seen = recognise.unchecked(KEY, *images).judged()
        recognition_warnings(setting, look, seen, recognise)
        counted.append(len(names))
        assert seen.objects.valid.sum() >= 2
    assert len({thinned_view(camera, shelf).camera.height for camera, _ in looks}) == 1
    assert counted[0] > 0
    assert counted[1:] == [0] * (len(looks) - 1)
