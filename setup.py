"""Which packages there are: those in `mechsearch_jax`, and the folders beside it, which are installed beneath it.

`benchmarks/lab`, which runs in a checkout, is not among them.
"""

from setuptools import find_packages, setup

BESIDE = ("envs", "train", "benchmarks")

setup(
    packages=[
        *find_packages(include=["mechsearch_jax", "mechsearch_jax.*"]),
        *(
            f"mechsearch_jax.{name}"
            for name in find_packages(
                include=[p for b in BESIDE for p in (b, f"{b}.*")], exclude=["benchmarks.lab", "benchmarks.lab.*"]
            )
        ),
    ],
    package_dir={f"mechsearch_jax.{name}": name for name in BESIDE},
)
