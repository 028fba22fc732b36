"""Rows as stored runs have them."""

import functools
import json

from mechsearch_jax.benchmarks.store.rows import EpisodeRow, configuration
from mechsearch_jax.envs.episode.method import Method

VERSIONS = json.dumps({"jax": "0.11.2", "machine": "x86_64", "mujoco": "3.17.0", "numpy": "2.5.2", "python": "3.12.3"})
USUAL = Method()


@functools.cache
def columns_of(method):
    """The columns that say what a row ran with; thousands of rows have the same few methods."""
    options = {**method.options(), "simulator": "NativeSimulator"}
    columns = {name: options[name] for name in ("policy", "recognition", "gamma", "horizon", "sequences")}
    return {**columns, "actions": "+".join(options["actions"]), "configuration": configuration(options)}


def row_of(scene, method=USUAL, seed=0, **fields):
    """A row of an episode that found the target, and took it out."""
    usual = {
        "scenario": scene,
        "objects": int(scene.split("-")[-2]) if "objects" not in fields else None,
        "target": "cylinder",
        **columns_of(method),
        "seed": seed,
        "found_step": 1,
        "graspable_step": 2,
        "retrieved": True,
        "steps": 3,
        "failure": None,
        "planning_seconds": 1.23456,
        "simulation_seconds": 2.0,
        "content_hash": "0123456789ab",
        "looks": 2,
        "objects_fallen": 0,
        "paper_graspable": True,
        "compile_seconds": 0.125,
        "code": "this code",
        "device": "cuda: H100",
        "versions": VERSIONS,
    }
    return EpisodeRow(**usual | fields)
