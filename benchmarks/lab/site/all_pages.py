"""Every page, table and picture of the docs that comes of stored results, in one command."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence

from mechsearch_jax.benchmarks.lab.site import network_pages, reproduction_page, results_page
from mechsearch_jax.benchmarks.running import episode_seconds

PAGES: dict[str, Callable[[Sequence[str]], None]] = {
    "benchmarks/running/episode_seconds.json": episode_seconds.main,
    "docs/reproduction.md": reproduction_page.main,
    "docs/results.md": results_page.main,
    "docs/networks": network_pages.main,
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Rewrite what comes of stored results; the first mistake ends the program with one line."""
    text = "At the root of a checkout: write all pages, tables and pictures of the docs that come of stored results."
    argparse.ArgumentParser(description=text).parse_args(arguments)
    for name, write in PAGES.items():
        print(name, flush=True)
        write([])


if __name__ == "__main__":
    main()
