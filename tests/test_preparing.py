"""The programs of a first decision are compiled in parallel with the rest, and progress is reported."""

import threading
import time

import jax
import jax.numpy as jnp
import pytest

from mechsearch_jax.actions import no_action
from mechsearch_jax.belief.belief import graspability_map, initial_belief, update_belief
from mechsearch_jax.commands.search import _expected
from mechsearch_jax.envs.camera.snapshot import Snapshot, objects_on_the_board, oracle, true_target_pose
from mechsearch_jax.envs.episode import verdicts
from mechsearch_jax.envs.recording import evidence
from mechsearch_jax.envs.world.world import from_scenario
from mechsearch_jax.geometry.bodies import PARTS
from mechsearch_jax.grasping.retrieval import top_grasps
from mechsearch_jax.planner import search_for_grasp
from mechsearch_jax.planner.rollout import begin, shapes_of_parts
from mechsearch_jax.session import preparing
from mechsearch_jax.session.preparing import Preparing, Program, prepared
from mechsearch_jax.shapes.compound import Piece
from mechsearch_jax.workspace.scenario import Body, Scenario
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target


def program(name, ready=False, prepare=lambda: None):
    return Program(name, lambda: ready, lambda: prepare)


def test_what_is_compiled_is_named_with_how_many_are_left():
    lines = []
    with prepared([program("a"), program("b", ready=True), program("c")], lines.append):
        pass
    assert lines[0] == "compiling: a, c; 0 of 2 done"
    assert lines[1] in ("compiling: a; 1 of 2 done", "compiling: c; 1 of 2 done")
    assert lines[2:] == ["compiling; 2 of 2 done"]


def test_what_is_added_later_is_reported_with_what_is_left():
    lines, first = [], threading.Event()
    with Preparing(lines.append) as preparing:
        preparing.add([program("a", prepare=lambda: first.wait(20))])
        preparing.add([program("b", ready=True), program("c", prepare=lambda: first.wait(20))])
        first.set()
    assert lines[:2] == ["compiling: a; 0 of 1 done", "compiling: a, c; 0 of 2 done"]
    assert lines[-1] == "compiling; 2 of 2 done"


def test_the_end_of_the_block_neither_begins_nor_waits_for_what_is_optional(monkeypatch):
    monkeypatch.setenv("MECHSEARCH_CORES", "2")
    ends, running, begun = threading.Event(), threading.Semaphore(0), []

    def begin(name):
        begun.append(name)
        running.release()
        return lambda: ends.wait(20)

    with Preparing(lambda line: None) as preparing:
        optional = [Program(name, lambda: False, lambda name=name: begin(name)) for name in ("a", "b", "c")]
        preparing.add(optional, optional=True)
        assert all(running.acquire(timeout=20) for _ in range(2))
        began = time.monotonic()
    assert time.monotonic() - began < 10
    # The third has waited for a core.
    ends.set()
    time.sleep(0.2)
    assert begun == ["a", "b"]


def test_what_is_wrong_is_said_by_who_calls_it():
    def fail():
        raise ValueError("cannot be compiled")

    lines = []
    with prepared([program("a", prepare=fail)], lines.append):
        pass
    assert lines == ["compiling: a; 0 of 1 done"]


MUG = Target.from_parts((Piece("cylinder", (0.03, 0.03, 0.05)), Piece("box", (0.02, 0.005, 0.03), (0.04, 0.0, 0.0))))


def standing(target, x):
    position = (x, 0.1, Shelf().board + target.bottom)
    return Body(target.shape, target.half_size, position, (1.0, 0.0, 0.0, 0.0), target.compound)


CASES = {
    "usual": (standing(Target.box(), 0.5), standing(Target.cylinder(), 0.65)),
    "compound-target": (standing(Target.box(), 0.5), standing(MUG, 0.65)),
    "compound-object": (standing(MUG, 0.5), standing(Target.cylinder(), 0.65)),
}


@pytest.mark.parametrize("case", CASES)
def test_what_a_search_compiles_ahead_is_what_it_calls(problem, monkeypatch, case):
    """The programs are for the arguments that a search then has."""
    calls = {}

    def noted(name, function, *args):
        calls.setdefault(name, []).append((function, args))
        return program(name)

    for module in (preparing, verdicts, evidence):
        monkeypatch.setattr(module, "program", noted)
    policy = search_for_grasp(tries=True)
    *objects, target = CASES[case]
    scene = Scenario(case, tuple(objects), target)
    there, recognised = _expected(scene, "oracle")
    preparing.decision(problem, policy, recognised)
    preparing.retrieval(problem, policy, recognised)
    verdicts.programs(problem, there.objects)
    evidence.programs(problem, recognised.objects, there.objects)
    snapshot = Snapshot(problem.camera, problem.shelf, from_scenario(scene))
    seen, pose = oracle(jax.random.key(0), snapshot), true_target_pose(snapshot.world)
    there, belief = objects_on_the_board(snapshot), initial_belief(problem)
    expected = {
        "belief": [(update_belief, (problem, belief, seen, seen, no_action()))],
        "grasp": [(top_grasps, (problem.target_grasps, seen.objects, belief.found_pose))],
        "verdict": [(verdicts.free_in_sets, (verdicts.judged_sets(problem), there, pose))],
        "hits": [(evidence.grasps_at, (problem.target_grasps, there, pose))],
        "g": [(graspability_map, (problem, belief, seen.objects))],
    }
    beliefs, key = (belief, belief.replace(found=jnp.array(True))), jax.random.key(1)
    expected["plan"] = [call for each in beliefs for call in policy.programs(key, problem, each, seen)]

    def keys(each):
        return {name: [(f, f._call_key(args, {})) for f, args in pairs] for name, pairs in each.items()}

    assert keys(calls) == keys(expected)


def test_a_plan_for_a_found_target_compiles_little_more_than_one_for_a_hidden_one(problem):
    policy, seen, key = search_for_grasp(), preparing.nothing_seen(), jax.random.key(0)
    hidden = initial_belief(problem)
    beliefs = hidden, hidden.replace(found=jnp.array(True))
    kept, own = [], []
    for (a, for_a), (b, for_b) in zip(*(policy.programs(key, problem, each, seen) for each in beliefs), strict=True):
        (kept if a._call_key(for_a, {}) == b._call_key(for_b, {}) else own).append(a.__name__)
    assert kept == ["first_draws", "candidates_of"]
    assert own == ["_begun", "_decided", "_weights"]


@pytest.mark.parametrize("is_found", [False, True])
def test_what_passes_between_the_parts_of_a_plan_has_the_shapes_that_are_compiled_for(problem, is_found):
    policy, seen = search_for_grasp(), preparing.nothing_seen()
    belief = initial_belief(problem).replace(found=jnp.array(is_found))
    problem, belief = policy._planned_with(problem, belief)
    key = jax.random.key(0)

    def begun(problem, belief, key, objects):
        rollout = policy.rollout(problem, belief)
        begun = begin(rollout, key, objects)
        root = begun.state.replace(candidates=rollout.candidates(begun.state))
        return begun.replace(state=root), rollout.weights(root)

    parts = jax.eval_shape(begun, problem, belief, key, seen.objects)
    assert parts == shapes_of_parts(policy.rollout(problem, belief), key, seen.objects)[:2]


@pytest.mark.parametrize(
    ("recognition", "parts"), [("masks", None), ("full", None), ("masks-parts", PARTS), ("full-parts", PARTS)]
)
def test_bodies_that_are_recognised_have_parts_where_the_recogniser_gives_them(recognition, parts):
    *objects, target = CASES["compound-object"]
    there, recognised = _expected(Scenario("one", tuple(objects), target), recognition)
    assert there.objects.parts.capacity == PARTS
    assert (recognised.objects.parts.capacity if parts else recognised.objects.parts) == parts


def test_no_more_is_compiled_at_once_than_there_are_cores(monkeypatch):
    """Where there are two, the third begins when one of the first two is over, and what it waits for is not claimed."""
    monkeypatch.setenv("MECHSEARCH_CORES", "2")
    first, begun = threading.Event(), []

    def begin(name):
        begun.append(name)
        return lambda: first.wait(60) if name != "b" else None

    programs = [Program(name, lambda: False, lambda name=name: begin(name)) for name in ("a", "b", "c", "d")]
    with prepared(programs, lambda line: None):
        while begun != ["a", "b", "c"]:
            time.sleep(0.01)
        time.sleep(0.1)
        assert begun == ["a", "b", "c"]
        first.set()
    assert begun == ["a", "b", "c", "d"]
