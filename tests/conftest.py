"""What all tests share: annotations checked at run time, strict broadcasting, kept compilations, one problem."""

import os
import tempfile

import jaxtyping

# Has to happen before the package is imported, and so before everything else.
jaxtyping.install_import_hook("mechsearch_jax", "runtime_checks.check")

import jax  # noqa: E402
import pytest  # noqa: E402

CACHE = os.environ.get("JAX_COMPILATION_CACHE_DIR") or os.path.join(tempfile.gettempdir(), "mechsearch-jax-tests")

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_compilation_cache_dir", CACHE)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


@pytest.fixture(scope="session")
def problem():
    """The default problem: the paper's shelf, camera and gripper, and the cylinder as the target."""
    from mechsearch_jax.planner import build_problem

    return build_problem()


@pytest.fixture(scope="module", autouse=True)
def forget_compilations():
    """Drop a file's compiled functions after it; what another file needs again comes from the persistent cache.

    Each holds dozens of memory mappings, of which Linux allows a process 65,530; past that XLA crashes.
    """
    yield
    jax.clear_caches()
