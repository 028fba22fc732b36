"""Options and arguments that several commands share."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from mechsearch_jax.errors import InputError

if TYPE_CHECKING:
    from mechsearch_jax.planner import PlannerConfig

Method = Literal["search-for-grasp", "search-and-grasp"]
Actions = Literal["both", "push", "pick-and-place"]
Recognition = Literal["oracle", "masks", "full"]
PushModel = Literal["quasi-static", "learned", "physics"]
TargetShape = Literal["cylinder", "box"]


@dataclasses.dataclass(frozen=True)
class PlannerOptions:
    """How the planner decides. What is not given is the preset's.

    Attributes:
      preset: where settings come from that are not given; "best" stands for the best known ones, which so far are
        the same as "paper".
      gamma: discount of later actions, above 0 and at most 1; the paper's is 0.9.
      horizon: actions in a sequence; the paper's is 3.
      sequences: sequences that are sampled for a decision; 30 by default.
      actions: which actions are used; both by default.
      criterion: what makes a target visible; "detector", the default, counts pixels as the detector does.
      focus: share of the sampled actions that go to objects by how much they hide or are in the way, 0.7 by default;
        0 is the paper's even draw.
      push_model: what predicts pushes: "learned", the default, by a network, "quasi-static" by geometry, "physics" by
        simulating them, on a CPU only those that come first.
      topple_charge: what a push costs, as a share of the cost J, times how many objects are expected to fall over; 0 by
        default. One after which an object falls with more than 0.5 is never made.
      max_steps: actions in an episode; 10 by default.
      recognition: what the planner sees the objects through: "oracle" knows their true shapes and poses; the others see
        a noisy depth image, "masks" with the true segmentation, "full" without.
      simulator: what executes the actions: MuJoCo in C ("native") or on the GPU ("mjx"); "auto" takes the latter for
        batches where there is a GPU.
    """

    preset: Literal["paper", "best"] = "paper"
    gamma: Annotated[float | None, tyro.conf.arg(metavar="FLOAT")] = None
    horizon: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    sequences: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    actions: Annotated[Actions | None, tyro.conf.arg(metavar="{both,push,pick-and-place}")] = None
    criterion: Annotated[
        Literal["detector", "depth-mse", "depth-norm"] | None,
        tyro.conf.arg(metavar="{detector,depth-mse,depth-norm}"),
    ] = None
    focus: Annotated[float | None, tyro.conf.arg(metavar="FLOAT")] = None
    push_model: Annotated[PushModel | None, tyro.conf.arg(metavar="{quasi-static,learned,physics}")] = None
    topple_charge: Annotated[float | None, tyro.conf.arg(metavar="FLOAT")] = None
    max_steps: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    recognition: Recognition = "oracle"
    simulator: Literal["auto", "native", "mjx"] = "auto"

    def config(self, method: Method) -> PlannerConfig:
        """The planner's configuration: the preset's, with what is given in its place.

        Raises:
          InputError: an option is impossible, or the push model cannot be used.
        """
        from mechsearch_jax.envs.push_models import push_models
        from mechsearch_jax.planner import PlannerConfig

        presets = {"paper": PlannerConfig.paper, "best": PlannerConfig.paper}
        names = (
            "gamma",
            "horizon",
            "sequences",
            "actions",
            "criterion",
            "focus",
            "push_model",
            "topple_charge",
            "max_steps",
        )
        given = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        config = presets[self.preset](method=method, **given)
        # Missing weights are to be told of now, not by every episode.
        push_models(config.push_model)
        return config

    def engine(self) -> str:
        """The class of the simulator that runs many episodes.

        Raises:
          InputError: it is not installed.
        """
        from mechsearch_jax.envs.mjx_simulator import import_mjx

        if self.simulator == "native" or (self.simulator == "auto" and not has_gpu()):
            return "NativeSimulator"
        if self.simulator == "mjx":
            import_mjx()
            return "MjxSimulator"
        try:
            import_mjx()
        except InputError as error:
            print(f"mechsearch: {error}; using the native simulator", file=sys.stderr)
            return "NativeSimulator"
        return "MjxSimulator"

    def only_native(self, command: str) -> None:
        """Refuse the batch simulator where one episode is run.

        Raises:
          InputError: it was asked for.
        """
        if self.simulator == "mjx":
            raise InputError(
                f"{command}: --simulator mjx is for batches (mechsearch evaluate); leave it out for one episode"
            )


def has_gpu() -> bool:
    """Whether JAX computes on something else than the CPU."""
    import jax

    return jax.default_backend() != "cpu"


Options = Annotated[PlannerOptions, tyro.conf.arg(name="")]
DEFAULTS = PlannerOptions()
Scenarios = Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="SCENARIO|FOLDER ...")]

JsonFile = Annotated[Path | None, tyro.conf.arg(metavar="FILE")]
WeightsFile = Annotated[Path | None, tyro.conf.arg(metavar="FILE.npz")]


def at_least_one(command: str, **options: int | None) -> None:
    """Refuse counts below 1; None stands for what is not given.

    Raises:
      InputError: one is.
    """
    for name, value in options.items():
        if value is not None and value < 1:
            raise InputError(f"{command}: --{name.replace('_', '-')} {value} must be at least 1")


def find_scenario(name: str) -> Path:
    """The file that a scenario's path, or the name of one that ships with the package, stands for.

    Raises:
      InputError: there is neither.
    """
    from mechsearch_jax.workspace.scenario import example_scenarios

    shipped = example_scenarios()
    if Path(name).is_file():
        return Path(name)
    if name in shipped:
        return shipped[name]
    raise InputError(f"{name}: there is no such file, nor a shipped scenario of that name ({', '.join(shipped)})")


def find_scenarios(names: Sequence[str]) -> list[Path]:
    """The files that paths, folders and names stand for.

    In a folder, JSON files that are plainly something else, as the episode.json that `search` writes beside its
    scenario, are left out; each is named on standard error.

    Raises:
      InputError: there is nothing for one of them.
    """
    from mechsearch_jax.workspace.scenario import is_another_format

    files: list[Path] = []
    for name in names:
        if Path(name).is_dir():
            inside = sorted(Path(name).glob("*.json"))
            others = [file for file in inside if is_another_format(file)]
            for file in others:
                print(f"{file}: is not a scenario file and is left out", file=sys.stderr)
            inside = [file for file in inside if file not in others]
            if not inside:
                raise InputError(f"{name}: there are no scenario files (*.json) in this folder")
            files += inside
        else:
            files.append(find_scenario(name))
    if not files:
        raise InputError("no scenario is given; name a file, a folder or a shipped scenario")
    return files
