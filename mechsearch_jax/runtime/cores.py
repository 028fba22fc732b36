"""The host's processors: how many cores this process may use, and how to compute on them if there is a GPU."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any

# Environment variable that limits the cores of a process.
VARIABLE = "MECHSEARCH_CORES"


def cores() -> int:
    """`MECHSEARCH_CORES`, or the cores that this process may use: those of its affinity, but no more than its control
    group's quota of processor time (`docker run --cpus`) keeps busy, rounded down, and at least one."""
    given = os.environ.get(VARIABLE, "")
    if given.isdecimal() and int(given) > 0:
        return int(given)
    there = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(int(min(there, cpu_quota())), 1)


def cpu_quota(root: Path = Path("/")) -> float:
    """Cores' worth of time that Linux's scheduler gives this process's control groups, of either version; infinite
    without a quota, and where nothing says so.

    Args:
      root: of the file system.
    """
    try:
        groups = (root / "proc/self/cgroup").read_text().splitlines()
        mounts = (root / "proc/self/mountinfo").read_text().splitlines()
    except (OSError, UnicodeDecodeError):
        return math.inf
    return min((_quota_of(folder) for folder in _groups(root, groups, mounts)), default=math.inf)


def _groups(root: Path, groups: list[str], mounts: list[str]) -> Iterator[Path]:
    """The folders of the control groups that this process is in, and of those that hold them.

    Args:
      root: of the file system.
      groups, mounts: lines of `/proc/self/cgroup` and `/proc/self/mountinfo`, as in the manuals cgroups(7), proc(5).
    """
    for mount in mounts:
        front, _, back = mount.partition(" - ")
        kind, *rest = back.split()
        if kind not in ("cgroup", "cgroup2") or (kind == "cgroup" and "cpu" not in rest[-1].split(",")):
            continue
        within, at = front.split()[3:5]
        for group in groups:
            controllers, _, path = group.partition(":")[2].partition(":")
            if path and ("cpu" in controllers.split(",") if kind == "cgroup" else not controllers):
                # A container may see its own group as the mount's root.
                inner = PurePosixPath(path)
                below = inner.relative_to(within) if inner.is_relative_to(within) else PurePosixPath()
                top = root / at.lstrip("/")
                yield from (top / part for part in (below, *below.parents))


def _quota_of(folder: Path) -> float:
    """The quota of one control group in cores; infinite if it has none."""
    for names in (("cpu.max",), ("cpu.cfs_quota_us", "cpu.cfs_period_us")):
        with contextlib.suppress(OSError, ValueError):
            quota, period = (float(word) for name in names for word in (folder / name).read_text().split())
            return quota / period if min(quota, period) > 0 else math.inf
    return math.inf


def share_of_cores(processes: int) -> dict[str, str]:
    """Environment variables for each of several processes that share this process's cores."""
    return {VARIABLE: str(max(cores() // processes, 1))}


def on_host() -> contextlib.AbstractContextManager[Any]:
    """A block in which JAX computes on the host, for work that takes longer on a GPU, compiling included.

    If `JAX_PLATFORMS` excludes the host, JAX computes on the GPU.
    """
    # Imported here so that `--help` does not wait for it.
    import jax

    if jax.default_backend() != "cpu":
        with contextlib.suppress(RuntimeError):
            return jax.default_device(jax.local_devices(backend="cpu")[0])
    return contextlib.nullcontext()
