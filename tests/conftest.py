"""What all tests share: annotations checked at run time, strict broadcasting, kept compilations, one problem.

`--slow-share K/N` selects the K-th of N parts of the slow tests that are not marked `always`, `--slow-share auto/N` the
one that the commit's hash falls into, so that the same commit is always the same run.
"""

import gc
import os
import subprocess
import sys
import tempfile
from pathlib import Path

# Two thirds of the tests' time is XLA's, and most of that is spent on making fast what runs once. XLA reads this when
# JAX is first imported; a jaxlib that does not know a flag aborts, so it is asked first. `XLA_FLAGS=""` leaves all as
# it is for users.
QUICK = (
    "--xla_backend_optimization_level=1 --xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1 "
    "--xla_backend_extra_options=xla_cpu_disable_loop_unrolling,xla_cpu_disable_slp_vectorizer"
)
# There is a process for each core; threads of linear algebra beside it only wait for each other. The processes that are
# started from here read this as they import NumPy.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
if "XLA_FLAGS" not in os.environ:
    environment = {**os.environ, "XLA_FLAGS": QUICK, "JAX_PLATFORMS": "cpu"}
    tried = subprocess.run([sys.executable, "-c", "import jax; jax.devices()"], env=environment, capture_output=True)
    os.environ["XLA_FLAGS"] = QUICK if tried.returncode == 0 else ""

import runtime_checks  # noqa: E402

# Has to happen before the package is imported, and so before everything else.
runtime_checks.install("mechsearch_jax")

import mechsearch_jax.benchmarks  # noqa: E402

# Where the package is installed, the lab is not: its tests are of this checkout's.
mechsearch_jax.benchmarks.__path__.append(str(Path(__file__).parents[1] / "benchmarks"))

import jax  # noqa: E402
import pytest  # noqa: E402
import shares  # noqa: E402
from xdist.scheduler import LoadScopeScheduling  # noqa: E402

CACHE = os.environ.get("JAX_COMPILATION_CACHE_DIR") or os.path.join(tempfile.gettempdir(), "mechsearch-jax-tests")
# A compiled function holds dozens of memory mappings, of which Linux allows a process 65,530; past that XLA crashes.
MAPPINGS = 35_000

# Files that trace the same functions stay in one process, so that they are traced once; every other file is a group of
# its own. Those that take long come first, so that all processes end at the same time.
GROUPS = {
    "planning": (
        "test_planner",
        "test_envs_default_episode",
        "test_envs_trials",
        "test_planner_lost_target",
        "test_unmeasured",
        "test_planner_unseen_motion",
        "test_search",
        "test_envs_live",
        "test_planner_moved_target",
        "test_stacks",
        "test_dynamics_actions",
        "test_envs_episode",
        "test_envs_batch_episode",
        "test_existence",
        "test_envs_verdicts",
        "test_preparing",
        "test_decisions",
        "test_shelf_as_data",
        "test_readme",
        "test_docs",
        "test_doc_blocks",
    ),
    "pushing": ("test_benchmarks_push", "test_envs_pushes"),
    "recognising": (
        "test_envs_recognisers",
        "test_perception_recogniser",
        "test_benchmarks_recognition",
    ),
}
LONG_FIRST = (
    *GROUPS["planning"],
    *GROUPS["pushing"],
    "test_networks_push",
    *GROUPS["recognising"],
    "test_train_networks",
    "test_envs_mjx_simulator",
    "test_perception_refinement",
    "test_envs_physics_push",
)

# What was traced is gone afterwards, and to forget it takes the longer the more it is.
FIRST = ("test_program_budget",)

# What is traced stays, and there is much of it: Python looks through all of it for cycles, again and again.
gc.set_threshold(50_000, 20, 100)

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_compilation_cache_dir", CACHE)
# Small ones too: thousands of operations that run alone are compiled in every process, and again after its compiled
# functions were dropped.
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def pytest_addoption(parser):
    parser.addoption("--slow-share", metavar="K/N", help="of the slow tests only one of N parts; auto/N: the commit's")


def share_of(text):
    """The part and the number of parts that `--slow-share` asks for."""
    part, _, parts = text.partition("/")
    valid = parts.isdigit() and (part == "auto" or part.isdigit())
    if not valid or int(parts) < 1 or not (part == "auto" or 1 <= int(part) <= int(parts)):
        raise pytest.UsageError(f'--slow-share "{text}" is neither K/N with K from 1 to N nor auto/N')
    return (int(commit(), 16) % int(parts) + 1 if part == "auto" else int(part)), int(parts)


def commit(folder=Path(__file__).parent):
    """The hexadecimal digits of the commit that is checked out."""
    try:
        done = subprocess.run(["git", "rev-parse", "HEAD"], cwd=folder, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError) as error:
        why = "there is no git" if isinstance(error, OSError) else error.stderr.strip().partition("\n")[0]
        raise pytest.UsageError(
            f"--slow-share auto/N: {folder} tells no commit to choose a part by ({why}); give K/N"
        ) from error
    return done.stdout.strip()


def pytest_configure(config):
    if config.getoption("slow_share"):
        # Every process has to select the same tests, so that the part is chosen once.
        part, parts = share_of(config.getoption("slow_share"))
        config.option.slow_share = f"{part}/{parts}"


def pytest_report_header(config):
    share = config.getoption("slow_share")
    return f"slow tests: part {share}" if share else None


class ByGroup(LoadScopeScheduling):
    """Gives each group of files to one process, in the order in which they were collected; of a part of the slow tests,
    which is balanced by file, each file."""

    def _split_scope(self, nodeid):
        file = Path(nodeid.partition("::")[0]).stem
        if self.config.getoption("slow_share"):
            return file
        return next((group for group, files in GROUPS.items() if file in files), file)


# Not xdist's own "loadgroup": with pytest 9.2 and xdist 3.8 it finds no group, and says nothing.
@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    return ByGroup(config, log)


# Parts are made of the tests that `-m` has left.
@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config, items):
    if config.getoption("slow_share"):
        part, parts = share_of(config.getoption("slow_share"))
        drawn = [i.nodeid for i in items if i.get_closest_marker("slow") and not i.get_closest_marker("always")]
        part_of = shares.part_of_each(drawn, parts)
        left_out = [item for item in items if part_of.get(item.nodeid, part) != part]
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if part_of.get(item.nodeid, part) == part]
    rank = {name: i for i, name in enumerate((*FIRST, *LONG_FIRST))}
    if config.getoption("slow_share"):
        rank = {name: i for i, name in enumerate((*FIRST, *shares.longest_first([item.nodeid for item in items])))}
    items.sort(key=lambda item: rank.get(Path(item.path).stem, len(rank)))


@pytest.fixture(scope="session")
def problem():
    """The default problem: the paper's shelf, camera and gripper, and the cylinder as the target."""
    from mechsearch_jax.problem.cache import cached_problem
    from mechsearch_jax.runtime.kept_arrays import VARIABLE

    # It is built once for all processes, and the same for all files.
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", False)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(VARIABLE, CACHE)
        built = cached_problem()
    jax.config.update("jax_disable_most_optimizations", before)
    return built


@pytest.fixture(scope="module", autouse=True)
def forget_compilations():
    """Drop compiled functions between files where the process holds many of their memory mappings, and keep none that
    a command has kept."""
    yield
    from mechsearch_jax.runtime.compiled import keep_in

    keep_in(None)
    maps = Path("/proc/self/maps")
    if not maps.exists() or maps.read_bytes().count(b"\n") > MAPPINGS:
        jax.clear_caches()
