"""Draws the household catalogue: `python -m mechsearch_jax.envs.scenes.household_pictures OUT.png`."""

from __future__ import annotations

import math
import sys

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.figure import Figure

from mechsearch_jax.envs.scenes.household import Thing, household
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike, replacing
from mechsearch_jax.shapes import PRIMITIVES
from mechsearch_jax.shapes.compound import solids, surface_points
from mechsearch_jax.viz.raycast import Eye, VisibleSolid
from mechsearch_jax.workspace.camera import Camera

COLUMNS, SIDE = 7, 200
# Direction from a thing to the eye, and the distance in lengths of the thing.
TOWARDS = np.array([0.4, -0.85, 0.45])
DISTANCE = 3.2
LIGHT, AMBIENT, PAPER = (-0.2, -0.62, 0.74), 0.45, (1.0, 1.0, 1.0)


def _camera(centre: Float[np.ndarray, " 3"], length: float) -> Camera:
    """A camera that looks at a thing of a length [m]."""
    back = TOWARDS / np.linalg.norm(TOWARDS)
    right = np.cross(-back, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(-back, right), -back], axis=1)
    place = centre + DISTANCE * length * back
    focal = 0.8 * SIDE * DISTANCE
    rows = tuple(tuple(float(v) for v in row) for row in rotation)
    x, y, z = place.tolist()
    return Camera(SIDE, SIDE, focal, focal, SIDE / 2, SIDE / 2, rows, (x, y, z))  # pyright: ignore[reportArgumentType]


def picture_of(thing: Thing) -> UInt8[np.ndarray, "h w 3"]:
    """A picture of a thing as it stands, 8 bits per channel."""
    points = surface_points(thing.compound)
    low, high = points.min(axis=0), points.max(axis=0)
    eye = Eye(_camera((low + high) / 2, float(np.linalg.norm(high - low))), LIGHT, AMBIENT, PAPER)
    colour = thing.compound.colour or (0.5, 0.5, 0.5)
    drawn = [
        VisibleSolid(PRIMITIVES[s.shape], np.array(s.half_size), s.rotation, np.array(s.position), colour)
        for s in solids(thing.compound.pieces)
    ]
    return eye.picture(drawn).pixels


def draw(path: PathLike) -> None:
    """Draw all things, each in a field of its own and as large as fits.

    Raises:
      InputError: the file cannot be written.
    """
    things = list(household().values())
    rows = math.ceil(len(things) / COLUMNS)
    figure = Figure(figsize=(1.6 * COLUMNS, 1.75 * rows), layout="constrained")
    for axes, thing in zip(figure.subplots(rows, COLUMNS).flat, things, strict=False):
        points = surface_points(thing.compound)
        extent = 100 * np.ptp(points, axis=0)
        axes.imshow(picture_of(thing))
        axes.set_title(thing.name, fontsize=9)
        axes.set_xlabel(" x ".join(f"{e:.0f}" for e in extent) + " cm", fontsize=7)
    for axes in figure.axes:
        axes.set_xticks([])
        axes.set_yticks([])
        axes.spines[:].set_visible(False)
    with replacing(path) as file:
        figure.savefig(file, format="png", dpi=100)


def main() -> None:
    """Draw the catalogue into the file that the command line names."""
    if len(sys.argv) != 2:
        raise InputError(f"usage: python -m {__spec__.name} OUT.png")
    draw(sys.argv[1])


if __name__ == "__main__":
    main()
