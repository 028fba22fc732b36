"""Training the push network (paper section 4.3): its task and loss, and its scores next to other push models."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Key

from mechsearch_jax.dynamics.learned import LIKELY, MAX_PENETRATION, NAME, predicted
from mechsearch_jax.dynamics.push_model import PushModel
from mechsearch_jax.dynamics.quasi_static import QuasiStatic
from mechsearch_jax.envs.pushing import pushes as generator
from mechsearch_jax.envs.pushing.push_portions import portions
from mechsearch_jax.envs.pushing.pushes import Generation, Pushes, PushesConfig, joined, push_tables
from mechsearch_jax.envs.simulators.simulator import Simulator
from mechsearch_jax.envs.world.world import superquadrics
from mechsearch_jax.networks.push import PushConfig, PushMotion, PushNetwork, apply_network
from mechsearch_jax.networks.push_contacts import REACH, pusher_distance
from mechsearch_jax.networks.push_geometry import CHAIN, NORMALS, PushStart, push_start
from mechsearch_jax.networks.weights import save_weights
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.train.push_scores import PushTruth, model_scores, no_motion, push_truth, turn_error
from mechsearch_jax.train.scenes import SceneConfig, origin, random_world
from mechsearch_jax.workspace.shelf import Shelf

# One in so many lanes of pushes is held out.
HELD_OUT_LANES = 32
# Units of errors in the loss [m, rad]: 1 cm is as bad as 10 degrees.
_SHIFT, _TURN = 0.01, np.deg2rad(10.0)
LOSS_WEIGHTS = {"shift": 1.0, "turn": 0.5, "still": 0.1, "moves": 0.5, "topples": 0.5, "scale": 0.02}


def push_scenes() -> SceneConfig:
    """Scenes in which pushes begin; no object leans, since nothing would hold it."""
    return SceneConfig(objects=(1, 8), lying=0.03, leaning=0.0)


def crowded_scenes() -> SceneConfig:
    """Scenes for training: with few objects hardly any pushes another, and `varied` removes more of them."""
    return dataclasses.replace(push_scenes(), objects=(3, 8))


# An object that stays farther than this from everything that moves does not affect the push [m].
CLEAR = 0.005
# A body with a larger tilt (see `PushStart`) leans: no face is level, and others may hold it.
LEANS = 0.01
# Probability that an uninvolved object is removed, or a wall moved, and how far outwards at most [m].
VARIED, OUTWARDS = 0.5, 0.2


def varied(key: Key[Array, ""], start: PushStart, truth: PushTruth) -> tuple[PushStart, PushTruth]:
    """Data augmentation: the same push and outcome without random uninvolved objects and with distant walls moved.

    An approximation: objects sweep straight lines as circles around their footprints, and the hand is represented by
    the points that the network receives.

    Args:
      key: PRNG key.
      start: of a push of objects (N, ...).
      truth: their motion, fields (N, ...).
    """
    prints = start.prints
    length = jnp.sqrt(jnp.sum(start.displacement**2))
    heading = start.displacement / jnp.maximum(length, 1e-6)
    radius = jnp.sqrt(jnp.sum(prints.half**2, axis=-1))
    # A body that falls over comes to lie beside its footprint.
    radius = radius + jnp.where(truth.toppled, prints.high - prints.low, 0.0)
    shift = jnp.where(truth.moved[:, None], truth.shift, 0.0)
    offset = prints.position[None] - prints.position[:, None]
    along = jnp.sum(offset * shift[:, None], axis=-1) / jnp.maximum(jnp.sum(shift**2, axis=-1), 1e-9)[:, None]
    nearest = offset - jnp.clip(along, 0.0, 1.0)[..., None] * shift[:, None]
    clearance = jnp.sqrt(jnp.sum(nearest**2, axis=-1)) - radius[:, None] - radius[None]
    clear = jnp.all((clearance > CLEAR) | ~(truth.moved & truth.valid)[:, None], axis=0)
    distance, level = pusher_distance(prints, start.points, heading)
    clear &= jnp.min(jnp.where(level, distance, REACH), axis=1) > length + CLEAR
    # Bodies that support a leaning one are involved, too, and so are those that support them.
    gap = jnp.sqrt(jnp.sum(offset**2, axis=-1)) - radius[:, None] - radius[None]
    beside = (gap <= CLEAR) & truth.valid[:, None]
    clear &= ~jnp.any(beside & (start.tilt > LEANS)[:, None] & ~jnp.eye(len(clear), dtype=bool), axis=0)
    for _ in range(CHAIN):
        clear &= ~jnp.any(beside & ~clear[:, None], axis=0)
    keys = jax.random.split(key, 4)
    valid = truth.valid & ~(clear & ~truth.moved & jax.random.bernoulli(keys[0], VARIED, clear.shape))

    normals = jnp.asarray(NORMALS)
    ends = jnp.stack([prints.position, prints.position + shift])
    inside = jnp.sum(ends[:, :, None] * normals[None, None], axis=-1) - radius[None, :, None]
    hand = jnp.stack([start.points[:, :2], start.points[:, :2] + start.displacement[None]])
    hand = jnp.min(jnp.sum(hand[:, :, None] * normals[None, None], axis=-1), axis=(0, 1))
    # The arm reaches over the front edge.
    hand = jnp.where(normals[:, 0] > 0, jnp.inf, hand)
    room = jnp.min(jnp.where(valid[None, :, None], inside, jnp.inf), axis=(0, 1))
    room = jnp.minimum(room, hand) - start.faces - 2 * CLEAR
    far = (room > 0) & ~jnp.any(truth.toppled & truth.valid)
    inwards = jax.random.bernoulli(keys[1], 0.5, room.shape)
    moved = jax.random.uniform(keys[2], room.shape) * jnp.where(inwards, jnp.minimum(room, REACH), -OUTWARDS)
    moved = jnp.where(far & jax.random.bernoulli(keys[3], VARIED, room.shape), moved, 0.0)
    start = start.replace(prints=prints.replace(valid=valid), faces=start.faces + moved)
    return start, truth.replace(valid=valid)


# Ratio of the noise in position to the noise in yaw [m].
_TURN_RADIUS = 0.08


def blurred(key: Key[Array, ""], start: PushStart, blur: float) -> PushStart:
    """Data augmentation: the same push with noise on every object's pose.

    It counters overfitting and makes the network robust to errors of recognised poses.

    Args:
      key: PRNG key.
      start: of a push.
      blur: standard deviation of the noise on each planar coordinate of an object [m]; that of its yaw is this over
        8 cm.
    """
    prints = start.prints
    keys = jax.random.split(key)
    position = prints.position + blur * jax.random.normal(keys[0], prints.position.shape)
    yaw = prints.yaw + blur / _TURN_RADIUS * jax.random.normal(keys[1], prints.yaw.shape)
    return start.replace(prints=prints.replace(position=position, yaw=yaw))


class PushExample(PyTreeNode):
    """The network's inputs for pushes, and the true motion."""

    start: PushStart
    truth: PushTruth


def example_loss(motion: PushMotion, truth: PushTruth) -> dict[str, Float[Array, ""]]:
    """The terms of the loss of a batch, each a mean over the objects that it concerns."""
    upright = truth.valid & ~truth.toppled

    def mean(value, chosen):
        return jnp.sum(jnp.where(chosen, value, 0.0)) / jnp.maximum(jnp.sum(chosen), 1)

    gap = motion.shift - truth.shift
    shift = jnp.sqrt(gap[..., 0] ** 2 + gap[..., 1] ** 2 + 1e-10)
    turn = jnp.abs(turn_error(motion.turn, truth.turn))
    errors = jax.lax.stop_gradient(jnp.stack([shift, turn], axis=-1))
    scale = jnp.mean(errors / jnp.exp(motion.log_scale) + motion.log_scale, axis=-1)
    moved, still = upright & truth.moved, upright & ~truth.moved
    return {
        "shift": mean(shift / _SHIFT, moved),
        "turn": mean(turn / _TURN, moved),
        "still": mean(shift / _SHIFT + turn / _TURN, still),
        "moves": mean(optax.sigmoid_binary_cross_entropy(motion.moves, truth.moved), truth.valid),
        "topples": mean(optax.sigmoid_binary_cross_entropy(motion.topples, truth.toppled), truth.valid),
        "scale": mean(scale, moved),
    }


@dataclasses.dataclass(frozen=True, eq=False)
class PushTask:
    """A `loop.Task`.

    Attributes:
      pushes: for training, on the device.
      held_out: for scoring, of other scenes.
      origin: how the pushes were generated.
      network: sizes of the network.
      shelf: the shelf.
      pusher: surface of the gripper in its own frame [m].
      blur: see `blurred`; applied in training only [m].
      precision: type in which the network computes.
    """

    pushes: Pushes
    held_out: Pushes
    origin: dict[str, Any] = dataclasses.field(default_factory=dict)
    network: PushConfig = dataclasses.field(default_factory=PushConfig)
    shelf: Shelf = dataclasses.field(default_factory=Shelf)
    pusher: Array = dataclasses.field(default_factory=lambda: push_tables(PushesConfig()).pusher)
    blur: float = 5e-4
    precision: Any = jnp.float32
    name: str = NAME

    def start(self, pushes: Pushes) -> PushStart:
        """The network's inputs for pushes."""

        def start_of(scene, T, displacement):
            return push_start(self.shelf, scene, self.pusher, T, displacement)

        return jax.vmap(start_of)(superquadrics(pushes.before), pushes.T_world_gripper, pushes.displacement)

    def init(self, key: Key[Array, ""]) -> Any:
        first = self.start(jax.tree.map(lambda a: jnp.asarray(a[:1]), self.pushes))
        return PushNetwork(self.network).init(key, jax.tree.map(lambda a: a[0], first))["params"]

    def sample(self, key: Key[Array, ""], batch: int) -> PushExample:
        key, vary_key, blur_key = jax.random.split(key, 3)
        chosen = jax.random.randint(key, (batch,), 0, len(self.pushes.object))
        pushes: Pushes = jax.tree.map(lambda a: jnp.asarray(a)[chosen], self.pushes)
        start, truth = self.start(pushes), push_truth(pushes)
        start, truth = jax.vmap(varied)(jax.random.split(vary_key, batch), start, truth)
        start = jax.vmap(blurred, in_axes=(0, 0, None))(jax.random.split(blur_key, batch), start, self.blur)
        return PushExample(start, truth)

    def loss(self, parameters: Any, examples: PushExample) -> tuple[Float[Array, ""], dict[str, Any]]:
        network = PushNetwork(self.network, self.precision)
        motion = jax.vmap(functools.partial(apply_network, network, parameters))(examples.start)
        terms = example_loss(motion, examples.truth)
        loss = sum((weight * terms[name] for name, weight in LOSS_WEIGHTS.items()), jnp.zeros(()))
        return loss, terms

    def scores(self, parameters: Any, scenes: int) -> dict[str, Any]:
        """Scores of the network and of baselines on the first `scenes` held-out pushes."""
        held_out = jax.tree.map(lambda a: a[:scenes], self.held_out)
        network = PushNetwork(self.network)
        models: dict[str, PushModel] = {
            "network": functools.partial(predicted, network, parameters, LIKELY, MAX_PENETRATION),
            "quasi-static": QuasiStatic(),
            "no motion": no_motion,
        }
        return {name: model_scores(model, held_out, self.pusher, self.shelf) for name, model in models.items()}

    def save(self, path: Path, parameters: Any, card: dict[str, Any]) -> None:
        card = card | {"scored_with": {"likely": LIKELY, "max_penetration": MAX_PENETRATION}}
        save_weights(path, self.name, self.network, parameters, card)


def random_pushes(
    generation: Generation,
    folder: Path,
    gpu: bool,
    scenes: SceneConfig,
    on_progress: Callable[[int], None] = lambda pushes: None,
    make_simulator: Callable[[], Simulator] | None = None,
) -> Pushes:
    """Pushes in random scenes, simulated on a GPU or not; see `envs.pushing.push_portions.portions` for the rest."""
    draw_world = functools.partial(random_world, config=scenes)
    simulate = make_simulator or functools.partial(generator.engine, gpu)
    source = repr((generator.engine_name(gpu), generator.push_simulation(), origin(scenes)))
    return joined(list(portions(generation, folder, simulate, draw_world, source, PushesConfig(), on_progress)))


def push_task(
    generation: Generation,
    folder: Path,
    network: PushConfig | None = None,
    on_progress: Callable[[int], None] = lambda pushes: None,
) -> PushTask:
    """The task of training on pushes in a folder; missing ones are simulated first.

    Args:
      generation: number of pushes and portions.
      folder: for the pushes.
      network: sizes of the network.
      on_progress: called with the number of pushes so far.

    Raises:
      InputError: a file in the folder is damaged or was generated otherwise, the folder cannot be written, or there are
        too few pushes to hold some out.
    """
    scenes, config = crowded_scenes(), PushesConfig()
    gpu = jax.default_backend() != "cpu"
    pushes = random_pushes(generation, folder, gpu, scenes, on_progress)
    held = pushes.lane % HELD_OUT_LANES == 0
    if held.all() or not held.any():
        raise InputError("train push: too few pushes to hold some out; give more --pushes or --worlds")
    origin_of_pushes = {
        "source": "random pushes of the robot, simulated",
        "engine": generator.engine_name(gpu),
        **dataclasses.asdict(generation),
        "found": len(pushes.object),
        "held_out": int(held.sum()),
        "objects": scenes.objects,
        "lengths": config.lengths,
        "sideways": config.sideways,
        "tries": config.tries,
        "blur": PushTask.blur,
    }
    return PushTask(
        pushes=jax.tree.map(lambda a: jnp.asarray(a[~held]), pushes),
        held_out=jax.tree.map(lambda a: a[held], pushes),
        origin=origin_of_pushes,
        network=network or PushConfig(),
    )
