"""`--world KEY=VALUE ...`: how the simulated world differs from what the planner assumes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from mechsearch_jax.runtime.errors import InputError, nearest

if TYPE_CHECKING:
    from mechsearch_jax.envs.world.mismatch import Mismatch
    from mechsearch_jax.planner import Option


def about_world() -> str:
    """The help of the option: every key with what it sets and its default."""
    from mechsearch_jax.envs.world.mismatch import ASSUMED, MISMATCH_OPTIONS

    def shown(option: Option) -> str:
        values = f"; {', '.join(option.choices)}" if option.choices else ""
        usual = getattr(ASSUMED, option.name)
        return f"{option.name}: {option.help}{values} ({usual if option.choices else f'{option.outside(usual):g}'})"

    lines = "\n".join(map(shown, MISMATCH_OPTIONS.values()))
    return f"how the simulated world differs from what the planner assumes, as friction=2 camera_turn=1:\n{lines}"


def mismatch_of(world: Sequence[str]) -> Mismatch:
    """The mismatch that texts such as "friction=2" say.

    Raises:
      InputError: a text says nothing of the kind, or a value is impossible.
    """
    from mechsearch_jax.envs.world.mismatch import Mismatch

    return Mismatch(**{option.name: _value(option, text) for option, text in _settings(world)})


def swept(world: Sequence[str]) -> dict[str, list[str]]:
    """Of texts such as "friction=0.5,2" those of a single value, "friction=0.5" and "friction=2", by their keys.

    Raises:
      InputError: a text says nothing of the kind.
    """
    return {option.name: [f"{option.name}={part}" for part in text.split(",")] for option, text in _settings(world)}


def _settings(world: Sequence[str]) -> Iterator[tuple[Option, str]]:
    """The options and their values as texts, in the order of the options."""
    from mechsearch_jax.envs.world.mismatch import MISMATCH_OPTIONS

    given: dict[str, str] = {}
    for text in world:
        key, equals, value = text.partition("=")
        key = key.replace("-", "_")
        if not equals:
            raise InputError(f"--world {text}: give a key and a value, as friction=2")
        if key not in MISMATCH_OPTIONS:
            raise InputError(f"--world {text}: {key} is unknown; {nearest(key, MISMATCH_OPTIONS)}")
        if key in given:
            raise InputError(f"--world {text}: {key} is given twice; a sweep takes several values as {key}=1,2")
        given[key] = value
    return ((option, given[key]) for key, option in MISMATCH_OPTIONS.items() if key in given)


def _value(option: Option, text: str) -> Any:
    """A single value, as the field holds it."""
    if option.choices:
        return text
    try:
        number = float(text)
    except ValueError:
        several = "; several values are for mechsearch sweep" if "," in text else ""
        raise InputError(f"--world {option.name}={text}: is not a number{several}") from None
    return option.inside(number)
