"""Training of the recognition network: its examples, its loss (paper equations 6 and 7) and its held-out scores."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, Key

from mechsearch_jax.envs.world.world import TARGET, World, true_superquadrics
from mechsearch_jax.geometry import superquadric
from mechsearch_jax.geometry.transforms import matmul, rotate
from mechsearch_jax.images.cloud import View, shelf_view
from mechsearch_jax.images.segments import SegmentConfig, Segments, segment_clouds
from mechsearch_jax.images.trained_view import TrainedView
from mechsearch_jax.networks.recognition import (
    BASE_ROTATIONS,
    HYPOTHESES,
    HYPOTHESIS_KINDS,
    IS_ROUND,
    Hypotheses,
    RecognitionConfig,
    RecognitionNetwork,
    apply_network,
)
from mechsearch_jax.networks.weights import save_weights
from mechsearch_jax.perception.recognition import best_hypothesis, nearness
from mechsearch_jax.perception.scores import EDGE, centre_error, intersection_over_union, sharpened
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.shapes import by_shape
from mechsearch_jax.train.loop import HELD_OUT_SEED
from mechsearch_jax.train.scenes import (
    PIXELS,
    Capture,
    Scene,
    SceneConfig,
    in_catalogue,
    noise_names,
    origin,
    random_scene,
    surface_points,
    taken,
    visible_share,
    worth_seeing,
)
from mechsearch_jax.workspace.shelf import Shelf

# Points of the true surface that equation 7 is averaged over.
SURFACE = 512
# Unit of sizes, positions and the root of equation 7 in the loss [m].
_UNIT = 0.01
# How far beyond its range of yaw angles a hypothesis is still trained [rad].
_OVERLAP = np.deg2rad(6.0)
# Deviation of the height of what an object stands on, where that is no board [m].
_SUPPORT_ERROR = 0.002
# Exponents of a sharp edge, and of a round cross-section.
_SHARP, _ROUND = 0.06, 1.0


def _cube_symmetries() -> np.ndarray:
    """The 24 rotations that map a cube's axes onto each other."""
    turns = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            if np.linalg.det(matrix) > 0:
                turns.append(matrix)
    return np.stack(turns).astype(np.float32)


SYMMETRIES = _cube_symmetries()


class Truth(PyTreeNode):
    """A true body in a segment's frame; every field may have leading axes.

    Attributes:
      kind: code of its shape.
      half_size: [m], (..., 3).
      position: `t_segment_object` [m], (..., 3).
      rotation: `R_segment_object`, (..., 3, 3).
      surface: uniform points of its surface, in the segment's frame [m], (..., 512, 3).
    """

    kind: jax.Array
    half_size: jax.Array
    position: jax.Array
    rotation: jax.Array
    surface: jax.Array


class Example(PyTreeNode):
    """Segments and their true bodies; every field has the leading axis of the batch.

    Attributes:
      segments: the network's input.
      truth: the true bodies.
      weight: 1, or 0 if there is no segment.
    """

    segments: Segments
    truth: Truth
    weight: jax.Array


class Answers(PyTreeNode):
    """The right answer of every hypothesis for one true body.

    Attributes:
      turn: rotation vector from the hypothesis' base orientation [rad], (13, 3).
      half_size: along the axes of that description of the body [m], (13, 3).
      taught: whether the hypothesis is near enough to be trained, (13,).
      right: whether it is the one that should win, (13,).
    """

    turn: jax.Array
    half_size: jax.Array
    taught: jax.Array
    right: jax.Array


def rotation_vector(rotation: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 3"]:
    """The vector [rad] of a rotation by less than a half turn."""
    off = jnp.stack([rotation[..., i, j] - rotation[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=-1)
    trace = rotation[..., 0, 0] + rotation[..., 1, 1] + rotation[..., 2, 2]
    sine = jnp.linalg.norm(off, axis=-1)
    angle = jnp.arctan2(sine, trace - 1.0)
    return off * jnp.where(sine > 1e-6, angle / jnp.maximum(sine, 1e-6), 0.5)[..., None]


def answers(kind: Int[Array, ""], half_size: Float[Array, "3"], rotation: Float[Array, "3 3"]) -> Answers:
    """The right answer of each hypothesis for a body with `R_segment_object = rotation`.

    A box is the same under 24 rotations that permute its axes, a cylinder under rotations about its axis and under half
    a turn; of the equal descriptions each hypothesis takes the one nearest to its base orientation.
    """
    base = jnp.asarray(BASE_ROTATIONS)
    relative = matmul(jnp.swapaxes(base, -1, -2), rotation)
    symmetric = matmul(relative[:, None], jnp.asarray(SYMMETRIES)[None])
    best = jnp.argmax(jnp.trace(symmetric, axis1=-2, axis2=-1), axis=1)
    box_turn = rotation_vector(jnp.take_along_axis(symmetric, best[:, None, None, None], axis=1)[:, 0])
    box_size = jnp.sum(jnp.abs(jnp.asarray(SYMMETRIES))[best] * half_size[None, :, None], axis=1)

    axis = relative[:, :, 2]
    axis = axis * jnp.where(axis[:, 2:] < 0, -1.0, 1.0)
    sine = jnp.sqrt(axis[:, 0] ** 2 + axis[:, 1] ** 2)
    angle = jnp.arctan2(sine, axis[:, 2])
    ratio = jnp.where(sine > 1e-6, angle / jnp.maximum(sine, 1e-6), 1.0)
    can_turn = jnp.stack([-axis[:, 1] * ratio, axis[:, 0] * ratio, jnp.zeros_like(ratio)], axis=-1)

    is_round = jnp.asarray(IS_ROUND)
    turn = jnp.where(is_round[:, None], can_turn, box_turn)
    size = jnp.where(is_round[:, None], half_size[None], box_size)
    distance = jnp.linalg.norm(turn, axis=-1)
    fits = jnp.asarray(HYPOTHESIS_KINDS) == kind
    right = jnp.argmin(jnp.where(fits, distance, jnp.inf)) == jnp.arange(HYPOTHESES)
    near = distance < jnp.min(jnp.where(fits, distance, jnp.inf)) + _OVERLAP
    return Answers(turn, size, fits & near, right)


@dataclasses.dataclass(frozen=True)
class RecognitionTask:
    """A `loop.Task`.

    Attributes:
      network: sizes of the network.
      scenes: distribution of the scenes.
      segments: how clouds are drawn.
      shelf: the shelf.
      view: which rays are cast.
      share: mean number of examples per scene, of its up to eight objects.
      ragged: share of scenes whose labels have ragged borders, as a segmentation's.
      misjudged: share of objects that are taken to stand on what another object stands on, in scenes with stacks.
      precision: type in which the network computes.
    """

    network: RecognitionConfig = dataclasses.field(default_factory=RecognitionConfig)
    scenes: SceneConfig = dataclasses.field(default_factory=SceneConfig)
    segments: SegmentConfig = dataclasses.field(default_factory=SegmentConfig)
    shelf: Shelf = dataclasses.field(default_factory=Shelf)
    view: View = dataclasses.field(default_factory=shelf_view)
    share: int = 5
    ragged: float = 0.25
    misjudged: float = 0.15
    precision: Any = jnp.bfloat16
    name: str = "recognition"

    @property
    def origin(self) -> dict[str, Any]:
        return origin(self.scenes)

    def init(self, key: Key[Array, ""]) -> Any:
        segments = self.segments.points
        inputs = jnp.zeros((1, segments, 3)), jnp.zeros((1, segments), jnp.int8), jnp.zeros((1, 3))
        return RecognitionNetwork(self.network).init(key, *inputs)["params"]

    def scene(self, key: Key[Array, ""]) -> tuple[World, Capture, Example]:
        """A random scene, its image, and the examples of its eight slots."""
        worlds, sensing, drawing, surfaces, tearing, torn = jax.random.split(key, 6)
        scene, seen = taken(sensing, random_scene(worlds, self.scenes, self.shelf, self.view), self.scenes)
        world = scene.world
        labels = jnp.where(jax.random.bernoulli(torn, self.ragged), tear(tearing, seen.labels), seen.labels)
        segments = segment_clouds(drawing, scene.camera, seen.points, labels, scene.shelf, TARGET, self.segments)
        if self.scenes.stacked:
            segments = self._raised(jax.random.fold_in(drawing, 1), segments, scene)
        if self.scenes.places is not None:
            segments = segments.replace(camera=nearness(scene.camera, scene.shelf) * segments.camera)
        objects = jax.tree.map(lambda a: a[:TARGET], world)
        local = jax.vmap(functools.partial(surface_points, count=SURFACE))(
            jax.random.split(surfaces, TARGET), objects.kind, objects.half_size
        )
        surface = rotate(objects.rotation[:, None], local) + objects.position[:, None]
        R_segment_world = jnp.swapaxes(segments.T_world_segment[:, :3, :3], -1, -2)
        origin = segments.T_world_segment[:, :3, 3]
        truth = Truth(
            kind=objects.kind,
            half_size=objects.half_size,
            position=rotate(R_segment_world, objects.position - origin),
            rotation=matmul(R_segment_world, objects.rotation),
            surface=rotate(R_segment_world[:, None], surface - origin[:, None]),
        )
        # Training includes objects that show too little to be scored, but at least a quarter of that.
        taught = segments.valid & objects.valid & worth_seeing(seen, self.view, PIXELS // 4)
        return world, seen, Example(segments, truth, taught.astype(jnp.float32))

    def _raised(self, key: Array, segments: Segments, scene: Scene) -> Segments:
        """The segments as if the board were what each stands on, with some mistakes."""
        wrong, other, error = jax.random.split(key, 3)
        support = scene.support[:TARGET] - scene.shelf.board
        support = jnp.where(support > 0, support + _SUPPORT_ERROR * jax.random.normal(error, (TARGET,)), 0.0)
        misjudged = jax.random.bernoulli(wrong, self.misjudged, (TARGET,))
        support = jnp.where(misjudged, support[jax.random.randint(other, (TARGET,), 0, TARGET)], support)
        return segments.replace(
            points=segments.points.at[..., 2].add(-support[:, None]),
            camera=segments.camera.at[..., 2].add(-support),
            T_world_segment=segments.T_world_segment.at[:, 2, 3].add(support),
        )

    def sample(self, key: Key[Array, ""], batch: int) -> Example:
        examples = jax.vmap(lambda k: self.scene(k)[2])(jax.random.split(key, batch))
        flat = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), examples)
        order = jnp.argsort(-flat.weight)[: batch * self.share]
        return jax.tree.map(lambda a: a[order], flat)

    def loss(self, parameters: Any, examples: Example) -> tuple[Float[Array, ""], dict[str, Any]]:
        segments = examples.segments
        network = RecognitionNetwork(self.network, self.precision)
        hypotheses = apply_network(network, parameters, segments.points, segments.mark, segments.camera)
        terms = jax.vmap(example_loss)(hypotheses, examples.truth)
        total = jnp.maximum(jnp.sum(examples.weight), 1.0)
        means = jax.tree.map(lambda a: jnp.sum(a * examples.weight) / total, terms)
        loss = sum((weight * means[name] for name, weight in LOSS_WEIGHTS.items()), jnp.zeros(()))
        return loss, means | {"examples": total}

    def scores(self, parameters: Any, scenes: int) -> dict[str, Any]:
        return held_out_scores(self, parameters, scenes)

    def save(self, path: Path, parameters: Any, card: dict[str, Any]) -> None:
        view = TrainedView(self.view.camera, self.shelf).entry()
        save_weights(path, self.name, self.network, parameters, card | {"view": view})


LOSS_WEIGHTS = {
    "class": 0.5,
    "turn": 1.0,
    "size": 1.0,
    "position": 1.0,
    "surface": 1.0,
    "exponents": 0.1,
    "scale": 0.02,
}


def example_loss(hypotheses: Hypotheses, truth: Truth) -> dict[str, Float[Array, ""]]:
    """The terms of one example's loss.

    `surface` is the root of equation 7 for the hypothesis that should win, in centimetres: the root, so that mostly
    hidden objects do not dominate. The other terms pull every hypothesis near the truth directly towards it.
    """
    right = answers(truth.kind, truth.half_size, truth.rotation)
    share = right.taught / jnp.maximum(jnp.sum(right.taught), 1)

    def mean(error, unit):
        return jnp.sum(share * jnp.mean(jnp.abs(error) / unit, axis=-1))

    size_error = hypotheses.size - right.half_size
    position_error = hypotheses.position - truth.position[None]
    edges = jnp.stack([jnp.full(HYPOTHESES, _SHARP), jnp.where(jnp.asarray(IS_ROUND), _ROUND, _SHARP)], axis=-1)
    errors = jax.lax.stop_gradient(jnp.abs(jnp.concatenate([size_error, position_error], axis=-1)))
    scale = jnp.exp(hypotheses.log_scale)
    winner = jnp.argmax(right.right)
    best = jax.tree.map(lambda a: a[winner], hypotheses)
    local = rotate(best.rotation.T, truth.surface - best.position[None])
    radial = superquadric.radial_distance(best.size, best.exponents, local)
    return {
        "class": optax.softmax_cross_entropy(hypotheses.logit, _soft(right)),
        "correct": (jnp.argmax(hypotheses.logit) == winner).astype(jnp.float32),
        "turn": mean(hypotheses.turn - right.turn, 0.1),
        "size": mean(size_error, _UNIT),
        "position": mean(position_error, _UNIT),
        "exponents": mean(hypotheses.exponents - edges, 0.1),
        "scale": jnp.sum(share * jnp.mean(errors / scale + hypotheses.log_scale, axis=-1)),
        "surface": jnp.sqrt(jnp.mean(radial**2) + 1e-10) / _UNIT,
    }


def _soft(right: Answers) -> Float[Array, " k"]:
    """Target probabilities: 0.8 for the winner, the rest spread evenly over the trained hypotheses."""
    near = right.taught / jnp.maximum(jnp.sum(right.taught), 1)
    return 0.8 * right.right + 0.2 * near


def tear(key: Key[Array, ""], labels: Int[Array, "h w"], reach: int = 2) -> Int[Array, "h w"]:
    """Labels with ragged borders: each pixel takes the label of one up to `reach` pixels away, if both show objects."""
    height, width = labels.shape
    shift = jax.random.randint(key, (2, height, width), -reach, reach + 1)
    rows = jnp.clip(jnp.arange(height)[:, None] + shift[0], 0, height - 1)
    columns = jnp.clip(jnp.arange(width)[None, :] + shift[1], 0, width - 1)
    other = labels[rows, columns]
    return jnp.where((labels >= 0) & (other >= 0), other, labels)


class _Scored(PyTreeNode):
    overlap: jax.Array
    centre: jax.Array
    right: jax.Array
    share: jax.Array
    counted: jax.Array
    catalogue: jax.Array
    sensor: jax.Array


@functools.partial(jax.jit, static_argnames=("task", "batch"))
def _score_batch(task: RecognitionTask, parameters: Any, key: Array, batch: int) -> _Scored:
    worlds, seen, examples = jax.vmap(task.scene)(jax.random.split(key, batch))
    flat = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), examples.segments)
    hypotheses = apply_network(RecognitionNetwork(task.network), parameters, flat.points, flat.mark, flat.camera)
    recognised = jax.tree.map(lambda a: a.reshape(batch, TARGET, *a.shape[1:]), best_hypothesis(hypotheses, flat))
    truth = sharpened(true_superquadrics(worlds))
    return _Scored(
        overlap=intersection_over_union(truth, recognised),
        centre=centre_error(truth, recognised),
        right=(recognised.exponents[..., 1] > EDGE)
        == by_shape(worlds.kind[:, :TARGET], lambda shape: shape.round, jnp),
        share=jax.vmap(visible_share)(seen),
        counted=truth.valid & jax.vmap(lambda s: worth_seeing(s, task.view))(seen),
        catalogue=jax.vmap(in_catalogue)(worlds)[:, :TARGET],
        sensor=jnp.broadcast_to(seen.sensor[:, None], (batch, TARGET)),
    )


def held_out_scores(task: RecognitionTask, parameters: Any, scenes: int, batch: int = 32) -> dict[str, Any]:
    """Scores on held-out scenes, separately for every kind of noise and of shapes.

    They cover objects with at least 100 pixels of the full image, with true masks and without refinement.
    """
    clean = dataclasses.replace(task, ragged=0.0)
    key = jax.random.key(HELD_OUT_SEED)
    parts = [_score_batch(clean, parameters, jax.random.fold_in(key, i), batch) for i in range(-(-scenes // batch))]
    scored = jax.tree.map(lambda *a: np.concatenate([np.asarray(x).reshape(-1) for x in a]), *parts)
    result: dict[str, Any] = {}
    for shapes, is_catalogue in (("paper's shapes", True), ("random shapes", False)):
        for sensor, noise in enumerate(noise_names(task.scenes)):
            chosen = scored.counted & (scored.catalogue == is_catalogue) & (scored.sensor == sensor)
            result[f"{shapes}, {noise}"] = {
                "all": _summary(scored, chosen),
                "visible 60% and more": _summary(scored, chosen & (scored.share >= 0.6)),
                "visible below 30%": _summary(scored, chosen & (scored.share < 0.3)),
            }
    return result


def _summary(scored: _Scored, chosen: Bool[np.ndarray, " n"]) -> dict[str, float]:
    if not chosen.any():
        return {"objects": 0}
    return {
        "objects": int(chosen.sum()),
        "iou_mean": round(float(np.mean(scored.overlap[chosen])), 4),
        "iou_median": round(float(np.median(scored.overlap[chosen])), 4),
        "centre_median_mm": round(1e3 * float(np.median(scored.centre[chosen])), 3),
        "shape_right": round(float(np.mean(scored.right[chosen])), 4),
    }
