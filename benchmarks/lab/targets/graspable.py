"""Whether the planner can grasp a target of any shape wherever physics can.

A mesh stands upright, alone on the board. The planner's side: of the grasps of a found target those that arm and shelf
allow, and whether one of those that it would try takes the target out in a trial. Physics: whether any of many
antipodal grasps, drawn from the mesh's surface without the planner's knowledge, takes it out in the same trial.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import zlib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mechsearch_jax.actions import Action
from mechsearch_jax.actions.kinds.retrieve import retrieve_action
from mechsearch_jax.benchmarks.lab.targets.antipodal import Approaches, gripper_poses, lines
from mechsearch_jax.benchmarks.running.evaluate import present_code
from mechsearch_jax.benchmarks.statistics.intervals import share_interval
from mechsearch_jax.envs.trials.native import NativeTrials, TrialSetup
from mechsearch_jax.envs.trials.nearby import Perturbations
from mechsearch_jax.envs.world.world import TARGET
from mechsearch_jax.geometry.superquadric import Superquadrics, empty
from mechsearch_jax.geometry.transforms import upright_pose
from mechsearch_jax.grasping.graspability import is_grasp
from mechsearch_jax.grasping.retrieval import GraspChoice, TargetGrasps, found_grasps, target_grasps, top_grasps
from mechsearch_jax.planner.trials import TrialResult, TrialScenes
from mechsearch_jax.problem.settings import Settings
from mechsearch_jax.robot.entry import ways_in
from mechsearch_jax.robot.motion import MotionConfig
from mechsearch_jax.runtime.errors import InputError, check_once
from mechsearch_jax.runtime.versions import versions
from mechsearch_jax.shapes.compound import centred
from mechsearch_jax.workspace.scenario import parse_compound
from mechsearch_jax.workspace.target import DENSITY, FRICTION, Target

# Where targets stand: x and y [m], as objects of generated scenes.
PLACES = ((0.45, 0.73), (-0.18, 0.38))
# How much narrower than the gripper's opening a drawn grasp is [m], and its largest angle between the line of the
# fingers and the surface's normal: that of the fingers' friction [rad].
CLEARANCE, CONE = 0.004, math.radians(45)
# Angles of joint 7 that are drawn for each grasp, within these [rad]; the arm has the first that it can follow.
WRISTS, Q7 = 8, (-2.8, 2.8)
# Grasps whose ways in are computed together.
AT_ONCE = 50


@dataclasses.dataclass(frozen=True)
class GivenMesh:
    """A mesh file, the name by which results call it, and its unit [m]."""

    name: str
    file: Path
    scale: float = 1.0


@dataclasses.dataclass(frozen=True)
class TargetRow:
    """A mesh at one pose.

    Attributes:
      mesh: its name.
      x, y, yaw: where it stands [m, rad].
      grasps: number of grasps that the planner knows for the target; 0 if the gripper fits nowhere.
      feasible: how many of them arm and shelf allow at the pose.
      tried: how many of these were tried.
      planner: whether one of them takes the target out.
      drawn: number of antipodal grasps, up to the first that succeeds.
      executed: how many of them were executed, since the arm can follow them.
      physics: whether one of them takes the target out.
      grasp: of that one: yaw, tilt, and roll about the approach [degrees]; how high above the board the fingers close,
        and the distance between them [mm]; None without one.
    """

    mesh: str
    x: float
    y: float
    yaw: float
    grasps: int
    feasible: int
    tried: int
    planner: bool
    drawn: int
    executed: int
    physics: bool
    grasp: list[float] | None = None

    @property
    def fault(self) -> str:
        """Why the planner does not take the target out."""
        if self.planner:
            return "none"
        if not self.feasible:
            return "no grasp is feasible" if self.grasps else "no grasp is known"
        return "no tried grasp succeeds"


class Mesh(NamedTuple):
    """A mesh as the target that it is taken for, and its surface in the target's frame."""

    target: Target
    surface: Any


def load(given: GivenMesh) -> Mesh:
    """Read a mesh: as a target in the way of `Target.from_mesh`, and its own surface.

    Raises:
      InputError: as `Target.from_mesh`.
    """
    import trimesh

    value = {"mesh": str(given.file), "scale": given.scale, "density": DENSITY, "friction": FRICTION}
    compound = parse_compound(value, (), f"{given.file}: target", Path())
    target = Target.of_compound(compound)
    surface: Any = trimesh.load(str(given.file), force="mesh", process=True)
    surface.apply_scale(given.scale)
    surface.apply_translation(-centred(compound)[1])
    return Mesh(target, surface)


@jax.jit
def _planned(
    grasps: TargetGrasps, scene: Superquadrics, pose: Float[Array, "3"]
) -> tuple[Bool[Array, " f"], GraspChoice]:
    """Which grasps of a target are feasible at a pose, and those that are worth trying."""
    found = found_grasps(grasps, grasps.standing(pose))
    return found.feasible, top_grasps(grasps, scene, pose)


@functools.partial(jax.jit, static_argnames=("config",))
def _follows(
    T_world_gripper: Float[Array, "g 4 4"], q7: Float[Array, "g w"], config: MotionConfig
) -> Bool[Array, "g w"]:
    """Whether the arm can follow the way in of a retrieval with each angle of joint 7."""

    def follows(T, q7):
        return ways_in(T, q7, config.gripper, config.waypoints - 1, config.waypoints)[1]

    return jax.vmap(jax.vmap(follows, (None, 0)))(T_world_gripper, q7)


@dataclasses.dataclass(frozen=True)
class TargetsBench:
    """The comparison.

    Attributes:
      meshes: what is grasped; names differ.
      poses: of each.
      grasps: antipodal ones at each pose, at most.
      seed: of poses and grasps.
      settings: of shelf, gripper, and the planner's grasps of a found target.
      approaches: of the antipodal grasps.

    Raises:
      InputError: there are no meshes, or two have the same name.
    """

    meshes: Sequence[GivenMesh]
    poses: int = 3
    grasps: int = 1000
    seed: int = 0
    settings: Settings = dataclasses.field(default_factory=Settings)
    approaches: Approaches = dataclasses.field(default_factory=Approaches)

    def __post_init__(self):
        if not self.meshes:
            raise InputError("lab targets: there are no meshes; name files, or make some with --things")
        check_once("lab targets: two meshes", (mesh.name for mesh in self.meshes))

    @functools.cached_property
    def trials(self) -> NativeTrials:
        """What judges both sides: no scenes nearby, since the place is known exactly."""
        return NativeTrials(nearby=Perturbations(scenes=0))

    def run(self, on_progress: Callable[[list[TargetRow]], None] = lambda rows: None) -> list[TargetRow]:
        """The rows of all meshes.

        Args:
          on_progress: called with the rows so far, after each mesh.

        Raises:
          InputError: a mesh cannot be a target.
        """
        rows: list[TargetRow] = []
        for given in self.meshes:
            rows += self.rows(given)
            on_progress(rows)
        return rows

    def rows(self, given: GivenMesh) -> list[TargetRow]:
        """The rows of a mesh.

        Raises:
          InputError: it cannot be a target.
        """
        mesh = load(given)
        mesh.target.check_fits(self.settings.workcell.shelf)
        # The same poses and grasps, whatever other meshes there are.
        rng = np.random.default_rng([self.seed, zlib.crc32(given.name.encode())])
        poses = np.column_stack(
            [*(rng.uniform(*bounds, self.poses) for bounds in PLACES), rng.uniform(-math.pi, math.pi, self.poses)]
        )
        if mesh.target.solid.round:
            # As images and scenes have it: the planner knows its grasps about +x only.
            poses[:, 2] = 0.0
        cell, config = self.settings.workcell, self.settings.config.problem.retrieval
        try:
            known = target_grasps(cell.shelf, cell.gripper, mesh.target, config)
        except InputError:
            known = None
        rows = []
        for pose in poses:
            where = {name: round(float(v), 4) for name, v in zip(("x", "y", "yaw"), pose, strict=True)}
            pose = np.array(list(where.values()), np.float32)
            planner = {"grasps": 0, "feasible": 0, "tried": 0, "planner": False}
            if known is not None:
                planner = self._by_planner(mesh.target, known, pose)
            rows.append(TargetRow(given.name, **where, **planner, **self._in_physics(mesh, pose, rng)))
        return rows

    def _by_planner(self, target: Target, known: TargetGrasps, pose: Float[np.ndarray, " 3"]) -> dict[str, Any]:
        """The planner's fields of a row."""
        feasible, choices = jax.device_get(_planned(known, empty(1), jnp.asarray(pose)))
        results = self._tried(target, pose, choices.action, np.asarray(choices.feasible))
        return {
            "grasps": int(is_grasp(known.tables.T_target_gripper).sum()),
            "feasible": int(feasible.sum()),
            "tried": len(results),
            "planner": TrialResult.SUCCEEDED in results,
        }

    def _in_physics(self, mesh: Mesh, pose: Float[np.ndarray, " 3"], rng: np.random.Generator) -> dict[str, Any]:
        """The fields of a row that physics decides."""
        gripper, shelf = self.settings.workcell.gripper, self.settings.workcell.shelf
        T_world_mesh = np.array(upright_pose(jnp.asarray(pose), mesh.target.height(shelf)), float)
        # About many lines no allowed approach is drawn.
        found = lines(mesh.surface, 4 * self.grasps, gripper.max_opening - CLEARANCE, CONE, rng)
        T, line = gripper_poses(found, T_world_mesh, self.approaches, rng)
        T, line = T[: self.grasps].astype(np.float32), line[: self.grasps]
        q7 = rng.uniform(*Q7, (len(T), WRISTS)).astype(np.float32)
        executed = 0
        for start in range(0, len(T), AT_ONCE):
            part = np.arange(start, min(start + AT_ONCE, len(T)))
            able, results = self._executed(mesh.target, pose, T[part], q7[part])
            executed += len(results)
            if TrialResult.SUCCEEDED in results:
                first = int(np.flatnonzero(able)[len(results) - 1])
                grasp = _described(T[start + first], float(found.width[line[start + first]]), float(shelf.board))
                return {"drawn": start + first + 1, "executed": executed, "physics": True, "grasp": grasp}
        return {"drawn": len(T), "executed": executed, "physics": False, "grasp": None}

    def _executed(
        self, target: Target, pose: Float[np.ndarray, " 3"], T: Float[np.ndarray, "k 4 4"], q7: Float[np.ndarray, "k w"]
    ) -> tuple[Bool[np.ndarray, " k"], list[int]]:
        """Which grasps the arm can follow, and the results of these up to the first success."""
        gripper = self.settings.workcell.gripper
        # All have one size, so that nothing is compiled twice.
        rows = np.resize(np.arange(len(T)), AT_ONCE)
        motion = dataclasses.replace(self.trials.simulation.motion, gripper=gripper)
        follows: np.ndarray = np.asarray(_follows(T[rows], q7[rows], motion))[: len(T)]
        wrist = q7[np.arange(len(T)), follows.argmax(axis=1)]
        opening = np.full(len(T), gripper.max_opening, np.float32)
        able = np.asarray(follows.any(axis=1))
        actions = retrieve_action(*map(jnp.asarray, (T, wrist, opening)))
        return able, self._tried(target, pose, actions, able)

    def _tried(
        self, target: Target, pose: Float[np.ndarray, " 3"], actions: Action, wanted: Bool[np.ndarray, " k"]
    ) -> list[int]:
        """Results of the wanted actions in order, up to the first that succeeds."""
        cell = TrialSetup(target, self.settings.workcell.shelf, self.settings.workcell.gripper)
        objects, one = jax.tree.map(lambda a: jnp.asarray(a)[None], empty(TARGET)), jnp.ones(1)
        scenes = TrialScenes(objects, jnp.asarray(pose)[None], jnp.ones(1, bool), one, one)
        row = jax.tree.map(lambda a: np.asarray(a)[None], jax.device_get(actions))
        results = self.trials.in_cell(cell, scenes, row, wanted[None])[0][wanted].tolist()
        end = results.index(TrialResult.SUCCEEDED) + 1 if TrialResult.SUCCEEDED in results else len(results)
        return results[:end]


def _described(T_world_gripper: Float[np.ndarray, "4 4"], width: float, board: Any) -> list[float]:
    """`TargetRow.grasp`."""
    R = T_world_gripper[:3, :3].astype(float)
    yaw, tilt = math.atan2(R[1, 2], R[0, 2]), math.asin(float(np.clip(-R[2, 2], -1.0, 1.0)))
    roll = math.asin(float(np.clip(R[2, 1], -1.0, 1.0)))
    height = float(T_world_gripper[2, 3]) - float(board)
    return [
        *(round(math.degrees(angle), 1) for angle in (yaw, tilt, roll)),
        round(1e3 * height, 1),
        round(1e3 * width, 1),
    ]


def summary(rows: Sequence[TargetRow]) -> dict[str, Any]:
    """Of the poses where physics takes a mesh out, the share where the planner does, with an interval over meshes."""
    able = [row for row in rows if row.physics]
    share = sum(row.planner for row in able) / len(able) if able else None
    interval = share_interval([row.planner for row in able], [row.mesh for row in able]) if able else None
    return {
        "meshes": len({row.mesh for row in rows}),
        "poses": len(rows),
        "physics": len(able),
        "both": sum(row.planner for row in able),
        "share": share if share is None else round(share, 4),
        "interval": None if interval is None else [round(bound, 4) for bound in interval],
        "planner_alone": sum(row.planner for row in rows if not row.physics),
        "faults": dict(Counter(row.fault for row in able if not row.planner)),
    }


def by_mesh(rows: Sequence[TargetRow]) -> dict[str, dict[str, Any]]:
    """The `summary` of each mesh."""
    return {name: summary([row for row in rows if row.mesh == name]) for name in dict.fromkeys(r.mesh for r in rows)}


def about(bench: TargetsBench) -> dict[str, Any]:
    """What a result depends on beside the meshes."""
    return {
        "code": present_code(),
        "versions": versions(),
        "poses": bench.poses,
        "grasps": bench.grasps,
        "seed": bench.seed,
        "approaches": dataclasses.asdict(bench.approaches),
        "scales": {mesh.name: mesh.scale for mesh in bench.meshes},
    }


def value(bench: TargetsBench, rows: Sequence[TargetRow]) -> Mapping[str, Any]:
    """The head of a result file."""
    return {**about(bench), "summary": summary(rows), "meshes": by_mesh(rows)}
