"""The protocol of the published code: what failed is taken back, the next best is tried, and nothing is taken out."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from stage import BOX, CYLINDER, HIDDEN, OPEN, Grab, Stage, push_off, reveal

from mechsearch_jax.actions import ActionKind
from mechsearch_jax.envs.camera.snapshot import oracle, true_target_pose
from mechsearch_jax.envs.episode.closed_loop import Listeners, RunSettings, Start
from mechsearch_jax.envs.episode.episodes import run_episode, run_episodes
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.envs.episode.protocols import ALL_FAILED, HIDDEN_AGAIN, OUTSIDE, PROTOCOLS, REACHED
from mechsearch_jax.envs.episode.verdicts import swept_free
from mechsearch_jax.envs.world.outcome import Failure
from mechsearch_jax.envs.world.world import from_scenario, true_superquadrics
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner import PRESETS
from mechsearch_jax.workspace.scenario import Scenario

PUBLISHED = PROTOCOLS["published-code"]
DISTANCES = (0.05, 0.1, 0.15)


class Several(Grab):
    """Grabs, and knows three pushes, the shortest the best; the last of four sequences found none."""

    def __call__(self, key, problem, belief, observation):
        decision = super().__call__(key, problem, belief, observation)
        push = jax.tree.map(lambda a: a[0, 0], decision.sequences.actions)

        def by(distance, kind):
            return push.replace(displacement=jnp.array([0.0, distance, 0.0]), kind=jnp.int32(kind))

        pushes = [*(by(distance, ActionKind.PUSH) for distance in DISTANCES), by(0.0, ActionKind.NONE)]
        actions = jax.tree.map(lambda *a: jnp.stack(a)[:, None], *pushes)
        pushing = decision.action.kind == ActionKind.PUSH
        action = jax.tree.map(lambda a, b: jnp.where(pushing, a, b), pushes[0], decision.action)
        return decision.replace(action=action, sequences=decision.sequences.replace(actions=actions))


class Rewinding(Stage):
    """Can be set back, and the first so many actions come to nothing but trouble, by the scenario."""

    def __init__(self, acts=reveal, fail=0, trouble=lambda world: world, failure=Failure.DROPPED):
        super().__init__(acts)
        self.failing, self.trouble, self.failure, self.tried, self.loads = fail, trouble, failure, {}, 0

    def load(self, world, only=None):
        self.loads += 1
        for i in np.flatnonzero(only):
            self._worlds[i] = jax.tree.map(lambda a, i=i: a[i], world)
        return self._gather()

    def execute(self, actions, active=None):
        acts = self._script["acts"]
        bad = []
        for i in np.flatnonzero(np.asarray(active)):
            name = self.names[i]
            self.tried[name] = self.tried.get(name, 0) + 1
            allowed = self.failing.get(name, 0) if isinstance(self.failing, dict) else self.failing
            bad += [name] if self.tried[name] <= allowed else []
        self._script["acts"] = {name: self.trouble if name in bad else acts for name in self.names}
        self._script["failures"] = dict.fromkeys(bad, self.failure)
        outcome = super().execute(actions, active)
        self._script["acts"] = acts
        return outcome


def run(problem, scenario, stage, policy=None, **settings):
    settings = RunSettings(**{"max_steps": 2, "protocol": PUBLISHED, **settings})
    return run_episode(Start(scenario, 0), problem, policy or Several(), stage, settings)


def test_what_fails_is_taken_back_and_the_next_best_is_tried(problem):
    stage = Rewinding(fail=2, trouble=push_off)
    episode = run(problem, HIDDEN, stage)
    assert (episode.found_step, episode.graspable_step, episode.retrieved) == (1, 1, False)
    assert episode.failure == REACHED
    assert [float(action.displacement[1]) for action in stage.actions] == pytest.approx(DISTANCES)
    first, second = episode.steps
    # The record is of what was executed in the end.
    assert first.action.displacement[1] == pytest.approx(DISTANCES[2])
    assert (first.failure, first.fallen, first.predicted_cost) == (None, (), None)
    assert (second.graspable, second.action) == (True, None)
    assert stage.loads == 2


def test_what_leaves_the_board_is_taken_back_too(problem):
    stage = Rewinding(fail=1, trouble=push_off, failure=Failure.NONE)
    episode = run(problem, HIDDEN, stage)
    assert (episode.failure, len(stage.actions), stage.loads) == (REACHED, 2, 1)
    assert episode.steps[0].fallen == ()


def test_where_all_fail_the_episode_does_and_the_world_is_as_before(problem):
    stage = Rewinding(fail=9, trouble=push_off)
    episode = run(problem, HIDDEN, stage)
    assert (episode.failure, episode.found_step, len(episode.steps)) == (ALL_FAILED, None, 1)
    # Of four sequences one found nothing to do.
    assert len(stage.actions) == 3
    np.testing.assert_allclose(stage.world.position[0], from_scenario(HIDDEN).position)


def test_a_target_in_sight_that_could_be_grasped_ends_it_and_is_not_taken_out(problem):
    stage = Rewinding()
    episode = run(problem, OPEN, stage)
    assert (episode.found_step, episode.graspable_step, episode.retrieved) == (0, 0, False)
    assert (episode.failure, stage.executed) == (REACHED, [])


def test_after_the_last_action_a_target_that_can_be_grasped_counts(problem):
    episode = run(problem, HIDDEN, Rewinding(), max_steps=1)
    assert (episode.graspable_step, episode.failure) == (1, REACHED)
    lost = run(problem, HIDDEN, Rewinding(lambda world: world), max_steps=1)
    assert (lost.found_step, lost.failure) == (None, "not found")


def test_what_is_outside_as_a_step_begins_is_the_end(problem):
    gone = dataclasses.replace(BOX, position=(0.39, -0.2, 0.4845))
    episode = run(problem, Scenario("gone", (gone,), CYLINDER), Rewinding())
    assert (episode.failure, episode.steps[0].action) == (OUTSIDE, None)


def test_the_verdict_is_on_what_was_recognised(problem):
    """Strictly it is on the truth; there the box before it blocks every grasp."""

    def blind(key, snapshot):
        seen = oracle(key, snapshot)
        nothing = seen.objects.replace(valid=jnp.zeros_like(seen.objects.valid))
        return Observation(nothing, jnp.array(True), seen.target_pose + 0.2)

    front = dataclasses.replace(BOX, position=(0.52, 0.07, 0.4845))
    blocked = Scenario("blocked", (front,), CYLINDER)
    assert run(problem, blocked, Rewinding(), recogniser=blind).graspable_step == 0
    assert run(problem, blocked, Stage(retrievals=Failure.MISSED), recogniser=blind, protocol=PROTOCOLS["strict"],
               max_steps=1).graspable_step is None  # fmt: skip


def test_a_target_that_hides_again_is_not_in_sight(problem):
    def shy(key, snapshot):
        seen = oracle(key, snapshot)
        return seen.replace(target_visible=jnp.array(False))

    class Sure(Grab):
        def __call__(self, key, problem, belief, observation):
            found_belief = belief.replace(found=jnp.array(True), found_pose=observation.target_pose)
            return super().__call__(key, problem, found_belief, observation)

    assert run(problem, OPEN, Rewinding(), Sure(), recogniser=shy).failure == HIDDEN_AGAIN


def test_what_is_swept_at_any_grasp_must_meet_neither_objects_nor_shelf(problem):
    world = from_scenario(OPEN)
    scene, pose = true_superquadrics(world), true_target_pose(world)
    free = jax.jit(lambda scene, pose, active: swept_free(problem.target_grasps, scene, pose, active))
    assert free(scene, pose, jnp.array(True))
    assert not free(scene, pose, jnp.array(False))
    front = scene.replace(position=scene.position.at[0].set(jnp.array([0.52, 0.07, 0.4845])))
    assert not free(front, pose, jnp.array(True))
    # Beside the wall there is no room for the hand.
    assert not free(scene, pose.at[1].set(problem.shelf.left - 0.02), jnp.array(True))


@pytest.mark.slow
def test_slots_try_on_their_own(problem):
    """As alone: one succeeds at once, one at the third try, one never."""
    names = {"at once": 0, "third": 2, "never": 9}
    scenarios = [dataclasses.replace(HIDDEN, name=name) for name in names] + [OPEN]
    episodes = {}
    stage = Rewinding(fail=names, trouble=push_off)
    settings = RunSettings(max_steps=2, protocol=PUBLISHED, at_once=2)
    starts = [Start(s, 0) for s in scenarios]
    run_episodes(starts, problem, Several(), stage, 3, Listeners(episodes.update), settings)
    reasons = [episodes[i].failure for i in range(4)]
    assert reasons == [REACHED, REACHED, ALL_FAILED, REACHED]
    assert [episodes[i].graspable_step for i in range(4)] == [1, 1, None, 0]
    for i, scenario in enumerate(scenarios[:3]):
        alone = run(problem, scenario, Rewinding(fail=names, trouble=push_off))
        assert [step.action for step in alone.steps] == [step.action for step in episodes[i].steps]


def test_methods_differ_in_their_protocol_and_problem():
    strict, published = Method(), Method(protocol="published-code")
    assert strict.options()["protocol"] == "strict"
    assert published.options() == {**strict.options(), "protocol": "published-code"}
    assert strict.problem_config == strict.config.problem
    grasps = PRESETS["standard"]().problem.grasps
    assert published.problem_config == dataclasses.replace(strict.config.problem, retrieval=grasps)


def test_a_target_that_is_not_to_be_taken_out_is_not_brushed_out_in_trials_either():
    strict, published = (Method(protocol=name).policy().config for name in ("strict", "published-code"))
    assert strict.retrieval_contact
    assert published == dataclasses.replace(strict, retrieval_contact=False)
