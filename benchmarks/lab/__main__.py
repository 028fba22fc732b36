"""What is measured for this package itself: `python -m mechsearch_jax.benchmarks.lab NAME ...`."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from mechsearch_jax.benchmarks.lab import PROGRAM
from mechsearch_jax.benchmarks.lab.commands import quality
from mechsearch_jax.commands.main import call_of, run


def parse(arguments: Sequence[str]) -> Callable[[], None]:
    """The command with its arguments, ready to be called.

    Raises:
      InputError: the arguments are wrong.
      SystemExit: after help was printed.
    """
    return call_of(PROGRAM, "Measure the parts, one command each.", quality.COMMANDS, arguments)


def main() -> None:
    """The program."""
    run(parse)


if __name__ == "__main__":
    main()
