"""Kept executables: found again, made anew where something differs, and what compiling took."""

import dataclasses
import os
import re
import subprocess
import sys
import textwrap
import threading
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax.config.config import PlannerConfig
from mechsearch_jax.envs.episode import compile_clock
from mechsearch_jax.envs.episode.compile_clock import EVENTS, CompileClock
from mechsearch_jax.runtime import compiled, executables
from mechsearch_jax.runtime.compiled import CachedJit, CachedJitOnHost, keep_in
from mechsearch_jax.runtime.identity import Unidentified, identity
from mechsearch_jax.runtime.versions import source_digest
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf

TRACED = []


def scaled(camera, values, factor=2.0, config=None):
    TRACED.append("scaled")
    return {"scaled": values * factor * camera.width, "sum": jnp.sum(values) * (config.gamma if config else 1.0)}


def called_back(value):
    return jax.pure_callback(lambda a: np.asarray(a), jax.ShapeDtypeStruct((), jnp.float32), value)


def another_process(function=scaled, static=("camera",)):
    """The function as a new process knows it: not at all."""
    TRACED.clear()
    return CachedJit(function, static)


def as_numbers(tree):
    return jax.tree.map(np.asarray, tree)


@pytest.fixture
def folder(tmp_path):
    keep_in(tmp_path / "executables")
    yield tmp_path / "executables"
    keep_in(None)


VALUES = np.float32([1.0, 2.0, 3.0])


def test_a_second_process_traces_nothing(folder):
    first = another_process()(Camera(), VALUES)
    assert TRACED == ["scaled"]
    (file,) = folder.iterdir()
    assert file.name.startswith("scaled-")
    again = another_process()
    assert again.is_ready(Camera(), VALUES)
    again.prepare(Camera(), VALUES)
    assert again.returns(Camera(), VALUES)["sum"] == jax.ShapeDtypeStruct((), jnp.float32)
    second = again(Camera(), VALUES)
    again(Camera(), jnp.asarray(VALUES))
    assert TRACED == []
    jax.tree.map(np.testing.assert_array_equal, as_numbers(first), as_numbers(second))
    expected = as_numbers(jax.jit(scaled, static_argnames="camera")(Camera(), VALUES))
    jax.tree.map(np.testing.assert_array_equal, as_numbers(second), expected)


def test_the_digest_of_a_package_counts_folders_that_are_links(tmp_path, monkeypatch):
    source, package = tmp_path / "source", tmp_path / "linkedpackage"
    for folder in (source, package):
        folder.mkdir()
    (package / "__init__.py").write_text("")
    (package / "inner").symlink_to(source, target_is_directory=True)
    monkeypatch.syspath_prepend(tmp_path)
    digests = set()
    for text in ("a = 1", "a = 2"):
        (source / "module.py").write_text(text)
        digests.add(source_digest((".py",), ("linkedpackage",)))
    assert len(digests) == 2


def test_what_is_data_compiles_nothing_anew(folder):
    another_process()(Camera(), VALUES, factor=3.0, config=PlannerConfig(gamma=0.9))
    again = another_process()
    result = again(Camera(), VALUES, factor=4.0, config=PlannerConfig(gamma=0.5))
    assert TRACED == []
    assert float(result["sum"]) == 3.0


@pytest.mark.parametrize(
    "arguments",
    [
        (dataclasses.replace(Camera(), width=640), VALUES),
        (Camera(), VALUES[:2]),
        (Camera(), VALUES.astype(np.int32)),
        (Camera(), VALUES, 2.0),
        (Camera(), VALUES, 2),
        (Camera(), VALUES, 2.0, PlannerConfig()),
        (Camera(), VALUES, 2.0, PlannerConfig(horizon=2)),
    ],
)
def test_other_arguments_are_other_entries(folder, arguments):
    calls = [(Camera(), VALUES), (Camera(), VALUES, 2.5, PlannerConfig(horizon=3)), (Camera(), VALUES, jnp.ones(3))]
    for call in calls:
        another_process()(*call)
    again = another_process()
    assert not again.is_ready(*arguments)
    result = again(*arguments)
    assert TRACED == ["scaled"]
    expected = jax.jit(scaled, static_argnames="camera")(*arguments)
    jax.tree.map(np.testing.assert_array_equal, as_numbers(result), as_numbers(expected))


@pytest.mark.parametrize("what", ["_source", "_machine"])
def test_other_code_versions_and_processors_are_other_entries(folder, monkeypatch, what):
    another_process()(Camera(), VALUES)
    monkeypatch.setattr(executables, what, lambda: "another")
    another_process()(Camera(), VALUES)
    assert TRACED == ["scaled"]


def test_settings_of_jax_are_other_entries(folder):
    another_process()(Camera(), VALUES)
    with jax.default_matmul_precision("highest"):
        assert not another_process().is_ready(Camera(), VALUES)
    assert another_process().is_ready(Camera(), VALUES)


@pytest.mark.parametrize("damage", ["cut", "garbage", "empty", "altered", "of another", "no executable"])
def test_a_damaged_entry_is_compiled_anew(folder, damage):
    expected = as_numbers(another_process()(Camera(), VALUES))
    (file,) = folder.iterdir()
    whole = file.read_bytes()
    middle = len(whole) // 2
    if damage == "of another":
        another_process()(Camera(), VALUES[:2])
        (other,) = set(folder.iterdir()) - {file}
        file.write_bytes(other.read_bytes())
        other.unlink()
    elif damage == "no executable":
        head, key, _, _ = whole.split(b"\n", 3)
        data = b"\x80\x04N."
        file.write_bytes(b"\n".join((head, key, executables.hashlib.sha256(data).hexdigest().encode(), data)))
    else:
        altered = whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :]
        file.write_bytes({"cut": whole[:middle], "garbage": b"nothing", "empty": b"", "altered": altered}[damage])
    result = another_process()(Camera(), VALUES)
    assert TRACED == ["scaled"]
    jax.tree.map(np.testing.assert_array_equal, as_numbers(result), expected)
    # Also where JAX's own cache has it, which cannot be written a second time.
    result = another_process()(Camera(), VALUES)
    assert TRACED == []
    jax.tree.map(np.testing.assert_array_equal, as_numbers(result), expected)


def test_nothing_is_kept_unless_a_program_asks_for_it():
    function, values = another_process(), np.ones(7, np.float32)
    function(Camera(), values)
    assert TRACED == ["scaled"]
    function(Camera(), values)
    assert TRACED == ["scaled"]


def test_what_is_prepared_in_memory_is_what_is_called():
    """With shapes in the place of data; lowered first, compiled in another thread, and not traced again."""
    function, values = another_process(), np.ones(11, np.float32)
    called = function.jitted._cache_size()
    assert not function.is_ready(Camera(), values)
    finish = function.begin(Camera(), jax.ShapeDtypeStruct((11,), jnp.float32))
    assert TRACED == ["scaled"]
    assert function.begin(Camera(), values) is None
    assert function.returns(Camera(), values)["scaled"] == jax.ShapeDtypeStruct((11,), jnp.float32)
    threading.Thread(target=finish).start()
    # Who calls it before it is compiled waits for it.
    result = function(Camera(), values)
    assert TRACED == ["scaled"]
    assert function.jitted._cache_size() == called
    expected = jax.jit(scaled, static_argnames="camera")(Camera(), values)
    jax.tree.map(np.testing.assert_array_equal, as_numbers(result), as_numbers(expected))


def test_inside_of_transformations_it_is_a_jitted_function(folder):
    function = another_process()
    rows = jnp.ones((2, 3))
    assert jax.vmap(lambda row: function(Camera(), row)["sum"])(rows).shape == (2,)
    assert float(jax.jit(lambda row: function(Camera(), row)["sum"])(rows[0])) == 3.0
    assert float(jax.jit(lambda: function(Camera(), VALUES)["sum"])()) == 6.0
    assert not folder.exists()


def test_beside_a_gpu_the_host_computes_what_is_for_it(folder, monkeypatch):
    devices = []

    def doubled(values):
        devices.append(getattr(jax.default_device.value, "platform", None))
        return 2.0 * values

    on_a_cpu = CachedJitOnHost(doubled, on_disk=False)
    np.testing.assert_array_equal(on_a_cpu(VALUES), 2.0 * VALUES)
    assert devices == [None]
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    beside = CachedJitOnHost(doubled)
    beside.begin(VALUES)()
    assert beside.is_ready(VALUES)
    np.testing.assert_array_equal(beside(jnp.asarray(VALUES)), 2.0 * VALUES)
    assert devices == [None, "cpu"]
    # Executables on disk are of the first device, and a function of functions decides for itself.
    assert not folder.exists()
    np.testing.assert_array_equal(jax.vmap(beside)(jnp.asarray(VALUES)), 2.0 * VALUES)
    assert devices == [None, "cpu", None]


def test_what_has_no_identity_is_not_kept(folder):
    function = another_process(static=("camera", "factor"))

    @dataclasses.dataclass(frozen=True)
    class Own:
        width: int = 3

    assert float(function(Own(), VALUES)["scaled"][0]) == 6.0
    # A function that calls back into Python holds an address of this process.
    assert float(another_process(called_back, ())(VALUES[0])) == 1.0
    assert not folder.exists() or not list(folder.iterdir())


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="files have no owners here")
def test_a_folder_that_others_may_write_to_is_not_read(folder):
    another_process()(Camera(), VALUES)
    assert folder.stat().st_mode & 0o777 == 0o700
    folder.chmod(0o777)
    keep_in(folder)
    again = another_process()
    with pytest.warns(UserWarning, match="others may write to it"):
        again(Camera(), VALUES)
    assert TRACED == ["scaled"]


def test_the_oldest_entries_give_way(folder, monkeypatch):
    monkeypatch.setattr(executables, "MOST_BYTES", 0)
    another_process()(Camera(), VALUES)
    assert not list(folder.iterdir())


class Colour(compiled.CachedJit):
    pass


def test_identities_are_of_values():
    same = [(Shelf(), Shelf()), (np.ones(2), np.ones(2)), ({"a": 1, "b": 2.0}, {"a": 1, "b": 2.0})]
    other = [
        (Shelf(), dataclasses.replace(Shelf(), board=0.5)),
        (np.ones(2), np.ones(3)),
        (np.ones(2), np.ones(2, np.float32)),
        (1, 1.0),
        (1, True),
        (1, "1"),
        ((1, 2), 2),
        (0.1, float(np.nextafter(0.1, 1.0))),
        (identity, Unidentified),
        (jax.tree.structure((1, 2)), jax.tree.structure((1, (2,)))),
    ]
    for a, b in same:
        assert identity(a) == identity(b)
    for a, b in other:
        assert identity(a) != identity(b)


@pytest.mark.parametrize("value", [lambda: 0, object(), re.compile("a"), scaled, Colour, np.array([object()])])
def test_what_another_process_may_know_otherwise_has_no_identity(value):
    with pytest.raises(Unidentified):
        identity((1, {"a": value}))


SEARCH = """
    import re
    import jax
    from mechsearch_jax.envs.episode.closed_loop import Start
    from mechsearch_jax.envs.episode.episodes import run_episode, target_of
    from mechsearch_jax.envs.simulators.native import NativeSimulator
    from mechsearch_jax.session.preparing import first_decision, prepared
    from mechsearch_jax.planner import search_for_grasp
    from mechsearch_jax.problem.cache import cached_problem, keep_compilations
    from mechsearch_jax.robot.motion import MotionConfig
    from mechsearch_jax.workspace.scenario import example_scenarios, load_scenario

    traced = []

    def note(event, seconds, **about):
        if event.endswith("jaxpr_trace_duration"):
            traced.append(re.sub("_[0-9a-f]{8}$", "", about["fun_name"]))

    jax.monitoring.register_event_duration_secs_listener(note)
    keep_compilations()
    scene = load_scenario(example_scenarios()["first-light"])
    problem, policy = cached_problem(target_of(scene)), search_for_grasp(sequences=2, horizon=1)
    with prepared(first_decision(problem, policy, MotionConfig()), print):
        episode = run_episode(Start(scene, 0, max_steps=1), problem, policy, NativeSimulator())
    names = "update_belief", "first_draws", "_decided", "pixels_in_window", "sizes_and_truths", "keys_at"
    print(*(f"{name} {traced.count(name)}" for name in names))
    print([step.action for step in episode.steps], [step.cost for step in episode.steps])
"""
PERCEIVE = """
    import jax
    import mechsearch_jax as ms
    from mechsearch_jax.problem.cache import cached_problem

    ms.keep_compilations()
    images = ms.example_images()
    problem = cached_problem()
    print(ms.Recogniser(problem)(jax.random.key(0), images.depth, images.colour).target_pose.tolist())
"""


def run(script, folder):
    environment = {**os.environ, "MECHSEARCH_CACHE_DIR": str(folder)}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script)], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.slow
def test_a_second_start_traces_nothing_that_ran_before(tmp_path):
    *lines, counts, first = run(SEARCH, tmp_path)
    assert lines[0].startswith("compiling: plan, belief, motion of ")
    assert lines[0].endswith("; 0 of 10 done")
    assert lines[-1] == "compiling; 10 of 10 done"
    # What was prepared is what was called; where the action finds the target, what only its plan has comes after it.
    expected = "update_belief 1 first_draws 1 _decided [12] pixels_in_window 1 sizes_and_truths 1 keys_at 1"
    assert re.fullmatch(expected, counts)
    *lines, counts, second = run(SEARCH, tmp_path)
    assert lines == []
    assert counts == "update_belief 0 first_draws 0 _decided 0 pixels_in_window 0 sizes_and_truths 0 keys_at 0"
    assert second == first


@pytest.mark.slow
def test_recognition_which_uses_lapack_runs_from_disk(tmp_path):
    assert run(PERCEIVE, tmp_path) == run(PERCEIVE, tmp_path)
    assert {file.name.partition("-")[0] for file in (tmp_path / "executables").iterdir()} >= {"explained_image"}


def tell(seconds, event=f"{EVENTS}backend_compile_duration"):
    jax.monitoring.record_event_duration_secs(event, seconds)


def test_what_jax_compiles_is_counted_while_the_clock_runs():
    @jax.jit
    def never_seen(x):
        return jnp.sin(x) * 3.5 + jnp.cos(x)

    with CompileClock() as clock:
        start = time.perf_counter()
        never_seen(jnp.arange(7.0)).block_until_ready()
        took = time.perf_counter() - start
        assert 0.0 < clock.seconds <= took
        before = clock.seconds
        never_seen(jnp.arange(7.0)).block_until_ready()
        assert clock.seconds == before
    tell(1.0)
    assert clock.seconds == before


def test_what_is_compiled_inside_of_something_else_counts_once(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    with CompileClock() as clock:
        for at, seconds in ((100.0, 2.0), (101.0, 0.5), (104.0, 6.0)):
            now[0] = at
            tell(seconds)
        assert clock.seconds == pytest.approx(6.0)
        now[0] = 110.0
        tell(1.0)
        tell(50.0, "/jax/something/else")
        assert clock.seconds == pytest.approx(7.0)


def test_a_stage_is_timed_without_what_was_compiled_in_it(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    with CompileClock() as compiling:
        clock = compile_clock.StageClock(2, lambda stage, slots: None, compiling)
        for stage, rows, compiled, other in (("plan", [0, 1], 8.0, 2.0), ("judge", [1], 0.0, 3.0)):
            with clock(stage, rows):
                now[0] += compiled
                if compiled:
                    tell(compiled)
                now[0] += other
    assert clock.timings(0) == {"plan": 1.0, "compile": 4.0}
    assert clock.timings(1) == {"plan": 1.0, "compile": 4.0, "judge": 3.0}
