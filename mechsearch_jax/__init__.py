"""Mechanical search with superquadrics, in JAX: find and grasp a hidden object on a cluttered shelf."""

from pathlib import Path as _Path

# In a checkout, `mechsearch_jax.envs`, `train` and `benchmarks` lie beside this folder; installed, they lie in it.
if not (_Path(__file__).parent / "envs").is_dir():
    __path__.append(str(_Path(__file__).parents[1]))
