"""Training the push network (paper section 4.3): its task and loss, and its scores next to other push models."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Key

from mechsearch_jax.dynamics.learned import LIKELY, MAX_PENETRATION, NAME, predicted
from mechsearch_jax.dynamics.push_model import PushModel, PushOutcome
from mechsearch_jax.dynamics.quasi_static import QuasiStatic
from mechsearch_jax.envs.pushing import pushes as generator
from mechsearch_jax.envs.pushing.push_portions import portions
from mechsearch_jax.envs.pushing.pushes import Generation, Pushes, PushesConfig, joined, push_tables
from mechsearch_jax.envs.simulators.simulator import Simulator
from mechsearch_jax.envs.world.world import superquadrics
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import matmul
from mechsearch_jax.networks.push import PushConfig, PushMotion, PushNetwork, apply_network
from mechsearch_jax.networks.push_geometry import CHAIN, NORMALS, REACH, PushStart, push_start, pusher_distance
from mechsearch_jax.networks.weights import save_weights
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.shapes import by_shape
from mechsearch_jax.train.scenes import SceneConfig, origin, random_world
from mechsearch_jax.workspace.shelf import Shelf

# Every so many lanes of pushes one is never trained on.
HELD_OUT_LANES = 32
# What has moved less than this counts as still: objects settle by as much [m, rad].
STILL, STILL_TURN = 1e-3, np.deg2rad(0.5)
# A box is the same after half a turn [rad].
HALF_TURN = np.pi
# In the loss, errors are counted in these units [m, rad]: 1 cm is as bad as 10 degrees.
_SHIFT, _TURN = 0.01, np.deg2rad(10.0)
LOSS_WEIGHTS = {"shift": 1.0, "turn": 0.5, "still": 0.1, "moves": 0.5, "topples": 0.5, "scale": 0.02}
# Distances of the paper's pushes [m], and how much others may differ to be scored with them.
DISTANCES, WITHIN = (0.05, 0.10, 0.15), 0.025


def push_scenes() -> SceneConfig:
    """Scenes in which pushes begin: nothing leans, since nothing would hold it."""
    return SceneConfig(objects=(1, 8), lying=0.03, leaning=0.0)


def crowded_scenes() -> SceneConfig:
    """Scenes in which the network learns: with few objects hardly any pushes another, and `varied` takes some away."""
    return dataclasses.replace(push_scenes(), objects=(3, 8))


class PushTruth(flax.struct.PyTreeNode):
    """What became of the bodies; fields have the leading axes (..., 9).

    Attributes:
      shift: planar motion of the centre [m], (..., 9, 2).
      turn: about the vertical [rad].
      moved: whether it moved at all.
      toppled: whether it fell over, or off the board; its shift and turn then mean nothing.
      valid: whether it is there.
    """

    shift: jax.Array
    turn: jax.Array
    moved: jax.Array
    toppled: jax.Array
    valid: jax.Array


def planar_turn(before: Float[Array, "*batch 3 3"], after: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch"]:
    """The turn about the vertical [rad] that comes nearest to what leads from one rotation to another."""
    R = matmul(after, jnp.swapaxes(before, -1, -2))
    return jnp.arctan2(R[..., 1, 0] - R[..., 0, 1], R[..., 0, 0] + R[..., 1, 1])


def push_truth(pushes: Pushes) -> PushTruth:
    """What became of the bodies in pushes; those that settled by less than `STILL` have not moved."""
    before, after = pushes.before, pushes.after
    shift = (after.position - before.position)[..., :2]
    turn = planar_turn(before.rotation, after.rotation)
    stands = by_shape(before.kind, lambda shape: shape.round, jnp)
    stands &= jnp.abs(before.rotation[..., 2, 2]) > 0.98
    turn = jnp.where(stands, 0.0, turn)
    far = (shift[..., 0] ** 2 + shift[..., 1] ** 2 > STILL**2) | (jnp.abs(turn) > STILL_TURN)
    return PushTruth(shift, turn, before.valid & (far | pushes.toppled), pushes.toppled, before.valid)


def turn_error(a: Float[Array, "*shape"], b: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Difference of two turns of a box [rad], at most a quarter turn."""
    return a - b - HALF_TURN * jnp.round((a - b) / HALF_TURN)


# Nothing that stays farther than this from all that moves has a part in it [m].
CLEAR = 0.005
# Of a body whose tilt (see `PushStart`) is above this, no face is level; others may hold it.
LEANS = 0.01
# How often something that has no part in a push is taken away, or a wall set elsewhere, and how far outwards [m].
VARIED, OUTWARDS = 0.5, 0.2


def varied(key: Key[Array, ""], start: PushStart, truth: PushTruth) -> tuple[PushStart, PushTruth]:
    """The same push, with the same outcome, less some objects that had no part in it, and with other distant walls.

    An approximation: objects are taken to move on straight lines, in circles around their footprints, and the hand as
    the points of it that the network is told of.

    Args:
      key: PRNG key.
      start: of a push of objects (N, ...).
      truth: what became of them, fields (N, ...).
    """
    prints = start.prints
    length = jnp.sqrt(jnp.sum(start.displacement**2))
    heading = start.displacement / jnp.maximum(length, 1e-6)
    radius = jnp.sqrt(jnp.sum(prints.half**2, axis=-1))
    # What falls over comes to lie beside its footprint.
    radius = radius + jnp.where(truth.toppled, prints.high - prints.low, 0.0)
    shift = jnp.where(truth.moved[:, None], truth.shift, 0.0)
    offset = prints.position[None] - prints.position[:, None]
    along = jnp.sum(offset * shift[:, None], axis=-1) / jnp.maximum(jnp.sum(shift**2, axis=-1), 1e-9)[:, None]
    nearest = offset - jnp.clip(along, 0.0, 1.0)[..., None] * shift[:, None]
    clearance = jnp.sqrt(jnp.sum(nearest**2, axis=-1)) - radius[:, None] - radius[None]
    clear = jnp.all((clearance > CLEAR) | ~(truth.moved & truth.valid)[:, None], axis=0)
    distance, level = pusher_distance(prints, start.points, heading)
    clear &= jnp.min(jnp.where(level, distance, REACH), axis=1) > length + CLEAR
    # What holds something in place has a part in it, too, and so has what holds that.
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


# A pose that is off by a length is off by that over this in its turn [m].
_TURN_RADIUS = 0.08


def blurred(key: Key[Array, ""], start: PushStart, blur: float) -> PushStart:
    """The same push with every object told a little beside where it is.

    It is meant to keep the network from knowing pushes by heart, and to make it bear what recognition makes of poses.

    Args:
      key: PRNG key.
      start: of a push.
      blur: standard deviation of what is added to each coordinate of an object in the plane [m]; its turn about the
        vertical is off by that over 8 cm.
    """
    prints = start.prints
    keys = jax.random.split(key)
    position = prints.position + blur * jax.random.normal(keys[0], prints.position.shape)
    yaw = prints.yaw + blur / _TURN_RADIUS * jax.random.normal(keys[1], prints.yaw.shape)
    return start.replace(prints=prints.replace(position=position, yaw=yaw))


class PushExample(flax.struct.PyTreeNode):
    """Pushes as the network is told them, and what became of them."""

    start: PushStart
    truth: PushTruth


def example_loss(told: PushMotion, truth: PushTruth) -> dict[str, Float[Array, ""]]:
    """The terms of the loss of a batch, each a mean over the objects that it is about."""
    upright = truth.valid & ~truth.toppled

    def mean(value, chosen):
        return jnp.sum(jnp.where(chosen, value, 0.0)) / jnp.maximum(jnp.sum(chosen), 1)

    gap = told.shift - truth.shift
    shift = jnp.sqrt(gap[..., 0] ** 2 + gap[..., 1] ** 2 + 1e-10)
    turn = jnp.abs(turn_error(told.turn, truth.turn))
    errors = jax.lax.stop_gradient(jnp.stack([shift, turn], axis=-1))
    scale = jnp.mean(errors / jnp.exp(told.log_scale) + told.log_scale, axis=-1)
    moved, still = upright & truth.moved, upright & ~truth.moved
    return {
        "shift": mean(shift / _SHIFT, moved),
        "turn": mean(turn / _TURN, moved),
        "still": mean(shift / _SHIFT + turn / _TURN, still),
        "moves": mean(optax.sigmoid_binary_cross_entropy(told.moves, truth.moved), truth.valid),
        "topples": mean(optax.sigmoid_binary_cross_entropy(told.topples, truth.toppled), truth.valid),
        "scale": mean(scale, moved),
    }


@dataclasses.dataclass(frozen=True, eq=False)
class PushTask:
    """A `loop.Task`.

    Attributes:
      pushes: to learn from, on the device.
      held_out: to be scored on, of other scenes.
      origin: how the pushes were made.
      network: sizes of the network.
      shelf: the shelf.
      pusher: surface of the gripper in its own frame [m].
      blur: see `blurred`; of what is learnt from alone [m].
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
        """How pushes begin."""

        def one(scene, T, displacement):
            return push_start(self.shelf, scene, self.pusher, T, displacement)

        return jax.vmap(one)(superquadrics(pushes.before), pushes.T_world_gripper, pushes.displacement)

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
        told = jax.vmap(functools.partial(apply_network, network, parameters))(examples.start)
        terms = example_loss(told, examples.truth)
        loss = sum((weight * terms[name] for name, weight in LOSS_WEIGHTS.items()), jnp.zeros(()))
        return loss, terms

    def scores(self, parameters: Any, scenes: int) -> dict[str, Any]:
        """Scores on so many held-out pushes, of the network and of what there is without one."""
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
    told: Callable[[int], None] = lambda pushes: None,
    make_simulator: Callable[[], Simulator] | None = None,
) -> Pushes:
    """Pushes in such scenes, simulated on a GPU or not; see `envs.pushing.push_portions.portions` for the rest."""
    draw_world = functools.partial(random_world, config=scenes)
    simulate = make_simulator or functools.partial(generator.engine, gpu)
    source = repr((generator.engine_name(gpu), generator.push_simulation(), origin(scenes)))
    return joined(list(portions(generation, folder, simulate, draw_world, source, PushesConfig(), told)))


def push_task(
    generation: Generation,
    folder: Path,
    network: PushConfig | None = None,
    told: Callable[[int], None] = lambda pushes: None,
) -> PushTask:
    """The task of learning from pushes in a folder; those that are not there yet are simulated first.

    Args:
      generation: how many pushes.
      folder: for the pushes.
      network: sizes of the network.
      told: is told how many pushes there are.

    Raises:
      InputError: what lies in the folder is damaged or was made otherwise, the folder cannot be written, or there are
        too few pushes to hold some out.
    """
    scenes, config = crowded_scenes(), PushesConfig()
    gpu = jax.default_backend() != "cpu"
    pushes = random_pushes(generation, folder, gpu, scenes, told)
    held = pushes.lane % HELD_OUT_LANES == 0
    if held.all() or not held.any():
        raise InputError("train push: too few pushes to hold some out; give more --pushes or --worlds")
    made = {
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
        origin=made,
        network=network or PushConfig(),
    )


def no_motion(
    shelf: Shelf, scene: Superquadrics, pusher: Array, T_world_gripper: Array, displacement: Array, q7: Array
) -> PushOutcome:
    """The `PushModel` that predicts nothing."""
    nowhere = jnp.zeros(scene.capacity)
    return PushOutcome(scene, nowhere > 0, jnp.zeros(()), jnp.array(True), nowhere)


@functools.partial(jax.jit, static_argnames=("model", "shelf"))
def _predict(model: PushModel, pushes: Pushes, pusher: Array, shelf: Shelf) -> PushOutcome:
    def one(push: Pushes) -> PushOutcome:
        return model(shelf, superquadrics(push.before), pusher, push.T_world_gripper, push.displacement, push.q7)

    return jax.vmap(one)(pushes)


def predictions(
    model: PushModel,
    pushes: Pushes,
    pusher: Float[Array, "p 3"],
    shelf: Shelf | None = None,
    batch: int = 128,
    told: Callable[[int], None] = lambda pushes: None,
) -> PushOutcome:
    """What a model predicts of pushes.

    Args:
      model: jitted as a static argument.
      pushes: on the host.
      pusher: surface of the gripper in its own frame [m].
      shelf: the shelf.
      batch: pushes at once.
      told: is told how many are predicted.

    Returns:
      Fields with a leading axis for the pushes, on the host.
    """
    count = len(pushes.object)
    batch = min(batch, count)
    parts = []
    for start in range(0, count, batch):
        # The last batch begins earlier than where the one before it ended, so that all have one size.
        first = min(start, count - batch)
        some = jax.tree.map(lambda a, first=first: a[first : first + batch], pushes)
        outcome = jax.device_get(_predict(model, some, pusher, shelf or Shelf()))
        parts.append(jax.tree.map(lambda a, skip=start - first: a[skip:], outcome))
        told(min(start + batch, count))
    return jax.tree.map(lambda *a: np.concatenate(a), *parts)


def average_precision(score: Float[np.ndarray, " n"], truth: Bool[np.ndarray, " n"]) -> float:
    """Mean precision over the positives, in the order of falling scores; equal scores are one step. NaN without any."""
    if not truth.any():
        return float("nan")
    order = np.argsort(-score, kind="stable")
    hits = np.cumsum(truth[order])
    last = np.append(np.diff(score[order]) != 0, True)
    hits, seen = hits[last], np.flatnonzero(last) + 1
    return float(np.sum(np.diff(hits, prepend=0) * hits / seen) / truth.sum())


def model_scores(
    model: PushModel, pushes: Pushes, pusher: Float[Array, "p 3"], shelf: Shelf | None = None, batch: int = 128
) -> dict[str, Any]:
    """How well a model predicts pushes: the `outcome_scores` of its `predictions`; see there."""
    return outcome_scores(predictions(model, pushes, pusher, shelf, batch), pushes)


class _Compared(flax.struct.PyTreeNode):
    """Predictions next to the truth; fields have the leading axes (pushes, 9)."""

    shift_error: jax.Array
    turn_error: jax.Array
    shift: jax.Array
    topples: jax.Array


@jax.jit
def _compare(told: PushOutcome, pushes: Pushes, truth: PushTruth) -> _Compared:
    before = pushes.before
    shift = (told.scene.position - before.position)[..., :2]
    gap = shift - truth.shift
    turn = planar_turn(before.rotation, told.scene.rotation)
    return _Compared(
        shift_error=jnp.sqrt(gap[..., 0] ** 2 + gap[..., 1] ** 2),
        turn_error=jnp.abs(turn_error(turn, truth.turn)),
        shift=jnp.sqrt(shift[..., 0] ** 2 + shift[..., 1] ** 2),
        topples=told.topples,
    )


def outcome_scores(told: PushOutcome, pushes: Pushes) -> dict[str, Any]:
    """How well outcomes were predicted: over all, by distance, by the number of objects, and by both.

    Args:
      told: what was predicted of each push, with all nine bodies of a world in its scene.
      pushes: on the host.

    Returns:
      For each group the number of `pushes` and of those that the model `failed` at (an infinite residual; what it says
      of them counts all the same), mean errors of the pushed object (`pushed_mm`, `pushed_deg`, the latter of boxes)
      and of others that moved (`other_mm`), the share of still objects that are predicted to move by less than `STILL`
      (`still`), and the average precision of toppling (`topple_ap`). Objects that toppled, over or off the board, count
      for the last alone; so many were left out of the others (`toppled`), and so many of them were pushed themselves
      (`pushed_toppled`).

    Raises:
      InputError: what was predicted is no number.
    """
    valid = np.asarray(pushes.before.valid)
    numbers = told.scene.position, told.scene.rotation, told.topples
    if not all(np.isfinite(np.asarray(a)[valid]).all() for a in numbers):
        raise InputError("predictions of pushes are not finite numbers; the model's weights may be damaged")
    truth = push_truth(jax.tree.map(jnp.asarray, pushes))
    compared, truth = jax.device_get((_compare(told, pushes, truth), truth))
    failed = np.isinf(np.asarray(told.residual))
    length = np.linalg.norm(pushes.displacement, axis=1)
    objects = np.asarray(pushes.before.valid)[:, :-1].sum(axis=1)
    sideways = np.abs(np.asarray(pushes.displacement)[:, 0]) < 1e-3
    groups: dict[str, np.ndarray] = {
        "all": np.ones(len(length), bool),
        "sideways": sideways,
        "forward and diagonal": ~sideways,
    }
    near = {f"{100 * d:.0f} cm": np.abs(length - d) <= WITHIN for d in DISTANCES}
    counts = {f"{n} objects": objects == n for n in range(1, pushes.before.valid.shape[1])}
    # Together, those of about one of the distances; between them is no gap.
    together = f"{100 * (DISTANCES[0] - WITHIN):.1f} to {100 * (DISTANCES[-1] + WITHIN):.1f} cm"
    groups |= near | {together: np.any(list(near.values()), axis=0)} | counts
    groups |= {f"{a}, {b}": x & y for a, x in near.items() for b, y in counts.items()}
    return {name: _summary(compared, truth, failed, pushes, chosen) for name, chosen in groups.items() if chosen.any()}


def _summary(
    compared: _Compared, truth: PushTruth, failed: np.ndarray, pushes: Pushes, chosen: np.ndarray
) -> dict[str, Any]:
    here = chosen[:, None] & truth.valid
    upright = here & ~truth.toppled
    pushed = np.arange(truth.valid.shape[1])[None] == pushes.object[:, None]
    turns = ~by_shape(np.asarray(pushes.before.kind), lambda shape: shape.round, np)
    still = upright & ~truth.moved

    def mean(value, where, unit):
        return round(float(value[where].mean() * unit), 3) if where.any() else None

    precision = average_precision(np.asarray(compared.topples)[here], np.asarray(truth.toppled)[here])
    return {
        "pushes": int(chosen.sum()),
        "failed": int(failed[chosen].sum()),
        "toppled": int((here & truth.toppled).sum()),
        "pushed_toppled": int((here & truth.toppled & pushed).sum()),
        "pushed_mm": mean(compared.shift_error, upright & pushed, 1e3),
        "pushed_deg": mean(compared.turn_error, upright & pushed & turns, 180 / np.pi),
        "other_mm": mean(compared.shift_error, upright & ~pushed & truth.moved, 1e3),
        "still": mean((compared.shift < STILL).astype(float), still, 1.0),
        "topple_ap": None if np.isnan(precision) else round(precision, 4),
    }
