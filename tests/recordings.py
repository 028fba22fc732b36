"""Short recorded episodes for tests: a push, a step in which nothing is done, and a retrieval; and a lost one."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from stage import HIDDEN

from mechsearch_jax.actions import ActionKind, no_action, retrieve_action
from mechsearch_jax.envs.episode.records import Episode, Step, record_action
from mechsearch_jax.envs.recording.evidence import Evidence, Forecasts
from mechsearch_jax.envs.recording.recording import RecordedStep, Recording, empty_trace
from mechsearch_jax.envs.recording.sampled import sampled
from mechsearch_jax.envs.simulators.trace import Trace
from mechsearch_jax.envs.world.world import BODIES, from_scenario, true_superquadrics
from mechsearch_jax.planner.state import Sequences
from mechsearch_jax.planner.trials import TrialResult, TriedActions, nothing_tried
from mechsearch_jax.robot.kinematics import HOME
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

WORLD = jax.tree.map(np.asarray, from_scenario(HIDDEN))
OBJECTS = jax.tree.map(np.asarray, true_superquadrics(from_scenario(HIDDEN)))
TURNED = np.asarray(HOME) + np.array([0.3, 0.1, 0.0, 0.1, 0.0, 0.0, 0.0], np.float32)
GRIPPER = jnp.array([[0, 0, 1, 0.5], [0, -1, 0, 0.05], [1, 0, 0, 0.46], [0, 0, 0, 1]], jnp.float32)
PUSH = jax.tree.map(
    np.asarray,
    no_action().replace(
        kind=jnp.int32(ActionKind.PUSH),
        T_world_gripper=GRIPPER,
        displacement=jnp.array([0.0, 0.1, 0.0]),
        T_world_place=GRIPPER.at[1, 3].add(0.1),
    ),
)
RETRIEVAL = jax.tree.map(np.asarray, retrieve_action(GRIPPER, jnp.float32(0.7), jnp.float32(0.08)))
# Two sequences of two actions, and one that found nothing to do.
FAR = PUSH.replace(displacement=2 * PUSH.displacement, T_world_place=np.asarray(GRIPPER.at[1, 3].add(0.2)))


def shifted(*shifts):
    """The objects, moved along y by each of these lengths."""
    moved = [np.asarray(OBJECTS.position) + np.array([0.0, shift, 0.0], np.float32) for shift in shifts]
    every = jax.tree.map(lambda a: np.stack([a] * len(shifts)), OBJECTS)
    return every.replace(position=np.stack(moved))


SEQUENCES = Sequences(
    actions=jax.tree.map(lambda a, b, c: np.array([[a, b], [b, c], [c, c]]), PUSH, FAR, jax.device_get(no_action())),
    cost=np.array([[90.0, 80.0], [95.0, 95.0], [np.nan, np.nan]], np.float32),
    value=np.array([-30.0, -10.0, np.inf], np.float32),
    length=np.array([2, 1, 1], np.int32),
    after=shifted(0.1, 0.2, 0.0),
)
SAMPLED = sampled(SEQUENCES)
# What a simulator does: it sets the arm to where an action begins, and home after it.
MOVES, RESTS = 1.0, 0.4


def trace(shift, returns=True):
    """The arm turns a little in front of the shelf, and the box moves meanwhile; then the arm is set home."""
    share = np.linspace(0.0, 1.0, 26)
    q = TURNED + share[:, None] * np.array([0.1, 0, 0, 0, 0, 0, 0])
    rest = 10 if returns else 0
    position = np.repeat(WORLD.position[None], 26 + rest, axis=0).astype(float)
    position[:26, 0] += share[:, None] * shift
    position[26:, 0] += shift
    still = np.tile([1.0, 0.0, 0.0, 0.0], (26 + rest, BODIES, 1))
    time = 0.04 * (1 + np.arange(26 + rest))
    return Trace(time, np.concatenate([q, np.tile(HOME, (rest, 1))]), np.full((26 + rest, 2), 0.01), position, still)


def step(title, **changes):
    poses = Target.cylinder().candidate_poses(Shelf())
    after = OBJECTS.replace(position=OBJECTS.position + np.array([0.0, 0.1, 0.0], np.float32))
    fields = {
        "title": title,
        "caption": "why",
        "found": False,
        "world": WORLD,
        "scene": OBJECTS,
        "after": after,
        "existence": poses[:, 1] > 0.2,
        "graspability": np.arange(len(poses)) % 12 - 10,
        "target_pose": np.array([0.62, 0.07, 0.0], np.float32),
        "action": PUSH,
        "trace": trace(np.array([0.0, 0.1, 0.0])),
    }
    return RecordedStep(**{**fields, **changes})


FOUND = {"found": True, "action": RETRIEVAL, "trace": trace(np.zeros(3), returns=False)}
RECORDING = Recording(
    "hidden: retrieved",
    Camera().scaled(8),
    Shelf(),
    Target.cylinder(),
    (
        step("1  push", sampled=SAMPLED),
        step("2  no action", action=None, trace=empty_trace()),
        step("3  take the target out", **FOUND),
    ),
)

POSES = len(RECORDING.steps[0].existence)
SLOTS = OBJECTS.capacity


def stacked(*actions):
    return jax.tree.map(lambda *a: np.stack([np.asarray(x) for x in a]), *actions)


def evidence(found=False, hits=((0,), (0, 2)), tried=None):
    """Evidence of a step with two candidates, where each grasp hits what is listed for it."""
    everywhere, level = np.ones((2, POSES), bool), np.ones((2, POSES), np.int32)
    table = np.array([[i in row for i in range(SLOTS)] for row in hits])
    return Evidence(
        confidence=np.where(np.asarray(OBJECTS.valid), np.float32(0.9), np.float32(0.0)),
        believed_pose=np.array([0.62, 0.07, 0.0], np.float32) if found else np.full(3, np.nan, np.float32),
        hits=table,
        forecasts=Forecasts(np.arange(2), everywhere, level, np.array([1, 2] if found else [-1, -1], np.int32)),
        tried=tried or nothing_tried(),
    )


TRIED = TriedActions(stacked(FAR, PUSH), np.array([TrialResult.HARMFUL, TrialResult.SUCCEEDED], np.int32))
STEPS = (
    dataclasses.replace(RECORDING.steps[0], evidence=evidence(tried=TRIED)),
    dataclasses.replace(RECORDING.steps[1], evidence=evidence(found=True), found=True),
)


def record(action, **changes):
    fields = {
        "belief_size": 99, "found": False, "graspable": False, "cost": 100.0, "predicted_cost": 60.0,
        "observed_cost": 95.0, "sequences": 2, "failure": None, "timings": {}, "truth_possible": True,
        "action": None if action is None else record_action(action),
    }  # fmt: skip
    return Step(**{**fields, **changes})


EPISODE = Episode(
    scenario="hidden",
    objects=1,
    config={"policy": "search-for-grasp", "recognition": "masks", "max_steps": 1, "seed": 3},
    versions={},
    steps=(record(PUSH), record(None, found=True, cost=None, predicted_cost=None, observed_cost=None)),
    found_step=1,
    graspable_step=None,
    retrieved=False,
    failure="found, but not graspable",
)
LOST = dataclasses.replace(RECORDING, heading="hidden: found after 1 action", steps=STEPS, episode=EPISODE)
