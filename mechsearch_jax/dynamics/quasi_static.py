"""The analytic push model: objects yield to the gripper and to each other without inertia."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array

from mechsearch_jax.dynamics.contacts import (
    deepest,
    pair_contacts,
    point_depth,
    pusher_contacts,
    pusher_depth,
    unresolved,
    wall_depth,
)
from mechsearch_jax.dynamics.push_model import LEVERAGE, LOW_CONTACT, PushOutcome
from mechsearch_jax.dynamics.rigid import rigid_motion
from mechsearch_jax.geometry.footprints import TOUCH, dot, extents, footprints, in_world, turned
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import transform
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.shelf import Shelf


def _yield_to(prints, depth, normal, arm, heading, friction):
    """Move footprints out of contacts as quasi-static sliders under an ellipsoidal limit surface.

    A force f at `arm` from the centre moves the slider by f and turns it by (arm x f) / c^2, with c, the ratio of
    torque to force, that of a uniform pressure distribution: 0.6 of the footprint's half diagonal. The contact sticks,
    and the point at `arm` follows `heading` until it has given way by `depth` along `normal`, if the force for that is
    inside the friction cone; otherwise it slides, with the force on the cone's edge (Lynch and Mason, one contact).
    """
    c2 = 0.36 * dot(prints.half, prints.half)
    side = jnp.stack([-arm[..., 1], arm[..., 0]], axis=-1)
    advance = dot(heading, normal)
    follows = advance > 0.2
    target = jnp.where(follows[..., None], heading / jnp.where(follows, advance, 1.0)[..., None], normal)
    force = target - side * (dot(side, target) / (c2 + dot(side, side)))[..., None]
    tangent = jnp.stack([-normal[..., 1], normal[..., 0]], axis=-1)
    along, across = dot(force, normal), dot(force, tangent)
    sticks = jnp.abs(across) <= friction * along
    edge = normal + friction * jnp.where(across < 0, -1.0, 1.0)[..., None] * tangent
    given = dot(normal, edge) + dot(normal, side) * dot(side, edge) / c2
    edge = edge / jnp.maximum(given, 0.1)[..., None]
    force = jnp.where(sticks[..., None], force, edge) * jnp.maximum(depth, 0.0)[..., None]
    # Turning a disc does not change its footprint.
    turn = jnp.where(prints.round, 0.0, dot(side, force) / c2)
    return prints.replace(position=prints.position + force, yaw=prints.yaw + jnp.clip(turn, -0.2, 0.2))


def _resolve_pusher(prints, points, heading, friction):
    depth, away, arm = pusher_contacts(prints, points)
    heading = jnp.broadcast_to(heading, away.shape)
    return _yield_to(prints, depth, away, arm, heading, friction)


def _touched_high(scene, prints, points, heading, leverage):
    """Which objects are touched so high above the board that a push along `heading` topples them."""
    shapes = in_world(prints)
    local = turned(-shapes.yaw[:, None], points[None, :, :2] - shapes.position[:, None, :])
    depth = point_depth(shapes.half[:, None, :], shapes.round[:, None], local)
    level = (points[None, :, 2] > shapes.low[:, None]) & (points[None, :, 2] < shapes.high[:, None])
    touching = level & (depth > -TOUCH) & shapes.valid[:, None]
    if prints.parts is not None:
        touching = jnp.any(touching.reshape(*prints.parts.valid.shape, -1), axis=1)
    lowest = jnp.min(jnp.where(touching, points[None, :, 2], jnp.inf), axis=1) - prints.low
    half = extents(scene, jnp.append(heading, 0.0)[:, None])[:, 0]
    limit = jnp.where(prints.round, leverage[1], leverage[0]) * half
    # 5 mm more than planned pushes are allowed, since only the last pose of the gripper is checked.
    return jnp.any(touching, axis=1) & (lowest > jnp.maximum(limit, LOW_CONTACT) + 0.005)


def _resolve_neighbours(prints, heading, friction):
    """Objects further along the push yield to those behind them."""
    depth, direction, arm = pair_contacts(prints)
    along = dot(prints.position[None] - prints.position[:, None], heading[None, None])
    depth = jnp.where(along > 0, depth, -1.0)
    i = jnp.argmax(depth, axis=0)
    j = jnp.arange(prints.valid.size)
    return _yield_to(prints, depth[i, j], direction[i, j], arm[i, j], direction[i, j], friction)


def _resolve_walls(shelf, prints):
    inward = jnp.array([[-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    depth, outline = wall_depth(shelf, prints)
    depth, points = deepest(jnp.swapaxes(depth, -1, -2), outline[:, None])
    depth = jnp.where(prints.valid[:, None], depth, -1.0)
    for wall in range(3):
        point = points[:, wall]
        direction = jnp.broadcast_to(inward[wall], point.shape)
        prints = _yield_to(prints, depth[:, wall], direction, point - prints.position, direction, 0.0)
    return prints


@dataclasses.dataclass(frozen=True)
class QuasiStatic:
    """An analytic `PushModel`: the gripper moves in small steps, and the objects in its way yield.

    Objects are planar footprints that slide under an ellipsoidal limit surface without inertia. Objects pushed
    backwards by others are neglected, and only objects that the gripper itself touches too high topple.

    Attributes:
      steps: number of steps of the gripper.
      sweeps: how often contacts are resolved in each step.
      gripper_friction, object_friction: coefficients at contacts with the gripper and between objects.
      leverage: how high the gripper may touch an object without toppling it; see `LEVERAGE`.
      max_penetration: a push with more residual penetration is not resolved [m].

    Raises:
      InputError: `max_penetration` is negative.
    """

    steps: int = 16
    sweeps: int = 2
    gripper_friction: float = 0.8
    object_friction: float = 0.4
    leverage: tuple[float, float] = LEVERAGE
    max_penetration: float = 0.006

    def __post_init__(self):
        if not self.max_penetration >= 0.0:
            raise InputError(f"QuasiStatic: max_penetration {self.max_penetration} m must not be negative")

    def __call__(
        self, shelf: Shelf, scene: Superquadrics, pusher: Array, T_world_gripper: Array, displacement: Array, q7: Array
    ) -> PushOutcome:
        """See `PushModel`."""
        start = transform(T_world_gripper, pusher)
        length = jnp.sqrt(jnp.maximum(jnp.sum(displacement**2), 1e-12))
        heading = displacement[:2] / length

        def step(prints, points):
            for _ in range(self.sweeps):
                prints = _resolve_pusher(prints, points, heading, self.gripper_friction)
                prints = _resolve_walls(shelf, _resolve_neighbours(prints, heading, self.object_friction))
            return prints, prints

        before = footprints(scene)
        fraction = (jnp.arange(self.steps) + 1.0) / self.steps
        points = start[None] + fraction[:, None, None] * displacement[None, None]
        after, stages = jax.lax.scan(step, before, points)
        # The gripper would pass through a jammed object, so the deepest penetration of all steps counts.
        held = jnp.max(jax.vmap(pusher_depth)(jax.vmap(in_world)(stages), points)[0])
        residual = jnp.maximum(held, unresolved(shelf, before, after, points[-1]))
        turn = after.yaw - before.yaw
        moved = (jnp.abs(turn) > 1e-3) | (jnp.max(jnp.abs(after.position - before.position), axis=-1) > 1e-4)
        moved_scene = rigid_motion(scene, before.position, after.position, turn)
        pick = lambda new, old: jnp.where(moved.reshape(-1, *[1] * (new.ndim - 1)), new, old)  # noqa: E731
        scene = jax.tree.map(pick, moved_scene, scene)
        high = _touched_high(scene, after, start + displacement[None], heading, self.leverage)
        return PushOutcome(scene, moved, residual, residual <= self.max_penetration, jnp.where(high, 1.0, 0.0))
