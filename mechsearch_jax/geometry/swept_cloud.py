"""Points spread over the surface of the volume that boxes and capsules sweep together."""

from __future__ import annotations

import functools
import hashlib
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from mechsearch_jax.geometry import spreading
from mechsearch_jax.geometry.spreading import farthest_points
from mechsearch_jax.runtime.kept_arrays import kept_arrays

if TYPE_CHECKING:
    import trimesh

Kind = Literal["box", "capsule"]
# A box or a capsule: its kind, its size [m] and the bytes of its pose, as of a `gripper.RobotPart`.
SolidKey = tuple[Kind, tuple[float, ...], bytes]


def cloud_of(
    solids: tuple[SolidKey, ...], front: float, fine: float, count: int, distance: float, seed: int
) -> Float[np.ndarray, "{count} 3"]:
    """The points, float32 [m]; kept on disk, see `runtime.kept_arrays`.

    Args:
      solids: in one frame.
      front, fine: where z is above the first [m], the spacing is the second, relative to that elsewhere.
      count: number of points.
      distance: length of the way along z, which ends where the solids are [m].
      seed: equal seeds give equal points.
    """
    import trimesh

    files = (Path(__file__), Path(spreading.__file__))
    source = hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
    key = repr((solids, front, fine, count, distance, seed, source, trimesh.__version__, np.__version__))
    make = functools.partial(_cloud, solids, front, fine, count, distance, seed)
    return kept_arrays("cloud", key, lambda: {"points": make()})["points"]


def _cloud(
    solids: tuple[SolidKey, ...], front: float, fine: float, count: int, distance: float, seed: int
) -> Float[np.ndarray, "{count} 3"]:
    import trimesh

    hulls = [_swept_hull(*solid, distance) for solid in solids]
    areas = np.array([hull.mesh.area for hull in hulls])
    shares = np.ceil(12 * count * areas / areas.sum()).astype(int) + 50
    candidates = np.concatenate(
        [
            _outside(trimesh.sample.sample_surface(hull.mesh, share, seed=seed + i)[0], hulls[:i] + hulls[i + 1 :])
            for i, (hull, share) in enumerate(zip(hulls, shares, strict=True))
        ]
    )
    spacing = np.where(candidates[:, 2] > front, fine, 1.0)
    return candidates[_spread(candidates, spacing, count)].astype(np.float32)


def mesh_of(kind: Kind, size: tuple[float, ...], pose: np.ndarray) -> trimesh.Trimesh:
    """A primitive's surface; a capsule's facets lie at most half a percent of its radius beneath it."""
    import trimesh

    if kind == "box":
        mesh = trimesh.creation.box(extents=2 * np.array(size))
    else:
        radius, half = size
        mesh = trimesh.creation.capsule(height=2 * half, radius=radius, count=[32, 32])
        mesh.apply_translation((0.0, 0.0, -mesh.bounds.mean(axis=0)[2]))
    return mesh.apply_transform(pose)


class _Hull(NamedTuple):
    """A convex mesh, and its faces and bounds as plain arrays: trimesh checks its own for changes at every access."""

    mesh: trimesh.Trimesh
    normals: np.ndarray
    offsets: np.ndarray
    low: np.ndarray
    high: np.ndarray


@functools.cache
def _swept_hull(kind: Kind, size: tuple[float, ...], pose: bytes, distance: float) -> _Hull:
    """The convex hull of a primitive, given by hashable fields, and of its copy `distance` back along z.

    Cached, because only link 6 differs between the angles of joint 7.
    """
    import trimesh

    mesh = mesh_of(kind, size, np.frombuffer(pose).reshape(4, 4))
    hull = trimesh.convex.convex_hull(np.concatenate([mesh.vertices, mesh.vertices - (0.0, 0.0, distance)]))
    normals, centres, bounds = (np.array(a) for a in (hull.face_normals, hull.triangles_center, hull.bounds))
    return _Hull(hull, normals, np.sum(normals * centres, axis=-1), bounds[0], bounds[1])


def _outside(points: np.ndarray, hulls: list[_Hull]) -> np.ndarray:
    """The points that are not inside any of the convex hulls, to a tenth of a millimetre."""
    points = np.array(points)
    for hull in hulls:
        inside = np.all((points > hull.low) & (points < hull.high), axis=-1)
        inside[inside] = np.max(points[inside] @ hull.normals.T - hull.offsets, axis=-1, initial=-np.inf) <= -1e-4
        points = points[~inside]
    return points


def _spread(points: np.ndarray, spacing: np.ndarray, count: int) -> np.ndarray:
    """Indices of `count` points by farthest-point sampling, with distances relative to the spacing; the first is the
    one with the largest z."""
    x, y, z = np.array(points.T, order="C")
    scale = spacing**2
    distance, square = np.empty(len(points)), np.empty(len(points))

    # Column by column and in place, for this takes most of a cloud's time.
    def from_point(last: int) -> np.ndarray:
        np.subtract(x, x[last], out=distance)
        np.multiply(distance, distance, out=distance)
        for axis in (y, z):
            np.subtract(axis, axis[last], out=square)
            np.multiply(square, square, out=square)
            np.add(distance, square, out=distance)
        return np.divide(distance, scale, out=distance)

    return farthest_points(count, int(np.argmax(points[:, 2])), from_point)
