"""Warnings of a step: about images that do not fit the workcell, what is recognised in them, and the belief."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from mechsearch_jax.belief.belief import Belief
from mechsearch_jax.calibration.check import placement_faults
from mechsearch_jax.calibration.limits import CalibrationLimits
from mechsearch_jax.geometry.superquadric import ROUND_EXPONENT
from mechsearch_jax.images.checks import Look, check_images, hole_faults, unmeasured_target_faults
from mechsearch_jax.images.labels import CAPACITY, more_room
from mechsearch_jax.images.trained_view import view_faults
from mechsearch_jax.observation import Observation
from mechsearch_jax.perception.doubt import lost_faults
from mechsearch_jax.perception.edges import edge_faults, mask_faults
from mechsearch_jax.perception.overlaps import overlap_faults
from mechsearch_jax.perception.plausibility import (
    colour_faults,
    detection_faults,
    identity_faults,
    image_faults,
    shows_nothing,
    yaw_faults,
)
from mechsearch_jax.perception.recogniser import Recogniser, Setting
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.session.images import Images
from mechsearch_jax.workspace.sight import camera_faults


def view_warnings(workcell: Setting, recogniser: Any) -> tuple[str, ...]:
    """Warnings about the camera's pose and its distance from the views that the networks were trained on."""
    faults = camera_faults(workcell.camera, workcell.shelf)
    # Another recogniser may have other networks, or none.
    if faults or not isinstance(recogniser, Recogniser):
        return faults
    return view_faults(recogniser.camera, recogniser.shelf, recogniser.trained)


def check_image(
    setting: Setting, calibration: CalibrationLimits, images: Images, recogniser: Any = None
) -> tuple[Look, list[str]]:
    """Check the images of one look before anything is recognised in them.

    Args:
      setting: gives camera, shelf and target, such as a problem.
      calibration: how far the shelf may be from its place.
      images: as `images.converted` gives them.
      recogniser: that will be called with them; if it is no `Recogniser`, or None, how it identifies the target is not
        checked.

    Returns:
      The look, for `recognition_warnings`, and warnings about images that do not fit camera, shelf and target.

    Raises:
      InputError: an image cannot be used, or the shelf is too far from where it should be.
    """
    capacity = recogniser.core.capacity if isinstance(recogniser, Recogniser) else CAPACITY
    check_images(setting.camera, *images, capacity=capacity)
    detector = recogniser.core.detector if isinstance(recogniser, Recogniser) and images.target_id is None else None
    look = Look(setting.camera, setting.shelf, images.depth, images.colour, images.mask, detector)
    faults = image_warnings(setting, recogniser, look, images.target_id)
    return look, [*placement_faults(setting.camera, setting.shelf, images.depth, calibration), *faults]


def image_warnings(setting: Setting, recogniser: Any, look: Look, target_id: int | None) -> list[str]:
    """Warnings about images that do not fit camera, shelf and target, beside the place of the shelf."""
    faults = [*image_faults(look), *hole_faults(look)]
    faults += edge_faults(look.camera, look.shelf, look.depth, look.colour)
    faults += mask_faults(look.camera, look.shelf, look.depth, look.mask)
    # Another recogniser may identify the target in another way.
    if isinstance(recogniser, Recogniser):
        faults += identity_faults(look, target_id)
    if look.detector is not None and look.colour is not None:
        faults += colour_faults(look, setting.target)
    return faults


def checked(observation: Observation) -> Observation:
    """What a recogniser returned, as the rest of the library reads it.

    Raises:
      InputError: an object is no superquadric.
    """
    objects = observation.objects
    levels = (objects,) if objects.parts is None else (objects, objects.parts)
    for level in levels:
        size, exponents, valid = (np.asarray(a) for a in (level.size, level.exponents, level.valid))
        wrong = ~((size > 0) & np.isfinite(size)).all(axis=-1) | ~((exponents > 0) & (exponents <= 2)).all(axis=-1)
        if (wrong & valid).any():
            where = np.argwhere(wrong & valid)[0]
            raise InputError(
                f"recogniser: object {where[0]} has half-extents {size[tuple(where)].tolist()} and exponents "
                f"{exponents[tuple(where)].tolist()}; the former must be positive, the latter above 0 and at most 2"
            )
    return observation.with_boxes()


def shape_warnings(observation: Observation) -> list[str]:
    """Warnings about objects that are neither boxes nor round: plans take them for the latter."""
    faults = []
    for i in np.flatnonzero(np.asarray(observation.objects.valid)):
        e1, e2 = np.asarray(observation.objects.exponents[i], float)
        if max(e1, e2) > 2.0 - ROUND_EXPONENT:
            faults.append(
                f"object {i}: exponents {e1:.2f} and {e2:.2f} are of a body that comes to a point or a ridge; it is "
                "planned as the box or the round body around it, so look whether the recogniser's fit is right"
            )
    return faults


def recognition_warnings(setting: Setting, look: Look, observation: Observation, recogniser: Any = None) -> list[str]:
    """Warnings about what is recognised: not the target, not all, too much, odd shapes, or objects in each other."""
    other: list[str] = []
    if look.detector is not None and look.colour is not None:
        other += unmeasured_target_faults(look, observation)
        other += yaw_faults(look, observation, setting.target)
        if look.mask is None:
            other += detection_faults(look, observation)
    # Another recogniser may know of things that the images do not show.
    if isinstance(recogniser, Recogniser) and not shows_nothing(observation):
        lost = lost_faults(setting, observation, look.depth)
        other += [*lost, *(_crowd_warnings(observation) if lost else ())]
    return [*other, *shape_warnings(observation), *overlap_faults(setting, observation)]


def belief_warnings(before: Belief, after: Belief, shelf_is_empty: bool) -> list[str]:
    """Warnings about what a look made of the belief; on an empty shelf f becomes empty, and nothing is wrong."""
    faults = []
    if int(after.restarts) > int(before.restarts) and not shelf_is_empty:
        faults.append(
            "f became empty: what is hidden or was not measured is open again; something moved that was not seen, or a "
            "shape is wrong"
        )
    if bool(before.found) and not bool(after.found):
        faults.append("the target is not where it was found any more: it is searched for anew")
    return faults


def _crowd_warnings(observation: Observation) -> list[str]:
    slots = observation.objects.capacity
    if not bool(jnp.all(observation.objects.valid)):
        return []
    return [
        f"recognition: all {slots} slots are taken, so that nothing else can be an object; see what lies on none"
        f"{more_room(slots)}"
    ]
