"""Files of weights: NumPy archives of half-precision arrays, which cannot execute code, and their cards.

An archive `NAME.npz` holds one array for each parameter, named by its path in the network. The card `NAME.json` beside
it holds the network's name and configuration, the archive's SHA-256, and how the weights were trained and scored.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import importlib.resources
import io
import json
from pathlib import Path
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict

from mechsearch_jax.geometry.superquadric import empty
from mechsearch_jax.images.segments import SegmentConfig
from mechsearch_jax.images.trained_view import TrainedView, read_view
from mechsearch_jax.networks.push import PushConfig, PushNetwork
from mechsearch_jax.networks.push_geometry import push_start
from mechsearch_jax.networks.recognition import RecognitionConfig, RecognitionNetwork
from mechsearch_jax.networks.segmentation import SegmentationConfig, SegmentationNetwork
from mechsearch_jax.runtime.arrays import ARRAYS_LIMIT, read_arrays
from mechsearch_jax.runtime.errors import InputError, shown
from mechsearch_jax.runtime.files import PathLike, read_bytes, read_json, replacing
from mechsearch_jax.runtime.own_settings import in_own_settings
from mechsearch_jax.workspace.shelf import Shelf

FORMAT = "mechsearch-weights"
VERSION = 1


@dataclasses.dataclass(frozen=True)
class Architecture:
    """A kind of network.

    Attributes:
      network: its class.
      config: the class of its configuration.
      inputs: shapes and types of its inputs, arrays or pytrees.
    """

    network: Any
    config: Any
    inputs: tuple[Any, ...]

    def shapes(self, config: Any) -> Any:
        """The shapes of its parameters."""
        network = self.network(config)
        return jax.eval_shape(lambda *inputs: network.init(jax.random.key(0), *inputs), *self.inputs)["params"]


_CLOUD = SegmentConfig().points
_PUSH = in_own_settings(jax.eval_shape)(
    lambda: push_start(Shelf(), empty(2), jnp.zeros((1, 3)), jnp.zeros((4, 4)), jnp.zeros(3)),
)
ARCHITECTURES = {
    "segmentation": Architecture(
        SegmentationNetwork, SegmentationConfig, (jax.ShapeDtypeStruct((1, 64, 3), jnp.float32),)
    ),
    "recognition": Architecture(
        RecognitionNetwork,
        RecognitionConfig,
        (
            jax.ShapeDtypeStruct((1, _CLOUD, 3), jnp.float32),
            jax.ShapeDtypeStruct((1, _CLOUD), jnp.int8),
            jax.ShapeDtypeStruct((1, 3), jnp.float32),
        ),
    ),
    "push": Architecture(PushNetwork, PushConfig, (_PUSH,)),
}


@dataclasses.dataclass(frozen=True, eq=False)
class Weights:
    """A trained network.

    Attributes:
      network: the Flax module; static under jit.
      parameters: its parameters, float32.
      card: the content of its card.
      view: camera and shelf in its training, if its card records them.
    """

    network: nn.Module
    parameters: Any
    card: dict[str, Any]
    view: TrainedView | None = None


def save_weights(path: PathLike, name: str, config: Any, parameters: Any, card: dict[str, Any]) -> None:
    """Write an archive and its card.

    Args:
      path: of the archive, NAME.npz; the card goes beside it.
      name: of the architecture, one of `ARCHITECTURES`.
      config: of the network.
      parameters: Flax parameters; stored in half precision.
      card: how they were trained and scored, as JSON values.

    Raises:
      InputError: a file cannot be written.
    """
    arrays = {key: np.asarray(value, np.float16) for key, value in flatten_dict(parameters, sep="/").items()}
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # pyright: ignore[reportArgumentType]
    data = buffer.getvalue()
    head = {
        "format": FORMAT,
        "version": VERSION,
        "network": name,
        "config": dataclasses.asdict(config),
        "sha256": hashlib.sha256(data).hexdigest(),
        "bytes": len(data),
        "parameters": int(sum(a.size for a in arrays.values())),
    }
    with replacing(path) as file:
        file.write(data)
    with replacing(Path(path).with_suffix(".json")) as file:
        file.write((json.dumps(head | card, indent=1) + "\n").encode())


def read_card(archive: PathLike, name: str) -> dict[str, Any]:
    """The content of the card beside an archive NAME.npz.

    Args:
      archive: path of the archive.
      name: of the architecture.

    Raises:
      InputError: the card is missing, is not a card, or is of another network.
    """
    path = Path(archive).with_suffix(".json")
    try:
        card = read_json(path)
    except InputError as error:
        raise InputError(f"{error}; weights need their card") from None
    if not isinstance(card, dict) or card.get("format") != FORMAT or card.get("version") != VERSION:
        raise InputError(f'{path}: is not a card of format "{FORMAT}", version {VERSION}; train or install them anew')
    if card.get("network") != name:
        raise InputError(f"{path}: is of a {shown(card.get('network'))} network; give the one for {name}")
    return card


def read_archive(path: Path, card: dict[str, Any]) -> bytes:
    """The bytes of an archive, checked against its card.

    Raises:
      InputError: it is missing, or its SHA-256 differs from the card's.
    """
    try:
        data = read_bytes(path, ARRAYS_LIMIT)
    except InputError as error:
        raise InputError(f"{error}; train or install weights") from None
    if hashlib.sha256(data).hexdigest() != card.get("sha256"):
        raise InputError(f"{path}: is not the file that its card describes (SHA-256 differs); copy both again")
    return data


@functools.cache
def weight_shapes(name: str, config: Any) -> dict[str, tuple[int, ...]]:
    """The shapes of a network's parameters, by their paths."""
    shapes: dict[str, Any] = flatten_dict(ARCHITECTURES[name].shapes(config), sep="/")
    return {key: value.shape for key, value in shapes.items()}


def _config(name: str, value: Any, arrays: dict[str, np.ndarray], where: Path) -> Any:
    """The configuration in a card.

    Raises:
      InputError: it is not a configuration of this network, or of a larger one than the archive holds.
    """
    kinds = {field.name: type(field.default) for field in dataclasses.fields(ARCHITECTURES[name].config)}
    if not isinstance(value, dict) or {key: type(part) for key, part in value.items()} != kinds:
        keys = ", ".join(f"{key} ({kind.__name__})" for key, kind in kinds.items())
        raise InputError(f"{where}: config: {shown(value)} must hold {keys}; train or install anew")
    # Otherwise a damaged card could ask for a network of millions of layers, whose shapes take forever to compute.
    largest = max([len(arrays), *(size for array in arrays.values() for size in array.shape)])
    for key, part in value.items():
        if isinstance(part, int) and part > largest:
            raise InputError(f"{where}: config: {key} {shown(part)} is of a larger network than the archive holds")
    try:
        return ARCHITECTURES[name].config(**value)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def load_weights(path: PathLike, name: str) -> Weights:
    """Read an archive, checked against its card and its architecture `name`.

    Raises:
      InputError: a file is missing, damaged, or of another network.
    """
    path = Path(path)
    card = read_card(path, name)
    arrays = read_arrays(read_archive(path, card), path)
    config = _config(name, card.get("config"), arrays, path.with_suffix(".json"))
    view = read_view(card, str(path.with_suffix(".json")))
    try:
        shapes = weight_shapes(name, config)
    except (TypeError, ValueError):
        raise InputError(
            f"{path.with_suffix('.json')}: config makes no {name} network; train or install anew"
        ) from None
    for key in sorted(shapes.keys() | arrays.keys()):
        expected = shapes.get(key)
        shape = arrays[key].shape if key in arrays else None
        if expected != shape:
            raise InputError(
                f"{path}: {shown(key)} has the shape {shape} where the network needs {expected}; train anew"
            )
        if arrays[key].dtype.kind != "f":
            raise InputError(f"{path}: {shown(key)} holds {arrays[key].dtype} instead of numbers; train anew")
        with np.errstate(over="ignore"):
            arrays[key] = arrays[key].astype(np.float32)
        if not np.isfinite(arrays[key]).all():
            raise InputError(f"{path}: {shown(key)} holds NaN or infinite numbers; train anew")
    # Concrete arrays even if the caller is traced.
    with jax.ensure_compile_time_eval():
        parameters = {key: jax.device_put(a) for key, a in arrays.items()}
    return Weights(ARCHITECTURES[name].network(config), unflatten_dict(parameters, sep="/"), card, view)


def shipped_weights(name: str) -> Weights:
    """The weights that ship with the package.

    Raises:
      InputError: they are missing or damaged.
    """
    return load_weights(Path(str(importlib.resources.files("mechsearch_jax") / "networks" / f"{name}.npz")), name)
