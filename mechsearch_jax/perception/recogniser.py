"""From a camera's images to an observation: the entry point of perception.

Depth image -> points of the shelf's part of it -> labels (a given mask, or the segmentation network) -> superquadrics
(recognition network, refinement on the depth image) and the target's pose -> `Observation`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from mechsearch_jax.images.checks import check_images
from mechsearch_jax.images.cloud import MARGIN, OVERHANG, View, above_board, thinned_view
from mechsearch_jax.images.colour import TargetColour
from mechsearch_jax.images.detection import ColouredDepth, coloured_pixels, detect, no_detection
from mechsearch_jax.images.labels import CAPACITY, FREE, MISSING, OTHER, check_capacity
from mechsearch_jax.images.measured import measured_share
from mechsearch_jax.images.trained_view import TrainedView
from mechsearch_jax.observation import Observation
from mechsearch_jax.perception.edges import on_own_surfaces
from mechsearch_jax.perception.explanation import Explaining, Fitted, Fitter, as_segmented
from mechsearch_jax.perception.fusion import fused
from mechsearch_jax.perception.recognition import LabelledImage, ShapeNetwork
from mechsearch_jax.perception.refinement import RefinementConfig
from mechsearch_jax.perception.segmentation import NetworkSegmenter, Segmenter
from mechsearch_jax.runtime.compiled import cached_jit
from mechsearch_jax.runtime.own_settings import in_own_settings, own_settings
from mechsearch_jax.runtime.pytree import PyTreeNode, static
from mechsearch_jax.workspace.camera import Camera, back_project, measured
from mechsearch_jax.workspace.detector import SAMPLED, found_pixels
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.sight import check_camera
from mechsearch_jax.workspace.target import Target

if TYPE_CHECKING:
    from mechsearch_jax.networks.weights import Weights

# Gives the target's pixels, bool (h, w), of an image of red, green and blue in 0 to 1, shape (h, w, 3).
TargetDetector = Callable[[Array], Array]


class Setting(Protocol):
    """What a recogniser needs of a problem; `Problem` fulfils it."""

    @property
    def camera(self) -> Camera: ...

    @property
    def shelf(self) -> Shelf: ...

    @property
    def target(self) -> Target: ...


class ViewImages(NamedTuple):
    """The images of a `View`, as a recogniser reads them.

    Attributes:
      depth: along the camera's axis [m], shape (h, w); NaN where nothing was measured, infinite where there is nothing.
      colour: red, green and blue in 0 to 1, shape (h, w, 3); None without a colour image.
      mask: the number of the object that a pixel shows, or a label of `images.labels`, shape (h, w); None without one.
      target_id: the target's number in the mask, negative if it does not show it; None if only its colour tells.
    """

    depth: Any
    colour: Any = None
    mask: Any = None
    target_id: Any = None


class ViewRecogniser(PyTreeNode):
    """Recognises what the images of a view show: the part of recognition that robots and simulated cameras share.

    A pytree, whose leaves are the networks' weights.

    Attributes:
      segmenter: labels images without a mask.
      shapes: the recognition network.
      detector: finds the target's pixels in a colour image.
      target: whose pose is fitted; static, as all that follows.
      refinement: how the network's shapes are fitted to the depth image.
      fitter: fits objects to the segments of images without a mask.
      mask_fitter: fits objects to the segments of a mask.
      capacity: number of slots for objects.
    """

    segmenter: Segmenter
    shapes: ShapeNetwork
    detector: TargetDetector
    target: Target = static()
    refinement: RefinementConfig = static(default_factory=RefinementConfig)
    fitter: Fitter = static(default_factory=Explaining)
    mask_fitter: Fitter = static(default=as_segmented)
    capacity: int = static(default=CAPACITY)

    @classmethod
    def of(
        cls,
        target: Target,
        *,
        segmenter: Segmenter | None = None,
        weights: Weights | None = None,
        detector: TargetDetector | None = None,
        refinement: RefinementConfig | None = None,
        fitter: Fitter | None = None,
        mask_fitter: Fitter | None = None,
        capacity: int = CAPACITY,
    ) -> ViewRecogniser:
        """The recogniser of a target; see `Recogniser` for the defaults.

        Raises:
          InputError: weights are missing, damaged or of another network, or the capacity is impossible.
        """
        check_capacity(capacity)
        return cls(
            _as_pytree(segmenter or NetworkSegmenter.of(capacity=capacity)),
            ShapeNetwork.of(weights),
            _as_pytree(detector or TargetColour.lit()),
            target,
            refinement or RefinementConfig(),
            fitter or Explaining(),
            mask_fitter or as_segmented,
            capacity,
        )

    def __call__(
        self, camera: Camera, view: View, shelf: Shelf, images: ViewImages, before: Observation | None = None
    ) -> Observation:
        """The observation of the images of a view; the same images always give the same observation.

        Args:
          camera: of the full image.
          view: the rays of it that the images have.
          shelf: in the images.
          images: of the view.
          before: an earlier look, its objects where they are expected now: what it shows better is kept, see `fusion`.
            Objects with parts are not.
        """
        fitted, visible = self.fitted(camera, view, shelf, images, before)
        share = measured_share(camera, view, images.depth)
        return Observation(fitted.objects, visible, fitted.target_pose, fitted.confidence, share)

    def fitted(
        self, camera: Camera, view: View, shelf: Shelf, images: ViewImages, before: Observation | None = None
    ) -> tuple[Fitted, Bool[Array, ""]]:
        """What was made of the images, with the pixels of each object, and whether the target is visible.

        Args:
          camera, view, shelf, images, before: as above.
        """
        # Not of the caller's key, lest an object be seen or not by chance.
        keys = jax.random.split(jax.random.key(0), 3)
        image, visible = labelled(self, keys[0], camera, view, shelf, images)
        fitter = self.fitter if images.mask is None else self.mask_fitter
        settings = (self.shapes, view.camera, shelf, self.target, self.refinement)
        fitted = fitter(keys[1:], image, *settings, least=SAMPLED * _threshold(camera, view))
        if before is not None and before.objects.parts is None and fitted.objects.parts is None:
            fitted = fused(keys[1], fitted, before, image, visible, view.camera, shelf, self.target)
        return fitted, visible


@jax.tree_util.register_pytree_node_class
@dataclasses.dataclass(frozen=True, eq=False, init=False)
class Recogniser:
    """Recognises the objects' shapes and poses in a camera's images, and the target if it is visible.

    A callable `(key, depth, colour=None, mask=None, target_id=None) -> Observation` for `jit` and `vmap`, and a pytree,
    so that it can be an argument of either. Its leaves are the networks' weights and the poses of camera and shelf; all
    else is static. Construct it outside of both, since camera and shelf decide the shapes of arrays.

    The image is thinned to about the density of the networks' training, 400 pixels per metre at the middle of the
    board, and cut to the part in which the shelf's space appears.

    Attributes:
      core: recognises what the view shows.
      camera: of the images; depth and colour are registered to it.
      view: the part of the images that is used.
      shelf: in the view.
    """

    core: ViewRecogniser
    camera: Camera
    view: View
    shelf: Shelf

    def __init__(
        self,
        problem: Setting,
        *,
        camera: Camera | None = None,
        segmenter: Segmenter | None = None,
        weights: Weights | None = None,
        detector: TargetDetector | None = None,
        refinement: RefinementConfig | None = None,
        fitter: Fitter | None = None,
        mask_fitter: Fitter | None = None,
        capacity: int = CAPACITY,
    ):
        """Set up recognition for a problem.

        Args:
          problem: gives camera, shelf and target.
          camera: instead of the problem's, such as one whose pose `real_camera.prepare` corrected.
          segmenter: by default the `NetworkSegmenter` with the package's weights.
          weights: of the recognition network; by default the package's.
          detector: by default for a red target in any light, `TargetColour.lit()`.
          refinement: the default if None.
          fitter: by default `Explaining()`, which splits, joins and drops segments where that explains the image
            better; `as_segmented` keeps the segmenter's. With `InParts(Connected(), joining=join_floating)`
            of `parts.in_parts`, `parts.segments` and `parts.joining` objects are bodies of up to four parts.
          mask_fitter: by default `as_segmented`, which keeps the mask's segments, as `parts.in_parts.InParts()` does.
          capacity: number of objects that an observation can hold, 1 to 16. A planner's programs, time and memory grow
            with it.

        Raises:
          InputError: the camera does not see the shelf, weights are missing, damaged or of another network, or the
            capacity is impossible.
        """
        camera = camera or problem.camera
        check_camera(camera, problem.shelf)
        # The decorator would take this for a finished pytree.
        with own_settings():
            core = ViewRecogniser.of(
                problem.target,
                segmenter=segmenter,
                weights=weights,
                detector=detector,
                refinement=refinement,
                fitter=fitter,
                mask_fitter=mask_fitter,
                capacity=capacity,
            )
            self._set(core, camera, thinned_view(camera, problem.shelf), problem.shelf)

    def _set(self, *values: Any) -> None:
        for field, value in zip(dataclasses.fields(Recogniser), values, strict=True):
            object.__setattr__(self, field.name, value)

    def tree_flatten(self) -> tuple[tuple[Any, ...], None]:
        return (self.core, self.camera, self.view, self.shelf), None

    @classmethod
    def tree_unflatten(cls, static: None, leaves: tuple[Any, ...]) -> Recogniser:
        made = object.__new__(cls)
        made._set(*leaves)
        return made

    @property
    def trained(self) -> dict[str, TrainedView]:
        """Camera and shelf in the training of the networks, by the networks' names, if their cards record them."""
        views = {"recognition": self.core.shapes.view}
        if isinstance(self.core.segmenter, NetworkSegmenter):
            views["segmentation"] = self.core.segmenter.view
        return {name: view for name, view in views.items() if view is not None}

    @in_own_settings
    def __call__(
        self,
        key: Key[Array, ""],
        depth: Any,
        colour: Any = None,
        mask: Any = None,
        target_id: Any = None,
    ) -> Observation:
        """Recognise the objects and the target in images.

        The target is identified by its colour, or by `target_id` in the mask; with depth alone `target_visible` is
        False. It is visible with more than 100 pixels at 1280 x 720, or the same share of other images, in the shelf's
        space and with a measured depth.

        With a mask, slot i of the objects is instance i; if the target is one of the instances, the one whose number
        is the capacity takes its slot. Without a mask, the order of the slots is arbitrary.

        Args:
          key: for recognisers that draw at random, which are called alike; the same images give the same observation
            with every key.
          depth: float (H, W), metres along the camera's z; 0, NaN or 65.535 where nothing was measured, infinite where
            there is nothing for at least 3 m.
          colour: (H, W, 3), floats in 0 to 1 or uint8, registered to the depth image.
          mask: integers (H, W), registered to the depth image: for each pixel the number of its object, 0 to the
            capacity, or OTHER (-1), FREE (-2) or MISSING (-3) of `images.labels`. Points on the shelf's faces always
            count as FREE.
          target_id: the target's number in the mask; negative if the mask does not show it.

        Returns:
          The observation, with as many slots for objects as the capacity says.

        Raises:
          InputError: an image has the wrong shape, type or unit. Values are checked outside `jit` only.
        """
        check_images(self.camera, depth, colour, mask, target_id, self.core.capacity)
        return self.unchecked(key, depth, colour, mask, target_id)

    @in_own_settings
    def unchecked(
        self,
        key: Key[Array, ""],
        depth: Any,
        colour: Any = None,
        mask: Any = None,
        target_id: Any = None,
        before: Observation | None = None,
    ) -> Observation:
        """The same of images that `check_images` was called with before; `before` as of `ViewRecogniser`."""
        images = view_images(self.view, depth, colour, mask, target_id)
        return self.core(self.camera, self.view, self.shelf, images, before)

    @in_own_settings
    def fitted(
        self, key: Key[Array, ""], depth: Any, colour: Any = None, mask: Any = None, target_id: Any = None
    ) -> tuple[Fitted, Bool[Array, ""]]:
        """`ViewRecogniser.fitted` of a camera's images, which are not checked."""
        images = view_images(self.view, depth, colour, mask, target_id)
        return self.core.fitted(self.camera, self.view, self.shelf, images)


def _as_pytree(slot: Any) -> Any:
    """A callable as a pytree: unchanged if it is one, else, such as a function, without leaves."""
    return jax.tree_util.Partial(slot) if jax.tree_util.all_leaves([slot]) else slot


@cached_jit()
def view_images(view: View, depth: Any, colour: Any, mask: Any, target_id: Any) -> ViewImages:
    """The view's part of a camera's images, which are as of `Recogniser`."""
    seen = view.of(jnp.asarray(depth, jnp.float32))
    if colour is not None:
        colour = view.of(jnp.asarray(colour))
        colour = colour.astype(jnp.float32) / (255.0 if colour.dtype == jnp.uint8 else 1.0)
    mask = None if mask is None else view.of(jnp.asarray(mask))
    target_id = None if target_id is None else jnp.asarray(target_id, jnp.int32)
    return ViewImages(jnp.where(measured(seen), seen, jnp.nan), colour, mask, target_id)


def _threshold(camera: Camera, view: View) -> float | Array:
    """A target of at most this many pixels of a view is not visible."""
    return found_pixels(camera) / view.stride**2


@cached_jit()
def labelled(
    core: ViewRecogniser, key: Key[Array, ""], camera: Camera, view: View, shelf: Shelf, images: ViewImages
) -> tuple[LabelledImage, Bool[Array, ""]]:
    """The images of a view with labels, and whether the target is visible in them.

    Args:
      core: labels them.
      key: of the points that are drawn from the image.
      camera, view, shelf, images: as of `ViewRecogniser`.
    """
    seen, colour, mask, target_id = images
    # A simulated camera may see what is beyond the image.
    seen = jnp.where(view.is_inside(camera), seen, jnp.nan)
    points = back_project(view.camera, seen)

    # Points on the board's faces may be the target's.
    near = above_board(shelf, points, -MARGIN)
    threshold = _threshold(camera, view)
    if mask is None:
        detection = no_detection(seen)
        if colour is not None:
            image = ColouredDepth(points, seen, colour)
            detection = detect(key, core.detector, core.target, shelf, view.camera, image, threshold)
        visible, of_target = detection.visible, detection.pixels
        # As objects, small segments would rule out the pose of a target that is not detected.
        segments = core.segmenter(key, shelf, points, of_target | detection.unclear)
        labels = large_segments(segments, SAMPLED * threshold, core.capacity)
    else:
        instances = _instances(mask, core.capacity)
        instances = on_own_surfaces(points, instances, above_board(shelf, points), core.capacity)
        # The mask says what is one thing, so its colour alone tells the target from the others.
        coloured = jnp.zeros(seen.shape, bool)
        if colour is not None:
            coloured = coloured_pixels(core.detector, colour, seen) & near
        of_target, freed = _target_in(instances, coloured, target_id, core.capacity)
        of_target &= near
        labels = _labels(instances, freed, shelf, points, core.capacity)
        labels = jnp.where(of_target & (labels != MISSING) & (labels != FREE), OTHER, labels)
        visible = (jnp.sum(of_target) > threshold).astype(bool)
    image = LabelledImage(points, seen, labels, of_target & above_board(shelf, points) & visible, core.capacity)
    return image, visible


def large_segments(labels: Int[Array, "h w"], pixels: float | Array, capacity: int = CAPACITY) -> Int[Array, "h w"]:
    """Labels with segments, numbered from 0, of at most `pixels` pixels set to OTHER."""
    small = jnp.sum(labels.reshape(-1)[:, None] == jnp.arange(capacity + 1)[None], axis=0) <= pixels
    return jnp.where((labels >= 0) & small[labels], OTHER, labels).astype(jnp.int8)


def _instances(mask: Int[Array, "h w"], capacity: int) -> Int[Array, "h w"]:
    """The mask as labels of `images.labels`, int8; other numbers become OTHER."""
    is_label = (mask >= MISSING) & (mask <= capacity)
    return jnp.where(is_label, mask, OTHER).astype(jnp.int8)


def _target_in(
    instances: Int[Array, "h w"], coloured: Bool[Array, "h w"], target_id: Any, capacity: int
) -> tuple[Bool[Array, "h w"], Int[Array, ""]]:
    """The target's pixels in a mask, and its instance's number, or the last number if it is not an instance."""
    numbers = jnp.arange(capacity + 1)
    member = instances[..., None] == numbers.reshape(1, 1, -1)
    if target_id is not None:
        is_target = numbers == target_id
        rest = jnp.zeros(instances.shape, bool)
    else:
        # An instance is the target if most of it has the target's colour.
        in_colour = jnp.sum(member & coloured[..., None], axis=(0, 1))
        is_target = 2 * in_colour > jnp.sum(member, axis=(0, 1))
        rest = coloured & (instances == OTHER)
    of_target = jnp.any(member & is_target.reshape(1, 1, -1), axis=-1) | rest
    return of_target, jnp.where(jnp.any(is_target), jnp.argmax(is_target), capacity).astype(jnp.int8)


def _labels(
    instances: Int[Array, "h w"], freed: Int[Array, ""], shelf: Shelf, points: Float[Array, "h w 3"], capacity: int
) -> Int[Array, "h w"]:
    """The labels of an image with a mask: the objects' slots; the rest by the places of the points.

    Args:
      instances: of the mask.
      freed: the target's number, which the last instance takes.
      shelf: in the image.
      points: in the world [m].
      capacity: the last instance's number.
    """
    body = jnp.where(instances == freed, OTHER, jnp.where(instances == capacity, freed, instances))
    # Something in front of the shelf, such as the robot, hides what is behind it.
    before = (points[..., 0] <= shelf.front - OVERHANG) & (points[..., 2] > shelf.board) & (instances != FREE)
    labels = jnp.where(above_board(shelf, points), body, jnp.where(before, OTHER, FREE))
    missing = ~jnp.isfinite(points).all(axis=-1) | (instances == MISSING)
    return jnp.where(missing, MISSING, labels).astype(jnp.int8)
