"""A safety net for refactoring: what the program decides and computes, kept before a change and compared after it.

    python tests/goldens/net.py write            # keep today's answers in tests/goldens/
    python tests/goldens/net.py compare          # exit 1 if any answer differs
    python tests/goldens/net.py compare --only maps losses

The parts are `episodes` (whole native episodes: the shipped scenarios and one published one with each number of
objects, where those are beside the checkout, with all three recognitions, trying actions out as the default does, and
from true shapes without that and with the other method, too), `simulator` (a batch with one action of every kind in
the batch simulator), `maps` (f and g), `shapes` (what is recognised), `losses` (one of each network), `weights` (the
shipped files' digests) and `report` (what is written of the episodes). Kinds, indices, verdicts and texts have to be
the same, and numbers within 1e-5 (absolute, or relative where they are above 1).

Numbers of floating-point arithmetic belong to the machine that computed them: compare where you wrote, or write anew at
the commit before the change.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import dataclasses
import hashlib
import json
import multiprocessing
import os
import re
import sys
import tempfile
from pathlib import Path

# One thread for each of the processes, and the same number on every machine. Before JAX is imported.
os.environ.setdefault("PJRT_NPROC", "1")
os.environ.setdefault("JAX_PLATFORMS", "cpu")

import jax
import jax.numpy as jnp
import numpy as np

HERE = Path(__file__).parent
PUBLISHED = HERE.parents[2] / "shared" / "scenarios" / "published"
TOLERANCE = 1e-5
# With a decimal point: whole numbers in texts are compared as texts.
NUMBER = re.compile(r"-?\d+\.\d+(?:e-?\d+)?")
RECOGNITIONS = ("oracle", "masks", "full")
# What decides, what sees the world, and what tries actions out before one is made.
SETTINGS = (
    *(("search-for-grasp", recognition, "physics") for recognition in RECOGNITIONS),
    ("search-for-grasp", "oracle", "none"),
    ("search-and-grasp", "oracle", "physics"),
)


def scenario_files():
    from mechsearch_jax.workspace.scenario import example_scenarios

    return [*example_scenarios().values(), *sorted(PUBLISHED.glob("*.json"))[::25]]


# --- what is computed ------------------------------------------------------------------------------------------------


def run_episode(path, method, recognition, trials="physics", seed=0):
    from mechsearch_jax.envs.camera.recognisers import recogniser
    from mechsearch_jax.envs.episode import episodes
    from mechsearch_jax.envs.episode.closed_loop import RunSettings, Start
    from mechsearch_jax.envs.episode.method import Method
    from mechsearch_jax.envs.simulators.native import NativeSimulator
    from mechsearch_jax.planner import PRESETS
    from mechsearch_jax.problem.cache import cached_problem
    from mechsearch_jax.workspace.scenario import load_scenario

    scenario = load_scenario(path)
    target = episodes.target_of(scenario)
    chosen = Method(method, PRESETS["standard"](trials=trials), recognition)
    see = recogniser(recognition, target)
    simulator = NativeSimulator(threads=1)
    settings = RunSettings(see, options=chosen.options(), trials=chosen.trials())
    return episodes.run_episode(Start(scenario, seed), cached_problem(target), chosen.policy(), simulator, settings)


def episode_answer(path, method, recognition, trials):
    episode = run_episode(path, method, recognition, trials)
    value = dataclasses.asdict(episode)
    for step in value["steps"]:
        del step["timings"]
    names = ("scenario", "objects", "found_step", "graspable_step", "retrieved", "failure", "steps")
    return {name: value[name] for name in names} | {"trials": episode.config["trials"]}


def answers_of(share):
    from mechsearch_jax.problem.cache import keep_compilations

    keep_compilations()
    answers = {}
    for path, method, recognition, trials in share:
        name = f"{Path(path).stem} {method} {recognition}, trials {trials}"
        answers[name] = episode_answer(path, method, recognition, trials)
        print(".", end="", flush=True)
    return answers


def episode_jobs():
    """The file, method, recognition and trials of each episode."""
    files = [str(file) for file in scenario_files()]
    return [(file, *setting) for setting in SETTINGS for file in files]


def episodes():
    """By scenario, method, recognition and trials; in two processes."""
    jobs, answers = episode_jobs(), {}
    with concurrent.futures.ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool:
        # Half of the recognitions' jobs each: the one's episodes with masks take as long as the other's.
        for part in pool.map(answers_of, (jobs[0::2], jobs[1::2])):
            answers |= part
    print()
    return dict(sorted(answers.items()))


def chosen_actions():
    """An action for each kind in the order of their codes: none, a push, a pick-and-place, taking the target out."""
    from mechsearch_jax import planner
    from mechsearch_jax.actions import ActionKind, no_action
    from mechsearch_jax.grasping.retrieval import best_grasp
    from mechsearch_jax.observation import Observation
    from mechsearch_jax.problem.cache import cached_problem
    from mechsearch_jax.workspace.scenario import example_scenarios, load_scenario, superquadrics

    scenario = load_scenario(example_scenarios()["first-light"])
    problem, objects = cached_problem(), superquadrics(scenario.objects)
    observation = Observation(objects, jnp.array(False), jnp.zeros(3))
    belief = planner.update_belief(problem, planner.initial_belief(problem), observation)
    decision = planner.search_for_grasp()(jax.random.key(0), problem, belief, observation)
    firsts = jax.tree.map(lambda a: a[:, 0], decision.sequences.actions)
    kinds = np.asarray(firsts.kind)
    actions = [no_action()]
    for kind in (ActionKind.PUSH, ActionKind.PICK_AND_PLACE):
        first = int(np.flatnonzero(kinds == kind)[0])
        actions.append(jax.tree.map(lambda a, i=first: a[i], firsts))
    clear = objects.replace(valid=jnp.zeros_like(objects.valid))
    x, y, _ = scenario.target.position
    actions.append(best_grasp(problem.target_grasps, clear, jnp.float32([x, y, 0.0])).action)
    return {
        name: np.stack([np.asarray(getattr(action, name)) for action in actions])
        for name in ("T_world_gripper", "displacement", "T_world_place", "q7", "opening", "object")
    }


def simulator(kept):
    """The actions of `chosen_actions`."""
    from mechsearch_jax.actions import KINDS, Action
    from mechsearch_jax.envs.simulators.mjx_simulator import MjxSimulator
    from mechsearch_jax.workspace.scenario import example_scenarios, load_scenario

    actions = {k: v for k, v in kept.items() if k.startswith("action ")} or {
        f"action {name}": value for name, value in chosen_actions().items()
    }
    scenario = load_scenario(example_scenarios()["first-light"])
    alone = dataclasses.replace(scenario, objects=())
    simulator = MjxSimulator()
    simulator.reset([scenario, scenario, scenario, alone])
    outcome = simulator.execute(
        Action(
            kind=jnp.array([int(kind) for kind in sorted(KINDS)], jnp.int32),
            **{name.removeprefix("action "): jnp.asarray(value) for name, value in actions.items()},
        )
    )
    names = ("failure", "steps", "settled", "fallen", "held", "outside", "retrieved", "overflow")
    results = {name: np.asarray(getattr(outcome, name)) for name in names}
    world = simulator.world
    return {**actions, **results, "position": np.asarray(world.position), "rotation": np.asarray(world.rotation)}


def maps(kept):
    from mechsearch_jax.envs.episode.episodes import target_of
    from mechsearch_jax.envs.recording.pictures import inspect_scenario
    from mechsearch_jax.problem.cache import cached_problem
    from mechsearch_jax.workspace.scenario import load_scenario

    answers = {}
    for file in scenario_files():
        scenario = load_scenario(file)
        maps, _ = inspect_scenario(scenario, cached_problem(target_of(scenario)))
        answers[f"{file.stem} existence"] = np.asarray(maps.existence)
        answers[f"{file.stem} graspability"] = np.asarray(maps.graspability)
    return answers


def shapes(kept):
    from mechsearch_jax.envs.camera.recognisers import recogniser
    from mechsearch_jax.envs.camera.snapshot import Snapshot
    from mechsearch_jax.envs.episode.episodes import target_of
    from mechsearch_jax.envs.world.world import from_scenario
    from mechsearch_jax.problem.cache import cached_problem
    from mechsearch_jax.workspace.scenario import load_scenario

    answers = {}
    for file in scenario_files():
        scenario = load_scenario(file)
        problem = cached_problem(target_of(scenario))
        for recognition in RECOGNITIONS:
            see = recogniser(recognition, target_of(scenario))
            seen = see(jax.random.key(0), Snapshot(problem.camera, problem.shelf, from_scenario(scenario)))
            for name in ("size", "exponents", "position", "rotation", "valid"):
                answers[f"{file.stem} {recognition} {name}"] = np.asarray(getattr(seen.objects, name))
            answers[f"{file.stem} {recognition} found"] = np.asarray(seen.target_visible)
            answers[f"{file.stem} {recognition} target_pose"] = np.asarray(seen.target_pose)
    return answers


def made_up_pushes():
    """Pushes of the first object of each shipped scenario, after which it is where the gripper has gone."""
    from mechsearch_jax.envs.pushing.pushes import Pushes
    from mechsearch_jax.envs.world.world import BODIES, from_scenario
    from mechsearch_jax.geometry.transforms import make
    from mechsearch_jax.robot.grasp_frames import gripper_rotation
    from mechsearch_jax.workspace.scenario import example_scenarios, load_scenario

    worlds = [from_scenario(load_scenario(file)) for file in example_scenarios().values()]
    before = jax.tree.map(lambda *leaves: jnp.stack(leaves), *worlds)
    count = len(worlds)
    displacement = jnp.tile(jnp.float32([[0.02, 0.1, 0.0]]), (count, 1))
    rotation = gripper_rotation(jnp.zeros(count), jnp.full(count, 0.5))
    start = before.position[:, 0] - jnp.float32([[0.02, 0.09, 0.02]])
    return Pushes(
        before=before,
        after=before.replace(position=before.position.at[:, 0].add(displacement)),
        object=jnp.zeros(count, jnp.int32),
        T_world_gripper=make(rotation, start),
        displacement=displacement,
        q7=jnp.full(count, 0.8),
        toppled=jnp.zeros((count, BODIES), bool).at[0, 1].set(True),
        fallen=jnp.zeros((count, BODIES), bool),
        lane=jnp.arange(count),
    )


def losses(kept):
    from mechsearch_jax.networks.push import PushConfig
    from mechsearch_jax.networks.recognition import RecognitionConfig
    from mechsearch_jax.networks.segmentation import SegmentationConfig
    from mechsearch_jax.train.push import PushTask
    from mechsearch_jax.train.recognition import RecognitionTask
    from mechsearch_jax.train.segmentation import SegmentationTask

    pushes = made_up_pushes()
    tasks = {
        "segmentation": SegmentationTask(network=SegmentationConfig(width=32, layers=2, heads=2, neighbours=8)),
        "recognition": RecognitionTask(network=RecognitionConfig(width=32, layers=1, heads=2)),
        "push": PushTask(pushes, pushes, network=PushConfig(width=16, layers=2)),
    }
    answers = {}
    for name, task in tasks.items():
        parameters = jax.jit(task.init)(jax.random.key(1))
        examples = jax.jit(task.sample, static_argnums=1)(jax.random.key(2), 2)
        loss, terms = jax.jit(task.loss)(parameters, examples)
        answers[f"{name} loss"] = np.asarray(loss)
        answers |= {f"{name} {term}": np.asarray(value) for term, value in terms.items()}
    return answers


def weights(kept):
    import mechsearch_jax

    files = sorted(Path(mechsearch_jax.__file__).parent.rglob("*.npz"))
    shipped = [file for file in files if file.stem in ("push", "recognition", "segmentation")]
    return {file.stem: hashlib.sha256(file.read_bytes()).hexdigest() for file in shipped}


def report(kept):
    """What is written of a few episodes whose wall times are made up."""
    from mechsearch_jax.benchmarks.report.report_files import write_report
    from mechsearch_jax.benchmarks.store.rows import EpisodeRow
    from mechsearch_jax.workspace.scenario import example_scenarios

    rows = []
    for file in example_scenarios().values():
        for method in ("search-for-grasp", "search-and-grasp"):
            row = EpisodeRow.of_episode(run_episode(file, method, "oracle"))
            rows.append(dataclasses.replace(row, planning_seconds=1.0, simulation_seconds=2.0))
    with tempfile.TemporaryDirectory() as folder:
        write_report(rows, Path(folder))
        texts = ("report.md", "rates.csv", "rates.json", "failures.csv")
        return {name: (Path(folder) / name).read_text() for name in texts}


# --- keeping and comparing -------------------------------------------------------------------------------------------

JSON_PARTS = {"episodes": lambda kept: episodes(), "weights": weights, "report": report}
ARRAY_PARTS = {"simulator": simulator, "maps": maps, "shapes": shapes, "losses": losses}
PARTS = JSON_PARTS | ARRAY_PARTS


def place(part):
    return HERE / f"net-{part}.{'json' if part in JSON_PARTS else 'npz'}"


def load(part):
    if part in JSON_PARTS:
        return json.loads(place(part).read_text())
    with np.load(place(part)) as file:
        return {name: file[name] for name in file.files}


def save(part, value):
    if part in JSON_PARTS:
        place(part).write_text(json.dumps(value, indent=None, separators=(",", ":")) + "\n")
    else:
        np.savez_compressed(place(part), **value)


def differences(old, new, where=""):
    """Lines that say where two answers differ."""
    if isinstance(old, dict) and isinstance(new, dict):
        for name in old.keys() | new.keys():
            if name not in old or name not in new:
                yield f"{where}/{name}: only {'after' if name in new else 'before'}"
            else:
                yield from differences(old[name], new[name], f"{where}/{name}")
    elif isinstance(old, list) and isinstance(new, list):
        if len(old) != len(new):
            yield f"{where}: {len(old)} before, {len(new)} after"
        for i, (a, b) in enumerate(zip(old, new, strict=False)):
            yield from differences(a, b, f"{where}/{i}")
    elif isinstance(old, np.ndarray | float):
        old, new = np.asarray(old), np.asarray(new)
        if old.shape != new.shape or old.dtype.kind != new.dtype.kind:
            yield f"{where}: {old.dtype}{old.shape} before, {new.dtype}{new.shape} after"
        elif old.dtype.kind == "f":
            if not np.allclose(new, old, rtol=TOLERANCE, atol=TOLERANCE, equal_nan=True):
                yield f"{where}: differs by up to {np.nanmax(np.abs(new - old)):.3g}"
        elif not np.array_equal(old, new):
            yield f"{where}: {np.sum(old != new)} of {old.size} differ"
    elif isinstance(old, str) and isinstance(new, str):
        if NUMBER.split(old) != NUMBER.split(new):
            yield f"{where}: {old!r} before, {new!r} after"
        yield from differences(*(np.array(NUMBER.findall(text), float) for text in (old, new)), where)
    elif old != new:
        yield f"{where}: {old!r} before, {new!r} after"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("do", choices=("write", "compare"))
    parser.add_argument("--only", nargs="+", choices=tuple(PARTS), default=tuple(PARTS))
    options = parser.parse_args()
    from mechsearch_jax.problem.cache import keep_compilations

    keep_compilations()
    differing = 0
    for part in options.only:
        kept = load(part) if place(part).exists() else {}
        # What is not there is not compared: the published scenes, in a checkout alone.
        now = json.loads(json.dumps(PARTS[part](kept))) if part in JSON_PARTS else PARTS[part](kept)
        if options.do == "write":
            save(part, now)
            print(f"{part}: {len(now)} answers kept in {place(part).name}")
            continue
        if not PUBLISHED.is_dir():
            kept = {name: value for name, value in kept.items() if not name.startswith("objects_")}
        lines = sorted(differences(kept, now, part))
        differing += len(lines)
        print(f"{part}: {len(kept)} answers, {len(lines)} differences")
        print("".join(f"  {line}\n" for line in lines[:20]), end="")
    sys.exit(1 if differing else 0)


if __name__ == "__main__":
    main()
