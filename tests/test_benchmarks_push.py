"""The measurements of push models: what they are measured on, what repeating a push tells, what is printed and kept."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax.benchmarks.lab import __main__ as lab
from mechsearch_jax.benchmarks.lab.parts import push
from mechsearch_jax.benchmarks.lab.parts.push import PushBench, held_out_generation, nudged, repeated
from mechsearch_jax.commands import main as cli
from mechsearch_jax.envs.pushing import pushes as generator
from mechsearch_jax.envs.simulators.native import NativeSimulator
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


# --- what is measured on ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [0, 7, 2**31 - 1])
def test_training_refuses_the_seeds_of_the_pushes(seed):
    generation = held_out_generation(10, 4, seed)
    with pytest.raises(InputError, match="held out"):
        TrainConfig(seed=generation.seed, steps=1)
    # Every one of them is another key.
    assert int(jax.random.key_data(jax.random.key(generation.seed))[1]) == generation.seed


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
