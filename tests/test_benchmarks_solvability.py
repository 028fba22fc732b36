"""What share of scenes can be solved: which episodes count, what is searched, and what is kept."""

import dataclasses
import json
from collections import Counter
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from published import published_scenarios
from stage import HIDDEN, OPEN, TWO

from mechsearch_jax.actions import KINDS, Action
from mechsearch_jax.benchmarks.lab.ceiling import solvability
from mechsearch_jax.benchmarks.lab.ceiling.solvability import Ceiling, CeilingRow, Outcomes, summary
from mechsearch_jax.envs.episode.records import ActionRecord
from mechsearch_jax.envs.known_target.judgement import Judgement
from mechsearch_jax.envs.known_target.search import KnownSearchConfig, KnownSearchResult, Node
from mechsearch_jax.envs.simulators.native import NativeWorld
from mechsearch_jax.envs.world.world import from_scenario
from mechsearch_jax.workspace.scenario import load_scenario

PUSH = ActionRecord("push", 0, np.eye(4).tolist(), [0.0, 0.1, 0.0], np.eye(4).tolist(), 0.7, 0.0)


def judgement(*hits):
    """Of grasps that hit these objects."""
    rows = np.zeros((len(hits), 8), bool)
    for row, objects in zip(rows, hits, strict=True):
        row[list(objects)] = True
    return Judgement(np.float32(1.0), np.ones(len(hits), bool), rows)


def result_of(start, best=None, actions=None):
    """What a search came to, by the judgements of its worlds."""
    world = jax.device_get(from_scenario(TWO))
    begin = Node(world, (), start)
    reached = begin if best is None else Node(world, (PUSH,), best)
    return KnownSearchResult(actions, reached, begin, 3, 70, Counter())


@pytest.fixture
def ceiling(tmp_path, monkeypatch):
    """Searches that come to what `answers` says of a scene; `ceiling.searched` tells which were searched."""
    ceiling = Ceiling(tmp_path, KnownSearchConfig(rounds=3))
    ceiling.searched, ceiling.answers = [], {}

    def known_search(scenario, *rest):
        ceiling.searched.append(scenario.name)
        return ceiling.answers[scenario.name]

    monkeypatch.setattr(solvability, "known_search", known_search)
    monkeypatch.setattr(solvability, "cached_problem", lambda *_: None)
    monkeypatch.setattr(ceiling, "_problem", lambda *_: None)
    return ceiling


def test_only_what_no_episode_solved_is_searched_and_kept(tmp_path, ceiling, monkeypatch):
    ceiling.answers = {
        "two": result_of(judgement([0]), judgement([]), (PUSH, PUSH)),
        "hidden": result_of(judgement([0])),
    }
    outcomes = Outcomes({}, {"open": (4, 1), "hidden": (4, 0)})
    first = [ceiling.row(scene, outcomes) for scene in (OPEN, TWO, HIDDEN)]
    assert ceiling.searched == ["two", "hidden"]
    assert [(row.solvable, row.episodes, row.retrieved, row.actions) for row in first] == [
        (True, 4, 1, None), (True, 0, 0, 2), (False, 4, 0, None),
    ]  # fmt: skip
    assert [row.reason for row in first] == [None, None, "1 in the way after 0 actions"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["hidden.json", "two.json"]
    assert first[1].path == [dataclasses.asdict(PUSH)] * 2

    assert [ceiling.row(scene, outcomes) for scene in (OPEN, TWO, HIDDEN)] == first
    assert ceiling.searched == ["two", "hidden"]
    ceiling.row(dataclasses.replace(OPEN, name="two"), Outcomes({}, {"two": (1, 1)}))
    (tmp_path / "hidden.json").write_text("{")
    ceiling.row(HIDDEN, outcomes)
    monkeypatch.setattr(solvability, "present_code", lambda: "other code")
    ceiling.row(TWO, outcomes)
    other = Ceiling(tmp_path, KnownSearchConfig(rounds=4))
    assert other.settings != ceiling.settings
    assert ceiling.searched == ["two", "hidden", "hidden", "two"]


RESULT = Path(__file__).parents[1] / "benchmarks" / "results" / "ceiling-cpu.json"


def test_the_stored_summary_of_the_ceiling_is_that_of_its_scenes():
    stored = json.loads(RESULT.read_text())
    rows = [CeilingRow(**dict(zip(stored["columns"], each, strict=True))) for each in stored["rows"]]
    lines = summary(rows)
    assert json.loads(json.dumps(lines)) == stored["summary"]


@pytest.mark.slow
@pytest.mark.skipif(not published_scenarios(), reason="the published scenes are not next to this checkout")
def test_stored_actions_take_the_target_out():
    stored = json.loads(RESULT.read_text())
    rows = [CeilingRow(**dict(zip(stored["columns"], each, strict=True))) for each in stored["rows"]]
    scenes = {scene.content_hash: scene for scene in map(load_scenario, published_scenarios())}
    codes, world = {kind.name: code for code, kind in KINDS.items()}, NativeWorld()
    for row in (row for row in rows if row.path):
        world.reset(scenes[row.content_hash])
        for action in row.path:
            fields = {**action, "kind": codes[action["kind"]], "object": action["object"] or 0}
            outcome = world.execute(Action(**{name: jnp.array(value) for name, value in fields.items()}))
            assert not outcome.fallen.any()
        assert outcome.retrieved, row.scenario
