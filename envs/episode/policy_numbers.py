"""The numbers among a policy's leaves, which may differ between the slots of one computation.

A policy is a pytree. Its structure, static fields and arrays determine the compiled program and are shared by all
slots; numbers, such as a discount, are data of each slot.
"""

from __future__ import annotations

import hashlib
from collections.abc import Hashable, Iterator, Sequence
from typing import Any

import jax
import numpy as np

from mechsearch_jax.planner import Policy


def as_pytree(policy: Policy) -> Any:
    """A policy as an argument of a jitted function: a plain function becomes a pytree without leaves."""
    return jax.tree_util.Partial(policy) if jax.tree_util.all_leaves([policy]) else policy


def _is_number(leaf: Any) -> bool:
    if isinstance(leaf, bool | int | float):
        return True
    return getattr(leaf, "shape", None) == () and jax.numpy.issubdtype(leaf.dtype, np.number)


def numbers(policy: Any) -> tuple[np.ndarray, ...]:
    """The numbers of a policy that is a pytree, in the order of its leaves."""
    return tuple(np.asarray(leaf) for leaf in jax.tree.leaves(policy) if _is_number(leaf))


def with_numbers(policy: Any, values: Sequence[Any]) -> Any:
    """The policy with other numbers, in the order of `numbers`; both may be traced."""
    leaves, tree = jax.tree.flatten(policy)
    rest: Iterator[Any] = iter(values)
    return jax.tree.unflatten(tree, [next(rest) if _is_number(leaf) else leaf for leaf in leaves])


def compile_key(policy: Policy) -> Hashable:
    """A key of a policy's compiled program: equal for policies that differ in numbers alone and may share a batch."""
    leaves, tree = jax.tree.flatten(as_pytree(policy))
    return tree, tuple(map(_leaf_key, leaves))


def _leaf_key(leaf: Any) -> Hashable:
    if _is_number(leaf):
        return np.asarray(leaf).dtype.kind
    if isinstance(leaf, np.ndarray | jax.Array):
        data = np.asarray(jax.random.key_data(leaf) if jax.numpy.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf)
        return str(leaf.dtype), leaf.shape, hashlib.sha256(data.tobytes()).hexdigest()
    return leaf
