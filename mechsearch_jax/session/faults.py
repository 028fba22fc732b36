"""Warnings of a step: about images that do not fit the workcell, what is recognised in them, and the belief."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from mechsearch_jax.belief.belief import Belief
from mechsearch_jax.calibration.check import placement_faults
from mechsearch_jax.calibration.limits import CalibrationLimits
from mechsearch_jax.images.trained_view import view_faults
from mechsearch_jax.observation import Observation
from mechsearch_jax.perception.doubt import lost_faults
from mechsearch_jax.perception.edges import edge_faults, mask_faults
from mechsearch_jax.perception.overlaps import overlap_faults
from mechsearch_jax.perception.plausibility import (
    check_measured,
    colour_faults,
    detection_faults,
    identity_faults,
    image_faults,
    sight_faults,
)
from mechsearch_jax.perception.recogniser import Recogniser, Setting, check_images
from mechsearch_jax.problem.workcell import Workcell
from mechsearch_jax.session.images import Images
from mechsearch_jax.workspace.sight import camera_faults


def view_warnings(workcell: Workcell, recogniser: Any) -> tuple[str, ...]:
    """Warnings about the camera's pose and its distance from the views that the networks were trained on."""
    faults = camera_faults(workcell.camera, workcell.shelf)
    # Another recogniser may have other networks, or none.
    if faults or not isinstance(recogniser, Recogniser):
        return faults
    return view_faults(recogniser.camera, recogniser.shelf, recogniser.trained)


def placement_warnings(setting: Setting, calibration: CalibrationLimits, depth: np.ndarray) -> tuple[str, ...]:
    """Warnings about where the shelf is in a depth image; they need no recogniser.

    Args:
      setting: gives camera and shelf, such as a problem.
      calibration: how far the shelf may be from its place.
      depth: as of `Searcher.next`.

    Raises:
      InputError: the image cannot be used.
    """
    check_images(setting.camera, depth)
    check_measured(setting.camera, setting.shelf, depth)
    return placement_faults(setting.camera, setting.shelf, depth, calibration)


def image_warnings(setting: Setting, recogniser: Any, images: Images, observation: Observation) -> list[str]:
    """Warnings about images that do not fit camera, shelf and target; the observation is of them."""
    camera, shelf, depth, target_id = setting.camera, setting.shelf, images.depth, images.target_id
    mask, colour = (None if image is None else np.asarray(image) for image in (images.mask, images.colour))
    faults = list(image_faults(camera, shelf, depth, mask))
    faults += [*edge_faults(camera, shelf, depth, colour), *mask_faults(camera, shelf, depth, mask)]
    # Another recogniser may identify the target in another way, and know of things that the images do not show.
    if isinstance(recogniser, Recogniser):
        faults += lost_faults(setting, observation, depth)
        faults += identity_faults(colour, mask, target_id)
        if colour is not None and target_id is None:
            detector = recogniser.detector
            faults += colour_faults(camera, shelf, setting.target, detector, depth, colour)
            if mask is None:
                faults += detection_faults(camera, shelf, detector, depth, colour, observation)
    return faults


def recognition_warnings(setting: Setting, depth: np.ndarray, observation: Observation) -> list[str]:
    """Warnings about what is recognised: nothing, too much, or objects in each other."""
    unseen = sight_faults(setting.camera, setting.shelf, depth, observation)
    return [*unseen, *_crowd_warnings(observation), *overlap_faults(setting, observation)]


def belief_warnings(before: Belief, after: Belief, shelf_is_empty: bool) -> list[str]:
    """Warnings about what a look made of the belief; on an empty shelf f becomes empty, and nothing is wrong."""
    faults = []
    if int(after.restarts) > int(before.restarts) and not shelf_is_empty:
        faults.append("f became empty and was started anew: something moved that was not seen, or a shape is wrong")
    if bool(before.found) and not bool(after.found):
        faults.append("the target is not where it was found any more: it is searched for anew")
    return faults


def _crowd_warnings(observation: Observation) -> list[str]:
    slots = observation.objects.capacity
    if not bool(jnp.all(observation.objects.valid)):
        return []
    return [f"recognition: all {slots} slots are taken; objects beyond the largest {slots} are not seen"]
