"""Checks whole trajectories of many random actions: whether they keep the limits, and a simulated arm follows them.

python -m mechsearch_jax.benchmarks.lab.parts.trajectories SCENES --out trajectories.json [--actions 500] [--speed 1.0]
"""

# The bindings of MuJoCo come without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import mujoco
import mujoco.rollout
import numpy as np
from jaxtyping import Float

from mechsearch_jax.actions import Action
from mechsearch_jax.benchmarks.lab.parts.agreement import draw_actions
from mechsearch_jax.envs.camera.snapshot import true_target_pose
from mechsearch_jax.envs.known_target.judgement import retrievals_of
from mechsearch_jax.envs.simulators.simulator import ARM, LAG, ROBOT
from mechsearch_jax.envs.world import model as models
from mechsearch_jax.envs.world.world import BODIES, from_scenario, true_superquadrics
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner import Problem, build_problem
from mechsearch_jax.robot.arm_clearance import tip_positions
from mechsearch_jax.robot.robot_trajectory import Part, RobotTrajectory
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import save_json
from mechsearch_jax.session.whole_trajectory import Setting, whole_trajectory
from mechsearch_jax.workspace.scenario import Scenario, load_scenario

# Share of retrievals among the actions; largest numbers of objects, and of retrievals, in a scene with retrievals.
RETRIEVALS, FEW_OBJECTS, PER_SCENE = 0.24, 3, 4
TRIES = 12

Case = tuple[Scenario, Action]


@dataclasses.dataclass(frozen=True)
class TrajectoryRow:
    """The trajectory of one action.

    Attributes:
      scenario, action: name of the scene, and code of the kind of action.
      refused: why there is no trajectory, or None; if refused, the fields after `seconds` are None.
      seconds: of planning the trajectory [s].
      duration, velocity, acceleration, jerk, position_margin, clearance, straight, ends_at_home: of its `Report`.
      within: whether it keeps all limits.
      tip_error: largest distance of the simulated tip from the commanded one in free motion [m].
    """

    scenario: str
    action: int
    refused: str | None
    seconds: float
    duration: float | None = None
    velocity: float | None = None
    acceleration: float | None = None
    jerk: float | None = None
    position_margin: float | None = None
    clearance: float | None = None
    straight: bool | None = None
    ends_at_home: bool | None = None
    within: bool | None = None
    tip_error: float | None = None


def draw_cases(problem: Problem, scenes: Sequence[Scenario], count: int) -> list[Case]:
    """Random possible actions of all kinds: pushes, pick-and-places, and retrievals from scenes with fewer objects.

    Raises:
      InputError: the scenes do not have so many actions.
    """
    retrievals = round(RETRIEVALS * count)
    cases = draw_actions(scenes, count - retrievals, tries=TRIES)
    retrieval_cases: list[Case] = []
    for i, scene in enumerate(scenes):
        thinned = dataclasses.replace(scene, objects=scene.objects[i % 2 :: 2][:FEW_OBJECTS])
        choice = retrievals_of(problem, from_scenario(thinned), 40)
        possible = np.flatnonzero(choice.success)
        for j in possible[:: max(1, len(possible) // PER_SCENE)][:PER_SCENE]:
            retrieval_cases.append((thinned, jax.tree.map(lambda a, j=j: a[j], choice.action)))
    if len(retrieval_cases) < retrievals:
        available = len(retrieval_cases)
        raise InputError(f"trajectories: {len(scenes)} scenes have only {available} retrievals; take more scenes")
    return cases + retrieval_cases[:retrievals]


class Follower:
    """The simulated arm in front of an empty shelf."""

    def __init__(self, setting: Setting, timestep: float):
        """Args:
        setting: of the shelf and the camera.
        timestep: of the trajectories [s].
        """
        self._model = models.compile_model(setting.shelf, setting.camera, timestep)

    def states(self, trajectory: RobotTrajectory) -> Float[np.ndarray, "steps 7"]:
        """Joint angles of the simulated arm after each step [rad]."""
        data = models.initial_state(self._model, [None] * BODIES)
        fingers = trajectory.width[:, None] / 2
        # The integrator applies the stiffness at the positions before a step: with commands for the positions after it,
        # as in `simulator.controls`, the arm is one time step ahead, 4 mm at full speed.
        velocity = np.diff(trajectory.position, axis=0) / trajectory.time[1]
        arm = trajectory.position[:-1] + LAG * velocity
        controls = np.concatenate([arm, fingers[1:], fingers[1:]], axis=1)
        data.qpos[:ARM], data.qpos[ARM:ROBOT] = trajectory.position[0], fingers[0]
        size = mujoco.mj_stateSize(self._model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        state, states = np.empty(size), np.empty((1, len(controls), size))
        mujoco.mj_getState(self._model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        mujoco.rollout.rollout(self._model, data, state[None], controls[None], state=states)
        return states[0, :, 1 : 1 + ARM]

    def tip_error(self, trajectory: RobotTrajectory) -> float:
        """Largest distance of the simulated tip from the commanded one in free motion [m]."""
        free = trajectory.part[1:] != Part.ACTION
        if not free.any():
            return 0.0
        apart = tip_positions(self.states(trajectory)[free]) - tip_positions(trajectory.position[1:][free])
        return float(np.linalg.norm(apart, axis=1).max())


def measure(setting: Setting, cases: Sequence[Case], speed: float = 1.0) -> list[TrajectoryRow]:
    """Plan and follow the trajectory of every case."""
    follower: Follower | None = None
    rows = []
    for scene, action in cases:
        world = from_scenario(scene)
        kind = int(action.kind)
        seen = np.array(kind == 3)
        observation = Observation(true_superquadrics(world), seen, true_target_pose(world))  # pyright: ignore
        begin = time.perf_counter()
        try:
            trajectory = whole_trajectory(setting, observation, action, speed=speed)
        except InputError as error:
            rows.append(TrajectoryRow(scene.name, kind, str(error), time.perf_counter() - begin))
            continue
        seconds, report = time.perf_counter() - begin, trajectory.report()
        follower = follower or Follower(setting, float(trajectory.time[1]))
        fields: dict[str, Any] = dataclasses.asdict(report)
        # No target has a place here, and rows hold numbers.
        for name in ("place_fault", "nearest", "intended"):
            del fields[name]
        tip_error = follower.tip_error(trajectory)
        rows.append(
            TrajectoryRow(scene.name, kind, None, seconds, **fields, within=report.within(), tip_error=tip_error)
        )
    return rows


def summary(rows: Sequence[TrajectoryRow]) -> dict[str, Any]:
    """Counts, highest shares and largest errors of all rows."""
    made = [row for row in rows if row.refused is None]
    numbers = ("velocity", "acceleration", "jerk", "tip_error", "duration", "seconds")
    return {
        "actions": len(rows),
        "refused": len(rows) - len(made),
        "within_limits": sum(bool(row.within) for row in made),
        "straight": sum(bool(row.straight) for row in made),
        "ends_at_home": sum(bool(row.ends_at_home) for row in made),
        **{f"{name}_max": max((getattr(row, name) for row in made), default=None) for name in numbers},
        **{f"{name}_median": float(np.median([getattr(row, name) for row in made])) for name in numbers if made},
        "position_margin_min": min(
            (row.position_margin for row in made if row.position_margin is not None), default=None
        ),
        "clearance_min": min((row.clearance for row in made if row.clearance is not None), default=None),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure as the command line says, print the summary and write all rows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", type=Path, help="folder of scenario files")
    parser.add_argument("--out", type=Path, required=True, help="JSON file for the summary and all rows")
    parser.add_argument("--actions", type=int, default=40)
    parser.add_argument("--speed", type=float, default=1.0, help="share of the joints' limits")
    options = parser.parse_args(arguments)
    scenes = [load_scenario(path) for path in sorted(options.scenes.glob("*.json"))]
    problem = build_problem()
    rows = measure(problem, draw_cases(problem, scenes, options.actions), options.speed)
    figures = summary(rows)
    save_json({"summary": figures, "rows": [dataclasses.asdict(row) for row in rows]}, options.out)
    print("\n".join(f"{name}: {value}" for name, value in figures.items()))


if __name__ == "__main__":
    main()
