"""Options and arguments that several commands share."""

from __future__ import annotations

import dataclasses
import functools
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_type_hints

import tyro

from mechsearch_jax.commands.world import about_world, mismatch_of
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import check_writable, is_file, is_folder

if TYPE_CHECKING:
    from mechsearch_jax.envs.episode.method import Method
    from mechsearch_jax.envs.scenes.scene_sets import Block
    from mechsearch_jax.envs.simulators.named import EngineName
    from mechsearch_jax.envs.world.mismatch import Mismatch
    from mechsearch_jax.planner import Option
    from mechsearch_jax.problem.settings import Settings

PaperMethod = Literal["search-for-grasp", "search-and-grasp"]
PushModel = Literal["quasi-static", "learned", "physics"]


@dataclasses.dataclass(frozen=True)
class EpisodeOptions:
    """What episodes run with. `with_planner_options` adds the preset and all of the planner's options.

    Attributes:
      config_file: a file of settings of camera, shelf, gripper, target, objects and planner; what else is given here
        goes before it. `mechsearch config` prints an example.
      recognition: what the planner sees the objects through: "oracle" knows their true shapes and poses, "informed" the
        target's too; the others see noisy depth, "masks" with true segments; "-parts": bodies of up to four parts.
      simulator: what executes the actions: MuJoCo in C ("native") or on the GPU ("mjx"); "auto" takes the latter for
        batches where there is a GPU.
      sensor: the simulated depth camera; short for --world sensor=NAME.
      world: how the simulated world differs from what the planner assumes.
    """

    config_file: Annotated[Path | None, tyro.conf.arg(name="config", metavar="FILE.toml", help_behavior_hint="")] = None
    recognition: Literal["oracle", "masks", "masks-parts", "full", "full-parts", "informed"] = "oracle"
    simulator: Literal["auto", "native", "mjx"] = "auto"
    sensor: Annotated[
        Literal["ideal", "structured-light", "active-stereo", "time-of-flight"] | None,
        tyro.conf.arg(metavar="{ideal,structured-light,active-stereo,time-of-flight}", help_behavior_hint=""),
    ] = None
    world: tuple[str, ...] = ()

    def settings(self) -> Settings:
        """The configuration file's settings, overridden by the options that are given.

        Raises:
          InputError: the file cannot be used, or an option is impossible.
        """
        from mechsearch_jax.planner import OPTIONS

        named = {option: getattr(self, option.name, None) for option in OPTIONS}
        given = {option.name: option.inside(value) for option, value in named.items() if value is not None}
        return settings_of(self.config_file).with_options(getattr(self, "preset", None), **given)

    def mismatch(self) -> Mismatch:
        """How the simulated world differs from what the planner assumes.

        Raises:
          InputError: an option is impossible.
        """
        return mismatch_of((*self.world, *([] if self.sensor is None else [f"sensor={self.sensor}"])))

    def methods(self, policies: Sequence[str], engine: EngineName = "NativeSimulator") -> list[Method]:
        """The method of each policy.

        Raises:
          InputError: a policy, an option, the push model, the recognition or the mismatch cannot be used.
        """
        from mechsearch_jax.envs.episode.method import Method

        if any(":" in policy for policy in policies) and "" not in sys.path:
            # As Python does for a program that is not installed.
            sys.path.append("")
        settings, mismatch = self.settings(), self.mismatch()
        methods = [
            Method(name, settings.config, self.recognition, engine, settings.workcell, mismatch) for name in policies
        ]
        for method in methods:
            method.check()
        return methods

    def engine(self, gpu: Callable[[], bool] | None = None) -> EngineName:
        """The simulator that runs many episodes.

        Args:
          gpu: returns whether there is a GPU where they run; called only if needed. Default: on this machine.

        Raises:
          InputError: the simulator is not installed.
        """
        if self.simulator == "native" or (self.simulator == "auto" and not (gpu or has_gpu)()):
            return "NativeSimulator"
        from mechsearch_jax.envs.simulators.mjx_model import import_mjx

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
        """Refuse the batch simulator in a command that runs one episode.

        Raises:
          InputError: the simulator is "mjx".
        """
        if self.simulator == "mjx":
            raise InputError(
                f"{command}: --simulator mjx is for batches (mechsearch evaluate); leave it out for one episode"
            )

    def without_mismatch(self, command: str) -> None:
        """Refuse a mismatch in a command that simulates no episode.

        Raises:
          InputError: an option of it is given.
        """
        if self.world or self.sensor is not None:
            raise InputError(f"{command}: simulates no world that could differ; leave --world and --sensor out")


# Default of a command's parameter `options`, before `with_planner_options` adds the planner's.
DEFAULTS = EpisodeOptions()


@functools.cache
def with_planner_options() -> type[EpisodeOptions]:
    """`EpisodeOptions` with a field for the preset and for each option of the planner, None if not given.

    Importing the configuration, which defines them, takes a second.
    """
    from mechsearch_jax.planner import DEFAULT_PRESET, OPTIONS, PRESETS

    preset = tyro.conf.arg(
        metavar="{" + ",".join(PRESETS) + "}",
        help="where settings come from that are not given: what is best known, or the paper.",
        help_behavior_hint=f"(default: {DEFAULT_PRESET})",
    )
    fields: list[tuple[str, Any, Any]] = [("preset", Annotated[Literal[tuple(PRESETS)] | None, preset], None)]
    fields += [(option.name, _annotation(option, _usual(option)), None) for option in OPTIONS]
    fields.append(("world", world_argument(), ()))
    return dataclasses.make_dataclass("Options", fields, bases=(EpisodeOptions,), frozen=True, kw_only=True)


# Boxes of the help, by the names of their first words, with what they are about. Planner options are all the others.
BOXES = {
    "search": "Where settings come from, and how a search is run.",
    "recognition": "What the planner sees the objects through.",
    "planner": "How the next action is chosen.",
    "world": "What the simulated world is like.",
}
_SEARCH = ("config_file", "simulator", "preset", "retrieval_contact", "trials", "max_steps")


def _box(name: str) -> str:
    """The box of an option."""
    if name in ("recognition", "world", "sensor"):
        return "world" if name == "sensor" else name
    return "search" if name in _SEARCH else "planner"


def world_argument(values: str = "VALUE") -> Any:
    """The type of `--world`, whose help names every key."""
    about = tyro.conf.arg(metavar=f"KEY={values} ...", help=about_world(), help_behavior_hint="")
    return Annotated[tuple[str, ...], about]


@functools.cache
def in_boxes(options: type) -> type:
    """A type with the fields of a type of options in a part for each of `BOXES`; for the parser alone."""
    described = next(kind.__doc__ or "" for kind in options.__mro__ if "Attributes:" in (kind.__doc__ or ""))
    hints = get_type_hints(options, include_extras=True)
    parts: list[tuple[str, Any, Any]] = []
    for box, about in BOXES.items():
        fields = [
            (field.name, hints[field.name], field.default)
            for field in dataclasses.fields(options)
            if _box(field.name) == box
        ]
        part = dataclasses.make_dataclass(box.capitalize(), fields, frozen=True, kw_only=True)
        part.__doc__ = f"{about}\n\n    Attributes:{described.partition('Attributes:')[2]}"
        parts.append((box, Annotated[part, tyro.conf.OmitArgPrefixes], dataclasses.field(default_factory=part)))
    return dataclasses.make_dataclass("Boxes", parts, frozen=True, kw_only=True)


def out_of_boxes(options: type, boxes: Any) -> Any:
    """The options of an instance of `in_boxes(options)`."""
    return options(**{name: value for box in BOXES for name, value in vars(getattr(boxes, box)).items()})


def _annotation(option: Option, hint: str) -> Any:
    """The type of a command line's option that may be left out."""
    kind = Literal[option.choices] if option.choices else option.type
    shown = "{" + ",".join(option.choices) + "}" if option.choices else _METAVARS.get(option.type)
    # The hint shows the presets' values, also the paper's.
    text = re.sub(r"; (the paper's .*|not in the paper)$", "", option.help)
    about = tyro.conf.arg(metavar=shown, help=f"{text}.", help_behavior_hint=hint)
    return Annotated[kind | None, about]


def _usual(option: Option) -> str:
    """The hint for an option's default: the default preset's value, and other presets' where they differ."""
    from mechsearch_jax.planner import DEFAULT_PRESET, PRESETS

    values = {name: option.outside(preset().options()[option.name]) for name, preset in PRESETS.items()}
    shown = {
        name: " ".join(map(_short, value)) if isinstance(value, list | tuple) else value
        for name, value in values.items()
    }
    usual = shown.pop(DEFAULT_PRESET)
    presets_by_value: dict[Any, list[str]] = {}
    for name, value in shown.items():
        if value != usual:
            presets_by_value.setdefault(value, []).append(name)
    exceptions = [f", in preset {' and '.join(names)} {value}" for value, names in presets_by_value.items()]
    return f"(default: {usual}{''.join(exceptions)})"


def _short(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


_METAVARS: dict[Any, str] = {
    float: "FLOAT",
    int: "INT",
    bool: "{True,False}",
    tuple[float, ...]: "FLOAT ...",
    tuple[str, ...]: "NAME ...",
}


def settings_of(file: Path | None) -> Settings:
    """The settings of a configuration file; the defaults without one.

    Raises:
      InputError: the file cannot be used.
    """
    from mechsearch_jax.problem.settings import Settings, load_settings

    return Settings() if file is None else load_settings(file)


def base_of(file: Path | None) -> tuple[float, float, float]:
    """Where the robot's base stands in a configuration file's frame [m]; at its origin without a file."""
    from mechsearch_jax.problem.settings import Base
    from mechsearch_jax.runtime.tables import read_document, with_table

    return Base().position if file is None else with_table(read_document(file), "base", Base()).position


def chosen_policies(command: str, method: Sequence[str] | None, policy: Sequence[str] | None) -> Sequence[str]:
    """The policies that `--policy` or `--method` names; default: search-for-grasp.

    Raises:
      InputError: both are given.
    """
    if method and policy:
        raise InputError(f"{command}: give either --method or --policy, not both; --policy takes a method's name too")
    return method or policy or ("search-for-grasp",)


def has_gpu() -> bool:
    """Whether JAX uses an accelerator."""
    import jax

    return jax.default_backend() != "cpu"


@dataclasses.dataclass(frozen=True)
class OnePolicy:
    """How it is decided.

    Attributes:
      method: "search-for-grasp", the default, minds the grasp while it searches, "search-and-grasp" only afterwards.
      policy: instead of a method, the name of a policy (also random, greedy), or the import path of another.
    """

    method: Annotated[
        PaperMethod | None,
        tyro.conf.arg(metavar="{search-for-grasp,search-and-grasp}", help_behavior_hint=""),
    ] = None
    policy: Annotated[str | None, tyro.conf.arg(metavar="NAME|MODULE:ATTRIBUTE", help_behavior_hint="")] = None

    def chosen(self, command: str) -> Sequence[str]:
        """The one policy; see `chosen_policies`."""
        return chosen_policies(command, self.method and (self.method,), self.policy and (self.policy,))


# A parameter of a command, and its default.
DecidedBy = Annotated[OnePolicy, tyro.conf.arg(name="")]
USUAL_POLICY = OnePolicy()


Scenarios = Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="SCENARIO|FOLDER|SET ...")]

SomeScenarios = Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[SCENARIO|FOLDER|SET ...]")]
ConfigFile = Annotated[Path | None, tyro.conf.arg(metavar="FILE.toml")]
JsonFile = Annotated[Path | None, tyro.conf.arg(metavar="FILE")]
WeightsFile = Annotated[Path | None, tyro.conf.arg(metavar="FILE.npz")]


def at_least_one(command: str, **options: int | None) -> None:
    """Check that counts are at least 1; None means not given.

    Raises:
      InputError: a count is below 1.
    """
    for name, value in options.items():
        if value is not None and value < 1:
            raise InputError(f"{command}: --{name.replace('_', '-')} {value} must be at least 1")


def check_files(*files: Path | None) -> None:
    """Check before any work that output files can be written.

    Raises:
      InputError: a file cannot be written.
    """
    for file in files:
        if file is not None:
            check_writable(file.parent)


def forget_kept_compilations() -> None:
    """Turn the compilation cache off, to measure how long compiling takes."""
    import jax

    jax.config.update("jax_enable_compilation_cache", False)


def find_scenario(name: str) -> Path:
    """The file of a scenario, by its path, or by its name among shipped scenarios and scene sets.

    Raises:
      InputError: there is no such scenario.
    """
    from mechsearch_jax.envs.scenes.scene_sets import SETS, find_scene
    from mechsearch_jax.workspace.scenario import example_scenarios

    shipped = example_scenarios()
    if is_file(name):
        _warn_of_same_name(name)
        return Path(name)
    if name in shipped:
        return shipped[name]
    if name in SETS:
        first = SETS[name].blocks[0].scene_name(0)
        raise InputError(f"{name}: is a set of {SETS[name].scenes} scenes; name one of them, as {first}")
    scene = find_scene(name)
    if scene is None:
        raise InputError(
            f"{name}: there is no such file, nor a shipped scenario of that name ({', '.join(shipped)}), nor a scene "
            "set (mechsearch scenarios list)"
        )
    return files_of([scene])[0]


def find_scenarios(names: Sequence[str]) -> list[Path]:
    """The files that paths, folders and names stand for.

    A folder without scenario files stands for its subfolders. JSON files of another format in a folder, such as the
    episode.json that `search` writes beside its scenario, are skipped; each is named on standard error.

    Raises:
      InputError: there is no scenario for a name.
    """
    from mechsearch_jax.envs.scenes.scene_sets import SETS, set_scenes

    files: list[Path] = []
    for name in names:
        if is_folder(name):
            _warn_of_same_name(name)
            files += _files_in(Path(name))
        elif name in SETS and not is_file(name):
            files += files_of(set_scenes(SETS[name]))
        else:
            files.append(find_scenario(name))
    if not files:
        raise InputError("no scenario is given; name a file, a folder, a shipped scenario or a scene set")
    return files


def _warn_of_same_name(name: str) -> None:
    """Print a notice if a path takes precedence over a scene set, or a scene of one, of the same name."""
    from mechsearch_jax.envs.scenes.scene_sets import SETS, find_scene

    if name in SETS or find_scene(name):
        what = "folder" if is_folder(name) else "file"
        print(f"{name}: the {what} of this name is taken, not the scene set's", file=sys.stderr)


def _files_in(folder: Path) -> list[Path]:
    """Scenario files in a folder, or else in the folders in it.

    Raises:
      InputError: there are none.
    """
    from mechsearch_jax.workspace.scenario import is_another_format

    for pattern in ("*.json", "*/**/*.json"):
        inside = sorted(folder.glob(pattern))
        skipped = [file for file in inside if is_another_format(file)]
        for file in skipped:
            print(f"{file}: is not a scenario file and is left out", file=sys.stderr)
        if len(inside) > len(skipped):
            return [file for file in inside if file not in skipped]
    raise InputError(f"{folder}: there are no scenario files (*.json) in this folder or those in it")


def files_of(scenes: Sequence[tuple[Block, int]]) -> list[Path]:
    """Files of scenes of sets; making them shows its progress on standard error."""
    from mechsearch_jax.envs.scenes.scene_sets import scene_files
    from mechsearch_jax.problem.cache import keep_compilations

    def progress(missing: Sequence[Any]) -> Iterable[Any]:
        from rich.console import Console
        from rich.progress import track

        keep_compilations()
        return track(missing, "generating scenes", console=Console(stderr=True)) if missing else ()

    made = scene_files(scenes, progress=progress)
    tell_strange(made.strange)
    return made.files


def tell_strange(scenes: Sequence[str]) -> None:
    """Print a notice about scenes of sets that differ from the record."""
    if scenes:
        who = f"{scenes[0]} and {len(scenes) - 1} more" if scenes[1:] else scenes[0]
        print(
            f"{who}: made here, not what is on record; results are not those of these scenes elsewhere", file=sys.stderr
        )
