"""Run searches in the cell, one JSON file each as they end, and print what came of them; a run that was killed goes on.

python -m tests.own_cell --layouts 8 --seeds 5 --out DIR [--first N] [--workers N] [--target box|cylinder]
"""

import argparse
import concurrent.futures
import json
import multiprocessing
import os
from pathlib import Path

from . import search, summary


def main():
    parser = argparse.ArgumentParser(prog="python -m tests.own_cell", description=__doc__.splitlines()[0])
    parser.add_argument("--first", type=int, default=0, help="number that the first layout is drawn by")
    parser.add_argument("--layouts", type=int, default=8, help="how many layouts, one number after another")
    parser.add_argument("--seeds", type=int, default=5, help="searches of each, from 0")
    parser.add_argument("--out", type=Path, required=True, help="folder of rows, trajectory files and pictures")
    parser.add_argument("--workers", type=int, default=1, help="processes, of one thread each")
    parser.add_argument("--target", choices=["box", "cylinder"], default="box", help="green box, or white with masks")
    parser.add_argument("--arm", choices=["panda", "fr3"], default="panda")
    parser.add_argument("--force", type=float, help="on the hand at which the arm stops [N]; each motion's own bound")
    parser.add_argument("--film", action="store_true", help="draw the images of lost searches")
    parser.add_argument("--report", action="store_true", help="only print what there is")
    parser.add_argument("--store", type=Path, help="also write what came of them to this JSON file, beside others")
    given = parser.parse_args()
    rows, what = given.out / "rows", (given.target, given.arm)
    rows.mkdir(parents=True, exist_ok=True)
    jobs = [(layout, seed) for seed in range(given.seeds) for layout in range(given.first, given.first + given.layouts)]
    jobs = [job for job in jobs if not search.row_file(given.out, *job, *what).exists() and not given.report]
    # What workers read as they import NumPy and JAX.
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "JAX_PLATFORMS": "cpu"}
    context = multiprocessing.get_context("spawn")
    settings = {
        "mp_context": context,
        "initializer": search.on_one_core,
        "initargs": (context.Value("i", 0), given.workers),
    }
    with concurrent.futures.ProcessPoolExecutor(given.workers, **settings) as pool:
        running = {pool.submit(search.kept, *job, *what, given.out, given.force, given.film): job for job in jobs}
        for done in concurrent.futures.as_completed(running):
            print(*running[done], done.result(), flush=True)
    kept = [json.loads(path.read_text()) for path in sorted(rows.glob(f"{given.target}-{given.arm}-*.json"))]
    print(summary.table(kept))
    (given.out / f"summary-{given.target}-{given.arm}.md").write_text(summary.table(kept) + "\n")
    if given.store:
        results = json.loads(given.store.read_text()) if given.store.exists() else {"searches": {}}
        results["searches"][f"{given.target} on {given.arm}"] = summary.stored(kept)
        given.store.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
