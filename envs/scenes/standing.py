"""Whether the bodies of a scenario can be where it has them: by contact, and by letting them go."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from mechsearch_jax.envs.scenes.scene_sets import find_scene, is_recorded
from mechsearch_jax.envs.simulators.native import NativeWorld
from mechsearch_jax.envs.simulators.simulator import ARM, ROBOT
from mechsearch_jax.envs.world.touching import name_of
from mechsearch_jax.envs.world.world import BODIES, slots
from mechsearch_jax.robot.kinematics import HOME
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.scenario import Body, Scenario, rotation_matrix
from mechsearch_jax.workspace.shelf import Shelf

# Bodies may overlap each other or the shelf by so much [m], and move and turn by so much as they come to rest [m, rad].
# In shipped, published and 32 household scenes they overlap by 0.2 mm and move by 0.6 mm at most.
OVERLAP, SHIFT, TURN = 2e-3, 4e-3, np.radians(4.0)
# A contact whose normal has a larger z is underneath; others are beside the body.
STEEP = 0.7


def faults(scenario: Scenario, world: NativeWorld) -> list[str]:
    """What is wrong with where a scenario's bodies are, a line for each body; empty if they stand well.

    A body is at fault if it overlaps another one or the shelf by more than `OVERLAP`, or if it moves by more than
    `SHIFT` or turns by more than `TURN` once it is let go. Of two that overlap both are named. What stands on something
    and leans on something else may move: whether friction holds it is not for a file to know.

    Args:
      scenario: the bodies.
      world: with the shelf that they stand on; it is changed.

    Raises:
      InputError: there are more objects than slots.
    """
    bodies = slots(scenario)
    found = _faults(bodies, world)
    if not found:
        return []
    # What stands well with its quaternion read in another order was written in that order.
    turned: list[Body | None] = [
        dataclasses.replace(body, quaternion=(*body.quaternion[3:], *body.quaternion[:3]))
        if i in found and body
        else body
        for i, body in enumerate(bodies)
    ]
    still = _faults(turned, world)
    hint = "; its quaternion seems to be in the order x, y, z, w: write it as w, x, y, z"
    names = [*(f"objects[{i}]" for i in range(BODIES - 1)), "target"]
    return [f"{names[i]}: {text}{'' if i in still else hint}" for i, text in found.items()]


def check_standing(scenarios: Mapping[str, Scenario], shelf: Shelf) -> None:
    """Check that the bodies of all scenarios can be where they are; see `faults`.

    Scenes of the package's own sets, which came to rest as they were generated, are passed over.

    Args:
      scenarios: by how messages name them.
      shelf: on which the bodies stand.

    Raises:
      InputError: they cannot; the first body is named, and how many others there are.
    """
    world, found = NativeWorld(shelf), []
    for where, scenario in scenarios.items():
        scene = find_scene(scenario.name)
        if scene is None or not is_recorded(*scene, scenario):
            found += [f"{where}: {fault}" for fault in faults(scenario, world)]
    if found:
        more = f" (and {len(found) - 1} more; mechsearch scenarios check names all)" if found[1:] else ""
        raise InputError(found[0] + more)


def _faults(bodies: Sequence[Body | None], world: NativeWorld) -> dict[int, str]:
    """What is wrong with each body at fault, by its slot."""
    world.place([*bodies])
    contacts, inside = world.touching(), dict[int, tuple[float, str]]()
    for touch in contacts:
        if touch.overlap > OVERLAP:
            inside[touch.body] = max(inside.get(touch.body, (0.0, "")), (touch.overlap, touch.what))
    for i, j in itertools.permutations(range(BODIES), 2):
        # Two alike at exactly one pose have no contact.
        if (overlap := _deep(bodies[i], bodies[j])) > max(OVERLAP, inside.get(i, (0.0, ""))[0]):
            inside[i] = overlap, name_of(j)
    before = world.positions
    world.drive(np.concatenate([HOME, np.zeros(ROBOT - ARM)])[None])
    shift, turn = _motion(before, world.positions)
    moves = np.asarray(~((shift <= SHIFT) & (turn <= TURN)), bool)
    under, beside = ({t.body for t in contacts if (t.normal[2] > STEEP) == side} for side in (True, False))
    moves[[*(under & beside) - inside.keys()]] = False
    found = {}
    for i, body in enumerate(bodies):
        if body is None or not (i in inside or moves[i]):
            continue
        texts = [f"is {1e3 * inside[i][0]:.1f} mm inside {inside[i][1]}"] if i in inside else []
        if moves[i]:
            rest = ", and goes on" if world.restless[i] else ""
            texts.append(
                f"moves by {1e3 * shift[i]:.0f} mm and {np.degrees(turn[i]):.0f} degrees once it is let go{rest}"
            )
        found[i] = "; ".join(texts)
    return found


def _deep(first: Body | None, second: Body | None) -> float:
    """By how much the balls inside of two solid bodies overlap [m]; a compound may be hollow."""
    if first is None or second is None or first.compound or second.compound:
        return 0.0
    return min(first.half_size) + min(second.half_size) - math.dist(first.position, second.position)


def _motion(
    before: Float[np.ndarray, " coordinates"], after: Float[np.ndarray, " coordinates"]
) -> tuple[Float[np.ndarray, " 9"], Float[np.ndarray, " 9"]]:
    """How far each body has moved [m] and turned [rad] between two of `NativeWorld.positions`."""
    (p, q), (p_after, q_after) = (np.split(x[-7 * BODIES :].reshape(BODIES, 7), [3], axis=1) for x in (before, after))
    cosine = (np.einsum("nij,nij->n", rotation_matrix(q), rotation_matrix(q_after)) - 1.0) / 2.0
    return np.linalg.norm(p_after - p, axis=1), np.arccos(np.clip(cosine, -1.0, 1.0))
