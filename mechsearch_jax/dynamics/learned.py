"""The push model learnt from simulated pushes (paper section 4.3); a `push_model.PushModel`."""

from __future__ import annotations

import dataclasses
import functools
import importlib.resources
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from mechsearch_jax.dynamics.contacts import unresolved
from mechsearch_jax.dynamics.push_model import PushOutcome
from mechsearch_jax.dynamics.rigid import rigid_motion
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.networks.push import PushNetwork, apply_network
from mechsearch_jax.networks.push_geometry import push_start
from mechsearch_jax.networks.weights import Weights, load_weights, read_archive, read_card
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.shelf import Shelf

NAME = "push"
# Probability of moving above which an object is predicted to move. At this value, less than 1 in 100 of the objects
# that stay is predicted to move, but 3 in 100 where there is one object and the target.
LIKELY = 0.75
# A real hand is compliant and stops short of its goal: in 1 of 20 simulated pushes, the result overlaps by 2 cm with
# the hand at its goal or with a neighbour, and predictions next to a wall are off by as much. 6 mm more is jammed [m].
MAX_PENETRATION = 0.026


@functools.cache
def _weights(path: Path, digest: str) -> Weights:
    """The network in a file whose card states this digest."""
    return load_weights(path, NAME)


@dataclasses.dataclass(frozen=True)
class LearnedPush:
    """Predicts pushes with a trained network. Instances with equal weights are equal.

    Attributes:
      path: of the weights; the package's if left out.
      likely: probability of moving above which an object is moved; others stay exactly where they are.
      max_penetration: a push with more overlap than this with the hand, a wall or another object is not resolved [m].
      digest: of the weights, read from their card.

    Raises:
      InputError: the weights are missing or damaged, or a number is out of range.
    """

    path: Path | None = dataclasses.field(default=None, compare=False)
    likely: float = LIKELY
    max_penetration: float = MAX_PENETRATION
    digest: str = dataclasses.field(default="", init=False)

    def __post_init__(self):
        if not 0.0 <= self.likely <= 1.0 or not self.max_penetration >= 0.0:
            raise InputError(
                f"LearnedPush: likely {self.likely} must be from 0 to 1, and max_penetration {self.max_penetration} m"
                " must not be negative"
            )
        shipped = self.path is None
        path = self.path or Path(str(importlib.resources.files("mechsearch_jax") / "networks" / f"{NAME}.npz"))
        # The class is frozen.
        object.__setattr__(self, "path", path)
        card = read_card(path, NAME)
        object.__setattr__(self, "digest", str(card.get("sha256")))
        if shipped:
            # The package's weights fit the network. Checking that takes a second, and a compiled program does not need
            # the network.
            read_archive(path, card)
        else:
            _weights(path, self.digest)

    def __call__(
        self, shelf: Shelf, scene: Superquadrics, pusher: Array, T_world_gripper: Array, displacement: Array, q7: Array
    ) -> PushOutcome:
        """See `push_model.PushModel`."""
        assert self.path is not None
        weights = _weights(self.path, self.digest)
        network = weights.network
        assert isinstance(network, PushNetwork)
        predict = functools.partial(predicted, network, weights.parameters, self.likely, self.max_penetration)
        return predict(shelf, scene, pusher, T_world_gripper, displacement, q7)


def predicted(
    network: PushNetwork,
    parameters: Any,
    likely: float,
    max_penetration: float,
    shelf: Shelf,
    scene: Superquadrics,
    pusher: Array,
    T_world_gripper: Array,
    displacement: Array,
    q7: Array,
) -> PushOutcome:
    """A network's prediction of a push; see `LearnedPush` and `push_model.PushModel` for the arguments.

    An approximation: to the network a body of several parts is the superquadric that bounds it. Overlaps afterwards are
    those of its parts.
    """
    start = push_start(shelf, scene, pusher, T_world_gripper, displacement)
    output = apply_network(network, parameters, start)
    moves = scene.valid & (jax.nn.sigmoid(output.moves) > likely)
    before = start.prints
    prints = before.replace(
        position=before.position + jnp.where(moves[:, None], output.shift, 0.0),
        yaw=before.yaw + jnp.where(moves, output.turn, 0.0),
    )
    shifted = rigid_motion(scene, before.position, prints.position, output.turn)
    after = jax.tree.map(lambda new, old: jnp.where(moves.reshape(-1, *[1] * (new.ndim - 1)), new, old), shifted, scene)
    # The points of the gripper that the network uses: with all points, overlaps are deeper by half a millimetre.
    end = start.points + displacement[None]
    residual = unresolved(shelf, before, prints, end)
    return PushOutcome(
        scene=after,
        moved=moves,
        residual=residual,
        resolved=residual <= max_penetration,
        topples=jnp.where(scene.valid, jax.nn.sigmoid(output.topples), 0.0),
    )
