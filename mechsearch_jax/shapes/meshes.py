"""Triangle meshes as convex pieces: read by `trimesh`, decomposed by `coacd` where they are not convex already."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import importlib.metadata
import importlib.util
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from mechsearch_jax.runtime.errors import InputError, Note
from mechsearch_jax.runtime.kept_arrays import kept_arrays
from mechsearch_jax.shapes.compound import (
    CONVEX,
    DIGITS,
    LEAST_VOLUME,
    MOST_SOLIDS,
    MOST_VERTICES,
    Piece,
    faces,
    hull,
    hull_volume,
)
from mechsearch_jax.shapes.surfaces import SEAM, SPECK, Mended, beyond, deviation, mended, nearest, turns_around, whole

if TYPE_CHECKING:
    from trimesh import Trimesh

# Largest mesh file [bytes].
LARGEST_FILE = 1 << 26
# Concavity up to which a mesh counts as convex, in CoACD's measure, and the most pieces that it is cut into.
CONCAVITY, PIECES = 0.05, 8
# Settings of CoACD beside these: coarser than its own, which take ten times as long and follow a scanned surface no
# better with so few pieces. It remeshes what is no manifold alone, for that makes things larger.
CUT: Mapping[str, Any] = MappingProxyType(
    {
        "preprocess_mode": "auto",
        "preprocess_resolution": 20,
        "resolution": 300,
        "mcts_iterations": 20,
        "mcts_max_depth": 2,
        "mcts_nodes": 10,
    }
)
# Pieces that may be joined with one: those whose centres are nearest.
NEIGHBOURS = 9
# Evenly spread directions in which the first vertices are looked for where there are too many.
START = 12
# Pieces that are farther from the surface than this are said [m].
FAR = 1e-3
# What was remeshed reaches out of the mesh by more than this [m]; what was not, by rounding alone.
REMESHED = 1e-5
# Thinner walls slip through the simulators' contacts, and through the grid on which grasps are looked for [m].
LEAST_THICKNESS = 0.002
# A part of a mesh whose volume is at least this share of its hull's is convex.
CONVEX_SHARE = 0.98


@functools.lru_cache(maxsize=64)
def _read(path: Path, content: str, scale: float, where: str) -> tuple[Piece, ...]:
    """`convex_pieces` of a file with a digest of its content."""
    loaded = _surface(path, where)
    loaded.apply_scale(scale)
    if not np.isfinite(loaded.vertices).all():
        raise InputError(f"{where}: {path} holds vertices that are not finite numbers; mend the mesh")
    surface = mended(loaded)
    if not surface.parts:
        raise InputError(f"{where}: {path} holds flat parts alone; give a mesh of solid ones")
    if len(surface.parts) <= MOST_SOLIDS and all(_is_convex(part) for part in surface.parts):
        hulls = [np.asarray(part.vertices) for part in surface.parts]
    else:
        key = repr((content, scale, sorted(CUT.items()), CONCAVITY, PIECES, MOST_VERTICES, SEAM, SPECK, _versions()))
        rows = kept_arrays("mesh", key, lambda: _decomposed(surface.parts, path, where))
        hulls = [rows[name] for name in sorted(rows)]
    pieces = [_piece(vertices, path, where) for vertices in hulls]
    for note in _what_was_mended(surface, pieces):
        warnings.warn(f"{path}: {note}", Note, stacklevel=2)
    return tuple(_thickened(piece) for piece in pieces)


def _what_was_mended(surface: Mended, pieces: Sequence[Piece]) -> Iterator[str]:
    """One line about each thing of a mesh that is used, perhaps not as it was meant."""
    volume = 1e6 * sum(float(hull(piece).volume) for piece in pieces)
    taken = f"{len(pieces)} convex pieces of {volume:.0f} cm3 together"
    if surface.specks:
        yield (
            f"{len(surface.specks)} of its {len(surface.specks) + len(surface.inner) + len(surface.parts)} loose parts,"
            f" at most {1e3 * max(surface.specks):.2g} mm long, are left out, tiny or flat; if they belong to it, join"
            " them to the rest"
        )
    if surface.inner:
        yield (
            f"closed surfaces inside it ({len(surface.inner)}, {1e6 * sum(surface.inner):.0f} cm3) are left out: it is"
            f" taken as solid, {taken}; if it is hollow, give a smaller density"
        )
    if surface.holes:
        yield (
            f"its surface is not closed: holes ({len(surface.holes)}, at most {1e3 * max(surface.holes):.0f} mm wide)"
            f" are filled, and it is taken as solid, {taken}; if it is hollow, give its wall a thickness"
        )
    if surface.open_edges:
        yield (
            f"its surface is not closed ({surface.open_edges} open edges), and its holes cannot be filled: it is taken"
            f" as a hollow shell, {taken}; close it if it is solid"
        )
    hulls = [piece.in_body(np.array(piece.vertices)) for piece in pieces]
    out, within = deviation(whole(surface.parts), hulls, FAR)
    if max(out, within) > FAR:
        yield (
            f"its convex pieces reach up to {1e3 * out:.1f} mm out of its surface, as where they fill hollows, and stay"
            f" up to {1e3 * within:.1f} mm inside it; where that matters, give it as at most {MOST_SOLIDS} convex parts"
        )
    thin = [width for piece in pieces if (width := thickness(piece)[0]) < LEAST_THICKNESS]
    if thin:
        yield (
            f"{len(thin)} of its convex pieces are thinner than {1e3 * LEAST_THICKNESS:g} mm (the thinnest"
            f" {1e3 * min(thin):.2g} mm) and are made so thick; if that is not meant, scale is that of another unit"
        )


def thickness(piece: Piece) -> tuple[float, Float[np.ndarray, " 3"]]:
    """The least distance between parallel planes that touch a polyhedron, one of which holds a face [m]; their normal
    in the piece's frame."""
    normals = faces(piece)[:, :3]
    along = np.array(piece.vertices) @ normals.T
    widths = np.ptp(along, axis=0)
    least = int(np.argmin(widths))
    return float(widths[least]), normals[least]


def _thickened(piece: Piece) -> Piece:
    """The polyhedron, stretched to at least `LEAST_THICKNESS` along its shortest width."""
    width, normal = thickness(piece)
    if width >= LEAST_THICKNESS:
        return piece
    corners = np.array(piece.vertices)
    grown = corners + (LEAST_THICKNESS / max(width, 1e-6) - 1.0) * (corners @ normal)[:, None] * normal
    rows = np.round(grown, DIGITS).tolist()
    return dataclasses.replace(piece, vertices=tuple((x, y, z) for x, y, z in rows))


def box_around(
    path: Path, scale: float, where: str
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
    """The smallest box around a mesh file, turned as it may be.

    Args:
      path, scale, where: as of `convex_pieces`.

    Returns:
      Its axes as columns, its centre [m] and its sizes along them [m], in the mesh's frame.

    Raises:
      InputError: it cannot be read, or is no mesh.
    """
    _content(path, where)
    loaded = _surface(path, where)
    loaded.apply_scale(scale)
    if not np.isfinite(loaded.vertices).all():
        raise InputError(f"{where}: {path} holds vertices that are not finite numbers; mend the mesh")
    import trimesh

    try:
        T_box_mesh, size = trimesh.bounds.oriented_bounds(loaded)
    except Exception as error:
        raise InputError(f"{where}: {path} has no box around it ({error}); give the mesh of a body") from None
    T = np.linalg.inv(T_box_mesh)
    return T[:3, :3], T[:3, 3], np.asarray(size, float)


def _content(path: Path, where: str) -> bytes:
    """The bytes of a mesh file."""
    try:
        if path.stat().st_size > LARGEST_FILE:
            raise InputError(f"{where}: {path} is larger than {LARGEST_FILE >> 20} MiB; simplify the mesh")
        return path.read_bytes()
    except OSError as error:
        raise InputError(
            f"{where}: {path} cannot be read ({error.strerror}); a path in a file counts from that file's folder"
        ) from None


def _surface(path: Path, where: str):
    """The surface of a mesh file, in which vertices at the same place are one: files have several for textures."""
    import trimesh

    try:
        loaded = trimesh.load(str(path), force="mesh", process=True)
    # What its many readers raise is not limited.
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(
            f"{where}: {path} is no mesh that can be read ({reason}); give an OBJ, STL or PLY file"
        ) from None
    if not isinstance(loaded, trimesh.Trimesh) or not len(loaded.faces):
        raise InputError(f"{where}: {path} holds no triangles; give an OBJ, STL or PLY file of a surface")
    loaded.merge_vertices(merge_tex=True, merge_norm=True)
    return loaded


def _versions() -> tuple[str, ...]:
    """Of what cuts meshes."""
    installed = [name for name in ("coacd", "trimesh") if importlib.util.find_spec(name)]
    return tuple(f"{name} {importlib.metadata.version(name)}" for name in installed)


def _is_convex(part) -> bool:
    return bool(part.is_watertight and part.volume >= CONVEX_SHARE * part.convex_hull.volume)


def _decomposed(parts: Sequence[Trimesh], path: Path, where: str) -> dict[str, Float[np.ndarray, "_ 3"]]:
    """Vertices of convex pieces that together are about a mesh of several parts, by names in their order."""
    hulls = []
    for part in parts:
        hulls += [np.asarray(part.vertices)] if _is_convex(part) else _cut(part, path, where)
    return {f"piece{i:02}": vertices for i, vertices in enumerate(joined(hulls))}


def _cut(part: Trimesh, path: Path, where: str) -> list[Float[np.ndarray, "_ 3"]]:
    """Vertices of convex pieces that together are about a connected part."""
    try:
        import coacd  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise InputError(
            f"{where}: {path} is not convex, nor made of convex pieces; to cut it into such, install CoACD with:"
            " pip install 'mechsearch-jax[objects]'"
        ) from None
    coacd.set_log_level("error")
    cut = coacd.run_coacd(
        coacd.Mesh(np.asarray(part.vertices), np.asarray(part.faces)),
        threshold=CONCAVITY,
        max_convex_hull=PIECES,
        seed=0,
        **CUT,
    )
    found = [thinned(_corners(vertices)) for vertices, _ in cut if hull_volume(vertices)]
    low, high = part.bounds
    if any(np.max([low - corners, corners - high]) > REMESHED for corners in found):
        found = [_true_to_size(corners, part) for corners in found]
    # Without slivers along the cuts.
    return [vertices for vertices in found if hull_volume(vertices) >= LEAST_VOLUME] or found


def joined(hulls: Sequence[Float[np.ndarray, "_ 3"]], most: int = MOST_SOLIDS) -> list[Float[np.ndarray, "_ 3"]]:
    """At most so many convex polyhedra, by their vertices: always the two neighbours are joined whose hull holds least
    that neither holds."""
    from scipy.spatial import KDTree

    left = {i: thinned(_corners(vertices)) for i, vertices in enumerate(hulls)}
    volumes = {i: hull_volume(vertices) for i, vertices in left.items()}
    gains: dict[tuple[int, int], float] = {}
    for new in range(len(left), 2 * len(left) - most):
        names = np.array(list(left))
        tree = KDTree([vertices.mean(axis=0) for vertices in left.values()])
        near = names[tree.query(tree.data, k=min(NEIGHBOURS, len(names)))[1]]
        pairs = {
            (min(i, j), max(i, j)) for i, row in zip(names.tolist(), near.tolist(), strict=True) for j in row if i != j
        }
        for i, j in pairs - gains.keys():
            gains[i, j] = hull_volume(np.concatenate([left[i], left[j]])) - volumes[i] - volumes[j]
        i, j = min(pairs, key=lambda pair: (gains[pair], pair))
        left[new] = thinned(_corners(np.concatenate([left.pop(i), left.pop(j)])))
        volumes[new] = hull_volume(left[new])
    return list(left.values())


def _true_to_size(corners: Float[np.ndarray, "n 3"], part: Trimesh) -> Float[np.ndarray, "m 3"]:
    """Corners of a piece of a part, without what remeshing has added: those outside are moved to the surface."""
    moved = np.where(turns_around(part, corners)[:, None] < 0.5, nearest(part, corners)[0], corners)
    return _corners(moved) if hull_volume(moved) else corners


def _corners(vertices: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """Those of the convex hull."""
    from scipy.spatial import ConvexHull

    return vertices[ConvexHull(vertices).vertices]


def _piece(vertices: Float[np.ndarray, "n 3"], path: Path, where: str) -> Piece:
    """The convex hull of vertices, thinned to `MOST_VERTICES`, about its own centre."""
    if not hull_volume(vertices):
        raise InputError(f"{where}: {path} has a part that is flat; give a mesh of solid parts")
    corners = thinned(_corners(vertices))
    centre = np.round(corners.mean(axis=0), DIGITS)
    rows = np.round(corners - centre, DIGITS)
    x, y, z = centre.tolist()
    return Piece(CONVEX, (0.0, 0.0, 0.0), (x, y, z), vertices=tuple((a, b, c) for a, b, c in rows.tolist()))


def thinned(corners: Float[np.ndarray, "n 3"], most: int = MOST_VERTICES) -> Float[np.ndarray, "m 3"]:
    """At most so many of the vertices of a convex polyhedron: those farthest out along the axes, so that it stays as
    long, wide and tall, and in `START` other directions, then always the one that is farthest from the hull of those.
    """
    if len(corners) <= most:
        return corners
    rows = np.arange(START) + 0.5
    angle, height = np.pi * (1 + 5**0.5) * rows, 1 - 2 * rows / START
    level = np.sqrt(1 - height**2)
    around = np.stack([level * np.cos(angle), level * np.sin(angle), height], axis=1)
    kept = np.unique(np.argmax(corners @ np.concatenate([np.eye(3), -np.eye(3), around]).T, axis=0))
    while len(kept) < most and (away := beyond([corners[kept]], corners)).max() > 0:
        kept = np.union1d(kept, np.argmax(away))
    return corners[kept]


def convex_pieces(path: Path, scale: float, where: str) -> tuple[Piece, ...]:
    """The convex pieces of a mesh file, in the mesh's frame.

    Seams are welded, faces turned outwards, holes filled; loose parts that are tiny or flat, and closed ones inside
    others, are left out, see `surfaces`. A mesh of at most 16 connected parts that are convex then is taken as
    it is. Of any other, each part that is not convex is cut into at most `PIECES` pieces, and pieces are joined where
    there are too many; always the same, which are kept on disk, see `runtime.kept_arrays`. A `Note` warns of all that
    was filled or left out, where pieces are more than 1 mm off the surface, and where they are thinner than
    `LEAST_THICKNESS` and are made so thick.

    Args:
      path: of the file.
      scale: metres per unit of the file.
      where: how messages begin.

    Raises:
      InputError: it cannot be read, is no mesh, has flat parts, or `coacd` is needed and not installed.
    """
    content = hashlib.sha256(_content(path, where)).hexdigest()
    return _read(path, content, scale, where)
