"""Recognisers: what the planner sees the simulated world through, from its truth to nothing but a depth image.

`oracle` knows the true shapes and poses. The others are shown the depth image of a camera with the noise of a sensor,
and make superquadrics of it as `perception.recogniser.Recogniser` does: `masks` is told which pixels are whose, and
which show nothing at all, `full` has to segment them too. Whether the target is seen is the detector's word, for all of
them; where it is, only the oracle is told. Which pixels are the target's, `full` is told if the detector sees it; as
long as it does not, they are to it those of one more object.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Literal, Protocol, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from mechsearch_jax.envs.camera.simulated_camera import observe
from mechsearch_jax.envs.camera.snapshot import Recogniser, Snapshot, oracle
from mechsearch_jax.envs.world.world import TARGET, World
from mechsearch_jax.images.cloud import MARGIN, View, above_board
from mechsearch_jax.images.labels import FREE, INSTANCES, MISSING, OTHER
from mechsearch_jax.images.noise import NoiseModel, RandomDirection, depth_of, measured_depth
from mechsearch_jax.networks.weights import Weights, shipped_weights
from mechsearch_jax.observation import Observation
from mechsearch_jax.perception.assignment import assign
from mechsearch_jax.perception.recognition import LabelledImage, ShapeNetwork, recognise_image
from mechsearch_jax.perception.refinement import RefinementConfig
from mechsearch_jax.perception.segmentation import NetworkSegmenter
from mechsearch_jax.runtime.compiled import kept
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.detector import found_pixels
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

# In a thinned image a thing may seem to have so many times the pixels that it has.
SAMPLED = 1.5

RecognitionName = Literal["oracle", "masks", "full"]


def true_labels(
    points: Float[Array, "h w 3"], owner: Int[Array, "h w"], shelf: Shelf, margin: float = MARGIN
) -> Int[Array, "h w"]:
    """Labels of an image whose pixels show the slots `owner`, as `observe` has them: objects' slots, TARGET, and what
    `images.labels` has for the rest. What is measured near the shelf counts as the shelf, whatever it is.
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
        unseen: float,
    ) -> Int[Array, "h w"]:
        """Label an image.

        Args:
          key: PRNG key.
          shelf: may be traced.
          points: in the world [m]; NaN where nothing was measured.
          of_target: where the detector sees the target; nowhere as long as it does not.
          masks: the true labels; a labeller that should not know them takes no more from them than the numbers that
            objects go by, so that what is done to an object can be judged.
          unseen: of how few pixels the detector does not find the target.
        """
        ...


def true_masks(key: Array, shelf: Shelf, points: Array, of_target: Array, masks: Array, unseen: float) -> Array:
    """The `Labeller` that is told everything."""
    return masks


@dataclasses.dataclass(frozen=True, eq=False)
class Segmenter:
    """The `Labeller` that segments the image with a network, and names the segments after the true objects.

    What shows so little of itself that it may be the target is no object to it: it would rule out the target where the
    target is.

    Attributes:
      weights: of the segmentation network.
    """

    weights: Weights

    def __call__(self, key: Array, shelf: Shelf, points: Array, of_target: Array, masks: Array, unseen: float) -> Array:
        found = NetworkSegmenter.of(self.weights)(key, shelf, points, of_target)
        return numbered(large_segments(found, SAMPLED * unseen), masks)


def numbered(found: Int[Array, "h w"], masks: Int[Array, "h w"]) -> Int[Array, "h w"]:
    """Segments, numbered 0 to 7, renamed after the true objects that they overlap most, one each; none is lost.

    A planner does not care for the names; but the simulator's notes on whether the picked object slipped do.
    """
    slots = jnp.arange(TARGET)
    own = (found.reshape(-1)[:, None] == slots[None]).astype(jnp.float32)
    truth = (masks.reshape(-1)[:, None] == slots[None]).astype(jnp.float32)
    # With nothing shared, a segment still gets one of the slots of objects that nobody sees.
    name = assign(-jnp.matmul(own.T, truth))
    return jnp.where(found >= 0, name[jnp.maximum(found, 0)], found).astype(jnp.int8)


def large_segments(labels: Int[Array, "h w"], pixels: float) -> Int[Array, "h w"]:
    """Labels in which segments, numbered from 0, that have no more than so many pixels are OTHER."""
    small = jnp.sum(labels.reshape(-1)[:, None] == jnp.arange(INSTANCES)[None], axis=0) <= pixels
    return jnp.where((labels >= 0) & small[labels], OTHER, labels).astype(jnp.int8)


class Depth(Protocol):
    """Says how deep a measured image is."""

    def __call__(
        self, camera: Camera, depth: Float[Array, "h w"], points: Float[Array, "h w 3"]
    ) -> Float[Array, "h w"]:
        """The depth of measured points [m], NaN where nothing was measured; see `noise.measured_depth`."""
        ...


def only_measured(camera: Camera, depth: Array, points: Array) -> Array:
    """The `Depth` that takes nothing from the truth: where nothing was measured, nothing is known."""
    return depth_of(camera, points)


@dataclasses.dataclass(frozen=True, eq=False)
class ImageRecogniser:
    """The `Recogniser` that sees a depth image. What it recognises has the edges of `superquadric.standard_edges`.

    Attributes:
      target: its known shape.
      labeller: says which pixels show which object.
      weights: of the recognition network.
      noise: of the depth sensor.
      refinement: how recognised shapes are refined.
      depth: of the image; by default it is known, as with true masks, where there is nothing at all.
    """

    target: Target
    labeller: Labeller
    weights: Weights
    noise: NoiseModel = dataclasses.field(default_factory=RandomDirection)
    refinement: RefinementConfig = dataclasses.field(default_factory=RefinementConfig)
    depth: Depth = measured_depth

    def __call__(self, key: Array, snapshot: Snapshot) -> Observation:
        view, shelf = snapshot.view, snapshot.shelf
        keys = jax.random.split(key, 4)
        unseen = found_pixels(snapshot.camera) / view.stride**2
        image = labelled(keys[:2], self, view, shelf, snapshot.world, snapshot.target_seen, unseen)
        shapes = ShapeNetwork.of(self.weights)
        # Compiled on its own, whatever the labels come from.
        objects, pose = recognise_image(keys[2:], image, shapes, view.camera, shelf, self.target, self.refinement)
        return Observation(objects, snapshot.target_seen, pose)


@kept(static_argnames=("recogniser", "unseen"))
def labelled(
    keys: Key[Array, "2"],
    recogniser: ImageRecogniser,
    view: View,
    shelf: Shelf,
    world: World,
    target_seen: Bool[Array, ""],
    unseen: float,
) -> LabelledImage:
    """What a recogniser makes shapes of: the part of the image that shows the shelf, as measured, with labels.

    Args:
      keys: of the noise, and of the labeller.
      recogniser: static.
      view: which rays of a camera are cast.
      shelf: what they see.
      world: the true state.
      target_seen: whether the detector sees the target; where it does not, nothing is said of its pixels.
      unseen: of how few pixels of the view the detector does not find the target; static.
    """
    image = observe(view.camera, world, shelf)
    points = recogniser.noise(keys[0], view.camera, image.depth)
    masks = true_labels(points, image.segmentation, shelf)
    labels = recogniser.labeller(keys[1], shelf, points, (image.segmentation == TARGET) & target_seen, masks, unseen)
    depth = recogniser.depth(view.camera, image.depth, points)
    return LabelledImage(points, depth, labels, (masks == TARGET) & target_seen)


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
    shapes = shipped_weights("recognition")
    if name == "masks":
        return ImageRecogniser(target, true_masks, shapes)
    return ImageRecogniser(target, Segmenter(shipped_weights("segmentation")), shapes, depth=only_measured)
