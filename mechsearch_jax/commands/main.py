"""The command line: parse, call, print. `mechsearch --help` tells what there is.

Bad input ends a command with one line on standard error and status 2, and leaves existing output as it is. What a
command needs is imported when it runs, so that help and mistakes are answered at once.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import io
import re
import sys
from collections.abc import Callable, Mapping, Sequence

import tyro

from mechsearch_jax.commands import bench, bench_quality, scenarios, train
from mechsearch_jax.commands.evaluate import evaluate
from mechsearch_jax.commands.inspect import inspect
from mechsearch_jax.commands.report import report
from mechsearch_jax.commands.search import search
from mechsearch_jax.errors import InputError

Commands = Mapping[str, Callable[..., None]]


def _group(name: str, description: str) -> Callable[[], None]:
    """What stands for a group among the commands; `parse` looks into the group before it could be called."""

    def group() -> None: ...

    group.__name__ = name
    group.__doc__ = description
    return group


COMMANDS: Commands = {
    "search": search,
    "inspect": inspect,
    "evaluate": evaluate,
    "report": report,
    "scenarios": _group("scenarios", "Generate and check scenario files: mechsearch scenarios generate|check."),
    "train": _group("train", "Train the networks: mechsearch train segmentation|recognition|push."),
    "bench": _group("bench", "Measure the parts, one command each."),
}
GROUPS: Mapping[str, Commands] = {
    "scenarios": scenarios.COMMANDS,
    "train": train.COMMANDS,
    "bench": {**bench.COMMANDS, **bench_quality.COMMANDS},
}


def _deferred(command: Callable[..., None]) -> Callable[..., Callable[[], None]]:
    """A function with the same signature that only returns what is to be run."""

    @functools.wraps(command)
    def parsed(*args, **kwargs):
        return functools.partial(command, *args, **kwargs)

    return parsed


def one_line(complaint: str) -> str:
    """The message in the box that the parser draws around it, on one line."""
    plain = re.sub(r"\x1b\[[0-9;]*m", "", complaint)
    rows = [row.strip("│╭╰╮╯ \t") for row in plain.splitlines()]
    title, *rows = [row for row in rows if row] or ["the arguments are wrong"]
    body: list[str] = []
    for row in rows:
        if not row.strip("─"):
            break
        body.append(row)
    text = " ".join(body) if body else title.strip("─ ")
    return re.sub(r"\s+", " ", text)


def parse(arguments: Sequence[str]) -> Callable[[], None]:
    """The command that arguments ask for, ready to be called.

    Raises:
      InputError: the arguments are wrong.
      SystemExit: after help was printed.
    """
    group = arguments[0] if arguments and arguments[0] in GROUPS else None
    program = f"mechsearch {group}" if group else "mechsearch"
    commands = GROUPS[group] if group else COMMANDS
    description = COMMANDS[group].__doc__ if group else "Find a hidden object on a cluttered shelf and take it out."
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.extras.subcommand_cli_from_dict(
                {name: _deferred(command) for name, command in commands.items()},
                prog=program,
                description=description,
                args=list(arguments[1:] if group else arguments),
            )
    except SystemExit as end:
        if not end.code:
            raise
        raise InputError(f"{one_line(complaint.getvalue())} ({program} --help tells more)") from None


def main() -> None:
    """The console command `mechsearch`."""
    # Tracing makes millions of small objects that are not garbage: looking for it takes a fifth of a start.
    gc.set_threshold(200_000, 20, 20)
    try:
        parse(sys.argv[1:])()
    except InputError as error:
        print(f"mechsearch: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        print("mechsearch: stopped", file=sys.stderr)
        raise SystemExit(130) from None


if __name__ == "__main__":
    main()
