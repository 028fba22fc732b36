"""What the options of rows say in few words: a preset, and what differs from it."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from mechsearch_jax.config.fixed import without_fixed
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.planner import PRESETS

# The defaults before a found target was grasped from within 75 degrees, before boxes were grasped from the side, and
# before that looked one action ahead.
WITHIN_45 = "standard with retrievals within 45°"
FROM_THE_FRONT = "standard until 2026-11-28"
THREE_AHEAD = "standard until 2026-11-26"
_RETRIEVALS_WITHIN_45 = {
    "retrieval_max_yaw": math.radians(45),
    "retrieval_tilts": list(map(math.radians, (20.0, 22.5, 25.0, 27.5, 30.0))),
}
_FRONT_GRASPS = {
    "object_grasp_max_yaw": math.radians(45),
    "object_grasp_tilts": list(map(math.radians, (20.0, 30.0))),
    **_RETRIEVALS_WITHIN_45,
}
# What preset `standard` was before, the latest first: by the name that it has since in stored results, the options that
# were other than today's, some of which are none any more.
FORMER_STANDARDS: Mapping[str, Mapping[str, Any]] = {
    WITHIN_45: _RETRIEVALS_WITHIN_45,
    FROM_THE_FRONT: _FRONT_GRASPS,
    THREE_AHEAD: {"horizon": 3, "sequences": 30, "move_target": True, "erosion": 0.001, **_FRONT_GRASPS},
}
# Options that no preset decides.
_NOT_OF_PRESETS = frozenset(("simulator", "target", "seed"))


class Settings(NamedTuple):
    """The settings of a variant.

    Attributes:
      preset: the preset that differs from them in the fewest options, or one of `FORMER_STANDARDS`.
      differing: what is not as in that preset, with search-for-grasp and true shapes; None is the
        value of an option that the variant does not have.
    """

    preset: str
    differing: Mapping[str, Any]


@functools.cache
def _preset_options(name: str) -> Mapping[str, Any]:
    if name in FORMER_STANDARDS:
        return {**Method().options(), **FORMER_STANDARDS[name]}
    return Method(config=PRESETS[name]()).options()


def settings_of(options: Mapping[str, Any]) -> Settings:
    """The settings of a row's options, as `store.rows.options_of` has them.

    An option that the row does not have is of a later version, and is taken to be as in the preset.
    """
    options, names = without_fixed(options), (*PRESETS, *FORMER_STANDARDS)
    candidates = [Settings(name, _differing(options, _preset_options(name))) for name in names]
    return min(candidates, key=lambda settings: len(settings.differing))


def _differing(options: Mapping[str, Any], preset: Mapping[str, Any]) -> dict[str, Any]:
    given = {name: value for name, value in options.items() if name not in _NOT_OF_PRESETS}
    # Settings without a name of their own are left out where they are as usual.
    unusual = {name: None for name in preset if "." in name and name not in given}
    return {name: value for name, value in given.items() if name not in preset or preset[name] != value} | unusual
