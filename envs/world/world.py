"""The true state of the shelf: every body's shape and pose, in fixed slots."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mechsearch_jax.envs.world.compounds import Compounds, body_at, body_of, compounds_of, with_polyhedra
from mechsearch_jax.geometry.bodies import bodies_of as of_parts
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.identity import Uncompared
from mechsearch_jax.runtime.pytree import PyTreeNode, static
from mechsearch_jax.shapes import Shape, in_order, shape_of
from mechsearch_jax.shapes.compound import COMPOUND, Compound, half_extents
from mechsearch_jax.workspace.scenario import MAX_OBJECTS, Body, Scenario, rotation_matrix
from mechsearch_jax.workspace.target import Target

TARGET = MAX_OBJECTS
BODIES = MAX_OBJECTS + 1
# A target that leans further than this has fallen over [rad].
MAX_TILT = math.radians(15)
# Steps of `TargetCompoundWorld.room` [m].
ROOM = 0.02


def fallen_over(rotation: Float[np.ndarray, "3 3"], ends_alike: bool = True) -> bool:
    """Whether a target with this `R_world_target` has fallen over; one with `Solid.ends_alike` stands on either end."""
    upright = abs(rotation[2, 2]) if ends_alike else rotation[2, 2]
    return bool(upright < math.cos(MAX_TILT))


class World(PyTreeNode):
    """All bodies on the shelf. Every field has the leading axes (..., 9): eight slots for objects, then the target.

    Attributes:
      kind: code of the body's shape (`shapes.Shape`), int32.
      half_size: half-extents along the body's own axes [m], shape (..., 9, 3).
      position: `t_world_body` [m], shape (..., 9, 3).
      rotation: `R_world_body`, shape (..., 9, 3, 3).
      valid: whether the slot holds a body.
    """

    kind: jax.Array
    half_size: jax.Array
    position: jax.Array
    rotation: jax.Array
    valid: jax.Array


class CompoundWorld(World):
    """A world of which some bodies are compounds; see `World`.

    Kind and half size of a compound are those of the box about its centre of mass that contains it.

    Attributes:
      compounds: what the bodies are made of.
    """

    compounds: Compounds


class TargetCompoundWorld(CompoundWorld):
    """A world whose target is a compound; see `CompoundWorld`.

    Attributes:
      made_of: the target. Static: worlds side by side have the same; but programs do not depend on it.
      room: half-extents of a box that has room for it, in steps of `ROOM` [m]; static.
    """

    made_of: Uncompared[Compound] = static()
    room: tuple[float, float, float] = static()

    @property
    def target(self) -> Compound:
        """What the target is made of; not for use inside of a program."""
        return self.made_of.value


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
    """The world of a scenario: a `CompoundWorld` if it has compounds, a `TargetCompoundWorld` if the target is one.

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


def _of_compounds(world: World, bodies: Sequence[Body | None]) -> CompoundWorld:
    """A plain world as one of the compounds that the bodies in its slots are."""
    fields, target = {**_fields(world), "compounds": compounds_of(bodies)}, bodies[TARGET]
    if target is None or target.compound is None:
        return CompoundWorld(**fields)
    x, y, z = (round(math.ceil(half / ROOM - 1e-6) * ROOM, 3) for half in half_extents(target.compound))
    return TargetCompoundWorld(**fields, made_of=Uncompared(target.compound), room=(x, y, z))


def with_target(world: World, target: Target) -> World:
    """A world with the target's pieces, where it has the box around a target that is a compound.

    Args:
      world: fields without further leading axes.
      target: of the search.
    """
    if target.compound is None or isinstance(world, TargetCompoundWorld):
        return world
    bodies = bodies_of(world)
    bodies[TARGET] = Body(COMPOUND, target.half_size, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), target.compound)
    return _of_compounds(world, bodies)


def outer_shape(body: Body | Target) -> Shape:
    """The shape whose code a body has in a `World`: of a compound that of the box around it."""
    return in_order()[0] if body.shape == COMPOUND else shape_of(body.shape)


def _fields(world: World) -> dict[str, Any]:
    return {name: getattr(world, name) for name in World.__dataclass_fields__}


def alike(worlds: Sequence[World]) -> list[World]:
    """The worlds with the same leaves, so that they can be stacked: all of compounds if one is.

    Args:
      worlds: fields without further leading axes.

    Raises:
      InputError: a body has a shape that cannot stand beside compounds.
    """
    if not any(isinstance(world, CompoundWorld) for world in worlds):
        return list(worlds)
    made = [as_compounds(world) for world in worlds]
    if any(world.compounds.solids.faces.shape[-2] for world in made):
        return [world.replace(compounds=with_polyhedra(world.compounds)) for world in made]
    return [*made]


def as_compounds(world: World) -> CompoundWorld:
    """A world as one of compounds; a plain body is a single solid.

    Args:
      world: fields without further leading axes.

    Raises:
      InputError: a body has a shape that cannot stand beside compounds.
    """
    if isinstance(world, CompoundWorld):
        return world
    return _of_compounds(world, bodies_of(world))


def bodies_of(world: World) -> list[Body | None]:
    """The bodies in a world's slots; None for an empty slot.

    Args:
      world: fields without further leading axes.
    """
    host = jax.device_get(world)
    quaternions = Rotation.from_matrix(np.where(host.valid[:, None, None], host.rotation, np.eye(3))).as_quat()
    quaternions = quaternions[:, [3, 0, 1, 2]]
    made = host.compounds if isinstance(host, CompoundWorld) else None

    def body(i: int) -> Body:
        pose = host.position[i].tolist(), quaternions[i].tolist()
        if i == TARGET and isinstance(host, TargetCompoundWorld):
            return body_at(host.target, pose)
        if made is not None and made.compound[i]:
            return body_of(made, i, pose)
        return Body(
            in_order()[host.kind[i]].name,
            *(tuple(float(v) for v in values) for values in (host.half_size[i], host.position[i])),  # pyright: ignore
            tuple(float(v) for v in quaternions[i]),  # pyright: ignore
        )

    return [body(i) if host.valid[i] else None for i in range(BODIES)]


def superquadrics(world: World) -> Superquadrics:
    """The true superquadrics of all bodies, the target last; of a world with compounds bodies of several parts."""
    if isinstance(world, CompoundWorld):
        scene = of_parts(world.compounds.parts, world.position, world.rotation)
        return scene.replace(valid=scene.valid & world.valid)
    exponents = jnp.array([shape.exponents for shape in in_order()])
    return Superquadrics(world.half_size, exponents[world.kind], world.position, world.rotation, world.valid)


def plain_objects(world: World) -> World:
    """The world as a plain one, with the box around the target, if none of its objects is a compound.

    Objects of a plain world are superquadrics without parts, with which all of a planner's programs are half as large.
    Inside of programs, where it is not known which bodies are compounds, the world stays as it is.
    """
    if not isinstance(world, CompoundWorld) or isinstance(world.compounds.compound, Tracer):
        return world
    objects = np.asarray(world.compounds.compound)[..., :TARGET]
    return world if objects.any() else World(**_fields(world))


def true_superquadrics(world: World) -> Superquadrics:
    """The true superquadrics of the objects, without the target."""
    lead = world.valid.ndim - 1
    return superquadrics(jax.tree.map(lambda leaf: leaf[(slice(None),) * lead + (slice(TARGET),)], world))
