"""The ray-cast image against a brute-force ray march in float64, and against MuJoCo's renderer where there is one."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mechsearch_jax.envs.camera import simulated_camera
from mechsearch_jax.envs.world import world
from mechsearch_jax.envs.world.model import shelf_boxes
from mechsearch_jax.envs.world.world import TARGET
from mechsearch_jax.shapes.primitives import CYLINDER
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import Body, Scenario
from mechsearch_jax.workspace.shelf import Shelf

CAMERA = Camera().scaled(8)
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
TALL_BOX = Body("box", (0.054, 0.025, 0.054), (0.55, 0.1, 0.4585), UPRIGHT)
CAN = Body("cylinder", (0.034, 0.034, 0.107), (0.6, 0.25, 0.5115), UPRIGHT)
TARGET_BODY = Body("cylinder", (0.02, 0.02, 0.05), (0.7, 0.0, 0.4545), UPRIGHT)
SCENE = Scenario("scene", (TALL_BOX, CAN), TARGET_BODY)


def random_scenario(seed, count=6):
    """Bodies of any shape at any pose in the shelf, the target among them."""
    rng = np.random.default_rng(seed)

    def body(shape):
        a, b, c = rng.uniform(0.02, 0.08, 3)
        turn = Rotation.random(random_state=rng).as_quat(scalar_first=True)
        place = rng.uniform((0.45, -0.2, 0.45), (0.75, 0.4, 0.7))
        return Body(shape, (a, a if shape == "cylinder" else b, c), tuple(place), tuple(turn))

    return Scenario("random", tuple(body(rng.choice(["box", "cylinder"])) for _ in range(count)), body("cylinder"))


def march(camera, scene, row, column, steps=20_000):
    """First point of a pixel's ray inside a body or the shelf: dense samples, then bisection, in float64."""
    rotation = np.array(camera.rotation)
    direction = rotation @ [(column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy, 1.0]
    turns = [np.array(world.rotation_matrix(b.quaternion)) for b in (*scene.objects, scene.target)]

    def owners(depth):
        point = np.array(camera.position) + depth[:, None] * direction
        inside = []
        for body, turn in zip((*scene.objects, scene.target), turns, strict=True):
            local = (point - body.position) @ turn / body.half_size
            if body.shape == "box":
                inside.append((np.abs(local) < 1).all(axis=1))
            else:
                inside.append((local[:, 0] ** 2 + local[:, 1] ** 2 < 1) & (np.abs(local[:, 2]) < 1))
        boards = [((point > low) & (point < high)).all(axis=1) for low, high in shelf_boxes(Shelf()).values()]
        return np.array([*inside, np.any(boards, axis=0)])

    depths = np.linspace(0.3, 1.6, steps)
    hit = owners(depths).any(axis=0)
    if not hit.any():
        return np.inf, -1
    far, near = depths[hit.argmax()], depths[hit.argmax() - 1]
    for _ in range(40):
        middle = (near + far) / 2
        near, far = (near, middle) if owners(np.array([middle])).any() else (middle, far)
    slots = [*range(len(scene.objects)), TARGET, simulated_camera.SHELF]
    return far, slots[int(owners(np.array([far]))[:, 0].argmax())]


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_depth_and_segmentation_are_those_of_a_ray_march(seed):
    scene = random_scenario(seed)
    seen = simulated_camera.observe(CAMERA, world.from_scenario(scene))
    rng = np.random.default_rng(seed)
    rows, columns = rng.integers(0, CAMERA.height, 150), rng.integers(0, CAMERA.width, 150)
    for row, column in zip(rows, columns, strict=True):
        depth, owner = march(CAMERA, scene, row, column)
        # A sliver thinner than a sample can be missed by the march, never by the ray-cast.
        assert seen.depth[row, column] <= depth + 2e-5
        if abs(seen.depth[row, column] - depth) < 2e-5:
            assert seen.segmentation[row, column] == owner
        else:
            assert np.isinf(depth) == np.isinf(seen.depth[row, column])


NO_RENDERER = 3
RENDER = """
import sys
import numpy as np
try:
    # With an OpenGL backend that is not there, already the import fails.
    import mujoco
except Exception:
    sys.exit(3)
from mechsearch_jax.envs.world import model
from mechsearch_jax.envs.world import world
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import load_scenario
from mechsearch_jax.workspace.shelf import Shelf

camera = Camera().scaled(4)
bodies = world.slots(load_scenario(sys.argv[1]))
compiled = model.with_bodies(model.compile_model(Shelf(), camera), bodies, skin=0.0)
compiled.vis.quality.numslices = 128
try:
    renderer = mujoco.Renderer(compiled, camera.height, camera.width)
except Exception:
    sys.exit(3)
shown = mujoco.MjvOption()
shown.geomgroup[:] = [1, 1, 0, 0, 0, 0]
renderer.enable_depth_rendering()
renderer.update_scene(model.initial_state(compiled, bodies), "camera", shown)
np.save(sys.argv[2], renderer.render())
"""


def test_depth_is_within_a_millimetre_of_the_renderer(tmp_path):
    from mechsearch_jax.workspace.scenario import save_scenario

    scene = random_scenario(7)
    save_scenario(scene, tmp_path / "scene.json")
    for backend in ("osmesa", "egl"):
        command = [sys.executable, "-c", RENDER, str(tmp_path / "scene.json"), str(tmp_path / "depth.npy")]
        done = subprocess.run(command, env={**os.environ, "MUJOCO_GL": backend}, capture_output=True, text=True)
        if done.returncode == 0:
            break
        assert done.returncode == NO_RENDERER, done.stderr
    else:
        pytest.skip("neither OSMesa nor EGL renders here")
    rendered = np.load(tmp_path / "depth.npy")
    seen = simulated_camera.observe(Camera().scaled(4), world.from_scenario(scene))
    owner = np.asarray(seen.segmentation)
    # Where neighbours show different things, or nothing, the two may differ by half a pixel on who is hit.
    shifts = [np.roll(owner, shift, axis) for shift in (-1, 1) for axis in (0, 1)]
    inner = (owner >= 0) & np.all([owner == s for s in shifts], axis=0)
    error = np.abs(np.asarray(seen.depth) - rendered)[inner]
    assert inner.mean() > 0.3
    assert np.percentile(error, 99.5) < 1e-3
    assert error.mean() < 2e-4


def test_colour_tells_bodies_apart_and_the_target_is_red():
    seen = simulated_camera.observe(CAMERA, world.from_scenario(SCENE))
    owner, colour = np.asarray(seen.segmentation), np.asarray(seen.colour)
    assert colour.min() >= 0.0
    assert colour.max() <= 1.0
    assert set(np.unique(owner)) == {-1, 0, 1, TARGET, simulated_camera.SHELF}
    red = colour[owner == TARGET]
    assert (red[:, 0] > 2 * red[:, 1]).all()
    assert np.isinf(np.asarray(seen.depth)[owner == -1]).all()


@pytest.mark.parametrize("seed", range(6))
def test_target_pixels_are_those_of_the_whole_image(seed):
    rng = np.random.default_rng(seed)
    place = (rng.uniform(0.43, 0.77), rng.uniform(-0.26, 0.46), 0.4545)
    scene = Scenario("scene", random_scenario(seed).objects, Body("cylinder", (0.02, 0.02, 0.05), place, UPRIGHT))
    state = world.from_scenario(scene)
    camera = Camera().scaled(2)
    whole = int(jnp.sum(simulated_camera.observe(camera, state).segmentation == TARGET))
    assert int(simulated_camera.target_pixels(camera, state)) == whole


def test_the_detector_needs_more_than_100_pixels():
    camera = Camera()
    behind = Scenario("hidden", (Body("box", (0.02, 0.15, 0.1), (0.6, 0.0, 0.505), UPRIGHT),), TARGET_BODY)
    assert not simulated_camera.is_found(camera, world.from_scenario(behind))
    assert simulated_camera.is_found(camera, world.from_scenario(SCENE))
    assert int(simulated_camera.target_pixels(camera, world.from_scenario(behind))) == 0


@pytest.mark.slow
def test_eager_jit_and_vmap_agree():
    states = [world.from_scenario(random_scenario(seed, count)) for seed, count in ((0, 3), (1, 8))]
    stacked = jax.tree.map(lambda *a: jnp.stack(a), *states)
    camera = Camera().scaled(16)
    batch = jax.vmap(lambda state: simulated_camera.observe(camera, state))(stacked)
    for i, state in enumerate(states):
        single = simulated_camera.observe(camera, state)
        np.testing.assert_allclose(batch.depth[i], single.depth, atol=1e-6)
        np.testing.assert_array_equal(batch.segmentation[i], single.segmentation)
        with jax.disable_jit():
            eager = simulated_camera.observe(camera, state)
        np.testing.assert_allclose(eager.depth, single.depth, atol=1e-6)


def test_adding_and_moving_objects_compiles_nothing_anew():
    simulated_camera.observe(CAMERA, world.from_scenario(SCENE))
    before = simulated_camera.observe._cache_size()
    simulated_camera.observe(CAMERA, world.from_scenario(random_scenario(5, 8)))
    assert simulated_camera.observe._cache_size() == before


def test_the_truth_as_superquadrics_leaves_the_target_out():
    scene = world.true_superquadrics(world.from_scenario(SCENE))
    assert scene.capacity == 8
    np.testing.assert_array_equal(np.asarray(scene.valid), [True, True] + [False] * 6)
    np.testing.assert_allclose(scene.exponents[:2], [(0.2, 0.2), (0.2, 1.0)])
    assert world.from_scenario(SCENE).kind[1] == CYLINDER
