"""`mechsearch sweep`: many episodes, with several values of any option."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_origin

import tyro

from mechsearch_jax.commands.options import (
    EpisodeOptions,
    PaperMethod,
    SomeScenarios,
    chosen_policies,
    with_planner_options,
    world_argument,
)
from mechsearch_jax.commands.runs import USUAL_RUN, RunOptions, run_episodes_of
from mechsearch_jax.commands.world import swept
from mechsearch_jax.runtime.errors import InputError, nearest
from mechsearch_jax.runtime.tables import checked, read_document

if TYPE_CHECKING:
    from mechsearch_jax.runtime.tables import Document

Recognition = Literal["oracle", "masks", "masks-parts", "full", "full-parts", "informed"]
SimulatorName = Literal["auto", "native", "mjx"]
# Types of the keys of a sweep's file that are no options of the planner; all but the last two may be lists.
_KEYS: Mapping[str, Any] = {
    **dict.fromkeys(("scenarios", "policy", "method"), str),
    "seed": int,
    "recognition": Recognition,
    "simulator": SimulatorName,
    "config": str,
}
_SINGLE = ("simulator", "config")
# Keys that are fields of `SweptOptions`, and the names of the fields.
# The key and the table of `--world`.
_WORLD = "world"
_FIELDS = {"recognition": "recognition", "simulator": "simulator", "config": "config_file"}


@dataclasses.dataclass(frozen=True)
class SweptOptions:
    """What episodes run with, any number of values of each; `with_swept_options` adds the preset and the planner's.

    Attributes:
      config_file: a file of settings of camera, shelf, gripper, target, objects and planner; what else is given goes
        before it. One for all.
      recognition: "oracle" knows true shapes and poses, "informed" also the hidden target's; the others see a noisy
        depth image, "masks" with the true segmentation, "full" without.
      simulator: MuJoCo in C ("native") or on the GPU ("mjx"); "auto" takes the latter for batches where there is a GPU.
        One for all.
      world: how the simulated world differs from what the planner assumes, with commas between several values.
    """

    config_file: Annotated[Path | None, tyro.conf.arg(name="config", metavar="FILE.toml", help_behavior_hint="")] = None
    recognition: Annotated[
        tuple[Recognition, ...],
        tyro.conf.arg(metavar="{oracle,masks,full,informed} ...", help_behavior_hint="(default: oracle)"),
    ] = ()
    simulator: Annotated[
        SimulatorName | None, tyro.conf.arg(metavar="{auto,native,mjx}", help_behavior_hint="(default: auto)")
    ] = None
    world: tuple[str, ...] = ()

    def points(self) -> list[EpisodeOptions]:
        """All combinations of the values, in the order of the options.

        Raises:
          InputError: a value that is a list holds something else.
        """
        from mechsearch_jax.planner import OPTIONS

        kind: Any = with_planner_options()
        lists = {option.name: option.type for option in OPTIONS if get_origin(option.type) is tuple}
        values_of = {"recognition": self.recognition}
        values_of |= {name: getattr(self, name, ()) for name in ("preset", *(option.name for option in OPTIONS))}
        given: dict[str, list[Any]] = {
            name: [_listed(name, value, lists[name]) if name in lists else value for value in values]
            for name, values in values_of.items()
            if values
        }
        given["world"] = list(itertools.product(*swept(self.world).values()))
        file = None if self.config_file is None else Path(self.config_file)
        fixed: dict[str, Any] = {"config_file": file, "simulator": self.simulator or "auto"}
        return [kind(**fixed, **dict(zip(given, point, strict=True))) for point in itertools.product(*given.values())]


SWEPT_DEFAULTS = SweptOptions()


@dataclasses.dataclass(frozen=True)
class SweptPolicies:
    """Which policies decide in which episodes of a scenario.

    Attributes:
      file: a file with scenarios, policy, seed and options by their names with underscores, a value or a list of values
        each, and perhaps a table [world]; what is given here goes before it.
      method: one or more; search-for-grasp if neither this nor a policy is given.
      policy: instead of methods, names of policies, or import paths of others, one or more.
      seed: one or more; 0 if not given.
    """

    file: Annotated[Path | None, tyro.conf.arg(metavar="SWEEP.toml", help_behavior_hint="")] = None
    method: Annotated[tuple[PaperMethod, ...], tyro.conf.arg(help_behavior_hint="")] = ()
    policy: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME|MODULE:ATTRIBUTE ...", help_behavior_hint="")] = ()
    seed: Annotated[tuple[int, ...], tyro.conf.arg(help_behavior_hint="")] = ()

    def read(self) -> dict[str, Any]:
        """The values of the file by key, with policies of their own instead of the file's if any are given.

        Raises:
          InputError: as `read_sweep`.
        """
        values = {} if self.file is None else read_sweep(self.file)
        given = {"method": self.method, "policy": self.policy} if self.method or self.policy else {}
        return {**values, **given, **({"seed": self.seed} if self.seed else {})}


SWEPT_POLICIES = SweptPolicies()


def _listed(name: str, value: Any, kind: Any) -> tuple[Any, ...]:
    """The parts of a value that is itself a list; separated by commas on the command line."""
    if not isinstance(value, str):
        return tuple(value)
    try:
        return tuple(get_args(kind)[0](part.strip()) for part in value.split(","))
    except ValueError:
        raise InputError(
            f"sweep: --{name.replace('_', '-')} {value} is no list of numbers; give each value as 0.05,0.1, and one "
            "after the other to sweep over them"
        ) from None


@functools.cache
def with_swept_options() -> type[SweptOptions]:
    """`SweptOptions` with a field for the preset and for each option of the planner, empty if not given."""
    from mechsearch_jax.planner import OPTIONS, PRESETS

    def several(kind: Any, metavar: str, about: str) -> Any:
        shown = tyro.conf.arg(metavar=f"{metavar} ...", help=about, help_behavior_hint="")
        return Annotated[tuple[kind, ...], shown]

    names = ",".join(PRESETS)
    preset = several(Literal[tuple(PRESETS)], f"{{{names}}}", "where settings come from that are not given.")
    fields: list[tuple[str, Any, Any]] = [("preset", preset, ())]
    for option in OPTIONS:
        if get_origin(option.type) is tuple:
            part = "NAME" if get_args(option.type)[0] is str else "FLOAT"
            kind, metavar = str, f"{part},..."
        elif option.choices:
            kind, metavar = Literal[option.choices], f"{{{','.join(option.choices)}}}"
        else:
            kind, metavar = option.type, "{True,False}" if option.type is bool else str(option.type.__name__).upper()
        fields.append((option.name, several(kind, metavar, f"{option.help}."), ()))
    fields.append(("world", world_argument("VALUE,..."), ()))
    return dataclasses.make_dataclass("Swept", fields, bases=(SweptOptions,), frozen=True, kw_only=True)


def read_sweep(path: Path) -> dict[str, Any]:
    """Read the values of a sweep's file by key: tuples, except for keys with a single value for all episodes.

    Those of its table `world` are texts as on the command line.

    Raises:
      InputError: the file cannot be read, a key is unknown, or a value is of another type. The message names file, line
        and key.
    """
    from mechsearch_jax.envs.world.mismatch import MISMATCH_OPTIONS
    from mechsearch_jax.planner import OPTIONS, PRESETS

    document = read_document(path)
    for table in document.tables:
        if table not in ("", _WORLD):
            raise InputError(
                f"{document.where(table)} is a table, of which a sweep has [world] alone; give its settings by config"
            )
    options = {option.name: option.values for option in OPTIONS}
    values_of = _values(document, "", {**_KEYS, "preset": Literal[tuple(PRESETS)], **options})
    world = _values(document, _WORLD, {name: option.values for name, option in MISMATCH_OPTIONS.items()})
    if world:
        values_of[_WORLD] = tuple(f"{key}={','.join(map(str, values))}" for key, values in world.items())
    return values_of


def _values(document: Document, table: str, types: Mapping[str, Any]) -> dict[str, Any]:
    """The values of a table's keys, of these types: tuples of them, but for keys with a single value for all."""
    values_of: dict[str, Any] = {}
    for key, value in document.tables.get(table, {}).items():
        where = document.where(table, key)
        if key not in types:
            raise InputError(f"{where} is unknown; {nearest(key, types)}")
        if key in _SINGLE:
            values_of[key] = checked(value, types[key], where)
            continue
        is_list = get_origin(types[key]) is tuple
        several = isinstance(value, list) and (not is_list or any(isinstance(part, list) for part in value))
        values = value if several else [value]
        values_of[key] = tuple(
            checked(v, types[key], f"{where}[{i}]" if several else where) for i, v in enumerate(values)
        )
    return values_of


def sweep(
    scenarios: SomeScenarios = (),
    /,
    *,
    out: Path,
    policies: Annotated[SweptPolicies, tyro.conf.arg(name="")] = SWEPT_POLICIES,
    run: Annotated[RunOptions, tyro.conf.arg(name="")] = USUAL_RUN,
    options: SweptOptions = SWEPT_DEFAULTS,
) -> None:
    """Run many episodes with all combinations of several values of any option; otherwise as evaluate.

    The rows are those of evaluate, in the same kind of folder. Values of gamma share one compilation, in batches one
    batch.

    Args:
      scenarios: scenario files, folders of them, names of shipped ones or of scene sets.
      out: folder for the results, one row for each episode; those of which it holds a row are not run again.
      policies: who decides, and in which episodes.
      run: how the episodes are run.
      options: how the planner decides.
    """
    values = policies.read()
    names = chosen_policies("sweep", values.get("method"), values.get("policy"))
    fields = {name: values[key] for key, name in _FIELDS.items() if key in values}
    fields |= {key: value for key, value in values.items() if key not in _KEYS}
    given = swept(options.world)
    fields[_WORLD] = *(text for text in fields.get(_WORLD, ()) if text.partition("=")[0] not in given), *options.world
    options = dataclasses.replace(options, world=())
    not_on_command_line = {key: value for key, value in fields.items() if not getattr(options, key)}
    points = dataclasses.replace(options, **not_on_command_line).points()
    chosen = scenarios or values.get("scenarios", ())
    run_episodes_of("sweep", chosen, points, names, values.get("seed") or (0,), out, run)
