"""What scenes are like: counts against a brute-force count in the image, and figures that are those of the rows."""

import dataclasses

import numpy as np
import pytest
from stage import CYLINDER, HIDDEN, OPEN, TWO

from mechsearch_jax.benchmarks.lab.parts import scenes
from mechsearch_jax.benchmarks.lab.parts.exact_existence import exact_existence
from mechsearch_jax.benchmarks.lab.parts.scenes import look_at_all, nearest_pose
from mechsearch_jax.envs.camera.simulated_camera import observe, target_pixels
from mechsearch_jax.envs.world.world import TARGET, from_scenario, true_superquadrics
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.detector import FOUND_PIXELS
from mechsearch_jax.workspace.scenario import Scenario
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target


@pytest.fixture(scope="module")
def looked(problem):
    """Three scenes, looked at with the problem that other tests have built."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scenes, "cached_problem", lambda target: problem)
        return {row.scenario: row for row in look_at_all({"stage": [HIDDEN, OPEN, TWO]})}


def test_what_is_seen_is_what_the_image_shows(looked):
    for scene in (HIDDEN, OPEN, TWO):
        owner = np.asarray(observe(Camera(), from_scenario(scene)).segmentation)
        alone = observe(Camera(), from_scenario(Scenario("alone", (), scene.target))).segmentation
        row = looked[scene.name]
        assert row.target_pixels == (owner == TARGET).sum()
        assert row.target_share == pytest.approx(
            (owner == TARGET).sum() / (np.asarray(alone) == TARGET).sum(), abs=1e-4
        )
        shares = []
        for i, body in enumerate(scene.objects):
            one = observe(
                Camera(),
                from_scenario(Scenario("alone", (body,), dataclasses.replace(CYLINDER, position=(-5.0, 0.0, 0.0)))),
            )
            shares.append((owner == i).sum() / (np.asarray(one.segmentation) == 0).sum())
        assert row.objects_share == pytest.approx(np.mean(shares), abs=0.01)
        assert row.visible == len(scene.objects) == row.objects
        assert row.content_hash == scene.content_hash
    assert looked["hidden"].target_share == 0.0
    assert looked["open"].target_share == 1.0


def test_f_is_that_of_a_target_that_is_not_seen(looked):
    # Behind the box the target can be; where nothing hides it, it cannot.
    assert looked["hidden"].truth_possible
    assert not looked["open"].truth_possible
    assert 10 < looked["hidden"].possible < 200
    assert looked["two"].possible > looked["hidden"].possible
    assert {row.candidates for row in looked.values()} == {792}


@pytest.mark.slow
def test_brute_force_finds_the_poses_at_which_the_image_shows_too_few_pixels_to_detect(problem):
    for scene in (HIDDEN, TWO):
        world = from_scenario(scene)
        exists = np.asarray(exact_existence(problem, true_superquadrics(world), side=1))
        cells = np.asarray(exact_existence(problem, true_superquadrics(world), side=3))
        assert not (exists & ~cells).any()
        assert exists.sum() < cells.sum()
        # Half of them where it exists, half elsewhere.
        rng = np.random.default_rng(0)
        chosen = np.concatenate(
            [rng.choice(np.flatnonzero(exists == there), 15, replace=False) for there in (True, False)]
        )
        for i in chosen:
            x, y, _ = np.asarray(problem.poses[i])
            moved = world.replace(position=world.position.at[TARGET, :2].set(np.array([x, y])))
            pixels = int(target_pixels(Camera(), moved))
            # The edges of superquadrics are a little rounder than those of bodies.
            if not 60 < pixels < 160 and not (pixels == 0 and not exists[i]):
                assert exists[i] == (pixels <= FOUND_PIXELS)
            # Where it shows nothing it exists, unless it would stand in an object.
            if pixels == 0 and not exists[i]:
                assert min(np.hypot(*(np.array(b.position[:2]) - (x, y))) for b in scene.objects) < 0.12


def test_the_nearest_pose_is_near_in_place_and_yaw():
    shelf = Shelf()
    for target in (Target.cylinder(), Target.box()):
        poses = target.candidate_poses(shelf)
        cell = target.cell(shelf)
        rng = np.random.default_rng(0)
        for index in rng.integers(len(poses), size=50):
            shift = rng.uniform(-0.45, 0.45, 3) * cell
            turned = poses[index] + shift + [0.0, 0.0, np.pi * rng.integers(-2, 3)]
            assert nearest_pose(target, shelf, turned) == index
