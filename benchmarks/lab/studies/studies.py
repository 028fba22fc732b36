"""What a study is: a question, the scenes that it is answered on, and variants of one method."""

from __future__ import annotations

import dataclasses
import functools
import json
import operator
from collections import Counter
from collections.abc import Hashable, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

from mechsearch_jax.benchmarks.statistics.preset_names import settings_of
from mechsearch_jax.benchmarks.store.rows import OPTIONS, EpisodeRow, options_of
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.envs.scenes.scene_sets import Block, find_set, set_scenes
from mechsearch_jax.envs.simulators.named import EngineName
from mechsearch_jax.problem.settings import Settings, load_settings
from mechsearch_jax.runtime.errors import InputError, nearest

# Options of a variant that are no options of the planner, by their fields of `Method`.
_OF_METHODS = ("recognition", "mismatch")
# Columns that say what an episode ran with.
_ran_with = operator.attrgetter("configuration", *OPTIONS)


@dataclasses.dataclass(frozen=True)
class Variant:
    """A method of a study.

    Attributes:
      label: in tables and pictures.
      options: how it differs from `search-for-grasp` in preset `standard` with true shapes: the planner's options by
        name, `preset`, and fields of `Method` (`recognition`, `mismatch`).
      policy: its name.
      config: a configuration file of another camera; the default one's settings if None.
      engine: the simulator that it needs; any if None.
      scenes: only the first so many of each number of objects; all if None.
    """

    label: str
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    policy: str = "search-for-grasp"
    config: Path | None = None
    engine: EngineName | None = None
    scenes: int | None = None

    def method(self, engine: EngineName = "NativeSimulator") -> Method:
        """The method, in a simulator unless the variant needs another.

        Raises:
          InputError: an option is impossible, or what it needs is not installed.
        """
        settings = Settings() if self.config is None else load_settings(self.config)
        own = {name: self.options[name] for name in _OF_METHODS if name in self.options}
        settings = settings.with_options(**{name: v for name, v in self.options.items() if name not in own})
        return Method(self.policy, settings.config, engine=self.engine or engine, workcell=settings.workcell, **own)


@dataclasses.dataclass(frozen=True)
class Study:
    """A question, and the variants that answer it.

    Attributes:
      name: as commands take it.
      question: in one sentence.
      scenes: name of a scene set.
      variants: the first is what the others are compared with.
    """

    name: str
    question: str
    scenes: str
    variants: tuple[Variant, ...]

    @property
    def baseline(self) -> Variant:
        """What the others are compared with."""
        return self.variants[0]

    def scene_list(self, variant: Variant) -> list[tuple[Block, int]]:
        """The scenes of a variant, for `scene_sets.scene_files`."""
        scenes = set_scenes(find_set(self.scenes))
        return [(block, index) for block, index in scenes if variant.scenes is None or index < variant.scenes]

    def rows_of(self, rows: Sequence[EpisodeRow]) -> dict[str, list[EpisodeRow]]:
        """The rows of each variant on the study's scenes, by its label; a variant without rows is left out.

        A row is a variant's if it differs from the default in the same options. Where a variant may run in any
        simulator, the rows of the one that ran most of them count.
        """
        blocks = {block.name for block in find_set(self.scenes).blocks}
        # Thousands of rows have the same few options.
        keys_of: dict[Hashable, tuple[str, str]] = {}
        groups: dict[tuple[str, str], list[EpisodeRow]] = {}
        for row in rows:
            if row.scenario.rpartition("-")[0] in blocks:
                ran_with = _ran_with(row)
                if ran_with not in keys_of:
                    options = options_of(row)
                    keys_of[ran_with] = _key(options), options["simulator"]
                groups.setdefault(keys_of[ran_with], []).append(row)
        wanted = {variant.label: _variant_key(variant.method()) for variant in self.variants}
        ran = Counter({engine: 0 for engine in get_args(EngineName)})
        for (key, engine), group in groups.items():
            ran[engine] += len(group) if key in wanted.values() else 0
        usual = ran.most_common(1)[0][0]
        keys = {variant.label: (wanted[variant.label], variant.engine or usual) for variant in self.variants}
        return {label: groups[key] for label, key in keys.items() if key in groups}


def _key(options: Mapping[str, Any]) -> str:
    """What tells variants apart, whatever the simulator."""
    return json.dumps(settings_of(options), sort_keys=True)


@functools.lru_cache(maxsize=4096)
def _variant_key(method: Method) -> str:
    return _key(method.options())


def find_studies(names: Sequence[str], studies: Mapping[str, Study]) -> list[Study]:
    """The studies of names, each once; "all" is every one.

    Raises:
      InputError: there is no name, or no study of a name.
    """
    if not names:
        raise InputError(f"study: name one or more of {', '.join(studies)}, or all")
    unknown = [name for name in names if name not in studies and name != "all"]
    if unknown:
        raise InputError(f"study: {unknown[0]} is unknown; {nearest(unknown[0], [*studies, 'all'])}")
    chosen = studies if "all" in names else names
    return [studies[name] for name in dict.fromkeys(chosen)]
