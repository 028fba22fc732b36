"""The closed loop: look, recognise, update the belief, decide, act; once the target can be taken out, take it out.

Two verdicts are passed on an episode, both on the true state: `graspable` (the target is in sight and a collision-free
grasp exists) and `retrieved` (the hand took it out of the shelf, and no object fell). An action that fails costs a step
and leaves the world as it made it.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Protocol, runtime_checkable

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mechsearch_jax import planner
from mechsearch_jax.actions import Action, ActionKind
from mechsearch_jax.benchmarks.rows import Row, configuration
from mechsearch_jax.envs.push_models import push_models
from mechsearch_jax.envs.records import ActionRecord, Episode, Step, record_action
from mechsearch_jax.envs.simulator import Outcome, Retrieval
from mechsearch_jax.envs.snapshot import Recogniser, Snapshot, objects_on_the_board, oracle, true_target_pose
from mechsearch_jax.envs.world import TARGET, World
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.planner import Belief, GraspChoice, Plan, PlannerConfig, Problem
from mechsearch_jax.versions import versions
from mechsearch_jax.workspace.scenario import Scenario
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

MAX_TILT = math.radians(15)
BOX_YAWS = 6


@runtime_checkable
class Simulator(Protocol):
    """What an episode needs of a simulator; `NativeSimulator` is one."""

    world: World | None

    def reset(self, scenario: Scenario) -> World: ...

    def execute(self, action: Action) -> Outcome: ...

    def retrieve(self, T_world_gripper: Array, q7: Array | float, opening: Array | float) -> Retrieval: ...


def target_of(scenario: Scenario) -> Target:
    """The target of a scenario as the planner knows it: its shape, and how finely its yaw is searched."""
    body = scenario.target
    return Target(shape=body.shape, half_size=body.half_size, yaws=BOX_YAWS if body.shape == "box" else 1)


@dataclasses.dataclass(frozen=True)
class Moment:
    """All that is known at one step, for who looks on.

    Attributes:
      index: number of actions before it.
      snapshot: what the camera sees.
      scene: the objects as recognised.
      belief: where the target can be.
      plan: the decision; None where none was needed.
      grasp: how the target is taken out; None where it cannot be.
      record: what is written down; its `observed_cost` comes later.
      outcome: what the simulator said of the action or the retrieval; None before it was executed, or without one.
    """

    index: int
    snapshot: Snapshot
    scene: Superquadrics
    belief: Belief
    plan: Plan | None
    grasp: GraspChoice | None
    record: Step
    outcome: Outcome | Retrieval | None


@runtime_checkable
class Watcher(Protocol):
    """Looks on while an episode runs."""

    def busy(self, stage: str) -> None:
        """A stage begins: "recognise", "believe", "grasp", "plan" or "simulate"."""
        ...

    def decided(self, moment: Moment) -> None:
        """The robot has looked and decided, and is about to act."""
        ...

    def acted(self, moment: Moment) -> None:
        """The action is over. Also called, without an action, when the episode ends."""
        ...


class _Blind:
    def busy(self, stage: str) -> None: ...

    def decided(self, moment: Moment) -> None: ...

    def acted(self, moment: Moment) -> None: ...


class _Stopwatch:
    """Wall time of the stages of a step."""

    def __init__(self, busy: Callable[[str], None]) -> None:
        self.seconds: dict[str, float] = {}
        self._busy = busy

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        self._busy(stage)
        start = time.perf_counter()
        yield
        self.seconds[stage] = round(time.perf_counter() - start, 4)


def run_episode(
    seed: int,
    scenario: Scenario,
    problem: Problem,
    config: PlannerConfig,
    simulator: Simulator,
    recogniser: Recogniser = oracle,
    recognition: str = "oracle",
    watcher: Watcher | None = None,
) -> Episode:
    """Run one episode to its end, whatever that is.

    Args:
      seed: of the planner's and of the environment's random numbers, which are independent of each other.
      scenario: where everything stands at the start.
      problem: built for the scenario's target.
      config: the planner's options.
      simulator: executes the actions; reset first.
      recogniser: what the planner sees the world through.
      recognition: what the record calls it.
      watcher: told of every step.

    Raises:
      InputError: the push model that `config` names cannot be used.
    """
    planner_key, environment_key = jax.random.split(jax.random.key(seed))
    models = push_models(config.push_model)
    watcher = watcher or _Blind()
    world = simulator.reset(scenario)
    belief = planner.initial_belief(problem)
    log = EpisodeLog(config)
    ended = False

    while not ended:
        clock = _Stopwatch(watcher.busy)
        snapshot = Snapshot(problem.camera, problem.shelf, world)
        with clock("recognise"):
            seen = recogniser(jax.random.fold_in(environment_key, log.index), snapshot)
            jax.block_until_ready(seen)
        with clock("believe"):
            found = jnp.asarray(seen.target_visible)
            belief = planner.observe_belief(problem, belief, seen.objects, found, seen.target_pose, config)
            jax.block_until_ready(belief)

        trouble = _target_trouble(snapshot) if belief.found else None
        grasp = decision = choice = None
        if belief.found and trouble is None:
            with clock("grasp"):
                grasp = _grasp(problem, seen.objects, belief.found_pose)
        if grasp is None and trouble is None and not log.last:
            with clock("plan"):
                key = jax.random.fold_in(planner_key, log.index)
                decision = planner.plan(key, problem, belief, seen.objects, config, *models)
                jax.block_until_ready(decision)
            choice = chosen(decision)
            trouble = distrust(choice)

        size = 1 if belief.found else int(jnp.sum(belief.exists))
        graspable = bool(belief.found) and _truly_graspable(problem, snapshot)
        index = log.index
        step = log.decide(record(bool(belief.found), size, graspable, grasp, None if trouble else choice, config))
        moment = Moment(index, snapshot, seen.objects, belief, decision, grasp, step, None)
        deed = outcome = None
        if log.acts:
            watcher.decided(moment)
            with clock("simulate"):
                deed, outcome = _act(simulator, grasp, decision)
        ended = log.act(deed, trouble, clock.seconds)
        watcher.acted(dataclasses.replace(moment, record=log.steps[-1], outcome=outcome))
        world = simulator.world or world

    return log.episode(scenario, describe(seed, problem, config, recognition, type(simulator).__name__))


def _grasp(problem: Problem, scene: Superquadrics, pose: Array) -> GraspChoice | None:
    choice = jax.block_until_ready(planner.graspable_at(problem, scene, pose))
    return choice if choice.success else None


def _truly_graspable(problem: Problem, snapshot: Snapshot) -> bool:
    """Whether a collision-free grasp of the target exists, whatever anybody believes."""
    return (
        _target_trouble(snapshot) is None
        and _grasp(problem, objects_on_the_board(snapshot), true_target_pose(snapshot.world)) is not None
    )


def _target_trouble(snapshot: Snapshot) -> str | None:
    position, rotation = snapshot.world.position[TARGET], snapshot.world.rotation[TARGET]
    return target_trouble(snapshot.shelf, np.asarray(position), np.asarray(rotation))


def target_trouble(shelf: Shelf, position: Float[np.ndarray, " 3"], rotation: Float[np.ndarray, "3 3"]) -> str | None:
    """Why a target at this pose can no longer be taken out as the planner knows it; None if it can."""
    if position[0] < shelf.front or position[2] < shelf.board:
        return "the target fell off the board"
    return "the target fell over" if abs(rotation[2, 2]) < math.cos(MAX_TILT) else None


@dataclasses.dataclass(frozen=True)
class Deed:
    """What came of a retrieval or an action.

    Attributes:
      retrieved: whether it took the target out.
      failure: why it was not carried out as planned; None if it was.
    """

    retrieved: bool
    failure: str | None

    @classmethod
    def of_action(cls, kind: int, failure: str | None) -> Deed:
        """What came of an action that the planner chose."""
        return cls(False, "no action is possible" if kind == ActionKind.NONE else failure)

    @classmethod
    def of_retrieval(cls, retrieved: bool, failure: str | None) -> Deed:
        """What came of an attempt to take the target out."""
        return cls(retrieved, failure and f"retrieval: {failure}")


def _act(simulator: Simulator, grasp: GraspChoice | None, decision: Plan | None) -> tuple[Deed, Outcome | Retrieval]:
    """Take the target out if there is a grasp, or else execute the decision."""
    if grasp is not None:
        retrieval = simulator.retrieve(grasp.T_world_gripper, grasp.q7, grasp.opening)
        return Deed.of_retrieval(retrieval.retrieved, retrieval.failure), retrieval
    assert decision is not None
    outcome = simulator.execute(decision.action)
    return Deed.of_action(int(decision.action.kind), outcome.failure), outcome


class Choice(flax.struct.PyTreeNode):
    """What `planner.plan` decided, without the sequences that it did not choose.

    Attributes:
      action, cost, predicted_cost, overflow: of the `Plan`.
      sequences: how many sequences it was chosen from.
    """

    action: Action
    cost: jax.Array
    predicted_cost: jax.Array
    sequences: jax.Array
    overflow: jax.Array


def chosen(plan: Plan) -> Choice:
    """What a plan comes down to."""
    count = jnp.sum(jnp.isfinite(plan.sequences.value))
    return Choice(plan.action, plan.cost, plan.predicted_cost, count, plan.overflow)


def distrust(choice: Choice) -> str | None:
    """Why a choice must not be acted upon; None if it may."""
    if choice.overflow:
        return "error: an object's image outgrew its window, so that f may be too small"
    numbers = [choice.cost, *jax.tree.leaves(choice.action)]
    return None if all(np.all(np.isfinite(n)) for n in numbers) else "error: the decision is not finite"


class EpisodeLog:
    """The steps of an episode that is running, and the verdicts on them.

    At every step `decide` notes what was known and decided, and then `act` what came of it.

    Attributes:
      steps: those that are over, and the one that was decided.
    """

    def __init__(self, config: PlannerConfig) -> None:
        self.steps: list[Step] = []
        self._max_steps = config.max_steps
        self._index = 0
        self._found_step: int | None = None
        self._graspable_step: int | None = None
        self._retrieved = False
        self._failure: str | None = None

    @property
    def index(self) -> int:
        """Number of the present step: how many steps came before it."""
        return self._index

    @property
    def last(self) -> bool:
        """Whether at the present step only a retrieval is allowed any more."""
        return self._index == self._max_steps

    @property
    def acts(self) -> bool:
        """Whether an action was decided upon."""
        return self.steps[-1].action is not None

    def decide(self, step: Step) -> Step:
        """Note what is known and decided at the present step."""
        if self.steps:
            self.steps[-1] = dataclasses.replace(self.steps[-1], observed_cost=step.cost)
        if step.found and self._found_step is None:
            self._found_step = self._index
        if step.graspable and self._graspable_step is None:
            self._graspable_step = self._index
        self.steps.append(step)
        return step

    def act(self, deed: Deed | None, trouble: str | None, timings: dict[str, float]) -> bool:
        """Note what came of the decision; whether the episode ends with it.

        Args:
          deed: None if nothing was done.
          trouble: why the episode cannot go on, unless it was a success; None if it can.
          timings: of the step's stages [s].
        """
        step = self.steps[-1] = dataclasses.replace(self.steps[-1], failure=deed and deed.failure, timings=timings)
        self._retrieved = deed is not None and deed.retrieved and not (trouble or "").startswith("error")
        self._failure = None if self._retrieved else trouble or _end(step, self.last)
        self._index += 1
        return self._retrieved or self._failure is not None

    def episode(self, scenario: Scenario, options: dict[str, Any]) -> Episode:
        """The record of the episode, which has ended."""
        return Episode(
            scenario=scenario.name,
            objects=len(scenario.objects),
            config=options,
            versions=versions(),
            steps=tuple(self.steps),
            found_step=self._found_step,
            graspable_step=self._graspable_step,
            retrieved=self._retrieved,
            failure=self._failure,
        )


def _end(step: Step, last: bool) -> str | None:
    """Why an episode without a retrieval ends here; None if it goes on."""
    # Trying once more would neither make the same grasp reachable nor put a fallen object back on the board.
    if step.failure in ("retrieval: unreachable", "retrieval: fallen"):
        return step.failure
    if not last:
        return None
    return step.failure or ("found, but not graspable" if step.found else "not found")


def record(
    found: bool,
    belief_size: int,
    graspable: bool,
    grasp: GraspChoice | None,
    choice: Choice | None,
    config: PlannerConfig,
) -> Step:
    """A step as it is decided: what comes of it is filled in later."""
    cost = predicted = None
    action, sequences = None, 0
    if grasp is not None:
        cost = 1.0 if config.method == "search-for-grasp" else 0.0
        T = np.asarray(grasp.T_world_gripper).tolist()
        action = ActionRecord("retrieve", None, T, [0.0, 0.0, 0.0], T, float(grasp.q7), float(grasp.opening))
    elif choice is not None:
        cost, predicted = float(choice.cost), float(choice.predicted_cost)
        action = record_action(choice.action)
        sequences = int(choice.sequences)
    return Step(
        belief_size=belief_size,
        found=found,
        graspable=graspable,
        cost=cost,
        action=action,
        predicted_cost=predicted,
        observed_cost=None,
        sequences=sequences,
        failure=None,
        timings={},
    )


def describe(seed: int, problem: Problem, config: PlannerConfig, recognition: str, simulator: str) -> dict[str, Any]:
    """The options of an episode, as its record keeps them."""
    return {
        **dataclasses.asdict(config),
        "push_distances": list(config.push_distances),
        "target": problem.target.shape,
        "recognition": recognition,
        "simulator": simulator,
        "seed": seed,
    }


def row(episode: Episode) -> Row:
    """An episode as a line of a table."""
    config = episode.config
    planning = ("recognise", "believe", "grasp", "plan")
    seconds = {name: sum(s.timings.get(name, 0.0) for s in episode.steps) for name in (*planning, "simulate")}
    return Row(
        scenario=episode.scenario,
        objects=episode.objects,
        target=config["target"],
        method=config["method"],
        recognition=config["recognition"],
        gamma=config["gamma"],
        horizon=config["horizon"],
        sequences=config["sequences"],
        actions=config["actions"],
        seed=config["seed"],
        found_step=episode.found_step,
        graspable_step=episode.graspable_step,
        retrieved=episode.retrieved,
        steps=sum(step.action is not None for step in episode.steps),
        failure=episode.failure,
        planning_seconds=sum(seconds[name] for name in planning),
        simulation_seconds=seconds["simulate"],
        configuration=configuration(config),
    )
