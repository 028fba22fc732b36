"""All settings of the planner, the problem and an episode.

Discrete settings decide the shapes of a computation and are static under jit. Continuous ones of the planner are
dynamic, so that changing them compiles nothing.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any, Literal, NamedTuple, get_args, get_type_hints

import jax
from jaxtyping import Array

from mechsearch_jax.actions.config import ActionConfig
from mechsearch_jax.dynamics.named import PushModelName, check_name
from mechsearch_jax.existence import ExistenceConfig
from mechsearch_jax.grasping.config import GraspConfig
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.options import DEGREES, in_degrees, in_radians, option

TrialsName = Literal["none", "physics"]


class Weights(NamedTuple):
    """Weights of the terms that J adds to equation 2; see `PlannerConfig`.

    Attributes:
      crowding: of the objects that obstruct the grasps of a pose.
    """

    crowding: Array | float = 0.0


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=(
        "gamma",
        "unseen_contact_penalty",
        "guided_fraction",
        "crowding_weight",
    ),
    meta_fields=(
        "horizon",
        "sequences",
        "move_target",
        "retrieval_contact",
        "as_in_paper",
    ),
)
@dataclasses.dataclass(frozen=True)
class PlannerConfig:
    """How the planner decides: a pytree whose leaves are the settings that are not static.

    Attributes:
      gamma: discount of equation 2, in (0, 1]. The paper gives none; 0.9 is ours.
      horizon: M, actions in a sequence; static.
      sequences: number of sequences sampled for a decision; static.
      unseen_contact_penalty: cost of touching the hidden target, in units of J: the penalty of a sampled action is J
        times the share of the possible poses at which it would touch the target, and J more if it enters space that
        was not measured. If no sequence gains anything then, the latter is dropped, and if none does still, the former.
        The paper has none.
      guided_fraction: share of the draws that prefer objects that hide much or are in the way, from 0 to below 1; the
        other draws are uniform, as all are in the paper.
      crowding_weight: weight in J of objects that only some of a pose's grasps hit; the paper's J counts the best grasp
        of a pose alone. Small enough that no number of hits outweighs one object of the cost proper.
      move_target: whether a found target may be pushed, too; static. Nothing else helps if every grasp of it hits an
        object that can neither be grasped nor pushed, but that is too rare to gain anything.
      retrieval_contact: whether a grasp that hits objects may take a found target out if its trial succeeds; static.
        Not so in the paper. If False, only grasps that hit nothing are tried.
      as_in_paper: set by preset `paper` alone; static. An object may then move more than once in a sequence, an action
        is drawn more often until one is possible, and f rules out overlaps of the target with objects (equation 14) in
        predicted states, too. If False, poses that an object is moved to stay possible: a target there would be pushed
        along.
    """

    gamma: float = option(0.9, "discount of later actions, above 0 and at most 1")
    horizon: int = option(1, "actions in a sequence; the paper's is 3")
    sequences: int = option(100, "sequences that are sampled for a decision; the paper's is 30")
    unseen_contact_penalty: float = 1.0
    guided_fraction: float = 0.7
    crowding_weight: float = 0.02
    move_target: bool = option(False, "whether a found target may be pushed, too, as it may not in the paper")
    retrieval_contact: bool = option(
        True, "whether trials may take a found target out with a grasp that touches objects; not in the paper"
    )
    as_in_paper: bool = False

    @property
    def draws(self) -> tuple[int, int]:
        """How often an action is drawn until one is possible: the first of a sequence, and a later one.

        A first action is executed, so it is worth more draws. The paper has no limit: 8 is an approximation.
        """
        return (8, 8) if self.as_in_paper else (4, 1)

    @property
    def weights(self) -> Weights:
        """The weights of an `Objective`."""
        return Weights(self.crowding_weight)

    def __post_init__(self):
        # In a pytree rebuilt by JAX, dynamic fields may hold tracers or other stand-ins, which are not checked.
        number = lambda name: isinstance(getattr(self, name), int | float)  # noqa: E731
        if number("gamma") and not 0.0 < self.gamma <= 1.0:
            raise InputError(f"gamma {self.gamma} is outside (0, 1]; the default is 0.9")
        for name in ("unseen_contact_penalty", "crowding_weight"):
            if number(name) and not 0.0 <= getattr(self, name) < math.inf:
                raise InputError(f"{name} {getattr(self, name)} must be a number that is not negative")
        if number("guided_fraction") and not 0.0 <= self.guided_fraction < 1.0:
            raise InputError(
                f"guided_fraction {self.guided_fraction} is outside [0, 1); the default is 0.7, and 0 draws evenly"
            )
        for name in ("horizon", "sequences"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} {getattr(self, name)} must be at least 1")


@dataclasses.dataclass(frozen=True)
class ProblemConfig:
    """How a problem is built; hashable, static under jit.

    Attributes:
      existence: of f.
      grasps: the candidate grasps of g.
      retrieval: a denser set of grasps for the found target.
      actions: the possible actions.
    """

    existence: ExistenceConfig = dataclasses.field(default_factory=ExistenceConfig)
    grasps: GraspConfig = dataclasses.field(default_factory=GraspConfig)
    retrieval: GraspConfig = dataclasses.field(default_factory=GraspConfig.dense)
    actions: ActionConfig = dataclasses.field(default_factory=ActionConfig)


@dataclasses.dataclass(frozen=True)
class Config:
    """All settings of an episode apart from scenario, seed, policy, recognition and simulator.

    Attributes:
      problem: how the problem is built.
      planner: how the planner decides.
      push_model: name of a push model; see `dynamics.named`, and `envs.pushing.push_models` for "physics".
      trials: name of what tries actions before one is executed; see `envs.trials`. The paper tries nothing.
      max_steps: T, actions in an episode.
    """

    problem: ProblemConfig = dataclasses.field(default_factory=ProblemConfig)
    planner: PlannerConfig = dataclasses.field(default_factory=PlannerConfig)
    push_model: PushModelName = option(
        "learned",
        "what predicts pushes: a network, geometry, or simulating them, on a CPU only those that come first",
        get_args(PushModelName),
    )
    trials: TrialsName = option(
        "physics",
        "what tries the best few actions out before one is made: nothing, or a simulation",
        get_args(TrialsName),
    )
    max_steps: int = option(10, "actions in an episode")

    def __post_init__(self):
        check_name(self.push_model)
        if self.trials not in get_args(TrialsName):
            raise InputError(f'trials "{self.trials}" is unknown; use {", ".join(get_args(TrialsName))}')
        if self.max_steps < 1:
            raise InputError(f"max_steps {self.max_steps} must be at least 1")

    def options(self) -> dict[str, Any]:
        """The values of all `OPTIONS` by name, as JSON values, for rows and episodes."""
        values = {option.name: _at(self, option.path) for option in OPTIONS}
        return {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}

    def with_options(self, **changes: Any) -> Config:
        """The configuration with other values of some `OPTIONS`, by name; lists become tuples.

        Raises:
          InputError: there is no such option, or a value is impossible.
        """
        config = self
        paths = {option.name: option.path for option in OPTIONS}
        for name, value in changes.items():
            if name not in paths:
                raise InputError(f"option {name} is unknown; there are {', '.join(paths)}")
            config = _with(config, paths[name], tuple(value) if isinstance(value, list) else value)
        return config


@dataclasses.dataclass(frozen=True)
class Option:
    """A setting that is a column of results and an option of the command line.

    Attributes:
      name: of the option, unique.
      path: the fields that lead to it from a `Config`.
      type: of a value.
      help: one line.
      choices: the values it may have; any if None.
      least_degrees: as of `runtime.options.option`.
    """

    name: str
    path: tuple[str, ...]
    type: Any
    help: str
    choices: tuple[str, ...] | None
    least_degrees: float | None = None

    @classmethod
    def of_field(cls, field: dataclasses.Field[Any], kind: Any, path: tuple[str, ...] = ()) -> Option:
        """The option of a field that `runtime.options.option` made, of a type, at a path."""
        about = field.metadata
        kind = str if about["choices"] else kind
        return cls(field.name, (*path, field.name), kind, about["help"], about["choices"], about[DEGREES])

    @property
    def values(self) -> Any:
        """The type of its values, which are among `choices` if it has some."""
        return Literal[self.choices] if self.choices else self.type

    def inside(self, given: Any) -> Any:
        """A value of a file or the command line as the field holds it: angles in radians.

        Raises:
          InputError: an angle was meant in radians.
        """
        return in_radians(self.name, given, self.least_degrees)

    def outside(self, value: Any) -> Any:
        """A field's value as files and the command line have it: angles in degrees."""
        return value if self.least_degrees is None else in_degrees(value)


def _at(value: Any, path: tuple[str, ...]) -> Any:
    for name in path:
        value = getattr(value, name)
    return value


def _with(value: Any, path: tuple[str, ...], new: Any) -> Any:
    inner = new if len(path) == 1 else _with(getattr(value, path[0]), path[1:], new)
    return dataclasses.replace(value, **{path[0]: inner})


def _fields(kind: type, path: tuple[str, ...]) -> tuple[Option, ...]:
    """The options among the fields of a configuration class, in their order."""
    hints = get_type_hints(kind)
    return tuple(
        Option.of_field(field, hints[field.name], path)
        for field in dataclasses.fields(kind)
        if "help" in field.metadata
    )


OPTIONS: tuple[Option, ...] = (
    *_fields(PlannerConfig, ("planner",)),
    *_fields(ActionConfig, ("problem", "actions")),
    *_fields(Config, ()),
)
