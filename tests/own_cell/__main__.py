"""Run searches in the cell, one JSON file each as they end, and print what came of them; a run that was killed goes on.

python -m tests.own_cell --layouts 8 --seeds 5 --out DIR [--workers N] [--target box|cylinder] [--film]
"""

import argparse
import concurrent.futures
import json
import multiprocessing
import os
import traceback
from pathlib import Path

from . import search, summary


def main():
    parser = argparse.ArgumentParser(prog="python -m tests.own_cell", description=__doc__.splitlines()[0])
    parser.add_argument("--layouts", type=int, default=8, help="how many layouts, drawn by number from 0")
    parser.add_argument("--seeds", type=int, default=5, help="searches of each, from 0")
    parser.add_argument("--out", type=Path, required=True, help="folder of rows, trajectory files and pictures")
    parser.add_argument("--workers", type=int, default=1, help="processes, of one thread each")
    parser.add_argument("--target", choices=["box", "cylinder"], default="box", help="green box, or white with masks")
    parser.add_argument("--arm", choices=["panda", "fr3"], default="panda")
    parser.add_argument("--film", action="store_true", help="draw the images of lost searches")
    parser.add_argument("--report", action="store_true", help="only print what there is")
    given = parser.parse_args()
    rows = given.out / "rows"
    rows.mkdir(parents=True, exist_ok=True)
    jobs = [(layout, seed) for seed in range(given.seeds) for layout in range(given.layouts)]
    jobs = [job for job in jobs if not _path(rows, given, *job).exists() and not given.report]
    # What workers read as they import NumPy and JAX.
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "JAX_PLATFORMS": "cpu"}
    context = multiprocessing.get_context("spawn")
    settings = {"mp_context": context, "initializer": _on_one_core, "initargs": (context.Value("i", 0), given.workers)}
    with concurrent.futures.ProcessPoolExecutor(given.workers, **settings) as pool:
        running = {pool.submit(_search, given, layout, seed): (layout, seed) for layout, seed in jobs}
        for done in concurrent.futures.as_completed(running):
            print(*running[done], done.result(), flush=True)
    kept = [json.loads(path.read_text()) for path in sorted(rows.glob(f"{given.target}-{given.arm}-*.json"))]
    print(summary.table(kept))
    (given.out / f"summary-{given.target}-{given.arm}.md").write_text(summary.table(kept) + "\n")


def _on_one_core(count, workers):
    """Keep this process, and so all its threads, to a core of its own; one alone takes what there is."""
    if workers == 1:
        return
    with count.get_lock():
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[count.value % len(cores)]})
        count.value += 1


def _path(rows, given, layout, seed):
    return rows / f"{given.target}-{given.arm}-{layout}-{seed}.json"


def _search(given, layout, seed):
    try:
        row = search.run(layout, seed, given.target, given.arm, given.out, given.film)
    except Exception as error:
        # An error is a lost search with its reason, and does not end the others.
        row = {
            "layout": layout,
            "seed": seed,
            "target": given.target,
            "arm": given.arm,
            "retrieved": False,
            "why": f"error: {type(error).__name__}: {error}",
            "trace": traceback.format_exc(),
            "steps": [],
        }
    search.save(row, _path(given.out / "rows", given, layout, seed))
    return f"{'retrieved' if row['retrieved'] else 'lost'}: {row['why']}"


if __name__ == "__main__":
    main()
