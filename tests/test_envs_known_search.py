"""The search with everything known: what it tries, what it keeps, when it gives up, and what it says of it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from stage import BOX, HIDDEN, TWO

from mechsearch_jax import planner
from mechsearch_jax.actions import no_action, retrieve_action
from mechsearch_jax.config.config import PlannerConfig, Weights
from mechsearch_jax.envs.camera.snapshot import Snapshot, objects_on_the_board, true_target_pose
from mechsearch_jax.envs.known_target import search as known_search
from mechsearch_jax.envs.known_target.judgement import InFullView, Judgement, judge
from mechsearch_jax.envs.known_target.search import KnownSearchConfig
from mechsearch_jax.envs.simulators.native import NativeSimulator
from mechsearch_jax.envs.world.world import BODIES, from_scenario
from mechsearch_jax.geometry import superquadric
from mechsearch_jax.grasping.retrieval import GraspChoice, best_grasp, best_grasps
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner import Sequences
from mechsearch_jax.planner.rollout import present_state

SEARCH = planner.planning_policy(objective=InFullView())


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
