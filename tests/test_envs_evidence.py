"""What a recording keeps of a decision beside motion and belief: confidence, grasps, forecasts, trials."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from recordings import EPISODE, LOST, OBJECTS, PUSH, RECORDING, SEQUENCES, SLOTS, stacked

from mechsearch_jax.actions import no_action
from mechsearch_jax.envs.episode.numbering import named_tried
from mechsearch_jax.envs.known_target.in_the_way import blocking, grasps_in_words, least_sets, objects_in_words
from mechsearch_jax.envs.recording.evidence import Forecasts, foreseen_rows
from mechsearch_jax.envs.recording.recording import NAME, load_recording, save_recording
from mechsearch_jax.envs.recording.sampled import Sampled
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner import Decision, initial_belief
from mechsearch_jax.planner.noted_trials import NotedTrials
from mechsearch_jax.planner.trials import TrialResult, decide, sequences_to_try
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


def forget_results(arrays):
    del arrays["evidence.result"]


def invent_results(arrays):
    arrays["evidence.result"] = arrays["evidence.result"] + 40


def negate_rows(arrays):
    arrays["evidence.foreseen.existence.rows"] = -arrays["evidence.foreseen.existence.rows"]


def retype_confidence(arrays):
    arrays["evidence.confidence"] = arrays["evidence.confidence"].astype("U3")


@pytest.mark.parametrize("spoil", [halve_hits, forget_results, invent_results, negate_rows, retype_confidence])
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


def test_forecasts_of_an_earlier_version_are_of_the_best_candidates(tmp_path):
    save_recording(LOST, tmp_path / NAME)
    with np.load(tmp_path / NAME) as file:
        arrays = {name: file[name] for name in file if not name.startswith("evidence.foreseen.row")}
    np.savez(tmp_path / NAME, **arrays)
    again = load_recording(tmp_path / NAME)
    assert [step.evidence.forecasts.row.tolist() for step in again.steps] == [[0, 1]] * 2


def test_objects_are_listed_as_in_a_sentence():
    assert [objects_in_words(indices) for indices in ((3,), (1, 3), (1, 3, 5))] == [
        "object 3",
        "objects 1 and 3",
        "objects 1, 3 and 5",
    ]


def test_least_sets_of_what_grasps_hit():
    hits = np.zeros((4, 5), bool)
    hits[0, [1]], hits[1, [1, 4]], hits[2, [2, 3]], hits[3, [2, 3, 4]] = True, True, True, True
    assert least_sets(hits) == [(1,), (2, 3)]
    assert blocking(hits) == (1,)
    assert grasps_in_words(hits) == (
        "each of the 4 grasps that the arm can reach inside the shelf hits object 1, or objects 2 and 3"
    )
    assert grasps_in_words(hits[:1]) == "the only grasp that the arm can reach inside the shelf hits object 1"
    assert grasps_in_words(hits[:0]) == "the arm can reach no grasp of the target inside the shelf"
    assert blocking(np.zeros((1, 5), bool)) == ()


def test_trials_are_noted_up_to_the_first_success_with_the_bodies_numbers():
    codes = [TrialResult.HARMFUL, TrialResult.UNKNOWN, TrialResult.SUCCEEDED, TrialResult.FAILED]
    noted = NotedTrials(lambda problem, scenes, actions, wanted: np.array([codes], np.int32))
    push = jax.tree.map(jnp.asarray, PUSH.replace(object=np.int32(1)))
    actions = jax.tree.map(lambda a: jnp.stack([a] * 4)[None], push)
    bodies = np.array([3, 5, *range(6)])[:SLOTS]
    assert len(noted.tried().result) == 0
    call = NotedTrials.__call__.__wrapped__
    results = call(noted, None, None, actions, np.array([[True, False, True, True]]))
    np.testing.assert_array_equal(results, [codes])
    tried = named_tried(noted.tried(), bodies)
    assert tried.result.tolist() == [TrialResult.HARMFUL, TrialResult.SUCCEEDED]
    assert tried.action.object.tolist() == [5, 5]
    call(noted, None, None, actions, np.array([[True, True, False, False]]))
    assert len(noted.tried().result) == 4
    assert tried.action.kind.tolist() == [int(PUSH.kind)] * 2
    assert int(no_action().kind) not in tried.action.kind.tolist()


def test_decisions_are_the_same_with_trials_that_are_noted(problem):
    codes = np.array([[TrialResult.HARMFUL, TrialResult.FAILED, TrialResult.UNKNOWN]], np.int32)
    objects = jax.tree.map(jnp.asarray, OBJECTS)
    sequences = jax.tree.map(jnp.asarray, SEQUENCES)
    first = jax.tree.map(lambda a: a[0, 0], sequences.actions)
    alternatives = sequences_to_try(sequences, objects, jnp.float32(0.0))
    decision = Decision(
        first,
        sequences.value[0],
        jnp.float32(100.0),
        sequences.cost[0, 0],
        objects,
        sequences,
        alternatives=alternatives,
    )
    observation = Observation(objects, jnp.array(False), jnp.zeros(3))
    for row in (codes, codes[:, ::-1], np.full_like(codes, TrialResult.SUCCEEDED)):

        def trials(problem, scenes, actions, wanted, row=row):
            return row

        noted = NotedTrials(trials)
        arguments = (jax.random.key(0), problem, initial_belief(problem), observation)
        plainly, noting = (decide(lambda *_: decision, each, *arguments) for each in (trials, noted))
        jax.tree.map(np.testing.assert_array_equal, plainly, noting)
        assert len(noted.tried().result)
    assert int(plainly.refused) == 0
