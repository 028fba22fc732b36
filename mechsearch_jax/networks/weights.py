"""Weights of networks in files: NumPy archives of half-precision arrays, from which no code can run, and their cards.

An archive `NAME.npz` holds one array for each parameter, named by its path in the network. Beside it lies the card
`NAME.json`: which network with which configuration it is, the archive's SHA-256, and how it was made and scored.
"""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.resources
import io
import json
import zipfile
from pathlib import Path
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict

from mechsearch_jax.errors import InputError
from mechsearch_jax.files import PathLike, replacing
from mechsearch_jax.geometry.superquadric import empty
from mechsearch_jax.networks.push import PushConfig, PushNetwork
from mechsearch_jax.networks.push_geometry import push_start
from mechsearch_jax.networks.recognition import RecognitionConfig, RecognitionNetwork
from mechsearch_jax.networks.segmentation import SegmentationConfig, SegmentationNetwork
from mechsearch_jax.perception.segments import SegmentConfig
from mechsearch_jax.workspace.shelf import Shelf

FORMAT = "mechsearch-weights"
VERSION = 1


@dataclasses.dataclass(frozen=True)
class Architecture:
    """What a kind of network consists of.

    Attributes:
      network: its class.
      config: the class of its configuration.
      inputs: arrays of the shapes and types that it takes, or pytrees of such.
    """

    network: Any
    config: Any
    inputs: tuple[Any, ...]

    def shapes(self, config: Any) -> Any:
        """Its parameters' shapes."""
        network = self.network(config)
        return jax.eval_shape(lambda *inputs: network.init(jax.random.key(0), *inputs), *self.inputs)["params"]


_CLOUD = SegmentConfig().points
_PUSH = jax.eval_shape(
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
      card: what its card says.
    """

    network: nn.Module
    parameters: Any
    card: dict[str, Any]


def save_weights(path: PathLike, name: str, config: Any, parameters: Any, card: dict[str, Any]) -> None:
    """Write an archive and its card.

    Args:
      path: of the archive, NAME.npz; the card goes beside it.
      name: of the architecture, one of `ARCHITECTURES`.
      config: of the network.
      parameters: Flax parameters; kept in half precision.
      card: how they were made and scored; numbers, texts, lists and dictionaries.

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
    """What the card beside an archive says.

    Args:
      archive: NAME.npz.
      name: of the architecture.

    Raises:
      InputError: the card is missing, is none, or is of another network.
    """
    path = Path(archive).with_suffix(".json")
    try:
        card = json.loads(path.read_text())
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); weights need their card") from None
    except ValueError:
        raise InputError(f"{path}: is not a card of weights; train or install them anew") from None
    if not isinstance(card, dict) or card.get("format") != FORMAT or card.get("version") != VERSION:
        raise InputError(f'{path}: is not a card of format "{FORMAT}", version {VERSION}; train or install them anew')
    if card.get("network") != name:
        raise InputError(f"{path}: is of a {json.dumps(card.get('network'))} network; give the one for {name}")
    return card


def read_archive(path: Path, card: dict[str, Any]) -> bytes:
    """An archive, as its card describes it.

    Raises:
      InputError: it is missing, or another than its card describes.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); train or install weights") from None
    if hashlib.sha256(data).hexdigest() != card.get("sha256"):
        raise InputError(f"{path}: is not the file that its card describes (SHA-256 differs); copy both again")
    return data


def load_weights(path: PathLike, name: str) -> Weights:
    """Read an archive, checked against its card and against the network that it is for.

    Args:
      path: of the archive.
      name: of the architecture.

    Raises:
      InputError: a file is missing, corrupt, or of another network.
    """
    path = Path(path)
    card = read_card(path, name)
    architecture, data = ARCHITECTURES[name], read_archive(path, card)
    try:
        config = architecture.config(**card["config"])
        shapes: dict[str, Any] = flatten_dict(architecture.shapes(config), sep="/")
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            arrays = {key: archive[key] for key in archive.files}
    except InputError as error:
        raise InputError(f"{path.with_suffix('.json')}: {error}") from None
    except (KeyError, TypeError, ValueError, OSError, zipfile.BadZipFile):
        raise InputError(f"{path}: is no archive of a {name} network; train or install weights anew") from None
    for key in shapes.keys() | arrays.keys():
        expected = shapes[key].shape if key in shapes else None
        found = arrays[key].shape if key in arrays else None
        if expected != found:
            raise InputError(f"{path}: {key} has the shape {found} where the network needs {expected}; train anew")
        if not np.isfinite(arrays[key]).all():
            raise InputError(f"{path}: {key} holds NaN or infinite numbers; train anew")
    # Numbers, also where the caller is traced.
    with jax.ensure_compile_time_eval():
        parameters = {key: jnp.asarray(np.asarray(a, np.float32)) for key, a in arrays.items()}
    return Weights(architecture.network(config), unflatten_dict(parameters, sep="/"), card)


def shipped_weights(name: str) -> Weights:
    """The weights that ship with the package.

    Raises:
      InputError: they are missing or damaged.
    """
    return load_weights(Path(str(importlib.resources.files("mechsearch_jax") / "networks" / f"{name}.npz")), name)
