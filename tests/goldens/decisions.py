"""What is decided by default in a few scenes, so that a change of it is never without a new `DECISION_VERSION`.

    python tests/goldens/decisions.py     # keep today's decisions in tests/goldens/decisions.json

A change of decisions first raises the number, in `mechsearch_jax/runtime/versions.py`. Decisions are compared by their
kinds and objects, and by their places to 2 mm: they are the same on every machine.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

FILE = Path(__file__).parent / "decisions.json"
# Of places and sizes [m], and of the number of poses where f is 1.
TOLERANCE, SHARE = 0.002, 0.03


def described(belief, decision):
    """What a decision is, and how much f allows."""
    from mechsearch_jax.actions import kind_of

    action = decision.action
    return {
        "possible": int(jnp.sum(belief.exists)),
        "kind": kind_of(int(action.kind)).name,
        "object": int(action.object),
        "from": np.asarray(action.T_world_gripper, float)[:3, 3].round(4).tolist(),
        "to": np.asarray(action.T_world_place, float)[:3, 3].round(4).tolist(),
    }


def looked(problem, objects, found=False, pose=(0.0, 0.0, 0.0)):
    """An observation, and the belief after it."""
    from mechsearch_jax import planner
    from mechsearch_jax.observation import Observation

    observation = Observation(objects, jnp.array(found), jnp.float32(pose))
    return observation, planner.update_belief(problem, planner.initial_belief(problem), observation)


def from_true_shapes(problem):
    """Plans in shipped scenarios, one of them tried out in physics, and the grasp of a target that stands free."""
    from mechsearch_jax.envs.episode.method import Method
    from mechsearch_jax.planner.step import decide, unsearched
    from mechsearch_jax.workspace.scenario import example_scenarios, load_scenario, superquadrics

    key, method, answers = jax.random.key(0), Method(), {}
    for name in ("first-light", "crowded-shelf"):
        scenario = load_scenario(example_scenarios()[name])
        objects = superquadrics(scenario.objects)
        observation, belief = looked(problem, objects)
        answers[name] = described(belief, method.policy()(key, problem, belief, observation))
    state = unsearched(problem, observation).replace(belief=belief)
    tried = decide(method.policy(), method.trials(), key, problem, state).decision
    answers[f"{name}, tried"] = described(belief, tried)
    x, y, _ = scenario.target.position
    clear = objects.replace(valid=jnp.zeros_like(objects.valid))
    observation, belief = looked(problem, clear, True, (x, y, 0.0))
    answers["free"] = described(belief, method.policy().retrieval(key, problem, belief, observation))
    return answers


def from_images(problem):
    """What is recognised in the shipped images, and the plan."""
    import mechsearch_jax as ms
    from mechsearch_jax.envs.episode.method import Method

    images, key = ms.example_images(), jax.random.key(0)
    assert images.camera == problem.camera
    seen = ms.Recogniser(problem)(key, images.depth, images.colour).objects
    observation, belief = looked(problem, seen)
    there = np.asarray(seen.valid)
    rows = np.concatenate([seen.position[there], seen.size[there]], axis=1).astype(float)
    decision = Method().policy()(key, problem, belief, observation)
    return {"images": {**described(belief, decision), "objects": rows.round(4).tolist()}}


def differences(old, new):
    """A line for each answer that is not the same."""
    for name in sorted(old.keys() | new.keys()):
        if not (name in old and name in new and _alike(old[name], new[name])):
            yield f"{name}: {old.get(name)} before, {new.get(name)} after"


def _alike(old, new):
    if isinstance(old, dict):
        return old.keys() == new.keys() and all(_alike(old[name], new[name]) for name in old)
    if isinstance(old, list):
        return np.shape(old) == np.shape(new) and np.allclose(old, new, rtol=0.0, atol=TOLERANCE)
    return abs(old - new) <= SHARE * old if isinstance(old, int) and old > 10 else old == new


def kept():
    """The number of the kept decisions, and these."""
    value = json.loads(FILE.read_text())
    return value["decision_version"], value["decisions"]


def main():
    from mechsearch_jax.problem.cache import cached_problem, keep_compilations
    from mechsearch_jax.runtime.versions import DECISION_VERSION

    keep_compilations()
    problem = cached_problem()
    now = {**from_true_shapes(problem), **from_images(problem)}
    if FILE.exists():
        number, before = kept()
        lines = list(differences(before, now))
        print("".join(f"{line}\n" for line in lines), end="")
        if lines and number == DECISION_VERSION:
            sys.exit(
                f"decisions changed: raise DECISION_VERSION ({number}) in mechsearch_jax/runtime/versions.py first"
            )
    FILE.write_text(json.dumps({"decision_version": DECISION_VERSION, "decisions": now}, indent=1) + "\n")


if __name__ == "__main__":
    main()
