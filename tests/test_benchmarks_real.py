"""`bench real`: figures that are known by construction, on scenes of the simulated camera in both kinds of files."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from test_mutated_files import program

from mechsearch_jax.benchmarks.real import figures, looks, scenes, scores
from mechsearch_jax.envs.camera.simulated_camera import observe
from mechsearch_jax.envs.world.world import BODIES, World, true_superquadrics
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.observation import Observation
from mechsearch_jax.perception.scores import sharpened
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.shapes import shape_of
from mechsearch_jax.workspace.camera import Camera, rays
from mechsearch_jax.workspace.shelf import Shelf

SHELF = Shelf(front=0.3, back=1.3, right=-0.6, left=0.9, ceiling=1.5)
# It looks down at the board by 38 degrees.
S, C = np.sin(np.radians(38.0)), np.cos(np.radians(38.0))
DOWN = tuple(map(tuple, np.array([[0.0, -S, C], [-1.0, 0.0, 0.0], [0.0, -C, -S]]).tolist()))
CAMERA = Camera(320, 240, 260.0, 260.0, 160.0, 120.0, DOWN, (-0.1, 0.1, 1.05))
# What is measured of the walls is not in it.
INSIDE = Shelf(front=0.3, back=1.2, right=-0.5, left=0.8, ceiling=1.4)
# Half-extents, and place from the board: a low box with a smaller one on it, a wide box, and a cylinder.
LOW, UPPER, WIDE, ROUND = range(4)
THINGS = (
    ("box", (0.06, 0.07, 0.03), (0.6, 0.25, 0.03)),
    ("box", (0.03, 0.04, 0.04), (0.58, 0.25, 0.10)),
    ("box", (0.03, 0.08, 0.06), (0.6, 0.0, 0.06)),
    ("cylinder", (0.04, 0.04, 0.05), (0.62, -0.17, 0.05)),
)


def column(rows, rest):
    return jnp.array([*rows, *[rest] * (BODIES + 1 - len(rows))])


WORLD = World(
    kind=column([shape_of(shape).code for shape, _, _ in THINGS], 0).astype(jnp.int32),
    half_size=column([size for _, size, _ in THINGS], (1e-3,) * 3),
    position=column([(x, y, z + SHELF.board) for _, _, (x, y, z) in THINGS], (0.0,) * 3),
    rotation=jnp.broadcast_to(jnp.eye(3), (BODIES + 1, 3, 3)),
    valid=jnp.arange(BODIES + 1) < len(THINGS),
)


@pytest.fixture(scope="module")
def image():
    return jax.tree.map(np.asarray, observe(CAMERA, WORLD, SHELF))


@pytest.fixture(scope="module")
def folder(image, tmp_path_factory):
    """The scene in a file of arrays, and as a BOP scene whose world begins on the board."""
    folder = tmp_path_factory.mktemp("scenes")
    depth = np.where(np.isfinite(image.depth), image.depth, 0.0)
    things = np.where((image.segmentation >= 0) & (image.segmentation < BODIES), image.segmentation, 255)
    colour = Image.fromarray(np.round(255 * np.clip(image.colour, 0, 1)).astype(np.uint8))
    c, T = CAMERA, np.eye(4)
    T[:3, :3], T[:3, 3] = c.rotation, c.position
    K = [c.fx, 0.0, c.cx - 0.5, 0.0, c.fy, c.cy - 0.5, 0.0, 0.0, 1.0]
    camera = {"width": c.width, "height": c.height, "K": K, "T_world_camera": T.tolist()}
    (folder / "arrays").mkdir()
    stored = {"depth": np.round(1e4 * depth).astype(np.uint16), "mask": things.astype(np.uint8)}
    np.savez(folder / "arrays/table3.npz", camera=json.dumps(camera), notes='{"category": "stacked"}', **stored)
    colour.save(folder / "arrays/table3.jpg", quality=95)
    for name in ("depth", "rgb", "mask_visib"):
        (folder / "bop/000001" / name).mkdir(parents=True)
    R, t = T[:3, :3].T, -T[:3, :3].T @ (1000 * (T[:3, 3] - [0, 0, SHELF.board]))
    entry = {"cam_K": K, "depth_scale": 0.1, "cam_R_w2c": R.ravel().tolist(), "cam_t_w2c": t.tolist()}
    (folder / "bop/000001/scene_camera.json").write_text(json.dumps({"7": entry}))
    Image.fromarray(stored["depth"]).save(folder / "bop/000001/depth/000007.png")
    colour.save(folder / "bop/000001/rgb/000007.png")
    for i in range(len(THINGS)):
        mask = np.uint8(255) * (things == i)
        Image.fromarray(mask.astype(np.uint8)).save(folder / f"bop/000001/mask_visib/000007_{i:06d}.png")
    return folder


def truth(**changes):
    """The true bodies, with the leaves of some slots changed: field=({slot: value})."""
    bodies = sharpened(true_superquadrics(WORLD))
    for field, rows in changes.items():
        for slot, value in rows.items():
            bodies = bodies.replace(**{field: getattr(bodies, field).at[slot].set(jnp.asarray(value))})
    return bodies


def seen(bodies):
    return Observation(bodies, jnp.array(False), jnp.zeros(3), 0.95 * bodies.valid.astype(jnp.float32))


def box(size, place):
    x, y, z = place
    return {"size": size, "exponents": (0.01, 0.01), "position": (x, y, z + SHELF.board), "valid": True}


def with_boxes(boxes):
    """The true bodies with boxes in some slots; None takes one away."""
    rows = {slot: each or {"valid": False} for slot, each in boxes.items()}
    return truth(
        **{key: {slot: row[key] for slot, row in rows.items() if key in row} for key in box((0,) * 3, (0,) * 3)}
    )


def looked_at(folder, bodies, own=None):
    scene = scenes.find_scenes(folder / "arrays")["table3"]()
    of = scores.scored(scene, CAMERA, INSIDE, seen(bodies), own)
    return figures.Look("table3", "stacked", "depth and colour", 4, *of, 0.1, 1.0, None, [])


def values(look):
    of = figures.figures([look])["depth and colour"]["all"]
    return {name: value.value for name, value in of.items() if value.values}


@pytest.mark.parametrize("own", [None, {i: i for i in range(4)}])
def test_true_bodies_are_perfect(folder, own):
    look = looked_at(folder, truth(), own)
    assert len(look.things) == 4
    assert [thing.body for thing in look.things] == [LOW, UPPER, WIDE, ROUND]
    assert min(thing.iou for thing in look.things) > 0.95
    assert max(thing.p90 for thing in look.things) < 0.001
    assert max(abs(thing.tilt) for thing in look.things) < 0.1
    assert min(thing.on_upright for thing in look.things if thing.number != UPPER) > 0.97
    measured = values(look)
    perfect = ("matched", "matched well", "upright", "stand", "stand raised", "sure and right")
    assert {name: measured[name] for name in perfect} == dict.fromkeys(perfect, 1.0)
    none = ("split", "merging", "phantoms", "pulled down", "stopped, right")
    assert {name: measured[name] for name in none} == dict.fromkeys(none, 0.0)
    assert measured["rays through, %"] < 0.5
    assert look.right


def test_a_body_that_reaches_below_what_it_stands_on_is_pulled_down(folder):
    look = looked_at(folder, with_boxes({UPPER: box((0.03, 0.04, 0.065), (0.58, 0.25, 0.075))}))
    assert look.things[UPPER].bottom == pytest.approx(0.01, abs=1e-4)
    assert look.things[UPPER].low == pytest.approx(0.06, abs=5e-3)
    measured = values(look)
    assert (measured["matched well"], measured["pulled down"], measured["stand raised"]) == (1.0, 1.0, 0.0)
    assert measured["stand"] == 1.0
    # A box before it would hide its foot.
    scene = scenes.find_scenes(folder / "arrays")["table3"]()
    rows, columns = np.nonzero(scene.mask == UPPER)
    depth = scene.depth.copy()
    depth[rows.max() - 3 : rows.max() + 9, columns.min() : columns.max() + 1] -= 0.1
    depth = np.where(scene.mask == UPPER, scene.depth, depth)
    assert scores.foot_in_sight(scene.mask == UPPER, scene.depth)
    assert not scores.foot_in_sight(scene.mask == UPPER, depth)


def test_split_merged_and_imagined_bodies_are_told_apart(folder):
    third = [box((0.03, 0.08 / 3, 0.06), (0.6, y, 0.06)) for y in (-0.16 / 3, 0.0, 0.16 / 3)]
    split = looked_at(folder, with_boxes(dict(zip((WIDE, 5, 6), third, strict=True))))
    assert [thing.split for thing in split.things] == [False, False, True, False]
    assert split.things[WIDE].iou < 0.5
    assert values(split)["matched"] == 0.75
    assert values(split)["sure and right"] == pytest.approx(3 / 6)
    assert not any(body.phantom or body.merges for body in split.bodies)
    merged = looked_at(folder, with_boxes({WIDE: box((0.04, 0.17, 0.06), (0.61, -0.06, 0.06)), ROUND: None}))
    assert {body.slot for body in merged.bodies if body.merges} == {WIDE}
    assert values(merged)["merging"] == 1.0
    imagined = looked_at(folder, with_boxes({5: box((0.03, 0.03, 0.03), (0.45, 0.4, 0.15))}))
    assert [body.slot for body in imagined.bodies if body.phantom] == [5]
    assert (values(imagined)["phantoms"], values(imagined)["matched"], values(imagined)["stopped, wrong"]) == (1, 1, 0)


def test_rays_pass_through_what_is_too_tall_and_axes_tilt(folder, image):
    taller = looked_at(folder, with_boxes({WIDE: box((0.03, 0.08, 0.09), (0.6, 0.0, 0.09))})).things[WIDE]
    # By the slabs of the taller box: rays that enter it more than a centimetre before they end.
    origin, way = np.array(CAMERA.position), np.asarray(rays(CAMERA), float)
    points = origin + image.depth[..., None] * way
    ends = ((points > (0.3, -0.5, 0.0)) & (points < (1.2, 0.8, 1.4))).all(axis=-1)
    half = np.array([0.03, 0.08, 0.09])
    sides = [((0.6, 0.0, SHELF.board + 0.09) + sign * half - origin) / way for sign in (-1, 1)]
    enter = np.minimum(*sides).max(axis=-1)
    hit = ends & (enter < np.maximum(*sides).min(axis=-1))
    passed = (image.depth - enter) * np.linalg.norm(way, axis=-1) > 0.01
    assert taller.passed == pytest.approx((hit & passed).sum() / hit.sum(), abs=0.01)
    assert taller.passed > 0.1
    c, s = np.cos(0.2), np.sin(0.2)
    leaning = jnp.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    for slot in (WIDE, ROUND):
        thing = looked_at(folder, truth(rotation={slot: leaning})).things[slot]
        assert thing.tilt == pytest.approx(np.degrees(0.2), abs=0.01)
    assert thing.bottom == pytest.approx(0.05 - 0.05 * c - 0.04 * s, abs=1e-3)


def test_distances_are_those_of_boxes_and_cylinders():
    random = np.random.default_rng(0)
    points = random.uniform(-0.15, 0.15, (4000, 3))
    size = np.array([0.05, 0.08, 0.1])
    past = np.abs(points) - size
    of_box = np.abs(np.linalg.norm(np.maximum(past, 0), axis=1) + np.minimum(past.max(axis=1), 0))
    past = np.stack([np.hypot(points[:, 0], points[:, 1]) - 0.06, np.abs(points[:, 2]) - 0.1], axis=1)
    of_cylinder = np.abs(np.linalg.norm(np.maximum(past, 0), axis=1) + np.minimum(past.max(axis=1), 0))
    turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    for half, e2, expected in ((size, 0.01, of_box), ((0.06, 0.06, 0.1), 1.0, of_cylinder)):
        leaves = (np.array([half]), np.array([[0.01, e2]]), np.array([[0.5, 0.1, 0.6]]), turn[None])
        body = Superquadrics(*(jnp.asarray(leaf, jnp.float32) for leaf in leaves), jnp.array([True]))
        found = scores.distances(body, points @ turn.T + [0.5, 0.1, 0.6])
        np.testing.assert_allclose(found, expected, atol=2.5e-3)
        assert np.median(np.abs(found - expected)) < 1e-4


def test_both_kinds_of_files_hold_the_same_scene(folder, image):
    found = scenes.find_scenes(folder)
    assert list(found) == ["arrays/table3", "bop/000001/000007"]
    one, other = (read() for read in found.values())
    assert (one.category, other.category) == ("stacked", "000001")
    np.testing.assert_allclose(one.depth, other.depth, atol=1e-6)
    np.testing.assert_allclose(one.depth, np.where(np.isfinite(image.depth), image.depth, 0), atol=6e-5)
    np.testing.assert_array_equal(one.mask, other.mask)
    assert np.abs(one.colour.astype(int) - other.colour).mean() < 3
    places = []
    for scene in (one, other):
        camera, table = scene.workspace(None)
        assert table.board == scene.board
        places.append([*camera.position[:2], camera.position[2] - table.board, table.front, table.back, table.left])
    np.testing.assert_allclose(*places, atol=1e-9)
    # A camera that looks along -y is turned with its world.
    turned = dataclasses.replace(CAMERA, rotation=((-1.0, 0, 0), (0, 0, -1.0), (0, -1.0, 0)))
    ahead = scenes.ahead(turned)
    np.testing.assert_allclose(np.array(ahead.rotation)[:, 2], (1, 0, 0), atol=1e-12)
    assert np.hypot(*ahead.position[:2]) == pytest.approx(np.hypot(*turned.position[:2]))


def maker(image, bodies, calls):
    """Recognisers that return the same bodies; of a mask in its order."""

    def make(cell):
        shift = jnp.array([[0.0, 0.0, cell.shelf.board - SHELF.board]])

        def recognise(key, depth, colour=None, mask=None, target_id=None):
            calls.append(cell)
            order = np.arange(BODIES)
            if mask is not None:
                shown = [int(image.segmentation[mask == i][0]) for i in range(len(THINGS))]
                order = np.array([*shown, *sorted(set(range(BODIES)) - set(shown))])
            given = jax.tree.map(lambda a: a[order], bodies)
            return seen(given.replace(position=given.position + shift))

        return recognise

    return make


def test_a_killed_run_goes_on_and_failures_are_drawn(folder, image, tmp_path):
    calls, found = [], scenes.find_scenes(folder)
    wrong = with_boxes({5: box((0.03, 0.03, 0.03), (0.45, 0.4, 0.15))})
    made = [look for at in looks.looks_at(found, None, tmp_path, maker(image, wrong, calls)) for look in at]
    assert [(look.scene, look.images) for look in made] == [
        (name, images) for name in found for images in ("depth and colour", "true masks")
    ]
    assert len(calls) == 8
    assert all(look.labels == 4 and min(thing.iou for thing in look.things) > 0.95 for look in made)
    assert [sum(body.phantom for body in look.bodies) for look in made] == [1] * 4
    assert all(look.warnings and look.compile_seconds >= 0 for look in made)
    pictures = sorted(path.name for path in tmp_path.glob("*.png"))
    assert pictures[:2] == ["arrays table3 from depth and colour.png", "arrays table3 from true masks.png"]
    with Image.open(tmp_path / pictures[0]) as drawn:
        assert drawn.width > 1000
    # The second scene's line is torn.
    rows = tmp_path / looks.ROWS
    text = rows.read_text()
    rows.write_text(text[: -len(text) // 4])
    calls.clear()
    again = [look for at in looks.looks_at(found, None, tmp_path, maker(image, wrong, calls)) for look in at]
    assert len(calls) == 4
    assert list(looks.looks_at(found, None, tmp_path, maker(image, wrong, calls))) == [again[:2], again[2:]]
    assert len(calls) == 4
    assert again[:2] == made[:2]
    of_looks = figures.figures(again)
    looks.save_results(again, of_looks, tmp_path / "results.json")
    stored = json.loads((tmp_path / "results.json").read_text())
    all_scenes = stored["figures"]["depth and colour"]["all"]
    assert all_scenes["matched"] == {"value": 1.0, "interval": [1.0, 1.0], "values": 8}
    assert list(stored["figures"]["true masks"]) == ["all", "000001", "stacked"]
    assert set(stored["about"]) == set(all_scenes) == set(figures.FIGURES)
    assert figures.table("true masks", of_looks["true masks"]).row_count == len(figures.FIGURES)
    # A table that is right has no picture.
    (tmp_path / "x").mkdir()
    right = list(looks.looks_at({"one": found["arrays/table3"]}, None, tmp_path / "x", maker(image, truth(), calls)))
    assert right[0][0].right
    assert not list((tmp_path / "x").glob("*.png"))


def test_intervals_resample_scenes():
    def look(scene, ious):
        things = [scores.Thing(i, 0.0, True, 1.0, False, i, iou) for i, iou in enumerate(ious)]
        return figures.Look(scene, "any", "true masks", len(ious), things, [], 0.1, 0.0, None, [])

    # All things of a scene fare alike: intervals are as of 20 scenes, not of 200 things.
    some = [look(str(i), [float(i % 2)] * 10) for i in range(20)]
    value = figures.value_of(figures.FIGURES["matched"], some)
    assert (value.value, value.values) == (0.5, 200)
    low, high = value.interval
    assert high - low == pytest.approx(2 * 1.96 * (0.25 / 20) ** 0.5, rel=0.15)
    assert figures.value_of(figures.FIGURES["matched"], some[:1]).interval is None
    assert figures.value_of(figures.FIGURES["upright"], some) == (None, None, 0)


@pytest.mark.parametrize(
    ("broken", "words"),
    [
        (lambda folder: None, "holds no scenes; name a folder"),
        (lambda folder: (folder / "a.npz").write_bytes(b"none"), r"a\.npz: is no labelled depth image"),
        (lambda folder: np.savez(folder / "a.npz", mask=np.zeros((3, 3), np.uint8)), r"a\.npz: is no labelled depth"),
        (lambda folder: (folder / "scene_camera.json").write_text("[]"), r"scene_camera\.json: must hold an object"),
        (lambda folder: (folder / "scene_camera.json").write_text('{"1": {}}'), r"000001\.png: cannot be read"),
    ],
)
def test_what_cannot_be_read_is_said_in_one_line(tmp_path, monkeypatch, broken, words):
    broken(tmp_path)
    status, message = program(monkeypatch, "bench", "real", str(tmp_path))
    assert status == 2
    assert len(message.strip().splitlines()) == 1
    with pytest.raises(InputError, match=words):
        list(looks.looks_at(scenes.find_scenes(tmp_path)))
