"""Holes of the simulated depth camera: what is not measured, and what recognisers make of the rest."""

from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage
from stage import HIDDEN, OPEN, TWO, grab

from mechsearch_jax.envs.camera.holes import BASELINE, HOLES, JUMP, NARROWEST, WIDEST, DrawnHoles, Holes, shadows
from mechsearch_jax.envs.camera.recognisers import recogniser
from mechsearch_jax.envs.camera.sensing import sensed_depth, sensing_of
from mechsearch_jax.envs.camera.simulated_camera import BACKGROUND, observe
from mechsearch_jax.envs.camera.snapshot import Snapshot, informed, oracle
from mechsearch_jax.envs.episode.closed_loop import Listeners, RunSettings, Start
from mechsearch_jax.envs.episode.episodes import run_episode, run_episodes, target_of
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.envs.simulators.native import NativeSimulator
from mechsearch_jax.envs.world.mismatch import ASSUMED, HolesName, Mismatch
from mechsearch_jax.envs.world.world import TARGET, from_scenario
from mechsearch_jax.images.cloud import thinned_view
from mechsearch_jax.perception.recogniser import labelled
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace import scenario
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf

CAMERA, SHELF = Camera(), Shelf()
SMALL = CAMERA.scaled(4)
SCENE = scenario.load_scenario(scenario.example_scenarios()["first-light"])
NAMES = [name for name in HOLES if name != "none"]


def drawn(holes, seed=0):
    return DrawnHoles(np.uint32(seed), HOLES[holes] if isinstance(holes, str) else holes)


def sensed(name, scene=SCENE, seed=0):
    mismatch = Mismatch(holes=name)
    return sensing_of(mismatch, mismatch.drawn(scene, seed, CAMERA, SHELF))


@pytest.fixture(scope="module")
def world():
    return from_scenario(SCENE)


@pytest.fixture(scope="module")
def image(world):
    return observe(SMALL, world, SHELF)


def test_every_name_has_holes_and_none_is_as_before(world, image):
    assert tuple(HOLES) == get_args(HolesName)
    assert sensed("none") is None
    assert sensed_depth(SMALL, world, image, None) is image.depth
    assert ASSUMED.compile_key() == Mismatch(holes="none").compile_key() != Mismatch(holes="patches").compile_key()
    assert Mismatch(holes="shadows").compile_key() == Mismatch(holes="patches").compile_key()
    assert "mismatch.holes" not in Method().options()
    method = Method(mismatch=Mismatch(holes="shadows"))
    assert method.options()["mismatch.holes"] == "shadows"
    assert Method.of_options(method.options()) == method
    with pytest.raises(InputError, match='holes "some" is unknown; use none, objects'):
        Mismatch(holes="some")


@pytest.fixture(scope="module")
def compiled(world, image):
    """Which pixels are lost; compiled once, whatever the holes are."""
    return jax.jit(lambda holes: holes.of(SMALL, world, image))


@pytest.fixture(scope="module")
def batched(world, image):
    """The same of a batch."""
    return jax.jit(jax.vmap(lambda holes: holes.of(SMALL, world, image)))


@pytest.mark.parametrize("name", NAMES)
def test_eager_jitted_and_in_a_batch_the_same_pixels_are_lost(world, image, compiled, batched, name):
    drawn = [sensed(name, seed=seed).holes for seed in (0, 1)]
    many = batched(jax.tree.map(lambda *each: np.stack(each), *drawn))
    for holes, one in zip(drawn, many, strict=True):
        # Rounding decides at the edge of a blob.
        assert np.mean(np.asarray(compiled(holes)) != np.asarray(one)) < 1e-4
    if name == "patches":
        assert np.mean(np.asarray(drawn[0].of(SMALL, world, image)) != np.asarray(many[0])) < 1e-4
    assert compiled._cache_size() == batched._cache_size() == 1
    # Its target is hidden.
    assert np.asarray(many).any() == (name != "target")


@pytest.mark.parametrize(("holes", "least"), [(Holes(patches=0.1), 60), (Holes(patches=0.3), 100)])
def test_patches_are_connected_and_take_their_share_of_the_shelf(image, compiled, holes, least):
    lost = np.asarray(compiled(drawn(holes)))
    shelf = np.asarray(image.segmentation) != BACKGROUND
    assert not (lost & ~shelf).any()
    assert lost[shelf].mean() == pytest.approx(holes.patches, abs=0.001)
    numbers, count = ndimage.label(lost)
    sizes = np.bincount(numbers[lost])[1:]
    assert 3 < count < 60
    assert sizes[sizes >= least].sum() > 0.9 * lost.sum()


@pytest.mark.parametrize("factor", [1, 2])
@pytest.mark.parametrize(
    ("near", "width"), [(0.6, WIDEST), (0.8, BASELINE * CAMERA.fx * 0.25), (0.94, NARROWEST), (1.0 - JUMP / 2, 0)]
)
def test_shadows_lie_on_the_left_and_are_as_wide_as_the_depth_differs(factor, near, width):
    camera, left, right = CAMERA.scaled(factor), 60, 90
    depth = jnp.ones((2, 120)).at[0, left:right].set(near)
    lost = np.asarray(shadows(camera, depth))
    assert np.flatnonzero(lost[0]).tolist() == list(range(left - int(np.ceil(width / factor)), left))
    assert not lost[1].any()


def test_an_object_without_depth_has_none_at_every_look(world, image, compiled):
    moved = world.replace(position=world.position + jnp.array([[0.01, 0.02, 0.0]]))
    counts = []
    for seed in range(40):
        holes = drawn("objects", seed)
        blank = np.asarray(holes.without_depth(world))
        np.testing.assert_array_equal(blank, holes.without_depth(moved))
        counts.append(blank.sum())
        assert not blank[TARGET]
        assert not (blank & ~np.asarray(world.valid)).any()
    there = int(np.asarray(world.valid)[:TARGET].sum())
    assert min(counts) == 1
    assert 0.2 * there < np.mean(counts) < 0.45 * there
    owner = np.asarray(image.segmentation)
    np.testing.assert_array_equal(compiled(holes), np.isin(owner, np.flatnonzero(blank)))


@pytest.mark.parametrize("recognise", [oracle, informed])
def test_true_shapes_without_depth_are_left_out(recognise):
    world = from_scenario(TWO)

    def seen(name):
        return recognise(jax.random.key(0), Snapshot(CAMERA, SHELF, world, sensing=sensed(name, TWO)))

    assert np.asarray(seen("none").objects.valid).sum() == 2
    left = np.asarray(seen("objects").objects.valid)
    np.testing.assert_array_equal(left[:2], ~np.asarray(sensed("objects", TWO).holes.without_depth(world))[:2])
    assert np.asarray(seen("shadows").objects.valid).sum() == 2


@pytest.mark.parametrize(
    ("name", "visible"), [("none", True), ("shadows", True), ("scattered", True), ("target", False)]
)
def test_a_target_without_depth_is_not_seen(name, visible):
    snapshot = Snapshot(CAMERA, SHELF, from_scenario(OPEN), sensing=sensed(name, OPEN))
    assert bool(oracle(jax.random.key(0), snapshot).target_visible) is visible
    assert bool(informed(jax.random.key(0), snapshot).target_visible)


def test_masks_have_no_points_in_holes():
    masks, view, world = recogniser("masks", target_of(OPEN)), thinned_view(CAMERA, SHELF), from_scenario(OPEN)
    images = masks.images(jax.random.key(0), Snapshot(CAMERA, SHELF, world, sensing=sensed("target", OPEN)))
    image, visible = labelled(masks.core, jax.random.key(0), CAMERA, view, SHELF, images)
    there = np.asarray(observe(view.camera, world, SHELF).segmentation) == TARGET
    assert there.sum() > 100
    assert np.isnan(np.asarray(image.points)[there]).all()
    assert np.isnan(np.asarray(image.depth)[there]).all()
    assert np.isfinite(np.asarray(image.points)[~there]).any()
    assert not np.asarray(image.of_target).any()
    assert not visible


@pytest.mark.slow
@pytest.mark.parametrize("name", ["objects", "patches"])
def test_episodes_with_holes_are_the_same_alone_and_in_a_batch(problem, name):
    starts = [Start(scene, seed, mismatch=Mismatch(holes=name)) for scene, seed in ((HIDDEN, 0), (TWO, 1), (OPEN, 2))]
    settings, episodes = RunSettings(max_steps=2, at_once=2), []
    run_episodes(starts, problem, grab, NativeSimulator(threads=1), 2, Listeners(episodes.extend), settings)
    for place, episode in episodes:
        again = run_episode(starts[place], problem, grab, NativeSimulator(), settings)
        what = [
            [(s.belief_size, s.found, s.truth_possible, s.around_possible) for s in e.steps] for e in (episode, again)
        ]
        assert what[0] == what[1]
