"""Scenes of tables and other shelves against float64 geometry: stacks, vessels, cameras and what networks are given."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax.envs.world.world import TARGET
from mechsearch_jax.images.cloud import shelf_view
from mechsearch_jax.images.noise import no_noise
from mechsearch_jax.shapes.primitives import BOX, CYLINDER
from mechsearch_jax.train import scenes
from mechsearch_jax.train.recognition import RecognitionTask
from mechsearch_jax.train.vessels import Form, cut_round
from mechsearch_jax.workspace.shelf import Shelf

SHELF, VIEW, COUNT = Shelf(), shelf_view(stride=4), 32
REAL = dataclasses.replace(scenes.SceneConfig.real(), noises=(no_noise,), stacked=0.6, leaning=0.15, target=0.5)
# Where bodies of the default distribution stand, for one key [m].
GOLDEN = (
    (0.69683385, 0.06058975, 0.47150001),
    (0.65015632, 0.37222546, 0.44296876),
    (0.56472141, 0.14418265, 0.43300027),
)
RECOGNITION = RecognitionTask(scenes=REAL, view=VIEW, ragged=0.0, misjudged=0.0)


def plain(scene):
    """What the tests read of scenes; not the camera itself, which checks the numbers of NumPy."""
    space = jnp.stack([jnp.float32(getattr(scene.shelf, name)) for name in ("front", "board", "ceiling")])
    is_usual = jnp.float32(scene.camera.fx) == VIEW.camera.fx
    place, turn = jnp.array(scene.camera.position), jnp.array(scene.camera.rotation)
    return (scene.world, scene.forms, scene.support, space, is_usual, place, turn, scene.around.front)


@functools.cache
def drawn():
    """Scenes, what a perfect sensor sees of them, and the segments for the recognition network."""

    @jax.jit
    def make(key):
        # As the task draws them.
        drawing, sensing = jax.random.split(key, 6)[:2]
        scene, _ = scenes.taken(sensing, scenes.random_scene(drawing, REAL, SHELF, VIEW), REAL)
        _, seen, examples = RECOGNITION.scene(key)
        return plain(scene), seen, examples.segments.T_world_segment, examples.weight

    return jax.tree.map(np.asarray, jax.vmap(make)(jax.random.split(jax.random.key(0), COUNT)))


def inside(world, forms, scene, slot, points):
    """How deep points are in a body [m], in float64: at most 0 outside, also of a vessel's hollow."""
    local = (points - world.position[scene, slot].astype(float)) @ world.rotation[scene, slot].astype(float)
    half = world.half_size[scene, slot].astype(float)
    if world.kind[scene, slot] == BOX:
        return np.min(half - np.abs(local), axis=-1)
    form = jax.tree.map(lambda a: float(a[scene, slot]), forms)
    return depth_of_round(local, half, form)


def depth_of_round(local, half, form):
    """How deep points are in a solid of revolution, by its profile; level distances, which are the larger."""
    radius, height = np.hypot(local[..., 0], local[..., 1]), local[..., 2]
    wide = half[0] * (form.lower + (form.upper - form.lower) * (height / half[2] + 1) / 2)
    outer = np.minimum(wide - radius, half[2] - np.abs(height))
    if form.wall == 0:
        return outer
    cavity = np.minimum(wide - form.wall - radius, height - (form.wall - half[2]))
    return np.minimum(outer, -cavity)


@pytest.mark.parametrize(
    "form", [(1.0, 1.0, 0.0), (0.6, 1.0, 0.0), (1.0, 0.7, 0.0), (0.6, 1.0, 0.004), (1.0, 1.0, 0.01)]
)
@pytest.mark.parametrize("eye", [(0.3, 0.05, 0.35), (-0.5, 0.1, 0.0), (0.02, 0.01, 0.4), (0.2, 0.2, -0.3)])
def test_rays_meet_round_bodies_where_marching_along_them_does(form, eye):
    half = np.array([0.08, 0.08, 0.05])
    form = Form(*(jnp.float32(value) for value in form))
    aim = np.stack(np.meshgrid([0.0], np.linspace(-0.1, 0.1, 17), np.linspace(-0.09, 0.09, 13)), axis=-1).reshape(-1, 3)
    towards = aim - np.array(eye)
    found = jax.jit(cut_round)(
        [jnp.float32(e) for e in eye],
        [jnp.asarray(d, jnp.float32) for d in towards.T],
        jnp.asarray(half, jnp.float32),
        form,
    )
    steps = np.linspace(0.5, 1.7, 6001)
    exact = jax.tree.map(float, form)
    deep = depth_of_round(np.array(eye) + steps[None, :, None] * towards[:, None], half, exact) > 0
    hit, first = deep.any(axis=1), steps[deep.argmax(axis=1)]
    found = np.asarray(found, float)
    # Rays that only graze an edge may fall between two steps.
    assert np.mean(np.isfinite(found) == hit) > 0.985
    both = np.isfinite(found) & hit
    late = (first - found)[both]
    assert both.sum() > 20
    assert np.mean((late > -1e-4) & (late < 3e-4)) > 0.985
    surface = np.array(eye) + found[both][:, None] * towards[both]
    assert np.abs(depth_of_round(surface, half, exact)).max() < 2e-5


def tops(world, forms, scene):
    """Heights of the tops that can carry something [m], by slot."""
    flat = np.abs(world.rotation[scene, :, 2]).max(axis=1) > 0.999
    flat &= (world.kind[scene] == BOX) | (world.rotation[scene, :, 2, 2] > 0.999)
    reach = np.einsum("si,si->s", np.abs(world.rotation[scene, :, 2]), world.half_size[scene])
    able = world.valid[scene] & flat & (forms.wall[scene] == 0) & (np.arange(len(flat)) != TARGET)
    return np.where(able, world.position[scene, :, 2] + reach, np.nan)


@pytest.mark.slow
def test_stacked_bodies_stand_on_a_top_beneath_their_middle():
    (world, forms, support, space, *_), *_ = drawn()
    raised = levels = 0
    for scene in range(COUNT):
        high = tops(world, forms, scene)
        for slot in np.flatnonzero(world.valid[scene]):
            turn, half = world.rotation[scene, slot].astype(float), world.half_size[scene, slot].astype(float)
            reach = np.abs(turn[2]) @ half
            if world.kind[scene, slot] == CYLINDER:
                reach = abs(turn[2, 2]) * half[2] + np.sqrt(max(1 - turn[2, 2] ** 2, 0)) * half[0]
            assert world.position[scene, slot, 2] - reach == pytest.approx(support[scene, slot], abs=1e-5)
            assert world.position[scene, slot, 2] + reach < space[scene, 2] + 4.0
            if support[scene, slot] < space[scene, 1] + 1e-6:
                continue
            raised += 1
            below = np.flatnonzero(np.abs(high - support[scene, slot]) < 1e-5)
            foot = np.append(world.position[scene, slot, :2], support[scene, slot] - 1e-3).astype(float)
            under = [k for k in below if inside(world, forms, scene, k, foot) > 0]
            assert under, (scene, slot)
            levels += any(support[scene, k] > space[scene, 1] + 1e-6 for k in under)
    assert raised >= 30
    assert levels >= 3


def test_no_body_is_in_another():
    (world, forms, *_), *_ = drawn()
    draw = jax.jit(jax.vmap(functools.partial(scenes.surface_points, count=400)))
    for scene in range(COUNT):
        slots = np.flatnonzero(world.valid[scene])
        keys = jax.random.split(jax.random.key(scene), len(world.valid[scene]))
        local = np.asarray(draw(keys, jnp.asarray(world.kind[scene]), jnp.asarray(world.half_size[scene])), float)
        for a in slots:
            points = local[a] @ world.rotation[scene, a].T.astype(float) + world.position[scene, a]
            for b in slots[slots != a]:
                # Also not in what fills a vessel up.
                filled = jax.tree.map(lambda leaf: np.full_like(leaf, leaf is not forms.wall), forms)
                assert inside(world, filled, scene, b, points).max() < 1e-3, (scene, a, b)


@pytest.mark.slow
def test_the_default_distribution_stays_and_a_key_gives_one_scene():
    make = jax.jit(lambda key: scenes.random_world(key))
    world = make(jax.random.key(7))
    assert world.valid.shape == (9,)
    assert np.allclose(world.position[:3], GOLDEN, atol=1e-5)
    both = jax.jit(jax.vmap(lambda key: plain(scenes.random_scene(key, REAL, SHELF, VIEW))))(
        jax.random.wrap_key_data(jnp.array([[0, 1], [0, 1], [0, 2]], jnp.uint32))
    )
    for leaf in jax.tree.leaves(both):
        assert np.array_equal(leaf[0], leaf[1])
    assert not np.array_equal(both[0].position[0], both[0].position[2])
