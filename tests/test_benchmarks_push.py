"""The measurements of push models: what they are measured on, what repeating a push tells, what is printed and kept."""

import dataclasses
import hashlib
import io
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

from mechsearch_jax.actions import ActionKind
from mechsearch_jax.benchmarks.lab import __main__ as lab
from mechsearch_jax.benchmarks.lab.parts import push
from mechsearch_jax.benchmarks.lab.parts.push import PushBench, held_out_generation, nudged, repeated
from mechsearch_jax.benchmarks.parts import bench
from mechsearch_jax.benchmarks.report import console_tables
from mechsearch_jax.commands import main as cli
from mechsearch_jax.envs.pushing import pushes as generator
from mechsearch_jax.envs.simulators.native import NativeSimulator
from mechsearch_jax.envs.world.world import TARGET
from mechsearch_jax.networks.push import PushConfig, PushNetwork
from mechsearch_jax.networks.weights import ARCHITECTURES, save_weights
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.train.loop import TrainConfig
from mechsearch_jax.train.push_scores import outcome_scores

CONFIG = PushConfig(width=8, layers=1)
GENERATION = held_out_generation(pushes=5, worlds=8, rounds=1)


def simulator():
    return NativeSimulator(2, generator.push_simulation())


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """The path of weights that nobody has trained."""
    path = tmp_path_factory.mktemp("weights") / "push.npz"
    inputs = jax.tree.map(lambda a: jnp.ones(a.shape, a.dtype), ARCHITECTURES["push"].inputs)
    parameters = jax.jit(PushNetwork(CONFIG).init)(jax.random.key(0), *inputs)["params"]
    save_weights(path, "push", CONFIG, parameters, {})
    return path


@pytest.fixture(scope="module")
def comparison(weights):
    return PushBench(GENERATION, weights=weights, make_simulator=simulator)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Where the pushes lie."""
    return tmp_path_factory.mktemp("pushes")


@pytest.fixture(scope="module")
def pushes(comparison, folder):
    return comparison.pushes(folder)


@pytest.fixture(scope="module")
def measured(weights, pushes):
    """Of few models."""
    return PushBench(GENERATION, ("no motion", "learned", "nudged"), weights=weights, make_simulator=simulator).run(
        pushes
    )


@pytest.fixture(scope="module")
def drawn():
    """Six scenes of three objects, and a push in each."""
    return bench.drawn_pushes(6, 3)


# --- what is measured on ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [0, 7, 2**31 - 1])
def test_training_refuses_the_seeds_of_the_pushes(seed):
    generation = held_out_generation(10, 4, seed)
    with pytest.raises(InputError, match="held out"):
        TrainConfig(seed=generation.seed, steps=1)
    # Every one of them is another key.
    assert int(jax.random.key_data(jax.random.key(generation.seed))[1]) == generation.seed


@pytest.mark.parametrize("wrong", [{"pushes": 0}, {"worlds": 0}, {"rounds": 0}, {"seed": -1}, {"seed": 2**31}])
def test_impossible_pushes_are_refused(wrong):
    with pytest.raises(InputError, match=f"--{next(iter(wrong))}"):
        held_out_generation(**{"pushes": 5, "worlds": 8, **wrong})


@pytest.mark.parametrize("wrong", [{"rows": ()}, {"rows": ("guess",)}, {"rows": ("nudged",), "weights": "push.npz"}])
def test_impossible_comparisons_are_refused(wrong):
    with pytest.raises(InputError, match="lab push"):
        PushBench(GENERATION, **wrong)


@pytest.mark.slow
def test_pushes_to_time_are_real_and_among_the_given_number_of_objects(drawn):
    world, action = drawn
    np.testing.assert_array_equal(action.kind, ActionKind.PUSH)
    np.testing.assert_array_equal(world.valid[:, :TARGET].sum(axis=1), 3)
    assert world.valid[np.arange(6), action.object].all()
    assert (np.linalg.norm(action.displacement, axis=1) > 0.01).all()
    assert len(np.unique(action.T_world_gripper, axis=0)) == 6
    with pytest.raises(InputError, match="only 0 of 6"):
        bench.drawn_pushes(6, 3, tries=0)


# --- simulating again ------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_nudge_moves_what_is_there_by_next_to_nothing(pushes):
    before, after = pushes.before, nudged(pushes).before
    shift = after.position - before.position
    valid = before.valid
    assert (shift[valid][:, :2] != 0).all()
    assert np.std(shift[valid][:, :2]) == pytest.approx(1e-5, rel=0.35)
    assert (shift[valid][:, 2] == 0).all()
    assert (shift[~valid] == 0).all()
    for name in ("kind", "half_size", "rotation", "valid"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))


@pytest.mark.slow
def test_a_push_that_is_simulated_again_ends_the_same(pushes):
    count = len(pushes.object)
    assert count >= GENERATION.pushes
    seen = []
    # The last batch is not full.
    again = repeated(pushes, simulator(), count - 1, seen.append)
    assert seen == [count - 1, count]
    valid = pushes.before.valid
    np.testing.assert_array_equal(again.scene.position[valid], pushes.after.position[valid])
    np.testing.assert_array_equal(again.scene.rotation[valid], pushes.after.rotation[valid])
    np.testing.assert_array_equal(again.topples, pushes.toppled)
    assert (again.residual == 0).all()


@pytest.mark.slow
def test_a_push_that_the_arm_cannot_make_again_moves_nothing(pushes):
    first = jax.tree.map(lambda a: a[:2], pushes)
    away = first.T_world_gripper.copy()
    away[0, :3, 3] += 3.0
    again = repeated(first.replace(T_world_gripper=away), simulator(), 2)
    np.testing.assert_array_equal(again.residual, [np.inf, 0.0])
    assert outcome_scores(again, first)["all"]["failed"] == 1
    np.testing.assert_array_equal(again.scene.position[0], first.before.position[0])
    valid = first.before.valid[1]
    np.testing.assert_array_equal(again.scene.position[1][valid], first.after.position[1][valid])


@pytest.mark.slow
def test_predictions_that_are_no_numbers_are_refused(pushes):
    first = jax.tree.map(lambda a: a[:2], pushes)
    outcomes = repeated(first, simulator(), 2)
    invalid = outcomes.replace(topples=np.where(first.before.valid, np.nan, outcomes.topples))
    with pytest.raises(InputError, match="not finite numbers"):
        outcome_scores(invalid, first)


# --- what comes of it ------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_simulating_is_better_than_guessing(comparison, pushes):
    measured = comparison.run(pushes)
    assert list(measured.scores) == list(push.ROWS)
    every = {name: groups["all"] for name, groups in measured.scores.items()}
    assert {line["pushes"] for line in every.values()} == {len(pushes.object)}
    for name in ("physics", "nudged"):
        assert every[name]["pushed_mm"] < 0.3 * min(every[other]["pushed_mm"] for other in ("no motion", "learned"))
    assert every["no motion"]["still"] == 1.0


@pytest.mark.slow
def test_named_rows_are_measured_in_their_order(pushes):
    seen = []
    rows = ("quasi-static", "no motion", "quasi-static")
    few = PushBench(GENERATION, rows, make_simulator=simulator).run(pushes, lambda *progress: seen.append(progress))
    assert list(few.scores) == ["quasi-static", "no motion"]
    assert seen == [("quasi-static", len(pushes.object)), ("no motion", len(pushes.object))]
    assert few.weights is None
    assert few.best == "quasi-static"


@pytest.mark.slow
def test_another_process_reads_the_same_pushes(pushes, folder):
    with np.load(folder / "pushes-000.npz") as archive:
        identity = str(archive["identity"])
    # Where something lies in memory is different in every process.
    assert " at 0x" not in identity
    # What the outcome depends on has to be the same, too.
    assert repr(generator.push_simulation()) in identity


@pytest.mark.slow
def test_scores_are_written_with_how_they_came_about(measured, weights):
    value = json.loads(json.dumps(measured.value(), allow_nan=False))
    assert value["models"] == measured.scores
    assert value["settings"]["generation"] == dataclasses.asdict(GENERATION)
    assert value["settings"]["simulator"] == "NativeSimulator"
    assert value["weights"]["sha256"] == hashlib.sha256(weights.read_bytes()).hexdigest()
    assert value["weights"]["parameters"] == json.loads(weights.with_suffix(".json").read_text())["parameters"]
    assert "device" in value["versions"]
    assert "commit" in value


@pytest.mark.slow
@pytest.mark.parametrize("model", ["learned", "quasi-static", "physics"])
def test_predicting_is_timed(model, drawn, weights, monkeypatch):
    monkeypatch.setattr(bench, "drawn_pushes", lambda count, objects: jax.tree.map(lambda a: a[:count], drawn))
    timing = bench.bench_predict(model, 3, batch=4, repeats=2, weights=weights if model == "learned" else None)
    assert timing.subject == f"predict: {model}"
    assert timing.rate == pytest.approx(4 / timing.median)
    assert len(timing.seconds) == 2
    value = json.loads(json.dumps(timing.value()))
    assert value["predictions_per_second"] == pytest.approx(timing.rate)
    card = json.loads(weights.with_suffix(".json").read_text())
    about = (value["versions"].get("weights"), value["shapes"].get("parameters"))
    assert about == ((card["sha256"], card["parameters"]) if model == "learned" else (None, None))
    console = Console(file=io.StringIO(), width=200)
    console.print(console_tables.timing_table(timing))
    assert "predictions/s" in console.file.getvalue()
    assert f"{1e3 * timing.median / 4:,.3g} ms" in console.file.getvalue()


@pytest.mark.slow
def test_the_batch_simulator_repeats_its_pushes_too(weights, tmp_path):
    comparison = PushBench(GENERATION, ("no motion", "nudged"), make_simulator=lambda: generator.engine(True))
    measured = comparison.run(comparison.pushes(tmp_path))
    assert measured.settings["simulator"] == "MjxSimulator"
    every = {name: groups["all"] for name, groups in measured.scores.items()}
    assert every["nudged"]["pushed_mm"] < 0.3 * every["no motion"]["pushed_mm"]


@pytest.mark.slow
def test_the_commands_measure_print_and_write(weights, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments = ["push", "--pushes", "6", "--worlds", "2", "--weights", str(weights), "--data", "data"]
    lab.parse([*arguments, "--out", "push.json", "--models", "no motion", "learned"])()
    printed = capsys.readouterr().out
    assert "model learned, group all, pushes " in printed
    value = json.loads((tmp_path / "push.json").read_text())
    assert list(value["models"]) == ["no motion", "learned"]
    assert value["settings"]["pushes"] >= 6
    # The same pushes, read instead of made.
    lab.parse([*arguments, "--out", "again.json"])()
    again = json.loads((tmp_path / "again.json").read_text())
    assert list(again["models"]) == list(push.ROWS)
    assert again["models"]["learned"] == value["models"]["learned"]

    enabled = jax.config.jax_enable_compilation_cache
    cli.parse(["bench", "predict", "--objects", "2", "--batch", "3", "--repeats", "2", "--out", "predict.json"])()
    jax.config.update("jax_enable_compilation_cache", enabled)
    assert "predict: learned" in capsys.readouterr().out
    timing = json.loads((tmp_path / "predict.json").read_text())
    assert timing["shapes"]["predictions"] == 3
    assert len(timing["seconds"]) == 2
