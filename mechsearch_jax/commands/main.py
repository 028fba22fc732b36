"""The command line: parse, call, print. `mechsearch --help` lists the commands.

Bad input ends a command with one line on standard error and status 2, and leaves existing output unchanged. A command
imports its dependencies when it runs, so that help and errors appear immediately.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import importlib.metadata
import inspect
import io
import os
import re
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, get_type_hints

import tyro

from mechsearch_jax.commands import bench, scenarios, train
from mechsearch_jax.commands.cell.calibrate import calibrate
from mechsearch_jax.commands.cell.doctor import doctor, print_config
from mechsearch_jax.commands.evaluate import evaluate
from mechsearch_jax.commands.inspect import inspect as inspect_scenarios
from mechsearch_jax.commands.options import EpisodeOptions, in_boxes, out_of_boxes, with_planner_options
from mechsearch_jax.commands.plan import plan
from mechsearch_jax.commands.recordings import video, view
from mechsearch_jax.commands.report import report
from mechsearch_jax.commands.reproduce import reproduce
from mechsearch_jax.commands.search import search
from mechsearch_jax.commands.sweep import SweptOptions, sweep, with_swept_options
from mechsearch_jax.runtime.errors import InputError, Note, nearest
from mechsearch_jax.runtime.own_settings import OWN

Commands = Mapping[str, Callable[..., None]]


def _only_described(description: str | None) -> Callable[[], None]:
    """A command without arguments that does nothing, for the list of commands."""

    def described() -> None: ...

    described.__doc__ = description
    return described


COMMANDS: Commands = {
    "search": search,
    "plan": plan,
    "calibrate": calibrate,
    "inspect": inspect_scenarios,
    "video": video,
    "view": view,
    "evaluate": evaluate,
    "sweep": sweep,
    "reproduce": reproduce,
    "report": report,
    "config": print_config,
    "doctor": doctor,
    "scenarios": _only_described(
        "List scene sets, generate, check and import scenarios: mechsearch scenarios list|generate|check|import."
    ),
    "train": _only_described("Train the networks: mechsearch train segmentation|recognition|push."),
    "bench": _only_described("Time the parts and whole episodes, one command each."),
}
GROUPS: Mapping[str, Commands] = {
    "scenarios": scenarios.COMMANDS,
    "train": train.COMMANDS,
    "bench": bench.COMMANDS,
}
# What only a checkout has: benchmarks/lab, once commands of `mechsearch bench`.
IN_A_CHECKOUT = ("agreement", "push", "recognition", "scenes", "segmentation", "sensors")


# Complete option types, which take a second to make, by the type in a command's signature.
_OPTIONS: Mapping[type, Callable[[], type]] = {
    EpisodeOptions: with_planner_options,
    SweptOptions: with_swept_options,
}


def _deferred(command: Callable[..., None]) -> Callable[..., Callable[[], None]]:
    """A function that takes the command's arguments, with all options if it takes any, and returns the call to run."""

    # A named function may be wrapped by a checker of annotations, and the parser looks beneath what is wrapped.
    parsed: Any = lambda *args, **kwargs: functools.partial(command, *args, **kwargs)  # noqa: E731
    plain = inspect.unwrap(command)
    hints, signature = get_type_hints(plain, include_extras=True), inspect.signature(plain)
    parameters = dict(signature.parameters)
    if "options" in hints:
        options = _OPTIONS[hints["options"]]()
        boxes = in_boxes(options)
        parsed = lambda *args, **kwargs: functools.partial(  # noqa: E731
            command, *args, **kwargs | {"options": out_of_boxes(options, kwargs["options"])}
        )
        hints["options"] = Annotated[boxes, tyro.conf.arg(name="")]
        parameters["options"] = parameters["options"].replace(default=boxes())
    for name, parameter in parameters.items():
        # The help of such an option describes its default.
        given_by_place = parameter.kind is inspect.Parameter.POSITIONAL_ONLY
        if parameter.default is None or parameter.default == () or given_by_place:
            hints[name] = Annotated[hints[name], tyro.conf.arg(help_behavior_hint="")]
    parsed.__name__, parsed.__doc__, parsed.__annotations__ = command.__name__, command.__doc__, hints
    parsed.__signature__ = signature.replace(parameters=list(parameters.values()))
    return parsed


def one_line(complaint: str) -> str:
    """The message in the parser's box as one line, with the option that the parser suggests."""
    plain = re.sub(r"\x1b\[[0-9;]*m", "", complaint)
    rows = [row.strip("│╭╰╮╯ \t") for row in plain.splitlines()]
    title, *rows = [row for row in rows if row] or ["the arguments are wrong"]
    # Without box characters, the title is underlined.
    while rows and not rows[0].strip("─-"):
        del rows[0]
    body: list[str] = []
    for row in rows:
        if not row.strip("─-"):
            break
        body.append(row)
    text = " ".join(body) if body else title.strip("─ ")
    meant = re.search(r"Perhaps you meant:\s+(--[\w-]+)", " ".join(rows))
    return re.sub(r"\s+", " ", f"{text}; did you mean {meant[1]}?" if meant else text)


def parse(arguments: Sequence[str]) -> Callable[[], None]:
    """The command with its arguments, ready to be called.

    Raises:
      InputError: the arguments are wrong.
      SystemExit: after help or the version was printed.
    """
    if list(arguments) == ["--version"]:
        print(f"mechsearch {importlib.metadata.version('mechsearch-jax')}")
        raise SystemExit
    group = arguments[0] if arguments and arguments[0] in GROUPS else None
    program = f"mechsearch {group}" if group else "mechsearch"
    commands = GROUPS[group] if group else COMMANDS
    description = COMMANDS[group].__doc__ if group else "Find a hidden object on a cluttered shelf and take it out."
    rest = list(arguments[1:] if group else arguments)
    if program == "mechsearch bench" and rest and rest[0] in IN_A_CHECKOUT:
        raise InputError(
            f"{program} {rest[0]} needs a checkout: run `python -m mechsearch_jax.benchmarks.lab {rest[0]}` in one"
        )
    return call_of(program, description, commands, rest)


def call_of(program: str, description: str | None, commands: Commands, arguments: Sequence[str]) -> Callable[[], None]:
    """The one of a program's commands that is named first, with its arguments, ready to be called.

    Raises:
      InputError: the arguments are wrong.
      SystemExit: after help was printed.
    """
    rest = list(arguments)
    name = rest[0] if rest else None
    if name is not None and name not in commands and not name.startswith("-"):
        raise InputError(
            f'there is no command "{program} {name}"; {nearest(name, commands)} ({program} --help tells more)'
        )
    # Only the given command needs its options, which take long to make.
    parsed = {n: _deferred(c) if n == name else _only_described(c.__doc__) for n, c in commands.items()}
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            command: Any = tyro.extras.subcommand_cli_from_dict(
                parsed, prog=program, description=description, args=rest
            )
    except SystemExit as end:
        if not end.code:
            raise
        helpful = f"{program} {name}" if name in commands else program
        raise InputError(f"{one_line(complaint.getvalue())} ({helpful} --help tells more)") from None
    return command


def _noted(usual: Callable[..., None]) -> Callable[..., None]:
    """A function that shows a `Note` as a line of its own, and any other warning as usual."""

    def show(message: Warning | str, category: type[Warning], *place: Any) -> None:
        if issubclass(category, Note):
            print(f"mechsearch: {message}", file=sys.stderr)
        else:
            usual(message, category, *place)

    return show


def run(parse: Callable[[Sequence[str]], Callable[[], None]]) -> None:
    """Run what the command line says, as `parse` reads it; bad input ends with one line and status 2."""
    # Tracing makes millions of small objects that are not garbage: looking for it takes a fifth of a start.
    gc.set_threshold(200_000, 20, 20)
    # They are meant for other programs; so worker processes do without them, too.
    for name in OWN:
        os.environ.pop(name.upper(), None)
    warnings.showwarning = _noted(warnings.showwarning)
    try:
        parse(sys.argv[1:])()
    except InputError as error:
        print(f"mechsearch: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        print("mechsearch: stopped", file=sys.stderr)
        raise SystemExit(130) from None
    except BrokenPipeError:
        # The reader, such as `head`, has closed the pipe. Discard the rest that Python writes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(141) from None


def main() -> None:
    """The console command `mechsearch`."""
    run(parse)


if __name__ == "__main__":
    main()
