"""Triangle meshes as convex pieces: read by `trimesh`, decomposed by `coacd` where they are not convex already."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import importlib.metadata
import importlib.util
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float

from mechsearch_jax.runtime.errors import InputError, Note
from mechsearch_jax.runtime.kept_arrays import kept_arrays
from mechsearch_jax.shapes.compound import CONVEX, DIGITS, MOST_SOLIDS, MOST_VERTICES, Piece, faces, hull

# Largest mesh file [bytes].
LARGEST_FILE = 1 << 26
# Concavity up to which a mesh counts as convex, in CoACD's measure, and the most pieces that it is cut into.
CONCAVITY, PIECES = 0.05, 8
# Settings of CoACD beside these: coarser than its own, which take ten times as long and follow a scanned surface no
# better with so few pieces.
CUT: Mapping[str, Any] = MappingProxyType(
    {
        "preprocess_mode": "on",
        "preprocess_resolution": 20,
        "resolution": 300,
        "mcts_iterations": 20,
        "mcts_max_depth": 2,
        "mcts_nodes": 10,
    }
)
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
    parts = loaded.split(only_watertight=False, repair=False)
    if 0 < len(parts) <= MOST_SOLIDS and all(_is_convex(part) for part in parts):
        hulls = [np.asarray(part.vertices) for part in parts]
    else:
        key = repr((content, scale, sorted(CUT.items()), CONCAVITY, PIECES, MOST_VERTICES, _versions()))
        rows = kept_arrays("mesh", key, lambda: _decomposed(loaded, path, where))
        hulls = [rows[name] for name in sorted(rows)]
    uses = np.unique(loaded.edges_sorted, axis=0, return_counts=True)[1]
    pieces = [_piece(vertices, path, where) for vertices in hulls]
    _note_what_was_mended(path, int((uses == 1).sum()), pieces)
    return tuple(_thickened(piece) for piece in pieces)


def _note_what_was_mended(path: Path, open_edges: int, pieces: Sequence[Piece]) -> None:
    if open_edges:
        volume = 1e6 * sum(float(hull(piece).volume) for piece in pieces)
        warnings.warn(
            f"{path}: its surface is not closed ({open_edges} open edges), so that what is inside is a guess; it is"
            f" taken as {len(pieces)} convex pieces of {volume:.0f} cm3 together; close it if pictures show them wrong",
            Note,
            stacklevel=2,
        )
    thin = [width for piece in pieces if (width := thickness(piece)[0]) < LEAST_THICKNESS]
    if thin:
        warnings.warn(
            f"{path}: {len(thin)} of its convex pieces are thinner than {1e3 * LEAST_THICKNESS:g} mm (the thinnest"
            f" {1e3 * min(thin):.2g} mm) and are made so thick; if that is not meant, scale is that of another unit",
            Note,
            stacklevel=2,
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


def _decomposed(mesh, path: Path, where: str) -> dict[str, Float[np.ndarray, "n 3"]]:
    """Vertices of convex pieces that together are about a mesh, by names in their order."""
    try:
        import coacd  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise InputError(
            f"{where}: {path} is not convex, nor made of convex pieces; to cut it into such, install CoACD with:"
            " pip install 'mechsearch-jax[objects]'"
        ) from None
    coacd.set_log_level("error")
    settings = {"max_convex_hull": PIECES, "decimate": True, "max_ch_vertex": MOST_VERTICES, "seed": 0, **CUT}
    whole = coacd.Mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    pieces = coacd.run_coacd(whole, threshold=CONCAVITY, **settings)
    return {f"piece{i:02}": np.asarray(vertices) for i, (vertices, _) in enumerate(pieces)}


def _piece(vertices: Float[np.ndarray, "n 3"], path: Path, where: str) -> Piece:
    """The convex hull of vertices, thinned to `MOST_VERTICES`, about its own centre."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        corners = vertices[ConvexHull(vertices).vertices]
    except (QhullError, ValueError):
        raise InputError(f"{where}: {path} has a part that is flat; give a mesh of solid parts") from None
    corners = thinned(corners)
    centre = np.round(corners.mean(axis=0), DIGITS)
    rows = np.round(corners - centre, DIGITS)
    x, y, z = centre.tolist()
    return Piece(CONVEX, (0.0, 0.0, 0.0), (x, y, z), vertices=tuple((a, b, c) for a, b, c in rows.tolist()))


def thinned(corners: Float[np.ndarray, "n 3"], most: int = MOST_VERTICES) -> Float[np.ndarray, "m 3"]:
    """At most so many of the vertices of a convex polyhedron: those farthest out in evenly spread directions."""
    if len(corners) <= most:
        return corners
    rows = np.arange(most) + 0.5
    angle, height = np.pi * (1 + 5**0.5) * rows, 1 - 2 * rows / most
    level = np.sqrt(1 - height**2)
    directions = np.stack([level * np.cos(angle), level * np.sin(angle), height], axis=1)
    return corners[np.unique(np.argmax(corners @ directions.T, axis=0))]


def convex_pieces(path: Path, scale: float, where: str) -> tuple[Piece, ...]:
    """The convex pieces of a mesh file, in the mesh's frame.

    A mesh of at most 16 connected parts that are convex is taken as it is. Any other is cut into at most `PIECES`
    pieces, always the same, which are kept on disk, see `runtime.kept_arrays`. A `Note` warns where the surface is not
    closed, and where pieces are thinner than `LEAST_THICKNESS` and are made so thick.

    Args:
      path: of the file.
      scale: metres per unit of the file.
      where: how messages begin.

    Raises:
      InputError: it cannot be read, is no mesh, has flat parts, or `coacd` is needed and not installed.
    """
    try:
        if path.stat().st_size > LARGEST_FILE:
            raise InputError(f"{where}: {path} is larger than {LARGEST_FILE >> 20} MiB; simplify the mesh")
        content = hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise InputError(
            f"{where}: {path} cannot be read ({error.strerror}); a path in a file counts from that file's folder"
        ) from None
    return _read(path, content, scale, where)
