"""The closed loop: verdicts on the true state, failures that cost a step, and a record that says what happened."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax.envs import episode as episodes
from mechsearch_jax.envs.episode import Snapshot, oracle, run_episode, target_of
from mechsearch_jax.envs.records import load_episode, save_episode
from mechsearch_jax.envs.simulator import NativeSimulator, Outcome, Retrieval, Trace
from mechsearch_jax.envs.world import TARGET, from_scenario
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner import PlannerConfig
from mechsearch_jax.workspace.scenario import Body, Scenario

UPRIGHT = (1.0, 0.0, 0.0, 0.0)
BOX = Body("box", (0.048, 0.028, 0.08), (0.5, 0.135, 0.4845), UPRIGHT)
CYLINDER = Body("cylinder", (0.02, 0.02, 0.05), (0.62, 0.07, 0.4545), UPRIGHT)
HIDDEN = Scenario("hidden", (BOX,), CYLINDER)
OPEN = Scenario("open", (dataclasses.replace(BOX, position=(0.6, -0.2, 0.4845)),), CYLINDER)
# What `plan` compiles to is that of the default, which other tests need too.
CONFIG = PlannerConfig(max_steps=2)
TRACE = Trace(np.zeros(0), np.zeros((0, 7)), np.zeros((0, 2)), np.zeros((0, 9, 3)), np.zeros((0, 9, 4)))
STANDING = np.zeros(9, bool)


class Stage:
    """A simulator in which actions do what a test says."""

    def __init__(self, act=lambda world: world, failure=None, retrieval=None):
        self.world = None
        self.actions = []
        self._act, self._failure, self._retrieval = act, failure, retrieval

    def reset(self, scenario):
        self.world = from_scenario(scenario)
        return self.world

    def execute(self, action):
        self.actions.append(action)
        self.world = self._act(self.world)
        return Outcome(self._failure, 1, True, STANDING, TRACE)

    def retrieve(self, T_world_gripper, q7, opening):
        failure = self._retrieval
        return Retrieval(failure is None, failure is None, failure is None, failure, 1, STANDING, TRACE)


class Diary:
    def __init__(self):
        self.stages, self.decided_at, self.moments = [], [], []

    def busy(self, stage):
        self.stages.append(stage)

    def decided(self, moment):
        self.decided_at.append(moment.index)

    def acted(self, moment):
        self.moments.append(moment)


def reveal(world):
    """Put the box out of the way."""
    return world.replace(position=world.position.at[0].set(jnp.array([0.6, -0.2, 0.4845])))


def topple(world):
    lying = jnp.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    return reveal(world).replace(rotation=world.rotation.at[TARGET].set(lying))


def test_a_target_in_sight_is_taken_out_at_once(problem):
    episode = run_episode(0, OPEN, problem, CONFIG, NativeSimulator())
    assert (episode.found_step, episode.graspable_step, episode.retrieved, episode.failure) == (0, 0, True, None)
    (step,) = episode.steps
    assert (step.found, step.graspable, step.belief_size, step.sequences) == (True, True, 1, 0)
    assert step.action.kind == "retrieve"
    assert set(step.timings) == {"recognise", "believe", "grasp", "simulate"}


def test_a_search_goes_on_until_the_target_is_out(problem, tmp_path):
    diary = Diary()
    episode = run_episode(0, HIDDEN, problem, CONFIG, Stage(reveal), watcher=diary)
    assert (episode.found_step, episode.graspable_step, episode.retrieved) == (1, 1, True)
    first, second = episode.steps
    assert not first.found
    assert 1 < first.belief_size < 792
    assert first.cost > first.belief_size
    assert first.sequences >= 1
    assert first.observed_cost == second.cost == 1.0
    assert second.predicted_cost is None
    assert diary.decided_at == [0, 1]
    assert [moment.record.action.kind for moment in diary.moments][-1] == "retrieve"
    assert "plan" in diary.stages
    save_episode(episode, tmp_path / "episode.json")
    assert load_episode(tmp_path / "episode.json") == episode
    row = episodes.row(episode)
    assert (row.steps, row.objects, row.seed, row.method) == (2, 1, 0, "search-for-grasp")
    assert row.planning_seconds > 0


def test_failed_actions_cost_steps_and_nothing_is_rolled_back(problem):
    stage = Stage(failure="dropped")
    episode = run_episode(0, HIDDEN, problem, CONFIG, stage)
    assert len(stage.actions) == CONFIG.max_steps
    assert [step.failure for step in episode.steps] == ["dropped", "dropped", None]
    assert (episode.found_step, episode.graspable_step, episode.retrieved) == (None, None, False)
    assert episode.failure == "not found"
    sizes = [step.belief_size for step in episode.steps]
    assert sizes == sorted(sizes, reverse=True)


def test_a_missed_retrieval_is_tried_again_while_steps_are_left(problem):
    episode = run_episode(0, OPEN, problem, CONFIG, Stage(retrieval="missed"))
    assert [step.action.kind for step in episode.steps] == ["retrieve"] * 3
    assert (episode.graspable_step, episode.retrieved, episode.failure) == (0, False, "retrieval: missed")


def test_an_unreachable_grasp_is_not_tried_again(problem):
    episode = run_episode(0, OPEN, problem, CONFIG, Stage(retrieval="unreachable"))
    assert len(episode.steps) == 1
    assert episode.failure == "retrieval: unreachable"


def test_a_target_that_fell_over_is_found_but_not_graspable(problem):
    episode = run_episode(0, HIDDEN, problem, CONFIG, Stage(topple))
    assert (episode.found_step, episode.graspable_step, episode.retrieved) == (1, None, False)
    assert episode.failure == "the target fell over"
    assert episode.steps[-1].action is None


def test_verdicts_are_passed_on_the_truth_and_not_on_what_was_recognised(problem):
    def blind(key, snapshot):
        """Sees the target, but no object."""
        seen = oracle(key, snapshot)
        objects = seen.objects.replace(valid=jnp.zeros_like(seen.objects.valid))
        return Observation(objects, jnp.array(True), seen.target_pose)

    front = dataclasses.replace(BOX, position=(0.52, 0.07, 0.4845))
    episode = run_episode(0, Scenario("blocked", (front,), CYLINDER), problem, CONFIG, Stage(retrieval="missed"), blind)
    assert episode.steps[0].action.kind == "retrieve"
    assert episode.graspable_step is None


def test_the_same_seed_gives_the_same_decisions_whatever_the_recogniser_draws(problem):
    def drawing(key, snapshot):
        jax.random.normal(key)
        return oracle(key, snapshot)

    chosen = []
    for recogniser in (oracle, drawing):
        stage = Stage()
        run_episode(3, HIDDEN, problem, CONFIG, stage, recogniser)
        chosen.append([np.asarray(action.T_world_gripper) for action in stage.actions])
    np.testing.assert_array_equal(*chosen)


def test_the_oracle_leaves_out_what_fell_off_the_board(problem):
    world = from_scenario(OPEN)
    fallen = world.replace(position=world.position.at[0, 2].set(0.1))
    seen = oracle(jax.random.key(0), Snapshot(problem.camera, problem.shelf, fallen))
    assert not seen.objects.valid.any()
    assert seen.target_visible
    np.testing.assert_allclose(seen.target_pose, [0.62, 0.07, 0.0], atol=1e-6)


@pytest.mark.parametrize(
    ("shape", "half", "yaws"), [("cylinder", (0.02, 0.02, 0.05), 1), ("box", (0.015, 0.02, 0.05), 6)]
)
def test_a_scenario_says_what_its_target_is(shape, half, yaws):
    target = target_of(Scenario("one", (), Body(shape, half, CYLINDER.position, UPRIGHT)))
    assert (target.shape, target.half_size, target.yaws) == (shape, half, yaws)
