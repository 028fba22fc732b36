"""Training of the segmentation network: its examples, its matched loss and its held-out scores."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, Key

from mechsearch_jax.envs.world.world import BODIES, TARGET
from mechsearch_jax.images.cloud import POINTS, View, cloud_of, resample, shelf_view
from mechsearch_jax.images.labels import INSTANCES, OTHER
from mechsearch_jax.images.trained_view import TrainedView
from mechsearch_jax.networks.segmentation import SegmentationConfig, SegmentationNetwork, apply_network
from mechsearch_jax.networks.weights import save_weights
from mechsearch_jax.perception.assignment import assign
from mechsearch_jax.perception.segmentation import clean_up, labels_of
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.train.loop import HELD_OUT_SEED
from mechsearch_jax.train.scenes import SceneConfig, noise_names, origin, random_scene, taken, worth_seeing
from mechsearch_jax.workspace.shelf import Shelf

# Weight of a layer's loss relative to the next layer's.
_EARLIER = 0.5
# Unit of centre errors in the loss [m].
_UNIT = 0.05


class Example(PyTreeNode):
    """Labelled clouds; every field has the leading axis of the batch.

    Attributes:
      points: in the world [m], (P, 3).
      labels: slot of each point's object, or OTHER, (P,).
      centres: centre of each point's object [m], (P, 3).
      weight: 1, or 0 if the camera sees no object.
      objects: number of objects, seen or not.
      worth: which objects show at least 100 pixels of the full image, (8,).
      sensor: index of the noise in `SceneConfig.noises`.
    """

    points: jax.Array
    labels: jax.Array
    centres: jax.Array
    weight: jax.Array
    objects: jax.Array
    worth: jax.Array
    sensor: jax.Array


def match(logits: Float[Array, "p classes"], labels: Int[Array, " p"]) -> Int[Array, " classes"]:
    """The network's instance that each label is matched with, at the least total cost.

    The cost of a pair is the sum of both terms of `segmentation_loss` for it. Labels without points get the remaining
    instances. The last entry stands for OTHER, which matches itself.
    """
    log_probability = jax.nn.log_softmax(logits)[:, :INSTANCES]
    member = (labels[:, None] == jnp.arange(INSTANCES)[None]).astype(jnp.float32)
    count = jnp.sum(member, axis=0)
    likelihood = -jnp.matmul(member.T, log_probability, precision="highest") / jnp.maximum(count, 1.0)[:, None]
    cost = likelihood + 2.0 * dice(jnp.exp(log_probability), member).T
    cost = jnp.where(count[:, None] > 0, cost, 0.0)
    return jnp.append(assign(jax.lax.stop_gradient(cost)), INSTANCES)


def dice(probability: Float[Array, "p a"], member: Float[Array, "p b"]) -> Float[Array, "a b"]:
    """One minus the overlap (F. Milletari et al., "V-Net", 2016) of soft memberships with hard ones."""
    shared = jnp.matmul(probability.T, member, precision="highest")
    total = jnp.sum(probability, axis=0)[:, None] + jnp.sum(member, axis=0)[None, :]
    return 1.0 - (2.0 * shared + 1.0) / (total + 1.0)


def segmentation_loss(logits: Float[Array, "p classes"], labels: Int[Array, " p"]) -> dict[str, Float[Array, ""]]:
    """The matched loss of one cloud: mean cross-entropy of its points, mean overlap loss of its objects, and accuracy.

    It is invariant to permutations of the labels and of the network's instances.
    """
    instance = match(logits, labels)
    wanted = instance[jnp.where(labels == OTHER, INSTANCES, labels)]
    cross_entropy = optax.softmax_cross_entropy_with_integer_labels(logits, wanted)
    probability = jax.nn.softmax(logits)[:, instance[:INSTANCES]]
    member = (labels[:, None] == jnp.arange(INSTANCES)[None]).astype(jnp.float32)
    present = jnp.sum(member, axis=0) > 0
    overlap = jnp.diagonal(dice(probability, member))
    return {
        "cross_entropy": jnp.mean(cross_entropy),
        "dice": jnp.sum(overlap * present) / jnp.maximum(jnp.sum(present), 1),
        "accuracy": jnp.mean(jnp.argmax(logits, axis=-1) == wanted),
    }


@dataclasses.dataclass(frozen=True)
class SegmentationTask:
    """A `loop.Task`.

    Attributes:
      network: sizes of the network.
      scenes: distribution of the scenes.
      shelf: the shelf.
      view: which rays are cast.
      points: in a cloud.
      precision: type in which the network computes.
    """

    network: SegmentationConfig = dataclasses.field(default_factory=SegmentationConfig)
    scenes: SceneConfig = dataclasses.field(default_factory=SceneConfig)
    shelf: Shelf = dataclasses.field(default_factory=Shelf)
    view: View = dataclasses.field(default_factory=shelf_view)
    points: int = POINTS
    precision: Any = jnp.bfloat16
    name: str = "segmentation"

    @property
    def origin(self) -> dict[str, Any]:
        return origin(self.scenes)

    def init(self, key: Key[Array, ""]) -> Any:
        points = jnp.zeros((1, max(64, self.network.neighbours), 3))
        return SegmentationNetwork(self.network).init(key, points)["params"]

    def scene(self, key: Key[Array, ""]) -> Example:
        """A random scene's cloud.

        The target's points are left out, as by the detector's mask; the last instance is a ninth object. Points of
        further objects, and of the shelf where noise has lifted them off it, are kept as OTHER.
        """
        worlds, sensing, drawing = jax.random.split(key, 3)
        scene, seen = taken(sensing, random_scene(worlds, self.scenes, self.shelf, self.view), self.scenes)
        world = scene.world
        cloud = cloud_of(seen.points)
        labels = seen.labels.reshape(-1)
        cloud = cloud.replace(valid=cloud.valid & (labels >= OTHER) & (labels != TARGET))
        cloud = resample(drawing, cloud, self.points)
        slot = jnp.where(cloud.valid, labels[cloud.pixel], OTHER)
        centres = world.position[jnp.maximum(slot, 0)]
        label = jnp.where(slot < TARGET, slot, jnp.where(slot == BODIES, TARGET, OTHER)).astype(slot.dtype)
        weight = cloud.valid[0].astype(jnp.float32)
        return Example(
            points=cloud.points,
            labels=label,
            centres=centres,
            weight=weight,
            objects=jnp.sum(world.valid[:TARGET]),
            worth=worth_seeing(seen, self.view),
            sensor=seen.sensor,
        )

    def sample(self, key: Key[Array, ""], batch: int) -> Example:
        return jax.vmap(self.scene)(jax.random.split(key, batch))

    def loss(self, parameters: Any, examples: Example) -> tuple[Float[Array, ""], dict[str, Any]]:
        output = apply_network(SegmentationNetwork(self.network, self.precision), parameters, examples.points)
        terms = jax.vmap(jax.vmap(segmentation_loss), in_axes=(0, None))(output.logits, examples.labels)
        total = jnp.maximum(jnp.sum(examples.weight), 1.0)
        layers = {name: jnp.sum(a * examples.weight[None], axis=1) / total for name, a in terms.items()}
        error = jnp.abs(output.centres - examples.centres) / _UNIT
        of_object = (examples.labels != OTHER)[..., None] * examples.weight[:, None, None]
        centres = jnp.sum(error * of_object) / jnp.maximum(3.0 * jnp.sum(of_object), 1.0)
        share = _EARLIER ** jnp.arange(len(output.logits))[::-1]
        loss = jnp.sum(share * (layers["cross_entropy"] + 2.0 * layers["dice"])) / jnp.sum(share) + centres
        return loss, {name: a[-1] for name, a in layers.items()} | {"centres": centres}

    def scores(self, parameters: Any, scenes: int) -> dict[str, Any]:
        return held_out_scores(self, parameters, scenes)

    def save(self, path: Path, parameters: Any, card: dict[str, Any]) -> None:
        view = TrainedView(self.view.camera, self.shelf).entry()
        save_weights(path, self.name, self.network, parameters, card | {"view": view})


def instance_overlaps(
    segments: Int[Array, " p"], labels: Int[Array, " p"]
) -> tuple[Float[Array, " instances"], Bool[Array, " instances"]]:
    """Intersection over union of each true instance's points with those of its matched segment.

    The matching maximises the sum; an instance without a segment counts as 0.

    Returns:
      The overlaps, and which true instances are present.
    """
    instances = jnp.arange(INSTANCES)
    truth = (labels[:, None] == instances[None]).astype(jnp.float32)
    segmented = (segments[:, None] == instances[None]).astype(jnp.float32)
    shared = jnp.matmul(truth.T, segmented, precision="highest")
    union = jnp.sum(truth, axis=0)[:, None] + jnp.sum(segmented, axis=0)[None] - shared
    overlap = shared / jnp.maximum(union, 1.0)
    return overlap[instances, assign(-overlap)], jnp.sum(truth, axis=0) > 0


@functools.partial(jax.jit, static_argnames=("task", "batch"))
def _score_batch(task: SegmentationTask, parameters: Any, key: Array, batch: int):
    examples = task.sample(key, batch)
    output = apply_network(SegmentationNetwork(task.network), parameters, examples.points)
    raw = labels_of(output.logits[-1].reshape(-1, INSTANCES + 1)).reshape(batch, -1)
    valid = jnp.broadcast_to(examples.weight[:, None] > 0, raw.shape)
    clean = jax.vmap(clean_up)(examples.points, raw, valid)
    raw, present = jax.vmap(instance_overlaps)(raw, examples.labels)
    clean, _ = jax.vmap(instance_overlaps)(clean, examples.labels)
    # `worth` has no entry for the target.
    worth = present & jnp.pad(examples.worth, ((0, 0), (0, INSTANCES - examples.worth.shape[1])))
    return raw, clean, present, worth, examples.objects, examples.sensor


def held_out_scores(task: SegmentationTask, parameters: Any, scenes: int, batch: int = 32) -> dict[str, Any]:
    """Mean instance IoU on held-out scenes, before and after the clean-up, by number of objects and kind of noise.

    Scenes are drawn as in training. Scores are over all objects with a point in the cloud, and over those with at least
    100 pixels of the full image.
    """
    key = jax.random.key(HELD_OUT_SEED)
    parts = [_score_batch(task, parameters, jax.random.fold_in(key, i), batch) for i in range(-(-scenes // batch))]
    raw, clean, present, worth, objects, sensors = jax.tree.map(
        lambda *a: np.concatenate([np.asarray(x) for x in a]), *parts
    )

    def summary(counted):
        if not counted.any():
            return {"objects": 0}
        means = {"iou_raw": np.mean(raw[counted]), "iou_clean": np.mean(clean[counted])}
        return {"objects": int(counted.sum()), **{name: round(float(mean), 4) for name, mean in means.items()}}

    result: dict[str, Any] = {}
    for sensor, noise in enumerate(noise_names(task.scenes)):
        for count in range(1, TARGET + 1):
            chosen = (objects == count) & (sensors == sensor)
            if present[chosen].any():
                result[f"{count} objects, {noise}"] = {
                    "scenes": int(chosen.sum()),
                    "all": summary(present & chosen[:, None]),
                    "100 pixels and more": summary(worth & chosen[:, None]),
                }
    return result
