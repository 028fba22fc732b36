"""What the options of rows say in few words: the nearest preset, and what differs from it."""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping
from typing import Any, NamedTuple

from mechsearch_jax.config.fixed import without_fixed
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.planner import PRESETS

# Options that no preset decides.
_NOT_OF_PRESETS = frozenset(("simulator", "target", "seed"))


class Settings(NamedTuple):
    """The settings of a variant.

    Attributes:
      preset: the preset that differs from them in the fewest options.
      differing: what is not as in that preset, with search-for-grasp and true shapes; None is the
        value of an option that the variant does not have.
    """

    preset: str
    differing: Mapping[str, Any]


@functools.cache
def _preset_options(name: str) -> Mapping[str, Any]:
    return Method(config=PRESETS[name]()).options()


def settings_of(options: Mapping[str, Any]) -> Settings:
    """The settings of a row's options, as `store.rows.options_of` has them.

    An option that the row does not have is of a later version, and is taken to be as in the preset.
    """
    options = without_fixed(options)
    candidates = [Settings(name, _differing(options, _preset_options(name))) for name in PRESETS]
    return min(candidates, key=lambda settings: len(settings.differing))


def _differing(options: Mapping[str, Any], preset: Mapping[str, Any]) -> dict[str, Any]:
    given = {name: value for name, value in options.items() if name not in _NOT_OF_PRESETS}
    # Settings without a name of their own are left out where they are as usual.
    unusual = {name: None for name in preset if "." in name and name not in given}
    return {name: value for name, value in given.items() if name not in preset or preset[name] != value} | unusual


# Options beside those of presets, with their usual values; and those whose values say what they are of.
USUAL: Mapping[str, Any] = {
    "policy": "search-for-grasp",
    "recognition": "oracle",
    "target": "cylinder",
}
PLAIN = ("policy", "recognition", "target")
# A name that is longer fits into no table.
LONGEST_NAME = 40


class PresetName(NamedTuple):
    """What a variant is called.

    Attributes:
      preset: the one with the fewest options that deviate.
      deviations: these options in words, a comma between each.
    """

    preset: str
    deviations: str

    def __str__(self) -> str:
        return f"{self.preset}, {self.deviations}" if self.deviations else self.preset


def preset_name(options: Mapping[str, Any], text: Any) -> PresetName | None:
    """The name of a variant.

    Args:
      options: of the variant, by name.
      text: writes the value of an option.

    Returns:
      The name; None if the options do not tell one preset from another.
    """
    options, presets = without_fixed(options), _presets()
    if any(name not in options for name in _telling()):
        return None
    deviating = {preset: _deviating(options, values) for preset, values in presets.items()}
    # The first of several that are as near.
    preset = min(deviating, key=lambda name: len(deviating[name]))
    return PresetName(preset, ", ".join(_words(name, text(options[name])) for name in deviating[preset]))


def named_once(names: Mapping[str, PresetName | None]) -> dict[str, PresetName]:
    """Those names that are short enough and stand for one variant alone, by variant."""
    every = [str(name) for name in names.values() if name is not None]
    return {
        variant: name
        for variant, name in names.items()
        if name is not None and len(str(name)) <= LONGEST_NAME and every.count(str(name)) == 1
    }


@functools.cache
def _presets() -> dict[str, dict[str, Any]]:
    """The options of each preset."""
    return {name: {**Method(config=preset()).options(), **USUAL} for name, preset in PRESETS.items()}


@functools.cache
def _telling() -> frozenset[str]:
    """The options in which presets differ."""
    values = list(_presets().values())
    return frozenset(name for name in values[0] if len({json.dumps(each[name]) for each in values}) > 1)


def _deviating(options: Mapping[str, Any], preset: Mapping[str, Any]) -> list[str]:
    """The options that deviate from a preset; of those outside of it, the paths of settings that are not usual."""
    known = [name for name in preset if name in options and json.dumps(options[name]) != json.dumps(preset[name])]
    return known + sorted(name for name in options if name not in preset and "." in name)


def _words(name: str, value: str) -> str:
    """An option in words."""
    if name in PLAIN:
        return value
    return f"{name.rpartition('.')[2].replace('_', ' ')} {value}"
