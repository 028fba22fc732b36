"""What a result depends on: versions, device and source."""

from __future__ import annotations

import hashlib
import importlib.metadata
import importlib.resources
import os
import platform
from collections.abc import Sequence
from pathlib import Path

import jax

# Raised with every change of what is decided by default, whatever the reason: recognition, belief, plan or trials. So
# results of equal numbers belong together, and others do not. `tests/test_decisions.py` holds it to that.
DECISION_VERSION = 7
# Its name among the versions.
DECISIONS = "decisions"
# Folders of `mechsearch_jax` that do not influence decisions, and packages that are installed beneath it.
UNDECIDING = ("commands", "viz", "data", "envs", "train", "benchmarks")


def versions() -> dict[str, str]:
    """Versions of the packages that a result depends on, of the decisions (`DECISION_VERSION`), and the device."""
    packages = ("mechsearch-jax", "jax", "mujoco", "numpy")
    device = jax.devices()[0]
    return {
        **{name: importlib.metadata.version(name) for name in packages},
        DECISIONS: str(DECISION_VERSION),
        "python": platform.python_version(),
        "machine": platform.machine(),
        "device": f"{device.platform}: {device.device_kind}",
    }


def source_digest(endings: Sequence[str], packages: Sequence[str] = ("mechsearch_jax",)) -> str:
    """SHA-256, in hexadecimal, of the source that decides: files with these endings in all folders but `UNDECIDING`.

    Folders that are links count like others: with another source behind them, what was compiled must not be used again.
    """
    digest = hashlib.sha256()
    for package in packages:
        root = Path(str(importlib.resources.files(package)))
        files = (Path(folder, name) for folder, _, names in os.walk(root, followlinks=True) for name in names)
        for file in sorted(file for file in files if file.suffix in endings):
            inside = file.relative_to(root)
            if inside.parts[0] not in UNDECIDING:
                source = file.read_bytes()
                digest.update(f"{package} {inside.as_posix()} {len(source)} ".encode() + source)
    return digest.hexdigest()
