"""Recognisers of the simulated world, from the true state to nothing but images.

- `informed` returns the true shapes and poses, and the target's from the start.
- `oracle` returns the true shapes and poses.
- `masks` sees a noisy depth image and true masks, of which it knows the target's number, and knows which pixels show
  nothing.
- `full` sees a noisy depth and a noisy colour image, and nothing else.
- `masks-parts` and `full-parts` are these two with bodies of up to four parts, see `perception.parts.in_parts`.

What sees images is `perception.recogniser.ViewRecogniser`, as on a robot, before the images of the simulated camera.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from typing import Literal, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from mechsearch_jax.envs.camera.colour_image import ColourSensing, drawn_appearance, scene_key, sensed_colour
from mechsearch_jax.envs.camera.sensing import Sensing, sensed_depth, true_camera
from mechsearch_jax.envs.camera.sensors import surfaces_of
from mechsearch_jax.envs.camera.simulated_camera import SHELF, observe
from mechsearch_jax.envs.camera.snapshot import Recogniser, Snapshot, informed, oracle
from mechsearch_jax.envs.world.world import TARGET, World
from mechsearch_jax.images.cloud import MARGIN, View, above_board
from mechsearch_jax.images.colour import TargetColour
from mechsearch_jax.images.labels import FREE, MISSING, OTHER
from mechsearch_jax.images.noise import NoiseModel, RandomDirection, measured_depth
from mechsearch_jax.observation import Observation
from mechsearch_jax.perception.explanation import Explaining, as_segmented
from mechsearch_jax.perception.parts.in_parts import InParts
from mechsearch_jax.perception.parts.joining import join_floating
from mechsearch_jax.perception.parts.segments import Connected
from mechsearch_jax.perception.recogniser import ViewImages, ViewRecogniser
from mechsearch_jax.runtime.compiled import cached_jit
from mechsearch_jax.runtime.errors import InputError
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


@dataclasses.dataclass(frozen=True, eq=False)
class ImageRecogniser:
    """The `Recogniser` that sees images of the simulated camera.

    Attributes:
      core: recognises what they show, as on a robot.
      masks: whether there are true masks with the target's number; else there is a colour image, and the target has to
        be detected in it.
      target_colour: red, green and blue in 0 to 1; objects have random other colours, which belong to the scene.
      noise: of the depth, where `Snapshot.sensing` says nothing.
      colours: of the colour camera, where `Snapshot.sensing` says nothing.
    """

    core: ViewRecogniser
    masks: bool
    target_colour: tuple[float, float, float] = TargetColour.lit().rgb
    noise: NoiseModel = dataclasses.field(default_factory=RandomDirection)
    colours: ColourSensing = dataclasses.field(default_factory=ColourSensing)

    @property
    def detects_target(self) -> bool:
        """See `snapshot.Detects`."""
        return not self.masks

    def images(self, key: Key[Array, ""], snapshot: Snapshot) -> ViewImages:
        """The images that the camera takes; `key` is of their noise."""
        colour_of = None if self.masks else self.target_colour
        sensing = snapshot.sensing or Sensing()
        return taken(key, snapshot.view, snapshot.shelf, snapshot.world, sensing, colour_of, self.noise, self.colours)

    def __call__(self, key: Array, snapshot: Snapshot) -> Observation:
        return self.core(snapshot.camera, snapshot.view, snapshot.shelf, self.images(key, snapshot))


@cached_jit(static_argnames=("target_colour", "noise"))
def taken(
    key: Key[Array, ""],
    view: View,
    shelf: Shelf,
    world: World,
    sensing: Sensing,
    target_colour: tuple[float, float, float] | None,
    noise: NoiseModel,
    colours: ColourSensing,
) -> ViewImages:
    """The images that the simulated camera takes: depth, and colours or true masks.

    Of points that noise moves, an image shows the depth.

    Args:
      key: of the noise.
      view: which rays of a camera are cast.
      shelf: the shelf in the image.
      world: the true state.
      sensing: what of it is not where the planner takes it to be, or measured otherwise.
      target_colour: red, green and blue in 0 to 1; None for true masks instead of colours; static.
      noise: of the depth, where `sensing` says nothing; static.
      colours: of the colour camera, where `sensing` says nothing.
    """
    depth_key, colour_key = jax.random.split(key)
    camera = sensing.colour or colours
    appearance = None
    if target_colour is not None:
        appearance = drawn_appearance(scene_key(world), target_colour, camera.hue_gap)
    image = observe(true_camera(view.camera, sensing), world, shelf, appearance)
    depth, colour = sensed_depth(view.camera, world, image, sensing), image.colour
    if sensing.noise is None:
        points = noise(depth_key, view.camera, depth)
    else:
        there = true_camera(view.camera, sensing)
        surfaces = surfaces_of(scene_key(world), there, shelf, world, image.segmentation, image.depth)
        points = sensing.noise(depth_key, view.camera, depth, surfaces)
        colour = sensing.noise.shifted(view.camera, colour)
    depth = measured_depth(view.camera, image.depth, points)
    if target_colour is None:
        mask = jnp.where(image.segmentation == SHELF, FREE, image.segmentation)
        return ViewImages(depth, mask=mask, target_id=jnp.int32(TARGET))
    # A camera does not tell nothing from what it does not measure.
    depth = jnp.where(jnp.isfinite(depth), depth, jnp.nan)
    return ViewImages(depth, sensed_colour(colour_key, colour, camera))


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
    mask_fitter = InParts() if several else as_segmented
    return ImageRecogniser(ViewRecogniser.of(target, mask_fitter=mask_fitter), masks=True)


@functools.cache
def _alone(target: Target, detector: TargetColour, several: bool) -> ImageRecogniser:
    fitter = InParts(Connected(), joining=join_floating) if several else Explaining()
    core = ViewRecogniser.of(target, detector=detector, fitter=fitter)
    return ImageRecogniser(core, masks=False, target_colour=detector.rgb)
