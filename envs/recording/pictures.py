"""Pictures of the true world and of the planner's view of it: frames of a filmstrip, maps of f and g."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import UInt8
from matplotlib.figure import Figure

from mechsearch_jax import planner
from mechsearch_jax.actions import kind_of
from mechsearch_jax.actions.kind import Sketch
from mechsearch_jax.envs.camera.simulated_camera import Image
from mechsearch_jax.envs.camera.snapshot import Recogniser, Snapshot, oracle, true_target_pose, truth_of
from mechsearch_jax.envs.episode.endings import in_words
from mechsearch_jax.envs.episode.moments import Moment
from mechsearch_jax.envs.episode.numbering import named_objects
from mechsearch_jax.envs.recording.recording import RecordedStep
from mechsearch_jax.envs.world.world import from_scenario
from mechsearch_jax.planner import Problem
from mechsearch_jax.viz.filmstrip import Frame
from mechsearch_jax.viz.maps import Maps, maps_figure
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import Scenario
from mechsearch_jax.workspace.shelf import Shelf


def colour_image(image: Image) -> UInt8[np.ndarray, "h w 3"]:
    """The camera's image with 8 bits a channel."""
    return np.asarray(jnp.round(image.colour * 255)).astype(np.uint8)


def frame(moment: Moment, problem: Problem) -> Frame:
    """A step of an episode, ready to be drawn."""
    record, belief, image = moment.record, moment.belief, moment.snapshot.image
    objects = jax.tree.map(np.asarray, moment.observation.objects)
    sketch, after, does, why = Sketch(), objects, "no action", "the search ends here"
    if moment.decision is not None and record.action is not None:
        decision, kind = moment.decision, kind_of(int(moment.decision.action.kind))
        after = jax.tree.map(np.asarray, decision.predicted)
        sketch, does = kind.sketch(objects, after, decision.action), kind.describe(decision.action, objects.capacity)
        why = "a grasp that takes it out is known"
        if not kind.takes_target:
            expected = "" if record.predicted_cost is None else f" → {record.predicted_cost:.0f} expected"
            why = f"cost {record.cost:.0f}{expected}, best of {record.sequences} sequences"
            why = why if record.compares_costs else f"one of {record.sequences} possible actions, costs not compared"
    believed = bool(belief.found)
    mistaken = "something else is taken for the target" if believed else f"target can be at {record.belief_size} poses"
    target = "target found" if record.found else mistaken
    outcome = f" · {in_words(record.failure)}" if record.failure else ""
    outcome += " · an object fell off the board" if record.fallen else ""
    nowhere = np.zeros(problem.poses.shape[0], bool)
    return Frame(
        title=f"{moment.index + 1}  {does}",
        caption=f"{target} · {why}{outcome}",
        image=colour_image(image),
        owner=np.asarray(image.segmentation),
        scene=objects,
        existence=nowhere if believed or record.found else np.asarray(belief.exists),
        graspability=np.asarray(planner.graspability_map(problem, belief, moment.observation.objects)),
        target_pose=np.asarray(true_target_pose(moment.snapshot.world)),
        found=record.found,
        after=after,
        sketch=sketch,
    )


def recorded_frame(step: RecordedStep, camera: Camera, shelf: Shelf) -> Frame:
    """A step of a recording, ready to be drawn; the camera's image is ray-cast again."""
    image = Snapshot(camera, shelf, jax.tree.map(jnp.asarray, step.world)).image
    sketch = Sketch()
    if step.action is not None:
        sketch = kind_of(int(step.action.kind)).sketch(step.scene, step.after, step.action)
    return Frame(
        title=step.title,
        caption=step.caption,
        image=colour_image(image),
        owner=np.asarray(image.segmentation),
        scene=step.scene,
        existence=step.existence,
        graspability=step.graspability,
        target_pose=step.target_pose,
        found=step.found,
        after=step.after,
        sketch=sketch,
    )


def inspect_scenario(
    scenario: Scenario, problem: Problem, recogniser: Recogniser = oracle, seed: int = 0
) -> tuple[Maps, Figure]:
    """Maps of f and g at the start of an episode, and their picture.

    Args:
      scenario: the scene.
      problem: built for the scenario's target.
      recogniser: of the planner.
      seed: of the recogniser's random numbers.
    """
    snapshot = Snapshot(problem.camera, problem.shelf, from_scenario(scenario))
    # f is shown as if the target were hidden, also where it is not.
    recognised = recogniser(jax.random.key(seed), snapshot)
    seen = recognised.replace(target_visible=jnp.array(False))
    belief = planner.update_belief(problem, planner.initial_belief(problem), seen)
    bodies = np.asarray(truth_of(recogniser, snapshot, recognised).bodies)
    maps = Maps(
        poses=np.asarray(problem.poses),
        existence=np.asarray(belief.exists),
        graspability=np.asarray(planner.graspability_map(problem, belief, seen.objects)),
        scene=jax.tree.map(np.asarray, named_objects(seen.objects, bodies)),
    )
    image = snapshot.image
    figure = maps_figure(
        maps,
        colour_image(image),
        np.asarray(image.segmentation),
        np.asarray(true_target_pose(snapshot.world)),
        problem.camera,
        problem.shelf,
        problem.target,
        heading=scenario.name,
    )
    return maps, figure
