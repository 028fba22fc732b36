"""All kinds of action. A new kind is a new file in `kinds` and two lines here."""

from __future__ import annotations

import enum
from collections.abc import Mapping, Sequence

from mechsearch_jax.actions.kind import Kind, SampledKind
from mechsearch_jax.actions.kinds import nothing, pick_and_place, push, retrieve
from mechsearch_jax.runtime.errors import InputError, shown


class ActionKind(enum.IntEnum):
    """The values of `Action.kind`; files store them."""

    NONE = nothing.CODE
    PUSH = push.CODE
    PICK_AND_PLACE = pick_and_place.CODE
    RETRIEVE = retrieve.CODE


# Kinds from which sequences are sampled. Their order decides which random number belongs to which action.
SAMPLED_KINDS: Sequence[SampledKind] = (pick_and_place.PickAndPlace(), push.Push())

KINDS: Mapping[ActionKind, Kind] = {
    ActionKind(kind.code): kind for kind in (nothing.Nothing(), *SAMPLED_KINDS, retrieve.Retrieve())
}


def kind_of(code: int) -> Kind:
    """The kind with a code.

    Raises:
      InputError: no kind has this code.
    """
    for kind in KINDS.values():
        if kind.code == int(code):
            return kind
    codes = ", ".join(f"{kind.code} ({kind.name})" for kind in KINDS.values())
    raise InputError(f"action kind {int(code)} is unknown; there are {codes}")


def check_kinds(names: Sequence[str]) -> None:
    """Check names of kinds.

    Raises:
      InputError: a name is not one of `SAMPLED_KINDS`.
    """
    sampled = [kind.name for kind in SAMPLED_KINDS]
    for name in names:
        if name not in sampled:
            raise InputError(f"actions: {shown(name)} is unknown; use one or more of {', '.join(sampled)}")
