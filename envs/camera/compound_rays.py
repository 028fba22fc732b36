"""Rays that meet the solids of compounds, in closed form."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mechsearch_jax.envs.world.world import BODIES, Solids, World
from mechsearch_jax.geometry.masked import masked_vmap
from mechsearch_jax.geometry.transforms import matmul, rotate
from mechsearch_jax.shapes import PRIMITIVES, union
from mechsearch_jax.shapes.compound import CONVEX_CODE, MOST_SOLIDS
from mechsearch_jax.workspace.camera import Camera

# Index of what is no solid.
NONE = -1
# By so much the cone of rays is taken to be wider, for rounding [rad].
VIEW_MARGIN = 1e-3
# By so much the sphere around a polyhedron is taken to be larger, for rounding.
SLACK = 1e-3
# Rays that are cut, and points whose normals are found, at once.
RAYS, POINTS = 4096, 1024


def placed(world: World) -> Solids:
    """The solids of all bodies in one row each, in the world: leading axis 144; body `i // 16` owns solid i."""
    assert world.compounds is not None
    solids = world.compounds.solids
    rotation = matmul(world.rotation[:, None], solids.rotation)
    position = rotate(world.rotation[:, None], solids.position) + world.position[:, None]
    valid = solids.valid & world.valid[:, None]
    moved = solids.replace(rotation=rotation, position=position, valid=valid)
    return jax.tree.map(lambda leaf: leaf.reshape(BODIES * MOST_SOLIDS, *leaf.shape[2:]), moved)


def cast_solids(
    camera: Camera, world: World, directions: Float[Array, "*pixels 3"]
) -> tuple[Float[Array, "*pixels"], Int[Array, "*pixels"]]:
    """Depth along each ray [m] and the index of the first solid that it hits; infinity and `NONE` where it hits none.

    Args:
      camera: where the rays start.
      world: the bodies.
      directions: of unit depth, as `pixel_rays` returns them.
    """
    solids = placed(world)
    seen = solids.valid & _in_view(camera, solids, directions)
    # The number of turns is that of the solids in sight.
    order = jnp.argsort(~seen, stable=True)

    def nearer(turn, best):
        depth, owner = best
        i = order[turn]
        candidate = _cast(camera, solids, i, directions)
        return jnp.minimum(depth, candidate), jnp.where(candidate < depth, i.astype(jnp.int16), owner)

    miss = jnp.full(directions.shape[:-1], jnp.inf, directions.dtype)
    nothing = jnp.full(directions.shape[:-1], NONE, jnp.int16)
    return jax.lax.fori_loop(0, jnp.sum(seen), nearer, (miss, nothing))


def _in_view(camera: Camera, solids: Solids, directions: Float[Array, "*pixels 3"]) -> Bool[Array, " n"]:
    """Which solids' bounding spheres reach into the cone around all rays; the others cannot be hit."""
    units = (directions / jnp.linalg.norm(directions, axis=-1, keepdims=True)).reshape(-1, 3)
    axis = jnp.mean(units, axis=0)
    axis = axis / jnp.linalg.norm(axis)
    widest = jnp.arccos(jnp.clip(jnp.min(units @ axis), -1.0, 1.0))
    away = solids.position - jnp.array([camera.position])
    distance = jnp.linalg.norm(away, axis=-1)
    radius = jnp.linalg.norm(solids.half_size, axis=-1)
    around = jnp.arccos(jnp.clip(away @ axis / distance, -1.0, 1.0)) - jnp.arcsin(jnp.minimum(radius / distance, 1.0))
    return (around <= widest + VIEW_MARGIN) | (distance <= radius)


def _cast(camera: Camera, solids: Solids, i: Array, directions: Array) -> Array:
    """Depth of a single solid along rays."""
    rotation = solids.rotation[i]
    start = jnp.array(camera.position) - solids.position[i]
    origin = [jnp.dot(rotation[:, k], start, precision="highest") for k in range(3)]
    x, y, z = (directions[..., k] for k in range(3))
    direction = [rotation[0, k] * x + rotation[1, k] * y + rotation[2, k] * z for k in range(3)]
    cuts = [partial(primitive.cut, origin, direction, solids.half_size[i], jnp) for primitive in PRIMITIVES.values()]
    if solids.faces.shape[-2]:
        radius = jnp.linalg.norm(solids.half_size[i])
        cuts.append(partial(_cut_in_reach, origin, direction, solids.faces[i], radius))
    return jax.lax.switch(solids.kind[i], cuts)


def _cut_in_reach(
    origin: list[Array], direction: list[Array], faces: Float[Array, "f 4"], radius: Float[Array, ""]
) -> Float[Array, "*pixels"]:
    """`cut_polyhedron`, computed only for rays that come within a radius of its frame's origin: few of an image's."""
    start, rays = jnp.stack(origin), jnp.stack([d.reshape(-1) for d in direction], axis=-1)
    along = jnp.sum(rays * start[None], axis=-1)
    squared = jnp.sum(start**2) - along**2 / jnp.sum(rays**2, axis=-1)
    near = squared <= ((1.0 + SLACK) * radius) ** 2

    def cut(_, body, ray):
        start, faces = body
        return cut_polyhedron(list(start), list(ray), faces)

    depth = masked_vmap(cut, near, None, (start, faces), rays, block=RAYS)
    return jnp.where(near, depth, jnp.inf).reshape(direction[0].shape)


def cut_polyhedron(origin: list[Array], direction: list[Array], faces: Float[Array, "f 4"]) -> Float[Array, "*pixels"]:
    """Where rays from outside enter a convex polyhedron; infinite for misses; see `Primitive.cut`."""

    def crossed(f, state):
        return union.crossed(faces[f, :3], faces[f, 3], origin, direction, state, jnp)

    start = jnp.full_like(direction[0], jnp.inf), jnp.zeros_like(direction[0])
    near, far = jax.lax.fori_loop(0, len(faces), crossed, start)
    return union.entry(near, far, jnp)


def solid_normals(world: World, points: Float[Array, "n 3"], solid: Int[Array, " n"]) -> Float[Array, "n 3"]:
    """Outward unit normals in the world at points on the surfaces of solids [m].

    Args:
      world: the bodies.
      points: in the world.
      solid: index of the solid of each, as of `cast_solids`; `NONE` gives any normal.
    """
    solids = placed(world)
    row = jnp.maximum(solid, 0).astype(jnp.int32)
    rotation, half = solids.rotation[row], solids.half_size[row]
    local = rotate(jnp.swapaxes(rotation, -1, -2), points - solids.position[row])
    kind = solids.kind[row][:, None]
    chosen = jnp.zeros_like(local)
    for primitive in PRIMITIVES.values():
        chosen = jnp.where(kind == primitive.code, primitive.normal(local, half, jnp), chosen)
    if solids.faces.shape[-2]:
        chosen = jnp.where(kind == CONVEX_CODE, _nearest_face(solids, row, local, solid >= 0), chosen)
    chosen = chosen / jnp.maximum(jnp.linalg.norm(chosen, axis=-1, keepdims=True), 1e-9)
    return rotate(rotation, chosen)


def _nearest_face(
    solids: Solids, row: Int[Array, " n"], local: Float[Array, "n 3"], hit: Bool[Array, " n"]
) -> Float[Array, "n 3"]:
    """The normal of the face of each point's polyhedron that it is farthest outside of; any where no polyhedron is
    hit."""

    def farthest(_, faces, point):
        local, row = point
        own = faces[row]
        height = own[:, :3] @ local - own[:, 3]
        return own[jnp.argmax(height), :3]

    on_polyhedron = hit & (solids.kind[row] == CONVEX_CODE)
    return masked_vmap(farthest, on_polyhedron, None, solids.faces, (local, row), block=POINTS)
