"""Random scenarios as in the paper's appendix C.2: objects are dropped on the shelf, then the target is hidden."""

from __future__ import annotations

import copy
import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.spatial import ConvexHull

from mechsearch_jax.envs.camera.simulated_camera import pixels_in_windows, target_pixels, window_of
from mechsearch_jax.envs.simulators.native import NativeWorld
from mechsearch_jax.envs.simulators.simulator import SimulatorConfig
from mechsearch_jax.envs.world.world import from_scenario
from mechsearch_jax.geometry.transforms import upright_pose
from mechsearch_jax.grasping.config import GraspConfig
from mechsearch_jax.grasping.graspability import GraspTables, candidate_grasps, feasible_grasps, grasp_tables
from mechsearch_jax.problem.settings import Settings
from mechsearch_jax.robot.gripper import Gripper
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.shapes import shape_of
from mechsearch_jax.shapes.compound import surface_points
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.object_sizes import ObjectSizes
from mechsearch_jax.workspace.scenario import MAX_OBJECTS, Body, Scenario, rotation_matrix
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

# Shapes and half-extents of the paper's eleven objects; x and y of those that are not round may be swapped.
CATALOGUE = ObjectSizes().catalogue
# Poses of the target that are looked at in one call, first at one in so many rows and columns of the image.
BLOCK, STRIDE = 64, 4
# Draws an object, as it stands with its centre above the origin of a board at z 0.
DrawBody = Callable[[np.random.Generator], Body]


@dataclasses.dataclass(frozen=True)
class GeneratorConfig:
    """How scenarios are made.

    Attributes:
      drop: height above the board from which objects are dropped [m].
      gap: least distance between dropped objects, and between the target and its neighbours, seen from above [m].
      visible: a target is hidden if it shows at most this many pixels; the detector needs more than 100.
      anywhere: whether the target may stand anywhere in the rectangle that its candidate positions span, a box at any
        yaw, instead of at candidate poses only.
      drift: a scene is at rest if no body moves farther than this once the target is in place [m].
      placements: number of places drawn for an object before the scene is discarded.
      target_placements: number of poses drawn for a target that may stand anywhere, or that is a compound.
      attempts: number of scenes drawn for one seed.
    """

    drop: float = 0.02
    gap: float = 0.002
    visible: int = 0
    anywhere: bool = False
    drift: float = 1e-3
    placements: int = 200
    target_placements: int = 800
    attempts: int = 200

    def __post_init__(self):
        if not (self.drop >= 0 and self.gap >= 0 and self.visible >= 0 and self.drift > 0):
            raise InputError("GeneratorConfig: drop, gap and visible must be at least 0, and drift above 0")
        if min(self.placements, self.target_placements, self.attempts) < 1:
            raise InputError("GeneratorConfig: placements, target_placements and attempts must be at least 1")


def outline(body: Body) -> Float[np.ndarray, "corners 2"]:
    """A convex polygon that contains the body seen from above [m]."""
    if body.compound is not None:
        corners = surface_points(body.compound)
    else:
        rim = shape_of(body.shape).rim(body.half_size)
        corners = np.concatenate([np.insert(rim, 2, z, axis=1) for z in (-body.half_size[2], body.half_size[2])])
    flat = (corners @ rotation_matrix(body.quaternion).T + np.array(body.position))[:, :2]
    return flat[ConvexHull(flat).vertices]


def separation(first: Float[np.ndarray, "n 2"], second: Float[np.ndarray, "m 2"]) -> float:
    """The widest gap between two convex polygons along a normal of one of their sides [m]; negative if they overlap."""
    sides = np.concatenate([np.roll(p, -1, axis=0) - p for p in (first, second)])
    normals = np.stack([sides[:, 1], -sides[:, 0]], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    a, b = first @ normals.T, second @ normals.T
    return float(np.max(np.maximum(a.min(axis=0) - b.max(axis=0), b.min(axis=0) - a.max(axis=0))))


def _on_board(polygon: np.ndarray, shelf: Shelf, gap: float) -> bool:
    low, high = polygon.min(axis=0), polygon.max(axis=0)
    inner = np.array([shelf.front, shelf.right + gap]), np.array([shelf.back - gap, shelf.left - gap])
    return bool((low >= inner[0]).all() and (high <= inner[1]).all())


def _approaching(gripper: Gripper | None) -> Gripper:
    """A gripper that enters by the straight approach alone: everywhere counts as outside.

    The scene of a seed must not change, and scenes were generated with this check. An approximation: one in 750 of the
    default target's candidate poses can be approached but not reached from outside the shelf.
    """
    return dataclasses.replace(gripper or Gripper(), outside=(math.inf,))


@functools.cache
def graspable_alone(shelf: Shelf, target: Target, gripper: Gripper | None = None) -> Bool[np.ndarray, " x"]:
    """Whether the target alone on the shelf is graspable, at each of its candidate poses; read-only.

    See `_approaching`.
    """
    tables = candidate_grasps(shelf, _approaching(gripper), target, GraspConfig())
    graspable = np.zeros(len(tables.T_world_target), bool)
    graspable[np.asarray(tables.pair_pose)] = True
    graspable.setflags(write=False)
    return graspable


def graspable_at(shelf: Shelf, target: Target, gripper: Gripper | None = None) -> Callable[[np.ndarray], bool]:
    """A function of a pose (x, y [m], yaw [rad]): whether the target alone on the shelf is graspable there.

    See `_approaching`.
    """
    gripper = _approaching(gripper)
    tables = grasp_tables(gripper, target, GraspConfig())
    return lambda pose: bool(_any_grasp(tables, shelf, gripper, target, jnp.asarray(pose, jnp.float32)))


@functools.partial(jax.jit, static_argnames=("gripper", "target"))
def _any_grasp(
    tables: GraspTables, shelf: Shelf, gripper: Gripper, target: Target, pose: Float[Array, " 3"]
) -> Bool[Array, ""]:
    T_world_target = upright_pose(pose, target.height(shelf))
    return jnp.any(feasible_grasps(tables, shelf, gripper, GraspConfig(), T_world_target[None]))


class _DroppingWorld(NativeWorld):
    """A world in which friction gives way a little and does not act against rolling, as when the scene sets were
    recorded: poses to the micrometre, and with them all recorded scenes, depend on it."""

    def _model_for(self, bodies: list[Body | None]) -> Any:
        model = copy.copy(super()._model_for(bodies))
        model.opt.impratio, model.geom_condim[:] = 10.0, 4
        return model


def check_numbers(seed: int, objects: int) -> None:
    """Raises an InputError where the seed is negative, or the number of surrounding objects does not fit."""
    if not 1 <= objects <= MAX_OBJECTS:
        raise InputError(f"objects: {objects} is not between 1 and {MAX_OBJECTS}")
    if seed < 0:
        raise InputError(f"seed: {seed} is negative; use a whole number from 0")


class ScenarioGenerator:
    """Makes scenarios; the same seed gives the same scenario on the same machine.

    Attributes:
      target, config: as given.
    """

    def __init__(
        self,
        target: Target | None = None,
        shelf: Shelf | None = None,
        camera: Camera | None = None,
        config: GeneratorConfig | None = None,
        graspable: Callable[[Float[np.ndarray, " 3"]], bool] | None = None,
        gripper: Gripper | None = None,
        draw: DrawBody | None = None,
    ):
        """Args:
        target: the target to hide; the usual one by default.
        shelf, camera: the scene.
        config: how scenarios are made.
        graspable: whether the target alone on the shelf is graspable at a pose (x, y [m], yaw [rad]); by default
          `graspable_alone`, or `graspable_at` if the target may stand anywhere.
        gripper: of the robot; the default gripper if None.
        draw: draws the objects; the paper's if None.

        Raises:
          InputError: objects would be dropped beside the board, or the target is taller than the shelf.
        """
        self.target = target or Target()
        self.config = config or GeneratorConfig()
        self._shelf = shelf or Shelf()
        self.target.check_fits(self._shelf)
        self._camera = camera or Camera()
        self._draw = draw or draws_from(ObjectSizes())
        for name, low, high in (("x", self._shelf.front, self._shelf.back), ("y", self._shelf.right, self._shelf.left)):
            spawn = getattr(self._shelf, f"spawn_{name}")
            if not (spawn[0] < high and spawn[1] > low):
                raise InputError(f"Shelf: spawn_{name} {spawn} is beside the board, which reaches from {low} to {high}")
        self._simulator = _DroppingWorld(self._shelf, self._camera, SimulatorConfig(settle_block=50))
        self._poses = self.target.candidate_poses(self._shelf).astype(float)
        if self.config.anywhere:
            self._graspable = graspable or graspable_at(self._shelf, self.target, gripper)
        else:
            if graspable is None:
                allowed = graspable_alone(self._shelf, self.target, gripper)
            else:
                allowed = map(graspable, self._poses)
            self._poses = self._poses[np.array([*allowed], bool)]
            self._graspable = lambda pose: True

    @classmethod
    def of(cls, settings: Settings, target: str | Target | None = None) -> ScenarioGenerator:
        """The generator that a configuration file describes.

        Args:
          settings: of the workcell and the objects in it.
          target: the name of a shape, of the usual size, or a target, instead of the settings' own.

        Raises:
          InputError: there is no such shape, or as the constructor.
        """
        cell = settings.workcell
        chosen = cell.target
        if isinstance(target, Target):
            chosen = chosen.like(target)
        elif target is not None and target != chosen.shape:
            chosen = chosen.like(Target.of(target))
        return cls(chosen, cell.shelf, cell.camera, gripper=cell.gripper, draw=draws_from(settings.objects))

    def generate(self, seed: int, objects: int, name: str | None = None) -> Scenario:
        """A scenario whose bodies rest on the board, with a target that the detector does not see.

        Args:
          seed: any whole number from 0.
          objects: number of surrounding objects.
          name: of the scenario; made from the other two by default.

        Raises:
          InputError: the seed is negative, the number of objects does not fit, or no place hides a graspable target.
        """
        check_numbers(seed, objects)
        if not len(self._poses):
            raise InputError(
                "Target: the arm reaches it nowhere on the board with a grasp that fits it; use a smaller one"
            )
        name = name or f"generated-{objects}-{seed}"
        rng = np.random.default_rng([seed, objects])
        for _ in range(self.config.attempts):
            scene = self._drop(rng, objects, name)
            hidden = scene and self._hide(rng, scene)
            if hidden:
                return hidden
        raise InputError(
            f"{name}: no graspable place is hidden in {self.config.attempts} scenes; try another seed, or more objects"
        )

    def _drop(self, rng: np.random.Generator, objects: int, name: str) -> Scenario | None:
        """Objects at rest on the board, and the target wherever it does not touch them."""
        dropped: list[Body] = []
        outlines: list[np.ndarray] = []
        for _ in range(objects):
            drawn = self._draw(rng)
            for _ in range(self.config.placements):
                body = self._placed(rng, drawn)
                polygon = outline(body)
                clear = all(separation(polygon, other) > self.config.gap for other in outlines)
                if clear and _on_board(polygon, self._shelf, self.config.gap):
                    dropped.append(body)
                    outlines.append(polygon)
                    break
            else:
                return None
        self._simulator.reset(Scenario(name, tuple(dropped), self._target_at(np.array([-2.0, 0.0, 0.0]))))
        outcome = self._simulator.settle()
        at_rest = outcome.settled and not outcome.fallen[:objects].any()
        return self._simulator.scenario(name) if at_rest else None

    def _placed(self, rng: np.random.Generator, body: Body) -> Body:
        """A body that stands on a board at z 0, above a random place, at a random yaw."""
        x, y = rng.uniform(*self._shelf.spawn_x), rng.uniform(*self._shelf.spawn_y)
        yaw = rng.uniform(-np.pi, np.pi)
        height = self._shelf.board + body.position[2] + self.config.drop
        turn = (np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2))
        return dataclasses.replace(body, position=(x, y, height), quaternion=turn)

    def _target_at(self, pose: np.ndarray) -> Body:
        x, y, yaw = (float(p) for p in pose)
        turn = (round(float(np.cos(yaw / 2)), 9), 0.0, 0.0, round(float(np.sin(yaw / 2)), 9))
        height = float(self.target.height(self._shelf))
        place = round(x, 6), round(y, 6), round(height, 6)
        return Body(self.target.shape, self.target.half_size, place, turn, self.target.compound)

    def _hide(self, rng: np.random.Generator, scene: Scenario) -> Scenario | None:
        """The scene with the target at a random hidden pose; None if no drawn pose is hidden, graspable and stable."""
        outlines = [outline(body) for body in scene.objects]
        for pose in self._not_in_sight(scene, self._drawn_poses(rng)):
            candidate = dataclasses.replace(scene, target=self._target_at(pose))
            polygon = outline(candidate.target)
            if any(separation(polygon, other) <= self.config.gap for other in outlines):
                continue
            if self.is_hidden(candidate) and self._graspable(pose) and self.is_at_rest(candidate):
                return candidate
        return None

    def _not_in_sight(self, scene: Scenario, poses: Float[np.ndarray, "n 3"]) -> Iterator[Float[np.ndarray, " 3"]]:
        """The poses without those at which already a few of the image's rays show more pixels than a hidden target.

        `is_hidden` follows 16 times as many rays, one pose after the other, and hardly ever holds at a random pose.
        """
        world = from_scenario(scene)
        window = window_of(self._camera, world)
        for start in range(0, len(poses), BLOCK):
            block = poses[start : start + BLOCK]
            # The last block is filled up with its last pose, so that all have a program in common.
            filled = np.concatenate([block, np.repeat(block[-1:], BLOCK - len(block), axis=0)])
            targets = [self._target_at(pose) for pose in filled]
            places = np.array([target.position for target in targets], np.float32)
            turns = np.stack([rotation_matrix(target.quaternion) for target in targets]).astype(np.float32)
            seen = pixels_in_windows(self._camera, world, jnp.asarray(places), jnp.asarray(turns), window, STRIDE)
            yield from block[np.asarray(seen)[: len(block)] <= self.config.visible]

    def _drawn_poses(self, rng: np.random.Generator) -> Float[np.ndarray, "n 3"]:
        """Random poses for the target, in the order in which they are tried."""
        if not self.config.anywhere:
            # A compound has many more yaw angles than a box.
            tries = len(self._poses) if self.target.compound is None else self.config.target_placements
            return rng.permutation(self._poses)[:tries]
        low, high = self._poses.min(axis=0), self._poses.max(axis=0)
        # A cylinder looks the same from all sides, a box as after half a turn.
        low[2], high[2] = 0.0, self.target.turn if self.target.yaws > 1 else 0.0
        return rng.uniform(low, high, (self.config.target_placements, 3))

    def is_hidden(self, scene: Scenario) -> bool:
        """Whether a scene's target shows no more pixels than `GeneratorConfig.visible`."""
        return int(target_pixels(self._camera, from_scenario(scene))) <= self.config.visible

    def is_at_rest(self, scene: Scenario) -> bool:
        """Whether a scene's bodies stay at rest and its target hidden in simulation."""
        before = np.asarray(self._simulator.reset(scene).position)
        outcome = self._simulator.settle()
        world = self._simulator.world
        still = world is not None and bool(np.abs(np.asarray(world.position) - before).max() <= self.config.drift)
        return bool(outcome.settled) and still and self.is_hidden(self._simulator.scenario(scene.name))


def draws_from(sizes: ObjectSizes) -> DrawBody:
    """A function that draws one of some boxes and cylinders."""
    return functools.partial(_draw_shape, catalogue=sizes.catalogue)


def _draw_shape(rng: np.random.Generator, catalogue: Sequence[Any]) -> Body:
    name, (x, y, z) = catalogue[int(rng.integers(len(catalogue)))]
    swapped = not shape_of(name).round and rng.random() < 0.5
    return Body(name, (y, x, z) if swapped else (x, y, z), (0.0, 0.0, z), (1.0, 0.0, 0.0, 0.0))
