"""The method of an episode: everything that determines it beside its scenario and its seed."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Hashable, Iterator, Mapping, Sequence
from typing import Any

from mechsearch_jax.actions.registry import check_kinds
from mechsearch_jax.config.fixed import AS_IN_PAPER, without_fixed
from mechsearch_jax.envs.camera.recognisers import RecognitionName, recogniser
from mechsearch_jax.envs.camera.snapshot import Recogniser
from mechsearch_jax.envs.episode.policy_numbers import compile_key
from mechsearch_jax.envs.pushing.push_models import push_models
from mechsearch_jax.envs.simulators.named import EngineName
from mechsearch_jax.envs.trials.named import named_trials
from mechsearch_jax.envs.world.mismatch import ASSUMED, Mismatch
from mechsearch_jax.planner import OPTIONS, PRESETS, Config, Policy, policy_factory
from mechsearch_jax.planner.trials import Trials
from mechsearch_jax.problem.workcell import Workcell
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.target import Target

# What the options of an episode hold beside the configuration's.
_OF_EPISODES = frozenset(("policy", "recognition", AS_IN_PAPER, "simulator", "target", "seed"))

# Of the paths of a mismatch's settings among the options.
MISMATCH_PREFIX = "mismatch."


@dataclasses.dataclass(frozen=True)
class Method:
    """A policy with all its settings, a recogniser, a simulator, a workcell and a mismatch; hashable.

    Attributes:
      name: of the policy, as `planner.policy_factory` takes it: one of `planner.POLICIES`, or the import path of
        another, as "my_lab.policies:Mine".
      config: every setting of the problem and of the policy.
      recognition: name of the recogniser.
      engine: name of the simulator.
      workcell: of the episodes; its target sets the resolution of candidate poses.
      mismatch: how the simulated world differs from what the planner assumes.
    """

    name: str = "search-for-grasp"
    config: Config = dataclasses.field(default_factory=PRESETS["standard"])
    recognition: RecognitionName = "oracle"
    engine: EngineName = "NativeSimulator"
    workcell: Workcell = dataclasses.field(default_factory=Workcell)
    mismatch: Mismatch = ASSUMED

    def policy(self) -> Policy:
        """The policy, with the models that the configuration names.

        Its proposals are tried by `trials` before an action is executed.

        Raises:
          InputError: there is no such policy, or its push model cannot be used.
        """
        first, later = push_models(self.config.push_model, self.workcell.shelf)
        return policy_factory(self.name)(
            self.config.planner,
            push_model=first,
            later_push_model=later,
            tries=self.config.trials != "none",
        )

    def trials(self) -> Trials | None:
        """The trials of the policy's best actions; None without trials."""
        return named_trials(self.config.trials)

    def recogniser(self, target: Target) -> Recogniser:
        """The recogniser of its episodes with a target.

        Raises:
          InputError: its weights are missing or damaged.
        """
        return recogniser(self.recognition, target, self.workcell.detector)

    def compile_key(self) -> Hashable:
        """A key of the programs compiled for episodes of one target.

        It is equal for methods that differ only in numbers of their policies, such as gamma, in the number of steps, or
        in a mismatch that compiles nothing.

        Raises:
          InputError: as `policy`.
        """
        shared = self.workcell, self.config.problem, self.recognition, self.engine
        return *shared, self.config.trials, self.mismatch.compile_key(), compile_key(self.policy())

    def check(self) -> None:
        """Fail before the first episode rather than in every one.

        Raises:
          InputError: as `policy`, or there is no such kind of action, or the weights that the recogniser needs are
            missing or damaged, or recogniser or simulator cannot have the mismatch.
        """
        self.mismatch.check(self.recognition, self.engine)
        check_kinds(self.config.problem.actions.actions)
        self.policy()
        self.recogniser(self.workcell.target)

    def options(self) -> dict[str, Any]:
        """The options that identify this method, flat and as JSON values.

        They are policy, recognition, whether what is no option is as in the paper, every option of the configuration by
        its name, and by their paths all other settings that differ from the preset, `standard` or `paper`, from the
        default workcell or from no mismatch.
        """
        named = {".".join(option.path) for option in OPTIONS}
        pairs = (
            (self.config, PRESETS["paper" if self.config.planner.as_in_paper else "standard"](), ""),
            (self.workcell, Workcell(), "workcell."),
            (self.mismatch, ASSUMED, MISMATCH_PREFIX),
        )
        unusual: dict[str, Any] = {}
        for config, standard, prefix in pairs:
            usual = dict(_settings(standard, prefix))
            settings = _settings(config, prefix)
            unusual |= {path: value for path, value in settings if value != usual[path] and path not in named}
        identity = {
            "policy": self.name,
            "recognition": self.recognition,
            AS_IN_PAPER: self.config.planner.as_in_paper,
        }
        return {**identity, **self.config.options(), **unusual}

    @classmethod
    def of_options(cls, options: Mapping[str, Any]) -> Method:
        """The method whose `options` these are; what they do not hold is as in the preset, `standard` or `paper`. It
        runs natively.

        Raises:
          InputError: a setting is impossible, or an option or the path of a setting is unknown.
        """
        options = without_fixed(options)
        option_names = {option.name for option in OPTIONS}
        unknown = [name for name in options if "." not in name and name not in option_names | _OF_EPISODES]
        if unknown:
            raise InputError(f"option {unknown[0]} is unknown to this version: what ran with it cannot be run again")
        preset = PRESETS["paper" if options.get(AS_IN_PAPER) else "standard"]
        config = preset(**{name: value for name, value in options.items() if name in option_names})
        parts: dict[str, Any] = {"config": config, "workcell": Workcell(), "mismatch": ASSUMED}
        for path, value in options.items():
            first, *rest = path.split(".")
            if rest and first in ("workcell", "mismatch"):
                parts[first] = _with_setting(parts[first], rest, value)
            elif rest:
                parts["config"] = _with_setting(parts["config"], path.split("."), value)
        return cls(options["policy"], recognition=options["recognition"], **parts)


def _settings(config: Config | Workcell | Mismatch, prefix: str) -> Iterator[tuple[str, Any]]:
    """Every setting as a JSON value, by its path after a prefix, such as "problem.grasps.wrists"."""

    def inside(value: dict[str, Any], path: str) -> Iterator[tuple[str, Any]]:
        for name, part in value.items():
            if isinstance(part, dict):
                yield from inside(part, f"{path}{name}.")
            else:
                yield f"{path}{name}", part

    settings = inside(json.loads(json.dumps(dataclasses.asdict(config))), prefix)
    # The arm of a workcell's gripper follows from its model, and simulated episodes have no obstacles.
    unused = ("workcell.gripper.arm.", "workcell.obstacles", "workcell.camera_body")
    return ((path, value) for path, value in settings if not path.startswith(unused))


def _with_setting(settings: Any, path: Sequence[str], value: Any) -> Any:
    """Settings with another JSON value at a path.

    Raises:
      InputError: it is impossible, or there is no such path.
    """
    first, *rest = path
    if not hasattr(settings, first):
        raise InputError(f"setting {'.'.join(path)} is unknown to this version")
    part = getattr(settings, first)
    new = _with_setting(part, rest, value) if rest else _restored(part, value)
    return dataclasses.replace(settings, **{first: new})


def _restored(like: Any, value: Any) -> Any:
    """The inverse of `dataclasses.asdict` and JSON for values of the types in `like`."""
    if dataclasses.is_dataclass(like):
        return type(like)(**{name: _restored(getattr(like, name), part) for name, part in value.items()})
    if isinstance(value, list | tuple):
        first = like[0] if isinstance(like, tuple) and like else None
        return tuple(_restored(first, part) for part in value)
    return value
