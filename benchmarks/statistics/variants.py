"""What tells rows of results apart: their options as labels, long and short, and any column of them by its name."""

from __future__ import annotations

import dataclasses
import json
import operator
import re
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any

from mechsearch_jax.benchmarks.statistics.preset_names import PresetName, named_once, preset_name
from mechsearch_jax.benchmarks.store.rows import OPTIONS, EpisodeRow, options_of
from mechsearch_jax.config.fixed import without_fixed
from mechsearch_jax.runtime.errors import InputError, nearest

# A label that is longer does not fit into a table or a picture; variants are numbered then.
LONGEST = 16
# More variants than these have one line each in tables, over all numbers of objects.
MOST_IN_FULL = 12
# The column of a row's variant, and another name of it.
VARIANT = "method"
_ALIASES = {"variant": VARIANT}

_variant = operator.attrgetter("configuration", *OPTIONS)
_NUMBER = re.compile(r"(-?\d+(?:\.\d+)?(?:e-?\d+)?)")


def _text(value: Any) -> str:
    values = value if isinstance(value, list) else [value]
    return "/".join(f"{v:g}" if isinstance(v, float) else str(v) for v in values)


def _label(policy: str, differing: Mapping[str, str]) -> str:
    return ", ".join([policy, *(f"{name} {value}" for name, value in differing.items())])


def _left_out(name: str) -> str:
    """What stands for an option that a row does not have; settings by their paths are left out where they are usual."""
    return "usual" if "." in name else "unknown"


def _options_of_variants(rows: Sequence[EpisodeRow]) -> tuple[list[Any], dict[Any, dict[str, Any]]]:
    """For each row its variant, and for each variant its options."""
    variants = list(map(_variant, rows))
    # Thousands of rows have the same few options.
    each = dict(zip(variants, rows, strict=True)).items()
    return variants, {variant: without_fixed(options_of(row)) for variant, row in each}


def _differing(rows: Sequence[EpisodeRow]) -> tuple[list[Any], dict[Any, tuple[str, dict[str, str]]]]:
    """For each row its variant, and for each variant the policy and the options that differ."""
    variants, each = _options_of_variants(rows)
    names = sorted({name for options in each.values() for name in options} - {"policy"})
    differing = [name for name in names if len({json.dumps(options.get(name)) for options in each.values()}) > 1]
    parts = {
        variant: (
            str(options["policy"]),
            {name.replace("_", " "): _text(options.get(name, _left_out(name))) for name in differing},
        )
        for variant, options in each.items()
    }
    return variants, parts


def label_variants(rows: Sequence[EpisodeRow]) -> list[str]:
    """For each row the policy and those options that are not the same in all rows: "search-for-grasp, gamma 0.5".

    Rows that ran under different options never share a label.
    """
    variants, parts = _differing(rows)
    labels = {variant: _label(*part) for variant, part in parts.items()}
    return [labels[variant] for variant in variants]


def natural(text: Any) -> Any:
    """A key to sort by, in which numbers inside of texts count as numbers, and None comes last."""
    if text is None:
        return 2, ()
    if isinstance(text, bool | int | float):
        return 0, (float(text),)
    parts = _NUMBER.split(str(text))
    return 1, tuple((0, float(part), "") if i % 2 else (1, 0.0, part) for i, part in enumerate(parts) if part)


@dataclasses.dataclass(frozen=True)
class Key:
    """Short labels of variants, and what they stand for.

    Attributes:
      short: by the labels of `label_variants`, in an order in which numbers count as such.
      common: the policy, where it is the same in all of several variants and left out of the short labels; else empty.
      options: what each variant's options are that differ, by its label, and then by the option's name in words.
      presets: the names that say by which preset a variant is called, by its label; empty where the policy and the
        options that differ say enough.
    """

    short: Mapping[str, str]
    common: str = ""
    options: Mapping[str, Mapping[str, str]] = dataclasses.field(default_factory=dict)
    presets: Mapping[str, PresetName] = dataclasses.field(default_factory=dict)

    @classmethod
    def of(cls, rows: Sequence[EpisodeRow]) -> Key:
        """The key of rows: labels without a policy that all have.

        Where one is too long, names by preset and what deviates from it; numbers where these are too long, too, or say
        not enough.
        """
        of_variants = _differing(rows)[1]
        parts = {_label(*part): part for part in of_variants.values()}
        labels = sorted(parts, key=natural)
        policies = {policy for policy, _ in parts.values()}
        common = policies.pop() if len(policies) == 1 and len(labels) > 1 else ""
        options = {label: {**({} if common else {"policy": parts[label][0]}), **parts[label][1]} for label in labels}
        plain = {label: label.removeprefix(f"{common}, ") if common else label for label in labels}
        if max(map(len, plain.values()), default=0) <= LONGEST:
            return cls(plain, common, options)
        digits = len(str(len(labels)))
        numbers = {label: f"V{i:0{digits}d}" for i, label in enumerate(labels, start=1)}
        each = _options_of_variants(rows)[1]
        names = {_label(*of_variants[variant]): preset_name(each[variant], _text) for variant in each}
        presets = named_once(names)
        return cls({label: str(presets.get(label, numbers[label])) for label in labels}, common, options, presets)

    @property
    def numbered(self) -> bool:
        """Whether the short labels say nothing by themselves."""
        return any(short not in label for label, short in self.short.items())

    def text(self, value: Hashable) -> str:
        """A value of a column in a table: None, for all values, is "all", and a variant has its short label."""
        if value is None:
            return "all"
        return f"{value:g}" if isinstance(value, float) else self.short.get(str(value), str(value))

    def named(self, text: str) -> str:
        """The label that a text stands for: itself, its short one, or some of its parts, as "gamma 0.5" or "gamma=0.5".

        Raises:
          InputError: there is none, or there are several.
        """
        if text in self.short:
            return text
        if exact := [label for label, short in self.short.items() if text == short]:
            return exact[0]
        parts = {part.strip().replace("=", " ").replace("_", " ") for part in text.split(",")}
        matches = [
            label for label, short in self.short.items() if parts <= {*label.split(", "), *short.split(", "), short}
        ]
        if len(matches) == 1:
            return matches[0]
        among = matches or list(self.short)
        names = "; ".join(f"{self.short[label]} ({label})" for label in among[:4]) + ("; ..." if among[4:] else "")
        raise InputError(f'report: variant "{text}" is {"one of several" if matches else "unknown"}: {names}')


def column(rows: Sequence[EpisodeRow], name: str) -> list[Hashable]:
    """What a column says of each row: a field of `EpisodeRow`, an option, or "method" for the label of its variant.

    Lists are joined by "/".

    Raises:
      InputError: there is no such column.
    """
    name = canonical(name)
    if name == VARIANT:
        return list(label_variants(rows))
    fields = [field.name for field in dataclasses.fields(EpisodeRow)]
    if name in fields:
        return [getattr(row, name) for row in rows]
    variants = list(map(_variant, rows))
    each = {variant: options_of(row) for variant, row in dict(zip(variants, rows, strict=True)).items()}
    if not any(name in options for options in each.values()):
        options = {option for names in each.values() for option in names}
        raise InputError(f"report: column {name} is unknown; {nearest(name, [VARIANT, *fields, *sorted(options)])}")
    values: dict[Any, Hashable] = {
        variant: _text(value) if isinstance(value := options.get(name), list) else value
        for variant, options in each.items()
    }
    return [values[variant] for variant in variants]


def canonical(name: str) -> str:
    """A column's name as `EpisodeRow` has it, of one that may be written as an option."""
    plain = name.strip().removeprefix("--").replace("-", "_")
    return _ALIASES.get(plain, plain)


def grouped(rows: Sequence[EpisodeRow], columns: Sequence[str]) -> dict[tuple[Hashable, ...], list[EpisodeRow]]:
    """The rows by what several columns say of them, in their order, where numbers count as such.

    Raises:
      InputError: there is no such column.
    """
    groups: dict[tuple[Hashable, ...], list[EpisodeRow]] = {}
    for values, row in zip(zip(*(column(rows, name) for name in columns), strict=True), rows, strict=True):
        groups.setdefault(values, []).append(row)
    order: Callable[[tuple[Hashable, ...]], Any] = lambda values: tuple(map(natural, values))  # noqa: E731
    return {values: groups[values] for values in sorted(groups, key=order)}
