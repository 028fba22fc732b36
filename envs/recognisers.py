"""Recognisers: what the planner sees the simulated world through, from its truth to nothing but a depth image.

`oracle` knows the true shapes and poses. The others are shown the depth image of a camera with the noise of a sensor,
and make superquadrics of it as `perception.recogniser.Recogniser` does: `masks` is told which pixels are whose, `full`
has to segment them too. Whether the target is seen is the detector's word, for all of them; where it is, only the
oracle is told.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Literal, Protocol, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from mechsearch_jax.envs.simulated_camera import observe
from mechsearch_jax.envs.snapshot import Recogniser, Snapshot, oracle
from mechsearch_jax.envs.world import TARGET, World
from mechsearch_jax.errors import InputError
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.networks.weights import Weights, shipped_weights
from mechsearch_jax.observation import Observation
from mechsearch_jax.perception.assignment import assign
from mechsearch_jax.perception.cloud import MARGIN, View, above_board, shelf_view
from mechsearch_jax.perception.labels import FREE, INSTANCES, MISSING, OTHER
from mechsearch_jax.perception.noise import NoiseModel, RandomDirection, measured_depth
from mechsearch_jax.perception.recognition import LabelledImage, ShapeNetwork, recognise_image
from mechsearch_jax.perception.refinement import RefinementConfig
from mechsearch_jax.perception.segmentation import NetworkSegmenter
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

RecognitionName = Literal["oracle", "masks", "full"]


def true_labels(
    points: Float[Array, "h w 3"], owner: Int[Array, "h w"], shelf: Shelf, margin: float = MARGIN
) -> Int[Array, "h w"]:
    """Labels of an image whose pixels show the slots `owner`, as `observe` has them: objects' slots, TARGET, and what
    `perception.labels` has for the rest. What is measured near the shelf counts as the shelf, whatever it is.
    """
    body = jnp.where((owner >= 0) & (owner <= TARGET), owner, OTHER)
    labels = jnp.where(above_board(shelf, points, margin), body, FREE)
    return jnp.where(jnp.isfinite(points).all(axis=-1), labels, MISSING).astype(jnp.int8)


class Labeller(Protocol):
    """Says which pixels show which object."""

    def __call__(
        self,
        key: Key[Array, ""],
        shelf: Shelf,
        points: Float[Array, "h w 3"],
        of_target: Bool[Array, "h w"],
        masks: Int[Array, "h w"],
    ) -> Int[Array, "h w"]:
        """Label an image.

        Args:
          key: PRNG key.
          shelf: static.
          points: in the world [m]; NaN where nothing was measured.
          of_target: where the detector sees the target.
          masks: the true labels; a labeller that should not know them takes no more from them than the numbers that
            objects go by, so that what is done to an object can be judged.
        """
        ...


def true_masks(key: Array, shelf: Shelf, points: Array, of_target: Array, masks: Array) -> Array:
    """The `Labeller` that is told everything."""
    return masks


@dataclasses.dataclass(frozen=True, eq=False)
class Segmenter:
    """The `Labeller` that segments the image with a network, and names the segments after the true objects.

    Attributes:
      weights: of the segmentation network.
    """

    weights: Weights

    def __call__(self, key: Array, shelf: Shelf, points: Array, of_target: Array, masks: Array) -> Array:
        return numbered(NetworkSegmenter.of(self.weights)(key, shelf, points, of_target), masks)


def numbered(found: Int[Array, "h w"], masks: Int[Array, "h w"]) -> Int[Array, "h w"]:
    """Segments renamed after the true objects that they overlap most, one each; what is left over becomes OTHER.

    A planner does not care for the names; but the simulator's notes on whether the picked object slipped do.
    """
    segments = jnp.arange(INSTANCES)
    own = (found.reshape(-1)[:, None] == segments[None]).astype(jnp.float32)
    truth = (masks.reshape(-1)[:, None] == segments[None]).astype(jnp.float32)
    shared = jnp.matmul(own.T, truth)
    # With nothing shared, a segment still gets one of the slots of objects that nobody sees. One finds none.
    slots = jnp.where(segments[None] < TARGET, shared, 0.0)
    slot = assign(-slots)
    name = jnp.where(slot < TARGET, slot, OTHER)
    return jnp.where(found >= 0, name[jnp.maximum(found, 0)], found).astype(jnp.int8)


@dataclasses.dataclass(frozen=True, eq=False)
class ImageRecogniser:
    """The `Recogniser` that sees a depth image. What it recognises has the edges of `superquadric.standard_edges`.

    Attributes:
      target: its known shape.
      labeller: says which pixels show which object.
      weights: of the recognition network.
      noise: of the depth sensor.
      refinement: how recognised shapes are refined.
    """

    target: Target
    labeller: Labeller
    weights: Weights
    noise: NoiseModel = dataclasses.field(default_factory=RandomDirection)
    refinement: RefinementConfig = dataclasses.field(default_factory=RefinementConfig)

    def __call__(self, key: Array, snapshot: Snapshot) -> Observation:
        view = shelf_view(snapshot.camera, snapshot.shelf)
        objects, pose = _recognise(key, self, view, snapshot.shelf, snapshot.world)
        return Observation(objects, snapshot.target_seen, pose)


@functools.partial(jax.jit, static_argnames=("recogniser", "view", "shelf"))
def _recognise(
    key: Array, recogniser: ImageRecogniser, view: View, shelf: Shelf, world: World
) -> tuple[Superquadrics, Float[Array, " 3"]]:
    """The objects, and where the target would be if it was seen."""
    keys = jax.random.split(key, 4)
    image = observe(view.camera, world, shelf)
    points = recogniser.noise(keys[0], view.camera, image.depth)
    masks = true_labels(points, image.segmentation, shelf)
    labels = recogniser.labeller(keys[1], shelf, points, image.segmentation == TARGET, masks)
    seen = LabelledImage(points, measured_depth(view.camera, image.depth, points), labels, masks == TARGET)
    shapes = ShapeNetwork.of(recogniser.weights)
    return recognise_image(keys[2:], seen, shapes, view.camera, shelf, recogniser.target, recogniser.refinement)


@functools.cache
def recogniser(name: str, target: Target) -> Recogniser:
    """The recogniser of a name; the same object for the same arguments, so that nothing is compiled twice.

    Args:
      name: "oracle", "masks" or "full".
      target: its known shape.

    Raises:
      InputError: there is none of that name, or its weights are missing or damaged.
    """
    if name not in get_args(RecognitionName):
        raise InputError(f'recognition "{name}" is unknown; use {", ".join(get_args(RecognitionName))}')
    if name == "oracle":
        return oracle
    labellers = {"masks": lambda: true_masks, "full": lambda: Segmenter(shipped_weights("segmentation"))}
    return ImageRecogniser(target, labellers[name](), shipped_weights("recognition"))
