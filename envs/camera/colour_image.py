"""The colour image of a simulated camera: what colour everything has, and what the camera makes of it."""

from __future__ import annotations

import colorsys
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from mechsearch_jax.envs.camera.simulated_camera import LIGHT, PALETTE, SHELF, Appearance
from mechsearch_jax.envs.world.mismatch import USUAL_COLOUR_NOISE, USUAL_HUE_GAP
from mechsearch_jax.envs.world.world import TARGET, World
from mechsearch_jax.runtime.pytree import PyTreeNode

# Ranges from which the objects' saturation and brightness are drawn: from grey to pure, from dark to bright.
SATURATIONS, BRIGHTNESSES = (0.0, 0.9), (0.25, 0.95)
# Deviation of the components of the light's direction from those of the unit vector along `simulated_camera.LIGHT`.
LIGHT_SPREAD = 0.3
# Brightness levels of a channel.
LEVELS = 255


class ColourSensing(PyTreeNode):
    """How a colour camera and the colours before it are; all numbers are data.

    Attributes:
      noise: standard deviation of each channel, in shares of full brightness.
      exposure: factor on all channels, before they are clipped.
      white_balance: share by which red is too strong and blue too weak.
      hue_gap: least difference of the objects' hues from the target's [degrees], at most 180.
    """

    noise: jax.Array | np.ndarray | float = USUAL_COLOUR_NOISE
    exposure: jax.Array | np.ndarray | float = 1.0
    white_balance: jax.Array | np.ndarray | float = 0.0
    hue_gap: jax.Array | np.ndarray | float = USUAL_HUE_GAP


def scene_key(world: World) -> Key[Array, ""]:
    """A key that belongs to a scene: it depends on the sizes of what stands on the shelf, not on where it stands.

    What is drawn with it is the same at every look of every episode in the scene, and another in other scenes.
    """
    bits = jax.lax.bitcast_convert_type(jnp.asarray(world.half_size, jnp.float32), jnp.uint32).reshape(-1)
    odd = 2 * jnp.arange(bits.size, dtype=jnp.uint32) + 1
    return jax.random.fold_in(jax.random.key(0), jnp.sum(bits * odd, dtype=jnp.uint32))


def drawn_appearance(
    key: Key[Array, ""], target: tuple[float, float, float], hue_gap: Array | np.ndarray | float
) -> Appearance:
    """An appearance with random colours of the objects and a random direction of the light.

    Hue, saturation and brightness of an object are uniformly distributed in what `hue_gap` and `SATURATIONS` allow. The
    shelf is as in `PALETTE`.

    Args:
      key: PRNG key.
      target: the target's colour, red, green and blue in 0 to 1.
      hue_gap: as in `ColourSensing`.
    """
    hue_key, other_key, light_key = jax.random.split(key, 3)
    gap = jnp.asarray(hue_gap) / 360.0
    hue = colorsys.rgb_to_hsv(*target)[0] + gap + (1.0 - 2.0 * gap) * jax.random.uniform(hue_key, (TARGET,))
    low, high = (jnp.array([ends]) for ends in zip(SATURATIONS, BRIGHTNESSES, strict=True))
    saturation, brightness = jnp.moveaxis(low + (high - low) * jax.random.uniform(other_key, (TARGET, 2)), -1, 0)
    colours = jnp.concatenate([_rgb(hue, saturation, brightness), jnp.array([target]), PALETTE[SHELF:]])
    light = np.array(LIGHT, np.float32) / math.hypot(*LIGHT) + LIGHT_SPREAD * jax.random.normal(light_key, (3,))
    return Appearance(colours, light)


def sensed_colour(key: Key[Array, ""], colour: Float[Array, "h w 3"], sensing: ColourSensing) -> Float[Array, "h w 3"]:
    """What a camera makes of a colour image: exposed, out of balance, noisy, clipped, and rounded to 8 bits a channel.

    Args:
      key: PRNG key of the noise.
      colour: red, green and blue in 0 to 1.
      sensing: of the camera.
    """
    gains = sensing.exposure * jnp.stack([1.0 + sensing.white_balance, jnp.float32(1.0), 1.0 - sensing.white_balance])
    noisy = colour * gains.reshape(1, 1, 3) + sensing.noise * jax.random.normal(key, colour.shape)
    return jnp.round(LEVELS * jnp.clip(noisy, 0.0, 1.0)) / LEVELS


def _rgb(hue: Array, saturation: Array, brightness: Array) -> Float[Array, " n 3"]:
    """Red, green and blue of a hue in turns, a saturation and a brightness in 0 to 1."""
    sector = jnp.mod(jnp.array([[5.0, 3.0, 1.0]]) + 6.0 * hue[:, None], 6.0)
    share = jnp.clip(jnp.minimum(sector, 4.0 - sector), 0.0, 1.0)
    return brightness[:, None] * (1.0 - saturation[:, None] * share)
