"""One look into the shelf: its images, and what the checks of them share, computed once."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from mechsearch_jax.images.cloud import BLOCK, View, above_board, shelf_view, thinned_view
from mechsearch_jax.images.target_pixels import coloured_pixels
from mechsearch_jax.workspace.camera import Camera, back_project, measured
from mechsearch_jax.workspace.shelf import Shelf


@dataclasses.dataclass(frozen=True, eq=False)
class Look:
    """The images of one look, on the host.

    Attributes:
      camera, shelf: of the images; the camera sees the shelf.
      depth, colour, mask: as of a `Recogniser`.
      detector: gives the target's pixels of a colour image; None if it is not told by its colour.
    """

    camera: Camera
    shelf: Shelf
    depth: Float[np.ndarray, "h w"]
    colour: np.ndarray | None = None
    mask: Int[np.ndarray, "h w"] | None = None
    detector: Callable[[jax.Array], Any] | None = None

    @functools.cached_property
    def whole(self) -> Part:
        """Every pixel that may show the shelf."""
        return Part(self, shelf_view(self.camera, self.shelf, 1, BLOCK))

    @functools.cached_property
    def thinned(self) -> Part:
        """The pixels that recognition uses."""
        return Part(self, thinned_view(self.camera, self.shelf))


@dataclasses.dataclass(frozen=True, eq=False)
class Part:
    """What a view shows of a look; only with a colour image and a detector it has pixels of the target's colour."""

    look: Look
    view: View

    def of(self, image: np.ndarray) -> np.ndarray:
        """The view's pixels of a full image."""
        camera, stride = self.view.camera, self.view.stride
        part = image[self.view.row :: stride, self.view.column :: stride]
        return part[: camera.height, : camera.width]

    @functools.cached_property
    def depth(self) -> Float[np.ndarray, "h w"]:
        """Depth [m]; NaN where nothing was measured."""
        part = self.of(self.look.depth).astype(np.float32)
        return np.where(measured(part), part, np.float32(np.nan))

    @functools.cached_property
    def points(self) -> Float[np.ndarray, "h w 3"]:
        """In the world [m]; NaN without a finite depth."""
        return np.asarray(back_project(self.view.camera, jnp.asarray(self.depth)))

    @functools.cached_property
    def above_board(self) -> Bool[np.ndarray, "h w"]:
        """Which pixels show something in the shelf's free space."""
        return np.asarray(above_board(self.look.shelf, jnp.asarray(self.points)))

    @functools.cached_property
    def colour(self) -> Float[np.ndarray, "h w 3"]:
        """Red, green and blue in 0 to 1."""
        part = self.of(np.asarray(self.look.colour))
        return part.astype(np.float32) / np.float32(255.0 if part.dtype == np.uint8 else 1.0)

    @functools.cached_property
    def detected(self) -> Bool[np.ndarray, "h w"]:
        """The pixels of the target's colour, each judged alone."""
        return self.judged(self.colour)

    def judged(self, colour: Float[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
        """Those of another colour image of the view."""
        assert self.look.detector is not None
        return np.asarray(self.look.detector(jnp.asarray(colour)))

    def elected(self, colour: Float[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
        """Those in the shelf's free space by a vote among neighbours, which is slow."""
        assert self.look.detector is not None
        chosen = coloured_pixels(self.look.detector, jnp.asarray(colour), jnp.asarray(self.depth))
        return np.asarray(chosen) & self.above_board
