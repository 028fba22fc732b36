"""What stands in for an episode: does what the scenario's name asks for, in worker processes that import it."""

import contextlib
import dataclasses
import os
import sys
import time
from pathlib import Path

from mechsearch_jax.runtime.cores import VARIABLE


def run(job):
    """The row of a job; the file that the variable LOG names tells which jobs were run."""
    name = job.scenario.name
    with open(os.environ["LOG"], "a") as log:
        log.write(f"{name} {os.getpid()}\n")
    if name == "hang":
        time.sleep(600)
    if name == "crash":
        print("out of luck", file=sys.stderr, flush=True)
        os._exit(3)
    if name == "raise":
        raise ValueError("no")
    if name == "exit":
        sys.exit("enough")
    return dataclasses.replace(
        job.failed(""),
        failure=None,
        found_step=1,
        graspable_step=2,
        retrieved=True,
        steps=3,
        planning_seconds=1.0,
        simulation_seconds=0.5,
    )


def one_by_one(jobs, ended, begin):
    """A runner that does so in this process."""
    for job in jobs:
        if begin(job):
            try:
                row = run(job)
            except ValueError as error:
                row = job.failed_by(error)
            ended([row])


def share(job):
    """Tells how many cores the worker may keep busy."""
    return job.failed(f"share {os.environ[VARIABLE]}")


def is_gone(pid, patience=10.0):
    """Whether a process is gone, or soon is."""
    for _ in range(int(patience / 0.1)):
        with contextlib.suppress(OSError):
            if Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z":
                time.sleep(0.1)
                continue
        return True
    return False
