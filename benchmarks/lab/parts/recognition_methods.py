"""The compared recognition methods: the network, refinement and the classical method."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Literal, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from mechsearch_jax.benchmarks.lab.parts import ems
from mechsearch_jax.benchmarks.lab.parts.images import Shown
from mechsearch_jax.envs.world.world import TARGET
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.networks.recognition import RecognitionNetwork
from mechsearch_jax.networks.weights import Weights, shipped_weights
from mechsearch_jax.perception.recognition import recognise_with_error
from mechsearch_jax.perception.refinement import RefinementConfig, refine, select
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf

MethodName = Literal["network", "network-refined", "ems", "ems-refined"]
# Points of a segment for the classical method, which is slow; more points do not improve it.
EMS_POINTS = 250


@dataclasses.dataclass(frozen=True, eq=False)
class Method:
    """A way to recognise objects.

    Attributes:
      answer: from a PRNG key, the image, and the initial superquadrics, to superquadrics in the slots of the labels.
      after: name of the method whose answer is the initial one; None if that is an empty scene.
      slow: whether it may be measured on fewer scenes.
    """

    answer: Callable[[Key[Array, ""], Shown, Superquadrics], Superquadrics]
    after: str | None = None
    slow: bool = False


def shipped_methods(camera: Camera, shelf: Shelf, weights: Weights | None = None) -> dict[str, Method]:
    """The compared methods.

    Args:
      camera: of the images.
      shelf: in the images.
      weights: of the recognition network; the shipped ones if None.

    Raises:
      InputError: the shipped weights are missing or damaged.
    """
    weights = weights or shipped_weights("recognition")
    network = cast(RecognitionNetwork, weights.network)

    def by_network(key: Array, shown: Shown, _: Superquadrics) -> Superquadrics:
        return recognise_with_error(key, network, weights.parameters, camera, shown.points, shown.labels, shelf)[0]

    def by_ems(key: Array, shown: Shown, _: Superquadrics) -> Superquadrics:
        points, labels = (np.asarray(a) for a in sampled_points(shown))
        return ems.recover_scene(points, labels, TARGET)

    def refiner(config: RefinementConfig) -> Callable[[Array, Shown, Superquadrics], Superquadrics]:
        def refined(key: Array, shown: Shown, initial: Superquadrics) -> Superquadrics:
            points, labels = shown.points.reshape(-1, 3), shown.labels.reshape(-1)
            return refine(camera, shelf, initial, points, labels, shown.depth, config).scene

        return refined

    methods: dict[MethodName, Method] = {
        "network": Method(by_network),
        "network-refined": Method(refiner(RefinementConfig()), after="network"),
        "ems": Method(by_ems, slow=True),
        "ems-refined": Method(refiner(RefinementConfig.rough()), after="ems", slow=True),
    }
    return cast(dict[str, Method], methods)


@jax.jit
def sampled_points(shown: Shown) -> tuple[Float[Array, "p 3"], Int[Array, " p"]]:
    """`EMS_POINTS` points spread evenly over every segment, and their labels; -1 beyond a segment's points."""
    labels = shown.labels.reshape(-1).astype(jnp.int32)
    slots = jnp.arange(TARGET)
    index, weight = jax.vmap(lambda slot: select(labels, slot, EMS_POINTS))(slots)
    sampled = jnp.where(weight > 0, slots[:, None], -1)
    return shown.points.reshape(-1, 3)[index.reshape(-1)], sampled.reshape(-1)


def chosen_methods(methods: Mapping[str, Method], names: Sequence[str]) -> dict[str, Method]:
    """The methods of given names, each after its initial method.

    Raises:
      InputError: there is no method of a name.
    """
    chosen: dict[str, Method] = {}
    for name in names:
        if name not in methods:
            raise InputError(f'lab recognition: method "{name}" is unknown; use {", ".join(methods)}')
        start = methods[name].after
        if start is not None:
            chosen.setdefault(start, methods[start])
        chosen.setdefault(name, methods[name])
    return chosen
