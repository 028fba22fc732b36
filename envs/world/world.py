"""The true state of the shelf: every body's shape and pose, in fixed slots, and what compounds are made of."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Float
from scipy.spatial import HalfspaceIntersection
from scipy.spatial.transform import Rotation

from mechsearch_jax.geometry.bodies import bodies_of as of_parts
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.pytree import PyTreeNode, static
from mechsearch_jax.shapes import PRIMITIVES, Shape, in_order, shape_of
from mechsearch_jax.shapes.compound import (
    COMPOUND,
    CONVEX,
    CONVEX_CODE,
    MOST_SOLIDS,
    MOST_VERTICES,
    Compound,
    Piece,
    faces,
    half_extents,
    inertial,
    solids,
)
from mechsearch_jax.shapes.parts import part_rows
from mechsearch_jax.workspace.scenario import MAX_OBJECTS, Body, Scenario, pieces_of, rotation_matrix
from mechsearch_jax.workspace.target import Target

# Most faces of a convex polyhedron: triangles between its vertices.
FACES = 2 * MOST_VERTICES - 4
# What fills unused rows of arrays [m].
_NOTHING = 1e-3
TARGET = MAX_OBJECTS
BODIES = MAX_OBJECTS + 1
# A target that leans further than this has fallen over [rad].
MAX_TILT = math.radians(15)
# Steps of `CompoundTarget.room` [m].
ROOM = 0.02


class Solids(PyTreeNode):
    """The solids of bodies, in the bodies' frames; leading axes (..., 9, 16).

    Attributes:
      kind: code of a primitive, or `CONVEX_CODE`, int32.
      half_size: half-extents along a primitive's axes [m], shape (..., 9, 16, 3).
      position: of the centre [m], shape (..., 9, 16, 3).
      rotation: `R_body_solid`, shape (..., 9, 16, 3, 3).
      faces: half-spaces of a convex polyhedron, rows (n, d) with n . x <= d in its frame; none in a world without
        such, shape (..., 9, 16, F, 4).
      valid: whether the row holds a solid.
    """

    kind: jax.Array
    half_size: jax.Array
    position: jax.Array
    rotation: jax.Array
    faces: jax.Array
    valid: jax.Array


class Matter(PyTreeNode):
    """What bodies are made of; leading axes (..., 9).

    Attributes:
      mass: [kg].
      moments: principal moments of inertia [kg m2], shape (..., 9, 3).
      axes: rotation of the principal axes in the body's frame, shape (..., 9, 3, 3).
      friction: coefficient of sliding friction.
      density: [kg/m3].
      colour: red, green and blue, 0 to 1; NaN where the colour is the slot's, shape (..., 9, 3).
    """

    mass: jax.Array
    moments: jax.Array
    axes: jax.Array
    friction: jax.Array
    density: jax.Array
    colour: jax.Array


class Compounds(PyTreeNode):
    """What a `World` of compounds knows beside a plain one.

    Attributes:
      compound: which bodies are compounds, shape (..., 9); the others have a single solid.
      solids: of all bodies.
      matter: of all bodies.
      parts: the superquadrics that describe each body to the planner, in its frame, leading axes (..., 9, 4).
    """

    compound: jax.Array
    solids: Solids
    matter: Matter
    parts: Superquadrics


def compounds_of(bodies: Sequence[Body | None]) -> Compounds:
    """What the bodies in a world's slots are made of.

    Args:
      bodies: in their slots; None for an empty one.

    Raises:
      InputError: a plain body is of a shape that is no primitive.
    """
    made = [None if body is None else pieces_of(body) for body in bodies]
    wide = any(piece.shape == CONVEX for one in made if one for piece in one.pieces)
    rows = [_body_solids(one, FACES if wide else 0) for one in made]
    return Compounds(
        compound=jax.device_put(np.array([body is not None and body.compound is not None for body in bodies])),
        solids=_stacked(rows),
        matter=_stacked([_matter(one) for one in made]),
        parts=_stacked([_parts(one) for one in made]),
    )


def _stacked(trees: Sequence[Any]) -> Any:
    return jax.tree.map(lambda *leaves: jax.device_put(np.stack(leaves)), *trees)


@functools.lru_cache(maxsize=1024)
def _body_solids(compound: Compound | None, sides: int) -> Any:
    """The rows of a body's solids, as a `Solids` of NumPy arrays, which must not be changed."""
    rows = [] if compound is None else solids(compound.pieces)
    half = np.full((MOST_SOLIDS, 3), _NOTHING, np.float32)
    kind, position = np.zeros(MOST_SOLIDS, np.int32), np.zeros((MOST_SOLIDS, 3), np.float32)
    rotation = np.tile(np.eye(3, dtype=np.float32), (MOST_SOLIDS, 1, 1))
    planes = np.zeros((MOST_SOLIDS, sides, 4), np.float32)
    for i, solid in enumerate(rows):
        position[i], rotation[i] = solid.position, solid.rotation
        if solid.shape == CONVEX:
            own = faces(solid)
            kind[i], half[i] = CONVEX_CODE, np.abs(np.array(solid.vertices)).max(axis=0)
            planes[i] = own[np.minimum(np.arange(sides), len(own) - 1)]
        else:
            kind[i], half[i] = PRIMITIVES[solid.shape].code, solid.half_size
    return Solids(kind, half, position, rotation, planes, np.arange(MOST_SOLIDS) < len(rows))  # pyright: ignore


@functools.lru_cache(maxsize=1024)
def _matter(compound: Compound | None) -> Any:
    if compound is None:
        numbers = (_NOTHING, [_NOTHING] * 3, np.eye(3), 0.0, 1.0, [np.nan] * 3)
    else:
        weight, colour = inertial(compound), compound.colour or [np.nan] * 3
        numbers = (weight.mass, weight.moments, weight.rotation, compound.friction, compound.density, colour)
    return Matter(*(np.asarray(value, np.float32) for value in numbers))  # pyright: ignore[reportArgumentType]


@functools.lru_cache(maxsize=1024)
def _parts(compound: Compound | None) -> Any:
    return Superquadrics(*part_rows(compound))  # pyright: ignore[reportArgumentType]


def body_of(host: Compounds, slot: int, pose: tuple[Sequence[float], Sequence[float]]) -> Body:
    """A compound in a slot, made again of what a world knows of it.

    Frustums come back as their discs.

    Args:
      host: as NumPy arrays, without further leading axes.
      slot: of a compound.
      pose: position [m] and quaternion (w, x, y, z).
    """
    rows: Any = jax.tree.map(lambda leaf: np.asarray(leaf)[slot], host.solids)
    pieces = tuple(_piece(jax.tree.map(lambda leaf, i=i: leaf[i], rows)) for i in np.flatnonzero(rows.valid))
    matter: Any = jax.tree.map(lambda leaf: np.asarray(leaf)[slot], host.matter)
    colour = None if np.isnan(matter.colour).any() else tuple(float(c) for c in matter.colour)
    compound = Compound(pieces, float(matter.density), float(matter.friction), colour)  # pyright: ignore
    return body_at(compound, pose)


def body_at(compound: Compound, pose: tuple[Sequence[float], Sequence[float]]) -> Body:
    """The body of a compound at a pose: position [m] and quaternion (w, x, y, z)."""
    position, quaternion = (tuple(float(v) for v in values) for values in pose)
    return Body(COMPOUND, half_extents(compound), position, quaternion, compound)  # pyright: ignore


def _piece(row: Any) -> Piece:
    """The piece of a single row of `Solids`."""
    quaternion = tuple(Rotation.from_matrix(row.rotation).as_quat(scalar_first=True).tolist())
    position = tuple(row.position.tolist())
    if row.kind != CONVEX_CODE:
        name = list(PRIMITIVES)[row.kind]
        return Piece(name, tuple(row.half_size.tolist()), position, quaternion)
    halves = np.column_stack([row.faces[:, :3], -row.faces[:, 3]]).astype(float)
    corners: Float[np.ndarray, "n 3"] = np.unique(
        np.round(HalfspaceIntersection(halves, np.zeros(3)).intersections, 7), axis=0
    )
    vertices = tuple((x, y, z) for x, y, z in corners.tolist())
    return Piece(CONVEX, (0.0, 0.0, 0.0), position, quaternion, vertices)


def with_polyhedra(compounds: Compounds) -> Compounds:
    """The same with room for convex polyhedra, so that worlds with and without such can be stacked."""
    shape = compounds.solids.faces.shape
    if shape[-2]:
        return compounds
    room = jax.device_put(np.zeros((*shape[:-2], FACES, 4), np.float32))
    return dataclasses.replace(compounds, solids=dataclasses.replace(compounds.solids, faces=room))


def fallen_over(rotation: Float[np.ndarray, "3 3"], ends_alike: bool = True) -> bool:
    """Whether a target with this `R_world_target` has fallen over; one with `Solid.ends_alike` stands on either end."""
    upright = abs(rotation[2, 2]) if ends_alike else rotation[2, 2]
    return bool(upright < math.cos(MAX_TILT))


@dataclasses.dataclass(frozen=True)
class CompoundTarget:
    """A target that is a compound, as a world knows it; equal for targets with the same room.

    Attributes:
      room: half-extents of a box that has room for it, in steps of `ROOM` [m].
      made_of: the target; no program depends on it, and it is not for use inside of one.
    """

    room: tuple[float, float, float]
    made_of: Compound = dataclasses.field(compare=False)


class World(PyTreeNode):
    """All bodies on the shelf. Arrays have the leading axes (..., 9): eight slots for objects, then the target.

    Attributes:
      kind: code of the body's shape (`shapes.Shape`), int32; of a compound that of the box around it.
      half_size: half-extents along the body's own axes [m], shape (..., 9, 3); of a compound those of the box about its
        centre of mass that contains it.
      position: `t_world_body` [m], shape (..., 9, 3).
      rotation: `R_world_body`, shape (..., 9, 3, 3).
      valid: whether the slot holds a body.
      compounds: what the bodies are made of; None if none is a compound, so that programs stay what they are.
      target: a target that is a compound, else None. Static: worlds side by side have the same.
    """

    kind: jax.Array
    half_size: jax.Array
    position: jax.Array
    rotation: jax.Array
    valid: jax.Array
    compounds: Compounds | None = None
    target: CompoundTarget | None = static(default=None)


def slots(scenario: Scenario) -> list[Body | None]:
    """The scenario's bodies in the order of a `World`'s slots; None for an empty slot.

    Raises:
      InputError: there are more objects than slots.
    """
    missing = MAX_OBJECTS - len(scenario.objects)
    if missing < 0:
        raise InputError(f"{scenario.name}: {len(scenario.objects)} objects are too many; at most {MAX_OBJECTS} fit")
    return [*scenario.objects, *[None] * missing, scenario.target]


def from_scenario(scenario: Scenario) -> World:
    """The world of a scenario.

    Raises:
      InputError: there are more objects than slots, or a shape that cannot stand beside compounds.
    """
    empty = Body(in_order()[0].name, (1e-3, 1e-3, 1e-3), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    bodies = slots(scenario)
    filled = [body or empty for body in bodies]
    world = World(
        kind=jax.device_put(np.array([outer_shape(b).code for b in filled], np.int32)),
        half_size=jax.device_put(np.array([b.half_size for b in filled], np.float32)),
        position=jax.device_put(np.array([b.position for b in filled], np.float32)),
        rotation=jax.device_put(np.stack([rotation_matrix(b.quaternion) for b in filled]).astype(np.float32)),
        valid=jax.device_put(np.array([b is not None for b in bodies])),
    )
    if not any(body is not None and body.compound for body in bodies):
        return world
    return _of_compounds(world, bodies)


def _of_compounds(world: World, bodies: Sequence[Body | None]) -> World:
    """A plain world as one of the compounds that the bodies in its slots are."""
    world, target = world.replace(compounds=compounds_of(bodies)), bodies[TARGET]
    if target is None or target.compound is None:
        return world
    x, y, z = (round(math.ceil(half / ROOM - 1e-6) * ROOM, 3) for half in half_extents(target.compound))
    return world.replace(target=CompoundTarget((x, y, z), target.compound))


def with_target(world: World, target: Target) -> World:
    """A world with the target's pieces, where it has the box around a target that is a compound.

    Args:
      world: fields without further leading axes.
      target: of the search.
    """
    if target.compound is None or world.target is not None:
        return world
    bodies = bodies_of(world)
    bodies[TARGET] = Body(COMPOUND, target.half_size, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), target.compound)
    return _of_compounds(world, bodies)


def outer_shape(body: Body | Target) -> Shape:
    """The shape whose code a body has in a `World`: of a compound that of the box around it."""
    return in_order()[0] if body.shape == COMPOUND else shape_of(body.shape)


def alike(worlds: Sequence[World]) -> list[World]:
    """The worlds with the same leaves, so that they can be stacked: all of compounds if one is.

    Args:
      worlds: fields without further leading axes.

    Raises:
      InputError: a body has a shape that cannot stand beside compounds.
    """
    if all(world.compounds is None for world in worlds):
        return list(worlds)
    made = [as_compounds(world) for world in worlds]
    of_all = [world.compounds for world in made if world.compounds is not None]
    if any(compounds.solids.faces.shape[-2] for compounds in of_all):
        return [world.replace(compounds=with_polyhedra(own)) for world, own in zip(made, of_all, strict=True)]
    return made


def as_compounds(world: World) -> World:
    """A world that has `compounds`; a plain body is a single solid.

    Args:
      world: fields without further leading axes.

    Raises:
      InputError: a body has a shape that cannot stand beside compounds.
    """
    return world if world.compounds is not None else _of_compounds(world, bodies_of(world))


def bodies_of(world: World) -> list[Body | None]:
    """The bodies in a world's slots; None for an empty slot.

    Args:
      world: fields without further leading axes.
    """
    host = jax.device_get(world)
    quaternions = Rotation.from_matrix(np.where(host.valid[:, None, None], host.rotation, np.eye(3))).as_quat()
    quaternions = quaternions[:, [3, 0, 1, 2]]

    def body(i: int) -> Body:
        pose = host.position[i].tolist(), quaternions[i].tolist()
        if i == TARGET and host.target is not None:
            return body_at(host.target.made_of, pose)
        if host.compounds is not None and host.compounds.compound[i]:
            return body_of(host.compounds, i, pose)
        return Body(
            in_order()[host.kind[i]].name,
            *(tuple(float(v) for v in values) for values in (host.half_size[i], host.position[i])),  # pyright: ignore
            tuple(float(v) for v in quaternions[i]),  # pyright: ignore
        )

    return [body(i) if host.valid[i] else None for i in range(BODIES)]


def superquadrics(world: World) -> Superquadrics:
    """The true superquadrics of all bodies, the target last; of a world with compounds bodies of several parts."""
    if world.compounds is not None:
        scene = of_parts(world.compounds.parts, world.position, world.rotation)
        return scene.replace(valid=scene.valid & world.valid)
    exponents = jnp.array([shape.exponents for shape in in_order()])
    return Superquadrics(world.half_size, exponents[world.kind], world.position, world.rotation, world.valid)


def plain_objects(world: World) -> World:
    """The world as a plain one, with the box around the target, if none of its objects is a compound.

    Objects of a plain world are superquadrics without parts, with which all of a planner's programs are half as large.
    Inside of programs, where it is not known which bodies are compounds, the world stays as it is.
    """
    if world.compounds is None or isinstance(world.compounds.compound, Tracer):
        return world
    objects = np.asarray(world.compounds.compound)[..., :TARGET]
    return world if objects.any() else world.replace(compounds=None, target=None)


def true_superquadrics(world: World) -> Superquadrics:
    """The true superquadrics of the objects, without the target."""
    lead = world.valid.ndim - 1
    return superquadrics(jax.tree.map(lambda leaf: leaf[(slice(None),) * lead + (slice(TARGET),)], world))
