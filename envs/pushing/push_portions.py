"""Pushes in files, generated in portions; portions that exist in a folder are read instead."""

from __future__ import annotations

import dataclasses
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax.traverse_util import unflatten_dict
from jaxtyping import Array

from mechsearch_jax.envs.pushing.pushes import Generation, Pushes, PushesConfig, generate_pushes
from mechsearch_jax.envs.simulators.simulator import Simulator
from mechsearch_jax.envs.world.world import World
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import replacing


def save_pushes(path: Path, pushes: Pushes, identity: str) -> None:
    """Write pushes with an identity, a text that says how they were generated.

    Raises:
      InputError: the file cannot be written.
    """
    leaves, _ = jax.tree_util.tree_flatten_with_path(pushes)
    arrays = {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}
    with replacing(path) as file:
        np.savez(file, identity=np.array(identity), **arrays)  # pyright: ignore[reportArgumentType]


def load_pushes(path: Path, identity: str) -> Pushes:
    """Read pushes of an identity.

    Raises:
      InputError: the file is damaged, or its identity differs.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        stored = str(arrays.pop("identity"))
        tree: dict[str, Any] = unflatten_dict(arrays, sep="/")
        worlds = {name: World(**tree.pop(name)) for name in ("before", "after")}
        pushes = Pushes(**worlds, **tree)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); choose another --data") from None
    except (KeyError, TypeError, ValueError, EOFError, zipfile.BadZipFile):
        complaint = "is damaged, or was written by another version; remove it or choose another --data"
        raise InputError(f"{path}: {complaint}") from None
    if stored != identity:
        raise InputError(f"{path}: was made otherwise ({stored}); repeat that or choose another --data")
    return pushes


def _drawn_from(config: PushesConfig) -> dict[str, Any]:
    """The settings on which pushes depend: all of `config`, but of its `actions` only those of pushes."""
    pushing = ("push_wrists", "push_tilt", "push_depths", "push_height", "push_leverage")
    pushing += ("cloud_points", "pusher_points")
    settings = {field.name: getattr(config, field.name) for field in dataclasses.fields(config)}
    return settings | {"actions": {name: getattr(config.actions, name) for name in pushing}}


def portions(
    generation: Generation,
    folder: Path,
    make_simulator: Callable[[], Simulator],
    draw_world: Callable[[Array], World],
    source: str = "",
    config: PushesConfig | None = None,
    on_progress: Callable[[int], None] = lambda pushes: None,
) -> Iterator[Pushes]:
    """Portions of pushes until there are enough; those that exist in the folder are read instead of generated.

    Args:
      generation: number of pushes and portions.
      folder: holds one file for each portion.
      make_simulator: called if anything has to be simulated.
      draw_world: see `generate_pushes`.
      source: names the simulator and the scenes; files in the folder must have the same.
      config: of the pushes.
      on_progress: called with the number of pushes so far.

    Raises:
      InputError: a file in the folder is damaged or of another identity, or the folder cannot be written.
    """
    config = config or PushesConfig()
    simulator: Simulator | None = None
    count = number = 0
    while count < generation.pushes:
        path = folder / f"pushes-{number:03d}.npz"
        identity = repr((generation.seed, generation.worlds, generation.rounds, number, _drawn_from(config), source))
        if path.exists():
            part = load_pushes(path, identity)
        else:
            simulator = simulator or make_simulator()
            key = jax.random.fold_in(jax.random.key(generation.seed), number)
            base = count
            part = generate_pushes(
                key,
                generation.worlds,
                generation.rounds,
                simulator,
                draw_world,
                config,
                on_progress=lambda _, pushes, base=base: on_progress(base + pushes),
            )
            part = part.replace(lane=part.lane + number * generation.worlds)
            save_pushes(path, part, identity)
        count += len(part.object)
        if not len(part.object):
            raise InputError(f"no push was possible in {generation.worlds} worlds; give more --worlds")
        on_progress(count)
        number += 1
        yield part
