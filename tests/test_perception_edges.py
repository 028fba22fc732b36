"""Edges of depth, colour and mask; surfaces: of a mask, of a cloud, and those on which nothing is recognised."""

import dataclasses
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import grey_dilation, minimum_filter

from mechsearch_jax.images.cloud import above_board, cloud_of, hanging, resample, shelf_view, surfaces, walled
from mechsearch_jax.images.examples import example_images
from mechsearch_jax.observation import Observation
from mechsearch_jax.perception.doubt import lost_faults
from mechsearch_jax.perception.edges import edge_faults, mask_faults, on_own_surfaces
from mechsearch_jax.workspace.camera import rays
from mechsearch_jax.workspace.scenario import example_scenarios, load_scenario, superquadrics
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

IMAGES, SHELF = example_images(), Shelf()
DEPTH, COLOUR, MASK = IMAGES.depth, IMAGES.colour, IMAGES.mask.astype(np.int32)


def fattened(pixels, shadow=0):
    """Nearer surfaces reach farther by so many pixels; left of them nothing is measured in a shadow so wide."""
    depth = minimum_filter(np.where(DEPTH > 0, DEPTH, np.inf), size=2 * pixels + 1)
    nearer = np.roll(depth, -shadow, axis=1) < depth - 0.04
    return np.where(np.isfinite(depth) & ~nearer, depth, 0.0).astype(np.float32)


@pytest.mark.parametrize("colour", [COLOUR, None, np.roll(COLOUR, 3, axis=1), np.full_like(COLOUR, 90)])
def test_of_a_clean_image_and_of_a_colour_image_beside_it_nothing_is_said(colour):
    assert edge_faults(IMAGES.camera, SHELF, DEPTH, colour) == ()


@pytest.mark.parametrize("shadow", [0, 12])
@pytest.mark.parametrize("pixels", [1, 2, 3])
def test_surfaces_that_reach_beyond_their_edges_are_said(pixels, shadow):
    for colour in (COLOUR, np.float32(COLOUR / 255)):
        (fault,) = edge_faults(IMAGES.camera, SHELF, fattened(pixels, shadow), colour)
        assert fault.startswith(f"depth image: its edges lie {pixels} pixels beyond those of the colour image")


@pytest.mark.parametrize(
    "mask", [None, MASK, np.roll(MASK, 1, axis=1), np.where(MASK == 2, 2, -1), np.full_like(MASK, -1)]
)
def test_of_a_mask_that_fits_nothing_is_said(mask):
    assert mask_faults(IMAGES.camera, SHELF, DEPTH, mask) == ()


@pytest.mark.parametrize(
    "mask",
    [
        np.roll(MASK, 8, axis=1),
        np.roll(MASK, -20, axis=1),
        np.roll(MASK, 8, axis=0),
        grey_dilation(np.maximum(MASK, -1), size=(13, 13)),
    ],
)
def test_a_mask_that_does_not_fit_is_said(mask):
    (fault,) = mask_faults(IMAGES.camera, SHELF, DEPTH, mask)
    assert fault.startswith("mask: does not fit the depth image: at ")


def plane(*pieces):
    """Points of an image of 24 x 40 pixels at 1 m, with rectangles (rows, columns) at other depths, 2 mm apart."""
    depth = np.ones((24, 40), np.float32)
    for rows, columns, z in pieces:
        depth[rows, columns] = z
    v, u = np.meshgrid(np.arange(24) * 0.002, np.arange(40) * 0.002, indexing="ij")
    return jnp.asarray(np.stack([depth, u, v], axis=-1), jnp.float32)


ALL = slice(None)


def labels(*pieces):
    image = np.full((24, 40), -1, np.int8)
    for rows, columns, label in pieces:
        image[rows, columns] = label
    return image


# Behind, from columns 0 to 20 another thing at 0.9 m.
NEARER = plane((ALL, slice(0, 20), 0.9))
BAR = plane((ALL, slice(10, 20), 0.9))
MASKS = {
    "true": (NEARER, labels((ALL, slice(0, 20), 0), (ALL, slice(20, 40), 1)), None),
    "shifted": (
        NEARER,
        labels((ALL, slice(0, 24), 0), (ALL, slice(24, 40), 1)),
        labels((ALL, slice(0, 20), 0), (ALL, slice(24, 40), 1)),
    ),
    "two that touch": (plane(), labels((ALL, slice(0, 30), 0), (ALL, slice(30, 40), 1)), None),
    "one that another divides": (BAR, labels((ALL, ALL, 0), (ALL, slice(10, 20), 1)), None),
    "beside a step as on a slope": (
        plane(*((ALL, slice(i, 40), 1.0 + 0.012 * (i - 20)) for i in range(20, 40))),
        labels((ALL, ALL, 4)),
        None,
    ),
}


@pytest.mark.parametrize("name", list(MASKS))
def test_a_masks_pixels_on_another_surface_are_left_out(name):
    points, mask, expected = MASKS[name]
    cleaned = on_own_surfaces(points, jnp.asarray(mask), jnp.ones(mask.shape, bool))
    np.testing.assert_array_equal(cleaned, mask if expected is None else expected)


def test_what_does_not_stand_on_the_shelf_keeps_its_label():
    points, mask, _ = MASKS["shifted"]
    assert np.array_equal(on_own_surfaces(points, jnp.asarray(mask), jnp.zeros(mask.shape, bool)), mask)


def test_small_surfaces_are_not_left_out_of_a_cloud():
    points = np.random.default_rng(0).normal(size=(100, 100, 3)).astype(np.float32)
    surface = np.zeros((100, 100), np.int32)
    surface[:4, :10], surface[50, 50] = 1, 2
    cloud, number = cloud_of(jnp.asarray(points)), jnp.asarray(surface.reshape(-1))
    for seed in range(3):
        drawn = resample(jax.random.key(seed), cloud, 512, number)
        assert bool(drawn.valid.all())
        assert 20 <= np.sum(surface.reshape(-1)[np.asarray(drawn.pixel)] == 1) <= 26
    # Where all are large, the points are those of a draw without surfaces.
    large = jnp.asarray((np.arange(10_000) >= 5_000).astype(np.int32))
    key = jax.random.key(0)
    assert np.array_equal(resample(key, cloud, 512, large).pixel, resample(key, cloud, 512).pixel)
    empty = cloud.replace(valid=jnp.zeros(10_000, bool))
    assert not resample(key, empty, 512, number).valid.any()


SCENE = load_scenario(example_scenarios()["first-light"])
SETTING = types.SimpleNamespace(camera=IMAGES.camera, shelf=SHELF, target=Target.cylinder())


@pytest.mark.parametrize("missed", [None, *range(len(SCENE.objects))])
def test_a_surface_on_which_nothing_is_recognised_is_said(missed):
    objects = superquadrics(SCENE.objects)
    if missed is not None:
        objects = objects.replace(valid=objects.valid.at[missed].set(False))
    faults = lost_faults(SETTING, Observation(objects, jnp.array(False), jnp.zeros(3)), DEPTH)
    assert len(faults) == (missed is not None)
    assert all(fault.startswith("recognition: what shows ") for fault in faults)


@pytest.mark.parametrize(("low", "hangs"), [(SHELF.ceiling - 0.04, True), (SHELF.board + 0.01, False)])
def test_what_hangs_in_the_opening_is_no_object_and_is_said(low, hangs):
    """A plate across the opening, down from the upper board: a lip, or something that stands on the board."""
    view = shelf_view(IMAGES.camera, SHELF, 4)
    directions, eye = np.asarray(rays(view.camera), float), np.array(IMAGES.camera.position)
    length = (SHELF.front + 0.01 - eye[0]) / directions[..., 0]
    plate = eye + length[..., None] * directions
    within = (plate[..., 2] > low) & (plate[..., 2] < SHELF.ceiling) & (np.abs(plate[..., 1] - 0.1) < 0.1)
    points = jnp.asarray(np.where(within[..., None], plate, np.nan), jnp.float32)
    standing = above_board(SHELF, points)
    left_out = np.asarray(hanging(SHELF, points, standing, surfaces(points, standing)))
    assert np.array_equal(left_out, np.asarray(standing) & hangs)
    # A shelf without an upper board has nothing that could hang from it.
    table = dataclasses.replace(SHELF, faces=("back", "right", "left"))
    assert not np.asarray(hanging(table, points, standing, surfaces(points, standing))).any()


@pytest.mark.parametrize(
    ("off", "noise", "moved"),
    [(0.0, 0.0007, 0.0), (0.0, 0.003, 0.0035), (0.002, 0.003, 0.0055), (-0.006, 0.001, 0.0), (0.04, 0.001, 0.0)],
)
def test_a_wall_ends_where_its_own_points_do(off, noise, moved):
    """The left wall is measured farther in than it is said to be, with noise; a thing stands 2 cm before it."""
    rng, count = np.random.default_rng(0), 4000
    wall = rng.uniform((SHELF.front, 0, SHELF.board), (SHELF.back, 0, SHELF.ceiling), (count, 3))
    wall[:, 1] = SHELF.left - off + noise * rng.normal(size=count)
    thing = rng.uniform((0.5, SHELF.left - 0.1, 0.45), (0.5, SHELF.left - 0.02, 0.6), (count, 3))
    points = jnp.asarray(np.concatenate([wall, thing, np.full((100, 3), np.nan)]), jnp.float32)
    seen = walled(SHELF, points)
    # The margin of 4 mm is enough for a wall with little noise.
    np.testing.assert_allclose(SHELF.left - float(seen.left), moved, atol=0.0015)
    assert (float(seen.back), float(seen.right)) == pytest.approx((SHELF.back, SHELF.right))
    assert int(above_board(seen, points)[count:].sum()) == count
    if off < 0.01:
        assert int(above_board(seen, points)[:count].sum()) < 0.03 * count
