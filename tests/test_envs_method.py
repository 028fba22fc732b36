"""Methods: what tells them apart, and that they reach another process whole."""

import dataclasses
import json
import pickle

import pytest

from mechsearch_jax.benchmarks.running.evaluate import Job, present_code
from mechsearch_jax.benchmarks.store.rows import EpisodeRow
from mechsearch_jax.config.fixed import AS_IN_PAPER, FIXED
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.envs.episode.records import Episode
from mechsearch_jax.existence import ExistenceConfig
from mechsearch_jax.grasping.config import GraspConfig
from mechsearch_jax.planner import OPTIONS, PRESETS
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.versions import DECISION_VERSION
from mechsearch_jax.workspace.scenario import Body, Scenario

TARGET = Body("cylinder", (0.02, 0.02, 0.05), (0.62, 0.07, 0.4545), (1.0, 0.0, 0.0, 0.0))
METHODS = [
    Method(),
    Method(
        "my_lab.policies:Mine",
        PRESETS["paper"](gamma=0.1 + 0.2, push_distances=(0.05, 0.2)),
        recognition="full",
        engine="MjxSimulator",
    ),
]


@pytest.mark.parametrize("method", METHODS, ids=["default", "other"])
def test_a_method_survives_the_way_to_a_worker(method):
    again = pickle.loads(pickle.dumps(method))
    assert again == method
    assert hash(again) == hash(method)


def test_options_are_flat_and_complete():
    options = METHODS[1].options()
    assert {"policy", "recognition", *(option.name for option in OPTIONS)} <= set(options)
    assert options["policy"] == "my_lab.policies:Mine"
    assert options["push_distances"] == [0.05, 0.2]
    assert json.loads(json.dumps(options)) == options
    assert not any("." in name for name in options)
    assert set(Method().options()) == {"policy", "recognition", AS_IN_PAPER, *(option.name for option in OPTIONS)}


def test_episodes_from_before_an_option_run_as_they_did():
    """Of what was an option and is fixed now, a value of neither preset cannot be run again."""
    for preset, which in PRESETS.items():
        options = Method(config=which()).options()
        del options[AS_IN_PAPER]
        former = {name: getattr(fixed, "in_paper" if preset == "paper" else "value") for name, fixed in FIXED.items()}
        assert Method.of_options({**options, **former}).config == which()
    with pytest.raises(InputError, match="option draws is unknown to this version"):
        Method.of_options({**Method().options(), "draws": 3})


def test_what_is_no_option_tells_methods_apart_too():
    problem = dataclasses.replace(
        METHODS[0].config.problem, existence=ExistenceConfig(found_pixels=80), retrieval=GraspConfig(yaw_step=0.5)
    )
    method = Method(config=dataclasses.replace(METHODS[0].config, problem=problem))
    unusual = {name: value for name, value in method.options().items() if "." in name}
    assert unusual.pop("problem.existence.found_pixels") == 80
    assert unusual.pop("problem.retrieval.yaw_step") == 0.5
    assert set(unusual) == {f"problem.retrieval.{name}" for name in ("wrists", "antipodal", "max_yaw", "turn")}
    assert Method.of_options(method.options()) == method


def test_the_row_of_a_job_is_that_of_its_episode():
    job = Job("", Scenario("one", (), TARGET), METHODS[1], 3)
    # As `run_episodes` writes it.
    config = {**METHODS[1].options(), "target": "cylinder", "simulator": "MjxSimulator", "seed": 3}
    episode = Episode("one", 0, config, {}, (), None, None, False, "error: no", job.scenario.content_hash)
    # What a row does not know of an episode that was not run to its end.
    unknown = {"compile_seconds": None, "device": None, "versions": None}
    unknown["decision_version"] = DECISION_VERSION
    assert dataclasses.replace(EpisodeRow.of_episode(episode, present_code()), **unknown) == job.failed("no")


def test_a_policy_of_another_module_is_found(tmp_path, monkeypatch):
    source = (
        "class Mine:",
        "    def __init__(self, config, *, push_model, later_push_model, tries):",
        "        self.known = config.gamma, push_model is later_push_model",
        "    def __call__(self, key, problem, belief, observation): ...",
    )
    (tmp_path / "my_lab.py").write_text("\n".join(source))
    monkeypatch.syspath_prepend(tmp_path)
    method = Method("my_lab:Mine", PRESETS["standard"](gamma=0.25))
    method.check()
    assert method.policy().known == (0.25, True)
    with pytest.raises(dataclasses.FrozenInstanceError):
        method.name = "random"
