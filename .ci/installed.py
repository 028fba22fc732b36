"""Checks an installed mechsearch-jax as a newcomer would use it: `python installed.py VERSION`, in an empty folder.

It has to be of the version, and not of a checkout; all that is promised can be imported; the weights are those of
their cards; and one search takes the target out and is filmed.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
import subprocess
import sys
import sysconfig
from pathlib import Path

NETWORKS = ("recognition", "segmentation", "push")
LIBRARIES = ("jax", "jaxlib", "flax", "optax", "numpy", "scipy", "mujoco", "mujoco-mjx", "pandas", "pyarrow")


def check_package(version: str) -> Path:
    """Check what is installed, and return its folder."""
    import mechsearch_jax

    installed = importlib.metadata.version("mechsearch-jax")
    assert installed == version, f"version {installed} is installed, not {version}"
    folder = Path(mechsearch_jax.__file__).parent
    assert folder.parent == Path(sysconfig.get_path("purelib")), f"{folder} is not the installed package"
    assert not (folder / "benchmarks" / "lab").exists(), "what belongs to a checkout is installed, too"
    for name in mechsearch_jax.__all__:
        getattr(mechsearch_jax, name)
    return folder


def check_weights(folder: Path) -> None:
    """Check that each file of weights is the one that its card is of."""
    for network in NETWORKS:
        card = json.loads((folder / "networks" / f"{network}.json").read_text(encoding="utf-8"))
        digest = hashlib.sha256((folder / "networks" / f"{network}.npz").read_bytes()).hexdigest()
        assert digest == card["sha256"], f"{network}.npz is not the file that its card is of"


def check_search(out: Path) -> None:
    """Check the README's search: the target is taken out, and there is a film of it."""
    program = Path(sysconfig.get_path("scripts")) / "mechsearch"
    search = [program, "search", "first-light", "--out", out, "--video", out / "search.mp4"]
    caches = {"MECHSEARCH_CACHE_DIR": str(out / "cache"), "JAX_PLATFORMS": "cpu"}
    subprocess.run(search, check=True, env={**os.environ, **caches})
    episode = json.loads((out / "episode.json").read_text(encoding="utf-8"))
    assert episode["retrieved"] is True, f"the target was not taken out: {episode['failure']}"
    assert (out / "search.mp4").stat().st_size > 50_000, "the film is empty"
    print("actions:", *(step["action"]["kind"] for step in episode["steps"] if step["action"]))


def main() -> None:
    """Check the package that this Python has."""
    if len(sys.argv) != 2:
        sys.exit("usage: python installed.py VERSION")
    folder = check_package(sys.argv[1])
    check_weights(folder)
    print("python", sys.version.split()[0], *(f"{name} {importlib.metadata.version(name)}" for name in LIBRARIES))
    check_search(Path("out").resolve())


if __name__ == "__main__":
    main()
