"""The target as the planner's images and scenes hold it: as a body of superquadrics, in depth images, as points, and as
the space that it sweeps on a straight way out.

A box or a cylinder is one superquadric everywhere. A compound is a body of superquadric parts among the objects, but
its own images and points are those of its exact pieces: they decide where it can still be.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mechsearch_jax.geometry import superquadric
from mechsearch_jax.geometry.bodies import placed_parts
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import make, transform
from mechsearch_jax.shapes import solid
from mechsearch_jax.workspace import render
from mechsearch_jax.workspace.camera import Camera, pixel_rays
from mechsearch_jax.workspace.target import Target

if TYPE_CHECKING:
    from scipy.spatial import ConvexHull

# Arrays of JAX or NumPy.
Numbers = Any
# Multiple of the points on a swept target of several pieces that are drawn, since most are in other pieces' ways.
SPARE = 4
# Of so many faces of a hull one is looked at first.
FACES = 16


def body_at(
    target: Target,
    position: Float[Numbers, "*batch 3"],
    rotation: Float[Numbers, "*batch 3 3"],
    valid: Bool[Numbers, "*batch"],
) -> Superquadrics:
    """The target at poses in the world, with the given leading axes; with `parts` if it is a compound.

    A compound's own superquadric is a box about its centre of mass that contains it.
    """
    parts = None

    def constant(row: Any) -> Array:
        if isinstance(row, jax.Array):
            return jnp.broadcast_to(row, (*valid.shape, *row.shape))
        return jnp.asarray(np.broadcast_to(row, (*valid.shape, *row.shape)))

    if target.is_compound:
        rows: Any = (constant(row) for row in target.data.parts)
        parts = Superquadrics(*rows)
    return Superquadrics(
        size=constant(_half_size(target)),
        exponents=constant(np.array(target.exponents, np.float32)),
        position=position,
        rotation=rotation,
        valid=valid,
        parts=parts,
    )


def main_body(
    target: Target,
    position: Float[Numbers, "*batch 3"],
    rotation: Float[Numbers, "*batch 3 3"],
    valid: Bool[Numbers, "*batch"],
) -> Superquadrics:
    """One superquadric that is in the target, where bodies of parts do not count: a compound's largest part.

    Args:
      target, position, rotation, valid: as of `body_at`.
    """
    body = body_at(target, position, rotation, valid)
    if not target.is_compound:
        return body
    largest = jnp.argmax(jnp.prod(jnp.asarray(target.data.parts[0]), axis=1))
    axis = len(valid.shape)
    return jax.tree.map(lambda a: jnp.take(a, largest, axis=axis), placed_parts(body))


def window_image(
    camera: Camera, target: Target, T_world_target: Float[Array, "4 4"], window: tuple[int, int]
) -> render.Window:
    """Depth of a target at a pose in a window of fixed size around its image, see `render.object_window`.

    Args:
      camera: the camera at the window's resolution.
      target: static.
      T_world_target: its pose.
      window: rows and columns; static.
    """
    box = box_around(target, T_world_target)
    if not target.is_compound:
        return render.object_window(camera, box, window)
    corner, stride = render.window_place(camera, box, window)
    rows, columns = jnp.meshgrid(jnp.arange(window[0]), jnp.arange(window[1]), indexing="ij")
    middle = (stride - 1) / 2.0
    along = pixel_rays(camera, rows * stride + corner[0] + middle, columns * stride + corner[1] + middle)
    R, offset = T_world_target[:3, :3], jnp.array(camera.position) - T_world_target[:3, 3]
    origin = [jnp.reshape(sum(offset[j] * R[j, i] for j in range(3)), (1, 1)) for i in range(3)]
    local = [sum(along[..., j] * R[j, i] for j in range(3)) for i in range(3)]
    return render.Window(target.data.cut(origin, local), corner, stride)


def _half_size(target: Target) -> Any:
    """Half-extents [m], float32."""
    return target.data.half_size if target.is_compound else np.array(target.half_size, np.float32)


def extent(target: Target) -> tuple[Float[Numbers, " 3"], Float[Numbers, " 3"]]:
    """The middle of the smallest box around the target along its axes, and its half-extents [m], float32."""
    if target.is_compound:
        return target.data.middle, target.data.half
    return np.zeros(3, np.float32), _half_size(target)


def framed(target: Target, T_world_target: Float[Array, "*batch 4 4"]) -> Float[Array, "*batch 4 4"]:
    """Poses of the box of `extent` from the target's; for a box or a cylinder they are the same."""
    if not target.is_compound:
        return T_world_target
    middle = transform(T_world_target[..., None, :, :], jnp.asarray(extent(target)[0])[None])[..., 0, :]
    return make(T_world_target[..., :3, :3], middle)


def box_around(target: Target, T_world_target: Float[Array, "4 4"]) -> Superquadrics:
    """The box of `extent` at a pose of the target, or the target itself if it is one superquadric."""
    T_world_box = framed(target, T_world_target)
    return Superquadrics(
        size=jnp.float32(extent(target)[1]),
        exponents=jnp.float32(target.exponents),
        position=T_world_box[:3, 3],
        rotation=T_world_target[:3, :3],
        valid=jnp.array(True),
    )


def surface_cloud(target: Target, count: int) -> Float[np.ndarray, "n 3"]:
    """`count` points on the surface of the target, in its own frame [m]."""
    if target.compound is None:
        sample = jax.jit(superquadric.sample_surface, static_argnames="count")
        half = np.array(target.half_size, np.float32)
        return np.asarray(sample(half, np.array(target.exponents, np.float32), count=count))
    points = solid.surface(target.compound, count).astype(np.float32)
    # As many for every target, so that all share their programs.
    return points[np.arange(count) % len(points)]


def swept_target(target: Target, direction: np.ndarray, distance: float, count: int, erosion: float) -> np.ndarray:
    """Surface of the volume that the target sweeps along a direction, in its own frame, shape (count, 3) [m]."""
    import trimesh
    from scipy.spatial import ConvexHull

    way = distance * np.asarray(direction)
    if target.compound is None:
        (mesh,) = target.solid.hulls(erosion)
        hull = trimesh.convex.convex_hull(np.concatenate([mesh.vertices, mesh.vertices + way]))
        return np.asarray(trimesh.sample.sample_surface(hull, count, seed=0)[0], np.float32)
    hulls = [ConvexHull(np.concatenate([corners, corners + way])) for corners in _corners(target, erosion)]
    # Points in other hulls are not on the surface; those that are left are spread evenly.
    shares = np.ceil(SPARE * count * np.array([hull.area for hull in hulls]) / sum(hull.area for hull in hulls))
    drawn = [_drawn(hull, int(share), i) for i, (hull, share) in enumerate(zip(hulls, shares, strict=True))]
    outside = [_outside(points, hulls[:i] + hulls[i + 1 :]) for i, points in enumerate(drawn)]
    points = np.concatenate(outside)
    if len(points) < count:
        points = np.concatenate([points, *drawn])
    return np.asarray(points[np.random.default_rng(0).permutation(len(points))[:count]], np.float32)


@functools.lru_cache(maxsize=16)
def _corners(target: Target, erosion: float) -> tuple[Float[np.ndarray, "n 3"], ...]:
    """The corners of the shrunk solids [m]; must not be changed."""
    return tuple(np.asarray(mesh.vertices) for mesh in target.solid.hulls(erosion))


def _drawn(hull: ConvexHull, count: int, seed: int) -> Float[np.ndarray, "{count} 3"]:
    """Points on the surface of a convex hull [m]."""
    import trimesh

    # Much faster than `trimesh.convex.convex_hull`, whose faces all turn the same way, which does not count here.
    surface = trimesh.Trimesh(hull.points, hull.simplices, process=False)
    return np.asarray(trimesh.sample.sample_surface(surface, count, seed=seed)[0])


def _outside(points: Float[np.ndarray, "n 3"], hulls: list[ConvexHull]) -> Float[np.ndarray, "m 3"]:
    """The points that are in none of several convex hulls [m]."""
    inside = np.zeros(len(points), bool)
    for hull in hulls:
        left = np.flatnonzero(~inside)
        # A few faces tell most points that are outside.
        for faces in (hull.equations[::FACES], hull.equations):
            left = left[np.all(points[left] @ faces[:, :3].T + faces[:, 3] < -1e-4, axis=1)]
        inside[left] = True
    return points[~inside]
