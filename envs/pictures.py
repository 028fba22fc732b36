"""Pictures of the true world and of what the planner makes of it: frames of a filmstrip, maps of f and g."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import UInt8
from matplotlib.figure import Figure

from mechsearch_jax import planner
from mechsearch_jax.actions import Action, ActionKind
from mechsearch_jax.envs.episode import Moment, Recogniser, Snapshot, oracle, true_target_pose
from mechsearch_jax.envs.observation import Observation
from mechsearch_jax.envs.world import from_scenario
from mechsearch_jax.planner import PlannerConfig, Problem
from mechsearch_jax.viz.filmstrip import Frame
from mechsearch_jax.viz.maps import Maps, maps_figure
from mechsearch_jax.workspace.scenario import Scenario


def colour_image(observation: Observation) -> UInt8[np.ndarray, "h w 3"]:
    """The camera's image with 8 bits a channel."""
    return np.asarray(jnp.round(observation.colour * 255)).astype(np.uint8)


def describe_action(action: Action) -> str:
    """An action in words, for example "push object 2 by 10 cm to the left", as the robot sees it."""
    kind, i = ActionKind(int(action.kind)), int(action.object)
    if kind is ActionKind.NONE:
        return "do nothing: no action is possible"
    if kind is ActionKind.PICK_AND_PLACE:
        shift = np.asarray(action.T_world_place - action.T_world_gripper)[:2, 3]
        return f"pick object {i} and place it {100 * np.linalg.norm(shift):.0f} cm away"
    d = np.asarray(action.displacement)
    side = "to the left" if d[1] > 0 else "to the right"
    return f"push object {i} by {100 * np.linalg.norm(d):.0f} cm {side}"


def frame(moment: Moment, problem: Problem, config: PlannerConfig) -> Frame:
    """A step of an episode, ready to be drawn."""
    record, belief, observation = moment.record, moment.belief, moment.snapshot.observation
    nowhere = np.zeros(problem.poses.shape[0], bool)
    retrieves = record.action is not None and record.action.kind == "retrieve"
    if moment.plan is not None:
        deed = describe_action(moment.plan.action)
        why = f"cost {record.cost:.0f} → {record.predicted_cost:.0f} expected, best of {record.sequences} sequences"
    else:
        deed = "take the target out" if retrieves else "give up"
        why = "a grasp that hits nothing is known" if retrieves else "no actions are left"
    known = "target found" if record.found else f"target can be at {record.belief_size} poses"
    outcome = f" · {record.failure}" if record.failure else ""
    return Frame(
        title=f"{moment.index + 1}  {deed}",
        caption=f"{known} · {why}{outcome}",
        image=colour_image(observation),
        owner=np.asarray(observation.segmentation),
        scene=jax.tree.map(np.asarray, moment.scene),
        existence=nowhere if record.found else np.asarray(belief.exists),
        graspability=np.asarray(planner.graspability_map(problem, belief, moment.scene, config)),
        target_pose=np.asarray(true_target_pose(moment.snapshot.world)),
        found=record.found,
        action=None if moment.plan is None else jax.tree.map(np.asarray, moment.plan.action),
        retrieval=np.asarray(moment.grasp.T_world_gripper) if retrieves and moment.grasp is not None else None,
    )


def inspect_scenario(
    scenario: Scenario, problem: Problem, config: PlannerConfig, recogniser: Recogniser = oracle, seed: int = 0
) -> tuple[Maps, Figure]:
    """Maps of f and g at the start of an episode, and their picture.

    Args:
      scenario: where everything stands.
      problem: built for the scenario's target.
      config: the planner's options.
      recogniser: what the planner sees the world through.
      seed: of the recogniser's random numbers.
    """
    snapshot = Snapshot(problem.camera, problem.shelf, from_scenario(scenario))
    scene = recogniser(jax.random.key(seed), snapshot).objects
    belief = planner.initial_belief(problem)
    belief = planner.observe_belief(problem, belief, scene, jnp.array(False), jnp.zeros(3), config)
    maps = Maps(
        poses=np.asarray(problem.poses),
        existence=np.asarray(belief.exists),
        graspability=np.asarray(planner.graspability_map(problem, belief, scene, config)),
        scene=jax.tree.map(np.asarray, scene),
    )
    observation = snapshot.observation
    figure = maps_figure(
        maps,
        colour_image(observation),
        np.asarray(observation.segmentation),
        np.asarray(true_target_pose(snapshot.world)),
        problem.camera,
        problem.shelf,
        problem.target,
        heading=scenario.name,
    )
    return maps, figure
