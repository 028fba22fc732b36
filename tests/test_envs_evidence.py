"""What a recording keeps of a decision beside motion and belief: confidence, grasps, forecasts, trials."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from recordings import EPISODE, LOST, OBJECTS, PUSH, RECORDING, SEQUENCES, SLOTS, stacked

from mechsearch_jax.envs.episode.numbering import named_tried
from mechsearch_jax.envs.recording.evidence import Forecasts, foreseen_rows
from mechsearch_jax.envs.recording.in_the_way import blocking, least_sets
from mechsearch_jax.envs.recording.recording import NAME, load_recording, save_recording
from mechsearch_jax.envs.recording.sampled import Sampled
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner import Decision
from mechsearch_jax.planner.state import Alternatives
from mechsearch_jax.planner.step import decide, unsearched
from mechsearch_jax.planner.trials import TrialResult, nothing_tried, sequences_to_try, tried
from mechsearch_jax.runtime.errors import InputError


def test_evidence_comes_back_as_it_was_written(tmp_path):
    save_recording(LOST, tmp_path / NAME)
    again = load_recording(tmp_path / NAME)
    assert again.episode == EPISODE
    for read, written in zip(again.steps, LOST.steps, strict=True):
        for name in ("confidence", "believed_pose", "hits"):
            np.testing.assert_array_equal(getattr(read.evidence, name), getattr(written.evidence, name))
        jax.tree.map(np.testing.assert_array_equal, read.evidence.tried, written.evidence.tried)
        for field in dataclasses.fields(Forecasts):
            ours, theirs = (getattr(each.evidence.forecasts, field.name) for each in (read, written))
            np.testing.assert_array_equal(ours, theirs)


def test_a_recording_of_an_earlier_version_opens(tmp_path):
    save_recording(RECORDING, tmp_path / NAME)
    with np.load(tmp_path / NAME) as file:
        assert not [name for name in file if name.startswith("evidence")]
        assert '"episode"' not in str(file["head"])
    again = load_recording(tmp_path / NAME)
    assert again.episode is None
    assert [step.evidence for step in again.steps] == [None] * 3


def halve_hits(arrays):
    arrays["evidence.hits"] = arrays["evidence.hits"][1:]


def negate_rows(arrays):
    arrays["evidence.foreseen.existence.rows"] = -arrays["evidence.foreseen.existence.rows"]


@pytest.mark.parametrize("spoil", [halve_hits, negate_rows])
def test_damaged_evidence_is_refused_in_one_line(spoil, tmp_path):
    save_recording(LOST, tmp_path / NAME)
    with np.load(tmp_path / NAME) as file:
        arrays = dict(file)
    spoil(arrays)
    np.savez(tmp_path / NAME, **arrays)
    with pytest.raises(InputError, match=f"{NAME}: is no recording of an episode") as refused:
        load_recording(tmp_path / NAME)
    assert "\n" not in str(refused.value)


def of_objects(*objects):
    """Candidates that move these objects, the best first; all else is alike."""
    count = len(objects)
    action = stacked(*(PUSH.replace(object=np.int32(i), q7=np.float32(k)) for k, i in enumerate(objects)))
    positions, rotations = (np.stack([np.asarray(a)] * count) for a in (OBJECTS.position, OBJECTS.rotation))
    return Sampled(action, -np.arange(count, 0.0, -1), np.full(count, 90.0), positions, rotations)


def test_the_best_candidate_that_moves_another_object_is_foreseen():
    assert foreseen_rows(of_objects(0, 0, 2, 3)) == [0, 1, 2]
    assert foreseen_rows(of_objects(0, 2, 0)) == [0, 1]
    assert foreseen_rows(of_objects(0)) == [0]


def test_least_sets_of_what_grasps_hit():
    hits = np.zeros((4, 5), bool)
    hits[0, [1]], hits[1, [1, 4]], hits[2, [2, 3]], hits[3, [2, 3, 4]] = True, True, True, True
    assert least_sets(hits) == [(1,), (2, 3)]
    assert blocking(hits) == (1,)
    assert blocking(np.zeros((1, 5), bool)) == ()


def test_trials_are_kept_up_to_the_first_success_with_the_bodies_numbers():
    codes = [TrialResult.HARMFUL, TrialResult.UNKNOWN, TrialResult.SUCCEEDED, TrialResult.FAILED]
    actions = jax.tree.map(lambda a: np.stack([a] * 4)[None], PUSH.replace(object=np.int32(1)))
    bodies = np.array([3, 5, *range(6)])[:SLOTS]

    def kept(*worth):
        alternatives = Alternatives(actions, np.array([worth]), np.zeros((1, 4), np.int32), None, None)
        return named_tried(tried(alternatives, np.array([codes], np.int32)), bodies)

    found = kept(True, False, True, True)
    assert found.result.tolist() == [TrialResult.HARMFUL, TrialResult.SUCCEEDED]
    assert found.action.object.tolist() == [5, 5]
    assert found.action.kind.tolist() == [int(PUSH.kind)] * 2
    assert kept(True, True, False, False).result.tolist() == [TrialResult.HARMFUL, TrialResult.UNKNOWN]
    assert len(nothing_tried().result) == 0


def test_a_decision_comes_with_what_was_tried_before_it(problem):
    objects, sequences = (jax.tree.map(jnp.asarray, tree) for tree in (OBJECTS, SEQUENCES))
    decision = Decision(
        jax.tree.map(lambda a: a[0, 0], sequences.actions),
        sequences.value[0],
        jnp.float32(100.0),
        sequences.cost[0, 0],
        objects,
        sequences,
        alternatives=sequences_to_try(sequences, objects, jnp.float32(0.0)),
    )
    state = unsearched(problem, Observation(objects, jnp.array(False), jnp.zeros(3)))
    worth = np.flatnonzero(decision.alternatives.worth)
    for succeeds in range(len(worth)):

        def trials(problem, scenes, actions, wanted, succeeds=succeeds):
            row = np.arange(wanted.shape[1]) >= worth[succeeds]
            return np.where(row, TrialResult.SUCCEEDED, TrialResult.HARMFUL)[None].astype(np.int32)

        decided = decide(lambda *_: decision, trials, jax.random.key(0), problem, state)
        assert decided.tried.result.tolist() == [TrialResult.HARMFUL] * succeeds + [TrialResult.SUCCEEDED]
        made = jax.tree.map(lambda a: a[-1], decided.tried.action)
        jax.tree.map(np.testing.assert_array_equal, decided.decision.action, made)
