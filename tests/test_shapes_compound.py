"""Primitives against references in float64, and compounds: solids, mass properties, superquadric parts, and meshes."""

import dataclasses
import warnings

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from mechsearch_jax.runtime import kept_arrays
from mechsearch_jax.runtime.errors import InputError, Note
from mechsearch_jax.shapes import PRIMITIVES, meshes, surfaces
from mechsearch_jax.shapes import compound as compounds
from mechsearch_jax.shapes.compound import CONVEX, Compound, Piece, inertial, solids
from mechsearch_jax.shapes.meshes import convex_pieces, joined
from mechsearch_jax.shapes.parts import PARTS, parts_of, volume_in_common
from mechsearch_jax.shapes.surfaces import mended

HALF = {
    "box": (0.03, 0.02, 0.05),
    "cylinder": (0.03, 0.03, 0.05),
    "ellipsoid": (0.03, 0.02, 0.05),
    "capsule": (0.03, 0.03, 0.05),
}
TILTED = tuple(Rotation.from_euler("xyz", [40, -25, 70], degrees=True).as_quat(scalar_first=True).tolist())
MUG = Compound(
    (
        Piece("cylinder", (0.04, 0.04, 0.05), (0.0, 0.0, 0.05)),
        Piece("box", (0.015, 0.006, 0.03), (0.05, 0.0, 0.05)),
    ),
    density=400.0,
    friction=0.5,
)


def even(seed, half, count=200_000, stretch=1.1):
    """Uniform points in the box around a primitive, a little larger, and the box's volume."""
    bound = stretch * np.array(half)
    return np.random.default_rng(seed).uniform(-bound, bound, (count, 3)), float(np.prod(2 * bound))


@pytest.mark.parametrize("name", PRIMITIVES)
def test_volume_and_moments_are_those_of_the_points_inside(name):
    primitive, half = PRIMITIVES[name], np.array(HALF[name])
    points, box = even(0, half)
    held = points[primitive.inside(points, half, np)]
    assert primitive.volume(half, np) == pytest.approx(box * len(held) / len(points), rel=0.01)
    square = (held**2).mean(axis=0)
    np.testing.assert_allclose(primitive.moments(half, np), square.sum() - square, rtol=0.01)
    assert np.linalg.norm(held, axis=1).max() <= primitive.bounding_radius(half, np)
    assert np.linalg.norm(held, axis=1).max() > 0.97 * primitive.bounding_radius(half, np)


@pytest.mark.parametrize("name", PRIMITIVES)
def test_rays_meet_a_primitive_where_its_inside_begins(name):
    primitive, half = PRIMITIVES[name], np.array(HALF[name])
    rng = np.random.default_rng(1)
    start = rng.normal(size=(300, 3))
    start *= 0.5 / np.linalg.norm(start, axis=1, keepdims=True)
    way = rng.uniform(-0.05, 0.05, (300, 3)) - start
    depth = primitive.cut(list(start.T), list(way.T), half, np)
    along = np.linspace(0.0, 1.5, 3001)
    held = primitive.inside(start[:, None] + along[:, None] * way[:, None], half, np)
    first = np.where(held.any(axis=1), along[held.argmax(axis=1)], np.inf)
    hit = np.isfinite(depth)
    assert hit.sum() > 100
    # A sliver thinner than a sample is hit by the ray alone.
    assert np.all(np.isfinite(first) <= hit)
    both = np.isfinite(first)
    assert np.all(depth[both] <= first[both] + 1e-9)
    assert np.quantile(first[both] - depth[both], 0.95) < 6e-4
    near = start[hit] + depth[hit][:, None] * way[hit]
    normal = primitive.normal(near, np.broadcast_to(half, near.shape), np)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    assert not primitive.inside(near + 1e-6 * normal, half, np).any()
    assert primitive.inside(near - 1e-6 * normal, half, np).all()


@pytest.mark.parametrize("name", PRIMITIVES)
def test_meshes_of_primitives_have_their_volume(name):
    primitive, half = PRIMITIVES[name], HALF[name]
    mesh = primitive.mesh(half)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(primitive.volume(np.array(half), np), rel=0.06)
    np.testing.assert_allclose(mesh.bounds, [-np.array(half), half], atol=0.02 * max(half))


@pytest.mark.parametrize("ends", [(0.03, 0.05), (0.05, 0.01), (0.03, 0.03)])
def test_a_frustum_is_a_stack_of_discs_of_its_volume(ends):
    low, high = ends
    stack = compounds.discs((low, high, 0.04))
    assert len(stack) == min(
        max(int(np.ceil(round(abs(high - low) / compounds.DISC_STEP, 9))), 1), compounds.MOST_DISCS
    )
    exact = np.pi * 0.08 * (low**2 + low * high + high**2) / 3
    assert sum(np.pi * r**2 * 2 * half for _, r, half in stack) == pytest.approx(exact)
    bottoms = [z - half for z, _, half in stack]
    tops = [z + half for z, _, half in stack]
    np.testing.assert_allclose([*bottoms, 0.04], [-0.04, *tops], atol=1e-12)


def test_mass_properties_are_those_of_a_mesh_of_the_same_solids():
    """Against trimesh, whose round solids have flat faces: within their lack of volume."""
    turned = Compound((*MUG.pieces, Piece("box", (0.01, 0.02, 0.03), (-0.1, 0.02, 0.2), TILTED)), 500.0, 0.5)
    surfaces = [compounds.mesh(solid) for solid in solids(turned.pieces)]
    whole = trimesh.util.concatenate(surfaces)
    whole.density = 500.0
    mass, centre, moments, rotation = inertial(turned)
    assert mass == pytest.approx(whole.mass, rel=0.01)
    np.testing.assert_allclose(centre, whole.center_mass, atol=5e-4)
    np.testing.assert_allclose(rotation @ np.diag(moments) @ rotation.T, whole.moment_inertia, atol=0.01 * max(moments))
    assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_a_polyhedron_weighs_what_the_box_of_its_corners_weighs():
    corners = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T * HALF["box"]
    polyhedron = Piece(CONVEX, (0.0,) * 3, (0.1, 0.0, 0.2), TILTED, tuple(map(tuple, corners.tolist())))
    box = dataclasses.replace(polyhedron, shape="box", half_size=HALF["box"], vertices=())
    given, wanted = (inertial(Compound((piece,), 500.0, 0.4)) for piece in (polyhedron, box))
    for a, b in zip(given[:3], wanted[:3], strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9)
    points, _ = even(3, HALF["box"], 2000)
    np.testing.assert_array_equal(*(compounds.inside(piece, points + piece.position) for piece in (polyhedron, box)))


def test_all_of_a_compound_is_in_the_hull_of_its_surface_points():
    pieces = tuple(Piece(name, half, (0.05 * i, 0.02 * i, 0.0), TILTED) for i, (name, half) in enumerate(HALF.items()))
    body = Compound((*pieces, Piece("frustum", (0.03, 0.05, 0.04), (0.0, 0.1, 0.0), TILTED)), 500.0, 0.5)
    directions = np.random.default_rng(0).normal(size=(200, 3))
    reach = (compounds.surface_points(body) @ directions.T).max(axis=0)
    rng = np.random.default_rng(1)
    points = rng.uniform(-0.2, 0.3, (200_000, 3))
    held = points[np.any([compounds.inside(solid, points) for solid in solids(body.pieces)], axis=0)]
    assert len(held) > 1000
    assert np.all((held @ directions.T).max(axis=0) <= reach)
    assert np.all(np.abs(held).max(axis=0) <= compounds.half_extents(body))


def test_parts_are_the_pieces_superquadrics():
    body = Compound(
        (
            Piece("box", HALF["box"], (0.0, 0.0, 0.0), TILTED),
            Piece("cylinder", HALF["cylinder"], (0.2, 0.0, 0.0)),
            Piece("frustum", (0.02, 0.03, 0.05), (0.0, 0.2, 0.0)),
        ),
        500.0,
        0.5,
    )
    box, cylinder, *stack = parts_of(body)
    assert (box.exponents, cylinder.exponents) == ((0.2, 0.2), (0.2, 1.0))
    np.testing.assert_array_equal(box.size, HALF["box"])
    np.testing.assert_array_equal(box.rotation, body.pieces[0].rotation)
    # What is left goes to the frustum.
    assert len(stack) == PARTS - 2
    np.testing.assert_allclose([part.position[2] for part in stack], [-0.025, 0.025])
    assert volume_in_common(body) > 0.9
    (smooth,) = parts_of(Compound((Piece("ellipsoid", HALF["ellipsoid"]),), 500.0, 0.5))
    assert smooth.exponents == (1.0, 1.0)
    assert volume_in_common(Compound((Piece("capsule", (0.02, 0.02, 0.06)),), 500.0, 0.5)) > 0.9


def test_a_mesh_of_convex_parts_is_taken_as_it_is(tmp_path):
    boxes = [trimesh.creation.box((20, 30, 40)), trimesh.creation.box((10, 10, 90)).apply_translation((40, 0, 0))]
    trimesh.util.concatenate(boxes).export(tmp_path / "two.obj")
    pieces = convex_pieces(tmp_path / "two.obj", 0.001, "here")
    assert [piece.shape for piece in pieces] == [CONVEX] * 2
    volumes = sorted(float(compounds.hull(piece).volume) for piece in pieces)
    np.testing.assert_allclose(volumes, [9e-6, 24e-6], rtol=1e-5)
    assert volume_in_common(Compound(pieces, 500.0, 0.5)) > 0.9


def test_a_hollow_mesh_is_cut_into_convex_pieces(tmp_path):
    pytest.importorskip("coacd")
    trimesh.creation.annulus(0.03, 0.04, 0.05).export(tmp_path / "ring.stl")
    pieces = convex_pieces(tmp_path / "ring.stl", 1.0, "here")
    assert 2 <= len(pieces) <= 8
    exact = np.pi * 0.05 * (0.04**2 - 0.03**2)
    assert exact < sum(float(compounds.hull(piece).volume) for piece in pieces) < 2.0 * exact


def test_what_no_mesh_is_is_one_line(tmp_path, monkeypatch):
    import sys

    (tmp_path / "text.obj").write_text("no mesh")
    trimesh.Trimesh([(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)], [(0, 1, 2), (1, 3, 2)]).export(tmp_path / "flat.stl")
    trimesh.creation.annulus(0.03, 0.04, 0.05).export(tmp_path / "ring.stl")
    monkeypatch.setitem(sys.modules, "coacd", None)
    for name, reason in (
        ("none.obj", "cannot be read"),
        ("text.obj", "no triangles"),
        ("flat.stl", "flat parts alone"),
        ("ring.stl", r"install CoACD with: pip install 'mechsearch-jax\[objects\]'"),
    ):
        with pytest.raises(InputError, match=reason) as error:
            convex_pieces(tmp_path / name, 1.0, "scene.json: objects[0].mesh")
        assert str(error.value).startswith("scene.json: objects[0].mesh: ")
        assert "\n" not in str(error.value)


def test_a_mesh_is_cut_once_and_again_if_what_was_kept_is_damaged(tmp_path, monkeypatch):
    pytest.importorskip("coacd")
    monkeypatch.setenv(kept_arrays.VARIABLE, str(tmp_path / "cache"))
    cuts = []
    decomposed = meshes._decomposed
    monkeypatch.setattr(meshes, "_decomposed", lambda *args: cuts.append(args) or decomposed(*args))
    trimesh.creation.annulus(0.03, 0.04, 0.05).export(tmp_path / "ring.stl")

    def cut(scale=1.0):
        meshes._read.cache_clear()
        return convex_pieces(tmp_path / "ring.stl", scale, "here")

    first = cut()
    assert cut() == first
    assert len(cuts) == 1
    (file,) = (tmp_path / "cache").glob("mesh-*.npz")
    file.write_bytes(file.read_bytes()[:100])
    assert cut() == first
    assert len(cuts) == 2
    cut(2.0)
    assert len(cuts) == 3
    # Another content counts, not another time.
    trimesh.creation.annulus(0.03, 0.04, 0.06).export(tmp_path / "ring.stl")
    assert cut() != first
    monkeypatch.setenv(kept_arrays.VARIABLE, "")
    cut()
    assert len(cuts) == 5


BOX = trimesh.creation.box((0.06, 0.06, 0.25))
# From a bottle's profile.
BOTTLE = trimesh.creation.revolve(
    np.array([(0, 0), (0.03, 0), (0.03, 0.15), (0.012, 0.19), (0.012, 0.25), (0, 0.25)]), sections=16
)


def turned(mesh, which=slice(None)):
    faces = np.array(mesh.faces)
    faces[which] = faces[which][:, ::-1]
    return trimesh.Trimesh(mesh.vertices, faces, process=False)


def with_seams(mesh):
    corners = mesh.triangles.reshape(-1, 3) + np.random.default_rng(0).uniform(-2e-6, 2e-6, (3 * len(mesh.faces), 3))
    return trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)


def without(mesh, above):
    kept = mesh.triangles_center[:, 2] < above
    return trimesh.Trimesh(mesh.vertices, mesh.faces[kept], process=False)


def beside(mesh, *sizes):
    """A mesh with loose boxes of these sides far from it."""
    places = ((0.1 * i, 0.2, 0) for i in range(len(sizes)))
    loose = [trimesh.creation.box((size,) * 3).apply_translation(at) for size, at in zip(sizes, places, strict=True)]
    return trimesh.util.concatenate([mesh, *loose])


def taken(tmp_path, mesh):
    """Extents [mm] and volume [cm3] of the pieces of a mesh, and what is said of it."""
    mesh.export(tmp_path / "thing.ply")
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", Note)
        pieces = convex_pieces(tmp_path / "thing.ply", 1.0, "here")
    extents = 1e3 * np.ptp(np.concatenate([piece.in_body(np.array(piece.vertices)) for piece in pieces]), axis=0)
    assert all("\n" not in str(note.message) for note in said)
    return extents, 1e6 * sum(float(compounds.hull(p).volume) for p in pieces), [str(note.message) for note in said]


@pytest.mark.parametrize(
    "mesh",
    [BOX, turned(BOX), turned(BOX, slice(None, None, 2)), with_seams(BOX), BOTTLE, turned(BOTTLE), with_seams(BOTTLE)],
)
def test_a_closed_mesh_keeps_its_size_however_its_faces_are_turned_or_joined(tmp_path, mesh):
    if len(mesh.faces) > 12:
        pytest.importorskip("coacd")
    extents, volume, said = taken(tmp_path, mesh)
    np.testing.assert_allclose(extents, (60, 60, 250), atol=0.1)
    assert volume == pytest.approx(900 if len(mesh.faces) == 12 else 1e6 * BOTTLE.volume, rel=0.02)
    assert said == []


def test_holes_are_filled_and_said(tmp_path):
    pytest.importorskip("coacd")
    flat_top = trimesh.creation.annulus(0.02, 0.03, 0.25)
    for mesh, volume, hole in ((without(BOX, 0.1249), 900, 60), (without(BOTTLE, 0.2499), 1e6 * BOTTLE.volume, 24)):
        extents, taken_volume, (note,) = taken(tmp_path, mesh)
        np.testing.assert_allclose(extents, (60, 60, 250), atol=0.1)
        assert taken_volume == pytest.approx(volume, rel=0.02)
        assert f"not closed: holes (1, at most {hole} mm wide) are filled, and it is taken as solid" in note
    # A hole with a rim around another.
    assert mended(without(flat_top, 0.12)).open_edges == 0


def test_what_cannot_be_filled_is_said_to_be_hollow(tmp_path):
    pytest.importorskip("coacd")
    # A band with half a twist has no inside.
    turn = np.linspace(0, 2 * np.pi, 13)[:-1]
    across = np.stack([np.cos(turn / 2) * np.cos(turn), np.cos(turn / 2) * np.sin(turn), np.sin(turn / 2)], axis=1)
    middle = 0.05 * np.stack([np.cos(turn), np.sin(turn), np.zeros(12)], axis=1)
    i = np.arange(12)
    a, b, c, d = i, i + 12, np.where(i < 11, i + 1, 12), np.where(i < 11, i + 13, 0)
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])
    band = trimesh.Trimesh(np.concatenate([middle - 0.02 * across, middle + 0.02 * across]), faces, process=False)
    extents, _, said = taken(tmp_path, band)
    assert "cannot be filled: it is taken as a hollow shell" in said[0]
    np.testing.assert_allclose(extents, 1e3 * band.extents, atol=2.0)


def test_specks_flat_parts_and_what_is_inside_are_left_out_and_said(tmp_path):
    sheet = trimesh.Trimesh([(0.1, 0, 0), (0.12, 0, 0), (0.1, 0.02, 0)], [(0, 1, 2)])
    inner = trimesh.creation.box((0.05, 0.05, 0.24))
    mesh = trimesh.util.concatenate([beside(BOX, 0.001, 0.001, 0.002), sheet, turned(inner)])
    extents, volume, (left_out, inside) = taken(tmp_path, mesh)
    np.testing.assert_allclose(extents, (60, 60, 250), atol=0.1)
    assert volume == pytest.approx(900)
    assert "4 of its 6 loose parts, at most 20 mm long, are left out" in left_out
    assert "closed surfaces inside it (1, 600 cm3) are left out: it is taken as solid" in inside
    # What is not tiny stays.
    assert len(mended(beside(BOX, 0.01, 0.02)).parts) == 3


def test_of_too_many_parts_neighbours_are_joined(tmp_path):
    row = [trimesh.creation.box((0.03, 0.02, 0.02)).apply_translation((0.02 * i, 0, 0.001 * i)) for i in range(17)]
    mesh = trimesh.util.concatenate([*row, trimesh.creation.box((0.02, 0.02, 0.1)).apply_translation((0.1, 0.3, 0))])
    extents, volume, _ = taken(tmp_path, mesh)
    np.testing.assert_allclose(extents, 1e3 * mesh.extents, atol=0.1)
    few = joined([np.array(part.vertices) for part in mesh.split()], 2)
    far = [len(corners) for corners in few if corners[:, 1].max() > 0.2]
    assert (len(few), far) == (2, [8])
    assert volume == pytest.approx(1e6 * mesh.volume, rel=0.05)


def test_the_distance_outside_is_that_to_the_surface():
    points = np.array([(0.0, 0, 0), (0.03, 0, 0), (0.035, 0, 0), (0.05, 0.04, 0.0), (0, 0, 0.2)])
    assert surfaces.farthest_outside(BOX, points[:2], 1e-3) == 0
    for count, distance in ((3, 0.005), (4, np.hypot(0.02, 0.01)), (5, 0.075)):
        assert surfaces.farthest_outside(BOX, points[:count], 1e-3) == pytest.approx(distance)
    np.testing.assert_allclose(surfaces.turns_around(BOX, points[[0, 2, 3, 4]]), (1, 0, 0, 0), atol=1e-9)
    aside = np.array((0.1, 0, 0))
    hulls = [BOX.vertices, BOX.vertices + aside]
    np.testing.assert_allclose(surfaces.beyond(hulls, points + 0.15 * aside), (0, 0.015, 0.02, 0.01, 0.075), atol=1e-9)
