"""Accuracy of the segmentation of depth images, on held-out scenes.

Images are labelled as in the planner's `full` mode: the cloud is sampled, segmented, cleaned up and spread over the
pixels. Segments are matched one to one with the objects that they overlap most; an object without a segment counts
as 0.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key
from matplotlib.figure import Figure

from mechsearch_jax.benchmarks.lab.parts.images import Look, Scene, check_images, image_of, image_settings
from mechsearch_jax.envs.camera.simulated_camera import is_found
from mechsearch_jax.envs.world.world import TARGET
from mechsearch_jax.images.cloud import shelf_view
from mechsearch_jax.networks.weights import Weights, shipped_weights
from mechsearch_jax.perception.assignment import assign
from mechsearch_jax.perception.segmentation import NetworkSegmenter
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.versions import versions
from mechsearch_jax.train.scenes import PIXELS
from mechsearch_jax.viz import drawing
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf


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
          shelf: may be traced.
          points: in the world [m]; NaN where nothing was measured.
          of_target: the target's pixels.
          masks: the true labels, whose numbers the labels have.
        """
        ...


def true_masks(key: Array, shelf: Shelf, points: Array, of_target: Array, masks: Array) -> Array:
    """The `Labeller` that returns the true labels."""
    return masks


@dataclasses.dataclass(frozen=True, eq=False)
class NamedSegments:
    """The `Labeller` that segments the image with a network, and numbers the segments after the true objects.

    Attributes:
      weights: of the segmentation network.
    """

    weights: Weights

    def __call__(self, key: Array, shelf: Shelf, points: Array, of_target: Array, masks: Array) -> Array:
        return numbered(NetworkSegmenter.of(self.weights)(key, shelf, points, of_target), masks)


def numbered(segments: Int[Array, "h w"], masks: Int[Array, "h w"]) -> Int[Array, "h w"]:
    """Segments, numbered 0 to 7, renumbered one to one after the true objects that they overlap most; none is lost."""
    slots = jnp.arange(TARGET)
    segmented = (segments.reshape(-1)[:, None] == slots[None]).astype(jnp.float32)
    truth = (masks.reshape(-1)[:, None] == slots[None]).astype(jnp.float32)
    # A segment without overlap still gets the slot of an object that no segment matches.
    name = assign(-jnp.matmul(segmented.T, truth))
    return jnp.where(segments >= 0, name[jnp.maximum(segments, 0)], segments).astype(jnp.int8)


# Colours of up to eight objects, distinguishable with red-green blindness.
_COLOURS = ("#4477aa", "#ee6677", "#228833", "#ccbb44", "#66ccee", "#aa3377", "#ee8866", "#8c8c8c")


@dataclasses.dataclass(frozen=True)
class SegmentRow:
    """The segmentation of one object.

    Attributes:
      source, scene, object: the object.
      objects: number of objects in the scene, seen or not.
      noise: name of the sensor.
      pixels, visible: as in `Look`.
      iou: intersection over union of its pixels with those of its segment.
    """

    source: str
    scene: str
    object: int
    objects: int
    noise: str
    pixels: int
    visible: float
    iou: float


@dataclasses.dataclass(frozen=True)
class MeasuredSegments:
    """Results of a run.

    Attributes:
      rows: one for every visible object of every image.
      seconds: for each image, the time to label it [s].
      compile_seconds: of the first call, minus the median of the others [s].
      settings: scenes, noises and seed.
      versions: as `versions` returns them.
    """

    rows: tuple[SegmentRow, ...]
    seconds: tuple[float, ...]
    compile_seconds: float
    settings: dict[str, Any]
    versions: dict[str, str]

    def summary(self) -> list[dict[str, Any]]:
        """Mean intersection over union by source, noise and number of objects in the scene (None: of all)."""
        lines = []
        for source, noise in dict.fromkeys((row.source, row.noise) for row in self.rows):
            group = [row for row in self.rows if (row.source, row.noise) == (source, noise)]
            for count in (*sorted({row.objects for row in group}), None):
                chosen = [row for row in group if count in (None, row.objects)]
                scored = [row.iou for row in chosen if row.pixels >= PIXELS]
                lines.append(
                    {
                        "source": source,
                        "noise": noise,
                        "objects": count,
                        "scenes": len({row.scene for row in chosen}),
                        "counted": len(scored),
                        "iou_mean": float(np.mean(scored)) if scored else None,
                        "missed": sum(iou < 0.5 for iou in scored),
                        "visible": len(chosen),
                        "iou_mean_visible": float(np.mean([row.iou for row in chosen])),
                    }
                )
        return lines

    def value(self) -> dict[str, Any]:
        """As JSON values, without the rows."""
        return {
            "settings": self.settings,
            "versions": self.versions,
            "median_seconds": statistics.median(self.seconds),
            "compile_seconds": self.compile_seconds,
            "summary": self.summary(),
        }


@dataclasses.dataclass(frozen=True, eq=False)
class SegmentationBench:
    """A measurement on scenes; it can repeat any part of a run.

    Attributes:
      scenes: to segment.
      noises: names of `images.NOISES`.
      seed: of the noise and of the sampled points.
      labeller: segments the images; the shipped network if None.
      shelf: of the scenes.
    """

    scenes: Sequence[Scene]
    noises: Sequence[str] = ("clean", "gaussian")
    seed: int = 0
    labeller: Labeller | None = None
    shelf: Shelf = dataclasses.field(default_factory=Shelf)

    def __post_init__(self):
        check_images("lab segmentation", self.scenes, self.noises)

    def run(self, on_progress: Callable[[int], None] = lambda done: None) -> MeasuredSegments:
        """Segment everything.

        Args:
          on_progress: called after every image with the number of images so far.

        Raises:
          InputError: the shipped weights are missing or damaged.
        """
        label = self._compiled()
        first = self._label(label, 0, self.noises[0])[2]
        rows: list[SegmentRow] = []
        seconds: list[float] = []
        for noise in self.noises:
            for index, scene in enumerate(self.scenes):
                image, labels, spent = self._label(label, index, noise)
                rows += _rows(scene, noise, image, labels)
                seconds.append(spent)
                on_progress(len(seconds))
        compiling = max(first - statistics.median(seconds), 0.0)
        settings = image_settings(self.scenes, self.noises, self.seed)
        return MeasuredSegments(tuple(rows), tuple(seconds), compiling, settings, versions())

    def images(self, choice: Sequence[tuple[int, str]]) -> list[tuple[Look, np.ndarray]]:
        """Images, chosen by a scene's index and a noise, with their segmentation."""
        label = self._compiled()
        return [self._label(label, index, noise)[:2] for index, noise in choice]

    def _compiled(self) -> Callable[..., Any]:
        labeller = self.labeller or NamedSegments(shipped_weights("segmentation"))

        def label(key, image, target_seen):
            labels = image.shown.labels
            of_target = (labels == TARGET) & target_seen
            return labeller(key, self.shelf, image.shown.points, of_target, labels)

        return jax.jit(label)

    def _label(self, label: Callable[..., Any], index: int, noise: str) -> tuple[Look, np.ndarray, float]:
        key, image = image_of(self.scenes, index, noise, self.seed, shelf_view(shelf=self.shelf), self.shelf)
        seen = jax.block_until_ready((image, is_found(Camera(), self.scenes[index].world)))[1]
        start = time.perf_counter()
        labels = jax.block_until_ready(label(key, image, seen))
        return image, np.asarray(labels), time.perf_counter() - start


def overlaps(labels: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Intersection over union of each object's pixels with those of the segment of its number; NaN if unseen."""
    objects = np.arange(TARGET)[:, None]
    segments, masks = labels.reshape(1, -1) == objects, truth.reshape(1, -1) == objects
    union = (segments | masks).sum(axis=1)
    return np.where(masks.any(axis=1), (segments & masks).sum(axis=1) / np.maximum(union, 1), np.nan)


def _rows(scene: Scene, noise: str, image: Look, labels: np.ndarray) -> list[SegmentRow]:
    iou = overlaps(labels, np.asarray(image.shown.labels))
    pixels, visible, valid = jax.device_get((image.pixels, image.visible, scene.world.valid[:TARGET]))
    return [
        SegmentRow(
            source=scene.source,
            scene=scene.name,
            object=int(i),
            objects=int(valid.sum()),
            noise=noise,
            pixels=int(pixels[i]),
            visible=round(float(visible[i]), 4),
            iou=round(float(iou[i]), 4),
        )
        for i in np.flatnonzero(valid & np.isfinite(iou))
    ]


def worst_figure(bench: SegmentationBench, rows: Sequence[SegmentRow], count: int) -> Figure:
    """The images with the least mean overlap of objects of at least 100 pixels: true masks beside segments.

    Raises:
      InputError: there are none, or the count is below 1.
    """
    shares: dict[tuple[str, str, str], list[float]] = {}
    for row in rows:
        if row.pixels >= PIXELS:
            shares.setdefault((row.source, row.scene, row.noise), []).append(row.iou)
    order = sorted(shares, key=lambda key: statistics.mean(shares[key]))[:count]
    if not order or count < 1:
        raise InputError("lab segmentation: there are no images to draw; count from 1")
    place = {(scene.source, scene.name): i for i, scene in enumerate(bench.scenes)}
    images = bench.images([(place[source, scene], noise) for source, scene, noise in order])
    columns = min(3, len(order))
    lines = -(-len(order) // columns)
    figure = Figure(figsize=(4.2 * columns, 4.1 * lines), layout="constrained")
    panels = figure.subfigures(lines, columns, squeeze=False).reshape(-1)
    for key, (image, segments), panel in zip(order, images, panels, strict=False):
        truth = np.asarray(image.shown.labels)
        panel.suptitle(
            f"{key[1]}, {key[2]}: mean IoU {statistics.mean(shares[key]):.2f}", fontsize=9, color=drawing.INK
        )
        for axes, labels, name in zip(panel.subplots(2, 1), (truth, segments), ("true", "found"), strict=True):
            _draw(axes, np.asarray(image.shown.depth), labels)
            axes.set_ylabel(name, fontsize=8, color=drawing.MUTED)
    return figure


def _draw(axes: Any, depth: np.ndarray, labels: np.ndarray) -> None:
    near = np.where(np.isfinite(depth), depth, np.nan)
    axes.imshow(near, cmap="gray", interpolation="nearest")
    tint = np.zeros((*labels.shape, 4))
    for i, colour in enumerate(_COLOURS):
        tint[labels == i] = (*drawing.rgb(colour), 0.75)
    axes.imshow(tint, interpolation="nearest")
    axes.set_xticks([])
    axes.set_yticks([])
