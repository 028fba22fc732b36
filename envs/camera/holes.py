"""Holes of a depth camera: connected parts of its image in which nothing is measured.

What has no depth keeps its colour. Lengths in pixels are of an image of 1280 x 720 of the default camera, so that holes
are as large in a thinned image as in the full one. All of it is data, so that a sweep over kinds compiles once.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from mechsearch_jax.envs.camera.simulated_camera import BACKGROUND, Image
from mechsearch_jax.envs.world.mismatch import HolesName
from mechsearch_jax.envs.world.world import BODIES, TARGET, World
from mechsearch_jax.runtime.pytree import PyTreeNode
from mechsearch_jax.workspace.camera import Camera

USUAL_FX = Camera().fx
# A stereo camera's second eye is so far to the right [m], as Intel's D435 has it.
BASELINE = 0.05
# Least difference in depth that casts a shadow [m], and the shadow's least and largest width in pixels.
JUMP, NARROWEST, WIDEST = 0.04, 5.0, 20.0
# Waves of which fields of blobs consist, and their lengths in patches and in clumps of scattered pixels.
WAVES, PATCH, CLUMP = 32, 160.0, 12.0
# Share of the scattered pixels that are lost in clumps.
CLUMPED = 2 / 3


class Holes(PyTreeNode):
    """What of a depth image is not measured; each may be traced.

    Attributes:
      objects: probability of each object that it has no depth, as black, shiny and transparent things.
      at_least_one: whether one object has none in any case.
      target: whether the target has none.
      shadows: whether there is none on the left of what stands before something else: what a stereo camera's second eye
        does not see, `NARROWEST` to `WIDEST` pixels wide, the wider the more the depth differs.
      scattered: share of the pixels that are lost, `CLUMPED` of them in clumps, the others singly.
      patches: share of the pixels that show shelf or bodies which lie in connected patches without depth.
    """

    objects: jax.Array | float = 0.0
    at_least_one: jax.Array | bool = False
    target: jax.Array | bool = False
    shadows: jax.Array | bool = False
    scattered: jax.Array | float = 0.0
    patches: jax.Array | float = 0.0


HOLES: Mapping[HolesName, Holes] = MappingProxyType(
    {
        "none": Holes(),
        "objects": Holes(objects=0.25, at_least_one=True),
        "shadows": Holes(shadows=True),
        "scattered": Holes(scattered=0.3),
        "target": Holes(target=True),
        "patches": Holes(patches=0.1),
    }
)


class DrawnHoles(PyTreeNode):
    """The holes of an episode: the same at every look, for the same image.

    Attributes:
      seed: of what is drawn, uint32, shape (...).
      holes: of which kinds.
    """

    seed: jax.Array | np.ndarray
    holes: Holes

    def without_depth(self, world: World) -> Bool[Array, " 9"]:
        """Which bodies have no depth; none of those that are not there."""
        chance = jax.random.uniform(self._key(0), (TARGET,))
        chance = jnp.where(world.valid[:TARGET], chance, jnp.inf)
        one = jnp.isfinite(chance) & (chance == jnp.min(chance)) & self.holes.at_least_one
        return jnp.append(one | (chance < self.holes.objects), self.holes.target & world.valid[TARGET])

    def of(self, camera: Camera, world: World, image: Image) -> Bool[Array, "h w"]:
        """Which pixels of an image have no depth.

        Args:
          camera: of the image; may be traced.
          world: the bodies in it.
          image: as `observe` returns it.
        """
        owner, holes = image.segmentation, jax.tree.map(jnp.asarray, self.holes)
        is_body = (owner >= 0) & (owner < BODIES)
        lost = is_body & self.without_depth(world)[jnp.clip(owner, 0, TARGET)]
        lost |= shadows(camera, image.depth) & holes.shadows
        clumped = CLUMPED * holes.scattered
        lost |= blobs(self._key(1), camera, jnp.ones(owner.shape, bool), clumped, CLUMP)
        lost |= jax.random.uniform(self._key(2), owner.shape) < (holes.scattered - clumped) / (1.0 - clumped)
        return lost | blobs(self._key(3), camera, owner != BACKGROUND, holes.patches, PATCH)

    def _key(self, number: int) -> Key[Array, ""]:
        return jax.random.fold_in(jax.random.key(self.seed), number)


def shadows(
    camera: Camera,
    depth: Float[Array, "h w"],
    baseline: jax.Array | float = BASELINE,
    narrowest: jax.Array | float = NARROWEST,
    widest: jax.Array | float = WIDEST,
) -> Bool[Array, "h w"]:
    """Which pixels have something nearer on their right that hides them from an eye farther to the right.

    Args:
      camera: of the image; may be traced.
      depth: the true one [m]; infinite where nothing is.
      baseline: how far that eye is to the right [m].
      narrowest, widest: least and largest width of a shadow, in pixels; no shadows if the latter is 0.
    """
    scale, width = camera.fx / USUAL_FX, depth.shape[1]

    def cast(k, lost):
        nearer = jnp.where(jnp.arange(width) + k < width, jnp.roll(depth, -k, axis=1), jnp.inf)
        disparity = baseline * camera.fx * (1.0 / nearer - 1.0 / depth)
        reach = jnp.ceil(jnp.clip(disparity, narrowest * scale, widest * scale))
        return lost | ((depth - nearer > JUMP) & (k <= reach))

    farthest = jnp.ceil(jnp.asarray(widest * scale)).astype(int)
    return jax.lax.fori_loop(1, farthest + 1, cast, jnp.zeros(depth.shape, bool))


def blobs(
    key: Key[Array, ""], camera: Camera, inside: Bool[Array, "h w"], share: jax.Array | float, length: float
) -> Bool[Array, "h w"]:
    """Connected blobs that take a share of the pixels `inside`.

    They lie where a sum of plane waves of about one length is largest. The waves belong to the rays, so that a camera
    with more pixels, or with a part of them, sees the same blobs.

    Args:
      key: PRNG key.
      camera: of the image; may be traced.
      inside: where blobs may be.
      share: of those pixels.
      length: of the waves, in pixels.
    """
    turn, stretch, phase = jax.random.uniform(key, (3, WAVES))
    count = 2 * math.pi * USUAL_FX / length * (0.75 + 0.5 * stretch)
    turn = 2 * math.pi * turn
    field = plane_waves(camera, inside.shape, count * jnp.cos(turn), count * jnp.sin(turn), 2 * math.pi * phase)
    highest = jnp.sort(jnp.where(inside, field, -jnp.inf).reshape(-1), descending=True)
    number = jnp.round(share * jnp.sum(inside)).astype(int)
    return inside & (field > highest[jnp.minimum(number, highest.size - 1)])


def plane_waves(
    camera: Camera,
    shape: tuple[int, ...],
    right: Float[Array, " waves"],
    down: Float[Array, " waves"],
    phase: Float[Array, " waves"],
) -> Float[Array, "h w"]:
    """A sum of cosines over the rays of an image.

    Args:
      camera: of the image; may be traced.
      shape: of the image, h and w.
      right, down: change of each one's angle with the tangents of a ray's angles to the camera's axis [rad].
      phase: angle of each along the axis [rad].
    """
    height, width = shape
    x = (jnp.arange(width) + 0.5 - camera.cx) / camera.fx
    y = (jnp.arange(height) + 0.5 - camera.cy) / camera.fy
    across = right[:, None] * x[None] + phase[:, None]
    along = down[:, None] * y[None]
    # cos(a + b) = cos a cos b - sin a sin b
    field = jnp.einsum("kh,kw->hw", jnp.cos(along), jnp.cos(across), precision="highest")
    return field - jnp.einsum("kh,kw->hw", jnp.sin(along), jnp.sin(across), precision="highest")
