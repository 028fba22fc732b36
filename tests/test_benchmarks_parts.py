"""What the lab measures: agreement of simulators, classical recovery, segmentation, scenes at their start."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from stage import HIDDEN, TWO

from mechsearch_jax.actions import ActionKind
from mechsearch_jax.benchmarks.lab.parts import ems, images
from mechsearch_jax.benchmarks.lab.parts.agreement import (
    agreement,
    draw_actions,
    pose_differences,
)
from mechsearch_jax.benchmarks.lab.parts.exact_existence import exact_existence
from mechsearch_jax.benchmarks.lab.parts.segmentation import SegmentationBench, overlaps, true_masks
from mechsearch_jax.benchmarks.parts import simulation
from mechsearch_jax.envs.camera.simulated_camera import target_pixels
from mechsearch_jax.envs.world.world import TARGET, from_scenario, true_superquadrics
from mechsearch_jax.geometry.superquadric import Superquadrics, sample_surface
from mechsearch_jax.perception import scores
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.detector import FOUND_PIXELS
from mechsearch_jax.workspace.scenario import Body, Scenario, example_scenarios, load_scenario


def turned(box, cylinder, shift=0.0):
    """A box and a cylinder, turned about the vertical by angles [degrees], one of them shifted."""
    q = [(math.cos(math.radians(a) / 2), 0.0, 0.0, math.sin(math.radians(a) / 2)) for a in (box, cylinder)]
    bodies = (
        Body("box", (0.02, 0.03, 0.05), (0.6 + shift, 0.1, 0.45), q[0]),
        Body("cylinder", (0.03, 0.03, 0.05), (0.6, 0.25, 0.45), q[1]),
    )
    target = Body("cylinder", (0.02, 0.02, 0.05), (0.7, 0.0, 0.45), (1.0, 0.0, 0.0, 0.0))
    return jax.tree.map(lambda leaf: np.asarray(leaf)[None], from_scenario(Scenario("two", bodies, target)))


def test_a_cylinder_has_no_spin_but_a_box_has():
    distance, angle, spin = pose_differences(turned(0, 0), turned(2, 40, shift=0.003))
    assert distance == pytest.approx([0.003], abs=1e-6)
    assert angle == pytest.approx([2], abs=0.05)
    assert spin == pytest.approx([40], abs=0.05)


@pytest.mark.slow
def test_actions_that_are_drawn_agree():
    """Where the native simulator ends in the same place whatever the nudge, the batch simulator ends there too."""
    scene = load_scenario(example_scenarios()["first-light"])
    cases = draw_actions([scene], 8, seed=1)
    assert {int(action.kind) for _, action in cases} == {ActionKind.PUSH, ActionKind.PICK_AND_PLACE}
    result = agreement(cases, nudges=8)
    assert not any(case.overflow for case in result.cases)
    assert all(case.native_failure == case.batch_failure for case in result.cases)
    assert all(case.native_moved > 0.01 for case in result.cases)
    steady = [case for case in result.cases if case.native_agrees]
    assert len(steady) >= 5
    assert all(case.agrees for case in steady)
    with pytest.raises(InputError, match="take more scenes"):
        draw_actions([scene], 100, tries=2)


@pytest.mark.slow
def test_the_speed_of_the_batch_simulator_is_measured():
    timing = simulation.bench_simulate(2, 20, repeats=1, scenes=1)
    assert timing.rate == pytest.approx(40 / timing.median)
    assert timing.shapes["overflowed_worlds"] == timing.shapes["diverged_worlds"] == 0


SHAPES = {
    "box": ((0.03, 0.05, 0.08), (0.2, 0.2)),
    "cylinder": ((0.034, 0.034, 0.08), (0.2, 1.0)),
    "ellipsoid": ((0.03, 0.05, 0.08), (1.0, 1.0)),
}


def cloud(name, seed, partial=False, noise=0.0, outliers=0):
    """Points of a superquadric somewhere, and itself; a partial cloud has the points that face one viewpoint."""
    rng = np.random.default_rng(seed)
    size, exponents = SHAPES[name]
    local = np.array(sample_surface(jnp.array(size), jnp.array(exponents), 4000), float)
    rotation, position = Rotation.random(random_state=rng).as_matrix(), rng.uniform(-1, 1, 3)
    if partial:
        local = local[local @ np.array([0.6, 0.5, 0.45]) / np.linalg.norm(local, axis=1) > 0.25]
    local = local[rng.permutation(len(local))[:250]]
    points = local @ rotation.T + position + rng.normal(0, noise, local.shape)
    strays = position + rng.uniform(-0.15, 0.15, (outliers, 3))
    truth = Superquadrics(
        *(jnp.asarray(np.float32(a))[None] for a in (size, exponents, position, rotation)), valid=jnp.ones(1, bool)
    )
    return np.concatenate([points, strays]), truth


def iou(points, truth):
    scene = ems.recover_scene(points, np.zeros(len(points), int), 1)
    return float(scores.intersection_over_union(scene, truth)[0])


def test_jacobian_is_that_of_finite_differences():
    rng = np.random.default_rng(5)
    rotation = Rotation.random(random_state=rng).as_matrix()
    shape = ems.Recovered(np.array([0.6, 0.9, 1.2]), np.array([0.4, 0.8]), rng.normal(size=3), rotation, 0.0, 0)
    points = rng.normal(size=(40, 3)) + shape.position

    def moved(x):
        turned = rotation @ Rotation.from_rotvec(x[8:]).as_matrix()
        return ems.Recovered(
            shape.size * np.exp(x[:3]), shape.exponents + x[3:5], shape.position + x[5:8], turned, 0.0, 0
        )

    steps = 1e-5 * np.eye(11)
    expected = [(ems._radial(moved(s), points) - ems._radial(moved(-s), points)) / 2e-5 for s in steps]
    np.testing.assert_allclose(ems._radial_jacobian(shape, points), np.transpose(expected), atol=2e-4)


@pytest.mark.parametrize("name", SHAPES)
def test_outliers_and_noise_do_little_harm(name):
    assert iou(*cloud(name, 0, noise=0.001, outliers=30)) > 0.97


@pytest.mark.parametrize("name", SHAPES)
def test_clouds_seen_from_one_side_are_recovered(name):
    assert iou(*cloud(name, 0, partial=True)) > 0.97


def test_slots_without_points_are_absent():
    points, _ = cloud("cylinder", 1)
    labels = np.full(len(points), 2)
    labels[:5] = 0
    scene = ems.recover_scene(points, labels, 4)
    np.testing.assert_array_equal(scene.valid, [False, False, True, False])
    with pytest.raises(InputError, match="at least 11"):
        ems.recover(points[:5])


SCENE = images.scenes_of([load_scenario(example_scenarios()["first-light"])])[0]


def two_as_one(key, shelf, points, of_target, masks):
    """The first object taken for a part of the second."""
    return jnp.where(masks == 0, 1, masks)


@pytest.fixture(scope="module")
def perfect():
    return SegmentationBench([SCENE], ("clean",), labeller=true_masks).run()


@pytest.fixture(scope="module")
def wrong():
    return SegmentationBench([SCENE], ("clean", "gaussian"), labeller=two_as_one)


def test_the_true_masks_are_perfect(perfect):
    assert {row.iou for row in perfect.rows} == {1.0}
    assert {row.objects for row in perfect.rows} == {int(SCENE.world.valid[:TARGET].sum())}
    each, everything = perfect.summary()
    assert everything["objects"] is None
    assert each["iou_mean"] == everything["iou_mean"] == 1.0
    assert everything["missed"] == 0
    assert everything["counted"] <= everything["visible"] == len(perfect.rows)


def test_an_object_that_is_not_separated_counts_as_nothing(wrong):
    rows = {(row.noise, row.object): row for row in wrong.run().rows}
    for noise in ("clean", "gaussian"):
        assert rows[noise, 0].iou == 0.0
        assert 0.0 < rows[noise, 1].iou < 1.0
        assert all(row.iou == 1.0 for (sensor, i), row in rows.items() if sensor == noise and i > 1)


def test_overlaps_are_those_of_a_plain_count():
    rng = np.random.default_rng(0)
    segments, truth = rng.integers(-3, 6, (2, 20, 30))
    iou = overlaps(segments, truth)
    for i in range(TARGET):
        both, either = np.sum((segments == i) & (truth == i)), np.sum((segments == i) | (truth == i))
        assert iou[i] == pytest.approx(both / either) if (truth == i).any() else np.isnan(iou[i])


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
