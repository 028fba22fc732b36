"""Recognisers of the simulated world, from the true state to nothing but a depth image.

- `informed` returns the true shapes and poses, and the target's from the start.
- `oracle` returns the true shapes and poses.
- `masks` receives a noisy depth image with the true segmentation, and with the pixels that show nothing marked.
- `full` receives a noisy depth and a noisy colour image alone and segments them.
- `masks-parts` and `full-parts` are these two with bodies of up to four parts, see `perception.parts.in_parts`.

`masks` and `full` fit superquadrics as `perception.recogniser.Recogniser` does. `oracle` and `masks` know whether
the target shows more than 100 pixels, and `masks` then which; only the oracle gets the target's pose. `full` finds the
target by itself in a depth and a colour image, by `images.detection.detect`, as on a robot.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from typing import Literal, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from mechsearch_jax.envs.camera.colour_image import ColourSensing, drawn_appearance, scene_key, sensed_colour
from mechsearch_jax.envs.camera.sensing import Sensing, sensed_depth, true_camera
from mechsearch_jax.envs.camera.simulated_camera import Image, observe
from mechsearch_jax.envs.camera.snapshot import Recogniser, Snapshot, informed, oracle
from mechsearch_jax.envs.world.world import TARGET, World
from mechsearch_jax.images.cloud import MARGIN, View, above_board
from mechsearch_jax.images.colour import TargetColour
from mechsearch_jax.images.detection import ColouredDepth, Detection, detect
from mechsearch_jax.images.labels import FREE, INSTANCES, MISSING, OTHER
from mechsearch_jax.images.measured import measured_share
from mechsearch_jax.images.noise import NoiseModel, RandomDirection, depth_of, measured_depth
from mechsearch_jax.networks.weights import Weights, shipped_weights
from mechsearch_jax.observation import Observation
from mechsearch_jax.perception.explanation import Explaining, Fitter, as_segmented
from mechsearch_jax.perception.parts.in_parts import InParts
from mechsearch_jax.perception.parts.joining import join_floating
from mechsearch_jax.perception.parts.segments import Connected
from mechsearch_jax.perception.recognition import LabelledImage, ShapeNetwork
from mechsearch_jax.perception.refinement import RefinementConfig
from mechsearch_jax.perception.segmentation import NetworkSegmenter, Segmenter
from mechsearch_jax.runtime.compiled import cached_jit
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.detector import SAMPLED, found_pixels
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

RecognitionName = Literal["oracle", "masks", "masks-parts", "full", "full-parts", "informed"]
# The recognisers that see no image.
_TRUE: Mapping[str, Recogniser] = {"oracle": oracle, "informed": informed}


def true_labels(
    points: Float[Array, "h w 3"], owner: Int[Array, "h w"], shelf: Shelf, margin: float = MARGIN
) -> Int[Array, "h w"]:
    """Labels of an image: objects' slots, TARGET, or a label of `images.labels`; points near the shelf count as shelf.

    Args:
      points: in the world [m]; NaN where nothing was measured.
      owner: the slot that each pixel shows, as `Image.segmentation`.
      shelf: may be traced.
      margin: distance from the shelf within which a point counts as shelf [m].
    """
    body = jnp.where((owner >= 0) & (owner <= TARGET), owner, OTHER)
    labels = jnp.where(above_board(shelf, points, margin), body, FREE)
    return jnp.where(jnp.isfinite(points).all(axis=-1), labels, MISSING).astype(jnp.int8)


def large_segments(labels: Int[Array, "h w"], pixels: float) -> Int[Array, "h w"]:
    """Labels with segments, numbered from 0, of at most `pixels` pixels set to OTHER."""
    small = jnp.sum(labels.reshape(-1)[:, None] == jnp.arange(INSTANCES)[None], axis=0) <= pixels
    return jnp.where((labels >= 0) & small[labels], OTHER, labels).astype(jnp.int8)


@dataclasses.dataclass(frozen=True, eq=False)
class ImageRecogniser:
    """The `Recogniser` that sees a depth image with masks.

    Recognised shapes have the edges of `superquadric.standard_edges`.

    Attributes:
      target: its shape.
      weights: of the recognition network.
      noise: of the depth sensor.
      refinement: how recognised shapes are refined.
      fitter: fits objects to the true segments.
    """

    target: Target
    weights: Weights
    noise: NoiseModel = dataclasses.field(default_factory=RandomDirection)
    refinement: RefinementConfig = dataclasses.field(default_factory=RefinementConfig)
    fitter: Fitter = as_segmented

    def __call__(self, key: Array, snapshot: Snapshot) -> Observation:
        view, shelf = snapshot.view, snapshot.shelf
        keys = jax.random.split(key, 4)
        image = labelled(keys[0], self, view, shelf, snapshot.world, snapshot.target_seen, snapshot.sensing)
        seen = snapshot.target_seen
        if snapshot.sensing is not None and snapshot.sensing.holes is not None:
            seen &= jnp.sum(image.of_target) > found_pixels(snapshot.camera) / view.stride**2
            image = image.replace(of_target=image.of_target & seen)
        shapes = ShapeNetwork.of(self.weights)
        fitted = self.fitter(keys[2:], image, shapes, view.camera, shelf, self.target, self.refinement)
        measured = measured_share(snapshot.camera, view, image.depth)
        return Observation(fitted.objects, seen, fitted.target_pose, fitted.confidence, measured)


@cached_jit(static_argnames=("recogniser",))
def labelled(
    key: Key[Array, ""],
    recogniser: ImageRecogniser,
    view: View,
    shelf: Shelf,
    world: World,
    target_seen: Bool[Array, ""],
    sensing: Sensing | None = None,
) -> LabelledImage:
    """The labelled image that a recogniser fits shapes to: the part that shows the shelf, as measured.

    Args:
      key: of the noise.
      recogniser: static.
      view: which rays of a camera are cast.
      shelf: the shelf in the image.
      world: the true state.
      target_seen: whether the detector sees the target; if not, the image marks no pixels as the target's.
      sensing: see `Snapshot`; the points lie where they seem to be to the planner.
    """
    image = observe(true_camera(view.camera, sensing), world, shelf)
    noise = recogniser.noise if sensing is None or sensing.noise is None else sensing.noise
    points = noise(key, view.camera, sensed_depth(view.camera, world, image, sensing))
    masks = true_labels(points, image.segmentation, shelf)
    # Where the true image shows nothing is marked, as in true masks.
    depth = measured_depth(view.camera, image.depth, points)
    return LabelledImage(points, depth, masks, (masks == TARGET) & target_seen)


@dataclasses.dataclass(frozen=True, eq=False)
class WeightedSegmenter:
    """The `NetworkSegmenter` of some weights, as a static value.

    Attributes:
      weights: of the segmentation network.
    """

    weights: Weights

    def __call__(self, key: Array, shelf: Shelf, points: Array, of_target: Array) -> Array:
        return NetworkSegmenter.of(self.weights)(key, shelf, points, of_target)


@dataclasses.dataclass(frozen=True, eq=False)
class ColourRecogniser:
    """The `Recogniser` that sees a depth and a colour image, and nothing else.

    Objects have random colours, which belong to the scene. Recognised shapes have the edges of
    `superquadric.standard_edges`.

    Attributes:
      target: its shape.
      detector: finds the target's colour, which is the target's true one.
      segmenter: says which pixels show which object.
      weights: of the recognition network.
      noise: of the depth sensor.
      camera: of colours, where `Snapshot.sensing` says nothing.
      refinement: how recognised shapes are refined.
      fitter: fits objects to the labelled image.
      detects_target: see `snapshot.Truth`.
    """

    target: Target
    detector: TargetColour
    segmenter: Segmenter
    weights: Weights
    noise: NoiseModel = dataclasses.field(default_factory=RandomDirection)
    camera: ColourSensing = dataclasses.field(default_factory=ColourSensing)
    refinement: RefinementConfig = dataclasses.field(default_factory=RefinementConfig)
    fitter: Fitter = dataclasses.field(default_factory=Explaining)
    detects_target: bool = True

    def __call__(self, key: Array, snapshot: Snapshot) -> Observation:
        view, shelf = snapshot.view, snapshot.shelf
        keys = jax.random.split(key, 4)
        unseen = found_pixels(snapshot.camera) / view.stride**2
        image, seen = detected(keys[:2], self, view, shelf, snapshot.world, unseen, snapshot.sensing)
        shapes = ShapeNetwork.of(self.weights)
        settings = (shapes, view.camera, shelf, self.target, self.refinement)
        fitted = self.fitter(keys[2:], image, *settings, least=SAMPLED * unseen)
        measured = measured_share(snapshot.camera, view, image.depth)
        return Observation(fitted.objects, seen, fitted.target_pose, fitted.confidence, measured)


def sighted(
    key: Key[Array, ""],
    recogniser: ColourRecogniser,
    view: View,
    shelf: Shelf,
    world: World,
    unseen: float,
    sensing: Sensing | None = None,
) -> tuple[Image, Float[Array, "h w 3"], Float[Array, "h w"], Detection]:
    """The true image, the measured points and their depth, and the target that is detected.

    Args:
      key: of the noise.
      recogniser, view, shelf, world, unseen, sensing: see `detected`.
    """
    camera = recogniser.camera if sensing is None or sensing.colour is None else sensing.colour
    appearance = drawn_appearance(scene_key(world), recogniser.detector.rgb, camera.hue_gap)
    image = observe(true_camera(view.camera, sensing), world, shelf, appearance)
    noise = recogniser.noise if sensing is None or sensing.noise is None else sensing.noise
    points = noise(key, view.camera, sensed_depth(view.camera, world, image, sensing))
    depth = depth_of(view.camera, points)
    # The noise of the depth takes 0 to 2 of this key, see `OtherNoise`.
    colour = sensed_colour(jax.random.fold_in(key, 3), image.colour, camera)
    detection = detect(
        jax.random.fold_in(key, 4),
        recogniser.detector,
        recogniser.target,
        shelf,
        view.camera,
        ColouredDepth(points, depth, colour),
        unseen,
    )
    return image, points, depth, detection


@cached_jit(static_argnames=("recogniser", "unseen"))
def detected(
    keys: Key[Array, "2"],
    recogniser: ColourRecogniser,
    view: View,
    shelf: Shelf,
    world: World,
    unseen: float,
    sensing: Sensing | None = None,
) -> tuple[LabelledImage, Bool[Array, ""]]:
    """The labelled image that a recogniser fits shapes to, and whether it shows the target.

    Args:
      keys: of the noise, and of the segmenter.
      recogniser: static.
      view, shelf, world, sensing: see `labelled`.
      unseen: a target of at most this many pixels of the view is not detected; static.
    """
    _, points, depth, detection = sighted(keys[0], recogniser, view, shelf, world, unseen, sensing)
    # As objects, small segments would rule out the pose of a target that is not detected.
    segments = recogniser.segmenter(keys[1], shelf, points, detection.pixels | detection.unclear)
    labels = large_segments(segments, SAMPLED * unseen)
    of_target = detection.pixels & above_board(shelf, points) & detection.visible
    return LabelledImage(points, depth, labels, of_target), detection.visible


def recogniser(name: str, target: Target, detector: TargetColour | None = None) -> Recogniser:
    """The recogniser of a name; the same object for the same arguments, so that nothing is compiled twice.

    Args:
      name: one of `RecognitionName`.
      target: whose shape is given.
      detector: of the target's colour, for `full`; `TargetColour.lit()`, red, if None.

    Raises:
      InputError: there is no recogniser of that name, or its weights are missing or damaged.
    """
    if name not in get_args(RecognitionName):
        raise InputError(f'recognition "{name}" is unknown; use {", ".join(get_args(RecognitionName))}')
    if name in _TRUE:
        return _TRUE[name]
    seen, _, parts = name.partition("-")
    several = bool(parts)
    return _with_masks(target, several) if seen == "masks" else _alone(target, detector or TargetColour.lit(), several)


@functools.cache
def _with_masks(target: Target, several: bool) -> ImageRecogniser:
    fitter = InParts() if several else as_segmented
    return ImageRecogniser(target, shipped_weights("recognition"), fitter=fitter)


@functools.cache
def _alone(target: Target, detector: TargetColour, several: bool) -> ColourRecogniser:
    segmenter = WeightedSegmenter(shipped_weights("segmentation"))
    fitter = InParts(Connected(), joining=join_floating) if several else Explaining()
    return ColourRecogniser(target, detector, segmenter, shipped_weights("recognition"), fitter=fitter)
