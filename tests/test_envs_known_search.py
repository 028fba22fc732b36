"""The search with everything known: what it tries, what it keeps, when it gives up, and what it says of it."""

import dataclasses
from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from stage import BOX, HIDDEN, TWO

from mechsearch_jax import planner
from mechsearch_jax.actions import ActionKind, no_action, retrieve_action
from mechsearch_jax.config.config import PlannerConfig, Weights
from mechsearch_jax.envs.camera.snapshot import Snapshot, objects_on_the_board, true_target_pose
from mechsearch_jax.envs.known_target import search as known_search
from mechsearch_jax.envs.known_target.judgement import InFullView, Judgement, judge
from mechsearch_jax.envs.known_target.search import KnownSearchConfig
from mechsearch_jax.envs.simulators.native import NativeSimulator
from mechsearch_jax.envs.simulators.simulator import Simulator
from mechsearch_jax.envs.world.outcome import Failure, Outcome
from mechsearch_jax.envs.world.world import BODIES, TARGET, World, from_scenario
from mechsearch_jax.geometry import superquadric
from mechsearch_jax.grasping.retrieval import GraspChoice, best_grasp, best_grasps
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner import Sequences
from mechsearch_jax.planner.rollout import present_state
from mechsearch_jax.workspace.shelf import Shelf

SEARCH = planner.planning_policy(objective=InFullView())


@dataclasses.dataclass
class Toy(Simulator):
    """A simulator in which a push moves its object by its displacement, and a retrieval comes to what a test says.

    Attributes:
      retrieval: what comes of taking the target out.
      tilts: whether a push of the target tips it over.
    """

    retrieval: Failure = Failure.NONE
    tilts: bool = False
    pushes: int = 0
    engine: str = "Toy"
    world: World | None = None

    def replace(self, scenarios):
        raise AssertionError("a search begins with one scenario")

    def settle(self, active=None):
        raise AssertionError("a search acts; it never just lets time pass")

    def reset(self, scenarios):
        return self.load(jax.tree.map(lambda a: a[None], from_scenario(scenarios[0])))

    def load(self, world, only=None):
        self.world = world
        return world

    def execute(self, actions, active=None):
        position, rotation, count = np.array(self.world.position), np.array(self.world.rotation), len(active)
        failure, retrieved = np.zeros(count, np.int32), np.zeros(count, bool)
        for i in np.flatnonzero(active):
            if actions.kind[i] == ActionKind.RETRIEVE:
                failure[i], retrieved[i] = self.retrieval, self.retrieval is Failure.NONE
                continue
            self.pushes += 1
            body = int(actions.object[i])
            position[i, body] += actions.displacement[i]
            if body == TARGET and self.tilts:
                rotation[i, body] = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
        self.world = self.world.replace(position=jnp.asarray(position), rotation=jnp.asarray(rotation))
        fallen = np.array(self.world.valid & (self.world.position[..., 0] < Shelf().front))
        flags = {name: np.zeros(count, bool) for name in ("held", "outside")}
        return Outcome(
            failure=failure, steps=np.ones(count, np.int32), settled=np.ones(count, bool),
            restless=np.zeros_like(fallen), fallen=fallen,
            retrieved=retrieved, overflow=np.zeros(count, np.int32), tracking_error=np.zeros(count), **flags,
        )  # fmt: skip


def push(body, **displacement):
    moved = np.array([displacement.get(axis, 0.0) for axis in "xyz"], np.float32)
    return jax.device_get(
        no_action().replace(kind=jnp.int32(ActionKind.PUSH), object=jnp.int32(body), displacement=jnp.asarray(moved))
    )


def sequences(*rows):
    """Each row: value, and the actions, which are all executed."""
    longest = max(len(actions) for _, *actions in rows)
    padded = [[*actions, *[jax.device_get(no_action())] * (longest - len(actions))] for _, *actions in rows]
    stacked = [jax.tree.map(lambda *a: np.stack(a), *actions) for actions in padded]
    scene = superquadric.empty(1)
    return Sequences(
        after=jax.tree.map(lambda a: np.stack([a] * len(rows)), scene),
        actions=jax.tree.map(lambda *a: np.stack(a), *stacked),
        cost=np.zeros((len(rows), longest)),
        value=np.array([value for value, *_ in rows]),
        length=np.array([len(actions) for _, *actions in rows]),
    )


@pytest.fixture
def search(problem, monkeypatch):
    """Runs a search in which the first object is in the way of the only grasp unless its y is above 0.3 [m]."""
    config = KnownSearchConfig(simulated=8, worlds=2, rounds=6, grasps=2, max_steps=4)

    def judged(self, worlds):
        free = [world.position[0, 1] > 0.3 for world in worlds]
        return [
            Judgement(np.float32(2.0 - clear), np.array([True, False]), np.eye(2, 8, dtype=bool) & ~clear)
            for clear in free
        ]

    grasp = retrieve_action(jnp.eye(4)[None].repeat(2, 0), jnp.zeros(2), jnp.zeros(2))
    choice = jax.device_get(GraspChoice(jnp.array([True, False]), jnp.array([True, True]), jnp.array([0, 1]), grasp))
    monkeypatch.setattr(known_search._Running, "_judged", judged)
    monkeypatch.setattr(known_search, "retrievals_of", lambda problem, world, count: choice)

    def run(sampled, simulator, **changes):
        monkeypatch.setattr(known_search, "sample", lambda search, key, problem, world: sampled)
        on_round = lambda *of: run.rounds.append(of)  # noqa: E731
        return known_search.known_search(
            TWO, problem, SEARCH, simulator, dataclasses.replace(config, **changes), on_round
        )

    run.rounds = []
    return run


LEFT = push(0, y=0.1)


def test_actions_are_joined_until_the_target_is_out(search):
    simulator = Toy()
    result = search(sequences((-0.5, LEFT), (-0.1, push(1, y=0.05))), simulator)
    assert [(action.kind, action.object) for action in result.actions] == [("push", 0), ("push", 0), ("retrieve", None)]
    assert result.rounds == 2
    assert [number for number, _ in search.rounds] == [1, 2]
    assert result.retrievals == Counter({"": 1})
    assert result.simulated == simulator.pushes + 1
    assert result.best.world.position[0, 1] == pytest.approx(0.335)
    assert (result.start.judgement.least, result.best.judgement.least) == (1, 0)


def test_there_are_no_more_actions_than_allowed(search):
    for steps, solved in ((3, True), (2, False), (1, False)):
        result = search(sequences((-0.5, LEFT, LEFT, LEFT)), Toy(), max_steps=steps)
        assert (result.actions is not None) is solved
        assert len(result.best.actions) <= steps - 1
    # Where there is no room for any action, no round is spent on it.
    assert result.rounds == 0


def test_a_world_that_is_lost_is_given_up(search):
    for sampled, simulator in (
        (sequences((-0.5, push(1, x=-0.3), LEFT, LEFT)), Toy()),
        (sequences((-0.5, push(TARGET, y=0.1), LEFT, LEFT)), Toy(tilts=True)),
    ):
        result = search(sampled, simulator)
        assert result.actions is None
        # Six rounds of one push each: nothing follows one after which something has fallen.
        assert (result.simulated, result.rounds, len(result.best.actions)) == (6, 6, 0)


def test_retrievals_that_fail_are_counted_and_solve_nothing(search):
    result = search(sequences((-0.5, LEFT, LEFT)), Toy(retrieval=Failure.HELD_UP))
    assert result.actions is None
    assert set(result.retrievals) == {"the arm was held up"}
    assert result.best.graspable


def test_a_target_that_may_stand_hidden_costs_no_more_for_it(problem):
    belief = planner.initial_belief(problem).replace(found=jnp.array(True))
    at = jnp.arange(problem.poses.shape[0]) == 400
    hidden = present_state(problem, belief, superquadric.empty(8), PlannerConfig()).replace(exists=at, target_at=at)
    seen = hidden.replace(exists=jnp.zeros_like(at))
    assert [float(InFullView().cost(problem, belief, state, Weights())) for state in (seen, hidden)] == [1.0, 1.0]
    assert planner.search_for_grasp().objective.cost(problem, belief, hidden, Weights()) > 1.0


@pytest.mark.slow
def test_a_judgement_is_the_planners_own(problem):
    policy = planner.search_for_grasp(sequences=2, horizon=1)
    beside = dataclasses.replace(BOX, position=(0.62, 0.0, 0.4845))
    for scene in (HIDDEN, TWO, dataclasses.replace(TWO, objects=(BOX, beside))):
        world = from_scenario(scene)
        objects = objects_on_the_board(Snapshot(problem.camera, problem.shelf, world))
        pose = true_target_pose(world)
        judgement = jax.device_get(
            judge(problem, InFullView(), planner.PlannerConfig().weights, world, jnp.array(True))
        )
        grasp = best_grasp(problem.target_grasps, objects, pose)
        assert judgement.least == int(grasp.hits)
        seen = Observation(objects, jnp.array(True), pose)
        belief = planner.update_belief(problem, planner.initial_belief(problem), seen)
        if not grasp.success:
            decision = policy(jax.random.key(0), problem, belief, seen)
            assert float(decision.cost) == pytest.approx(float(judgement.cost))
        best = best_grasps(problem.target_grasps, objects, pose, 5)
        np.testing.assert_array_equal(best.action.T_world_gripper[0], grasp.action.T_world_gripper)
        assert (np.diff(np.asarray(best.hits)) >= 0).all()
        assert best.hits[0] == grasp.hits


@pytest.mark.slow
def test_a_hidden_target_is_taken_out(problem):
    search = planner.planning_policy(planner.PlannerConfig(sequences=4, horizon=2), objective=InFullView())
    config = KnownSearchConfig(simulated=4, worlds=1, rounds=4, grasps=2)
    result = known_search.known_search(HIDDEN, problem, search, NativeSimulator(), config)
    assert result.actions is not None
    assert result.actions[-1].kind == "retrieve"
    assert result.best.graspable
    assert result.best.world.position.shape == (BODIES, 3)
