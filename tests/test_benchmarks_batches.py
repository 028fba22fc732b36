"""Batches of jobs: rows for all of them, whatever fails, and the same after a kill."""

import contextlib
import dataclasses

import jax
import pytest
from stage import HIDDEN, OPEN

from mechsearch_jax.benchmarks.running import batches
from mechsearch_jax.benchmarks.running.batches import Batches, fitting_worlds
from mechsearch_jax.benchmarks.running.evaluate import evaluate, make_jobs
from mechsearch_jax.benchmarks.store.rows import identity
from mechsearch_jax.benchmarks.store.shards import Results
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.envs.episode.records import Episode
from mechsearch_jax.envs.simulators.mjx_simulator import MjxSimulator
from mechsearch_jax.envs.simulators.native import NativeSimulator
from mechsearch_jax.envs.trials.native import NativeTrials
from mechsearch_jax.envs.trials.processes import ProcessTrials
from mechsearch_jax.planner import PRESETS
from mechsearch_jax.workspace.scenario import save_scenario

METHOD = Method(config=PRESETS["standard"](max_steps=2))


@pytest.fixture
def files(tmp_path):
    scenes = [dataclasses.replace(scene, name=f"{scene.name}-{i}") for i in range(2) for scene in (HIDDEN, OPEN)]
    for scene in scenes:
        save_scenario(scene, tmp_path / f"{scene.name}.json")
    return [tmp_path / f"{scene.name}.json" for scene in scenes]


def read_rows(folder):
    results = Results(folder)
    results.refresh()
    return list(results.rows.values())


def jobs_of(files, seeds=(0,)):
    return make_jobs(files, [METHOD], seeds)


class Stand:
    """Stands in for `run_episodes`: ends the episodes one by one, and fails when a test says so."""

    def __init__(self, problem, monkeypatch, fail=lambda place, slots: None):
        self.slots = []
        self._fail = fail
        monkeypatch.setattr(batches, "run_episodes", self)
        monkeypatch.setattr(batches.Workcell, "problem", lambda workcell, target, config: problem)

    def __call__(self, starts, problem, policy, simulator, slots, listeners, settings):
        self.slots.append(slots)
        for place, start in enumerate(starts):
            error = self._fail(start.scenario.name, slots)
            if error:
                raise error
            scene = start.scenario
            assert start.max_steps == start.options["max_steps"]
            config = {**start.options, "target": scene.target.shape, "simulator": simulator.engine, "seed": start.seed}
            facts = (scene.name, len(scene.objects), config, {}, (), 0, 0, False, "not found", scene.content_hash)
            listeners.ended([(place, Episode(*facts))])


def test_every_job_becomes_a_row_with_its_options(problem, tmp_path, files, monkeypatch):
    stand = Stand(problem, monkeypatch)
    jobs = jobs_of(files, seeds=(0, 1))
    rows = evaluate(jobs, tmp_path / "rows", Batches(worlds=3))
    assert [(r.scenario, r.seed) for r in rows] == [(j.scenario.name, j.seed) for j in jobs]
    assert {identity(r) for r in rows} == {identity(j.failed("")) for j in jobs}
    assert stand.slots == [3]


def test_where_memory_does_not_suffice_it_goes_on_with_half_the_worlds(problem, tmp_path, files, monkeypatch):
    def fail(name, slots):
        return jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: out of memory") if slots > 1 else None

    stand = Stand(problem, monkeypatch, fail)
    rows = evaluate(jobs_of(files), tmp_path / "rows", Batches(worlds=4))
    assert stand.slots == [4, 2, 1]
    assert all(row.failure == "not found" for row in rows)


def test_an_error_of_the_device_costs_its_episode_alone(problem, tmp_path, files, monkeypatch):
    def fail(name, slots):
        return jax.errors.JaxRuntimeError("INTERNAL: no luck") if name == "hidden-1" else None

    stand = Stand(problem, monkeypatch, fail)
    rows = evaluate(jobs_of(files), tmp_path / "rows", Batches(worlds=1))
    assert stand.slots == [1, 1]
    assert [row.failure for row in rows if row.scenario == "hidden-1"] == ["error: JaxRuntimeError: INTERNAL: no luck"]
    assert sum(row.failure == "not found" for row in rows) == 3


class Together(Stand):
    """The same, but all episodes of a batch end at its end, if none of them fails."""

    def __call__(self, starts, problem, policy, simulator, slots, listeners, settings):
        batch = list(starts)
        self.slots.append(len(batch))
        errors = [error for start in batch if (error := self._fail(start.scenario.name, slots))]
        if errors:
            raise errors[0]
        slots_before = self.slots[:]
        super().__call__(batch, problem, policy, simulator, slots, listeners, settings)
        self.slots = slots_before


def test_a_batch_that_fails_is_run_again_in_halves(problem, tmp_path, files, monkeypatch):
    stand = Together(problem, monkeypatch, lambda name, slots: ValueError("no") if name == "hidden-1" else None)
    said = []
    rows = evaluate(jobs_of(files, seeds=(0, 1)), tmp_path / "rows", Batches(worlds=8, again=said.append))
    assert said[0] == "8 episodes are run again in halves, because of ValueError: no"
    failed = {(row.scenario, row.seed): row.failure for row in rows if row.failure != "not found"}
    assert failed == {("hidden-1", seed): "error: ValueError: no" for seed in (0, 1)}
    assert len(read_rows(tmp_path / "rows")) == 8
    # No other number of worlds is compiled for it.
    assert set(stand.slots) == {8}


def test_what_fails_whatever_is_run_ends_the_run(problem, tmp_path, files, monkeypatch):
    stand = Together(problem, monkeypatch, lambda name, slots: ValueError("never"))
    jobs = jobs_of(files, seeds=(0, 1, 2, 3))
    with pytest.raises(ValueError, match="never"):
        evaluate(jobs, tmp_path / "rows", Batches(worlds=16))
    assert read_rows(tmp_path / "rows") == []
    assert len(stand.slots) < 2 * batches.MOST_FAILURES + 4
    # Once an episode has ended, those that fail have rows, so that the next run does not come upon them.
    bad = {job.scenario.name for job in jobs[4:]}
    Together(problem, monkeypatch, lambda name, slots: ValueError("never") if name in bad else None)
    with pytest.raises(ValueError, match="never"):
        evaluate(jobs, tmp_path / "rows", Batches(worlds=16))
    assert len(read_rows(tmp_path / "rows")) == 4 + batches.MOST_FAILURES
    rows = evaluate(jobs, tmp_path / "rows", Batches(worlds=16), retry_errors=False)
    assert sum(row.is_error for row in rows) == 12


def test_what_differs_in_numbers_alone_is_one_batch(problem, tmp_path, files, monkeypatch):
    changes = [{"gamma": 0.5}, {"gamma": 0.6}, {"max_steps": 5}, {}]
    methods = [Method(config=PRESETS["standard"](**change)) for change in changes]
    stand = Stand(problem, monkeypatch)
    rows = evaluate(make_jobs(files, methods, (0,)), tmp_path / "rows", Batches(worlds=30))
    assert stand.slots == [len(files) * len(methods)]
    assert {identity(r) for r in rows} == {identity(j.failed("")) for j in make_jobs(files, methods, (0,))}
    others = [
        *(Method(config=PRESETS["standard"](**change)) for change in ({"horizon": 2}, {"push_distances": (0.1,)})),
        *(Method("search-and-grasp"), Method(recognition="masks"), Method()),
    ]
    assert len({method.compile_key() for method in others}) == len(others)
    stand.slots.clear()
    evaluate(make_jobs(files, others, (0,)), tmp_path / "others", Batches(worlds=30))
    assert stand.slots == [len(files)] * len(others)


def test_beside_a_gpu_a_batch_tries_actions_out_in_processes_that_end_with_it(monkeypatch):
    closed = []
    monkeypatch.setattr(ProcessTrials, "close", lambda trials: closed.append(trials))
    with contextlib.ExitStack() as stack:
        assert batches._trials(stack, "none") is None
        assert isinstance(batches._trials(stack, "physics"), NativeTrials)
        monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
        assert batches._trials(stack, "none") is None
        trials = batches._trials(stack, "physics")
        assert isinstance(trials, ProcessTrials)
        assert closed == []
    assert closed == [trials]


def test_the_memory_of_the_device_bounds_the_worlds(monkeypatch):
    simulator = MjxSimulator()
    assert fitting_worlds(NativeSimulator()) == batches.MOST_WORLDS_ON_CPU
    assert 1e5 < simulator.bytes_per_world() < 1e7

    class Device:
        def memory_stats(self):
            return {"bytes_limit": 100 * simulator.bytes_per_world()}

    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(jax, "local_devices", lambda: [Device()])
    assert fitting_worlds(simulator) == 40
