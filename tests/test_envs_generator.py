"""The generator keeps its promises: hidden, at rest, graspable but for the objects, and the same for the same seed."""

import dataclasses
import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mechsearch_jax.envs import generator, simulated_camera, world
from mechsearch_jax.envs.generator import BOXES, CYLINDERS, GeneratorConfig, ScenarioGenerator, outline, separation
from mechsearch_jax.envs.native import NativeWorld
from mechsearch_jax.errors import InputError
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import Body, format_scenario, parse_scenario
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

SHELF = Shelf()
SIZES = {tuple(round(s / 2, 6) for s in box) for box in BOXES}
SIZES |= {(b, a, c) for a, b, c in SIZES}
SIZES |= {(r, r, round(h / 2, 6)) for r, h in CYLINDERS}


@pytest.fixture(scope="module", params=["cylinder", "box"])
def target(request):
    return Target.cylinder() if request.param == "cylinder" else Target.box()


@pytest.fixture(scope="module")
def made(target):
    return ScenarioGenerator(target)


@pytest.fixture(scope="module")
def allowed(target):
    poses = target.candidate_poses(SHELF)
    return poses[generator.graspable_alone(SHELF, target)]


def check(scene, objects, target, allowed):
    """Everything that a generated scenario promises."""
    state = world.from_scenario(scene)
    assert len(scene.objects) == objects
    assert all(tuple(round(s, 6) for s in b.half_size) in SIZES for b in scene.objects)
    assert scene.target.half_size == target.half_size
    assert int(simulated_camera.target_pixels(Camera(), state)) == 0

    yaw = 2 * np.arctan2(scene.target.quaternion[3], scene.target.quaternion[0])
    placed = np.array([*scene.target.position[:2], yaw])
    assert np.abs(allowed - placed).max(axis=1).min() < 1e-4

    simulator = NativeWorld()
    simulator.reset(scene)
    outcome = simulator.settle()
    assert outcome.settled
    assert not outcome.fallen.any()
    assert np.abs(np.asarray(simulator.world.position - state.position)).max() < 1.5e-3
    footprint = outline(scene.target)
    assert all(separation(footprint, outline(body)) > 0.001 for body in scene.objects)
    assert parse_scenario(json.loads(format_scenario(scene)), "made") == scene


@pytest.mark.parametrize("seed", range(4))
def test_promises(made, target, allowed, seed):
    objects = 2 + 2 * seed
    check(made.generate(seed, objects), objects, target, allowed)


@pytest.mark.slow
def test_promises_on_50_seeds(made, target, allowed):
    for seed in range(100, 150):
        objects = 1 + seed % 8
        check(made.generate(seed, objects), objects, target, allowed)


def test_a_seed_means_one_scenario(made):
    first, other = made.generate(3, 4), made.generate(4, 4)
    assert ScenarioGenerator(made.target).generate(3, 4) == first
    assert first.name == "generated-4-3"
    assert first.objects != other.objects
    assert made.generate(3, 4, "mine") == dataclasses.replace(first, name="mine")


def test_what_cannot_be_generated_is_one_line(made):
    for seed, objects, message in ((0, 9, "objects: 9"), (0, 0, "objects: 0"), (-1, 4, "seed: -1 is negative")):
        with pytest.raises(InputError, match=message):
            made.generate(seed, objects)
    with pytest.raises(InputError, match='"ball" is unknown'):
        generator.generate_scenario(0, 4, target="ball")
    nowhere = ScenarioGenerator(config=GeneratorConfig(attempts=2), graspable=lambda pose: False)
    with pytest.raises(InputError, match="no graspable place is hidden in 2 scenes"):
        nowhere.generate(0, 4)


def test_separation_is_the_gap_between_outlines():
    box = Body("box", (0.03, 0.02, 0.05), (0.5, 0.0, 0.45), (1.0, 0.0, 0.0, 0.0))
    can = Body("cylinder", (0.02, 0.02, 0.05), (0.5, 0.1, 0.45), (1.0, 0.0, 0.0, 0.0))
    assert separation(outline(box), outline(can)) == pytest.approx(0.06, abs=2e-4)
    assert separation(outline(can), outline(box)) == pytest.approx(0.06, abs=2e-4)
    assert separation(outline(box), outline(dataclasses.replace(box, position=(0.55, 0.0, 0.5)))) < 0


def test_outlines_hold_the_body_at_any_pose():
    rng = np.random.default_rng(0)
    for shape in ("box", "cylinder"):
        half = np.array([0.03, 0.03 if shape == "cylinder" else 0.02, 0.06])
        turn = Rotation.random(random_state=rng)
        body = Body(shape, tuple(half), (0.6, 0.1, 0.5), tuple(turn.as_quat(scalar_first=True)))
        inside = rng.uniform(-1, 1, (2000, 3))
        if shape == "cylinder":
            inside = inside[np.hypot(inside[:, 0], inside[:, 1]) < 1]
        points = turn.apply(inside * half)[:, :2] + (0.6, 0.1)
        corners = outline(body)
        sides = np.roll(corners, -1, axis=0) - corners
        left = sides[:, 0] * (points[:, None, 1] - corners[:, 1]) - sides[:, 1] * (points[:, None, 0] - corners[:, 0])
        assert (left > -1e-9).all()
